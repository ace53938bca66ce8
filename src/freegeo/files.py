"""Atomic writes of files, and the ledger of what was written below a run's folder.

A ledger in an output folder lists what freegeo wrote there, so that replacing a result never touches a file that
somebody put beside it. Only the standard library is used here.
"""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from freegeo.errors import FreeGeoError, UserError

FORMAT = 1
"""Version of the files that freegeo writes."""
RUN_FILE = ".freegeo-run.json"
LOCK_FILE = ".freegeo-lock"
LEDGER_FILE = ".freegeo-files"
OWN_FILES = frozenset({RUN_FILE, LOCK_FILE, LEDGER_FILE})


@contextmanager
def atomic_path(path: Path) -> Generator[Path]:
    """Give a temporary path beside `path` to write to; it takes the final name only when the block succeeds.

    The temporary name keeps the suffix, since writers choose the format by it. UserError when the folder cannot be
    written to; an OSError while writing, such as a full disk, names the final path.
    """
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        _flush(temporary)
        _enter_in_ledger(path)
        temporary.replace(path)
    except PermissionError:
        raise UserError(f"{path.parent}: the folder cannot be written to. Choose another output folder.") from None
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())
    # Some writers create files that only the owner can read; results get the permissions of the user's umask.
    mask = os.umask(0)
    os.umask(mask)
    path.chmod(0o666 & ~mask)


def _enter_in_ledger(path: Path) -> None:
    """Add a file to the ledger of the run folder that it is in, if it is in one."""
    path = path.absolute()
    owner = next((folder for folder in path.parents if (folder / RUN_FILE).is_file()), None)
    if owner is not None and path.name not in OWN_FILES:
        with (owner / LEDGER_FILE).open("a", encoding="utf-8") as file:
            file.write(path.relative_to(owner).as_posix() + "\n")


def as_json(value: Any) -> Any:
    """Return a value as it would be read back from a JSON file: tuples become lists, keys text."""
    return json.loads(json.dumps(value))


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
