"""What `run`, `reconstruct` and `demo` share: prepare photos, run a job with progress, say what came out."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from freegeo.cli import console
from freegeo.cli.files import FileOptions
from freegeo.cli.options import ModelOptions, OutputOptions
from freegeo.run_folder import check_folder, run_folder

if TYPE_CHECKING:
    from freegeo.adaptation.recipe import Recipe
    from freegeo.adaptation.samples import SceneImages
    from freegeo.models.api import ReconstructionModel
    from freegeo.pipeline import Hooks, Job
    from freegeo.types import PhotoLike

DEFAULT_FILES = FileOptions()
FRAMES_FOLDER = "images"
FILES = {
    "report.html": "the page to look at first",
    "prediction.npz": "depth, confidence, cameras",
    "frozen/prediction.npz": "the same before adaptation",
    "adapter": "the adapter (peft format)",
    "points.ply": "coloured points",
    "scene.glb": "points and camera frusta",
    "mesh.ply": "surface",
    "colmap": "COLMAP model with tracks",
    "transforms.json": "nerfstudio cameras",
    "depth": "16-bit depth images",
    "images": "the frames of the video that were used",
    "reconstruction.json": "settings, timings, versions, licence of the weights",
}


@contextmanager
def progress_hooks() -> Generator[Hooks]:
    """Show stages and adaptation steps."""
    from freegeo.pipeline import Hooks

    bars: list[Any] = []

    def show_step(progress) -> None:
        if not bars:
            bars.append(console.progress_bar("adapting", progress.steps))
            bars.append(bars[0].__enter__())
        last = progress.step + 1 == progress.steps
        # Reading a loss waits for the device, so it is done now and then only.
        text = f"loss {float(progress.terms['total']):.4f}" if last or progress.step % 10 == 0 else None
        bars[1](progress.step + 1, **({} if text is None else {"text": text}))
        if last:
            bars[0].__exit__(None, None, None)

    try:
        yield Hooks(stage=lambda name: console.note(f"{name} ..."), step=show_step)
    finally:
        if bars:
            bars[0].__exit__(None, None, None)


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
    """Carry out a job in its output folder and say what came out; a finished folder is left alone.

    `after` writes more before the folder counts as finished.
    """
    from freegeo.data.video import VideoFrame
    from freegeo.pipeline import Job, require_enough_photos, settings_of

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
            command=console.command_line(), after=after, formats=files.formats, filters=files.filters.settings(),
            masks=masks, scene=squashed_scene(photos, model, recipe),
        )  # fmt: skip
        describe(job.run(), output.output)


def squashed_scene(
    photos: Sequence[PhotoLike], model: ReconstructionModel, recipe: Recipe | None
) -> SceneImages | None:
    """Return the images of a recipe that has its own way to resize them."""
    from freegeo.adaptation.samples import SceneImages

    if recipe is None or recipe.squash is None:
        return None
    return SceneImages.from_photos("photos", photos, model, recipe)


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
    """Return what tells an adapter from another one; UserError when the folder holds none."""
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
    console.written(folder, FILES)
