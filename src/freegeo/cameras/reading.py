"""Known cameras of photos, from a file or folder in any of the formats.

Reading checks what a file says by itself, brings names, sizes and EXIF turns together with the photos, and returns
cameras in the order of the photos. Whether the poses were read as they were meant is `check_convention`'s matter.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from freegeo.cameras.base import CameraFile, FileCamera
from freegeo.cameras.convention import READINGS, pose_of
from freegeo.cameras.formats import choose_format
from freegeo.cameras.known import KnownCamera, KnownCameras, Lens
from freegeo.cameras.names import match_names
from freegeo.cameras.undistortion import require_lens
from freegeo.data.image_files import opened, orientation
from freegeo.data.photos import some_of
from freegeo.errors import FreeGeoError, UserError

if TYPE_CHECKING:
    from freegeo.types import PhotoLike

__all__ = ["read_camera_file", "read_cameras"]

logger = logging.getLogger(__name__)

LONGEST_SIDE = 1_000_000
"""Pixels of a side beyond which a number is no size of an image."""
ROTATION_TOLERANCE = 1e-3
"""Largest entry of R^T R - 1 that counts as rounding."""
SMALLEST_FOCAL = 0.05
"""Focal length, in longest sides, below which a number is no focal length in pixels."""
QUARTER_TURNS = {1: 0, 6: 1, 3: 2, 8: 3}
"""Quarter turns clockwise that make a photo upright, for each EXIF orientation without a mirror."""
UPRIGHT = 1


def read_cameras(
    path: Path | str,
    photos: Sequence[PhotoLike],
    *,
    format: str | None = None,
    metric: bool = False,
    convention: str | None = None,
) -> KnownCameras:
    """Read the cameras of photos; photos that the file leaves out have none, which a warning says.

    Args:
        path: a file, or a folder: a COLMAP project, a model of it, or poses in one file each.
        photos: upright, as everywhere.
        format: name of a format (`freegeo.cameras.formats.FORMATS`); None: by content.
        metric: lengths are metres. Files that say so themselves need no word.
        convention: how pose matrices are meant, a key of `READINGS`; None: as the format is documented.

    Raises:
        UserError: the file cannot be used, belongs to other photos, or contradicts them; one sentence says how.
    """
    file, reading = _content(Path(path), format, convention)
    chosen = match_names(file, photos)
    cameras = []
    for photo, camera in zip(photos, chosen, strict=True):
        cameras.append(
            KnownCamera() if camera is None else _of_photo(_checked(camera, file, reading, photo), file, photo)
        )
    names = tuple(photo.name for photo in photos)
    known = KnownCameras(
        names=names, cameras=tuple(cameras), source=file.source, metric=metric or file.metric, convention=reading
    )
    _say_partial(file, photos, chosen)
    _refuse_identical(known)
    return known


def read_camera_file(
    path: Path | str,
    *,
    format: str | None = None,
    metric: bool = False,
    convention: str | None = None,
) -> KnownCameras:
    """Read all cameras of a file as they are, without photos: names, sizes and order are the file's.

    Arguments and errors as `read_cameras`.
    """
    file, reading = _content(Path(path), format, convention)
    known = KnownCameras(
        names=tuple(camera.name for camera in file.cameras),
        cameras=tuple(_checked(camera, file, reading, None) for camera in file.cameras),
        source=file.source,
        metric=metric or file.metric,
        convention=reading,
    )
    _refuse_identical(known)
    return known


def _content(path: Path, name: str | None, convention: str | None) -> tuple[CameraFile, str]:
    if convention is not None and convention not in READINGS:
        raise UserError(f"{convention}: no reading of poses. Choose one of {', '.join(READINGS)}.")
    chosen, place = choose_format(path.expanduser(), name)
    try:
        file = chosen.read(place)
    except UserError:
        raise
    except FreeGeoError as error:
        # Damaged input of the user's, as any other.
        raise UserError(str(error)) from None
    if not file.cameras:
        raise UserError(f"{file.source}: the file holds no camera.")
    names = [camera.name for camera in file.cameras]
    seen: set[str] = set()
    for one in names:
        if one in seen:
            raise UserError(f"{file.source}: {one} is listed twice. Keep one camera for each photo.")
        seen.add(one)
    reading = convention or chosen.reading
    logger.info(
        "%s: %d cameras as %s%s", file.source, len(names), chosen.name,
        f", poses {READINGS[reading]}" if any(camera.matrix is not None for camera in file.cameras) else "",
    )  # fmt: skip
    return file, reading


def _checked(camera: FileCamera, file: CameraFile, reading: str, photo: PhotoLike | None) -> KnownCamera:
    """Return a camera of a file whose numbers make sense by themselves; UserError otherwise."""
    where = f"{file.source}: the camera of {camera.name}"
    size = camera.size_hw
    if size is not None and not 1 <= min(size) <= max(size) <= LONGEST_SIDE:
        raise UserError(f"{where} is of an image with a side that is not between 1 and {LONGEST_SIDE:,} pixels.")
    K = camera.K
    if camera.angle_x is not None:
        if photo is None:
            raise UserError(f"{where} has a field of view and no size of its image. Name the photos with --photos.")
        size = photo.size_hw
        K = _K_of_angle(camera.angle_x, size, where)
    pose = None if camera.matrix is None else pose_of(_rigid(camera.matrix, where), reading)
    if K is not None:
        _check_K(K, size or (None if photo is None else photo.size_hw), where)
    if camera.lens is not None:
        if K is None:
            raise UserError(f"{where} has distortion without intrinsics.")
        try:
            require_lens(camera.lens)
        except UserError as error:
            raise UserError(f"{where}: {error}") from None
    return KnownCamera(T_cam_world=pose, K=K, lens=camera.lens, size_hw=size, ids=camera.ids)


def _K_of_angle(angle: float, size_hw: tuple[int, int], where: str) -> np.ndarray:
    if not 0 < angle < np.pi:
        raise UserError(f"{where} has a horizontal field of view of {angle:g}, which is not between 0 and pi radians.")
    height, width = size_hw
    focal = width / 2 / np.tan(angle / 2)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def _check_K(K: np.ndarray, size: tuple[int, int] | None, where: str) -> None:
    if not np.isfinite(K).all():
        raise UserError(f"{where} has intrinsics that are not finite.")
    if not np.array_equal(K[2], (0, 0, 1)) or K[1, 0] != 0:
        raise UserError(f"{where} has intrinsics that are not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].")
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    if fx <= 0 or fy <= 0:
        raise UserError(f"{where} has a focal length that is not positive ({min(fx, fy):g}).")
    if abs(K[0, 1]) > 1e-3 * fx:
        raise UserError(f"{where} has skewed pixels ({K[0, 1]:g}), which no model here knows.")
    if size is None:
        return
    height, width = size
    if min(fx, fy) < SMALLEST_FOCAL * max(size):
        raise UserError(
            f"{where} has a focal length of {min(fx, fy):.3g} for an image of {width} x {height}: give intrinsics in "
            "pixels, not in shares of the image or in millimetres."
        )
    if not (0 <= cx <= width and 0 <= cy <= height):
        raise UserError(
            f"{where} has its principal point ({cx:.1f}, {cy:.1f}) outside the image of {width} x {height} pixels."
        )


def _rigid(matrix: np.ndarray, where: str) -> np.ndarray:
    """Return a rigid matrix with a rotation exact to rounding; UserError for one that is none."""
    if not np.isfinite(matrix).all():
        raise UserError(f"{where} has a pose that is not finite. Take it out of the file.")
    if not np.allclose(matrix[3], (0, 0, 0, 1), rtol=0, atol=1e-9):
        raise UserError(f"{where} has a pose whose last row is not 0 0 0 1; is the matrix transposed?")
    R = matrix[:3, :3]
    determinant = float(np.linalg.det(R))
    square = R.T @ R
    scale = float(np.trace(square)) / 3
    if scale <= 0 or np.abs(square / max(scale, 1e-300) - np.eye(3)).max() > ROTATION_TOLERANCE:
        raise UserError(f"{where} has a pose whose left part is no rotation.")
    if determinant < 0:
        raise UserError(f"{where} has mirrored axes (determinant {determinant:.3g}). Export right-handed poses.")
    if abs(scale - 1) > ROTATION_TOLERANCE:
        raise UserError(
            f"{where} has a rotation that is scaled by {scale**0.5:.4g}. Divide the left part of the pose by that."
        )
    u, _, vh = np.linalg.svd(R)
    rigid = matrix.copy()
    rigid[:3, :3] = u @ vh
    rigid[3] = (0, 0, 0, 1)
    return rigid


def _of_photo(camera: KnownCamera, file: CameraFile, photo: PhotoLike) -> KnownCamera:
    """Bring a camera to the size of its photo, and turn it as the photo was turned to be upright."""
    where, exif = f"{file.source}: {photo.name}", _exif_orientation(photo)
    turns = _turns(camera, file, photo, exif, where)
    if turns:
        camera = _turned(camera, turns)
    if camera.K is None:
        return replace(camera, size_hw=photo.size_hw)
    if camera.size_hw is None or camera.size_hw == photo.size_hw:
        return replace(camera, size_hw=photo.size_hw)
    scale = np.array(photo.size_hw[::-1]) / np.array(camera.size_hw[::-1])
    K = camera.K.copy()
    K[:2] *= scale[:, None]
    return replace(camera, K=K, size_hw=photo.size_hw)


def _exif_orientation(photo: PhotoLike) -> int:
    """Orientation 1 to 8 by which a photo's file was turned; 1 for photos without a file."""
    path = getattr(photo, "path", None)
    if not isinstance(path, Path):
        return UPRIGHT
    with opened(path) as image:
        return orientation(image) or UPRIGHT


def _turns(camera: KnownCamera, file: CameraFile, photo: PhotoLike, exif: int, where: str) -> int:
    """Quarter turns clockwise from the file's image to the upright photo; UserError where they cannot be known."""
    if camera.size_hw is not None:
        upright = _same_shape(camera.size_hw, photo.size_hw)
        sideways = _same_shape(camera.size_hw[::-1], photo.size_hw)
    else:
        upright = sideways = True
    size = None if camera.size_hw is None else f"{camera.size_hw[1]} x {camera.size_hw[0]}"
    if not upright and not (sideways and exif in (6, 8)):
        raise UserError(
            f"{where} is {photo.size_hw[1]} x {photo.size_hw[0]} pixels, and its camera is of an image of {size}, "
            "which has another shape: a photo that was cut or turned. Give the photos that the cameras are of."
        )
    if exif == UPRIGHT or (camera.K is None and camera.T_cam_world is None):
        return 0
    if not upright:
        return QUARTER_TURNS[exif]
    if (exif in (5, 6, 7, 8) and not sideways) or file.upright:
        return 0
    raise UserError(
        f"{where} is turned by its EXIF data, and it cannot be known whether its camera is that of the upright photo. "
        "Save the photos upright, without that entry, if it is."
    )


def _same_shape(old_hw: tuple[int, int], new_hw: tuple[int, int]) -> bool:
    """Whether one image is the other resized, when the smaller one's sides are rounded to pixels."""
    small, large = sorted((old_hw, new_hw))
    low = max((one - 1) / other for one, other in zip(small, large, strict=True))
    high = min((one + 1) / other for one, other in zip(small, large, strict=True))
    return low < high


def _turned(camera: KnownCamera, turns: int) -> KnownCamera:
    """Turn a camera with its image, `turns` quarters clockwise about the optical axis."""
    for _ in range(turns):
        camera = _turned_once(camera)
    return camera


def _turned_once(camera: KnownCamera) -> KnownCamera:
    """Right becomes down, and down becomes left: (x, y) is at (height - y, x) afterwards."""
    pose, K, lens, size = camera.T_cam_world, camera.K, camera.lens, camera.size_hw
    if pose is not None:
        pose = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) @ pose
    if K is not None:
        assert size is not None
        K = np.array([[K[1, 1], 0, size[0] - K[1, 2]], [0, K[0, 0], K[0, 2]], [0, 0, 1]])
    if lens is not None and lens.model in ("OPENCV", "FULL_OPENCV"):
        k1, k2, p1, p2, *rest = lens.params
        # Tangential distortion is the vector (p2, p1) in the image, which turns with it.
        lens = Lens(lens.model, (k1, k2, p2, -p1, *rest))
    return replace(camera, T_cam_world=pose, K=K, lens=lens, size_hw=None if size is None else size[::-1])


def _say_partial(file: CameraFile, photos: Sequence[PhotoLike], chosen: Sequence[FileCamera | None]) -> None:
    without = [photo.name for photo, camera in zip(photos, chosen, strict=True) if camera is None]
    if without:
        logger.warning(
            "%s has cameras of %d of %d photos; unknown: %s.", file.source, len(photos) - len(without), len(photos),
            some_of(without),
        )  # fmt: skip
    used = {id(camera) for camera in chosen if camera is not None}
    spare = [camera.name for camera in file.cameras if id(camera) not in used]
    if spare:
        logger.info("%s: %d cameras are of no photo here: %s", file.source, len(spare), some_of(spare))


def _refuse_identical(known: KnownCameras) -> None:
    """Raise UserError when several photos were all taken by one and the same pose, which no scene can be made of."""
    poses = [one.T_cam_world for one in known.cameras if one.T_cam_world is not None]
    if len(poses) > 1 and all(np.allclose(pose, poses[0], rtol=0, atol=1e-12) for pose in poses[1:]):
        raise UserError(f"{known.source}: all {len(poses)} cameras have the same pose. Give the poses of the photos.")
