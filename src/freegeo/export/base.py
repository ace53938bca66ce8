"""Description of an export format, and the data that the formats of one export share.

Neither this module nor a format's module loads torch before it writes, since the command line lists the formats.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from freegeo.export.reconstruction import Reconstruction
    from freegeo.fusion.points import PointCloud

DEFAULT_FORMATS = ("ply", "glb")
KEPT_NAME = "kept.npz"
"""File that says which pixels became points (`freegeo.export.kept`)."""
MAX_TRACKS = 100_000
"""Default limit of the points of a COLMAP model."""


@dataclass(frozen=True, kw_only=True)
class Format:
    """One export format; `freegeo.export.formats` lists all."""

    name: str
    path: str
    """The file or folder that it writes, relative to the folder of the export."""
    about: str
    """Short description for lists of files."""
    write: Callable[[Export], list[Path]]
    """Writes the files and returns their paths."""
    needs_cameras: bool = True


@dataclass(frozen=True, kw_only=True)
class Export:
    """One export: what is written, where, and how; the point cloud is computed once for all formats."""

    reconstruction: Reconstruction
    folder: Path
    keep: np.ndarray
    """(S, H, W) bool: pixels that the filters keep."""
    tolerance: float
    """Relative depth difference up to which two views see one surface."""
    max_points: int | None
    max_tracks: int | None
    voxel: float | None
    photo_folder: str
    seed: int
    written: dict[str, list[Path]] = field(default_factory=dict)
    """Files by the name of the format."""

    @cached_property
    def cloud(self) -> PointCloud:
        """The kept pixels as points."""
        from freegeo.fusion.points import coloured_points

        r = self.reconstruction
        T_cam_world, K = r.cameras()
        return coloured_points(
            r.depth_z, r.conf, T_cam_world, K, r.images, keep=self.keep, drop_share=0.0, drop_flying=False,
            max_points=self.max_points, seed=self.seed,
        )  # fmt: skip

    def write(self, format: Format) -> list[Path]:
        """Write a format, once, and return its files."""
        if format.name not in self.written:
            self.written[format.name] = format.write(self)
        return self.written[format.name]
