"""Rigid transforms as 4x4 matrices.

``T_b_a`` takes coordinates in frame ``a`` to frame ``b``: ``T_c_a = T_c_b @ T_b_a``. Cameras are ``T_cam_world``.
"""

import torch
from torch import Tensor

from freegeo.errors import UserError
from freegeo.geometry.rotation import rotate

__all__ = ["camera_centres", "from_Rt", "inverse", "normalise_poses", "relative", "to_4x4", "transform_points"]

SMALLEST_MEDIAN_DISTANCE = 0.1  # the scale DA3 falls back to when most cameras share one place


def from_Rt(R: Tensor, t: Tensor) -> Tensor:
    """Transforms (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    leading = torch.broadcast_shapes(R.shape[:-2], t.shape[:-1])
    return to_4x4(torch.cat((R.expand(*leading, 3, 3), t.expand(*leading, 3)[..., None]), dim=-1))


def to_4x4(T: Tensor) -> Tensor:
    """Transforms (..., 3, 4) or (..., 4, 4) as (..., 4, 4).

    Raises:
        UserError: the last two dimensions are neither.
    """
    if T.shape[-2:] == (4, 4):
        return T
    if T.shape[-2:] != (3, 4):
        raise UserError(f"A camera pose must be a 3x4 or 4x4 matrix, got shape {tuple(T.shape)}.")
    last_row = torch.zeros_like(T[..., :1, :])
    last_row[..., 3] = 1.0
    return torch.cat((T, last_row), dim=-2)


def inverse(T: Tensor) -> Tensor:
    """Inverse (..., 4, 4) of rigid transforms (..., 4, 4): ``[R^T | -R^T t]``."""
    R_transposed = T[..., :3, :3].mT
    return from_Rt(R_transposed, -(R_transposed @ T[..., :3, 3:]).squeeze(-1))


def relative(T_a_world: Tensor, T_b_world: Tensor) -> Tensor:
    """``T_b_a``: takes coordinates of camera ``a`` to camera ``b``; all (..., 4, 4)."""
    return T_b_world @ inverse(T_a_world)


def camera_centres(T_cam_world: Tensor) -> Tensor:
    """Camera positions (..., 3) in the world frame of ``T_cam_world`` (..., 4, 4)."""
    return -(T_cam_world[..., :3, :3].mT @ T_cam_world[..., :3, 3:]).squeeze(-1)


def transform_points(T_b_a: Tensor, points: Tensor) -> Tensor:
    """Points (..., *any, 3) from frame ``a`` to frame ``b``; ``T_b_a`` is (..., 4, 4), same leading ``...``."""
    turned = rotate(T_b_a[..., :3, :3], points)
    translation = T_b_a[..., :3, 3]
    between = (1,) * (turned.ndim - translation.ndim)
    return turned + translation.reshape(*translation.shape[:-1], *between, 3)


def normalise_poses(T_cam_world: Tensor) -> Tensor:
    """Poses (..., S, 4, 4) as the DA3 camera encoder expects them (docs/models/da3.md, "Known cameras").

    The first view becomes the identity, and lengths are divided by the lower median distance of the camera centres from
    it (over all views, the first included), at least 0.1. With two views the divisor is therefore always 0.1.
    """
    from_first = T_cam_world @ inverse(T_cam_world[..., :1, :, :])
    distances = torch.linalg.vector_norm(camera_centres(from_first), dim=-1)
    # torch.median takes the smaller of two middle values, as the published rule does.
    scale = distances.median(dim=-1).values.clamp(min=SMALLEST_MEDIAN_DISTANCE)
    return from_Rt(from_first[..., :3, :3], from_first[..., :3, 3] / scale[..., None, None])
