"""``points.ply``: coloured points in the reconstruction's world frame (OpenCV axes), binary little endian."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from freegeo import files
from freegeo.errors import FreeGeoError
from freegeo.export.base import Export, Format

if TYPE_CHECKING:
    from freegeo.fusion.points import PointCloud

FILE_NAME = "points.ply"


def write_ply(cloud: PointCloud, path: Path) -> Path:
    """Write the points; FreeGeoError when there are none."""
    import trimesh

    require_points(cloud, path)
    with files.atomic_path(path) as part:
        trimesh.PointCloud(cloud.points, colors=cloud.colours).export(part)
    return path


def require_points(cloud: PointCloud, path: Path) -> None:
    """Raise FreeGeoError for an empty cloud."""
    if len(cloud) == 0:
        raise FreeGeoError(f"{path}: no point is left to write. Lower the confidence limit or switch filters off.")


def _write(export: Export) -> list[Path]:
    return [write_ply(export.cloud, export.folder / FILE_NAME)]


FORMAT = Format(name="ply", path=FILE_NAME, about="coloured points", write=_write)
