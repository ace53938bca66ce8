"""Similarity transforms, and the alignment of a predicted camera trajectory with a reference one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from freegeo.errors import UserError
from freegeo.geometry.rotation import matrix_to_quat_xyzw, mean_rotation, rotate, rotation_angle
from freegeo.geometry.se3 import camera_centres, from_Rt, to_4x4

__all__ = [
    "NORMAL",
    "CameraAlignment",
    "CameraFit",
    "DegenerateAlignmentError",
    "Sim3",
    "align_cameras",
    "fit_cameras",
    "umeyama",
]

# Collinear float32 positions leave a second singular value of about 1e-14 of the first: rounding, not geometry.
SMALLEST_SINGULAR_RATIO = 1e-12
SHORT_PAIR = 0.05
"""Pairs of cameras nearer to each other than this share of the longest distance have no say in a scale."""
NORMAL = 1.4826
"""Standard deviation of a normal distribution in its median absolute deviations."""


class DegenerateAlignmentError(UserError):
    """The points do not determine a similarity transform: fewer than three, coincident, or all on one line."""


@dataclass(frozen=True, kw_only=True)
class Sim3:
    """``p_reference = s * R @ p_estimate + t`` with scale ``s`` (...), rotation ``R`` (..., 3, 3), ``t`` (..., 3)."""

    s: Tensor
    R: Tensor
    t: Tensor

    def apply(self, points: Tensor) -> Tensor:
        """Transform points (..., *any, 3); the leading dimensions of the transform are the first ones of the points."""
        turned = rotate(self.R, points)
        between = (1,) * (turned.ndim - self.t.ndim)
        scale = self.s.reshape(*self.s.shape, *between, 1)
        return scale * turned + self.t.reshape(*self.t.shape[:-1], *between, 3)

    def apply_to_cameras(self, T_cam_world: Tensor) -> Tensor:
        """Move cameras (..., S, 4, 4): ``R' = R R_world_cam``, ``c' = s R c + t``.

        The result is rigid; depth maps of these cameras must be multiplied by ``s``.
        """
        R_cam_world = T_cam_world[..., :3, :3] @ self.R.mT[..., None, :, :]
        centres = self.apply(camera_centres(T_cam_world))
        return from_Rt(R_cam_world, -(R_cam_world @ centres[..., None]).squeeze(-1))

    def inverse(self) -> Sim3:
        """The transform from the reference back to the estimate."""
        scale = 1 / self.s
        return Sim3(s=scale, R=self.R.mT, t=-scale[..., None] * rotate(self.R.mT, self.t))

    def __matmul__(self, other: Sim3) -> Sim3:
        """The transform that applies `other` first, then this one."""
        return Sim3(s=self.s * other.s, R=self.R @ other.R, t=self.apply(other.t))

    def __getitem__(self, index: int | Tensor) -> Sim3:
        """One or several transforms of a stack, by an index of their first dimension."""
        return Sim3(s=self.s[index], R=self.R[index], t=self.t[index])

    def to(self, dtype: torch.dtype) -> Sim3:
        """The same transform in another floating type."""
        return Sim3(s=self.s.to(dtype), R=self.R.to(dtype), t=self.t.to(dtype))

    def log(self) -> Tensor:
        """Logarithm (..., 7): axis times angle (3), at most pi; linear part of the translation (3); log of the scale.

        `Sim3.exp` is its inverse. ``S.inverse().log() == -S.log()``, but for half turns, whose axis has two signs.
        """
        quaternion = matrix_to_quat_xyzw(self.R)
        vector, w = quaternion[..., :3], quaternion[..., 3]
        sine = torch.linalg.vector_norm(vector, dim=-1)
        # Half the angle over its sine, whose limit at 0 is 1; the quaternion has w >= 0.
        ratio = torch.where(sine > 0, torch.atan2(sine, w) / sine.clamp(min=torch.finfo(sine.dtype).tiny), 1.0)
        axis_angle, log_scale = 2 * ratio[..., None] * vector, self.s.log()
        _, integral = _exponential(axis_angle, log_scale)
        linear = torch.linalg.solve(integral, self.t[..., None]).squeeze(-1)
        return torch.cat((axis_angle, linear, log_scale[..., None]), dim=-1)

    @classmethod
    def exp(cls, logarithm: Tensor) -> Sim3:
        """The transform whose `log` is `logarithm` (..., 7); angles above pi are understood too."""
        axis_angle, linear, log_scale = logarithm.split((3, 3, 1), dim=-1)
        log_scale = log_scale.squeeze(-1)
        turned, integral = _exponential(axis_angle, log_scale)
        scale = log_scale.exp()
        return cls(s=scale, R=turned / scale[..., None, None], t=(integral @ linear[..., None]).squeeze(-1))

    @classmethod
    def identity(cls, dtype: torch.dtype = torch.float64) -> Sim3:
        """The transform that changes nothing."""
        return cls(s=torch.ones((), dtype=dtype), R=torch.eye(3, dtype=dtype), t=torch.zeros(3, dtype=dtype))

    @classmethod
    def stack(cls, transforms: Sequence[Sim3]) -> Sim3:
        """Several transforms as one, along a new first dimension."""
        s, R, t = zip(*((each.s, each.R, each.t) for each in transforms), strict=True)
        return cls(s=torch.stack(s), R=torch.stack(R), t=torch.stack(t))


@dataclass(frozen=True, kw_only=True)
class CameraAlignment:
    """Outcome of :func:`align_cameras`."""

    sim3: Sim3  # estimate -> reference
    T_cam_world: Tensor  # (S, 4, 4) the estimated cameras in the reference's frame and scale
    inliers: Tensor  # (S,) bool: cameras the final fit rests on
    inlier_threshold: float | None  # in the reference's units; None without RANSAC


ScaleRule = Literal["least-squares", "symmetric", "one"]
"""How `umeyama` finds the scale."""


def umeyama(x: Tensor, y: Tensor, weights: Tensor | None = None, *, scale: ScaleRule = "least-squares") -> Sim3:
    """Least-squares similarity ``y ~ s R x + t`` (Umeyama 1991, equations 34 to 43).

    Args:
        x: (..., N, 3) points to move.
        y: (..., N, 3) where they should land.
        weights: optional (..., N) non-negative weights.
        scale: `least-squares` minimises ``|y - s R x - t|^2``; noise in `x` makes this scale too small. `symmetric`
            minimises ``|y - s R x - t|^2 / s`` (Horn 1987): without bias where both sets are equally noisy relative to
            their size, and exchanging them gives the inverse. `one`: a rigid transform, ``s = 1``.

    Returns:
        The transform, in the dtype of the inputs; computed in float64.

    Raises:
        DegenerateAlignmentError: the points of some batch element lie on one line or in one place, or are fewer than 3.
        UserError: a coordinate is not finite.
    """
    dtype = torch.promote_types(x.dtype, y.dtype)
    x, y = x.double(), y.double()
    if not (torch.isfinite(x).all() and torch.isfinite(y).all()):
        raise UserError("Cannot align points with NaN or infinite coordinates; remove those views first.")
    weights = x.new_ones(x.shape[:-1]) if weights is None else weights.double()
    weights = (weights / weights.sum(-1, keepdim=True))[..., None]
    mean_x, mean_y = (weights * x).sum(-2), (weights * y).sum(-2)
    centred_x, centred_y = x - mean_x[..., None, :], y - mean_y[..., None, :]
    U, D, Vh = torch.linalg.svd((weights * centred_y).mT @ centred_x)
    smallest = (D[..., 0] * SMALLEST_SINGULAR_RATIO).clamp(min=torch.finfo(torch.float64).eps)
    if not bool((D[..., 1] > smallest).all()):
        raise DegenerateAlignmentError(
            f"Cannot align {x.shape[-2]} points that lie on one line or in one place; "
            "use at least three views that do not move along a single line."
        )
    reflected = torch.linalg.det(U) * torch.linalg.det(Vh) < 0
    signs = torch.ones_like(D)
    signs[..., 2] = torch.where(reflected, -1.0, 1.0)
    R = (U * signs[..., None, :]) @ Vh
    spread_x = (weights * centred_x.square()).sum((-2, -1))
    if scale == "least-squares":
        s = (D * signs).sum(-1) / spread_x
    elif scale == "symmetric":
        s = ((weights * centred_y.square()).sum((-2, -1)) / spread_x).sqrt()
    else:
        s = torch.ones_like(spread_x)
    t = mean_y - s[..., None] * rotate(R, mean_x)
    return Sim3(s=s, R=R, t=t).to(dtype)


def align_cameras(
    reference_T_cam_world: Tensor,
    estimate_T_cam_world: Tensor,
    *,
    ransac: bool = True,
    seed: int = 42,
    iterations: int = 10,
    subset_size: int | None = None,
    inlier_threshold: float | None = None,
) -> CameraAlignment:
    """Align estimated cameras with reference cameras by their centres (docs/benchmark.md, "Fusion and scoring").

    With ``ransac`` (always, in scoring), ten random subsets of half of the views are fitted, the one with most inliers
    wins, and the transform is refitted on its inliers. Subsets come from ``numpy.random.default_rng(seed)``, so the
    result is the benchmark's, draw by draw.

    Args:
        reference_T_cam_world: (S, 3 or 4, 4).
        estimate_T_cam_world: (S, 3 or 4, 4), same order.
        ransac: off: one fit of all centres.
        seed: of the subsets.
        iterations: number of subsets.
        subset_size: views per subset; default ``max(3, (S + 1) // 2)``.
        inlier_threshold: largest centre distance of an inlier, in the reference's units; default: median distance
            from the estimated centres, aligned by a first fit of all, to their nearest reference centre.

    Returns:
        The alignment, in the promoted dtype of the inputs.

    Raises:
        DegenerateAlignmentError: the centres lie on one line or in one place, or there are fewer than three.
        UserError: different numbers of views, or non-finite poses.
    """
    if len(reference_T_cam_world) != len(estimate_T_cam_world):
        raise UserError(
            f"Cannot align {len(estimate_T_cam_world)} estimated cameras with {len(reference_T_cam_world)} reference "
            "cameras; pass the same views in the same order."
        )
    dtype = torch.promote_types(reference_T_cam_world.dtype, estimate_T_cam_world.dtype)
    estimate_cameras = to_4x4(estimate_T_cam_world).double()
    reference = camera_centres(to_4x4(reference_T_cam_world).double())
    estimate = camera_centres(estimate_cameras)
    fit = umeyama(estimate, reference)
    inliers = torch.ones(len(estimate), dtype=torch.bool, device=estimate.device)
    if ransac:
        if inlier_threshold is None:
            inlier_threshold = _median_nearest_distance(fit.apply(estimate), reference)
        size = max(3, (len(estimate) + 1) // 2) if subset_size is None else subset_size
        subsets = _draw_subsets(len(estimate), size, iterations, seed)
        fit, inliers = _consensus(estimate, reference, fit, subsets, inlier_threshold)
    aligned = fit.apply_to_cameras(estimate_cameras)
    threshold = inlier_threshold if ransac else None
    return CameraAlignment(
        sim3=fit.to(dtype), T_cam_world=aligned.to(dtype), inliers=inliers, inlier_threshold=threshold
    )


def _exponential(axis_angle: Tensor, log_scale: Tensor) -> tuple[Tensor, Tensor]:
    """``exp(A)`` and the integral of ``exp(a A)`` over a = 0..1, where ``A`` is the cross product plus the log scale.

    Both (..., 3, 3) are blocks of one matrix exponential, which needs no series for small angles.
    """
    x, y, z = axis_angle.unbind(-1)
    A = torch.stack((log_scale, -z, y, z, log_scale, -x, -y, x, log_scale), dim=-1).unflatten(-1, (3, 3))
    eye = torch.eye(3, dtype=A.dtype, device=A.device).expand_as(A)
    upper = torch.cat((A, eye), dim=-1)
    both = torch.linalg.matrix_exp(torch.cat((upper, torch.zeros_like(upper)), dim=-2))
    return both[..., :3, :3], both[..., :3, 3:]


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraFit:
    """How cameras are brought to other ones of the same views, which are known."""

    sim3: Sim3
    """From the world of the cameras to that of the known ones."""
    has_scale: bool
    """Whether the known cameras give a scale; else it is 1."""
    spread: float | None
    """Relative spread (one standard deviation) of the scales that pairs of cameras give; None: one pair or none."""
    rotation_deg: float
    """Median angle between the cameras and the known ones."""
    position: float | None
    """Median distance between them, as a share of the longest one between known cameras; None without a scale."""


def fit_cameras(predicted: Tensor, known: Tensor) -> CameraFit:
    """Fit cameras (S, 4, 4) to known ones of the same views.

    The rotation is the mean over the cameras, the scale the median over pairs of the ratio of their distances, and the
    translation the median over the centres: unlike a fit to the centres alone this needs no more than two cameras, and
    they may be on one line. DegenerateAlignmentError when the cameras are all in one place and the known ones are not.
    """
    predicted, known = predicted.double(), known.double()
    R = mean_rotation(known[:, :3, :3].mT @ predicted[:, :3, :3])
    here, there = camera_centres(predicted), camera_centres(known)
    first, second = torch.triu_indices(len(here), len(here), 1)
    distance, wanted = ((x[first] - x[second]).norm(dim=-1) for x in (here, there))
    longest = float(wanted.max()) if len(wanted) else 0.0
    has_scale = longest > 1e-9 * float(there.abs().max())
    scale, spread = 1.0, None
    if has_scale:
        far = wanted > SHORT_PAIR * longest
        logs = (wanted[far] / distance[far]).log()
        scale = float(logs.quantile(0.5).exp())
        if not 0 < scale < float("inf"):
            raise DegenerateAlignmentError("Cannot align cameras in one place; use photos with more motion.")
        if len(logs) > 1:
            spread = NORMAL * float((logs - logs.quantile(0.5)).abs().quantile(0.5))
    t = (there - scale * here @ R.mT).quantile(0.5, dim=0)
    sim3 = Sim3(s=torch.tensor(scale, dtype=torch.float64), R=R, t=t)
    moved = sim3.apply_to_cameras(predicted)
    apart = (camera_centres(moved) - there).norm(dim=-1).quantile(0.5)
    angle = rotation_angle(moved[:, :3, :3], known[:, :3, :3]).quantile(0.5)
    return CameraFit(
        sim3=sim3, has_scale=has_scale, spread=spread, rotation_deg=float(torch.rad2deg(angle)),
        position=float(apart) / longest if has_scale else None,
    )  # fmt: skip


def _draw_subsets(count: int, size: int, iterations: int, seed: int) -> list[list[int]]:
    if size > count:
        raise UserError(f"Cannot draw subsets of {size} views from {count}; lower the subset size.")
    generator = np.random.default_rng(seed)
    return [generator.choice(np.arange(count), size=size, replace=False).tolist() for _ in range(iterations)]


def _median_nearest_distance(aligned: Tensor, reference: Tensor) -> float:
    # Differences, not torch.cdist, whose matrix-product form loses the small distances this threshold is made of.
    distances = torch.linalg.vector_norm(aligned[:, None] - reference[None], dim=-1)
    return float(distances.min(dim=1).values.quantile(0.5))


def _consensus(
    estimate: Tensor, reference: Tensor, first_fit: Sim3, subsets: list[list[int]], threshold: float
) -> tuple[Sim3, Tensor]:
    """The fit with most inliers, ties to the smaller mean inlier error, refitted on its inliers if there are three."""
    best_fit, best_inliers, best_key = first_fit, None, (-1, 0.0)
    for subset in subsets:
        try:
            fit = umeyama(estimate[subset], reference[subset])
        except DegenerateAlignmentError:
            continue
        errors = torch.linalg.vector_norm(fit.apply(estimate) - reference, dim=-1)
        inliers = errors <= threshold
        mean_error = float(errors[inliers].mean()) if bool(inliers.any()) else float("inf")
        key = (int(inliers.sum()), -mean_error)
        if key > best_key:
            best_fit, best_inliers, best_key = fit, inliers, key
    if best_inliers is None:
        return first_fit, torch.ones(len(estimate), dtype=torch.bool, device=estimate.device)
    if int(best_inliers.sum()) >= 3:
        best_fit = umeyama(estimate[best_inliers], reference[best_inliers])
    return best_fit, best_inliers
