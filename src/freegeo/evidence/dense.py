"""Agreement of dense predictions: between views, between predictions, and between the heads of one model.

These scores need no matches (docs/evidence.md, "Scores"). None of them is safe alone: blurred depth and cameras that
collapse into one place agree well, and two heads may be wrong together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from freegeo.evidence.candidate import Candidate
from freegeo.fusion.agreement import QUANTILE, TOLERANCE_NEIGHBOURS, nearest_views, relative_slope, tolerance_from
from freegeo.geometry.depth import depth_to_world, valid_depth
from freegeo.geometry.se3 import relative
from freegeo.metrics.pose import area_under_curve, pair_errors

__all__ = [
    "CoVisible",
    "DepthAgreement",
    "Difference",
    "camera_difference",
    "co_visible",
    "confirmed_share",
    "depth_agreement",
    "point_difference",
    "stability",
]

SAMPLES = 2048
"""Most pixels of a view that take part, on an even grid."""
LARGEST_LOG = float(np.log(2))
"""A pixel that misses the other view, or differs by more than a factor of two, counts as a factor of two."""
_NOTHING_SHARED = "No two views see the same surface."


@dataclass(frozen=True, kw_only=True, eq=False)
class CoVisible:
    """Pixels that another view sees too, by one prediction: the fixed set on which candidates are compared."""

    pixel: Tensor
    """(G,) int64 flat indices into a depth map, the same for all views."""
    seen: Tensor
    """(S, S, G) bool: whether the second view sees what the first has there; false for a view and itself."""
    beyond: Tensor
    """(S, S, G) by how much the second view's depth differs there from what the first's says, beyond the local slope:
    log ratio; nan where it has none. A difference up to a tolerance confirms the first."""
    share: np.ndarray
    """(S, S) share of each view's known pixels that the other view sees, for `choose_pairs`."""
    tolerance: float
    """Relative depth difference that counts as the same surface."""

    @property
    def pairs(self) -> np.ndarray:
        """(D, 2) int64 source and target views with a pixel in common, sorted."""
        return torch.nonzero(self.seen.any(-1)).cpu().numpy()


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthAgreement:
    """Agreement of a candidate's depth maps on the fixed pixels."""

    pairs: np.ndarray
    """(D, 2) int64 source and target views."""
    share: np.ndarray
    """(D,) share of pixels whose depth the target view confirms, higher is better; nan without pixels."""
    log_ratio: np.ndarray
    """(D,) mean of abs(log(measured / expected depth)), each at most log 2, lower is better; nan without pixels."""
    reason: str | None
    """Why no pair has a value; None when one has."""

    @property
    def mean_share(self) -> float:
        """Mean over the pairs; nan without any."""
        return _mean(self.share)

    @property
    def mean_log_ratio(self) -> float:
        """Mean over the pairs; nan without any."""
        return _mean(self.log_ratio)


@dataclass(frozen=True, kw_only=True)
class Difference:
    """How far two predictions of the same views are apart; nan where there is nothing to compare."""

    pose_deg: float
    """Mean over pairs of views of the larger of rotation and translation direction angle."""
    pose_area: float
    """Area under the recall curve of that angle up to 30 degrees, 1 for equal poses."""
    focal_log: float
    """Mean of abs(log) of the ratio of focal lengths."""
    depth_log: float
    """Median of abs(log) of the ratio of depths after one common scale."""


def co_visible(candidate: Candidate, usable: Tensor | None = None) -> CoVisible:
    """Find the pixels of each view that other views see, by this prediction (the frozen model's).

    A pixel is seen when its point falls into the other image and no nearer surface hides it there.

    Args:
        candidate: its cameras and depth decide.
        usable: (S, H, W) bool, pixels that may take part (no sky, inside a mask); None: all with known depth.
    """
    depth = candidate.depth_z
    known = valid_depth(depth) if usable is None else valid_depth(depth) & usable.to(depth.device)
    height, width = depth.shape[1:]
    step = max(1, int(np.ceil(np.sqrt(height * width / SAMPLES))))
    grid = torch.arange(height * width, device=depth.device).view(height, width)
    grid = grid[step // 2 :: step, step // 2 :: step].flatten()
    tolerance = _tolerance(candidate, known.flatten(1), grid)
    slope = _slope(depth)
    seen, beyond = [], []
    for source in range(len(depth)):
        expected, measured, landed = _meet(candidate, source, grid)
        beyond.append((measured / expected).log().abs() - slope.gather(1, landed))
        seen.append((expected <= measured * (1 + tolerance)) & known[source].flatten()[grid])  # false for nan
        seen[-1][source] = False
    nothing = depth.new_zeros((0, 0, len(grid)))
    everything = torch.stack(seen) if seen else nothing.bool()
    possible = known.flatten(1)[:, grid].sum(-1).clamp(min=1)
    return CoVisible(
        pixel=grid,
        seen=everything,
        beyond=torch.stack(beyond) if beyond else nothing,
        share=(everything.sum(-1) / possible[:, None]).cpu().double().numpy(),
        tolerance=tolerance,
    )


def depth_agreement(candidate: Candidate, fixed: CoVisible) -> DepthAgreement:
    """S3: whether views confirm each other's depth on a fixed set of pixels.

    The set and the tolerance come from one prediction (`co_visible`), so that a candidate gains nothing by moving
    surfaces out of sight: what misses the other image, or has no depth there, is a disagreement.
    """
    depth = candidate.depth_z
    slope = _slope(depth)
    pairs = fixed.pairs
    share, log_ratio = [], []
    for source in range(len(depth)):
        expected, measured, landed = _meet(candidate, source, fixed.pixel)
        seen = fixed.seen[source]
        log = (measured / expected).log().abs()
        confirmed = log <= fixed.tolerance + slope.gather(1, landed)  # false for nan
        clipped = log.nan_to_num(LARGEST_LOG).clamp(max=LARGEST_LOG)
        count = seen.sum(-1)
        share.append((confirmed & seen).sum(-1) / count)
        log_ratio.append((clipped * seen).sum(-1) / count)
    values = torch.stack((torch.stack(share), torch.stack(log_ratio))).cpu().double().numpy()[:, *pairs.T]
    return DepthAgreement(
        pairs=pairs, share=values[0], log_ratio=values[1], reason=None if len(pairs) else _NOTHING_SHARED
    )


def confirmed_share(prediction: CoVisible, fixed: CoVisible, tolerance: float) -> float:
    """Return `depth_agreement(...).mean_share` of a prediction, whose own pixels are given, on another's; cheap."""
    confirmed = (prediction.beyond <= tolerance) & fixed.seen  # false for nan
    return _mean((confirmed.sum(-1) / fixed.seen.sum(-1)).cpu().double().numpy())


def stability(candidate: Candidate, others: Sequence[tuple[Sequence[int], Candidate]]) -> list[Difference]:
    """S4: how far predictions from other subsets, orders or reference views are from this one.

    Args:
        candidate: the prediction from all views.
        others: for each other prediction, which of these views it has, in its order, and the prediction.
    """
    return [_difference(candidate.select(list(views)), other) for views, other in others]


def camera_difference(candidate: Candidate, T_cam_world: Tensor, K: Tensor) -> Difference:
    """S5: how far a second head's cameras are from the candidate's, such as those of DA3's rays.

    Args:
        candidate: its cameras come from the camera head.
        T_cam_world: (S, 4, 4) of the same views.
        K: (S, 3, 3) pixels of the model's images.
    """
    pose_deg, area, focal = _camera_difference(candidate, T_cam_world, K)
    return Difference(pose_deg=pose_deg, pose_area=area, focal_log=focal, depth_log=float("nan"))


def point_difference(candidate: Candidate, points: Tensor, usable: Tensor | None = None) -> float:
    """S5: distance of a point head's world points from the candidate's depth and cameras, as VGGT predicts both.

    Args:
        candidate: depth and cameras.
        points: (S, H, W, 3) in the same world frame and scale.
        usable: (S, H, W) bool; None: all with known depth.

    Returns:
        Mean over views of the median distance as a share of depth; nan without a usable pixel.
    """
    depth = candidate.depth_z
    T, K = _cameras(candidate)
    known = valid_depth(depth) & points.isfinite().all(-1)
    known = known if usable is None else known & usable.to(known.device)
    away = torch.linalg.vector_norm(depth_to_world(depth, K, T) - points.to(depth), dim=-1) / depth
    medians = [view[mask].median() for view, mask in zip(away, known, strict=True) if mask.any()]
    return float(torch.stack(medians).mean()) if medians else float("nan")


def _difference(one: Candidate, two: Candidate) -> Difference:
    if one.depth_z.shape != two.depth_z.shape:
        raise ValueError(f"depth maps of the shapes {tuple(one.depth_z.shape)} and {tuple(two.depth_z.shape)}")
    pose_deg, area, focal = _camera_difference(one, two.T_cam_world, two.K)
    a, b = one.depth_z, two.depth_z.to(one.depth_z.device)
    known = valid_depth(a) & valid_depth(b)
    log = (a[known] / b[known]).log()
    depth_log = float((log - log.median()).abs().median()) if len(log) else float("nan")
    return Difference(pose_deg=pose_deg, pose_area=area, focal_log=focal, depth_log=depth_log)


def _camera_difference(candidate: Candidate, T_cam_world: Tensor, K: Tensor) -> tuple[float, float, float]:
    T, K = T_cam_world.detach().cpu().double(), K.detach().cpu().double()
    if len(T) != len(candidate):
        raise ValueError(f"{len(T)} cameras for {len(candidate)} views")
    focal = (K.diagonal(dim1=-2, dim2=-1) / candidate.K.diagonal(dim1=-2, dim2=-1))[:, :2].log().abs()
    worst = pair_errors(T, candidate.T_cam_world).worst_deg
    pose = float(worst.mean()) if len(worst) else float("nan")
    return pose, float(area_under_curve(worst, 30)), float(focal.mean())


def _cameras(candidate: Candidate) -> tuple[Tensor, Tensor]:
    """Return poses and intrinsics with the type and on the device of the depth."""
    return candidate.T_cam_world.to(candidate.depth_z), candidate.K.to(candidate.depth_z)


def _slope(depth_z: Tensor) -> Tensor:
    """Relative slope (S, H W) of depth maps (S, H, W), 0 where it is not known; view by view, as it takes much room."""
    slope = torch.empty_like(depth_z)
    for view, depth in enumerate(depth_z):
        slope[view] = relative_slope(torch.where(valid_depth(depth), depth, torch.nan))
    return slope.flatten(1)


def _tolerance(candidate: Candidate, known: Tensor, grid: Tensor) -> float:
    """Return the tolerance of `tolerance_of` by the pixels (G,) of the grid alone; `known` (S, H W) may take part."""
    found = []
    for source, targets in enumerate(nearest_views(candidate.T_cam_world, TOLERANCE_NEIGHBOURS)):
        expected, measured, landed = _meet(candidate, source, grid, targets)
        usable = known[targets.to(known.device)].gather(1, landed) & known[source, grid]
        found.append((measured / expected - 1).abs()[usable])
    differences = torch.cat([candidate.depth_z.new_zeros(0), *found])
    differences = differences[~differences.isnan()]
    return tolerance_from(float(differences.quantile(QUANTILE)) if len(differences) else float("nan"))


def _meet(
    candidate: Candidate, source: int, pixels: Tensor, targets: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Depth (S, n) that every view should measure at the points of source pixels (n,), what it has there, and where.

    With `targets` (t,), numbers of views, only these are asked (t, n). The measured depth is nan where the point misses
    the image, lies behind the camera, or has no depth on either side; the place is a flat index into the view's map,
    meaningless there.
    """
    asked = candidate if targets is None else candidate.select(targets.tolist())
    depth, own = asked.depth_z, candidate.depth_z[source].flatten()[pixels]
    height, width = depth.shape[1:]
    # Relative poses in double precision: a world frame far from the cameras costs no digits.
    T = relative(candidate.T_cam_world[source], asked.T_cam_world)
    # From the source's pixels, times depth, to those of every view, in one product.
    to_pixels = (asked.K @ T[:, :3, :3] @ torch.linalg.inv(candidate.K[source])).to(depth)
    shift = (asked.K @ T[:, :3, 3:]).to(depth)
    place = torch.stack((pixels % width, pixels // width, torch.ones_like(pixels))).to(depth)
    x, y, expected = (to_pixels @ (place * torch.where(valid_depth(own), own, torch.nan)) + shift).unbind(1)
    column, row = (x / expected + 0.5).floor(), (y / expected + 0.5).floor()
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & valid_depth(expected)
    landed = torch.where(inside, row * width + column, 0.0).long()
    measured = depth.flatten(1).gather(1, landed)
    return expected, torch.where(inside & valid_depth(measured), measured, torch.nan), landed


def _mean(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")
