"""`freegeo train-tiny`: train the embedded model on generated rooms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from freegeo.cli import console
from freegeo.models.catalog import EMBEDDED_MODEL
from freegeo.progress import progress_bar


def train_tiny(
    output: Path,
    *,
    preset: str = "gpu",
    views: int | None = None,
    minutes: float | None = None,
    budget: float | None = None,
    workers: int = 1,
    device: str = "cpu",
    compile: bool = False,
    seed: int = 0,
    views_per_step: int | None = None,
    continue_from: Path | None = None,
    peak: float | None = None,
    cooldown: float | None = None,
    rooms: int | None = None,
    first_room: int | None = None,
) -> None:
    """Train the embedded model; the same command continues, a larger --views goes on from the plateau.

    Parameters
    ----------
    output
        Folder of the run: state, log, rendered rooms, weights.
    preset
        gpu, the recipe of the shipped weights; cpu, smaller photos and steps; or cameras, which trains the camera
        encoder of given weights and nothing else.
    views
        Views to learn from, counted with repetition; default: those of the shipped recipe.
    minutes
        Stop this leg after so many minutes; the state is saved.
    budget
        Minutes that the whole schedule fits in, all legs together: the learning rate reaches zero by then.
    workers
        Processes that train on shared weights without locks; more than one is faster but not reproducible.
    device
        cpu or cuda, for rendering and training.
    compile
        Compile the blocks of the network first; faster on a GPU after half a minute or so.
    seed
        Seed of weights and batches.
    views_per_step
        Views that each step learns from.
    continue_from
        Folder of another run, or a weight file (.safetensors); this one starts where that one stands, with these
        settings and rooms.
    peak
        Factor on all learning rates; about 0.2 for a run that continues a finished one.
    cooldown
        Share of the run's views in which the learning rate falls to zero.
    rooms
        Rooms to learn from.
    first_room
        First room of the training domain; a number beyond an earlier run's gives rooms that it has not seen.
    """
    from freegeo.errors import UserError
    from freegeo.models.precision import choose_device
    from freegeo.training.config import PRESETS
    from freegeo.training.curve import plot_learning_curve
    from freegeo.training.loop import LOG, train

    if preset not in PRESETS:
        raise UserError(f"unknown preset '{preset}'. Choose one of {', '.join(PRESETS)}.")
    given: dict[str, Any] = {
        "seed": seed,
        "views": views,
        "minutes": budget,
        "views_per_step": views_per_step,
        "peak": peak,
        "cooldown": cooldown,
        "rooms": rooms,
        "first_room": first_room,
    }
    config = replace(PRESETS[preset], **{name: value for name, value in given.items() if value is not None})
    with progress_bar("views", config.views) as update:
        weights = train(
            config, output, minutes=minutes, workers=workers, device=str(choose_device(device)), compile_blocks=compile,
            continue_from=continue_from, progress=lambda state: update(min(state.seen, config.views)),
        )  # fmt: skip
    console.say(f"weights: {weights} ({console.size(weights)})")
    console.say(f"score them: freegeo models score {EMBEDDED_MODEL} --checkpoint {weights}")
    log = output / LOG
    if log.is_file():
        console.say(f"learning curve: {plot_learning_curve(log, output / 'learning-curve.png')}")
