"""``transforms.json`` for nerfstudio: OpenGL camera axes, intrinsics of the upright photos, initial points.

The photos that it refers to are the upright copies in ``images/`` (`freegeo.export.photos`). World coordinates stay
those of the reconstruction (and of `points.ply`, which the file names); only the cameras' axes change: x right, y up,
z backward. Pixel centres are at 0.5.

Depth lies in ``nerfstudio-depth/`` at the photos' size (`freegeo.export.upsampling`), of the pixels that became points,
0 elsewhere. nerfstudio multiplies it by 0.001 unless it is told otherwise, so that it is stored in thousandths of the
cameras' unit, as float32: 16-bit integers would be too coarse for lengths that are up to scale. The user's masks, if
there are any, lie in ``masks/`` at the photos' size; white is used. Either is given for all photos or for none.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from freegeo import files
from freegeo.errors import FreeGeoError
from freegeo.export import photos, ply
from freegeo.export.base import Export, Format
from freegeo.export.depth_files import depth_names, photo_depth
from freegeo.export.pixels import corner_K, mask_for_photo
from freegeo.export.reconstruction import Reconstruction

logger = logging.getLogger(__name__)

FILE_NAME = "transforms.json"
DEPTH_FOLDER = "nerfstudio-depth"
MASK_FOLDER = "masks"
DEPTH_UNIT = 0.001
"""What nerfstudio multiplies depth by, by default (`depth_unit_scale_factor`)."""


def opengl_camera_to_world(T_cam_world: np.ndarray) -> np.ndarray:
    """Camera-to-world matrices (S, 4, 4) float64 with OpenGL camera axes."""
    T = T_cam_world.astype(np.float64)
    return np.linalg.inv(T) @ np.diag([1.0, -1.0, -1.0, 1.0])


def write_nerfstudio(
    reconstruction: Reconstruction,
    path: Path,
    *,
    points: str | None = None,
    maps: Mapping[str, Sequence[Path]] | None = None,
) -> Path:
    """Write the cameras.

    Args:
        reconstruction: with cameras.
        path: of the JSON file; the copies of the photos are expected in `images/` beside it.
        points: name of a point cloud beside the file.
        maps: files in folders beside it, one per view, under the key that a frame names them by.
    """
    K = corner_K(reconstruction)
    matrices = opengl_camera_to_world(reconstruction.cameras()[0])
    frames = [
        {
            "file_path": f"{photos.FOLDER}/{name}",
            "w": int(reconstruction.photo_hw[view, 1]),
            "h": int(reconstruction.photo_hw[view, 0]),
            "fl_x": K[view, 0, 0],
            "fl_y": K[view, 1, 1],
            "cx": K[view, 0, 2],
            "cy": K[view, 1, 2],
            "transform_matrix": matrices[view].tolist(),
            **{key: paths[view].relative_to(path.parent).as_posix() for key, paths in (maps or {}).items()},
        }
        for view, name in enumerate(photos.copy_names(reconstruction.names))
    ]
    distortion = {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    cloud = {"ply_file_path": points} if points else {}
    unit = {"depth_unit_scale_factor": DEPTH_UNIT} if maps and "depth_file_path" in maps else {}
    files.write_json(path, {"camera_model": "OPENCV", **distortion, **cloud, **unit, "frames": frames})
    return path


def _write_depth(export: Export) -> list[Path]:
    """Write the depth of the kept pixels at the photos' size; nothing where there are none, or no photos."""
    if export.photos is None or not export.keep.any():
        return []
    folder, valid = export.folder / DEPTH_FOLDER, export.reconstruction.valid_pixels() & export.keep
    names = depth_names(export.reconstruction.names, ".npy")
    with files.atomic_files(folder, names) as paths:
        for view, path in enumerate(paths):
            with path.open("wb") as file:
                np.save(file, photo_depth(export, view, valid[view]) / np.float32(DEPTH_UNIT))
    return [folder / name for name in names]


def _write_masks(export: Export) -> list[Path]:
    """Write the user's masks at the photos' size, black where the model did not see them; nothing without masks."""
    from PIL import Image

    if export.masks is None:
        return []
    folder, names = export.folder / MASK_FOLDER, depth_names(export.reconstruction.names)
    with files.atomic_files(folder, names) as paths:
        for view, path in enumerate(paths):
            mask = mask_for_photo(export.reconstruction, view, export.masks[view])
            Image.fromarray(np.where(mask, np.uint8(255), np.uint8(0))).save(path, compress_level=1)
    return [folder / name for name in names]


def _write(export: Export) -> list[Path]:
    # It names the files that are written here: it goes before these change, and comes when they are complete.
    files.remove_written(export.folder / FILE_NAME)
    copies = export.write_photos(export.folder / photos.FOLDER)
    try:
        points = export.write(ply.FORMAT)
    except FreeGeoError as error:
        logger.warning("%s has neither initial points nor depth: %s", FILE_NAME, error)
        points = []
    if export.photos is None and points:
        logger.warning("%s has no depth: that is interpolated to the size of the photos by these.", FILE_NAME)
    written = {"depth_file_path": _write_depth(export), "mask_path": _write_masks(export)}
    maps = {key: paths for key, paths in written.items() if paths}
    name = points[0].name if points else None
    path = write_nerfstudio(export.reconstruction, export.folder / FILE_NAME, points=name, maps=maps)
    return [path, *points, *copies, *(file for paths in maps.values() for file in paths)]


FORMAT = Format(
    name="nerfstudio",
    path=FILE_NAME,
    more=(DEPTH_FOLDER, MASK_FOLDER),
    about="nerfstudio cameras, for images/",
    write=_write,
    check=photos.check_names,
)
