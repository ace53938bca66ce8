"""What `run`, `reconstruct` and `demo` share: prepare photos, run a job with progress, print the outcome."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from freegeo.cli import console
from freegeo.cli.files import FileOptions
from freegeo.cli.options import ModelOptions, OutputOptions
from freegeo.export import reconstruction as npz
from freegeo.export.formats import FORMATS
from freegeo.progress import step_bar
from freegeo.run_folder import check_folder, run_folder

if TYPE_CHECKING:
    from freegeo.adaptation.recipe import Recipe
    from freegeo.models.api import ReconstructionModel
    from freegeo.pipeline import Hooks, Job
    from freegeo.types import PhotoLike

DEFAULT_FILES = FileOptions()
FRAMES_FOLDER = "images"
FILES = {
    "report.html": "the page to look at first",
    npz.FORMAT.path: npz.FORMAT.about,
    "frozen/prediction.npz": "the same before adaptation",
    "adapter": "the adapter (peft format)",
    **{format.path: format.about for format in FORMATS.values()},
    "images": "the frames of the video that were used",
    "reconstruction.json": "settings, timings, versions, licence of the weights",
}


@contextmanager
def progress_hooks() -> Generator[Hooks]:
    """Show stages and adaptation steps."""
    from freegeo.pipeline import Hooks

    with step_bar() as on_step:
        yield Hooks(stage=lambda name: console.note(f"{name} ..."), step=on_step)


def run_job(
    photos: Sequence[PhotoLike],
    model: ReconstructionModel,
    model_options: ModelOptions,
    output: OutputOptions,
    *,
    command: str,
    recipe: Recipe | None,
    adapter: Path | None = None,
    files: FileOptions = DEFAULT_FILES,
    extra_settings: dict[str, Any] | None = None,
    after: Callable[[Job], None] = lambda job: None,
) -> None:
    """Run a job in its output folder and print the outcome; a finished folder is not changed.

    `after` writes more before the folder counts as finished.
    """
    from freegeo.data.video import VideoFrame
    from freegeo.pipeline import Job, require_enough_photos, scene_images, settings_of

    if recipe is not None:
        require_enough_photos(photos)
    batch = model.preprocess(photos)
    settings = settings_of(
        recipe,
        command=command,
        photos=list(batch.names),
        photo_contents=batch.digest(),
        adapter=None if adapter is None else adapter_identity(adapter),
        **model_options.settings(model),
        **files.settings(),
        **(extra_settings or {}),
    )
    check_folder(output.output, settings, overwrite=output.overwrite)
    masks = files.checked_masks(photos)
    with run_folder(output.output, settings, overwrite=output.overwrite) as folder, progress_hooks() as hooks:
        if folder.finished:
            say_finished(output.output, folder.finished_at)
            return
        save_frames([photo for photo in photos if isinstance(photo, VideoFrame)], folder / FRAMES_FOLDER)
        job = Job(
            model=model, batch=batch, folder=folder, recipe=recipe, adapter=adapter, seed=model_options.seed,
            compute=model_options.compute(), hooks=hooks, reference=model_options.reference,
            command=console.command_line(), warnings=console.warned(), after=after, formats=files.formats,
            filters=files.filters.settings(), masks=masks,
            scene=None if recipe is None else scene_images("photos", photos, model, recipe, batch),
        )  # fmt: skip
        describe(job.run(), output.output)


def save_frames(photos: Sequence[PhotoLike], folder: Path) -> None:
    """Write photos that are in no file of their own as PNG, under the names that exports refer to."""
    from PIL import Image

    from freegeo.files import atomic_path

    for photo in photos:
        path = folder / f"{Path(photo.name).stem}.png"
        if not path.is_file():
            with atomic_path(path) as part:
                Image.fromarray(photo.read()).save(part)


def adapter_identity(folder: Path) -> dict[str, str]:
    """Return what identifies an adapter; UserError when the folder holds none."""
    from freegeo.adaptation.adapter_files import WEIGHTS, read_peft
    from freegeo.models.checkpoints import fingerprint

    read_peft(folder)
    return {"folder": str(folder.resolve()), "weights": fingerprint(folder / WEIGHTS)}


def say_finished(folder: Path, finished_at: str | None) -> None:
    """Say that there is nothing left to do."""
    console.say(f"{folder}: already finished on {finished_at}; nothing to do.")


def describe(summary: dict[str, Any], folder: Path) -> None:
    """Print the outcome of a job."""
    console.say(f"{len(summary['images'])} views at {summary['image_hw'][1]} x {summary['image_hw'][0]} pixels")
    if summary["loss"]:
        first, last = summary["loss"]["first"], summary["loss"]["last"]
        console.say(f"adaptation loss {first:.4f} -> {last:.4f} (means of the first and last tenth of the steps)")
    console.say("seconds: " + ", ".join(f"{name} {value:.1f}" for name, value in summary["seconds"].items()))
    console.say(f"licence of the weights: {summary['licence_of_weights']}")
    for sentence in summary["warnings"]:
        console.say(f"warning: {sentence}")
    console.written(folder, FILES)
