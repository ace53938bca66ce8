"""Rotations: quaternions and matrices.

The order of a quaternion's numbers is part of every name: ``quat_xyzw`` (scalar last; the DA3 and VGGT heads) or
``quat_wxyz`` (scalar first; COLMAP). ``q`` and ``-q`` are the same rotation.
"""

import math
from typing import Any

import torch
from torch import Tensor

__all__ = [
    "closest_rotation",
    "matrix_to_quat_xyzw",
    "mean_rotation",
    "quat_wxyz_to_xyzw",
    "quat_xyzw_to_matrix",
    "quat_xyzw_to_wxyz",
    "rotate",
    "rotation_angle",
]

SMALLEST_DIVISOR = 0.1  # the models' published rule; never reached by a true rotation, whose largest entry is >= 1


def quat_wxyz_to_xyzw(quat_wxyz: Tensor) -> Tensor:
    """Scalar-first quaternions (..., 4) as scalar-last ones."""
    return quat_wxyz.roll(-1, dims=-1)


def quat_xyzw_to_wxyz(quat_xyzw: Tensor) -> Tensor:
    """Scalar-last quaternions (..., 4) as scalar-first ones."""
    return quat_xyzw.roll(1, dims=-1)


def quat_xyzw_to_matrix(quat_xyzw: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), which need not have unit length.

    The length is divided out (docs/models/da3.md, "Camera decoder"). The zero quaternion is no rotation and gives NaN.
    """
    x, y, z, w = quat_xyzw.unbind(-1)
    n = 2.0 / quat_xyzw.square().sum(-1)
    entries = (
        *(1 - n * (y * y + z * z), n * (x * y - z * w), n * (x * z + y * w)),
        *(n * (x * y + z * w), 1 - n * (x * x + z * z), n * (y * z - x * w)),
        *(n * (x * z - y * w), n * (y * z + x * w), 1 - n * (x * x + y * y)),
    )
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


def matrix_to_quat_xyzw(matrix: Tensor) -> Tensor:
    """Quaternions (..., 4), scalar last and ``w >= 0``, of rotation matrices (..., 3, 3).

    Of the four magnitudes of w, x, y, z the largest (first on ties) is taken and the others follow from it, which is
    accurate for every rotation, half turns included (docs/models/da3.md, "Known cameras"). The result is not
    renormalised: a matrix that is not quite a rotation gives a quaternion that is not quite of unit length.
    """
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = (row.unbind(-1) for row in matrix.unbind(-2))
    squares = torch.stack((m00 + m11 + m22, m00 - m11 - m22, m11 - m00 - m22, m22 - m00 - m11), dim=-1) + 1
    squares = squares.clamp(min=0)
    square_w, square_x, square_y, square_z = squares.unbind(-1)
    candidates_wxyz = (
        *(square_w, m21 - m12, m02 - m20, m10 - m01),
        *(m21 - m12, square_x, m10 + m01, m02 + m20),
        *(m02 - m20, m10 + m01, square_y, m12 + m21),
        *(m10 - m01, m20 + m02, m21 + m12, square_z),
    )
    candidates = torch.stack(candidates_wxyz, dim=-1).unflatten(-1, (4, 4))
    largest_square, choice = squares.max(dim=-1, keepdim=True)
    quat_wxyz = candidates.gather(-2, choice[..., None].expand(*choice.shape, 4)).squeeze(-2)
    quat_wxyz = quat_wxyz / (2 * largest_square.sqrt().clamp(min=SMALLEST_DIVISOR))
    quat_wxyz = torch.where(quat_wxyz[..., :1] < 0, -quat_wxyz, quat_wxyz)
    return quat_wxyz_to_xyzw(quat_wxyz)


def rotation_angle(matrix_a: Tensor, matrix_b: Tensor) -> Tensor:
    """Angle (...), radians 0..pi, of the rotation between two rotation matrices (..., 3, 3).

    Sine and cosine are both used, so tiny angles and half turns stay precise (an arc cosine loses half the digits).
    """
    relative = matrix_a.mT @ matrix_b
    skew = relative - relative.mT
    twice_sine = torch.stack((skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]), dim=-1)
    twice_cosine = relative.diagonal(dim1=-2, dim2=-1).sum(-1) - 1
    return torch.atan2(torch.linalg.vector_norm(twice_sine, dim=-1), twice_cosine)


def mean_rotation(matrices: Tensor, weights: Tensor | None = None) -> Tensor:
    """Rotation matrix (..., 3, 3) nearest to the mean of rotation matrices (..., S, 3, 3), by weights (..., S).

    The mean of the entries is projected onto the rotations by its singular vectors (the chordal mean), with the sign of
    the last one turned where the projection would be a reflection.
    """
    if weights is None:
        mean = matrices.mean(dim=-3)
    else:
        mean = (weights[..., None, None] * matrices).sum(dim=-3) / weights.sum(-1)[..., None, None]
    return closest_rotation(mean)


def rotate(matrix: Tensor, vectors: Tensor) -> Tensor:
    """Multiply vectors (..., *any, 3) by matrices (..., 3, 3), one matrix for all the ``any`` dimensions.

    The leading dimensions of ``matrix`` are the *first* dimensions of ``vectors``: one camera per view turns a whole
    (S, H, W, 3) map, and a single (3, 3) matrix turns anything.
    """
    leading = matrix.ndim - 2
    flat = vectors.reshape(*vectors.shape[:leading], math.prod(vectors.shape[leading:-1]), 3)
    return (flat @ matrix.mT).reshape(
        *torch.broadcast_shapes(vectors.shape[:leading], matrix.shape[:-2]), *vectors.shape[leading:]
    )


def closest_rotation(matrix: Tensor) -> Tensor:
    """Rotations (..., 3, 3) closest to matrices (..., 3, 3), in the sum of the squared differences of the entries.

    Its gradient is written out (docs/models/pi3.md, "Cameras"): the one of the SVD itself divides by differences of
    singular values, which all are 1 for a rotation.
    """
    return _ClosestRotation.apply(matrix)


class _ClosestRotation(torch.autograd.Function):
    """R = U diag(1, 1, e) V^T of the SVD U diag(s) V^T, with e = det(U V^T)."""

    @staticmethod
    def forward(ctx: Any, matrix: Tensor) -> Tensor:
        U, s, Vh = torch.linalg.svd(matrix)
        signs = torch.ones_like(s)
        signs[..., 2] = torch.linalg.det(U @ Vh).sign()
        ctx.save_for_backward(U, s, Vh, signs)
        return (U * signs[..., None, :]) @ Vh

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        [gradient] = gradients
        U, s, Vh, signs = ctx.saved_tensors
        E = signs[..., :, None] * (U.mT @ gradient @ Vh.mT)
        signed = signs * s
        sums = signed[..., :, None] + signed[..., None, :]
        # The diagonal is zero, whatever it is divided by.
        Z = (E - E.mT) / torch.where(torch.eye(3, dtype=torch.bool, device=s.device), 1, sums)
        return (U * signs[..., None, :]) @ Z @ Vh
