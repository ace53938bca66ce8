"""The export formats, and the one function that writes any of them.

A new format is a module beside this one that declares its `FORMAT`, and an entry in `FORMATS`. Help texts, checks and
lists of written files follow from that.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from freegeo.errors import UserError
from freegeo.export import colmap, depth_png, glb, mesh, nerfstudio, ply
from freegeo.export import reconstruction as npz
from freegeo.export.base import MAX_TRACKS, Export, Format
from freegeo.fusion.settings import MAX_POINTS, FilterSettings

if TYPE_CHECKING:
    from freegeo.export.reconstruction import Reconstruction
    from freegeo.fusion.filtering import FilterReport

logger = logging.getLogger(__name__)

_MODULES = (npz, ply, glb, mesh, colmap, nerfstudio, depth_png)
FORMATS: dict[str, Format] = {module.FORMAT.name: module.FORMAT for module in _MODULES}
ALL = "all"
"""Name that selects every format."""


def chosen_formats(names: Iterable[str]) -> list[str]:
    """Return the names of the chosen formats, each once, `all` resolved; UserError for one that does not exist."""
    chosen: list[str] = []
    for name in names:
        if name != ALL and name not in FORMATS:
            raise UserError(f"Unknown export format '{name}'. Choose from {', '.join(FORMATS)}.")
        chosen += FORMATS if name == ALL else [name]
    return list(dict.fromkeys(chosen))


def filter_reconstruction(
    reconstruction: Reconstruction, *, masks: np.ndarray | None = None, settings: FilterSettings | None = None
) -> tuple[np.ndarray, FilterReport]:
    """Pixels of a reconstruction to keep (S, H, W) bool, and what was removed; arguments as `filter_pixels`."""
    from freegeo.fusion.filtering import filter_pixels

    T_cam_world, K = reconstruction.cameras()
    return filter_pixels(
        reconstruction.depth_z, reconstruction.conf, T_cam_world, K, sky=reconstruction.sky, masks=masks,
        settings=settings,
    )  # fmt: skip


def export(
    reconstruction: Reconstruction,
    folder: Path | str,
    formats: Sequence[str],
    *,
    filtered: tuple[np.ndarray, FilterReport] | None = None,
    max_points: int | None = MAX_POINTS,
    max_tracks: int | None = MAX_TRACKS,
    voxel: float | None = None,
    photo_folder: str = "images",
    seed: int = 0,
) -> list[Path]:
    """Write a reconstruction in several formats.

    Args:
        reconstruction: what to write.
        folder: where the files are written.
        formats: names of `FORMATS`, or `all`.
        filtered: result of `filter_reconstruction`; default: filtered here with the default settings.
        max_points: of `points.ply` and `scene.glb`; None writes all.
        max_tracks: points of the COLMAP model; None writes all.
        voxel: voxel edge of the mesh in the reconstruction's units; default chosen from its resolution.
        photo_folder: where nerfstudio finds the original photos, relative to `folder`.
        seed: of the random choice of points.

    Returns:
        The files written, each once.

    Raises:
        UserError: an unknown format, a missing extra, or 3D formats of a reconstruction without cameras.
        FreeGeoError: nothing is left to write.
    """
    from freegeo.fusion.agreement import TOLERANCE_RANGE

    wanted = [FORMATS[name] for name in chosen_formats(formats)]
    keep, tolerance = np.ones(reconstruction.depth_z.shape, dtype=bool), None
    if any(format.needs_cameras for format in wanted):
        keep, report = filtered or filter_reconstruction(reconstruction)
        tolerance = report.tolerance
        logger.info("filters: %s", report.summary())
    run = Export(
        reconstruction=reconstruction,
        folder=Path(folder),
        keep=keep,
        tolerance=tolerance or TOLERANCE_RANGE[0],
        max_points=max_points,
        max_tracks=max_tracks,
        voxel=voxel,
        photo_folder=photo_folder,
        seed=seed,
    )
    return list(dict.fromkeys(path for format in wanted for path in run.write(format)))
