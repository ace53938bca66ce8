"""``points.ply``: coloured points in the reconstruction's world frame (OpenCV axes), binary little endian.

A comment in the header says the unit, as in ``mesh.ply``.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from freegeo import files
from freegeo.errors import FreeGeoError
from freegeo.export.base import Export, Format

if TYPE_CHECKING:
    import trimesh

    from freegeo.fusion.points import PointCloud

FILE_NAME = "points.ply"


def write_ply(cloud: PointCloud, path: Path, *, lengths: str) -> Path:
    """Write the points; FreeGeoError when there are none. `lengths` is that of the reconstruction."""
    import trimesh

    require_points(cloud, path)
    with files.atomic_path(path) as part:
        part.write_bytes(ply_bytes(trimesh.PointCloud(cloud.points, colors=cloud.colours), lengths))
    return path


def ply_bytes(geometry: trimesh.PointCloud | trimesh.Trimesh, lengths: str) -> bytes:
    """Return a PLY file whose header has a comment on the unit."""
    from trimesh.exchange.ply import export_ply

    first, rest = export_ply(geometry).split(b"\nelement ", 1)
    return first + f"\ncomment lengths are {lengths}\nelement ".encode() + rest


def require_points(cloud: PointCloud, path: Path) -> None:
    """Raise FreeGeoError for an empty cloud."""
    if len(cloud) == 0:
        raise FreeGeoError(f"{path}: no point is left to write. Lower the confidence limit or switch filters off.")


def _write(export: Export) -> list[Path]:
    return [write_ply(export.cloud, export.folder / FILE_NAME, lengths=export.reconstruction.lengths)]


FORMAT = Format(name="ply", path=FILE_NAME, about="coloured points", write=_write)
