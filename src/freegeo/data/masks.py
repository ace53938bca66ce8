"""A user's masks: one black and white image per photo, white where points are wanted."""

from __future__ import annotations

import logging
import re
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path, PurePath

import numpy as np

from freegeo.data.image_files import IMAGE_SUFFIXES, deep_values, is_image, opened, rgba_pixels, scaled
from freegeo.data.photos import natural_key, some_of
from freegeo.errors import UserError

logger = logging.getLogger(__name__)

Size = tuple[int, int]

_BLACK, _WHITE = 32, 223
"""Brightness up to and from which a pixel counts as black or white: masks are also saved as JPEG."""
_SOFT_SHARE = 0.05
"""Most pixels that may lie between, as at soft edges."""
_NAMING = "Name the mask of IMG_1.jpg IMG_1.png, IMG_1.jpg.png or IMG_1_mask.png, in sub-folders like the photos'"
_DECORATION = re.compile(r"mask[ ._-]+(?P<after>.+)|(?P<before>.+)[ ._-]+mask", re.IGNORECASE)


def load_masks(
    folder: Path, names: Sequence[str], sizes_hw: Sequence[Size], *, model_hw: Size | None = None
) -> list[np.ndarray]:
    """Read one mask (H, W) bool for each photo from a folder, true where points are wanted.

    A mask is named like its photo, as `IMG_1.png`, `IMG_1.jpg.png` or `IMG_1_mask.png` for `IMG_1.jpg`. White is
    wanted and black is not; of an image with a transparent part, what is opaque is wanted. A mask that is smaller or
    larger than its photo at the same aspect is resized to it.

    Args:
        folder: of the masks; sub-folders belong to it.
        names: of the photos.
        sizes_hw: of the photos.
        model_hw: another size that is left as it is: that of the model's images.

    Raises:
        UserError: no such folder, a photo without a mask or with several, a mask for several photos, an image that is
            damaged or too large, or not black and white, of another shape than the photo, or masks that select nothing.
    """
    folder = folder.expanduser()
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder of masks.")
    masks = []
    for name, path, size_hw in zip(names, _mask_of_each(folder, names), sizes_hw, strict=True):
        mask = _read_mask(path)
        masks.append(mask if mask.shape == model_hw else _fitted(mask, size_hw, path, name))
    _warn_of_empty_and_full(folder, names, masks)
    return masks


def _warn_of_empty_and_full(folder: Path, names: Sequence[str], masks: Sequence[np.ndarray]) -> None:
    empty = [name for name, mask in zip(names, masks, strict=True) if not mask.any()]
    full = [name for name, mask in zip(names, masks, strict=True) if mask.all()]
    if len(empty) == len(names):
        raise UserError(f"{folder}: the masks select nothing, since all are black. White is what is kept.")
    if empty:
        logger.warning(
            "the masks of %d of %d photos are all black, so these give no points: %s.",
            len(empty), len(names), some_of(empty),
        )  # fmt: skip
    if full:
        logger.warning(
            "the masks of %d of %d photos are all white and keep everything: %s.", len(full), len(names), some_of(full)
        )


# -- which file belongs to which photo


def _mask_of_each(folder: Path, names: Sequence[str]) -> list[Path]:
    """Return the file of each photo's mask."""
    files = sorted((path for path in folder.rglob("*") if path.is_file() and _is_mask(path)), key=natural_key)
    by_name: dict[str, list[Path]] = defaultdict(list)
    for file in files:
        for name in _photo_names(file):
            by_name[name].append(file)
    fitting = [_fitting(folder, by_name, PurePath(name)) for name in names]
    missing = [name for name, masks in zip(names, fitting, strict=True) if not masks]
    if missing:
        raise UserError(
            f"{folder}: {len(missing)} of {len(names)} photos have no mask ({some_of(missing)}). {_NAMING}, or leave "
            "--masks out."
        )
    for name, masks in zip(names, fitting, strict=True):
        if len(masks) > 1:
            raise UserError(f"{folder}: several masks fit {name} ({some_of(_relative(masks, folder))}). Keep one.")
    owners: dict[Path, str] = {}
    for name, (mask,) in zip(names, fitting, strict=True):
        if mask in owners:
            raise UserError(f"{mask}: fits {owners[mask]} and {name}. {_NAMING}, so that each photo has its own.")
        owners[mask] = name
    return list(owners)


def _is_mask(path: Path) -> bool:
    """Whether a file is an image; `UnreadableImageError` for one that is named like an image and cannot be read."""
    if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith("."):
        with opened(path):
            return True
    return is_image(path)


def _photo_names(mask: Path) -> set[str]:
    """Return which photos a mask may be of: their names, with or without ending."""
    plain = mask.stem.casefold()
    decorated = _DECORATION.fullmatch(plain)
    return {plain} if decorated is None else {plain, decorated["after"] or decorated["before"]}


def _fitting(folder: Path, by_name: dict[str, list[Path]], photo: PurePath) -> list[Path]:
    """Return the masks of a photo: more than one where names do not decide."""
    named = {photo.name.casefold(), photo.stem.casefold()}
    masks = list(dict.fromkeys(mask for name in sorted(named) for mask in by_name.get(name, ())))
    parents = photo.parent.parts
    inside = {mask: mask.parent.relative_to(folder).parts for mask in masks}
    same = [mask for mask in masks if inside[mask] == parents]
    return same or [mask for mask in masks if _ends_alike(inside[mask], parents)]


def _ends_alike(one: Sequence[str], other: Sequence[str]) -> bool:
    """Whether one path of folders is the end of the other."""
    length = min(len(one), len(other))
    return not length or tuple(one[-length:]) == tuple(other[-length:])


def _relative(paths: Sequence[Path], folder: Path) -> list[str]:
    return [str(path.relative_to(folder)) for path in paths]


# -- what is white in it


def _read_mask(path: Path) -> np.ndarray:
    """Return the wanted pixels (H, W) of a mask image; UserError when it is not black and white."""
    with opened(path) as image:
        values = deep_values(image, path)
        pixels = rgba_pixels(image, path) if values is None else _eight_bits(values, path)
    colours, opacity = pixels[..., :3], pixels[..., 3]
    grey, has_colours = colours.max(2), int(np.ptp(colours, axis=2).max()) > _BLACK
    if (opacity == 255).all():
        if has_colours:
            raise _not_understood(path, "it has colours")
        return _white_pixels(grey, path)
    # A photo that was cut out, or a white shape; a grey image may say with its brightness what is wanted.
    wanted = _white_pixels(opacity, path)
    if not has_colours and wanted.any() and (grey[wanted] < _WHITE).mean() > _SOFT_SHARE:
        raise _not_understood(path, "it has transparent pixels besides black or grey ones")
    return wanted


def _eight_bits(values: np.ndarray, path: Path) -> np.ndarray:
    """Scale a mask of more than 8 bits a channel to (H, W, 4) uint8; its white is 1, 255 or 65535."""
    low, high = float(values.min()), float(values.max())
    if not 0 <= low <= high <= 65_535:
        raise _not_understood(path, f"its values go from {low:g} to {high:g}")
    return np.array(scaled(values, next(white for white in (1, 255, 65_535) if high <= white)).convert("RGBA"))


def _white_pixels(values: np.ndarray, path: Path) -> np.ndarray:
    """Return where an image (H, W) uint8 is white; 1 is also white when it is the largest value."""
    largest = int(values.max())
    if largest == 1:
        return values == 1
    soft = float(((values > _BLACK) & (values < _WHITE)).mean())
    if soft > _SOFT_SHARE:
        raise _not_understood(path, f"{100 * soft:.0f} % of its pixels are neither black nor white")
    if 0 < largest < _WHITE:
        raise _not_understood(path, f"its brightest pixels have the value {largest} of 255")
    return values >= 128


def _not_understood(path: Path, why: str) -> UserError:
    return UserError(f"{path}: not a mask that is understood, {why}. Save it in black and white; white is kept.")


def _fitted(mask: np.ndarray, size_hw: Size, path: Path, name: str) -> np.ndarray:
    """Resize a mask to its photo by the nearest pixel; UserError when it has another aspect."""
    (height, width), (rows, columns) = size_hw, mask.shape
    if mask.shape == size_hw:
        return mask
    # Either side may be rounded.
    if abs(rows - columns * height / width) > 1 and abs(columns - rows * width / height) > 1:
        turned = " The photo is turned by its EXIF data, the mask is not." if mask.shape == size_hw[::-1] else ""
        raise UserError(
            f"{path}: the mask has {columns} x {rows} pixels, the photo {name} {width} x {height}, which is another "
            f"shape.{turned} Save masks at the size of the upright photos."
        )
    row, column = (
        ((np.arange(side) + 0.5) * (stored / side)).astype(int) for side, stored in ((height, rows), (width, columns))
    )
    return mask[row[:, None], column]
