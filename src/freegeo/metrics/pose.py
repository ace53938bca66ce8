"""Pose score of the published evaluation: relative errors over all view pairs and the area under their recall curve.

Every function takes world-to-camera matrices `T_cam_world` (OpenCV axes) and works in the floating type of its inputs:
the published numbers are float32 numbers. The scale and the world frame of the prediction do not matter.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from freegeo.errors import UserError
from freegeo.geometry import se3

THRESHOLDS_DEG = (3, 5, 15, 30)
FAILED_DEG = 1e6
_EPSILON = 1e-15


class PairErrors(NamedTuple):
    """Errors of the view pairs (0, 1), (0, 2), ..., (0, S-1), (1, 2), ..., each (..., P) degrees, P = S (S-1) / 2."""

    rotation_deg: Tensor
    """Full angle between the two relative rotations, 0 to 180; NaN where a matrix is not finite."""
    translation_deg: Tensor
    """Angle between the two baselines up to sign, 0 to 90; 1e6 where it is not finite."""

    @property
    def worst_deg(self) -> Tensor:
        """The error a pair is scored by, the larger of the two (..., P); NaN when either is."""
        return torch.maximum(self.rotation_deg, self.translation_deg)


def pair_errors(T_cam_world_pred: Tensor, T_cam_world_gt: Tensor) -> PairErrors:
    """Relative pose errors of all view pairs.

    Both trajectories are first moved into the frame of their own first view, then `T_i^-1 T_j` is compared for i < j.
    A zero baseline in either trajectory gives 90 degrees.

    Args:
        T_cam_world_pred: (..., S, 3, 4) or (..., S, 4, 4), in any similarity frame.
        T_cam_world_gt: the same views in the same order, (..., S, 3, 4) or (..., S, 4, 4).

    Raises:
        UserError: the two disagree in the number of views, or are not stacks of pose matrices.

    Source: docs/benchmark.md, "Pose score".
    """
    _check_poses(T_cam_world_pred, T_cam_world_gt)
    T_pred, T_gt = _relative_poses(T_cam_world_pred), _relative_poses(T_cam_world_gt)
    rotation_deg = _rotation_error_deg(T_pred[..., :3, :3], T_gt[..., :3, :3])
    return PairErrors(rotation_deg, _direction_error_deg(T_pred[..., :3, 3], T_gt[..., :3, 3]))


def area_under_curve(errors_deg: Tensor, threshold_deg: int) -> Tensor:
    """Mean over k = 1..T of the share of errors below k degrees; at the last k an error of exactly T still counts.

    Args:
        errors_deg: (..., P); NaN counts as a failure and stays in the denominator.
        threshold_deg: T, a positive whole number of degrees.

    Returns:
        (...) float64 in [0, 1]; NaN when there is no pair.

    Source: docs/benchmark.md, "Pose score".
    """
    if threshold_deg != int(threshold_deg) or threshold_deg < 1:
        raise UserError(f"The threshold of a pose score is a whole number of degrees from 1 up, not {threshold_deg}.")
    edges = torch.arange(1, int(threshold_deg) + 1, dtype=errors_deg.dtype, device=errors_deg.device)
    below = errors_deg[..., None] < edges
    below[..., -1] |= errors_deg == threshold_deg
    return below.double().mean(dim=-2).mean(dim=-1)


def pose_auc(errors_deg: Tensor, thresholds: tuple[int, ...] = THRESHOLDS_DEG) -> dict[str, float]:
    """Score of one scene, with keys such as `auc03` and `auc30`; values are fractions.

    Args:
        errors_deg: (P,) worst error of each pair, as in `pair_errors(...).worst_deg`.
        thresholds: whole degrees.
    """
    if errors_deg.ndim != 1:
        raise UserError(f"pose_auc scores one scene, pairs (P,), not {tuple(errors_deg.shape)}; use area_under_curve.")
    return {f"auc{threshold:02d}": float(area_under_curve(errors_deg, threshold)) for threshold in thresholds}


def score_poses(
    T_cam_world_pred: Tensor, T_cam_world_gt: Tensor, thresholds: tuple[int, ...] = THRESHOLDS_DEG
) -> dict[str, float]:
    """`pose_auc` of the pair errors of one scene; matrices (S, 3, 4) or (S, 4, 4)."""
    return pose_auc(pair_errors(T_cam_world_pred, T_cam_world_gt).worst_deg, thresholds)


def _check_poses(T_pred: Tensor, T_gt: Tensor) -> None:
    for name, T in (("predicted", T_pred), ("ground-truth", T_gt)):
        if T.ndim < 3 or tuple(T.shape[-2:]) not in ((3, 4), (4, 4)):
            raise UserError(f"The {name} poses must have shape (..., S, 3, 4) or (..., S, 4, 4), not {tuple(T.shape)}.")
    if T_pred.shape[:-2] != T_gt.shape[:-2]:
        raise UserError(f"Poses {tuple(T_pred.shape)} and ground truth {tuple(T_gt.shape)} are not of the same views.")


def _relative_poses(T: Tensor) -> Tensor:
    """`T_i^-1 T_j` over pairs i < j, (..., P, 4, 4), after moving to the frame of the first view.

    Not the usual camera-to-camera matrix `T_j T_i^-1`, hence the first view matters. Whole matrices are multiplied,
    inverses included, so that float32 rounding falls as in the published evaluation.
    """
    T = se3.to_4x4(T)
    T = T @ se3.inverse(T[..., :1, :, :])
    first, second = torch.triu_indices(T.shape[-3], T.shape[-3], offset=1, device=T.device)
    return se3.inverse(T)[..., first, :, :] @ T[..., second, :, :]


def _rotation_error_deg(R_pred: Tensor, R_gt: Tensor) -> Tensor:
    finite = R_pred.isfinite().all(-1).all(-1) & R_gt.isfinite().all(-1).all(-1)
    similarity = (_quaternion(R_pred) * _quaternion(R_gt)).sum(-1)
    half_sine_squared = (1 - similarity**2).clamp_min(_EPSILON)
    error = torch.rad2deg(torch.arccos(1 - 2 * half_sine_squared))
    return error.masked_fill(~finite, float("nan"))


def _quaternion(R: Tensor) -> Tensor:
    """Quaternion (..., 4), scalar last, by the largest of its four numbers.

    Not the function of `freegeo.geometry`: near zero the error is rounding of float32 and of matrices that are not
    quite rotations. The order of operations, and not normalising the result, affect the published numbers.
    """
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = R.flatten(-2).unbind(-1)
    traces = [1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22, 1 + m00 + m11 + m22]
    double = torch.stack(traces, dim=-1).clamp_min(0).sqrt()  # twice |x|, |y|, |z|, |w|
    xx, yy, zz, ww = double.square().unbind(-1)
    xy, xz, yz = m10 + m01, m02 + m20, m12 + m21
    xw, yw, zw = m21 - m12, m02 - m20, m10 - m01
    rows = [(xx, xy, xz, xw), (xy, yy, yz, yw), (xz, yz, zz, zw), (xw, yw, zw, ww)]
    four_q_q = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)  # each row is 4 q_k q
    best = double.argmax(dim=-1)[..., None]
    chosen = four_q_q.take_along_dim(best[..., None], dim=-2)[..., 0, :]
    return chosen / (2 * double.take_along_dim(best, dim=-1))


def _direction_error_deg(t_pred: Tensor, t_gt: Tensor) -> Tensor:
    unit_pred = t_pred / (t_pred.norm(dim=-1, keepdim=True) + _EPSILON)
    unit_gt = t_gt / (t_gt.norm(dim=-1, keepdim=True) + _EPSILON)
    cosine = (unit_pred * unit_gt).sum(-1)
    sine_squared = (1 - cosine**2).clamp_min(_EPSILON)
    error = torch.rad2deg(torch.arccos((1 - sine_squared).sqrt()))
    return torch.where(error.isfinite(), error, torch.full_like(error, FAILED_DEG))
