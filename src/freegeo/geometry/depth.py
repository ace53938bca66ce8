"""Depth maps and their points. ``depth_z`` is the coordinate along the optical axis, not the distance to the camera."""

import torch
from torch import Tensor

from freegeo.geometry.camera import pixel_grid
from freegeo.geometry.se3 import inverse, transform_points

__all__ = ["depth_to_world", "unproject", "valid_depth"]

SMALLEST_DEPTH = 1e-8


def valid_depth(depth_z: Tensor) -> Tensor:
    """Mask of usable depth, same shape: finite and above 1e-8 (docs/models/vggt.md, "Unprojection")."""
    return torch.isfinite(depth_z) & (depth_z > SMALLEST_DEPTH)


def unproject(depth_z: Tensor, K: Tensor) -> Tensor:
    """Lift z-depth (..., H, W) to camera-frame points (..., H, W, 3); ``K`` (..., 3, 3) is in pixels of that map.

    Pixel centres have whole-number coordinates. Skew is respected. Invalid depth gives meaningless points: mask them
    with :func:`valid_depth`.
    """
    u, v, _ = pixel_grid((depth_z.shape[-2], depth_z.shape[-1]), like=K).unbind(-1)
    (focal_x, skew, centre_x), (_, focal_y, centre_y) = (
        (entry[..., None, None] for entry in K[..., row, :].unbind(-1)) for row in (0, 1)
    )
    y = (v - centre_y) / focal_y
    x = (u - centre_x - skew * y) / focal_x
    x, y, depth_z = torch.broadcast_tensors(x, y, depth_z)
    return torch.stack((x * depth_z, y * depth_z, depth_z), dim=-1)


def depth_to_world(depth_z: Tensor, K: Tensor, T_cam_world: Tensor) -> Tensor:
    """World points (..., H, W, 3) of depth maps (..., H, W) with ``K`` (..., 3, 3) and ``T_cam_world`` (..., 4, 4)."""
    return transform_points(inverse(T_cam_world), unproject(depth_z, K))
