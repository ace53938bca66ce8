"""The table of export formats, and the one function that writes any of them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from freegeo.errors import UserError
from freegeo.export import colmap, depth_png, glb, mesh, nerfstudio, ply
from freegeo.export.reconstruction import FILE_NAME, Reconstruction
from freegeo.fusion.agreement import TOLERANCE_RANGE
from freegeo.fusion.filtering import FilterReport, FilterSettings, filter_pixels
from freegeo.fusion.points import MAX_POINTS, PointCloud, coloured_points
from freegeo.fusion.tracks import build_tracks

logger = logging.getLogger(__name__)

MAX_TRACKS = 100_000


@dataclass(frozen=True, kw_only=True)
class Job:
    """What the writers of one export share; points are lifted once."""

    reconstruction: Reconstruction
    folder: Path
    keep: np.ndarray
    tolerance: float
    max_points: int | None
    max_tracks: int | None
    voxel: float | None
    photo_folder: str
    seed: int

    @cached_property
    def cloud(self) -> PointCloud:
        """The kept pixels as points."""
        r = self.reconstruction
        T_cam_world, K = r.cameras()
        return coloured_points(
            r.depth_z,
            r.conf,
            T_cam_world,
            K,
            r.images,
            keep=self.keep,
            drop_share=0.0,
            drop_flying=False,
            max_points=self.max_points,
            seed=self.seed,
        )

    @cached_property
    def points_file(self) -> Path:
        """`points.ply`, written when it is first asked for."""
        return ply.write_ply(self.cloud, self.folder / ply.FILE_NAME)


def _npz(job: Job) -> list[Path]:
    return [job.reconstruction.save(job.folder / FILE_NAME)]


def _ply(job: Job) -> list[Path]:
    return [job.points_file]


def _glb(job: Job) -> list[Path]:
    T_cam_world, K = job.reconstruction.cameras()
    return [glb.write_glb(job.cloud, T_cam_world, K, job.reconstruction.image_hw, job.folder / glb.FILE_NAME)]


def _mesh(job: Job) -> list[Path]:
    return [mesh.write_mesh(job.reconstruction, job.keep, job.folder / mesh.FILE_NAME, voxel=job.voxel)]


def _colmap(job: Job) -> list[Path]:
    r = job.reconstruction
    T_cam_world, K = r.cameras()
    tracks = build_tracks(
        r.depth_z,
        T_cam_world,
        K,
        r.images,
        job.keep,
        tolerance=job.tolerance,
        max_points=job.max_tracks,
        seed=job.seed,
    )
    return colmap.write_colmap(r, tracks, job.folder / colmap.FOLDER)


def _nerfstudio(job: Job) -> list[Path]:
    points, file = job.points_file, job.folder / nerfstudio.FILE_NAME
    nerfstudio.write_nerfstudio(job.reconstruction, file, photo_folder=job.photo_folder, points=points.name)
    return [file, points]


def _depth(job: Job) -> list[Path]:
    return depth_png.write_depth(job.reconstruction, job.folder / depth_png.FOLDER)


WRITERS: dict[str, Callable[[Job], list[Path]]] = {
    "npz": _npz,
    "ply": _ply,
    "glb": _glb,
    "mesh": _mesh,
    "colmap": _colmap,
    "nerfstudio": _nerfstudio,
    "depth": _depth,
}
NEEDS_CAMERAS = frozenset({"ply", "glb", "mesh", "colmap", "nerfstudio"})


def check_formats(formats: Sequence[str]) -> None:
    """Raise UserError for a format that does not exist."""
    for name in formats:
        if name not in WRITERS:
            raise UserError(f"Unknown export format '{name}'. Choose from {', '.join(WRITERS)}.")


def filter_reconstruction(
    reconstruction: Reconstruction, *, masks: np.ndarray | None = None, settings: FilterSettings | None = None
) -> tuple[np.ndarray, FilterReport]:
    """Pixels of a reconstruction to believe (S, H, W) bool, and what was removed; arguments as `filter_pixels`."""
    T_cam_world, K = reconstruction.cameras()
    return filter_pixels(
        reconstruction.depth_z,
        reconstruction.conf,
        T_cam_world,
        K,
        sky=reconstruction.sky,
        masks=masks,
        settings=settings,
    )


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
        folder: where the files appear.
        formats: names of `WRITERS`.
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
    check_formats(formats)
    keep = np.ones(reconstruction.depth_z.shape, dtype=bool)
    tolerance = None
    if NEEDS_CAMERAS & set(formats):
        keep, report = filtered or filter_reconstruction(reconstruction)
        tolerance = report.tolerance
        logger.info("filters: %s", report.summary())
    job = Job(
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
    written = [path for name in dict.fromkeys(formats) for path in WRITERS[name](job)]
    return list(dict.fromkeys(written))
