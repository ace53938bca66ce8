"""One run at a time: `freegeo run` as a process of its own, whose progress is followed and which can be ended.

A process, not a thread: it ends when it is told to, saves its state then as after Ctrl-C, gives all memory of the
device back, and the web server answers meanwhile.
"""

from __future__ import annotations

import logging
import os
import re
import secrets
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from freegeo.export.base import DEFAULT_FORMATS
from freegeo.host import GRACE_S, bound_to_this_process
from freegeo.progress import LINES_VARIABLE, read_line

logger = logging.getLogger(__name__)

PHOTOS, RESULT, SCRATCH = "photos", "result", "scratch"
"""Folders of a run."""
ZIPS = "freegeo"
"""What the names of zip files of a result begin with; `ZIP_NAME` holds all of it, others one of its folders."""
ZIP_NAME = f"{ZIPS}.zip"
"""The zip file of a result, in the folder of its run."""
DONE_CODES = {0, 3}
"""Exit codes of a run whose result is there; 3 with something missing, which the result says."""
PROGRESS_LINES = 200
TEMPORARY = ("TMPDIR", "TEMP", "TMP")
"""Environment variables that name the folder of temporary files."""
_LAST_LINES = 30
_STAGE = re.compile(r"(.+) \.\.\.")
_DOWNLOAD = re.compile(r"(?P<file>[^:|]+):\s+(?P<percent>\d+)%\|[^|]*\| (?P<amount>[^ ]+) \[[\d:]+<(?P<left>[\d:]+|\?)")
"""A line of the model hub's progress bar."""

State = Literal["waiting", "running", "done", "failed", "cancelled"]


@dataclass(frozen=True, kw_only=True)
class Choice:
    """What a visitor chose, in the words of `freegeo run`."""

    model: str
    adapt: bool = True
    recipe: str = "scene"
    steps: int | None = None
    guard: str = "select"
    refine: str = "auto"
    max_views: int | None = None
    formats: tuple[str, ...] = DEFAULT_FORMATS
    skip_bad: bool = False

    def arguments(self) -> list[str]:
        """Return the options of the command; each value is joined to its name, so that none is taken for an option."""
        options = {
            "model": self.model, "refine": self.refine, "max-views": self.max_views, "formats": ",".join(self.formats),
        }  # fmt: skip
        if self.adapt:
            options |= {"recipe": self.recipe, "steps": self.steps, "guard": self.guard}
        switches = ["--no-adapt"] * (not self.adapt) + ["--skip-bad"] * self.skip_bad
        return [*(f"--{name}={value}" for name, value in options.items() if value not in (None, "")), *switches]


@dataclass(frozen=True, kw_only=True)
class Progress:
    """What a run is doing."""

    stage: str
    share: float | None = None
    """How much of the stage is done, from 0 to 1; None where it does not say."""
    seconds_left: int | None = None
    """Until the end of the stage, by what was done so far."""
    text: str = ""


@dataclass(kw_only=True, eq=False)
class Run:
    """One run, from the queue to its end."""

    folder: Path
    """Holds the photos and, in the end, the result."""
    inputs: tuple[object, ...]
    """What the result depends on; a run with the same inputs continues in the same folder."""
    command: list[str]
    token: str = field(default_factory=lambda: secrets.token_urlsafe(16))
    """Opens the result's pages and files; nobody else's page knows it."""
    state: State = "waiting"
    stages: list[str] = field(default_factory=list)
    """Those that are behind it."""
    progress: Progress = Progress(stage="starting")
    sentence: str | None = None
    """Why it failed, or what is missing in its result."""
    started: float = 0.0
    """By `time.monotonic`."""
    stopping: bool = False
    process: subprocess.Popen[str] | None = None

    @property
    def is_active(self) -> bool:
        """Whether it waits or computes."""
        return self.state in ("waiting", "running")

    @property
    def result(self) -> Path:
        """The output folder."""
        return self.folder / RESULT

    def without_folders(self, text: str) -> str:
        """Return a message with the names of photos and files as the visitor knows them."""
        for folder, name in ((self.folder / PHOTOS, "your photos"), (self.result, "the result")):
            text = text.replace(f"{folder}{os.sep}", "").replace(str(folder), name)
        return text

    def follow(self, line: str) -> None:
        """Take in a line that the command printed to stderr."""
        if (found := read_line(line)) is not None:
            title = self.progress.stage if found.title == "adapting" and self.progress.stage else found.title
            self.progress = Progress(
                stage=title, share=found.done / max(found.total, 1), seconds_left=found.seconds_left,
                text=", ".join([f"{found.done} of {found.total}", *([found.text] if found.text else [])]),
            )  # fmt: skip
        elif (download := _DOWNLOAD.match(line)) is not None:
            self._enter(f"download of {download['file'].strip()}")
            self.progress = Progress(
                stage=self.progress.stage, share=int(download["percent"]) / 100,
                seconds_left=_seconds(download["left"]), text=download["amount"].replace("/", " of "),
            )  # fmt: skip
        elif (stage := _STAGE.fullmatch(line)) is not None:
            self._enter(stage[1])
        elif line.startswith("freegeo: "):
            self.sentence = self.without_folders(line.removeprefix("freegeo: "))

    def _enter(self, stage: str) -> None:
        if stage != self.progress.stage:
            self.stages.append(self.progress.stage)
            self.progress = Progress(stage=stage)


def _seconds(clock: str) -> int | None:
    """Read 1:02:03."""
    seconds = 0
    for part in clock.split(":"):
        if not part.isdecimal():
            return None
        seconds = 60 * seconds + int(part)
    return seconds


class Queue:
    """Runs wait here, and one at a time computes."""

    def __init__(self):
        self._changed = threading.Condition()
        self._waiting: deque[Run] = deque()
        self._running: Run | None = None
        self._closed = False
        self._worker = threading.Thread(target=self._work, name="freegeo-queue", daemon=True)
        self._worker.start()

    def add(self, run: Run) -> None:
        """Let a run wait for its turn."""
        with self._changed:
            self._waiting.append(run)
            self._changed.notify_all()

    def before(self, run: Run) -> int:
        """How many runs come before a waiting one, the one that computes included."""
        with self._changed:
            return self._waiting.index(run) + (self._running is not None) if run in self._waiting else 0

    def cancel(self, run: Run, grace: float = GRACE_S) -> None:
        """End a run; one that computes is given `grace` seconds to save its state."""
        with self._changed:
            if run in self._waiting:
                self._waiting.remove(run)
                run.state = "cancelled"
            elif run.state == "running" and not run.stopping:
                run.stopping = True
                if run.process is not None:
                    _end(run.process, grace)

    def wait_for(self, run: Run, seconds: float) -> None:
        """Wait until a run is at its end, at most so long."""
        with self._changed:
            self._changed.wait_for(lambda: not run.is_active, timeout=seconds)

    def close(self, grace: float = GRACE_S) -> None:
        """End everything, as `cancel` does; returns when no process is left."""
        with self._changed:
            self._closed = True
            runs = [*self._waiting, *([self._running] if self._running else [])]
            self._changed.notify_all()
        for run in runs:
            self.cancel(run, grace)
        self._worker.join()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._waiting)
                if self._closed:
                    return
                run = self._running = self._waiting.popleft()
                run.state, run.started = "running", time.monotonic()
            try:
                state: State = self._compute(run)
            except OSError as error:
                logger.warning("a run could not be started: %s", error)
                run.sentence, state = f"the computation could not be started ({error.strerror}).", "failed"
            with self._changed:
                run.state, self._running, run.process = state, None, None
                self._changed.notify_all()

    def _compute(self, run: Run) -> State:
        # What the run puts aside, which may be parts of photos, is removed with it, also when it is killed.
        scratch = run.folder / SCRATCH
        scratch.mkdir(exist_ok=True)
        bound = bound_to_this_process()
        environment = {**bound["env"], LINES_VARIABLE: str(PROGRESS_LINES), **dict.fromkeys(TEMPORARY, str(scratch))}
        with self._changed:
            if run.stopping:
                return "cancelled"
            process = run.process = subprocess.Popen(
                run.command, stdin=bound["stdin"], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
                encoding="utf-8", errors="replace", env=environment, start_new_session=True,
            )  # fmt: skip
        last: deque[str] = deque(maxlen=_LAST_LINES)
        assert process.stderr is not None
        # Lines end in \r too, as those of progress bars do.
        for line in process.stderr:
            last.append(line)
            run.follow(line.strip())
        code = process.wait()
        _kill(process)
        assert process.stdin is not None
        process.stdin.close()
        shutil.rmtree(scratch, ignore_errors=True)
        if run.stopping:
            return "cancelled"
        if code in DONE_CODES:
            return "done"
        if run.sentence is None:
            logger.warning("a run ended with code %d and without a sentence:\n%s", code, "".join(last).rstrip())
            run.sentence = _unexpected(code)
        return "failed"


def _end(process: subprocess.Popen[str], grace: float) -> None:
    """Ask a run to save its state and end; it is killed when it does not."""
    # Not SIGINT, which a server that was started in the background hands down as ignored.
    process.terminate()
    timer = threading.Timer(grace, lambda: process.poll() is None and _kill(process))
    timer.daemon = True
    timer.start()


def _kill(process: subprocess.Popen[str]) -> None:
    """Kill a run, and whatever it started that is still there."""
    if os.name == "nt":
        process.kill()
        return
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)


def _unexpected(code: int) -> str:
    if code == -signal.SIGKILL:
        return (
            "the computation was killed, most likely because the memory of this machine does not suffice. Use fewer "
            "photos or a smaller model."
        )
    return "the computation ended unexpectedly. The terminal in which the app runs says more."


def command(source: Path, result: Path, choice: Choice, options: Sequence[str] = ()) -> list[str]:
    """Return the command line of a run; `options` are those of the server, for every run."""
    return [
        sys.executable, "-P", "-m", "freegeo.cli.app", "run", str(source), f"--output={result}", *choice.arguments(),
        *options,
    ]  # fmt: skip
