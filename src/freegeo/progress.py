"""Progress of a long piece of work: a bar in a terminal or a notebook, a line every tenth in a log file.

Everything goes to stderr. The library shows nothing unless it is asked to (`freegeo.adapt(..., progress=True)`).
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from freegeo.adaptation.adapt import Progress

Update = Callable[..., None]
LOSS_EVERY = 10
"""Steps between two readings of the loss, each of which waits for the device."""


@contextmanager
def progress_bar(title: str, total: int) -> Generator[Update]:
    """Show how much of `total` is done, with the time left; gives `update(done, text=None)`.

    `text` stands behind the numbers until another one is given.
    """
    if not (sys.stderr.isatty() or in_notebook()):
        yield _lines(title, total)
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"),
        TimeRemainingColumn(), TextColumn("{task.fields[text]}"),
    )  # fmt: skip
    with Bar(*columns, console=Console(stderr=True)) as bar:
        task, known = bar.add_task(title, total=total, text=""), False

        def update(done: int, text: str | None = None) -> None:
            nonlocal known
            if not known:  # the start of a resumed run must not count towards the speed
                known = True
                bar.reset(task, completed=done)
            bar.update(task, completed=done)
            if text is not None:
                bar.update(task, text=text)

        yield update
        # In a notebook rich stops without drawing the last state.
        bar.refresh()


@contextmanager
def step_bar(then: Callable[[Progress], None] = lambda progress: None) -> Generator[Callable[[Progress], None]]:
    """Give an `on_step` for `adapt` that shows a bar from the first step to the last, and calls `then` too."""
    with ExitStack() as stack:
        update: Update | None = None

        def on_step(progress: Progress) -> None:
            nonlocal update
            update = update or stack.enter_context(progress_bar("adapting", progress.steps))
            last = progress.step + 1 == progress.steps
            look = last or progress.step % LOSS_EVERY == 0
            update(progress.step + 1, f"loss {float(progress.terms['total']):.4f}" if look else None)
            if last:
                stack.close()
            then(progress)

        yield on_step


def in_notebook() -> bool:
    """Whether rich can draw a bar below a notebook's cell, for which it needs ipywidgets."""
    if "IPython" not in sys.modules or find_spec("ipywidgets") is None:
        return False
    from rich.console import Console

    return Console().is_jupyter


def _lines(title: str, total: int) -> Update:
    first, shown = None, -1

    def update(done: int, text: str | None = None) -> None:
        nonlocal first, shown
        # Time and work before the first report, such as an adaptation or an earlier run, do not count for the speed.
        first = first or (done, time.monotonic())
        tenth = done * 10 // total
        if tenth > shown:
            shown = tenth
            gained, seconds = done - first[0], time.monotonic() - first[1]
            left = f", {seconds * (total - done) / gained:.0f} s left" if gained else ""
            sys.stderr.write(f"{title}: {done}/{total}{left}{', ' + text if text else ''}\n")
            sys.stderr.flush()

    return update
