"""`freegeo train-tiny`: train the embedded model on generated rooms."""

from __future__ import annotations

from pathlib import Path

from freegeo.cli import console
from freegeo.training.config import TrainConfig


def train_tiny(
    output: Path,
    *,
    views: int = TrainConfig.views,
    minutes: float | None = None,
    workers: int = 1,
    device: str = "cpu",
    seed: int = 0,
) -> None:
    """Train the embedded model; the same command continues, a larger --views goes on from the plateau.

    Parameters
    ----------
    output
        Folder of the run: state, log, rendered rooms, weights.
    views
        Views to learn from, counted with repetition.
    minutes
        Stop this leg after so many minutes; the state is saved.
    workers
        Processes that train on shared weights without locks; more than one is faster but not reproducible.
    device
        cpu or cuda, for rendering and training.
    seed
        Seed of weights, rooms and batches.
    """
    from freegeo.models.precision import choose_device
    from freegeo.training.curve import plot_learning_curve
    from freegeo.training.loop import LOG, train

    config = TrainConfig(views=views, seed=seed)
    with console.progress_bar("views", views) as update:
        weights = train(
            config, output, minutes=minutes, workers=workers, device=str(choose_device(device)),
            progress=lambda state: update(min(state.seen, views)),
        )  # fmt: skip
    console.say(f"weights: {weights} ({console.size(weights)})")
    log = output / LOG
    if log.is_file():
        console.say(f"learning curve: {plot_learning_curve(log, output / 'learning-curve.png')}")
