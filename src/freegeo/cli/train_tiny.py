"""`freegeo train-tiny`: train the embedded model on generated rooms."""

from __future__ import annotations

from pathlib import Path

from freegeo.cli import console


def train_tiny(
    output: Path,
    *,
    views: int | None = None,
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
        Views to learn from, counted with repetition; default: those of the shipped recipe.
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
    from freegeo.training.config import TrainConfig
    from freegeo.training.curve import plot_learning_curve
    from freegeo.training.loop import LOG, train

    config = TrainConfig(seed=seed) if views is None else TrainConfig(views=views, seed=seed)
    with console.progress_bar("views", config.views) as update:
        weights = train(
            config, output, minutes=minutes, workers=workers, device=str(choose_device(device)),
            progress=lambda state: update(min(state.seen, config.views)),
        )  # fmt: skip
    console.say(f"weights: {weights} ({console.size(weights)})")
    log = output / LOG
    if log.is_file():
        console.say(f"learning curve: {plot_learning_curve(log, output / 'learning-curve.png')}")
