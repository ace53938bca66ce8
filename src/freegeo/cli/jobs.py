"""What `run`, `reconstruct` and `demo` share: prepare photos, run a job with progress, say what came out."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from freegeo.cli import console
from freegeo.cli.options import ModelOptions, OutputOptions
from freegeo.storage import check_folder, run_folder

if TYPE_CHECKING:
    from freegeo.adaptation.recipe import Recipe
    from freegeo.models.api import ReconstructionModel
    from freegeo.pipeline import Hooks, Job
    from freegeo.types import PhotoLike

FILES = {
    "report.html": "the page to look at first",
    "prediction.npz": "depth, confidence, cameras",
    "frozen/prediction.npz": "the same before adaptation",
    "adapter": "the adapter (peft format)",
    "points.ply": "coloured points",
    "scene.glb": "points and camera frusta",
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
    extra_settings: dict[str, Any] | None = None,
) -> Job | None:
    """Carry out a job in its output folder and say what came out; None when the folder holds the finished result."""
    from freegeo.pipeline import Job, require_enough_photos, settings_of

    if recipe is not None:
        require_enough_photos(photos)
    settings = settings_of(
        recipe,
        command=command,
        photos=[photo.name for photo in photos],
        adapter=None if adapter is None else str(adapter.resolve()),
        **model_options.settings(model),
        **(extra_settings or {}),
    )
    check_folder(output.output, settings, overwrite=output.overwrite)
    batch = model.preprocess(photos)
    with run_folder(output.output, settings, overwrite=output.overwrite) as folder, progress_hooks() as hooks:
        if folder.finished:
            console.say(f"{output.output}: already finished on {folder.finished_at}; nothing to do.")
            return None
        job = Job(
            model=model, batch=batch, folder=folder, recipe=recipe, adapter=adapter, seed=model_options.seed,
            engine=model_options.engine(), hooks=hooks,
        )  # fmt: skip
        describe(job.run(), output.output)
        return job


def describe(summary: dict[str, Any], folder: Path) -> None:
    """Print the outcome of a job."""
    console.say(f"{len(summary['images'])} views at {summary['image_hw'][1]} x {summary['image_hw'][0]} pixels")
    if summary["loss"]:
        first, last = summary["loss"]["first"], summary["loss"]["last"]
        console.say(f"adaptation loss {first:.4f} -> {last:.4f} (means of the first and last tenth of the steps)")
    console.say("seconds: " + ", ".join(f"{name} {value:.1f}" for name, value in summary["seconds"].items()))
    console.say(f"licence of the weights: {summary['licence_of_weights']}")
    console.written(folder, FILES)


def command_line() -> str:
    """Return the command as it was typed, for files that say how they were made."""
    return shlex.join(["freegeo", *sys.argv[1:]])
