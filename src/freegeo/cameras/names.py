"""Which camera of a file belongs to which photo."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from freegeo.cameras.base import CameraFile, FileCamera
from freegeo.data.image_files import IMAGE_SUFFIXES
from freegeo.data.photos import some_of
from freegeo.errors import UserError

if TYPE_CHECKING:
    from freegeo.types import PhotoLike

logger = logging.getLogger(__name__)

__all__ = ["match_names"]

_COLOUR = (".color", ".colour", ".rgb")
"""What some recorders put between a frame's name and the ending of its photo."""
_SAME_TIME = 1e-6


def match_names(file: CameraFile, photos: Sequence[PhotoLike]) -> list[FileCamera | None]:
    """Return the camera of each photo, None where the file has none.

    UserError when no photo has a camera, or a photo's camera cannot be told.
    """
    if file.by == "order":
        return _in_order(file, photos)
    if file.by == "time":
        return _by_time(file, photos)
    return _by_name(file, photos)


def _in_order(file: CameraFile, photos: Sequence[PhotoLike]) -> list[FileCamera | None]:
    if len(file.cameras) != len(photos):
        raise UserError(
            f"{file.source}: {len(file.cameras)} poses without names for {len(photos)} photos. They are matched in "
            "order, so give as many photos as poses (--max-views limits the photos)."
        )
    return list(file.cameras)


def _by_time(file: CameraFile, photos: Sequence[PhotoLike]) -> list[FileCamera | None]:
    """Match time stamps with names that are numbers; in order where they do not fit and the counts agree."""
    times = {float(camera.name): camera for camera in file.cameras}
    chosen = [_at_time(times, photo) for photo in photos]
    if all(camera is not None for camera in chosen):
        return chosen
    # Counting from 0 and from 1 makes nearly all numbers agree: the order is right, the numbers are not.
    if len(file.cameras) == len(photos):
        logger.info("%s: the time stamps are not the names of the photos, and are matched in order", file.source)
        return list(file.cameras)
    if any(camera is not None for camera in chosen):
        return chosen
    raise UserError(
        f"{file.source}: {len(file.cameras)} time stamps such as {file.cameras[0].name}, of which none is the name of "
        f"one of the {len(photos)} photos, such as {photos[0].name}. Name photos after time stamps, or give as many."
    )


def _at_time(times: dict[float, FileCamera], photo: PhotoLike) -> FileCamera | None:
    try:
        time = float(_parts(photo.name)[-1])
    except ValueError:
        return None
    if time in times:
        return times[time]
    return next((camera for stamp, camera in times.items() if abs(stamp - time) < _SAME_TIME), None)


def _by_name(file: CameraFile, photos: Sequence[PhotoLike]) -> list[FileCamera | None]:
    by_stem: dict[str, list[FileCamera]] = defaultdict(list)
    for camera in file.cameras:
        by_stem[_parts(camera.name)[-1]].append(camera)
    chosen: list[FileCamera | None] = []
    for photo in photos:
        chosen.append(_best(by_stem.get(_parts(photo.name)[-1], []), photo, file))
    if all(camera is None for camera in chosen):
        raise UserError(
            f"{file.source}: its cameras are of other photos: it names "
            f"{some_of([camera.name for camera in file.cameras][:3])}, and the photos are "
            f"{some_of([photo.name for photo in photos][:3])}."
        )
    owners: dict[int, str] = {}
    for photo, camera in zip(photos, chosen, strict=True):
        if camera is not None and id(camera) in owners:
            raise UserError(
                f"{file.source}: the camera {camera.name} fits the photos {owners[id(camera)]} and {photo.name}. Name "
                "cameras with as many folders as it takes to tell photos apart."
            )
        if camera is not None:
            owners[id(camera)] = photo.name
    return chosen


def _best(candidates: Sequence[FileCamera], photo: PhotoLike, file: CameraFile) -> FileCamera | None:
    """Return the camera whose path agrees with the photo's for longest, endings last; UserError for a tie."""
    if not candidates:
        return None
    ranked = sorted(candidates, key=lambda camera: _likeness(camera.name, photo), reverse=True)
    if len(ranked) > 1 and _likeness(ranked[0].name, photo) == _likeness(ranked[1].name, photo):
        raise UserError(
            f"{file.source}: the photo {photo.name} may be {ranked[0].name} or {ranked[1].name}. Give the photos with "
            "their folders, or a file with the cameras of these photos only."
        )
    return ranked[0]


def _likeness(name: str, photo: PhotoLike) -> tuple[int, bool]:
    """Parts at the end that two paths have in common, and whether the file names are the same with their endings."""
    path = getattr(photo, "path", None)
    whole = path.absolute().as_posix() if isinstance(path, Path) else photo.name
    common = 0
    for one, other in zip(reversed(_parts(name)), reversed(_parts(whole)), strict=False):
        if one != other:
            break
        common += 1
    return common, PurePosixPath(name).name == PurePosixPath(whole).name


def _parts(name: str) -> list[str]:
    """Return the parts of a path, the last without the ending of an image."""
    parts = list(PurePosixPath(name.replace("\\", "/")).parts) or [""]
    last = PurePosixPath(parts[-1])
    stem = last.stem if last.suffix.lower() in IMAGE_SUFFIXES else last.name
    for ending in _COLOUR:
        stem = stem.removesuffix(ending)
    return [*parts[:-1], stem]
