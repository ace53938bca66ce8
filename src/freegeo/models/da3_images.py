"""How DA3 reads photos (docs/models/da3.md, "Images"): resize to a longest side, then to multiples of the patch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from freegeo.errors import UserError
from freegeo.geometry.resample import resize_area, resize_cubic
from freegeo.models.images import Size, images_of_one_size, planned, require_a_patch
from freegeo.models.spec import MIXED, Mixed
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
    """Compute the sizes for one photo; UserError when it is too small or too narrow to give one patch."""
    require_a_patch(photo, patch)
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


def preprocess(photos: Sequence[PhotoLike], *, side: int, patch: int, mixed: Mixed = MIXED) -> ImageBatch:
    """Read and resize photos; upstream cuts photos that end up with different sizes to the smallest sides."""
    plans = planned(photos, lambda size: plan_size(size, side, patch))
    return images_of_one_size(
        photos, [plan.final for plan in plans], lambda pixels, number: apply_plan(pixels, plans[number]), mixed=mixed,
        upstream="smallest",
    )  # fmt: skip
