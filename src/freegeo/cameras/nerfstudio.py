"""`transforms.json` of nerfstudio and instant-ngp: camera to world with OpenGL axes, pixels counted from the corner.

Intrinsics and distortion may be the file's or a frame's. `applied_transform` says by what the world was turned before
the poses were written; they belong to the world afterwards, and so do results: it is not undone.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from freegeo import files
from freegeo.cameras.base import CameraFile, FileCamera, Format, find_frames, matrix_of_numbers, read_frames
from freegeo.cameras.convention import matrix_of
from freegeo.cameras.known import KnownCameras, Lens
from freegeo.errors import UserError

logger = logging.getLogger(__name__)

NAME = "nerfstudio"
READING = "c2w-opengl"
_RADIAL = ("k1", "k2", "k3", "k4", "k5", "k6")
_LENS_KEYS = (*_RADIAL, "p1", "p2")
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
FISHEYE = "OPENCV_FISHEYE"


def find(path: Path) -> Path | None:
    """Return the JSON file when its frames have a `transform_matrix`."""
    return find_frames(path, "transforms.json", lambda frames: any("transform_matrix" in frame for frame in frames))


def read(path: Path) -> CameraFile:
    """Read the frames; UserError for what is not of this format."""
    content, frames = read_frames(path)
    if content.get("applied_transform") is not None:
        logger.info("%s: its world is the one after applied_transform, which is not undone", path)
    if content.get("applied_scale", 1.0) != 1.0:
        logger.warning(
            "%s: its lengths were multiplied by applied_scale (%s), which is not undone. Give --metric only if these "
            "lengths are metres.", path, content["applied_scale"],
        )  # fmt: skip
    return CameraFile(source=str(path), cameras=[_frame(content, frame, path) for frame in frames])


def _frame(content: Mapping[str, Any], frame: Mapping[str, Any], path: Path) -> FileCamera:
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise UserError(f"{path}: a frame has no file_path.")
    name = name.removeprefix("./")
    where = f"{path}: the frame {name}"
    values = _Values(content, frame, where)
    matrix = None
    if "transform_matrix" in frame:
        matrix = matrix_of_numbers(frame["transform_matrix"], ((4, 4), (3, 4)), f"{where}: transform_matrix")
    width, height = values.number("w"), values.number("h")
    size = None if width is None or height is None else (int(height), int(width))
    K, angle = _intrinsics(values, size, where)
    return FileCamera(name=name, matrix=matrix, K=K, angle_x=angle, lens=_lens(values, where), size_hw=size)


class _Values:
    """Values of a frame, which override those of the file."""

    def __init__(self, content: Mapping[str, Any], frame: Mapping[str, Any], where: str) -> None:
        self.content, self.frame, self.where = content, frame, where

    def get(self, key: str) -> Any:
        return self.frame.get(key, self.content.get(key))

    def number(self, key: str) -> float | None:
        value = self.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise UserError(f"{self.where}: {key} is {value!r:.40}, which is no number.")
        return float(value)


def _intrinsics(values: _Values, size: tuple[int, int] | None, where: str) -> tuple[np.ndarray | None, float | None]:
    """Return `K`, or the horizontal field of view where neither focal length nor size is given."""
    fx, fy = values.number("fl_x"), values.number("fl_y")
    angle_x, angle_y = values.number("camera_angle_x"), values.number("camera_angle_y")
    if fx is None and angle_x is not None:
        if size is None:
            return None, angle_x
        if not 0 < angle_x < np.pi:
            raise UserError(f"{where}: camera_angle_x is {angle_x:g}, which is not between 0 and pi.")
        fx = size[1] / 2 / float(np.tan(angle_x / 2))
        if fy is None and angle_y is not None:
            fy = size[0] / 2 / float(np.tan(angle_y / 2))
    if fx is None:
        return None, None
    cx, cy = values.number("cx"), values.number("cy")
    if (cx is None or cy is None) and size is None:
        raise UserError(f"{where}: has a focal length, but neither a principal point (cx, cy) nor a size (w, h).")
    if size is not None:
        cx, cy = size[1] / 2 if cx is None else cx, size[0] / 2 if cy is None else cy
    return np.array([[fx, 0, cx], [0, fx if fy is None else fy, cy], [0, 0, 1]], np.float64), None


def _lens(values: _Values, where: str) -> Lens | None:
    """Return the distortion as one of COLMAP's models; UserError for a camera model that is not known."""
    numbers = {key: values.number(key) or 0.0 for key in _LENS_KEYS}
    model = values.get("camera_model") or (FISHEYE if values.get("is_fisheye") else "OPENCV")
    if values.get("distortion_params") is not None:
        raise UserError(f"{where}: has distortion_params, which are not known. Write k1, k2, p1, p2 instead.")
    if model == FISHEYE:
        if numbers["p1"] or numbers["p2"]:
            raise UserError(f"{where}: a fisheye has no p1 and p2. Take them out, or correct camera_model.")
        return Lens(FISHEYE, tuple(numbers[key] for key in _RADIAL[:4]))
    if model not in _MODELS:
        raise UserError(f"{where}: the camera_model {model} is not known; known are {', '.join((*_MODELS, FISHEYE))}.")
    if numbers["k4"] or numbers["k5"] or numbers["k6"]:
        raise UserError(f"{where}: has k4, k5 or k6, which mean different things in different programs.")
    if not any(numbers.values()):
        return None
    if numbers["k3"]:
        return Lens("FULL_OPENCV", (*(numbers[key] for key in ("k1", "k2", "p1", "p2", "k3")), 0.0, 0.0, 0.0))
    return Lens("OPENCV", tuple(numbers[key] for key in ("k1", "k2", "p1", "p2")))


def write(known: KnownCameras, path: Path) -> None:
    """Write every photo as a frame with its own intrinsics; UserError when a pose or intrinsics are missing."""
    frames = []
    for name, one in zip(known.names, known.cameras, strict=True):
        if one.T_cam_world is None or one.K is None or one.size_hw is None:
            raise UserError(f"{name}: transforms.json needs pose, intrinsics and size of every photo.")
        frames.append(
            {
                "file_path": name, "w": one.size_hw[1], "h": one.size_hw[0],
                "fl_x": one.K[0, 0], "fl_y": one.K[1, 1], "cx": one.K[0, 2], "cy": one.K[1, 2],
                **_lens_numbers(name, one.lens), "transform_matrix": matrix_of(one.T_cam_world, READING).tolist(),
            }
        )  # fmt: skip
    files.write_json(path, {"frames": frames})


def _lens_numbers(name: str, lens: Lens | None) -> dict[str, Any]:
    if lens is None:
        return {"camera_model": "OPENCV"}
    if lens.model == FISHEYE:
        return {"camera_model": FISHEYE, **dict(zip(_RADIAL, lens.params, strict=False))}
    if lens.model in ("SIMPLE_RADIAL", "RADIAL"):
        return {"camera_model": "OPENCV", **dict(zip(_RADIAL, lens.params, strict=False))}
    k1, k2, p1, p2, *rest = lens.params
    if any(rest[1:]):
        raise UserError(f"{name}: transforms.json has no place for the distortion of {lens.model} beyond k3.")
    return {"camera_model": "OPENCV", "k1": k1, "k2": k2, "p1": p1, "p2": p2, **({"k3": rest[0]} if rest else {})}


FORMAT = Format(
    name=NAME, about="transforms.json of nerfstudio and instant-ngp", reading=READING, find=find, read=read,
    write=write,
)  # fmt: skip
