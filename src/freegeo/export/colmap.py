"""``colmap/``: a COLMAP model in ``sparse/0``, and the upright photos it is about in ``images`` (extra ``colmap``).

World and cameras have OpenCV axes in COLMAP too. Cameras are PINHOLE at the photos' resolution, one per photo; images
carry the names of the copies (`freegeo.export.photos`); pixel centres are at 0.5 (`freegeo.export.pixels`). Every point
has two or more observations. Those of a refined result are measured in the photos (`freegeo.export.measured`). Others
are projected from the predicted points, so that bundle adjustment reproduces the predicted cameras and cannot improve
them. ``README.txt`` beside the model says which kind it holds.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from freegeo import files
from freegeo.errors import FreeGeoError, UserError
from freegeo.export import photos
from freegeo.export.base import Export, Format
from freegeo.export.pixels import corner_K, corner_pixels
from freegeo.export.reconstruction import Reconstruction
from freegeo.host import sigterm_kept

if TYPE_CHECKING:
    from freegeo.fusion.tracks import Tracks

logger = logging.getLogger(__name__)

FOLDER = Path("colmap") / "sparse" / "0"
ABOUT = "COLMAP model; its README.txt says whether tracks are measured"
NOTICE = """freegeo wrote this COLMAP model.

sparse/0   cameras, images and points
images     upright copies of the photos, without distortion where that was known

Use the model with images/ (--image_path), not with the original photos: COLMAP and the trainers of Gaussian splats do
not turn photos by their EXIF orientation, but these cameras are those of upright photos.

Lengths are {lengths}.

"""
PROJECTED = """Observations are re-projections of the prediction.
They are not measured in the photos, but are the predicted points, projected into the views that agree on them.
Bundle adjustment of this model reproduces the predicted cameras and cannot improve them. To refine the cameras, use the
option --refine ba of freegeo, or match features in images/ (feature_extractor, a matcher, point_triangulator with this
model) and adjust.
"""
MEASURED = """Observations are measured matches.
Each is a place in a photo that was matched with the others of its point. The cameras were refined by bundle adjustment
of these tracks; another adjustment can learn from them.
"""


def write_colmap(reconstruction: Reconstruction, tracks: Tracks, folder: Path) -> list[Path]:
    """Write the binary model to `folder`, replacing one that freegeo wrote there, and return its files.

    Args:
        reconstruction: cameras and photos.
        tracks: points of it, from `fusion.tracks.build_tracks`.
        folder: of the model.

    Raises:
        UserError: the folder cannot be written to.
        FreeGeoError: there is no track, or pycolmap cannot be loaded.
    """
    try:
        with sigterm_kept():
            import pycolmap
    except ImportError as error:
        raise FreeGeoError(f"pycolmap cannot be loaded ({error}). Run: pip install 'freegeo[colmap]'.") from None
    if len(tracks) == 0:
        raise FreeGeoError("no point is seen by two views. Use photos that overlap, or loosen the filters.")
    model = _model(pycolmap, reconstruction, tracks)
    with files.atomic_folder(folder) as part:
        model.write_binary(str(part))
        names = sorted(path.name for path in part.iterdir())
        # pycolmap does not notice a full disk.
        files.require_room(part)
    return [folder / name for name in names]


def _model(pycolmap: ModuleType, reconstruction: Reconstruction, tracks: Tracks):
    model = pycolmap.Reconstruction()
    places = corner_pixels(reconstruction, tracks.view, tracks.pixel)
    position = np.zeros(len(tracks.view), np.int64)  # of each observation in its image's list
    T_cam_world, K = reconstruction.cameras()[0], corner_K(reconstruction)
    for view, name in enumerate(photos.copy_names(reconstruction.names)):
        number = view + 1  # COLMAP counts from 1
        height, width = (int(side) for side in reconstruction.photo_hw[view])
        params = [K[view, 0, 0], K[view, 1, 1], K[view, 0, 2], K[view, 1, 2]]
        camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params, camera_id=number)
        model.add_camera_with_trivial_rig(camera)
        rows = np.flatnonzero(tracks.view == view)
        position[rows] = np.arange(len(rows))
        image = pycolmap.Image(name=name, keypoints=places[rows], camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(_rigid(T_cam_world[view])))
    _add_points(pycolmap, model, tracks, position)
    model.update_point_3d_errors()
    return model


def _add_points(pycolmap: ModuleType, model, tracks: Tracks, position: np.ndarray) -> None:
    ends = np.searchsorted(tracks.point, np.arange(len(tracks)), side="right").tolist()
    images, places = (tracks.view + 1).tolist(), position.tolist()
    new_track, add_point = pycolmap.Track, model.add_point3D
    start = 0
    for xyz, colour, end in zip(tracks.xyz, tracks.colours, ends, strict=True):
        track = new_track()
        for i in range(start, end):
            track.add_element(images[i], places[i])
        add_point(xyz, track, colour)
        start = end


def _rigid(T: np.ndarray) -> np.ndarray:
    """(3, 4) float64 with a rotation that is orthogonal to double precision."""
    u, _, vh = np.linalg.svd(T[:3, :3].astype(np.float64))
    return np.concatenate((u @ vh, T[:3, 3:].astype(np.float64)), axis=1)


def check(names: Sequence[str]) -> None:
    """Raise UserError for a single photo, which has no tracks, and where pycolmap is not installed."""
    photos.check_names(names)
    if len(names) < 2:
        raise UserError("a COLMAP model needs points that two views see, and there is one photo. Leave colmap out.")
    if find_spec("pycolmap") is None:
        raise UserError("The COLMAP export needs an extra: pip install 'freegeo[colmap]'.")


def _write(export: Export) -> list[Path]:
    from freegeo.fusion.tracks import build_tracks, inside, thin_tracks

    export.require_pixels()
    r = export.reconstruction
    T_cam_world, K = r.cameras()
    tracks, kind = export.tracks, MEASURED
    if tracks is None:
        kind = PROJECTED
        tracks = build_tracks(
            r.depth_z, T_cam_world, K, r.images, export.keep, tolerance=export.tolerance, max_points=export.max_tracks,
            seed=export.seed,
        )  # fmt: skip
    else:
        tracks = thin_tracks(tracks if export.masks is None else inside(tracks, export.masks), export.max_tracks)
    model = write_colmap(r, tracks, export.folder / FOLDER)
    root = export.folder / FOLDER.parts[0]
    copies = export.write_photos(root / photos.FOLDER)
    notice = root / "README.txt"
    with files.atomic_path(notice) as part:
        part.write_text(NOTICE.format(lengths=r.lengths) + kind, encoding="utf-8")
    logger.info(
        "colmap: the model is about the upright photos in %s/%s, not the original ones. Its %s", FOLDER.parts[0],
        photos.FOLDER,
        "observations are measured matches." if kind is MEASURED else
        "observations are re-projections of the prediction: bundle adjustment cannot improve it.",
    )  # fmt: skip
    return [*model, *copies, notice]


FORMAT = Format(name="colmap", path=FOLDER.parts[0], about=ABOUT, write=_write, check=check)
