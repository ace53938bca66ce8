"""How MapAnything reads photos (docs/models/mapanything.md, "Images"): ten sizes, covered and cut around the middle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from freegeo.models.images import WHITE, Size, SizeOnly, common_size, planned, require_a_patch
from freegeo.models.spec import MIXED, Mixed
from freegeo.types import ImageBatch, PhotoLike

LONGEST = 37
"""Patches along the longest side of the published sizes."""
SHAPES: tuple[tuple[float, Size], ...] = (
    (0.486, (37, 18)), (0.567, (37, 21)), (0.649, (37, 24)), (0.757, (37, 28)), (1.0, (37, 37)),
    (1.321, (28, 37)), (1.542, (24, 37)), (1.762, (21, 37)), (2.056, (18, 37)), (3.083, (12, 37)),
)  # fmt: skip
"""Width over height -> rows and columns of patches."""
MORE_THAN_COVERED = 1e-8
"""Added to the factor of a photo, so that rounding down does not leave it a pixel short."""


@dataclass(frozen=True, kw_only=True)
class SizePlan:
    """How a photo is scaled and cut; sizes as (height, width)."""

    target: Size
    resized: Size
    scale: float
    top: int
    left: int

    def offset_xy(self, photo: Size) -> tuple[float, float]:
        """Return where the photo's corner is in the image; its middle stays in the middle when a size is rounded."""
        rounded = [(side * self.scale - size) / 2 for side, size in zip(photo, self.resized, strict=True)]
        return -rounded[1] - self.left, -rounded[0] - self.top


def size_for(aspect: float, side: int, patch: int) -> Size:
    """Return the size (height, width) for photos of an aspect (width over height), in whole patches."""
    _, shape = min(SHAPES, key=lambda known: abs(known[0] - aspect))
    longest = side // patch
    rows, columns = (max(1, round(longest * n / LONGEST)) for n in shape)
    return rows * patch, columns * patch


def plan_size(photo: Size, target: Size) -> SizePlan:
    """Compute how a photo covers a size."""
    scale = max(new / old for new, old in zip(target, photo, strict=True)) + MORE_THAN_COVERED
    rows, columns = (math.floor(side * scale) for side in photo)
    return SizePlan(
        target=target,
        resized=(rows, columns),
        scale=scale,
        top=(rows - target[0]) // 2,
        left=(columns - target[1]) // 2,
    )


def apply_plan(pixels_HW3: np.ndarray, plan: SizePlan) -> Tensor:
    """Carry out a plan on an 8-bit photo; the result (height, width, 3) is 8-bit too, as in the reference."""
    method = Image.Resampling.LANCZOS if plan.scale < 1 else Image.Resampling.BICUBIC
    resized = np.asarray(Image.fromarray(pixels_HW3).resize(plan.resized[::-1], method))
    cut = resized[plan.top :, plan.left :][: plan.target[0], : plan.target[1]]
    return torch.from_numpy(cut.copy())


def preprocess(photos: Sequence[PhotoLike], *, side: int, patch: int, mixed: Mixed = MIXED) -> ImageBatch:
    """Read photos at one size; upstream's is that of their mean aspect, which cuts the ends of those that differ."""
    sizes = planned(photos, lambda size: _own_size(size, side, patch))
    common = _common([photo.size_hw for photo in photos], sizes, side, patch, mixed)
    images, offsets, scales = [], [], []
    shown = [(photo, size) for photo, size in zip(photos, sizes, strict=True) if not isinstance(photo, SizeOnly)]
    for photo, own in shown:
        plan = plan_size(photo.size_hw, own if mixed == "pad" else common)
        top, left = ((whole - part) // 2 for whole, part in zip(common, plan.target, strict=True))
        area = torch.full((*common, 3), WHITE, dtype=torch.uint8)
        area[top : top + plan.target[0], left : left + plan.target[1]] = apply_plan(photo.read(), plan)
        x, y = plan.offset_xy(photo.size_hw)
        images.append(area.permute(2, 0, 1))
        offsets.append((x + left, y + top))
        scales.append((plan.scale, plan.scale))
    return ImageBatch(
        images=torch.stack(images).float() / 255,
        names=tuple(photo.name for photo, _ in shown),
        photo_hw=torch.tensor([photo.size_hw for photo, _ in shown]),
        scale_xy=torch.tensor(scales, dtype=torch.float64),
        offset_xy=torch.tensor(offsets, dtype=torch.float64),
    )


def _own_size(photo: Size, side: int, patch: int) -> Size:
    """Return the size for one photo alone; UserError when it would not fill a patch."""
    require_a_patch(photo, patch)
    return size_for(photo[1] / photo[0], side, patch)


def _common(photos: Sequence[Size], sizes: Sequence[Size], side: int, patch: int, mixed: Mixed) -> Size:
    """Return the one size of all images."""
    if mixed == "upstream":
        return size_for(math.fsum(width / height for height, width in photos) / len(photos), side, patch)
    heights, widths = zip(*sizes, strict=True)
    if mixed == "pad":
        return max(heights), max(widths)
    between = size_for(min(widths) / min(heights), side, patch)
    # In an order that does not depend on that of the photos, some of which may be read at another time.
    return common_size(photos, sorted({*sizes, between}))
