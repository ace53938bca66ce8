"""The lock of an output folder: one process at a time writes there, and notices when the folder is taken from it.

Every write and removal asks `require_lock` first. A folder that was deleted or replaced meanwhile, and perhaps belongs
to another process by now, gets nothing more. Only the standard library is used here.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from freegeo.errors import FreeGeoError, LostFolderError, UserError

LOCK_FILE = ".freegeo-lock"


@dataclass(frozen=True, eq=False)
class Lock:
    """A folder that this process has locked."""

    folder: Path
    handle: BinaryIO
    """The open lock file."""
    written: set[Path] = field(default_factory=set)
    """Files below the folder that this process wrote since, and did not remove; without links in their folders."""

    def is_held(self) -> bool:
        """Whether the lock file in the folder is still the one that was locked."""
        try:
            return os.path.samestat(os.fstat(self.handle.fileno()), (self.folder / LOCK_FILE).stat())
        except OSError:
            return False

    def require(self) -> None:
        """Raise LostFolderError when the folder is no longer that which was locked."""
        if not self.is_held():
            raise lost(self.folder, "the folder, or its lock file, was removed or replaced")


_held: dict[Path, Lock] = {}
"""The locks of this process by their folders, as they were named and without links."""


@contextmanager
def locked(folder: Path) -> Generator[Lock]:
    """Lock a folder against other processes; the system releases the lock when the process ends.

    A folder that is made here and stays empty is removed again. UserError when the folder cannot be made or written
    to, or when another process holds it; LostFolderError in place of whatever fails because the folder is gone.
    """
    file = folder / LOCK_FILE
    is_new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        require_no_link(file)
        handle = file.open("a+b")
    except OSError as error:
        raise UserError(
            f"{folder}: the output folder cannot be written to ({error.strerror}). Choose another one."
        ) from None
    with handle:
        lock = Lock(folder, handle)
        # The previous holder may have removed the file between open and lock; such a lock would protect nothing.
        if not _try_lock(lock) or not lock.is_held():
            raise UserError(f"{folder}: another freegeo process is writing here. Wait for it or choose another folder.")
        names = (folder.absolute(), folder.resolve())
        _held.update(dict.fromkeys(names, lock))
        try:
            yield lock
        except (FreeGeoError, OSError):
            lock.require()
            raise
        finally:
            for name in names:
                _held.pop(name, None)
            if lock.is_held():
                file.unlink(missing_ok=True)
                if is_new and not any(folder.iterdir()):
                    folder.rmdir()


@contextmanager
def kept_still(folder: Path | None) -> Generator[None]:
    """Keep other processes from changing a result while it is read, where its folder can be locked at all.

    A folder that may only be read, or None, is left alone. UserError when another process is writing there.
    """
    if folder is None or not os.access(folder, os.W_OK):
        yield
        return
    with locked(folder):
        yield


@contextmanager
def hold_shared(folder: Path, *, when_alone: Callable[[], object]) -> Generator[None]:
    """Hold a folder together with other processes; the first to come calls `when_alone` before others can hold it.

    The folder itself is locked, so that no file is made. It is not where the system cannot do that, and `when_alone` is
    not called there. A folder that cannot be made is left to who writes into it.
    """
    with ExitStack() as stack:
        with suppress(OSError, ImportError):
            import fcntl

            folder.mkdir(parents=True, exist_ok=True)
            handle = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, handle)
            with suppress(BlockingIOError):
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                when_alone()
            fcntl.flock(handle, fcntl.LOCK_SH)
        yield


def _try_lock(lock: Lock) -> bool:
    try:
        if os.name == "nt":
            import msvcrt

            msvcrt.locking(lock.handle.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(lock.handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EAGAIN, errno.EWOULDBLOCK, errno.EDEADLK):
            return False
        raise UserError(
            f"{lock.folder}: its file system cannot lock files ({error.strerror}), so two processes could mix their "
            "results there. Choose a folder on another disk."
        ) from None
    return True


def require_lock(path: Path) -> None:
    """Raise LostFolderError when a path is in a folder that this process had locked and that is no longer there."""
    for lock in _locks_around(path):
        lock.require()


def note_written(path: Path) -> None:
    """Note that this process wrote a file, in the locks of the folders that it is in."""
    for lock in _locks_around(path):
        lock.written.add(path.parent.resolve() / path.name)


def note_removed(path: Path) -> None:
    """Note that this process removed a file that it may have written."""
    for lock in _locks_around(path):
        lock.written.discard(path.parent.resolve() / path.name)


def _locks_around(path: Path) -> set[Lock]:
    if not _held:
        return set()
    places = {*path.absolute().parents, *(path.parent.resolve() / path.name).parents}
    return {_held[place] for place in places if place in _held}


def lost(folder: Path, what: str) -> LostFolderError:
    """Return the error that ends a run whose folder was changed behind its back."""
    return LostFolderError(
        f"{folder}: {what} while freegeo was writing there. The result is not complete; run the command again."
    )


def require_no_link(path: Path) -> None:
    """Raise UserError when one of freegeo's own files is a symbolic link, through which it would write elsewhere."""
    if path.is_symlink():
        raise UserError(f"{path}: is a symbolic link, and freegeo did not make it. Remove it.")
