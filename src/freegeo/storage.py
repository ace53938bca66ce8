"""Writing so that nothing is lost: files appear whole or not at all, folders are locked, runs continue.

A command's output folder goes through three states: absent, unfinished (its settings are stored, its parts appear one
by one) and finished (the marker names when). Only the standard library is used here.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from freegeo.errors import FreeGeoError, UserError

FORMAT = 1
STATE_FILE = ".freegeo-run.json"
LOCK_FILE = ".freegeo-lock"


@contextmanager
def atomic_path(path: Path) -> Generator[Path]:
    """Give a temporary path beside `path` to write to; it takes the final name only when the block succeeds.

    The temporary name keeps the suffix, since writers choose the format by it. UserError when the folder cannot be
    written to.
    """
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        _flush(temporary)
        temporary.replace(path)
    except PermissionError:
        raise UserError(f"{path.parent}: the folder cannot be written to. Choose another output folder.") from None
    finally:
        temporary.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())
    # Some writers create private files; a result is as readable as any other file of the user.
    mask = os.umask(0)
    os.umask(mask)
    path.chmod(0o666 & ~mask)


def write_json(path: Path, value: Any) -> None:
    """Write indented JSON atomically."""
    with atomic_path(path) as part:
        part.write_text(json.dumps(value, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """Read JSON; FreeGeoError when the file is damaged."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise FreeGeoError(f"{path}: damaged file ({error}). Remove it and run again.") from None


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write compressed NumPy arrays atomically."""
    import numpy as np

    with atomic_path(path) as part:
        np.savez_compressed(part, **arrays)


def write_tensors(path: Path, tensors: Mapping[str, Any], metadata: Mapping[str, str] | None = None) -> None:
    """Write tensors as safetensors atomically."""
    from safetensors.torch import save_file

    with atomic_path(path) as part:
        contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
        save_file(contiguous, part, metadata=dict(metadata or {}))


@contextmanager
def locked(folder: Path) -> Generator[None]:
    """Hold a folder against other processes; the lock goes with the process, however it ends."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = (folder / LOCK_FILE).open("a+b")
    except (PermissionError, NotADirectoryError, FileExistsError, OSError) as error:
        raise UserError(
            f"{folder}: the output folder cannot be written to ({error.strerror}). Choose another one."
        ) from None
    with handle:
        if not _try_lock(handle):
            raise UserError(f"{folder}: another freegeo process is writing here. Wait for it or choose another folder.")
        try:
            yield
        finally:
            (folder / LOCK_FILE).unlink(missing_ok=True)


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
        write_json(self.path / STATE_FILE, _state(self.settings, datetime.now(UTC).isoformat(timespec="seconds")))


@contextmanager
def run_folder(path: Path, settings: Mapping[str, Any], *, overwrite: bool = False) -> Generator[RunFolder]:
    """Open an output folder for a command with JSON-like settings.

    Absent or empty: it is started. Unfinished with the same settings: it goes on. Finished with the same settings:
    `finished` is true and the caller leaves it alone. Other settings, or a folder that freegeo did not write:
    UserError, unless `overwrite`, which removes what an earlier run wrote (a foreign folder is never removed).
    """
    settings = json.loads(json.dumps(settings))
    check_folder(path, settings, overwrite=overwrite)
    with locked(path):
        before = stored_state(path)
        if before is not None and (overwrite or before["settings"] != settings):
            clear(path)
            before = None
        if before is None:
            write_json(path / STATE_FILE, _state(settings, None))
        yield RunFolder(path, settings, before["finished"] if before else None)


def check_folder(path: Path, settings: Mapping[str, Any], *, overwrite: bool) -> None:
    """Raise UserError when `run_folder` would refuse; cheap, so that commands can ask before they load anything."""
    settings = json.loads(json.dumps(settings))
    if path.exists() and not path.is_dir():
        raise UserError(f"{path}: is a file. Choose a folder for the output.")
    before = stored_state(path)
    if before is None:
        if path.is_dir() and any(p.name != LOCK_FILE for p in path.iterdir()):
            raise UserError(f"{path}: holds files that freegeo did not write. Choose an empty or a new folder.")
        _require_writable(path)
        return
    if before["format"] > FORMAT:
        raise UserError(f"{path}: written by a newer freegeo (format {before['format']}). Update freegeo.")
    if before["settings"] != settings and not overwrite:
        state = "a finished result" if before["finished"] else "an unfinished run"
        raise UserError(
            f"{path}: holds {state} with other options ({_difference(before['settings'], settings)}). "
            "Add --overwrite to replace it, or choose another folder."
        )
    _require_writable(path)


def stored_state(path: Path) -> dict[str, Any] | None:
    """Return format, settings and finishing time of the run a folder holds; None when it holds none."""
    file = path / STATE_FILE
    return read_json(file) if file.is_file() else None


def clear(path: Path) -> None:
    """Remove an earlier run's files from a folder that freegeo wrote."""
    for item in path.iterdir():
        if item.name == LOCK_FILE:
            continue
        shutil.rmtree(item) if item.is_dir() and not item.is_symlink() else item.unlink()


def _state(settings: Mapping[str, Any], finished: str | None) -> dict[str, Any]:
    return {"format": FORMAT, "settings": settings, "finished": finished}


def _require_writable(path: Path) -> None:
    existing = next(parent for parent in (path, *path.absolute().parents) if parent.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        raise UserError(f"{path}: the output folder cannot be written to. Choose another one.")


def _difference(before: Mapping[str, Any], now: Mapping[str, Any], prefix: str = "") -> str:
    parts = []
    for name in sorted(set(before) | set(now)):
        old, new = before.get(name), now.get(name)
        if old == new:
            continue
        if isinstance(old, dict) and isinstance(new, dict):
            parts.append(_difference(old, new, f"{prefix}{name}."))
        else:
            parts.append(f"{prefix}{name}: {_short(old)} there, {_short(new)} now")
    return "; ".join(parts)


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
