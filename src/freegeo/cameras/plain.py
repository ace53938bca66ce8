"""`cameras.json`: the format of this package. Everything that `KnownCamera` holds, every part optional.

    {"metric": true,
     "frames": [{"name": "0001.jpg", "width": 768, "height": 512, "K": [[...], [...], [...]], "w2c": [[...], ...],
                 "lens": {"model": "OPENCV", "params": [k1, k2, p1, p2]}, "image_id": 1, "camera_id": 1}]}

docs/cameras.md, "cameras.json" has the table of the keys.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from freegeo import files
from freegeo.cameras.base import CameraFile, FileCamera, Format, find_frames, matrix_of_numbers, read_frames
from freegeo.cameras.known import KnownCamera, KnownCameras, Lens
from freegeo.errors import UserError

NAME = "cameras.json"
_KEYS = frozenset({"name", "width", "height", "K", "w2c", "lens", "image_id", "camera_id"})


def find(path: Path) -> Path | None:
    """Return the JSON file when its frames have names."""
    return find_frames(path, NAME, lambda frames: bool(frames) and all("name" in frame for frame in frames))


def read(path: Path) -> CameraFile:
    """Read the frames; UserError for what is not of this format."""
    content, frames = read_frames(path)
    metric = content.get("metric", False)
    if not isinstance(metric, bool):
        raise UserError(f"{path}: metric is {metric!r:.40}; it must be true or false.")
    return CameraFile(source=str(path), cameras=[_frame(frame, path) for frame in frames], metric=metric, upright=True)


def _frame(frame: Mapping[str, Any], path: Path) -> FileCamera:
    name = frame.get("name")
    if not isinstance(name, str) or not name:
        raise UserError(f"{path}: a frame has no name.")
    where = f"{path}: the frame {name}"
    unknown = sorted(set(frame) - _KEYS)
    if unknown:
        raise UserError(f"{where} has the unknown key {unknown[0]}; known are {', '.join(sorted(_KEYS))}.")
    size = _whole(frame, ("height", "width"), where)
    ids = _whole(frame, ("image_id", "camera_id"), where)
    K, w2c = frame.get("K"), frame.get("w2c")
    return FileCamera(
        name=name,
        matrix=None if w2c is None else matrix_of_numbers(w2c, ((4, 4), (3, 4)), f"{where}: w2c"),
        K=None if K is None else matrix_of_numbers(K, ((3, 3),), f"{where}: K"),
        lens=_lens(frame.get("lens"), where),
        size_hw=size,
        ids=ids,
    )


def _whole(frame: Mapping[str, Any], keys: tuple[str, str], where: str) -> tuple[int, int] | None:
    """Return two whole numbers that a frame has together, or None; UserError otherwise."""
    first, second = (frame.get(key) for key in keys)
    if first is None and second is None:
        return None
    if type(first) is not int or type(second) is not int:
        raise UserError(f"{where}: {keys[0]} and {keys[1]} must both be whole numbers.")
    return first, second


def _lens(value: Any, where: str) -> Lens | None:
    if value is None:
        return None
    try:
        return Lens(str(value["model"]), tuple(float(number) for number in value["params"]))
    except (TypeError, KeyError, ValueError):
        raise UserError(f'{where}: lens must be {{"model": "OPENCV", "params": [k1, k2, p1, p2]}}.') from None


def write(known: KnownCameras, path: Path) -> None:
    """Write everything that is known."""
    frames = [_written(name, one) for name, one in zip(known.names, known.cameras, strict=True)]
    files.write_json(path, {"metric": known.metric, "frames": frames})


def _written(name: str, one: KnownCamera) -> dict[str, Any]:
    parts: dict[str, Any] = {
        "width": None if one.size_hw is None else one.size_hw[1],
        "height": None if one.size_hw is None else one.size_hw[0],
        "K": None if one.K is None else one.K.tolist(),
        "w2c": None if one.T_cam_world is None else one.T_cam_world.tolist(),
        "lens": None if one.lens is None else {"model": one.lens.model, "params": list(one.lens.params)},
        "image_id": None if one.ids is None else one.ids[0],
        "camera_id": None if one.ids is None else one.ids[1],
    }
    return {"name": name, **{key: value for key, value in parts.items() if value is not None}}


FORMAT = Format(name=NAME, about="plain JSON of freegeo", reading="w2c-opencv", find=find, read=read, write=write)
