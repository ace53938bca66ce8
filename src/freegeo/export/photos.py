"""Upright copies of the photos for tools that read pixels as they are stored, and records of where the photos are.

COLMAP, nerfstudio and the trainers of Gaussian splats do not turn photos by their EXIF orientation, and read neither
HEIC nor 16-bit values as freegeo does. What they can read as it is, is copied byte by byte; the rest is encoded anew.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from freegeo import files
from freegeo.data.image_files import opened
from freegeo.errors import FreeGeoError, UserError

if TYPE_CHECKING:
    import numpy as np

    from freegeo.types import PhotoLike

FOLDER = "images"
JPEG_QUALITY = 95
_KINDS = {".jpg": ("JPEG", "MPO"), ".jpeg": ("JPEG", "MPO"), ".png": ("PNG",)}
_LOSSY = frozenset({".jfif", ".jpe", ".mpo", ".heic", ".heif", ".webp", ".avif"})
_ORIENTATION_TAG = 0x0112


def copy_names(names: Sequence[str]) -> list[str]:
    """File names of the copies, relative to their folder: JPEG and PNG keep theirs, other kinds become one of these."""
    return new_names(names, [_copy_suffix(PurePosixPath(name).suffix) for name in names])


def _copy_suffix(suffix: str) -> str:
    kept = suffix.lower()
    return suffix if kept in _KINDS else ".jpg" if kept in _LOSSY else ".png"


def new_names(names: Sequence[str], suffixes: Sequence[str]) -> list[str]:
    """Return file names with other suffixes, all different and none too long for a file.

    Where photos differ in the suffix only, the new suffix is added to the old one. Errors as `check_names`.
    """
    check_names(names)
    pairs = list(zip(names, suffixes, strict=True))
    short = [str(PurePosixPath(name).with_suffix(suffix)) for name, suffix in pairs]
    added = [name if name.endswith(suffix) else name + suffix for name, suffix in pairs]
    every = [name + suffix for name, suffix in pairs]
    chosen = next(found for found in (short, added, every) if len(set(found)) == len(names))
    return [files.fitted(name) for name in chosen]


def check_names(names: Sequence[str]) -> None:
    """Raise UserError for a photo's name that cannot be a file below a folder."""
    for name in names:
        files.inside(Path(FOLDER), name)


def write_copies(photos: Sequence[PhotoLike], folder: Path) -> list[Path]:
    """Write upright 8-bit copies of photos, in place of earlier ones; FreeGeoError when one can no longer be read."""
    from PIL import Image

    names = copy_names([photo.name for photo in photos])
    with files.atomic_files(folder, names) as paths:
        for photo, path in zip(photos, paths, strict=True):
            stored = _readable_as_stored(photo, path.suffix.lower())
            if stored is not None:
                path.write_bytes(stored)
            elif path.suffix.lower() == ".png":
                Image.fromarray(pixels_of(photo)).save(path, compress_level=1)
            else:
                Image.fromarray(pixels_of(photo)).save(path, quality=JPEG_QUALITY, subsampling=0)
    return [folder / name for name in names]


def _readable_as_stored(photo: PhotoLike, suffix: str) -> bytes | None:
    """Return the content of a photo's file if every reader takes its pixels as `photo.read` does."""
    path = own_file(photo)
    if path is None or path.suffix.lower() != suffix:
        return None
    try:
        content = path.read_bytes()
        with opened(path) as image:
            upright = image.getexif().get(_ORIENTATION_TAG, 1) == 1
            plain = image.mode in ("RGB", "L") and "transparency" not in image.info
            as_named = image.format in _KINDS[suffix] and image.size == photo.size_hw[::-1]
    except (OSError, SyntaxError, ValueError, TypeError, KeyError):  # among them that it is no image any more
        # Pillow raises different errors for odd metadata; decoding and encoding anew leaves it behind.
        return None
    return content if upright and plain and as_named else None


def pixels_of(photo: PhotoLike) -> np.ndarray:
    """Return the upright pixels (H, W, 3) uint8 of a photo; FreeGeoError when it can no longer be read."""
    try:
        return photo.read()
    except UserError as error:
        raise FreeGeoError(str(error)) from None


def link_copies(copies: Sequence[Path], names: Sequence[str], folder: Path) -> list[Path]:
    """Put copies that were written elsewhere into another folder too, without taking their space again if possible."""
    names = copy_names(names)
    with files.atomic_files(folder, names) as paths:
        for copy, path in zip(copies, paths, strict=True):
            try:
                os.link(copy, path)
            except OSError:
                shutil.copyfile(copy, path)
    return [folder / name for name in names]


def own_file(photo: PhotoLike) -> Path | None:
    """Return the image file that a photo is; None for frames of a video and images in memory."""
    path = getattr(photo, "path", None)
    return path if isinstance(path, Path) and path.name == PurePosixPath(photo.name).name else None


def photo_records(photos: Sequence[PhotoLike]) -> list[dict[str, Any] | None]:
    """Return file and content hash of each photo, by which a later export finds it; None where there is no file."""
    found = [own_file(photo) for photo in photos]
    return [
        {"file": str(file.absolute()), "sha256": content_hash(file)} if file is not None and file.is_file() else None
        for file in found
    ]


def content_hash(file: Path) -> str:
    """Return the SHA-256 of a file."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
