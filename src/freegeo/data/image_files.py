"""Image files, told by their content, as upright 8-bit RGB; what cannot be read is an `UnreadableImageError`."""

from __future__ import annotations

import errno
import struct
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from freegeo.errors import UserError

if TYPE_CHECKING:
    from PIL.Image import Image as PillowImage

FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "AVIF", "PPM", "GIF", "JPEG2000")
"""The formats of Pillow that are read (MPO is a JPEG). Others are not tried: some of them start programs or guess."""
KINDS = "JPEG, PNG, WebP, TIFF, BMP, AVIF, PPM, GIF, JPEG 2000, and HEIC with pip install 'freegeo[heif]'"
HEIF_SUFFIXES = frozenset({".heic", ".heif", ".hif"})
IMAGE_SUFFIXES = HEIF_SUFFIXES | {
    ".jpg", ".jpeg", ".jpe", ".jfif", ".mpo", ".png", ".webp", ".tif", ".tiff", ".bmp", ".dib", ".avif", ".gif",
    ".ppm", ".pgm", ".pbm", ".pnm", ".jp2", ".j2k", ".jpx",
}  # fmt: skip
"""Endings of files that must be images; files with other endings are looked into."""
MAX_PIXELS = 150_000_000
"""Largest image that is read; beyond it a decoded image takes more than half a gigabyte."""

_DARK, _BRIGHT, _FLAT = 0.04, 0.97, 0.02
"""Mean brightness below and above which, and range of brightness below which, an image is blank."""
_HEAD = 30
"""Bytes at the beginning of a file that are looked at; those of a WebP with its size."""
_HEIF_BRANDS = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"})
_JPEGS, _MOST_PIXELS_IN_A_BYTE = ("JPEG", "MPO"), 512
"""Each block of 8 x 8 pixels takes a bit at least. A decoder makes grey of what is missing, without an error."""
_ORIENTATION_TAG, _SIDEWAYS = 0x0112, (5, 6, 7, 8)
_SIXTEEN_BITS, _FLOAT_SLACK = 65_535, 0.01
_DEEP_MODES = frozenset({"I;16", "I;16B", "I;16L", "I;16N", "I", "F"})
# The decoders of Pillow and of its plug-ins raise different errors for damaged files.
_DECODER_ERRORS = (
    OSError, SyntaxError, EOFError, ValueError, RuntimeError, TypeError, AttributeError, LookupError, ArithmeticError,
    struct.error,
)  # fmt: skip
_SHORTAGES = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOMEM})
"""Errors of the machine, which say nothing about the file that was to be read."""


class UnreadableImageError(UserError):
    """An image file that cannot be used, and why."""

    def __init__(self, path: Path | str, reason: str) -> None:
        super().__init__(f"{path}: {reason}. Replace it or take it out.")
        self.path = path
        self.reason = reason


@contextmanager
def opened(path: Path) -> Generator[PillowImage]:
    """Open an image file with Pillow, without decoding its pixels.

    `UnreadableImageError` when it is none, or larger than `MAX_PIXELS`; OSError when the machine has no memory or no
    handles left, which no other file would help against.
    """
    from PIL import Image, UnidentifiedImageError

    formats = _formats(path)
    width, height = _size_of_animation(path)
    if width * height > MAX_PIXELS:
        raise _too_large(path, f"{width} x {height} pixels are")
    try:
        with pillow_limit_off():
            image = Image.open(path, formats=formats)
    except UnidentifiedImageError:
        reason = (
            "the file is not a readable image" if path.suffix.lower() in IMAGE_SUFFIXES else f"not a photo ({KINDS})"
        )
        raise UnreadableImageError(path, reason) from None
    except Image.DecompressionBombError:
        raise _too_large(path, "its pixels are") from None
    except (*_DECODER_ERRORS, MemoryError) as error:
        raise _damaged(path, error) from None
    with image:
        if image.width * image.height > MAX_PIXELS:
            raise _too_large(path, f"{image.width} x {image.height} pixels are")
        size = path.stat().st_size
        if image.format in _JPEGS and image.width * image.height > _MOST_PIXELS_IN_A_BYTE * size:
            raise _damaged(path, f"{size} bytes are too few for a JPEG of {image.width} x {image.height} pixels")
        yield image


@contextmanager
def pillow_limit_off() -> Generator[None]:
    """Keep Pillow from warning at a limit of its own, so that only `MAX_PIXELS` applies.

    Threads that decode need this around all of them, since they share Python's list of warnings.
    """
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        yield


def is_image(path: Path) -> bool:
    """Whether the content of a file is that of an image which can be read."""
    try:
        with opened(path):
            return True
    except UnreadableImageError:
        return False


def _formats(path: Path) -> tuple[str, ...]:
    """Return the formats that a file may have."""
    named_image = path.suffix.lower() in IMAGE_SUFFIXES
    # Raw files of cameras are TIFF files whose first image is a thumbnail: other endings are no TIFF photos.
    formats = FORMATS if named_image else tuple(name for name in FORMATS if name != "TIFF")
    if not _is_heif(path):
        return formats
    try:
        import pillow_heif
    except ImportError:
        raise UnreadableImageError(path, "HEIC photos need an extra: pip install 'freegeo[heif]'") from None
    pillow_heif.register_heif_opener()
    return (*formats, "HEIF")


def _is_heif(path: Path) -> bool:
    head = _head(path)
    return head[4:8] == b"ftyp" and head[8:12] in _HEIF_BRANDS


def _size_of_animation(path: Path) -> tuple[int, int]:
    """Return width and height of a WebP that may hold several pictures, for which Pillow makes room when it opens it.

    (0, 0) for all other files.
    """
    head = _head(path)
    if (head[:4], head[8:16]) != (b"RIFF", b"WEBPVP8X") or len(head) < _HEAD:
        return 0, 0
    return int.from_bytes(head[24:27], "little") + 1, int.from_bytes(head[27:30], "little") + 1


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(_HEAD)
    except OSError as error:
        _require_no_shortage(error)
        raise UnreadableImageError(path, f"the file cannot be opened ({error.strerror})") from None


def _too_large(path: Path, what: str) -> UnreadableImageError:
    return UnreadableImageError(path, f"{what} more than the limit of {MAX_PIXELS // 1_000_000} megapixels")


def _require_no_shortage(error: BaseException) -> None:
    if isinstance(error, OSError) and error.errno in _SHORTAGES:
        raise error


def _damaged(path: Path | str, error: BaseException | str) -> UnreadableImageError:
    if isinstance(error, BaseException):
        _require_no_shortage(error)
    return UnreadableImageError(path, f"the image is damaged or truncated ({' '.join(str(error).split())})")


def orientation(image: PillowImage, *, of_file: bool = True) -> int | None:
    """Return the orientation, 1 to 8, that the EXIF data of an image say; None where these are damaged.

    Only this field is read of them. Of a PNG all pixels are decoded, since the field may come after them. `of_file`
    False: the image is a user's, who may have changed the field after opening. `UnreadableImageError` when they do not
    fit into memory.
    """
    found, damaged = [], False
    try:
        with _in_memory(image, getattr(image, "filename", None) or "an image in memory"):
            found.append(image.getexif().get(_ORIENTATION_TAG))
    except UnreadableImageError:
        raise
    except _DECODER_ERRORS:
        damaged = True
    # Pillow stops at the first field that is damaged; the orientation may come after it.
    exif = image.info.get("exif") if of_file else None
    try:
        found += [_orientation_field(exif)] if exif else []
    except struct.error:
        damaged = True
    valid = [value for value in found if isinstance(value, int) and 1 <= value <= 8]
    if valid:
        return valid[0]
    return None if damaged else 1


def _orientation_field(exif: bytes) -> int | None:
    """Read the orientation out of an EXIF block without looking at other fields; None where there is none."""
    data = exif.removeprefix(b"Exif\0\0")
    order = {b"II": "<", b"MM": ">"}.get(data[:2])
    if order is None:
        raise struct.error("no byte order")
    (start,) = struct.unpack_from(f"{order}L", data, 4)
    (fields,) = struct.unpack_from(f"{order}H", data, start)
    for place in range(start + 2, start + 2 + 12 * fields, 12):
        tag, _, _, value = struct.unpack_from(f"{order}HHLH", data, place)
        if tag == _ORIENTATION_TAG:
            return value
    return None


def size_hw(image: PillowImage, orientation: int | None) -> tuple[int, int]:
    """Return height and width of an opened image as it is upright."""
    # Pillow gives the size of a TIFF as it is after rotation, of everything else as it is stored.
    turned = image.format != "TIFF" and orientation in _SIDEWAYS
    return (image.width, image.height) if turned else (image.height, image.width)


def holds_several(image: PillowImage) -> bool:
    """Whether a file holds further pictures besides the first (an animation, pages), which is the one that is read."""
    if image.format not in ("GIF", "WEBP", "PNG", "TIFF", "AVIF"):
        return False
    try:
        return bool(getattr(image, "is_animated", False))
    except _DECODER_ERRORS:
        return False


def rgb_pixels(image: PillowImage, path: Path | str, white: float | None = None) -> np.ndarray:
    """Decode an image to upright RGB (H, W, 3) uint8; transparent pixels become white.

    Args:
        image: opened by `opened`, or a user's own.
        path: of its file, or its name.
        white: value that becomes 255 in images of more than 8 bits a channel; None: `white_value` of the image.
    """
    with _in_memory(image, path):
        values = deep_values(image, path)
        if values is not None:
            return rgb_on_white(scaled(values, white_value(values, path) if white is None else white))
        _load(image, path)
        return _turned(rgb_on_white(image), orientation(image, of_file=isinstance(path, Path)))


def rgba_pixels(image: PillowImage, path: Path) -> np.ndarray:
    """Decode an opened image of 8 bits to upright RGB and opacity (H, W, 4) uint8."""
    with _in_memory(image, path):
        _load(image, path)
        return _turned(np.asarray(image.convert("RGBA")), orientation(image))


def stored_values(image: PillowImage, path: Path) -> np.ndarray:
    """Decode an opened image to its values as they are stored, (H, W) or (H, W, C), not turned."""
    with _in_memory(image, path):
        _load(image, path)
        return np.array(image)


@contextmanager
def _in_memory(image: PillowImage, path: Path | str) -> Generator[None]:
    """Turn exhausted memory into an `UnreadableImageError`, so that the file is named."""
    try:
        yield
    except MemoryError:
        raise UnreadableImageError(path, f"{image.width} x {image.height} pixels do not fit into memory") from None


def deep_values(image: PillowImage, path: Path | str) -> np.ndarray | None:
    """Return the upright values of an image of more than 8 bits a channel, None of any other.

    Shape (H, W), or (H, W, C) with RGB and possibly opacity; uint16, or float32.
    """
    if image.mode in _DEEP_MODES:
        _load(image, path)
        values = np.asarray(image)
        if values.dtype.kind in "iu" and values.min() >= 0 and values.max() <= _SIXTEEN_BITS:
            values = values.astype(np.uint16)
        return _turned(values, orientation(image, of_file=isinstance(path, Path)))
    if isinstance(path, Path) and _has_deep_channels(image):
        turn = orientation(image)
        _load(image, path)
        return _turned(_stored_channels(path), turn)
    return None


def _has_deep_channels(image: PillowImage) -> bool:
    """Whether colours have 16 bits in the file, of which Pillow keeps the upper 8."""
    if image.mode not in ("RGB", "RGBA", "RGBX", "LA"):
        return False
    arguments = [tile.args if isinstance(tile.args, tuple) else (tile.args,) for tile in getattr(image, "tile", ())]
    if image.format == "PPM":
        return any(isinstance(value, int) and value > 255 for values in arguments for value in values)
    return any(isinstance(value, str) and ";16" in value for values in arguments for value in values)


def _stored_channels(path: Path) -> np.ndarray:
    """Read a colour image of 16 bits, (H, W, 3 or 4) uint16, not turned."""
    import cv2

    try:
        values = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise _damaged(path, error) from None
    if values is None or values.dtype != np.uint16 or values.ndim != 3:
        raise UnreadableImageError(path, "16 bits a channel in a kind of file that is not supported: save it with 8")
    return cv2.cvtColor(values, cv2.COLOR_BGRA2RGBA if values.shape[2] == 4 else cv2.COLOR_BGR2RGB)


def white_value(values: np.ndarray, path: Path | str) -> float:
    """Return which value of an image of more than 8 bits is white, judged by the largest one.

    Cameras store 12 bits, and programs 8, in files of 16 bits. Floats are from 0 to 1 or from 0 to 255.
    `UnreadableImageError` when the values are no brightness: negative, not finite, or in another range.
    """
    colours = values[..., :3]
    low, high = float(colours.min()), float(colours.max())
    if values.dtype == np.uint16:
        return next(2.0**bits - 1 for bits in (8, 12, 16) if high < 2**bits)
    if values.dtype.kind == "f" and np.isfinite([low, high]).all():
        white = 1.0 if high <= 1 + _FLOAT_SLACK else 255.0
        # The values between are those of depth maps and of light without a limit.
        if low >= -_FLOAT_SLACK * white and (white == 1 or 32 < high <= 255 * (1 + _FLOAT_SLACK)):
            return white
    raise UnreadableImageError(
        path,
        f"its values go from {low:g} to {high:g}, which is neither 0 to 1, nor 0 to 255, nor 16 bits: save it with 8 "
        "bits a channel",
    )


def scaled(values: np.ndarray, white: float) -> PillowImage:
    """Turn values of `deep_values` into an image of 8 bits with the same channels, in which `white` is 255."""
    from PIL import Image

    if values.dtype == np.uint16:
        table = (np.arange(_SIXTEEN_BITS + 1) * (255 / white)).round().clip(0, 255).astype(np.uint8)
        return Image.fromarray(table[values])
    return Image.fromarray((values * (255 / white)).round().clip(0, 255).astype(np.uint8))


def rgb_on_white(image: PillowImage) -> np.ndarray:
    """Turn an image of 8 bits into RGB (H, W, 3) uint8; transparent pixels become white."""
    from PIL import Image

    if "A" in image.getbands() or "transparency" in image.info:
        image = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)
    # A copy of a large image would take half a gigabyte.
    return np.array(image if image.mode == "RGB" else image.convert("RGB"))


def _load(image: PillowImage, path: Path | str) -> None:
    try:
        image.load()
    except _DECODER_ERRORS as error:
        raise _damaged(path, error) from None


def _turned(pixels: np.ndarray, orientation: int | None) -> np.ndarray:
    """Turn stored pixels (H, W, ...) upright."""
    upright = {
        2: lambda a: a[:, ::-1],
        3: lambda a: a[::-1, ::-1],
        4: lambda a: a[::-1],
        5: lambda a: a.swapaxes(0, 1),
        6: lambda a: np.rot90(a, -1),
        7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
        8: lambda a: np.rot90(a, 1),
    }.get(orientation or 1, lambda a: a)
    return np.array(upright(pixels), order="C")


def is_cut_off(image: PillowImage, pixels: np.ndarray, turn: int) -> bool:
    """Whether a decoded JPEG ends in the very grey that decoders put in the place of lost data.

    `pixels` (H, W, 3) are upright; `turn` is the orientation that they had in the file. What is all grey has no end.
    """
    last = {3: pixels[0], 4: pixels[0], 5: pixels[:, -1], 8: pixels[:, -1], 6: pixels[:, 0], 7: pixels[:, 0]}
    return image.format in _JPEGS and not is_blank(pixels) and bool((last.get(turn, pixels[-1]) == 128).all())


def is_blank(pixels: np.ndarray) -> bool:
    """Whether an image (H, W) or (H, W, 3) uint8 is almost black, white or of one colour."""
    from PIL import Image

    small = np.asarray(Image.fromarray(pixels).convert("L").resize((32, 32), Image.Resampling.BOX), np.float32) / 255
    return bool(small.mean() < _DARK or small.mean() > _BRIGHT or np.ptp(small) < _FLAT)
