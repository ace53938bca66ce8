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
    budget: float | None = None,
    device: str | None = None,
    compile: bool = False,
    seed: int = 0,
    views_per_step: int | None = None,
    continue_from: Path | None = None,
    peak: float | None = None,
    cooldown: float | None = None,
    rooms: int | None = None,
    first_room: int | None = None,
) -> None:
    """Train the embedded model on a GPU; the same command continues.

    Parameters
    ----------
    output
        Folder of the run: state, log, rendered rooms, weights.
    views
        Views to learn from at most, counted with repetition; default: 9 million. With --budget 0 a finished run goes on
        from the plateau before its cool-down when more are asked for.
    minutes
        Stop this leg after so many minutes; the state is saved.
    budget
        Minutes that the whole schedule fits in, all legs together: the learning rate reaches zero by then. 0: no limit,
        and new rooms at fixed steps instead of in a share of the time, so that a CPU repeats a run exactly; default: 8.
    device
        cpu, cuda or cuda:N, for rendering and training; default: cuda where there is one. A CPU learns from a few views
        a second, a GPU from thousands.
    compile
        Compile the blocks of the network first; faster on a GPU after half a minute or so.
    seed
        Seed of weights and batches.
    views_per_step
        Views that each step learns from; default: 1024, which takes 47 GB of memory on a CPU.
    continue_from
        Folder of another run, or a weight file (.safetensors); this one starts where that one stands, with these
        settings and rooms.
    peak
        Factor on all learning rates; default: 1, and about 0.2 suits a run that continues a finished one.
    cooldown
        Share of the run's views in which the learning rate falls to zero; default: 0.8.
    rooms
        Rooms to learn from; default: 36 000.
    first_room
        First room of the training domain; a number beyond an earlier run's gives rooms that it has not seen.
    """
    import torch

    from freegeo.models.precision import choose_device
    from freegeo.training.config import TrainConfig
    from freegeo.training.curve import plot_learning_curve
    from freegeo.training.loop import LOG, train

    given: dict[str, Any] = {
        "seed": seed,
        "views": views,
        "minutes": budget,
        "views_per_step": views_per_step,
        "peak": peak,
        "cooldown": cooldown,
        "rooms": rooms,
        "first_room": first_room,
        "render_share": 0.0 if budget == 0 else None,
    }
    config = TrainConfig(**{name: value for name, value in given.items() if value is not None})
    chosen = choose_device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    with progress_bar("views", config.views) as update:
        weights = train(
            config, output, minutes=minutes, device=str(chosen), compile_blocks=compile, continue_from=continue_from,
            progress=lambda state: update(min(state.seen, config.views)),
        )  # fmt: skip
    console.say(f"weights: {weights} ({console.size(weights)})")
    console.say(f"score them: freegeo models score {EMBEDDED_MODEL} --checkpoint {weights}")
    log = output / LOG
    if log.is_file():
        console.say(f"learning curve: {plot_learning_curve(log, output / 'learning-curve.png')}")
