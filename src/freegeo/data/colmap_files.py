"""Reading the cameras and poses of a COLMAP model, text or binary, without pycolmap."""

import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from freegeo.errors import FreeGeoError, UserError, in_short
from freegeo.geometry.rotation import quat_wxyz_to_xyzw, quat_xyzw_to_matrix

_MODELS = (  # name and number of parameters, at the position that is COLMAP's number of the model
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
)
_TWO_FOCAL_LENGTHS = frozenset(
    {"PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"}
)
_CAMERA_BYTES, _IMAGE_BYTES, _POINT_BYTES = 48, 73, 24
"""Fewest bytes of a camera, and of an image without a name and points; bytes of a point of an image."""


@dataclass(frozen=True)
class ColmapCamera:
    """One camera as stored; the parameters begin with fx, fy, cx, cy when `has_pinhole`."""

    number: int
    model: str
    size_hw: tuple[int, int]
    params: tuple[float, ...]

    @property
    def has_pinhole(self) -> bool:
        """Whether the first four parameters are fx, fy, cx, cy."""
        return self.model in _TWO_FOCAL_LENGTHS and len(self.params) >= 4

    @property
    def K(self) -> np.ndarray:
        """Pinhole part (3, 3) float64; principal point as stored (COLMAP counts from the corner of the first pixel)."""
        if not self.has_pinhole:
            raise FreeGeoError(f"Camera {self.number} has the model {self.model}, which has no fx, fy, cx, cy.")
        fx, fy, cx, cy = self.params[:4]
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class ColmapImage:
    """One registered image."""

    name: str
    camera: int
    T_cam_world: np.ndarray
    """(4, 4) float64."""
    number: int


def read_cameras(folder: Path) -> dict[int, ColmapCamera]:
    """Cameras by number from `cameras.bin`, or `cameras.txt` when there is none.

    Raises:
        UserError: neither file exists. FreeGeoError: the file is damaged.
    """
    path = _model_file(folder, "cameras")
    cameras = _parse(path, _binary_cameras if path.suffix == ".bin" else _text_cameras)
    return {camera.number: camera for camera in cameras}


def read_images(folder: Path) -> list[ColmapImage]:
    """Images in file order from `images.bin`, or `images.txt` when there is none; errors as `read_cameras`."""
    path = _model_file(folder, "images")
    return _parse(path, _binary_images if path.suffix == ".bin" else _text_images)


def _model_file(folder: Path, name: str) -> Path:
    for suffix in (".bin", ".txt"):
        if (path := folder / f"{name}{suffix}").is_file():
            return path
    raise UserError(f"{folder} holds neither {name}.bin nor {name}.txt.")


def _parse(path: Path, reader):
    try:
        return reader(path)
    except (struct.error, ValueError, IndexError, KeyError) as error:
        raise FreeGeoError(f"{path} is not a readable COLMAP file ({in_short(error)}).") from error


def _text_cameras(path: Path) -> list[ColmapCamera]:
    cameras = []
    for line in path.read_text(encoding="utf-8").splitlines():
        tokens = line.split()
        if tokens and not line.startswith("#"):
            number, model, width, height, *params = tokens
            _require_model(model, len(params))
            cameras.append(ColmapCamera(int(number), model, (int(height), int(width)), tuple(map(float, params))))
    return cameras


def _require_model(model: str, count: int) -> None:
    expected = dict(_MODELS).get(model)
    if expected is None:
        raise ValueError(f"unknown camera model {model}")
    if count != expected:
        raise ValueError(f"a camera of the model {model} has {expected} parameters, not {count}")


def _text_images(path: Path) -> list[ColmapImage]:
    lines = path.read_text(encoding="utf-8").splitlines()
    header = next((number for number, line in enumerate(lines) if not line.startswith("#")), len(lines))
    images = []
    # By position: the points line of an image may be empty, and the last one may be missing.
    for place, line in enumerate(lines[header::2]):
        tokens = line.split(maxsplit=9)
        if tokens:
            points = lines[header + 2 * place + 1].split() if header + 2 * place + 1 < len(lines) else []
            if len(points) % 3 or not all(map(_is_number, points[:3])):
                raise ValueError(f"the line after image {tokens[9]} is not one of its points")
            quat_wxyz, translation = [float(t) for t in tokens[1:5]], [float(t) for t in tokens[5:8]]
            images.append(ColmapImage(tokens[9], int(tokens[8]), _pose(quat_wxyz, translation), int(tokens[0])))
    return images


def _is_number(token: str) -> bool:
    try:
        float(token)
    except ValueError:
        return False
    return True


def _binary_cameras(path: Path) -> list[ColmapCamera]:
    with path.open("rb") as file:
        cameras = []
        for _ in range(_count(file, _CAMERA_BYTES)):
            number, model_number, width, height = _read(file, "<iiQQ")
            if not 0 <= model_number < len(_MODELS):
                raise ValueError(f"camera {number} has the unknown model {model_number}")
            model, count = _MODELS[model_number]
            cameras.append(ColmapCamera(number, model, (height, width), _read(file, f"<{count}d")))
        return cameras


def _binary_images(path: Path) -> list[ColmapImage]:
    with path.open("rb") as file:
        images = []
        for _ in range(_count(file, _IMAGE_BYTES)):
            number, *pose, camera = _read(file, "<i7di")
            name = bytearray()
            while (letter := _read(file, "<c")[0]) != b"\0":
                name += letter
            images.append(ColmapImage(name.decode("utf-8"), camera, _pose(pose[:4], pose[4:]), number))
            file.seek(_POINT_BYTES * _count(file, _POINT_BYTES), 1)
        return images


def _read(file: BinaryIO, layout: str) -> tuple:
    return struct.unpack(layout, file.read(struct.calcsize(layout)))


def _count(file: BinaryIO, size: int) -> int:
    """Read how many things of at least `size` bytes follow; ValueError when the file is too short for them."""
    (count,) = _read(file, "<Q")
    if count * size > os.fstat(file.fileno()).st_size - file.tell():
        raise ValueError(f"it ends before the {count} entries that it announces")
    return count


def _pose(quat_wxyz: list[float], translation: list[float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = quat_xyzw_to_matrix(quat_wxyz_to_xyzw(torch.tensor(quat_wxyz, dtype=torch.float64))).numpy()
    T[:3, 3] = translation
    return T
