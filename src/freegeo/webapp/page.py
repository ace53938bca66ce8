"""The page: what its controls are called, what each does, and what its panel shows. Gradio draws it."""

# Annotations are values here, not text: Gradio looks for `gr.Request` among those of functions inside a function.
import base64
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from freegeo.adaptation.recipe import Guard, RecipeName
from freegeo.data.image_files import UnreadableImageError
from freegeo.data.photos import evenly_spaced, open_photos
from freegeo.data.video import is_video
from freegeo.errors import UserError
from freegeo.export.base import DEFAULT_FORMATS
from freegeo.export.formats import FORMATS
from freegeo.host import gigabytes, size_text
from freegeo.models import catalog
from freegeo.models.spec import ModelEntry
from freegeo.report.answer import answer
from freegeo.report.contents import contents
from freegeo.report.rendering import duration, fill
from freegeo.report.result import REPORT_NAME, SUMMARY_NAME
from freegeo.report.schema import Summary, read_part
from freegeo.webapp.runs import PHOTOS, ZIP_NAME, Choice, Run
from freegeo.webapp.sessions import AWAY_S, Session, Sessions

if TYPE_CHECKING:
    import gradio as gr

HERE = Path(__file__).parent / "templates"
TICK_S = 0.7
MOST_VIEWS = 32
"""Default limit of the photos that are used, as many as one browser page shows well."""
MOST_DIGITS = 9
"""Of a number in the page."""
THUMBNAILS, THUMBNAIL_SIDE = 8, 128
SHOW_PANEL = "() => document.querySelector('#outcome').scrollIntoView({behavior: 'smooth', block: 'nearest'})"
"""On a phone the panel is below the controls."""
NAME_RUN = """() => {
  const run = document.querySelector("[data-run]");
  if (run) history.replaceState(null, "", `?run=${run.dataset.run}`);
}"""
"""So that the page finds its run again when it is reloaded."""
WHAT_GUARD_DOES = (
    "select: matches between the photos decide whether the adapter is used; report: they are only asked; off"
)
STEPS, VIEWS = "Training steps (--steps)", "Most photos that are used (--max-views)"
RECIPES: tuple[RecipeName, ...] = ("scene", "evidence")
"""Those for a visitor's own photos; the others reproduce published settings."""


def models() -> list[ModelEntry]:
    """Return the models that can be used; plug-ins that do not work are left out with a warning."""
    return catalog.for_each(catalog.entry)


def download_of(item: ModelEntry) -> str:
    """Say how much has to be downloaded for a model."""
    if item.hub_id is not None:
        return gigabytes(item.download_bytes)
    return "included" if item.packaged_weights else "no download"


def short_licence(item: ModelEntry) -> str:
    """Return the name of the weights' licence, and whether it forbids commercial use; `about_model` has all of it."""
    name, _, details = item.licence.partition(" (")
    return f"{name}, non-commercial" if details.startswith("non-commercial") else name


def about_model(item: ModelEntry) -> str:
    """Return the note below the choice of the model, as HTML."""
    return render("model.html.j2", item=item, download=download_of(item))


def about_uploads(session: Session) -> str:
    """Return what the page says of the uploads, as HTML: how many and how large, some of them, and what is wrong."""
    problems, photos = [], []
    for path in session.uploads:
        if not is_video(path):
            try:
                photos += open_photos([path])
            except UnreadableImageError as error:
                problems.append(f"{path.name}: {error.reason}.")
    pictures = []
    for index in evenly_spaced(len(photos), THUMBNAILS) if photos else []:
        try:
            pictures.append(_thumbnail(photos[index].read()))
        except UnreadableImageError as error:
            problems.append(f"{photos[index].name}: {error.reason}.")
    sizes = sorted({photo.size_hw for photo in photos})
    return render(
        "uploads.html.j2", count=len(photos), sizes=[f"{width} × {height}" for height, width in sizes[:3]],
        more_sizes=max(0, len(sizes) - 3), pictures=pictures, problems=problems,
        videos=[path.name for path in session.uploads if is_video(path)],
    )  # fmt: skip


def _thumbnail(pixels: Any) -> str:
    from PIL import Image

    image = Image.fromarray(pixels)
    image.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE))
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=80)
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def panel(sessions: Sessions, session: Session, *, gone: bool = False) -> str:
    """Return what stands beside the controls, as HTML: how to begin, how far it is, or the result.

    `gone`: the page had a run, which was removed since.
    """
    run = session.run
    if run is None:
        return render("begin.html.j2", gone=gone, away=duration(AWAY_S))
    if run.state == "done":
        return result(run, kept=sessions.keep is not None)
    return render(
        "progress.html.j2", run=run, before=sessions.queue.before(run), duration=duration,
        sentence=capital(run.sentence or ""),
    )  # fmt: skip


def result(run: Run, *, kept: bool) -> str:
    """Return a finished result as HTML: the verdict, doubts, the scene, the maps, and the files.

    `kept`: it stays when the page is closed.
    """
    summary = read_part(run.result / SUMMARY_NAME, Summary)
    seconds = sum((summary.get("seconds") or {}).values())
    height, width = summary.get("image_hw") or (0, 0)
    used, given = len(summary.get("images") or ()), list((run.folder / PHOTOS).iterdir())
    is_part = len(given) > used and not any(map(is_video, given))
    return render(
        "result.html.j2",
        answer=answer(summary),
        adapted=bool(summary.get("recipe")),
        has_cameras=summary.get("filters") is not None,
        warnings=[run.without_folders(text) for text in summary.get("warnings") or []],
        missing=run.sentence,
        facts=[
            ("model", summary.get("model")), ("photos used", f"{used} of {len(given)}" if is_part else used),
            ("resolution", f"{width} × {height}"), ("time", duration(seconds)),
        ],
        licence=summary.get("licence_of_weights"),
        address=f"result/{run.token}",
        zip_name=ZIP_NAME,
        files=list(files(run)),
        folder=run.folder if kept else None,
        away=duration(AWAY_S),
    )  # fmt: skip


def files(run: Run) -> Iterator[dict[str, str]]:
    """Give name, size and purpose of the files of a result that can be fetched one by one."""
    order = [REPORT_NAME, *(FORMATS[name].path for name in DEFAULT_FORMATS)]
    there = [path for path in run.result.iterdir() if path.is_file() and not path.name.startswith(".")]
    about = contents(run.result)
    rank = {name: number for number, name in enumerate(order)}
    for path in sorted(there, key=lambda path: (rank.get(path.name, len(rank)), path.name)):
        yield {"name": path.name, "size": size_text(path.stat().st_size), "about": about.get(path.name, "")}


def capital(sentence: str) -> str:
    """Let a sentence begin with a capital, unless it begins with the name of a file."""
    first = sentence.partition(" ")[0]
    return sentence[:1].upper() + sentence[1:] if first.isalpha() else sentence


def render(template: str, **values: Any) -> str:
    """Return a part of the page as HTML (`freegeo.report.rendering.fill`)."""
    return fill(template, package="freegeo.webapp", **values)


def build(sessions: Sessions, *, model: str) -> "gr.Blocks":
    """Build the page; `model` is the one that is chosen at first."""
    import gradio as gr

    entries = {item.name: item for item in models()}
    choices = [(f"{name} · {short_licence(item)} · {download_of(item)}", name) for name, item in entries.items()]
    with gr.Blocks(analytics_enabled=False, title="freegeo", fill_width=True) as page:
        gr.HTML(render("head.html.j2"))
        with gr.Row(elem_id="columns"):
            with gr.Column(scale=2, min_width=330, elem_id="controls"):
                dropped = gr.File(label="Photos of one place, or one video", file_count="multiple", elem_id="photos")
                noticed = gr.HTML("", elem_id="noticed")
                chosen = gr.Dropdown(choices, value=model, label="Model", elem_id="model")
                about = gr.HTML(about_model(entries[model]))
                adapt = gr.Checkbox(
                    True, label="Adapt the model to these photos",
                    info="Takes longer; matches between the photos decide whether it is used. Off: --no-adapt.",
                    elem_id="adapt",
                )  # fmt: skip
                with gr.Accordion("Advanced", open=False, elem_id="advanced"):
                    # Not numbers for Gradio, which makes an empty one 0.
                    steps = gr.Textbox("", label=STEPS, placeholder="as the recipe says: 100", elem_id="steps")
                    views = gr.Textbox(
                        str(MOST_VIEWS), label=VIEWS, elem_id="views",
                        info="Of more, as many are chosen evenly. More photos need more memory.",
                    )  # fmt: skip
                    recipe = gr.Radio(
                        list(RECIPES), value="scene", label="Recipe (--recipe)",
                        info="evidence also learns cameras from matches between the photos",
                    )  # fmt: skip
                    guard = gr.Radio(
                        list(get_args(Guard)), value="select", label="Guard (--guard)", info=WHAT_GUARD_DOES
                    )
                    refine = gr.Radio(
                        ["auto", "ba", "off"], value="auto", label="Bundle adjustment of the cameras (--refine)",
                        info="auto: where the extra colmap is installed", elem_id="refine",
                    )  # fmt: skip
                    formats = gr.CheckboxGroup(
                        list(FORMATS), value=list(DEFAULT_FORMATS), label="Files (--formats)", elem_id="formats"
                    )
                    skip_bad = gr.Checkbox(
                        False, label="Leave out photos that cannot be read (--skip-bad)", elem_id="skip-bad"
                    )
                with gr.Row(elem_id="buttons"):
                    start = gr.Button("Reconstruct", variant="primary", elem_id="start", min_width=120)
                    cancel = gr.Button("Cancel", variant="stop", interactive=False, elem_id="cancel", min_width=80)
                trouble = gr.HTML("", elem_id="trouble")
            with gr.Column(scale=5, min_width=330, elem_id="outcome"):
                shown = gr.HTML(panel(sessions, Session()), elem_id="panel")
        gr.HTML(render("foot.html.j2"))
        timer = gr.Timer(TICK_S, active=False)

        def state(session: Session, *, gone: bool = False) -> list[Any]:
            """Update the panel, where it changed, the two buttons, and whether the page asks again."""
            text = panel(sessions, session, gone=gone)
            same, session.shown = text == session.shown, text
            active = session.run is not None and session.run.is_active
            stopping = session.run is not None and session.run.stopping
            return [
                gr.skip() if same else text, gr.update(interactive=not active),
                gr.update(interactive=active and not stopping), gr.update(active=active),
            ]  # fmt: skip

        def arrive(request: gr.Request) -> list[Any]:
            session = sessions.session(_key(request))
            sessions.find_again(session, request.query_params.get("run", ""))
            return state(session)

        def take(paths: Sequence[str] | None, request: gr.Request) -> str:
            session = sessions.session(_key(request))
            session.uploads = [Path(path) for path in paths or ()]
            return about_uploads(session)

        def begin(
            model: str, adapt: bool, steps: str, views: str, recipe: str, guard: str, refine: str,
            formats: list[str], skip_bad: bool, request: gr.Request,
        ) -> list[Any]:  # fmt: skip
            session, trouble = sessions.session(_key(request)), ""
            try:
                choice = Choice(
                    model=model, adapt=adapt, steps=whole_number(steps, STEPS), max_views=whole_number(views, VIEWS),
                    recipe=recipe, guard=guard, refine=refine, formats=tuple(formats), skip_bad=skip_bad,
                )  # fmt: skip
                sessions.start(session, choice)
            except UserError as error:
                trouble = render("trouble.html.j2", sentence=capital(str(error)))
            return [*state(session), trouble]

        def look(request: gr.Request) -> list[Any]:
            session = sessions.session(_key(request))
            return state(session, gone=session.run is None)  # only pages with a run ask

        def stop(request: gr.Request) -> list[Any]:
            session = sessions.session(_key(request))
            if session.run is not None:
                sessions.queue.cancel(session.run)
            return state(session)

        def leave(request: gr.Request) -> None:
            sessions.leave(_key(request))

        outputs = [shown, start, cancel, timer]
        settings = [chosen, adapt, steps, views, recipe, guard, refine, formats, skip_bad]
        # All answer at once, so that none has to wait in a queue of Gradio's.
        quick: dict[str, Any] = {"queue": False, "show_progress": "hidden", "api_visibility": "private"}
        dropped.change(take, dropped, noticed, **quick)
        chosen.change(lambda name: about_model(entries[name]), chosen, about, **quick)
        page.load(arrive, None, outputs, **quick)
        start.click(begin, settings, [*outputs, trouble], **quick).then(None, js=NAME_RUN)
        start.click(None, js=SHOW_PANEL)
        cancel.click(stop, None, outputs, **quick)
        timer.tick(look, None, outputs, **quick)
        page.unload(leave)
    return page


def whole_number(text: str, label: str) -> int | None:
    """Read a number of at least 1; None for an empty field. UserError for anything else."""
    digits = text.strip()
    if not digits:
        return None
    if not digits.isdecimal() or len(digits) > MOST_DIGITS or int(digits) < 1:
        raise UserError(f"{label} is a whole number from 1 on, got '{text[:40]}'.")
    return int(digits)


def _key(request: "gr.Request") -> str:
    return str(request.session_hash)


def design() -> dict[str, Any]:
    """Return how Gradio draws the page: our style, and fonts of the system in place of its own."""
    import gradio as gr

    fonts = ["system-ui", "-apple-system", "Segoe UI", "Roboto", "DejaVu Sans", "sans-serif"]
    theme = gr.themes.Default(
        primary_hue="blue", neutral_hue="slate", font=fonts, font_mono=["ui-monospace", "DejaVu Sans Mono", "monospace"]
    ).set(body_text_color_subdued="#5d666f", body_text_color_subdued_dark="#a2abb4")
    return {"theme": theme, "css_paths": [HERE / "app.css"], "footer_links": [], "run_history": False}
