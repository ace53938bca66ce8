"""`freegeo train-tiny`: train the embedded model on generated rooms."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from freegeo.cli import console
from freegeo.models.catalog import EMBEDDED_MODEL
from freegeo.progress import progress_bar


def train_tiny(
    output: Path,
    *,
    views: int | None = None,
    minutes: float | None = None,
    workers: int = 1,
    device: str = "cpu",
    seed: int = 0,
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
    views
        Views to learn from, counted with repetition; default: those of the shipped recipe.
    minutes
        Stop this leg after so many minutes; the state is saved.
    workers
        Processes that train on shared weights without locks; more than one is faster but not reproducible.
    device
        cpu or cuda, for rendering and training.
    seed
        Seed of weights and batches.
    continue_from
        Folder of another run; this one starts where that one stands, with these settings and rooms.
    peak
        Factor on all learning rates; about 0.2 for a run that continues a finished one.
    cooldown
        Share of the run's views in which the learning rate falls to zero.
    rooms
        Rooms to learn from.
    first_room
        First room of the training domain; a number beyond an earlier run's gives rooms that it has not seen.
    """
    from freegeo.models.precision import choose_device
    from freegeo.training.config import TrainConfig
    from freegeo.training.curve import plot_learning_curve
    from freegeo.training.loop import LOG, train

    given: dict[str, Any] = {
        "views": views,
        "peak": peak,
        "cooldown": cooldown,
        "rooms": rooms,
        "first_room": first_room,
    }
    config = TrainConfig(seed=seed, **{name: value for name, value in given.items() if value is not None})
    with progress_bar("views", config.views) as update:
        weights = train(
            config, output, minutes=minutes, workers=workers, device=str(choose_device(device)),
            continue_from=continue_from, progress=lambda state: update(min(state.seen, config.views)),
        )  # fmt: skip
    console.say(f"weights: {weights} ({console.size(weights)})")
    console.say(f"score them: freegeo models score {EMBEDDED_MODEL} --checkpoint {weights}")
    log = output / LOG
    if log.is_file():
        console.say(f"learning curve: {plot_learning_curve(log, output / 'learning-curve.png')}")
