"""``points.ply``: coloured points in the reconstruction's world frame (OpenCV axes), binary little endian.

Comments in the header say the unit, as in ``mesh.ply``, and what the normals are: they point to the camera that saw the
point, and are 0 0 0 where the pixels beside it show another surface or none.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from freegeo import files
from freegeo.errors import FreeGeoError
from freegeo.export.base import Export, Format

if TYPE_CHECKING:
    import trimesh

    from freegeo.fusion.points import PointCloud

logger = logging.getLogger(__name__)

FILE_NAME = "points.ply"
NORMALS = "normals point to the camera that saw the point; 0 0 0: not known"
_FLOATS, _COLOURS = ("x", "y", "z", "nx", "ny", "nz"), ("red", "green", "blue")


def write_ply(cloud: PointCloud, path: Path, *, lengths: str, normals: np.ndarray) -> Path:
    """Write the points.

    Args:
        cloud: world points.
        path: of the file.
        lengths: that of the reconstruction.
        normals: (n, 3) of the points, 0 where they are not known.

    Raises:
        FreeGeoError: there is no point.
    """
    require_points(cloud, path)
    kinds = {**dict.fromkeys(_FLOATS, "<f4"), **dict.fromkeys(_COLOURS, "u1")}
    rows = np.empty(len(cloud), list(kinds.items()))
    for name, column in zip(kinds, (*cloud.points.T, *normals.T, *cloud.colours.T), strict=True):
        rows[name] = column
    header = [
        "ply", "format binary_little_endian 1.0", f"comment lengths are {lengths}", f"comment {NORMALS}",
        f"element vertex {len(rows)}", *(f"property float {name}" for name in _FLOATS),
        *(f"property uchar {name}" for name in _COLOURS), "end_header", "",
    ]  # fmt: skip
    with files.atomic_path(path) as part, part.open("wb") as file:
        file.write("\n".join(header).encode())
        file.write(rows.data)
    return path


def ply_bytes(geometry: trimesh.Trimesh, lengths: str) -> bytes:
    """Return a PLY file whose header has a comment on the unit."""
    from trimesh.exchange.ply import export_ply

    first, rest = export_ply(geometry).split(b"\nelement ", 1)
    return first + f"\ncomment lengths are {lengths}\nelement ".encode() + rest


def require_points(cloud: PointCloud, path: Path) -> None:
    """Raise FreeGeoError for an empty cloud."""
    if len(cloud) == 0:
        raise FreeGeoError(f"{path}: no point is left to write. Lower the confidence limit or switch filters off.")


def _write(export: Export) -> list[Path]:
    from freegeo.fusion.normals import point_normals

    r = export.reconstruction
    normals = point_normals(export.cloud, r.depth_z, *r.cameras(), r.inside())
    unknown = np.count_nonzero(~normals.any(axis=1))
    if unknown:
        logger.info("%s: %.2g %% of the points have no normal (0 0 0)", FILE_NAME, 100 * unknown / len(normals))
    return [write_ply(export.cloud, export.folder / FILE_NAME, lengths=r.lengths, normals=normals)]


FORMAT = Format(name="ply", path=FILE_NAME, about="coloured points with normals", write=_write)
