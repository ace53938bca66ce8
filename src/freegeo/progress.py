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
from threading import Lock, get_ident
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from freegeo.adaptation.state import Progress

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

    def __init__(self, thread: int | None = None) -> None:
        """Start without any; with a `thread`, only what that one says is kept."""
        super().__init__(logging.WARNING)
        self.sentences: list[str] = []
        self._thread = thread

    def emit(self, record: logging.LogRecord) -> None:
        """Keep what a record says."""
        if self._thread not in (None, get_ident()):
            return
        sentence = record.getMessage()
        if sentence not in self.sentences:
            self.sentences.append(sentence)


@contextmanager
def remembered() -> Generator[list[str]]:
    """Collect the warnings of the package that this thread gives in the block.

    They are collected whatever level the caller's loggers have, and the caller's handlers get no more than before.
    """
    memory, package = Remembering(get_ident()), logging.getLogger("freegeo")
    _hear_warnings(package)
    package.addHandler(memory)
    try:
        yield memory.sentences
    finally:
        package.removeHandler(memory)
        _hear_as_before()


_LISTENING = Lock()
_blocks = 0
_levels: dict[logging.Logger, int] = {}
"""Levels of loggers that are lower while a block of `remembered` runs, in any thread."""
_filtered: list[logging.Handler] = []


def _hear_warnings(package: logging.Logger) -> None:
    global _blocks
    with _LISTENING:
        _blocks += 1
        if _blocks > 1:
            return
        every = [one for one in package.manager.loggerDict.values() if isinstance(one, logging.Logger)]
        own = [one for one in every if one is package or one.name.startswith(f"{package.name}.")]
        deaf = {one: one.level for one in own if one.level > logging.WARNING}
        if package.getEffectiveLevel() > logging.WARNING:
            deaf[package] = package.level
        if not deaf:
            return
        _filtered[:] = {handler for one in own for handler in _handlers_of(one)}
        _levels.update(deaf)
        for handler in _filtered:
            handler.addFilter(_was_heard)
        for one in deaf:
            one.setLevel(logging.WARNING)


def _hear_as_before() -> None:
    global _blocks
    with _LISTENING:
        _blocks -= 1
        if _blocks:
            return
        for one, level in _levels.items():
            one.setLevel(level)
        for handler in _filtered:
            handler.removeFilter(_was_heard)
        _levels.clear()
        _filtered.clear()


def _handlers_of(logger: logging.Logger) -> list[logging.Handler]:
    """Return the handlers that get what a logger says."""
    above = _handlers_of(logger.parent) if logger.propagate and logger.parent is not None else []
    return [*logger.handlers, *above]


def _was_heard(record: logging.LogRecord) -> bool:
    """Whether a record would have been made with the levels that the caller gave to the loggers."""
    one: logging.Logger | None = logging.getLogger(record.name)
    while one is not None:
        level = _levels.get(one, one.level)
        if level:
            return record.levelno >= level
        one = one.parent
    return True
