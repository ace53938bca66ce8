"""Intrinsics of a camera from points in its own frame (docs/models/pi3.md, "Intrinsics")."""

import torch
from torch import Tensor

from freegeo.geometry.camera import K_from_focal

__all__ = ["K_from_local_points"]

SMALLEST_DEPTH = 1e-6
REPETITIONS = 5
HUBER = 1.345
"""Of the residuals' spread: beyond it a pixel's weight falls with its residual (Huber's constant for normal noise)."""
MAD_TO_SIGMA = 1.4826
"""Spread of normal residuals, in medians of their size."""
SMALLEST_RESIDUAL = 1e-12


def K_from_local_points(points: Tensor, weight: Tensor, repetitions: int = REPETITIONS) -> Tensor:
    """Intrinsics (..., 3, 3), in pixels of the map, of points (..., H, W, 3) with weights (..., H, W).

    The principal point is the middle of the image. The slopes x/z and y/z are regressed on the pixel's place, not the
    other way round, since the noise is in the slopes: each axis by itself, with weights that fall where residuals are
    large. A gradient flows through the last regression, with the weights as they are. NaN where no pixel can be used.
    """
    height, width = weight.shape[-2:]
    depth = points[..., 2]
    usable = points.isfinite().all(-1) & (depth > SMALLEST_DEPTH)
    slopes = torch.where(usable[..., None], points[..., :2] / depth.clamp(min=SMALLEST_DEPTH)[..., None], 0)
    weight = torch.where(usable, weight, 0).flatten(-2)
    usable = usable.flatten(-2)
    middle_x, middle_y = (width - 1) / 2, (height - 1) / 2
    columns = (torch.arange(width, device=points.device) - middle_x).to(points.dtype).repeat(height)
    rows = (torch.arange(height, device=points.device) - middle_y).to(points.dtype).repeat_interleave(width)
    focal_x, focal_y = (
        _focal(place, slope, weight, usable, repetitions)
        for place, slope in zip((columns, rows), slopes.flatten(-3, -2).unbind(-1), strict=True)
    )
    return K_from_focal(focal_x, focal_y, torch.full_like(focal_x, middle_x), torch.full_like(focal_y, middle_y))


def _focal(place_P: Tensor, slope: Tensor, weight: Tensor, usable: Tensor, repetitions: int) -> Tensor:
    """Return 1 / a of the robust fit slope = a * place, all (..., P)."""
    with torch.no_grad():
        robust = weight
        for _ in range(repetitions):
            residual = (slope - _ratio(place_P, slope, robust)[..., None] * place_P).abs()
            middle = torch.where(usable, residual, torch.nan).nanmedian(-1, keepdim=True).values
            limit = (HUBER * MAD_TO_SIGMA * middle).clamp(min=SMALLEST_RESIDUAL)
            robust = weight * (limit / residual.clamp(min=SMALLEST_RESIDUAL)).clamp(max=1)
    return 1 / _ratio(place_P, slope, robust)


def _ratio(place_P: Tensor, slope: Tensor, weight: Tensor) -> Tensor:
    return (weight * place_P * slope).sum(-1) / (weight * place_P.square()).sum(-1)
