"""What every model here does with images: normalisation, the patch grid, and the mapping back to the photos."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from freegeo.types import ImageBatch, PhotoLike

Size = tuple[int, int]

IMAGE_MEAN = (0.485, 0.456, 0.406)
IMAGE_STD = (0.229, 0.224, 0.225)


def normalise(images: Tensor) -> Tensor:
    """Subtract ImageNet's mean and divide by its deviation; (..., 3, H, W) in [0, 1]."""
    mean = images.new_tensor(IMAGE_MEAN)[:, None, None]
    std = images.new_tensor(IMAGE_STD)[:, None, None]
    return (images - mean) / std


def patch_grid(images: Tensor, patch: int) -> Size:
    """Return rows and columns of patches of images (..., H, W); ValueError when a side is no multiple of the patch."""
    height, width = images.shape[-2:]
    if height % patch or width % patch:
        raise ValueError(f"image sides must be multiples of {patch}, got {height} x {width}")
    return height // patch, width // patch


def to_batch(
    photos: Sequence[PhotoLike],
    pixels_HW3: Sequence[Tensor],
    *,
    scale_xy: Sequence[Sequence[float]],
    offset_xy: Sequence[Sequence[float]],
) -> ImageBatch:
    """Put resized 8-bit photos of one size into a batch, with each photo's scale and offset (x first)."""
    return ImageBatch(
        images=torch.stack([pixels.permute(2, 0, 1).float() / 255 for pixels in pixels_HW3]),
        names=tuple(photo.name for photo in photos),
        photo_hw=torch.tensor([photo.size_hw for photo in photos]),
        scale_xy=torch.tensor(scale_xy, dtype=torch.float64),
        offset_xy=torch.tensor(offset_xy, dtype=torch.float64),
    )
