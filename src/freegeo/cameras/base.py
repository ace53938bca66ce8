"""What a file of cameras says, before it is brought to photos, and what a format is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from freegeo.cameras.known import Lens
from freegeo.errors import UserError
from freegeo.files import json_value

if TYPE_CHECKING:
    from freegeo.cameras.known import KnownCameras

__all__ = [
    "CameraFile",
    "FileCamera",
    "Format",
    "find_frames",
    "matrix_of_numbers",
    "read_frames",
    "read_json_object",
    "read_text",
]

BelongBy = Literal["name", "time", "order"]
"""How the cameras of a file find their photos."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FileCamera:
    """One camera as a file says it, not checked yet."""

    name: str
    """Name of the photo, a time stamp, or the place in the file, as `CameraFile.by` says."""
    matrix: np.ndarray | None = None
    """(4, 4) float64 as in the file."""
    K: np.ndarray | None = None
    """(3, 3) float64, pixels counted from the corner."""
    angle_x: float | None = None
    """Horizontal field of view in radians, where the file says it in place of `K`, and no size."""
    lens: Lens | None = None
    size_hw: tuple[int, int] | None = None
    """Height and width of the image that `K` is of."""
    ids: tuple[int, int] | None = None
    """COLMAP's numbers of the image and of its camera."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraFile:
    """The content of a file or folder of cameras."""

    source: str
    cameras: Sequence[FileCamera]
    by: BelongBy = "name"
    metric: bool = False
    upright: bool = False
    """Whether the format says that sizes and poses are those of upright photos."""


@dataclass(frozen=True, kw_only=True)
class Format:
    """One format of camera files."""

    name: str
    about: str
    reading: str
    """How its matrices are meant; a key of `freegeo.cameras.convention.READINGS`."""
    find: Callable[[Path], Path | None]
    """Return what `read` takes when a file or folder is of this format, judged by content, else None."""
    read: Callable[[Path], CameraFile]
    write: Callable[[KnownCameras, Path], None] | None = None


def read_text(path: Path) -> str:
    """Return the text of a file; UserError when it cannot be read, is no text, or is empty."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}. Check the name of the camera file.") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: not a text file. See --cameras-format for what can be read.") from None
    if not text.strip():
        raise UserError(f"{path}: the file is empty.")
    return text


def matrix_of_numbers(values: Any, shapes: Sequence[tuple[int, int]], what: str) -> np.ndarray:
    """Return nested lists as a matrix (float64) of one of the shapes; UserError naming `what` otherwise."""
    try:
        matrix = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape not in shapes:
        wanted = " or ".join(f"{rows} x {columns}" for rows, columns in shapes)
        raise UserError(f"{what} is not a matrix of {wanted} numbers.")
    if matrix.shape == (3, 4):
        matrix = np.concatenate((matrix, [[0.0, 0.0, 0.0, 1.0]]))
    return matrix


def find_frames(path: Path, name: str, is_own: Callable[[Any], bool]) -> Path | None:
    """Return a JSON file, or the one called `name` in a folder, when its `frames` are those of a format; else None."""
    file = path / name if path.is_dir() else path
    if file.suffix.lower() != ".json" or not file.is_file():
        return None
    try:
        return file if is_own(json_value(file.read_text(encoding="utf-8-sig"))["frames"]) else None
    except (ValueError, KeyError, TypeError, OSError, RecursionError):
        return None


def read_json_object(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file; UserError when it is broken, or something else."""
    text = read_text(path)
    try:
        content = json_value(text)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: broken JSON ({error}).") from None
    if not isinstance(content, dict):
        raise UserError(f"{path}: holds no JSON object.")
    return content


def read_frames(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the object in a JSON file and its list of frames; UserError when it is broken, or has none."""
    content = read_json_object(path)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise UserError(f"{path}: has no list of frames.")
    return content, frames
