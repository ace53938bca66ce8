"""``colmap/sparse/0``: a COLMAP model that splatting and bundle adjustment accept (extra ``colmap``).

World and cameras have OpenCV axes in COLMAP too. Cameras are PINHOLE at the original photos' resolution, one per photo;
images carry the photos' names; pixel centres are at 0.5 (`freegeo.export.pixels`). Sizes and intrinsics of photos with
an EXIF rotation are those of the upright photo. Every point has two or more observations.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from freegeo.errors import FreeGeoError, UserError
from freegeo.export.base import Export, Format
from freegeo.export.pixels import corner_K, corner_pixels
from freegeo.export.reconstruction import Reconstruction

if TYPE_CHECKING:
    from freegeo.fusion.tracks import Tracks

FOLDER = Path("colmap") / "sparse" / "0"


def write_colmap(reconstruction: Reconstruction, tracks: Tracks, folder: Path) -> list[Path]:
    """Write the binary model to `folder`, replacing the one there, and return its files.

    Args:
        reconstruction: cameras and photos.
        tracks: points of it, from `fusion.tracks.build_tracks`.
        folder: of the model.

    Raises:
        UserError: pycolmap is not installed, or the folder cannot be written to.
        FreeGeoError: there is no track.
    """
    pycolmap = _pycolmap()
    if len(tracks) == 0:
        raise FreeGeoError(f"{folder}: no point is seen by two views. Use photos that overlap, or loosen the filters.")
    model = _model(pycolmap, reconstruction, tracks)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    except OSError as error:
        raise UserError(f"{folder}: the folder cannot be written to ({error.strerror}). Choose another one.") from None
    try:
        part.chmod(0o755)
        model.write_binary(str(part))
        if folder.exists():
            shutil.rmtree(folder)
        part.rename(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return sorted(folder.iterdir())


def _pycolmap() -> ModuleType:
    try:
        import pycolmap
    except ImportError:
        raise UserError("The COLMAP export needs an extra: pip install 'freegeo[colmap]'.") from None
    return pycolmap


def _model(pycolmap: ModuleType, reconstruction: Reconstruction, tracks: Tracks):
    model = pycolmap.Reconstruction()
    places = corner_pixels(reconstruction, tracks.view, tracks.pixel)
    position = np.zeros(len(tracks.view), np.int64)  # of each observation in its image's list
    T_cam_world, K = reconstruction.cameras()[0], corner_K(reconstruction)
    for view, name in enumerate(reconstruction.names):
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


def _write(export: Export) -> list[Path]:
    from freegeo.fusion.tracks import build_tracks

    r = export.reconstruction
    T_cam_world, K = r.cameras()
    tracks = build_tracks(
        r.depth_z, T_cam_world, K, r.images, export.keep, tolerance=export.tolerance, max_points=export.max_tracks,
        seed=export.seed,
    )  # fmt: skip
    return write_colmap(r, tracks, export.folder / FOLDER)


FORMAT = Format(name="colmap", path=FOLDER.parts[0], about="COLMAP model with tracks", write=_write)
