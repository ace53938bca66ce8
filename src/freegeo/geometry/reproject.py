"""Reprojection of the pixels of one view into another."""

from dataclasses import dataclass

import torch
from torch import Tensor

from freegeo.geometry.camera import project
from freegeo.geometry.depth import unproject, valid_depth
from freegeo.geometry.se3 import relative, transform_points

__all__ = ["Reprojection", "reproject"]


@dataclass(frozen=True, kw_only=True)
class Reprojection:
    """Pixels of a source view as seen by a target camera; H, W are the source's."""

    pixel: Tensor  # (..., H, W, 2) column and row in the target image; meaningless where in_view is False
    depth_z: Tensor  # (..., H, W) depth the target camera should measure there
    in_view: Tensor  # (..., H, W) bool: valid source depth, in front of the target and inside its image


def reproject(
    depth_z: Tensor,
    *,
    K_source: Tensor,
    T_source_world: Tensor,
    K_target: Tensor,
    T_target_world: Tensor,
    target_hw: tuple[int, int],
) -> Reprojection:
    """Carry every pixel of a source depth map (..., H, W) into a target camera.

    ``K_*`` (..., 3, 3) and ``T_*_world`` (..., 4, 4) are broadcast against each other. A pixel is in view when its
    nearest target pixel exists: coordinates from -0.5 to side - 0.5, as pixel centres are whole numbers.
    """
    T_target_source = relative(T_source_world, T_target_world)
    leading = torch.broadcast_shapes(depth_z.shape[:-2], T_target_source.shape[:-2], K_target.shape[:-2])
    usable = valid_depth(depth_z)
    # Invalid depth is replaced, so that no NaN reaches gradients through masked pixels.
    points = unproject(torch.where(usable, depth_z, 1.0), K_source)
    points = points.expand(*leading, *points.shape[-3:])
    points_target = transform_points(T_target_source, points)
    pixel = project(points_target, K_target)
    expected = points_target[..., 2]
    height, width = target_hw
    u, v = pixel.unbind(-1)
    inside = (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)
    return Reprojection(pixel=pixel, depth_z=expected, in_view=usable & valid_depth(expected) & inside)
