"""Output folders of commands: locked while one writes, continued after a stop, never mixed.

A command's output folder goes through three states: absent, unfinished (its settings are stored, its parts appear one
by one) and finished (the marker names when). Only the standard library is used here.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from freegeo.errors import FreeGeoError, UserError
from freegeo.files import FORMAT, LEDGER_FILE, LOCK_FILE, OWN_FILES, RUN_FILE, as_json, read_json, write_json

_SHOWN = 4
_PART = re.compile(r"\..+\.[0-9a-f]{8}\.part(\..*)?")


@contextmanager
def locked(folder: Path) -> Generator[None]:
    """Lock a folder against other processes; the system releases the lock when the process ends.

    UserError when the folder cannot be made or written to, or when another process holds it.
    """
    lock = folder / LOCK_FILE
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = lock.open("a+b")
    except OSError as error:
        raise UserError(
            f"{folder}: the output folder cannot be written to ({error.strerror}). Choose another one."
        ) from None
    with handle:
        # The previous holder may have removed the file between open and lock; such a lock would protect nothing.
        if not _try_lock(handle) or not _is_same_file(handle, lock):
            raise UserError(f"{folder}: another freegeo process is writing here. Wait for it or choose another folder.")
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)


def _is_same_file(handle, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle.fileno()), path.stat())
    except FileNotFoundError:
        return False


def _try_lock(handle) -> bool:
    try:
        if os.name == "nt":
            import msvcrt

            msvcrt.locking(handle.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


@dataclass(frozen=True)
class RunFolder:
    """One command's output folder, locked while the command runs."""

    path: Path
    settings: Mapping[str, Any]
    finished_at: str | None

    @property
    def finished(self) -> bool:
        """Whether an earlier run with the same settings completed."""
        return self.finished_at is not None

    def __truediv__(self, name: str) -> Path:
        """Return the path of a file in the folder."""
        return self.path / name

    def finish(self) -> None:
        """Mark the result as complete."""
        write_json(self.path / RUN_FILE, _state(self.settings, datetime.now(UTC).isoformat(timespec="seconds")))


@contextmanager
def run_folder(path: Path, settings: Mapping[str, Any], *, overwrite: bool = False) -> Generator[RunFolder]:
    """Open an output folder for a command with JSON-like settings.

    Absent or empty: a run is started. Unfinished with the same settings: it continues. Finished with the same settings:
    `finished` is true and the caller must not write. Other settings, or a folder that freegeo did not write: UserError.
    `overwrite` removes what earlier runs wrote, and nothing else; a folder that freegeo did not write is still refused.
    When the block raises UserError before it wrote a file, the settings file and a new folder are removed again.
    """
    settings = as_json(settings)
    check_folder(path, settings, overwrite=overwrite)
    is_new = not path.exists()
    try:
        with locked(path):
            finished_at = _open(path, settings, overwrite)
            try:
                yield RunFolder(path, settings, finished_at)
            except UserError:
                if not _ledger(path):
                    (path / RUN_FILE).unlink(missing_ok=True)
                raise
    finally:
        if is_new and path.is_dir() and not any(path.iterdir()):
            path.rmdir()


def _open(path: Path, settings: Mapping[str, Any], overwrite: bool) -> str | None:
    """Start or continue the run of a locked folder; returns when it was finished."""
    # The state is read again under the lock: another process may have changed it since the check.
    check_folder(path, settings, overwrite=overwrite)
    before = stored_state(path)
    if before is not None and overwrite:
        clear(path)
        before = None
    if before is None:
        write_json(path / RUN_FILE, _state(settings, None))
        return None
    if not before["finished"]:
        _remove_parts(path)
    return before["finished"]


def check_folder(path: Path, settings: Mapping[str, Any], *, overwrite: bool) -> None:
    """Raise UserError when `run_folder` would refuse; cheap, so that commands can check before they load anything."""
    settings = as_json(settings)
    if path.exists() and not path.is_dir():
        raise UserError(f"{path}: is a file. Choose a folder for the output.")
    before = stored_state(path)
    if before is None:
        if path.is_dir() and any(p.name not in OWN_FILES for p in path.iterdir()):
            raise UserError(f"{path}: holds files that freegeo did not write. Choose an empty or a new folder.")
        _require_writable(path)
        return
    if before["format"] > FORMAT:
        raise UserError(f"{path}: written by a newer freegeo (format {before['format']}). Update freegeo.")
    if before["settings"] != settings and not overwrite:
        state = "a finished result" if before["finished"] else "an unfinished run"
        raise UserError(
            f"{path}: holds {state} with other options ({difference(before['settings'], settings)}). "
            "Add --overwrite to replace it, or choose another folder."
        )
    _require_writable(path)


def stored_state(path: Path) -> dict[str, Any] | None:
    """Return format, settings and finishing time of the run in a folder; None when there is none."""
    file = path / RUN_FILE
    if not file.is_file():
        return None
    state = read_json(file)
    if not isinstance(state, dict) or not {"format", "settings", "finished"} <= set(state):
        raise FreeGeoError(f"{file}: not the state of a run. Choose another output folder.")
    return state


def clear(path: Path) -> None:
    """Remove what earlier runs wrote into a folder, and nothing that anybody else put there."""
    state = stored_state(path)
    if state is not None:
        # If the removal is interrupted, the remaining files must not count as a finished result.
        write_json(path / RUN_FILE, {**state, "finished": None})
    files = [path / name for name in _ledger(path)]
    for file in files:
        if file.is_symlink() or file.is_file():
            file.unlink()
    _remove_parts(path)
    inner = {folder for file in files for folder in file.parents if path in folder.parents}
    for folder in sorted(inner, key=lambda f: len(f.parts), reverse=True):
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
    (path / LEDGER_FILE).unlink(missing_ok=True)


def difference(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Name the settings that differ, dotted where they are nested, with both values; empty when none does.

    At most four are named, for the rest their number is given. Both are as read from JSON (`freegeo.files.as_json`).
    """
    parts = list(_differences(before, now))
    more = len(parts) - _SHOWN
    return "; ".join(parts[:_SHOWN]) + (f"; and {more} more" if more > 0 else "")


def _ledger(path: Path) -> list[str]:
    """Names of the files that freegeo wrote below a folder, each once."""
    file = path / LEDGER_FILE
    lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
    return [name for name in dict.fromkeys(lines) if ".." not in Path(name).parts and not Path(name).is_absolute()]


def _remove_parts(path: Path) -> None:
    """Remove the half-written files of a process that was killed."""
    for folder in {path, *((path / name).parent for name in _ledger(path))}:
        for file in folder.glob(".*.part*"):
            if _PART.fullmatch(file.name):
                file.unlink()


def _state(settings: Mapping[str, Any], finished: str | None) -> dict[str, Any]:
    return {"format": FORMAT, "settings": settings, "finished": finished}


def _require_writable(path: Path) -> None:
    existing = next(parent for parent in (path, *path.absolute().parents) if parent.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        raise UserError(f"{path}: the output folder cannot be written to. Choose another one.")


def _differences(before: Mapping[str, Any], now: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for name in sorted(set(before) | set(now)):
        old, new = before.get(name), now.get(name)
        if isinstance(old, dict) and isinstance(new, dict):
            yield from _differences(old, new, f"{prefix}{name}.")
        elif old != new:
            yield f"{prefix}{name}: {_short(old)} there, {_short(new)} now"


def _short(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, dict):
        return f"'{value['name']}'" if "name" in value else "given"
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."
