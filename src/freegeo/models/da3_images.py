"""How DA3 reads photos (docs/models/da3.md, "Images"): resize to a longest side, then to multiples of the patch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from freegeo.errors import UserError
from freegeo.geometry.resample import resize_area, resize_cubic
from freegeo.models.images import Size, to_batch
from freegeo.types import ImageBatch, PhotoLike

Step = Literal["none", "area", "cubic"]


@dataclass(frozen=True, kw_only=True)
class SizePlan:
    """The two resizing steps from a photo to the network, sizes as (height, width)."""

    photo: Size
    bounded: Size
    """The longest side is the requested one."""
    bound_step: Step
    final: Size
    """Both sides are multiples of the patch."""
    final_step: Step


def plan_size(photo: Size, side: int, patch: int) -> SizePlan:
    """Compute the sizes for one photo; UserError when it is too narrow to give one patch."""
    longest = max(photo)
    bounded = (max(1, round(photo[0] * side / longest)), max(1, round(photo[1] * side / longest)))
    rows, columns = ((n + patch // 2) // patch * patch for n in bounded)
    if min(rows, columns) < patch:
        raise UserError(
            f"a photo of {photo[1]} x {photo[0]} pixels is too narrow: at the model's size its short side would be "
            f"{min(bounded)} pixels, less than a patch of {patch}. Crop it to a less extreme aspect."
        )
    return SizePlan(
        photo=photo,
        bounded=bounded,
        bound_step="none" if longest == side else "cubic" if side > longest else "area",
        final=(rows, columns),
        final_step=_final_step(bounded, (rows, columns)),
    )


def _final_step(bounded: Size, final: Size) -> Step:
    """Return how the second step is done: by the cubic kernel for both sides as soon as one of them grows."""
    if final == bounded:
        return "none"
    return "cubic" if any(new > old for new, old in zip(final, bounded, strict=True)) else "area"


def apply_plan(pixels_HW3: Tensor, plan: SizePlan) -> Tensor:
    """Carry out a plan on an 8-bit photo; the result of each step is 8-bit too, as in the reference."""
    return _resized(_resized(pixels_HW3, plan.bounded, plan.bound_step), plan.final, plan.final_step)


def _resized(pixels_HW3: Tensor, size: Size, step: Step) -> Tensor:
    if step == "none":
        return pixels_HW3
    return resize_area(pixels_HW3, size) if step == "area" else resize_cubic(pixels_HW3, size)


def preprocess(photos: Sequence[PhotoLike], *, side: int, patch: int) -> ImageBatch:
    """Read and resize photos; photos that end up with different sizes are centre-cropped to the smallest sides."""
    plans = [_plan_photo(photo, side, patch) for photo in photos]
    height, width = (min(plan.final[k] for plan in plans) for k in (0, 1))
    cropped, offsets = [], []
    for photo, plan in zip(photos, plans, strict=True):
        pixels = apply_plan(torch.from_numpy(photo.read()), plan)
        top, left = (plan.final[0] - height) // 2, (plan.final[1] - width) // 2
        cropped.append(pixels[top : top + height, left : left + width])
        offsets.append([-float(left), -float(top)])
    scales = [[plan.final[1] / plan.photo[1], plan.final[0] / plan.photo[0]] for plan in plans]
    return to_batch(photos, cropped, scale_xy=scales, offset_xy=offsets)


def _plan_photo(photo: PhotoLike, side: int, patch: int) -> SizePlan:
    try:
        return plan_size(photo.size_hw, side, patch)
    except UserError as error:
        raise UserError(f"{photo.name}: {error}") from None
