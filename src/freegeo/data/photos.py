"""A user's photos: files, a video, or images in memory; in natural order, upright, as 8-bit RGB."""

from __future__ import annotations

import glob
import logging
import re
import warnings
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from freegeo.data.video import is_video, load_video
from freegeo.errors import UserError

if TYPE_CHECKING:
    from PIL.Image import Image as PillowImage

    from freegeo.types import PhotoLike

    PhotoSource = str | Path | np.ndarray | PillowImage | Iterable[str | Path | np.ndarray | PillowImage | PhotoLike]
    """What `load_photos` takes."""

logger = logging.getLogger(__name__)

PHOTO_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff"})
HEIF_SUFFIXES = frozenset({".heic", ".heif"})
MAX_PIXELS = 150_000_000
"""Largest photo that is read; beyond it a decoded photo takes more than half a gigabyte."""
MAX_VIEWS = 32
"""Default limit of the photos that are used of a source."""
_SYSTEM_FILES = frozenset({"thumbs.db", "desktop.ini"})
_ORIENTATION_TAG, _SIDEWAYS = 0x0112, (5, 6, 7, 8)


@dataclass(frozen=True)
class Photo:
    """One photo on disk; pixels are decoded at each `read`."""

    name: str
    path: Path
    size_hw: tuple[int, int]
    """Height and width after EXIF rotation."""

    def read(self) -> np.ndarray:
        """Decode to upright RGB (H, W, 3) uint8; transparent pixels become white."""
        from PIL import ImageOps

        with _opened(self.path) as image:
            pixels = np.array(_to_rgb(ImageOps.exif_transpose(image)))
        if pixels.shape[:2] != self.size_hw:
            raise UserError(
                f"{self.path}: the image is damaged (its header says {self.size_hw[1]} x {self.size_hw[0]} pixels, "
                f"it has {pixels.shape[1]} x {pixels.shape[0]}). Replace it or take it out."
            )
        return pixels


@dataclass(frozen=True, eq=False)
class MemoryPhoto:
    """One photo in memory."""

    name: str
    pixels: np.ndarray
    """(H, W, 3) uint8 RGB, upright."""

    @property
    def size_hw(self) -> tuple[int, int]:
        """Height and width."""
        return self.pixels.shape[0], self.pixels.shape[1]

    def read(self) -> np.ndarray:
        """Return the pixels (H, W, 3) uint8."""
        return self.pixels


def load_photos(source: PhotoSource, max_views: int = MAX_VIEWS, *, fps: float | None = None) -> list[PhotoLike]:
    """Find the photos of a source and keep at most `max_views` of them, evenly spaced.

    Args:
        source: a folder, a pattern such as `photos/*.jpg` (both in natural name order), a video, a photo, or a list of
            photo files, PIL images and arrays (H, W, 3) uint8. `~` stands for the home folder. Images in memory are
            named after their place in the list: `image-000`, `image-001`, ... A list that this function returned is
            used whole, whatever `max_views` is.
        max_views: most photos to keep; frames of a video are chosen by sharpness and parallax instead of evenly.
        fps: videos only: take a frame this often per second.

    Raises:
        UserError: a file is missing, unreadable, no photo, or larger than `MAX_PIXELS`, or an image in memory is not
            of the kind above; the message names it.
    """
    if max_views < 1:
        raise UserError(f"--max-views must be at least 1, got {max_views}.")
    if isinstance(source, str | Path) and is_video(source):
        return list(load_video(Path(source).expanduser(), fps=fps, max_views=max_views))
    if fps is not None:
        raise UserError("--fps is for videos; the source is none.")
    if isinstance(source, list | tuple) and source and all(map(_is_photo, source)):
        return _named_once([item for item in source if _is_photo(item)])
    found = find_photos(source)
    if len(found) > max_views:
        logger.info("%d photos found, %d kept, evenly spaced (--max-views)", len(found), max_views)
        found = [found[i] for i in evenly_spaced(len(found), max_views)]
    paths = [item for item in found if isinstance(item, Path)]
    names = dict(zip(paths, unique_names(paths), strict=True))
    return _named_once([Photo(names[item], item, _size_hw(item)) if isinstance(item, Path) else item for item in found])


def _is_photo(item: Any) -> TypeGuard[PhotoLike]:
    return all(hasattr(item, name) for name in ("name", "size_hw", "read"))


def _named_once(photos: Sequence[PhotoLike]) -> list[PhotoLike]:
    """Return the photos; UserError when two have the same name."""
    names = [photo.name for photo in photos]
    twice = next((name for i, name in enumerate(names) if name in names[:i]), None)
    if twice is not None:
        raise UserError(f"two photos have the name {twice}. Name each photo once.")
    return list(photos)


def evenly_spaced(count: int, keep: int) -> list[int]:
    """Return `keep` distinct indices of `range(count)`, first and last included (the first alone for keep = 1)."""
    return [round(i) for i in np.linspace(0, count - 1, min(count, keep))]


def find_photos(source: PhotoSource) -> Sequence[Path | PhotoLike]:
    """List the photos of a source; a list keeps its order, a folder or pattern is sorted naturally."""
    if isinstance(source, str | Path):
        return _found_files(source)
    if _is_pillow(source) or (isinstance(source, np.ndarray) and source.ndim < 4):
        source = [source]
    if not isinstance(source, Iterable):
        raise UserError(
            f"photos are a folder, a pattern, a video, or a list of files or images, not {_kind(source)}. "
            "See freegeo.load_photos."
        )
    return [_listed(item, position) for position, item in enumerate(source)] or _no_photos("the list of photos")


def _found_files(source: str | Path) -> list[Path]:
    if not str(source):
        raise UserError("the name of the photos is empty. Give a folder of photos, a glob or a photo.")
    path = Path(source).expanduser()
    if path.is_dir():
        return _folder_photos(path)
    if path.is_file():
        return [_checked_file(path)]
    if glob.has_magic(str(source)):
        matches = [Path(found) for found in glob.glob(str(path), recursive=True)]  # noqa: PTH207 (absolute patterns too)
        return sorted((_checked_file(p) for p in matches if p.is_file()), key=natural_key) or _no_photos(str(source))
    raise UserError(f"{source}: no such folder, file or pattern. Give a folder of photos, a glob or a photo.")


def _listed(item: Any, position: int) -> Path | PhotoLike:
    """Return an element of a list of photos as a file or a photo in memory."""
    name = f"image-{position:03d}"
    if isinstance(item, str | Path):
        return _checked_file(Path(item).expanduser())
    if isinstance(item, np.ndarray):
        if item.dtype != np.uint8 or item.ndim != 3 or item.shape[2] != 3 or not item.size:
            raise UserError(
                f"{name} is an array of {item.dtype} and shape {item.shape}; "
                "give arrays of uint8 and shape (height, width, 3), RGB from 0 to 255."
            )
        return MemoryPhoto(name, item.copy())
    if _is_pillow(item):
        from PIL import ImageOps

        return MemoryPhoto(name, np.array(_to_rgb(ImageOps.exif_transpose(item))))
    if _is_photo(item):
        return item
    raise UserError(
        f"element {position} of the photos is {_kind(item)}; give file names, PIL images or uint8 arrays (H, W, 3)."
    )


def _is_pillow(item: Any) -> TypeGuard[PillowImage]:
    from PIL import Image

    return isinstance(item, Image.Image)


def _kind(value: object) -> str:
    return "None" if value is None else f"of the type {type(value).__name__}"


def natural_key(path: Path) -> list[tuple[int, int | str]]:
    """Sort key that puts frame2 before frame10."""
    return [(0, int(part)) if part.isdecimal() else (1, part.lower()) for part in re.split(r"(\d+)", str(path)) if part]


def unique_names(paths: Sequence[Path]) -> list[str]:
    """Return file names, with as many parent folders as needed to make them unique."""
    for depth in range(1, max((len(p.parts) for p in paths), default=1) + 1):
        names = ["/".join(path.parts[-depth:]) for path in paths]
        if len(set(names)) == len(names):
            return names
    twice = next(str(p) for i, p in enumerate(paths) if p in paths[:i])
    raise UserError(f"{twice} is listed twice. Name each photo once.")


def _no_photos(where: str) -> list[Path]:
    raise UserError(f"{where}: no photos found. Supported are {_supported()}.")


def _supported() -> str:
    return "JPEG, PNG, WebP and TIFF (HEIC with pip install 'freegeo[heif]')"


def _folder_photos(folder: Path) -> list[Path]:
    files = [p for p in folder.iterdir() if p.is_file() and not p.name.startswith(".")]
    files = sorted((p for p in files if p.name.lower() not in _SYSTEM_FILES), key=natural_key)
    strangers = [p for p in files if p.suffix.lower() not in PHOTO_SUFFIXES | HEIF_SUFFIXES]
    if strangers and len(strangers) < len(files):
        raise UserError(
            f"{folder}: {len(strangers)} of {len(files)} files are no photos (first: {strangers[0].name}). "
            f"Move them away, or choose the photos with a pattern such as '{folder}/*{_photo_suffix(files)}'."
        )
    return [p for p in files if p not in strangers] or _no_photos(str(folder))


def _photo_suffix(files: Sequence[Path]) -> str:
    return next(p.suffix for p in files if p.suffix.lower() in PHOTO_SUFFIXES | HEIF_SUFFIXES)


def _checked_file(path: Path) -> Path:
    if path.is_dir():
        raise UserError(f"{path}: a folder among several sources. Give one folder alone, or a list of photo files.")
    if not path.is_file():
        raise UserError(f"{path}: no such file. Check the name.")
    if path.suffix.lower() not in PHOTO_SUFFIXES | HEIF_SUFFIXES:
        raise UserError(f"{path}: not a photo. Supported are {_supported()}.")
    return path


def load_masks(folder: Path, names: Sequence[str]) -> list[np.ndarray]:
    """Read one mask (H, W) uint8 for each photo name from a folder, by the name without its ending.

    UserError when the folder or a mask is missing or unreadable.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder of masks.")
    files = {path.stem: path for path in sorted(folder.iterdir()) if path.suffix.lower() in PHOTO_SUFFIXES}
    missing = [name for name in names if Path(name).stem not in files]
    if missing:
        raise UserError(
            f"{folder}: {len(missing)} of {len(names)} photos have no mask (first: {missing[0]}). Name each mask as "
            "its photo, or leave --masks out."
        )
    masks = []
    for name in names:
        with _opened(files[Path(name).stem]) as image:
            masks.append(np.array(image.convert("L")))
    return masks


@contextmanager
def _opened(path: Path) -> Generator:
    from PIL import Image, UnidentifiedImageError

    if path.suffix.lower() in HEIF_SUFFIXES:
        _register_heif(path)
    try:
        with warnings.catch_warnings():
            # Pillow warns at a limit of its own, and refuses at twice that; only `MAX_PIXELS` applies here.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(path)
        with image:
            if image.width * image.height > MAX_PIXELS:
                raise _too_large(path, f"{image.width} x {image.height} pixels are")
            yield image
    except UserError:
        raise
    except UnidentifiedImageError:
        raise UserError(f"{path}: the file is not a readable image. Replace it or take it out.") from None
    except Image.DecompressionBombError:
        raise _too_large(path, "its pixels are") from None
    except (OSError, SyntaxError, EOFError, ValueError, RuntimeError) as error:
        # The decoders of Pillow and of its plug-ins raise different errors for damaged files.
        reason = " ".join(str(error).split())
        raise UserError(f"{path}: the image is damaged or truncated ({reason}). Replace it or take it out.") from None


def _too_large(path: Path, what: str) -> UserError:
    limit = MAX_PIXELS // 1_000_000
    return UserError(f"{path}: {what} more than the limit of {limit} megapixels. Shrink the photo first.")


def _register_heif(path: Path) -> None:
    try:
        import pillow_heif
    except ImportError:
        raise UserError(f"{path}: HEIC photos need an extra: pip install 'freegeo[heif]'.") from None
    pillow_heif.register_heif_opener()


def _size_hw(path: Path) -> tuple[int, int]:
    with _opened(path) as image:
        # Pillow gives the size of a TIFF as it is after rotation, of everything else as it is stored.
        turned = image.format != "TIFF" and image.getexif().get(_ORIENTATION_TAG) in _SIDEWAYS
        return (image.width, image.height) if turned else (image.height, image.width)


def _to_rgb(image):
    from PIL import Image

    if image.mode in ("I;16", "I;16B", "I;16L", "I"):
        # Pillow clips 16-bit values when it converts them; photos need them scaled.
        return Image.fromarray(
            (np.asarray(image, dtype=np.float64) / 257).round().clip(0, 255).astype(np.uint8)
        ).convert("RGB")
    if "A" in image.getbands() or "transparency" in image.info:
        image = image.convert("RGBA")
        white = Image.new("RGBA", image.size, "white")
        return Image.alpha_composite(white, image).convert("RGB")
    return image.convert("RGB")
