"""Further processes that train on the same weights without locks (Hogwild), one thread each."""

from __future__ import annotations

import logging
import multiprocessing
from pathlib import Path
from types import TracebackType
from typing import Self

import torch

from freegeo.errors import FreeGeoError
from freegeo.training.config import TrainConfig
from freegeo.training.state import State

logger = logging.getLogger(__name__)

JOIN_S = 60.0


class Crew:
    """The processes beside the first one; they stop at the end of the block, and when the first process ends."""

    def __init__(self, state: State, config: TrainConfig, folder: Path, count: int):
        context = torch.multiprocessing.get_context("spawn")
        self.lock, self._stop = context.Lock(), context.Event()
        if count:
            state.share()
        arguments = (state, config, folder, self.lock, self._stop)
        self._processes = [context.Process(target=work, args=arguments, daemon=True) for _ in range(count)]

    def __enter__(self) -> Self:
        for process in self._processes:
            process.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._stop.set()
        for process in self._processes:
            process.join(JOIN_S)
            if process.is_alive():
                process.terminate()

    def check(self) -> None:
        """Raise FreeGeoError when a process died before the run ended."""
        for process in self._processes:
            if process.exitcode:
                raise FreeGeoError(f"a training worker stopped with exit code {process.exitcode}. Resume the run.")


def work(state: State, config: TrainConfig, folder: Path, lock, stop) -> None:
    """Train until the first process sets `stop` or ends, or the view budget is used up."""
    from freegeo.training.loop import Trainer, open_pool

    torch.set_num_threads(1)
    parent = multiprocessing.parent_process()
    trainer = Trainer(state, open_pool(config, state, folder, "cpu"), config, folder, lock)
    while state.seen < config.views and not stop.is_set() and parent is not None and parent.is_alive():
        # Only the first process renders, so that no room is rendered twice.
        trainer.step(render_new=False)
