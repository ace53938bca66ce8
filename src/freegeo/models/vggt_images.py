"""How VGGT reads photos (docs/models/vggt.md, "Images"): one resize to a longest side and multiples of the patch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from freegeo.geometry.resample import resize_area, resize_cubic
from freegeo.models.images import Size, images_of_one_size, planned, require_a_patch
from freegeo.models.spec import MIXED, Mixed
from freegeo.types import ImageBatch, PhotoLike


@dataclass(frozen=True, kw_only=True)
class SizePlan:
    """The step from a photo to the network, sizes as (height, width)."""

    photo: Size
    resized: Size
    step: Literal["area", "cubic"]


def plan_size(photo: Size, side: int, patch: int) -> SizePlan:
    """Compute the size for one photo; UserError when it would not fill a patch."""
    require_a_patch(photo, patch)
    scale = side / max(photo)
    rows, columns = (max(patch, round(round(n * scale) / patch) * patch) for n in photo)
    return SizePlan(photo=photo, resized=(rows, columns), step="area" if scale <= 1 else "cubic")


def apply_plan(pixels_HW3: Tensor, plan: SizePlan) -> Tensor:
    """Carry out a plan on an 8-bit photo; the result is 8-bit too, as in the reference."""
    return (_resize_area if plan.step == "area" else resize_cubic)(pixels_HW3, plan.resized)


def preprocess(photos: Sequence[PhotoLike], *, side: int, patch: int, mixed: Mixed = MIXED) -> ImageBatch:
    """Read and resize photos; upstream pads photos that end up with different sizes to the largest sides."""
    plans = planned(photos, lambda size: plan_size(size, side, patch))
    return images_of_one_size(
        photos, [plan.resized for plan in plans], lambda pixels, number: apply_plan(pixels, plans[number]), mixed=mixed,
        upstream="largest",
    )  # fmt: skip


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
