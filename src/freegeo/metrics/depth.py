"""Depth scores: mean relative error and the share of pixels within a factor of 1.25."""

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from freegeo.errors import UserError
from freegeo.geometry.depth import valid_depth


class DepthScore(NamedTuple):
    """Scores over the valid pixels of all views, each (...) float64; NaN where no pixel is valid."""

    abs_rel: Tensor
    """Mean of |s d - d_gt| / d_gt."""
    delta1: Tensor
    """Share of pixels with max(s d / d_gt, d_gt / (s d)) < 1.25."""
    scale: Tensor
    """The factor s applied to the prediction."""


def score_depth(
    depth_pred: Tensor,
    depth_gt: Tensor,
    valid: Tensor | None = None,
    *,
    align: Literal["none", "median"] = "median",
) -> DepthScore:
    """Compare predicted z-depth with ground truth, one scale for all views of a scene.

    Args:
        depth_pred: (..., S, H, W), any positive scale.
        depth_gt: (..., S, H, W) metres.
        valid: (..., S, H, W) bool, pixels to score. A pixel also needs a finite positive depth on both sides.
        align: "median" scales the prediction by the median of d_gt / d over the valid pixels of all views (the lower
            one of two middle values); "none" takes it as it is.

    Raises:
        UserError: the shapes differ or `align` is unknown.
    """
    if depth_pred.shape != depth_gt.shape or depth_pred.ndim < 3:
        raise UserError(
            f"Predicted depth {tuple(depth_pred.shape)} and ground truth {tuple(depth_gt.shape)} "
            "must have one common shape (..., S, H, W)."
        )
    if align not in ("none", "median"):
        raise UserError(f'align must be "none" or "median", not {align!r}.')
    keep = valid_depth(depth_pred) & valid_depth(depth_gt)
    if valid is not None:
        keep = keep & valid
    pred = depth_pred.double().flatten(-3)
    gt = depth_gt.double().flatten(-3)
    keep = keep.flatten(-3)
    ratio = (gt / pred).masked_fill(~keep, float("nan"))
    scale = ratio.nanmedian(dim=-1).values if align == "median" else torch.ones_like(ratio[..., 0])
    relative = scale[..., None] / ratio  # s d / d_gt
    inside = torch.maximum(relative, 1 / relative) < 1.25
    delta1 = torch.where(keep, inside.double(), float("nan")).nanmean(dim=-1)
    return DepthScore((relative - 1).abs().nanmean(dim=-1), delta1, scale)
