"""How VGGT reads photos (spec: VGGT fact sheet, section 14).

| mode | rule |
|---|---|
| longest | longest side as given, each side to the nearest multiple of the patch; the default, as in the benchmark |
| crop | width as given, height to the nearest multiple of the patch, a taller centre cut to a square |
| pad | longest side as given, the other to the nearest multiple of the patch, white around it to a square |
| square | black around the photo to a square, then resized to the side given |

`longest` resizes as OpenCV does, the others as Pillow's bicubic does. Rounding is half to even.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import torch
from torch import Tensor

from freegeo.errors import UserError
from freegeo.geometry.resample import resize_area, resize_cubic
from freegeo.models.images import Size, to_batch
from freegeo.types import ImageBatch, PhotoLike

Mode = Literal["longest", "crop", "pad", "square"]
WHITE, BLACK = 255, 0


@dataclass(frozen=True, kw_only=True)
class SizePlan:
    """The steps from a photo to the network: black border, resize, then white border or centre crop.

    Sizes are (height, width).
    """

    photo: Size
    canvas: Size
    resized: Size
    final: Size
    step: Literal["area", "cubic", "pillow"]

    @property
    def scale_yx(self) -> tuple[float, float]:
        """Network pixels per photo pixel."""
        return self.resized[0] / self.canvas[0], self.resized[1] / self.canvas[1]

    @property
    def offset_yx(self) -> tuple[float, float]:
        """Where the photo's first pixel lies in the network's image; negative when it is cut off."""
        first, second = (
            _before(self.canvas[k], self.photo[k]) * self.scale_yx[k] + _before(self.final[k], self.resized[k])
            for k in (0, 1)
        )
        return first, second


def plan_size(photo: Size, *, mode: Mode, side: int, patch: int) -> SizePlan:
    """Work out the sizes for one photo; UserError when it would not fill a patch."""
    if mode not in get_args(Mode):
        raise UserError(f"unknown way '{mode}' to read photos: choose one of {', '.join(get_args(Mode))}.")
    height, width = photo
    longest, square = max(photo), (side, side)
    canvas, step = photo, "pillow"
    if mode == "longest":
        scale = side / longest
        rows, columns = (max(patch, _nearest(round(n * scale), patch)) for n in photo)
        final, step = (rows, columns), "area" if scale <= 1 else "cubic"
    elif mode == "crop":
        rows, columns = _nearest(height * side / width, patch), side
        final = (min(rows, side), side)
    elif mode == "pad":
        rows, columns = (side if n == longest else _nearest(n * side / longest, patch) for n in photo)
        final = square
    else:
        rows, columns = final = square
        canvas = (longest, longest)
    if min(height, width, rows, columns) < patch:
        raise UserError(
            f"a photo of {width} x {height} pixels is too small or too narrow: the model reads patches of "
            f"{patch} x {patch} pixels. Use a larger photo or crop it to a less extreme aspect."
        )
    return SizePlan(photo=photo, canvas=canvas, resized=(rows, columns), final=final, step=step)


def apply_plan(pixels_HW3: Tensor, plan: SizePlan) -> Tensor:
    """Carry out a plan on an 8-bit photo; the result is 8-bit too, as in the reference."""
    pixels_HW3 = _centre(pixels_HW3, plan.canvas, BLACK)
    resize = {"area": _resize_area, "cubic": resize_cubic, "pillow": _resize_pillow}[plan.step]
    return _centre(resize(pixels_HW3, plan.resized), plan.final, WHITE)


def preprocess(photos: Sequence[PhotoLike], *, mode: Mode, side: int, patch: int) -> ImageBatch:
    """Read and resize photos; sizes that differ in the end are padded, white and centred, to the largest sides."""
    plans = [_plan_photo(photo, mode, side, patch) for photo in photos]
    largest = (max(plan.final[0] for plan in plans), max(plan.final[1] for plan in plans))
    plans = [replace(plan, final=largest) for plan in plans]
    pixels = [apply_plan(torch.from_numpy(photo.read()), plan) for photo, plan in zip(photos, plans, strict=True)]
    return to_batch(
        photos,
        pixels,
        scale_xy=[plan.scale_yx[::-1] for plan in plans],
        offset_xy=[plan.offset_yx[::-1] for plan in plans],
    )


def _plan_photo(photo: PhotoLike, mode: Mode, side: int, patch: int) -> SizePlan:
    try:
        return plan_size(photo.size_hw, mode=mode, side=side, patch=patch)
    except UserError as error:
        raise UserError(f"{photo.name}: {error}") from None


def _nearest(length: float, patch: int) -> int:
    return round(length / patch) * patch


def _before(outer: int, inner: int) -> int:
    """Pixels before a centred row: the odd one goes to the end, of the border as of the cut."""
    return (outer - inner) // 2 if outer >= inner else -((inner - outer) // 2)


def _centre(pixels_HW3: Tensor, size: Size, grey: int) -> Tensor:
    """Put a photo into the middle of an area of `size`, cutting what is larger and filling what is smaller."""
    if tuple(pixels_HW3.shape[:2]) == size:
        return pixels_HW3
    area = pixels_HW3.new_full((*size, 3), grey)
    inside, source = zip(*(_overlap(size[k], pixels_HW3.shape[k]) for k in (0, 1)), strict=True)
    area[inside] = pixels_HW3[source]
    return area


def _overlap(outer: int, inner: int) -> tuple[slice, slice]:
    before, length = _before(outer, inner), min(outer, inner)
    start_outer, start_inner = max(before, 0), max(-before, 0)
    return slice(start_outer, start_outer + length), slice(start_inner, start_inner + length)


def _resize_area(pixels_HW3: Tensor, size: Size) -> Tensor:
    """Resize as OpenCV's INTER_AREA also where rounding to the patch makes a side grow by a few pixels."""
    if all(n <= old for n, old in zip(size, pixels_HW3.shape[:2], strict=True)):
        return resize_area(pixels_HW3, size)
    rows, columns = (_linear_weights(old, new) for old, new in zip(pixels_HW3.shape[:2], size, strict=True))
    resized_3HW = rows @ pixels_HW3.permute(2, 0, 1).double() @ columns.T
    return resized_3HW.permute(1, 2, 0).round().clamp(0, 255).to(torch.uint8)


def _linear_weights(n_in: int, n_out: int) -> Tensor:
    """Weights (n_out, n_in) of the interpolation that OpenCV puts in the place of area averaging when a side grows.

    Output pixels that lie inside one input pixel copy it, those across a border mix the two by their overlap.
    """
    position = torch.arange(n_out, dtype=torch.float64)
    first = (position * (n_in / n_out)).floor()
    second_share = (position + 1 - (first + 1) * (n_out / n_in)).clamp(min=0)
    second_share = second_share - second_share.floor()
    second_share[first >= n_in - 1] = 0
    first = first.long().clamp(max=n_in - 1)
    weights = torch.zeros(n_out, n_in, dtype=torch.float64)
    weights.scatter_add_(1, first[:, None], (1 - second_share)[:, None])
    return weights.scatter_add_(1, (first + 1).clamp(max=n_in - 1)[:, None], second_share[:, None])


def _resize_pillow(pixels_HW3: Tensor, size: Size) -> Tensor:
    import numpy as np
    from PIL import Image

    resized = Image.fromarray(pixels_HW3.numpy()).resize(size[::-1], Image.Resampling.BICUBIC)
    return torch.from_numpy(np.array(resized))
