"""The export formats, and the one function that writes any of them.

A new format is a `Format` in a module beside this one, and an entry in `FORMATS`. Help texts, checks and
lists of written files follow from that.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from freegeo import files
from freegeo.errors import FreeGeoError, LostFolderError, UserError
from freegeo.export import colmap, depth_files, glb, kitti, mesh, nerfstudio, ply, rerun, tum, video
from freegeo.export import reconstruction as npz
from freegeo.export.base import MAX_TRACKS, Before, DepthSize, Export, Exported, Format
from freegeo.fusion.settings import MAX_POINTS, FilterSettings

if TYPE_CHECKING:
    from freegeo.export.reconstruction import Reconstruction
    from freegeo.fusion.filtering import FilterReport
    from freegeo.fusion.tracks import Tracks
    from freegeo.types import PhotoLike

logger = logging.getLogger(__name__)

FORMATS: dict[str, Format] = {
    format.name: format
    for format in (
        npz.FORMAT, ply.FORMAT, glb.FORMAT, mesh.FORMAT, colmap.FORMAT, nerfstudio.FORMAT, tum.FORMAT, kitti.FORMAT,
        depth_files.PNG, depth_files.PICTURES, depth_files.NPY, depth_files.EXR, video.FORMAT, rerun.FORMAT,
    )
}  # fmt: skip
ALL = "all"
"""Name that selects every format."""
NO_CAMERAS = "this reconstruction has no cameras, so it has no 3D points. Use a model that predicts cameras."


def chosen_formats(names: Iterable[str]) -> list[str]:
    """Return the names of the chosen formats, each once, `all` resolved; a name may be several with commas.

    A string is one name.

    UserError for one that does not exist, and when none is named.
    """
    asked = _single(names)
    unknown = next((name for name in asked if name != ALL and name not in FORMATS), None)
    choice = f"Choose from {', '.join(FORMATS)}, or {ALL}."
    if unknown is not None:
        raise UserError(f"Unknown export format '{unknown}'. {choice}")
    if not asked:
        raise UserError(f"No export format is named. {choice}")
    return list(dict.fromkeys(format for name in asked for format in (FORMATS if name == ALL else [name])))


def _single(names: Iterable[str]) -> list[str]:
    names = [names] if isinstance(names, str) else names
    return [part.strip().lower() for name in names for part in name.split(",") if part.strip()]


def check_formats(names: Sequence[str], photos: Sequence[str], *, has_cameras: bool = True) -> list[str]:
    """Return the names of the formats to write for photos of these names; cheap, so done before anything is computed.

    UserError for a format that can never be written for them. Of `all`, such formats are left out with a warning.
    """
    usable = []
    for name in chosen_formats(names):
        try:
            if FORMATS[name].needs_cameras and not has_cameras:
                raise UserError(NO_CAMERAS)
            FORMATS[name].check(photos)
        except UserError as error:
            if name in _single(names):
                raise
            logger.warning("'%s' leaves out %s: %s", ALL, name, error)
        else:
            usable.append(name)
    return usable


def filter_reconstruction(
    reconstruction: Reconstruction, *, masks: np.ndarray | None = None, settings: FilterSettings | None = None
) -> tuple[np.ndarray, FilterReport]:
    """Pixels of a reconstruction to keep (S, H, W) bool, and what was removed; arguments as `filter_pixels`."""
    from freegeo.fusion.filtering import filter_pixels

    T_cam_world, K = reconstruction.cameras()
    return filter_pixels(
        reconstruction.depth_z, reconstruction.conf, T_cam_world, K, sky=reconstruction.sky, masks=masks,
        inside=reconstruction.inside(), settings=settings,
    )  # fmt: skip


def export(
    reconstruction: Reconstruction,
    folder: Path | str,
    formats: Sequence[str],
    *,
    filtered: tuple[np.ndarray, FilterReport] | None = None,
    masks: np.ndarray | None = None,
    photos: Sequence[PhotoLike] | None = None,
    max_points: int | None = MAX_POINTS,
    max_tracks: int | None = MAX_TRACKS,
    voxel: float | None = None,
    tracks: Tracks | None = None,
    before: Before | None = None,
    depth_size: DepthSize = "model",
    seed: int = 0,
) -> Exported:
    """Write a reconstruction in several formats; one that has nothing to write is a warning and costs no other.

    What an earlier export wrote in these formats is replaced, and removed where it is not written again; files that
    freegeo did not write stay.

    Args:
        reconstruction: what to write.
        folder: where the files are written.
        formats: names of `FORMATS`, or `all`.
        filtered: result of `filter_reconstruction`; default: filtered here with the default settings.
        masks: (S, H, W) bool, the user's masks at the model's size, which depth maps follow; None: no masks.
        photos: the photos, for upright copies in formats that refer to them; None when they are not at hand.
        max_points: of `points.ply` and `scene.glb`; None writes all.
        max_tracks: points of the COLMAP model; None writes all.
        voxel: voxel edge of the mesh in the reconstruction's units; default chosen from its resolution.
        tracks: points that were measured in the photos, for the COLMAP model; None: it gets projected ones.
        before: an earlier prediction of the same views, which the fly-through shows beside this one.
        depth_size: of depth files: the model's, or the photos' by interpolation, which needs the photos.
        seed: of the random choice of points.

    Raises:
        UserError: a format that is unknown or can never be written (`check_formats`), a voxel or limit that is not
            positive, other photos than the reconstruction's, none where depth is to have their size, or a folder that
            cannot be written to.
    """
    from freegeo.fusion.agreement import TOLERANCE_RANGE

    wanted = [FORMATS[name] for name in check_formats(formats, reconstruction.names)]
    _check_values(reconstruction, photos, max_points=max_points, max_tracks=max_tracks, voxel=voxel)
    if depth_size == "photo" and photos is None and any(format.holds_depth for format in wanted):
        raise UserError(
            "Depth at the size of the photos is interpolated by these, and they are not at hand: not given, moved or "
            "changed. Put them back where they were, or take depth at the model's size (--depth-size model)."
        )
    report = None
    keep = np.ones(reconstruction.depth_z.shape, dtype=bool) if masks is None else masks
    if reconstruction.has_cameras and any(format.needs_cameras for format in wanted):
        keep, report = filtered or filter_reconstruction(reconstruction, masks=masks)
        logger.info("filters: %s", report.summary())
    folder = Path(folder)
    files.keep_ledger(folder)
    run = Export(
        reconstruction=reconstruction,
        folder=folder,
        keep=keep,
        masks=masks,
        filters=report,
        tolerance=TOLERANCE_RANGE[0] if report is None or report.tolerance is None else report.tolerance,
        max_points=max_points,
        max_tracks=max_tracks,
        voxel=voxel,
        photos=photos,
        tracks=tracks,
        before=before,
        depth_size=depth_size,
        seed=seed,
    )
    written: list[Path] = []
    failed: dict[str, str] = {}
    for format in wanted:
        done = []
        try:
            if format.needs_cameras and not reconstruction.has_cameras:
                raise FreeGeoError(NO_CAMERAS)
            done = run.write(format)
        except (UserError, LostFolderError):
            raise
        except FreeGeoError as error:
            failed[format.name] = str(error)
            logger.warning("Format %s is not written: %s", format.name, error)
        finally:
            # Also when the export stops here, nothing stays that is of no use without the format's own file.
            for name in format.more:
                files.remove_written(folder / name, keep=done)
        files.remove_written(folder / format.path, keep=done)
        written += done
    return Exported(files=list(dict.fromkeys(written)), failed=failed)


def _check_values(
    reconstruction: Reconstruction,
    photos: Sequence[PhotoLike] | None,
    *,
    max_points: int | None,
    max_tracks: int | None,
    voxel: float | None,
) -> None:
    if voxel is not None and not voxel > 0:
        raise UserError(f"The voxel size must be positive, got {voxel}.")
    for what, value in (("points", max_points), ("tracks", max_tracks)):
        if value is not None and value < 1:
            raise UserError(f"The largest number of {what} must be at least 1, got {value}.")
    if photos is None:
        return
    if tuple(photo.name for photo in photos) != reconstruction.names:
        raise UserError("The photos are not those of the reconstruction. Give the same ones, in the same order.")
    for photo, size_hw in zip(photos, reconstruction.photo_hw.tolist(), strict=True):
        if list(photo.size_hw) != size_hw:
            raise UserError(f"{photo.name} has another size than when it was reconstructed. Give the same photos.")
