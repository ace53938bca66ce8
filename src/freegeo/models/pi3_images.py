"""How Pi3 reads photos (docs/models/pi3.md, "Images"): one Lanczos resize to a number of pixels and whole patches."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from freegeo.models.images import Size, images_of_one_size, planned, require_a_patch
from freegeo.models.spec import MIXED, Mixed
from freegeo.types import ImageBatch, PhotoLike


def plan_size(photo: Size, patch: int, pixels: int) -> Size:
    """Compute the size (height, width) for one photo: at most so many pixels, in whole patches."""
    height, width = photo
    scale = math.sqrt(pixels / (width * height))
    columns, rows = round(width * scale / patch), round(height * scale / patch)
    while patch**2 * columns * rows > pixels:
        if columns / rows > width / height:
            columns -= 1
        else:
            rows -= 1
    return patch * max(1, rows), patch * max(1, columns)


def resize(pixels_HW3: Tensor, size: Size) -> Tensor:
    """Resize an 8-bit photo as Pillow's Lanczos filter does."""
    image = Image.fromarray(pixels_HW3.numpy()).resize(size[::-1], Image.Resampling.LANCZOS)
    return torch.from_numpy(np.array(image))


def preprocess(photos: Sequence[PhotoLike], *, patch: int, pixels: int, mixed: Mixed = MIXED) -> ImageBatch:
    """Read and resize photos; upstream squashes all of them to the size that suits the first one."""
    sizes = planned(photos, lambda size: _own_size(size, patch, pixels))
    if mixed == "upstream":
        sizes = sizes[:1] * len(photos)
    return images_of_one_size(
        photos, sizes, lambda image, number: resize(image, sizes[number]), mixed=mixed, upstream="largest"
    )


def _own_size(photo: Size, patch: int, pixels: int) -> Size:
    """Return the size for one photo alone; UserError when it would not fill a patch."""
    require_a_patch(photo, patch)
    return plan_size(photo, patch, pixels)
