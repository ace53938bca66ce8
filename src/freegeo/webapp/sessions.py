"""Who is at the app: every open page has uploads and a run of its own, in folders that are removed after it."""

from __future__ import annotations

import logging
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from freegeo.data.photos import natural_key
from freegeo.data.video import is_video
from freegeo.errors import UserError
from freegeo.host import GRACE_S
from freegeo.lock import locked
from freegeo.webapp.runs import PHOTOS, RESULT, ZIPS, Choice, Queue, Run, command

logger = logging.getLogger(__name__)

PREFIX = "freegeo-app-"
UPLOADS = "uploads"
AWAY_S = 1800.0
"""How long a closed page may stay away before its run is ended and its files are removed."""
IDLE_S = 24 * 3600.0
"""How long the files of an open page are kept after it was last used."""
SWEEP_S = 30.0


@dataclass(kw_only=True, eq=False)
class Session:
    """One open page."""

    uploads: list[Path] = field(default_factory=list)
    """Files that were dropped into the page, in the order of the page."""
    run: Run | None = None
    seen: float = 0.0
    """When it was last heard of, by `time.monotonic`."""
    closed: float | None = None
    """Since when it is closed."""
    shown: str = ""
    """What the page's panel shows at present."""


class Sessions:
    """All open pages, their folders, and the queue that they share."""

    def __init__(self, *, keep: Path | None = None, options: Sequence[str] = ()):
        """Make the app's folder.

        Args:
            keep: folder in which photos and results stay; None: they are removed.
            options: of `freegeo run`, for every run.

        Raises:
            UserError: a folder that cannot be made.
        """
        self.keep, self.options = keep, options
        try:
            if keep is not None:
                keep.mkdir(parents=True, exist_ok=True)
            self.folder = Path(tempfile.mkdtemp(prefix=PREFIX))
        except OSError as error:
            raise UserError(f"{error.filename}: {error.strerror}. Choose another folder.") from None
        # By the lock, which ends with this process, later apps see that the folder is in use.
        self._lock = ExitStack()
        self._lock.enter_context(locked(self.folder))
        _remove_leftovers(self.folder)
        self.uploads = self.folder / UPLOADS
        self.uploads.mkdir()
        self.queue = Queue()
        self._open: dict[str, Session] = {}
        self._guard = threading.RLock()
        self._ended = threading.Event()
        threading.Thread(target=self._keep_sweeping, name="freegeo-sweeper", daemon=True).start()

    def session(self, key: str) -> Session:
        """Return the session of a page by its key, which counts as heard of now."""
        with self._guard:
            found = self._open.setdefault(key, Session())
            found.seen, found.closed = time.monotonic(), None
            return found

    def leave(self, key: str) -> None:
        """Note that a page was closed."""
        with self._guard:
            if key in self._open:
                self._open[key].closed = time.monotonic()

    def find_again(self, session: Session, token: str) -> None:
        """Give a page the run that a token opens, as after a reload; it is that page's alone from then on."""
        with self._guard:
            for other in self._open.values():
                if other is not session and other.run is not None and other.run.token == token:
                    session.run, other.run = other.run, None
                    return

    def finished(self, token: str) -> Run | None:
        """Return the finished run that a token opens."""
        with self._guard:
            runs = [session.run for session in self._open.values()]
        return next((run for run in runs if run is not None and run.token == token and run.state == "done"), None)

    def start(self, session: Session, choice: Choice) -> Run:
        """Queue a run of a page's uploads; with the same inputs as before it continues where that ended.

        UserError when there is nothing to reconstruct, when the page's run has not ended, or when the disk is full.
        """
        with self._guard:
            before = session.run
            if before is not None and before.is_active:
                raise UserError("a reconstruction of yours is under way. Cancel it first.")
            sources = _sources(session.uploads)
            inputs = (tuple(sources), choice)
            if before is not None and before.inputs == inputs and before.folder.is_dir():
                folder = before.folder
                # The result may become another one: what was missing may be there now.
                for made in folder.glob(f"{ZIPS}*.zip"):
                    made.unlink()
            else:
                self._remove(before)
                session.run = None
                folder = self._new_folder(sources)
            names = list((folder / PHOTOS).iterdir())
            source = names[0] if len(names) == 1 and is_video(names[0]) else folder / PHOTOS
            session.run = Run(
                folder=folder, inputs=inputs, command=command(source, folder / RESULT, choice, self.options)
            )
            self.queue.add(session.run)
            return session.run

    def sweep(self, now: float) -> None:
        """End the sessions that were away too long, and remove what belongs to none."""
        with self._guard:
            over = [
                key for key, session in self._open.items()
                if (session.closed is not None and now - session.closed > AWAY_S)
                or (now - session.seen > IDLE_S and not (session.run and session.run.is_active))
            ]  # fmt: skip
            gone = [self._open.pop(key) for key in over]
            wanted = {path for session in self._open.values() for path in session.uploads}
        for session in gone:
            self._remove(session.run)
        for path in list(self.uploads.rglob("*")):
            # A file may be new and not yet known to its page.
            with suppress(OSError):
                if path.is_file() and path not in wanted and time.time() - path.stat().st_mtime > AWAY_S:
                    path.unlink()

    def close(self) -> None:
        """End all runs and remove the app's folder."""
        self._ended.set()
        self.queue.close(0.0 if self.keep is None else GRACE_S)
        shutil.rmtree(self.folder, ignore_errors=True)
        self._lock.close()

    def _keep_sweeping(self) -> None:
        while not self._ended.wait(SWEEP_S):
            self.sweep(time.monotonic())

    def _new_folder(self, sources: Sequence[Path]) -> Path:
        """Make the folder of a run, with its photos."""
        prefix = "run-" if self.keep is None else f"{datetime.now():%Y-%m-%d-%H%M%S}-"
        folder = None
        try:
            folder = Path(tempfile.mkdtemp(prefix=prefix, dir=self.keep or self.folder))
            _take(sources, folder / PHOTOS)
        except OSError as error:
            if folder is not None:
                shutil.rmtree(folder, ignore_errors=True)
            raise UserError(
                f"the photos cannot be stored on the machine that runs this page ({error.strerror})."
            ) from None
        return folder

    def _remove(self, run: Run | None) -> None:
        """End a run and remove its folder, unless results are kept."""
        if run is None:
            return
        if run.is_active:
            self.queue.cancel(run)
            self.queue.wait_for(run, seconds=60)
        if self.keep is None:
            shutil.rmtree(run.folder, ignore_errors=True)


def _sources(uploads: Sequence[Path]) -> list[Path]:
    """Return the uploads that make one scene, in natural order of their names."""
    if not uploads:
        raise UserError("no photos yet. Drop photos of one place, or one video, into the box first.")
    if not all(path.is_file() for path in uploads):
        raise UserError("the photos were removed after a long time without use. Remove them from the box and add them.")
    if len(uploads) > 1 and any(map(is_video, uploads)):
        raise UserError("give photos, or one video alone.")
    return sorted(uploads, key=lambda path: natural_key(Path(path.name)))


def _take(sources: Sequence[Path], folder: Path) -> None:
    """Put uploads into a run's folder, under names that differ; no second copy where the file system can link."""
    folder.mkdir()
    for source, name in zip(sources, _different([source.name for source in sources]), strict=True):
        try:
            os.link(source, folder / name)
        except OSError:
            shutil.copyfile(source, folder / name)


def _different(names: Sequence[str]) -> Iterator[str]:
    """Give names that differ also where capitals make no difference; none is hidden."""
    used: set[str] = set()
    for name in names:
        path = Path(name.lstrip(".") or "photo")
        new, number = path.name, 2
        while new.lower() in used:
            new, number = f"{path.stem}-{number}{path.suffix}", number + 1
        used.add(new.lower())
        yield new


def _remove_leftovers(own: Path) -> None:
    """Remove the folders of apps of the same user that were killed."""
    for folder in own.parent.glob(f"{PREFIX}*"):
        with suppress(OSError, UserError):
            if folder != own and not folder.is_symlink() and folder.stat().st_uid == own.stat().st_uid:
                with locked(folder):
                    shutil.rmtree(folder, ignore_errors=True)
                logger.info("%s: removed; it was left by an app that was killed.", folder)
