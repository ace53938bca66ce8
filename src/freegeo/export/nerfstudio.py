"""``transforms.json`` for nerfstudio: OpenGL camera axes, intrinsics of the upright photos, initial points.

The photos that it refers to are the upright copies in ``images/`` (`freegeo.export.photos`). World coordinates stay
those of the reconstruction (and of `points.ply`, which the file names); only the cameras' axes change: x right, y up,
z backward. Pixel centres are at 0.5.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from freegeo import files
from freegeo.errors import FreeGeoError
from freegeo.export import photos, ply
from freegeo.export.base import Export, Format
from freegeo.export.pixels import corner_K
from freegeo.export.reconstruction import Reconstruction

logger = logging.getLogger(__name__)

FILE_NAME = "transforms.json"


def opengl_camera_to_world(T_cam_world: np.ndarray) -> np.ndarray:
    """Camera-to-world matrices (S, 4, 4) float64 with OpenGL camera axes."""
    T = T_cam_world.astype(np.float64)
    return np.linalg.inv(T) @ np.diag([1.0, -1.0, -1.0, 1.0])


def write_nerfstudio(reconstruction: Reconstruction, path: Path, *, points: str | None = None) -> Path:
    """Write the cameras.

    Args:
        reconstruction: with cameras.
        path: of the JSON file; the copies of the photos are expected in `images/` beside it.
        points: name of a point cloud beside the file.
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
        }
        for view, name in enumerate(photos.copy_names(reconstruction.names))
    ]
    distortion = {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    cloud = {"ply_file_path": points} if points else {}
    files.write_json(path, {"camera_model": "OPENCV", **distortion, **cloud, "frames": frames})
    return path


def _write(export: Export) -> list[Path]:
    copies = export.write_photos(export.folder / photos.FOLDER)
    try:
        points = export.write(ply.FORMAT)
    except FreeGeoError as error:
        logger.warning("%s has no initial points: %s", FILE_NAME, error)
        points = []
    name = points[0].name if points else None
    return [write_nerfstudio(export.reconstruction, export.folder / FILE_NAME, points=name), *points, *copies]


FORMAT = Format(
    name="nerfstudio", path=FILE_NAME, about="nerfstudio cameras, for images/", write=_write, check=photos.check_names
)
