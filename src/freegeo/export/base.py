"""Description of an export format, and the data that the formats of one export share.

Neither this module nor a format's module loads torch before it writes, since the command line lists the formats.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from freegeo.errors import FreeGeoError

if TYPE_CHECKING:
    import numpy as np

    from freegeo.export.reconstruction import Reconstruction
    from freegeo.fusion.filtering import FilterReport
    from freegeo.fusion.points import PointCloud
    from freegeo.fusion.settings import FilterSettings
    from freegeo.fusion.tracks import Tracks
    from freegeo.types import PhotoLike

logger = logging.getLogger(__name__)

DEFAULT_FORMATS = ("ply", "glb")
FLAT_FORMATS = ("depth",)
"""What is written by default of a model without cameras."""
KEPT_NAME = "kept.npz"
"""File that says which pixels became points (`freegeo.export.kept`)."""
TRACKS_NAME = "tracks.npz"
"""File of points that were measured in the photos (`freegeo.export.measured`)."""
MAX_TRACKS = 100_000
"""Default limit of the points of a COLMAP model."""
DepthSize = Literal["model", "photo"]
"""Size of depth files: of the model's images, or of the photos, by interpolation (`freegeo.export.upsampling`)."""


@dataclass(frozen=True, kw_only=True)
class Format:
    """One export format; `freegeo.export.formats` lists all."""

    name: str
    path: str
    """The file or folder that it writes, relative to the folder of the export."""
    more: tuple[str, ...] = ()
    """Folders that it writes for that file, which are nothing without it."""
    about: str
    """Short description for lists of files."""
    write: Callable[[Export], list[Path]]
    """Writes the files and returns their paths; FreeGeoError when there is nothing to write."""
    needs_cameras: bool = True
    holds_depth: bool = False
    """Whether it consists of depth maps, whose size can be chosen."""
    check: Callable[[Sequence[str]], None] = lambda names: None
    """Raises UserError when photos of these names cannot be written in this format, whatever a model predicts."""


@dataclass(frozen=True, kw_only=True)
class Exported:
    """The outcome of an export."""

    files: list[Path]
    """The files written, each once."""
    failed: Mapping[str, str]
    """Name of a format -> why it was not written, in a sentence."""

    def require_any(self) -> Exported:
        """Return this; FreeGeoError when no file was written."""
        if not self.files:
            raise FreeGeoError(f"nothing was written: {next(iter(self.failed.values()))}")
        return self


@dataclass(frozen=True, kw_only=True)
class Before:
    """An earlier prediction of the same views, for formats that show it beside the result."""

    folder: Path
    """Holds it, and which of its pixels became points."""
    label: str = "frozen"
    """What it is called, as in the report."""
    result_label: str = "adapted"
    """What the result is called."""
    filters: FilterSettings | None = None
    """By which its points are chosen; None: those that its folder says."""


@dataclass(frozen=True, kw_only=True)
class Export:
    """One export: what is written, where, and how; the point cloud is computed once for all formats."""

    reconstruction: Reconstruction
    folder: Path
    keep: np.ndarray
    """(S, H, W) bool: pixels that the masks and filters keep."""
    masks: np.ndarray | None
    """(S, H, W) bool: pixels that the user wants; None: all."""
    filters: FilterReport | None
    """What the filters removed; None where they did not run."""
    tolerance: float
    """Relative depth difference up to which two views see one surface."""
    max_points: int | None
    max_tracks: int | None
    voxel: float | None
    photos: Sequence[PhotoLike] | None
    """The photos of the reconstruction, in its order; None when they are not at hand."""
    tracks: Tracks | None
    """Points that were measured in the photos; None: there are none."""
    before: Before | None
    """None: there is no earlier prediction."""
    seed: int
    depth_size: DepthSize = "model"
    """Size of depth files; `photo` needs the photos."""
    written: dict[str, list[Path]] = field(default_factory=dict)
    """Files by the name of the format."""
    copies: list[Path] = field(default_factory=list)
    """Upright copies of the photos that a format of this export has written."""

    @cached_property
    def cloud(self) -> PointCloud:
        """The kept pixels as points; FreeGeoError when there are none."""
        from freegeo.fusion.points import coloured_points

        self.require_pixels()
        r = self.reconstruction
        T_cam_world, K = r.cameras()
        return coloured_points(
            r.depth_z, r.conf, T_cam_world, K, r.images, keep=self.keep, drop_share=0.0, drop_flying=False,
            max_points=self.max_points, seed=self.seed,
        )  # fmt: skip

    def require_pixels(self) -> None:
        """Raise FreeGeoError, with the reason, when no pixel is kept."""
        if not self.keep.any():
            self.require_depth()
            removed = f" ({self.filters.summary()})" if self.filters else ""
            raise FreeGeoError(f"no point is left to write{removed}. Loosen the filters or the masks.")

    def require_depth(self) -> None:
        """Raise FreeGeoError when the prediction has no usable depth at all."""
        if not self.reconstruction.valid_pixels().any():
            raise FreeGeoError(
                "no depth of the prediction is usable (none is finite and positive). Check the weights and the adapter."
            )

    def depth_pixels(self) -> np.ndarray:
        """Return the pixels (S, H, W) bool whose depth is written: usable, and within the masks but not the filters.

        FreeGeoError when there are none.
        """
        known = self.reconstruction.valid_pixels()
        if self.masks is not None:
            known &= self.masks
        if not known.any():
            self.require_depth()
            raise FreeGeoError("no depth is left to write: the masks leave no usable pixel. Check the masks.")
        return known

    def write(self, format: Format) -> list[Path]:
        """Write a format, once, and return its files."""
        if format.name not in self.written:
            self.written[format.name] = format.write(self)
        return self.written[format.name]

    def write_photos(self, folder: Path) -> list[Path]:
        """Write upright copies of the photos under their names in `export.photos.copy_names`; returns the files.

        Warns when the photos are not at hand.
        """
        from freegeo.export.photos import link_copies, write_copies

        names = self.reconstruction.names
        if self.photos is None:
            logger.warning(
                "The photos are not at hand, so %s has no copies of them. Put upright photos there under the names "
                "that the cameras refer to: the readers of this format do not turn photos by their EXIF orientation.",
                folder,
            )
            return []
        if self.copies:
            written = link_copies(self.copies, names, folder)
        else:
            written = write_copies(self.photos, folder)
            self.copies.extend(written)
        return written
