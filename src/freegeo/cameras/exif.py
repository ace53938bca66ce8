"""The focal length that a photo's EXIF data give: a weak prior, which lenses and crops make wrong by some percent."""

from __future__ import annotations

from pathlib import Path

from freegeo.data.image_files import UnreadableImageError, opened

__all__ = ["exif_focal"]

_IFD, _FOCAL, _FOCAL_35MM = 0x8769, 0x920A, 0xA405
_PLANE_RESOLUTION, _PLANE_UNIT, _STORED_WIDTH, _STORED_HEIGHT = 0xA20E, 0xA210, 0xA002, 0xA003
_DIAGONAL_35MM = (36**2 + 24**2) ** 0.5
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0}
_WANTED = frozenset({_FOCAL, _FOCAL_35MM, _PLANE_RESOLUTION, _PLANE_UNIT, _STORED_WIDTH, _STORED_HEIGHT})
_DAMAGED = (OSError, SyntaxError, ValueError, TypeError, LookupError, ArithmeticError, AttributeError)


def exif_focal(path: Path, size_hw: tuple[int, int]) -> float | None:
    """Return the focal length of a photo in pixels, None where its EXIF data have none or are damaged.

    The 35 mm equivalent comes first, which is defined by the diagonal of the image; else the focal length in
    millimetres with the resolution of the sensor.

    Args:
        path: of the photo's file.
        size_hw: height and width of the photo as it is used; either orientation.
    """
    try:
        with opened(path) as image:
            fields = image.getexif().get_ifd(_IFD)
        numbers = {key: float(fields[key]) for key in fields if key in _WANTED}
    except (UnreadableImageError, *_DAMAGED):
        return None
    height, width = size_hw
    if (focal := numbers.get(_FOCAL_35MM, 0)) > 0:
        return focal * (height**2 + width**2) ** 0.5 / _DIAGONAL_35MM
    resolution, unit = numbers.get(_PLANE_RESOLUTION, 0), _UNIT_MM.get(int(numbers.get(_PLANE_UNIT, 2)))
    focal = numbers.get(_FOCAL, 0)
    if not (focal > 0 and resolution > 0 and unit):
        return None
    stored = max(numbers.get(_STORED_WIDTH, 0), numbers.get(_STORED_HEIGHT, 0)) or max(size_hw)
    return focal * resolution / unit * max(size_hw) / stored
