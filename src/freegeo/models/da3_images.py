"""How DA3 reads photos: resize to a longest side, then to multiples of the patch (spec: DA3 fact sheet, section 11)."""

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

Method = Literal["upper_bound_resize", "upper_bound_crop", "lower_bound_resize", "lower_bound_crop"]


@dataclass(frozen=True, kw_only=True)
class SizePlan:
    """The two steps from a photo to the network, sizes as (height, width)."""

    photo: Size
    bounded: Size
    bound_step: Literal["none", "area", "cubic"]
    final: Size
    final_step: Literal["none", "area", "cubic", "crop"]

    @property
    def crop_offset(self) -> Size:
        """Rows and columns cut off at the top and left."""
        if self.final_step != "crop":
            return 0, 0
        return (self.bounded[0] - self.final[0]) // 2, (self.bounded[1] - self.final[1]) // 2


def plan_size(photo: Size, side: int, patch: int, method: Method = "upper_bound_resize") -> SizePlan:
    """Work out the sizes for one photo; UserError when it is too narrow to give one patch."""
    reference = max(photo) if method.startswith("upper") else min(photo)
    bounded = (max(1, round(photo[0] * side / reference)), max(1, round(photo[1] * side / reference)))
    bound_step = "none" if reference == side else "cubic" if side > reference else "area"
    if method.endswith("crop"):
        final = (bounded[0] // patch * patch, bounded[1] // patch * patch)
        final_step = "none" if final == bounded else "crop"
    else:
        rows, columns = ((n + patch // 2) // patch * patch for n in bounded)
        final = (rows, columns)
        grows = any(f > b for f, b in zip(final, bounded, strict=True))
        final_step = "none" if final == bounded else "cubic" if grows else "area"
    if min(final) < patch:
        raise UserError(
            f"a photo of {photo[1]} x {photo[0]} pixels is too narrow: at the model's size its short side would be "
            f"{min(bounded)} pixels, less than a patch of {patch}. Crop it to a less extreme aspect."
        )
    return SizePlan(photo=photo, bounded=bounded, bound_step=bound_step, final=final, final_step=final_step)


def apply_plan(pixels_HW3: Tensor, plan: SizePlan) -> Tensor:
    """Carry out a plan on an 8-bit photo; the result is 8-bit too, as in the reference."""
    steps = {"area": resize_area, "cubic": resize_cubic}
    if plan.bound_step != "none":
        pixels_HW3 = steps[plan.bound_step](pixels_HW3, plan.bounded)
    if plan.final_step in steps:
        pixels_HW3 = steps[plan.final_step](pixels_HW3, plan.final)
    top, left = plan.crop_offset
    return pixels_HW3[top : top + plan.final[0], left : left + plan.final[1]]


def preprocess(
    photos: Sequence[PhotoLike], *, side: int, patch: int, method: Method = "upper_bound_resize"
) -> ImageBatch:
    """Read and resize photos; photos that end up with different sizes are centre-cropped to the smallest sides."""
    plans = [_plan_photo(photo, side, patch, method) for photo in photos]
    height, width = (min(plan.final[k] for plan in plans) for k in (0, 1))
    cropped, offsets = [], []
    for photo, plan in zip(photos, plans, strict=True):
        pixels = apply_plan(torch.from_numpy(photo.read()), plan)
        top, left = (plan.final[0] - height) // 2, (plan.final[1] - width) // 2
        cropped.append(pixels[top : top + height, left : left + width])
        offsets.append([-float(left + plan.crop_offset[1]), -float(top + plan.crop_offset[0])])
    return to_batch(photos, cropped, scale_xy=[_scale_xy(plan) for plan in plans], offset_xy=offsets)


def _plan_photo(photo: PhotoLike, side: int, patch: int, method: Method) -> SizePlan:
    try:
        return plan_size(photo.size_hw, side, patch, method)
    except UserError as error:
        raise UserError(f"{photo.name}: {error}") from None


def _scale_xy(plan: SizePlan) -> list[float]:
    resized = plan.bounded if plan.final_step == "crop" else plan.final
    return [resized[1] / plan.photo[1], resized[0] / plan.photo[0]]
