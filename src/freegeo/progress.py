"""Progress of a long piece of work: a bar in a terminal or a notebook, a line every tenth in a log file; its warnings.

Progress goes to stderr. The library shows nothing unless it is asked to (`freegeo.adapt(..., progress=True)`).
"""

from __future__ import annotations

import logging
import os
import re
import sys
import time
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from freegeo.adaptation.adapt import Progress

Update = Callable[..., None]
LINES = 10
"""Lines of a whole piece of work in a log file."""
LINES_VARIABLE = "FREEGEO_PROGRESS_LINES"
"""Environment variable with another number of lines, for a program that follows them (`read_line`)."""
_LINE = re.compile(r"(?P<title>[^:/]+): (?P<done>\d+)/(?P<total>\d+)(, (?P<left>\d+) s left)?(, (?P<text>.+))?")
LOSS_EVERY = 10
"""Most steps between two readings of the loss, each of which waits for the device."""


@contextmanager
def progress_bar(title: str, total: int) -> Generator[Update]:
    """Show how much of `total` is done, with the time left; gives `update(done, text=None)`.

    `text` stands behind the numbers until another one is given, in a bar and in lines.
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
    """Give an `on_step` for `adapt` that shows a bar from the first step to the last, and calls `then` too.

    The loss shown is the mean of the steps since it was shown last: single steps are of view sets of unequal losses.
    """
    with ExitStack() as stack:
        update: Update | None = None
        unread: list[Tensor] = []

        def on_step(progress: Progress) -> None:
            nonlocal update
            update = update or stack.enter_context(progress_bar("adapting", progress.steps))
            done, last, text = progress.step + 1, progress.step + 1 == progress.steps, None
            unread.append(progress.terms["total"])
            if last or done == 1 or done % min(LOSS_EVERY, max(1, progress.steps // LINES)) == 0:
                text = f"loss {sum(map(float, unread)) / len(unread):.4g}"
                unread.clear()
            update(done, text)
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


@dataclass(frozen=True)
class Line:
    """What a line in a log file says."""

    title: str
    done: int
    total: int
    seconds_left: int | None = None
    text: str = ""

    def __str__(self) -> str:
        left = "" if self.seconds_left is None else f", {self.seconds_left} s left"
        return f"{self.title}: {self.done}/{self.total}{left}{', ' + self.text if self.text else ''}"


def read_line(text: str) -> Line | None:
    """Return what a line of progress says; None for any other line."""
    found = _LINE.fullmatch(text.rstrip())
    if found is None:
        return None
    left = None if found["left"] is None else int(found["left"])
    return Line(found["title"], int(found["done"]), int(found["total"]), left, found["text"] or "")


def _lines(title: str, total: int) -> Update:
    first, shown, known = None, -1, ""
    lines = int(os.environ.get(LINES_VARIABLE, LINES))

    def update(done: int, text: str | None = None) -> None:
        nonlocal first, shown, known
        known = known if text is None else text
        # Time and work before the first report, such as an adaptation or an earlier run, do not count for the speed.
        first = first or (done, time.monotonic())
        part = done * lines // total
        if part > shown:
            shown = part
            gained, seconds = done - first[0], time.monotonic() - first[1]
            left = round(seconds * (total - done) / gained) if gained else None
            sys.stderr.write(f"{Line(title, done, total, left, known)}\n")
            sys.stderr.flush()

    return update


class Remembering(logging.Handler):
    """Keeps warnings, each once, for the summary and the report of a result."""

    def __init__(self) -> None:
        """Start without any."""
        super().__init__(logging.WARNING)
        self.sentences: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep what a record says."""
        sentence = record.getMessage()
        if sentence not in self.sentences:
            self.sentences.append(sentence)
