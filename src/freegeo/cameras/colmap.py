"""COLMAP models: `cameras` and `images`, text or binary; a project, its `sparse/0`, or one of the files.

`rigs` and `frames`, which COLMAP 3.12 and newer write beside, are not needed: `images` has the pose of every image.
Pixels are counted from the corner there too.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from freegeo import files
from freegeo.cameras.base import CameraFile, FileCamera, Format
from freegeo.cameras.known import KnownCameras, Lens
from freegeo.data.colmap_files import ColmapCamera, ColmapImage, read_cameras, read_images
from freegeo.errors import UserError
from freegeo.geometry.rotation import matrix_to_quat_xyzw, quat_xyzw_to_wxyz

NAME = "colmap"
_ONE_FOCAL_LENGTH = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_PLACES = ("", "sparse", "colmap", "colmap/sparse")


def find(path: Path) -> Path | None:
    """Return the folder of the model; UserError when a project has several."""
    if path.is_file():
        return path.parent if path.name in {f"{n}.{e}" for n in ("images", "cameras") for e in ("bin", "txt")} else None
    found = [path / place for place in _PLACES if _is_model(path / place)]
    for place in _PLACES:
        folder = path / place
        found += [inner for inner in sorted(folder.glob("[0-9]*")) if _is_model(inner)] if folder.is_dir() else []
    if len(found) > 1:
        names = ", ".join(str(folder) for folder in found)
        raise UserError(f"{path}: holds several COLMAP models, {names}. Name one of them.")
    return found[0] if found else None


def _is_model(folder: Path) -> bool:
    return any(all((folder / f"{name}.{end}").is_file() for name in ("cameras", "images")) for end in ("bin", "txt"))


def read(folder: Path) -> CameraFile:
    """Read the images that have a pose, in the order of the model."""
    cameras, images = read_cameras(folder), read_images(folder)
    if not images:
        raise UserError(f"{folder}: the COLMAP model has no image with a pose.")
    missing = next((image for image in images if image.camera not in cameras), None)
    if missing is not None:
        raise UserError(f"{folder}: the image {missing.name} has the camera {missing.camera}, which is not listed.")
    return CameraFile(source=str(folder), cameras=[_file_camera(image, cameras[image.camera]) for image in images])


def _file_camera(image: ColmapImage, camera: ColmapCamera) -> FileCamera:
    if camera.model in _ONE_FOCAL_LENGTH:
        f, cx, cy, *rest = camera.params
        fx = fy = f
    else:
        fx, fy, cx, cy, *rest = camera.params
    pinhole = camera.model in ("SIMPLE_PINHOLE", "PINHOLE")
    return FileCamera(
        name=image.name,
        matrix=image.T_cam_world,
        K=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        lens=None if pinhole else Lens(camera.model, tuple(rest)),
        size_hw=camera.size_hw,
        ids=(image.number, camera.number),
    )


def write(known: KnownCameras, folder: Path) -> None:
    """Write a text model without points; photos of one camera share it, with the numbers that they came with.

    UserError when a pose, intrinsics or a size is missing, or the folder has a binary model, which readers prefer.
    """
    if any((folder / f"{name}.bin").exists() for name in ("cameras", "images")):
        raise UserError(f"{folder}: holds a binary COLMAP model. Choose another folder.")
    cameras: dict[tuple, int] = {}
    images: list[str] = []
    taken = {one.ids[1] for one in known.cameras if one.ids is not None}
    image_numbers = _image_numbers(known)
    for name, one, number in zip(known.names, known.cameras, image_numbers, strict=True):
        if one.T_cam_world is None or one.K is None or one.size_hw is None:
            raise UserError(f"{name}: a COLMAP model needs pose, intrinsics and size of every photo.")
        model, params = _params(one.K, one.lens)
        key = (None if one.ids is None else one.ids[1], model, params, one.size_hw)
        if key not in cameras:
            free = next(k for k in range(1, len(known) + len(taken) + 2) if k not in taken)
            chosen = one.ids[1] if one.ids is not None and one.ids[1] not in cameras.values() else free
            cameras[key] = chosen
            taken.add(chosen)
        pose = torch.from_numpy(np.asarray(one.T_cam_world, np.float64))
        quat = quat_xyzw_to_wxyz(matrix_to_quat_xyzw(pose[:3, :3])).tolist()
        images.append(f"{number} {_numbers([*quat, *pose[:3, 3].tolist()])} {cameras[key]} {name}\n\n")
    lines = [
        f"{number} {model} {size[1]} {size[0]} {_numbers(params)}\n"
        for (_, model, params, size), number in sorted(cameras.items(), key=lambda item: item[1])
    ]
    with files.atomic_folder(folder) as part:
        (part / "cameras.txt").write_text("# CAMERA_ID MODEL WIDTH HEIGHT PARAMS\n" + "".join(lines), encoding="utf-8")
        (part / "images.txt").write_text(
            "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of points (empty here)\n" + "".join(images),
            encoding="utf-8",
        )
        (part / "points3D.txt").write_text("# no points: these are cameras alone\n", encoding="utf-8")


def _image_numbers(known: KnownCameras) -> list[int]:
    """Numbers of the images: their own where all have one and no two the same, else 1, 2, ..."""
    own = [one.ids[0] for one in known.cameras if one.ids is not None]
    return own if len(set(own)) == len(known) else list(range(1, len(known) + 1))


def _params(K: np.ndarray, lens: Lens | None) -> tuple[str, tuple[float, ...]]:
    fx, fy, cx, cy = (float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    if lens is None:
        return "PINHOLE", (fx, fy, cx, cy)
    if lens.model not in _ONE_FOCAL_LENGTH:
        return lens.model, (fx, fy, cx, cy, *lens.params)
    if fx == fy:
        return lens.model, (fx, cx, cy, *lens.params)
    # Photos that were resized have two focal lengths, which the simpler models have no place for.
    return "OPENCV", (fx, fy, cx, cy, *lens.params, *([0.0] * (4 - len(lens.params))))


def _numbers(values) -> str:
    return " ".join(repr(float(value)) for value in values)


FORMAT = Format(
    name=NAME, about="COLMAP model, text or binary", reading="w2c-opencv", find=find, read=read, write=write
)
