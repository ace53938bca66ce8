"""Surface normals of the points of depth maps, from the pixels beside each of them."""

from __future__ import annotations

import numpy as np
import torch

from freegeo.fusion.filtering import on_one_surface
from freegeo.fusion.points import PointCloud

_REACH = 2
"""Pixels on each side that `on_one_surface` looks at."""


def point_normals(
    cloud: PointCloud, depth_z: np.ndarray, T_cam_world: np.ndarray, K: np.ndarray, inside: np.ndarray
) -> np.ndarray:
    """Unit normals (n, 3) float32 of a cloud's points in the world, towards the camera; 0 where they are not known.

    The cross product of the steps to the neighbours along the row and along the column. A step counts if both pixels
    lie on one surface (`on_one_surface`); with neighbours on both sides it is their mean, and without any there is no
    normal. The maps are read one view at a time, and only at the cloud's pixels.

    Args:
        cloud: points of these maps, ordered by view.
        depth_z: (S, H, W); what is not finite and positive is no neighbour.
        T_cam_world: (S, 4, 4).
        K: (S, 3, 3).
        inside: (S, H, W) bool; pixels in the padding around a photo are no neighbours either.
    """
    normals = np.zeros((len(cloud), 3), np.float32)
    ends = np.searchsorted(cloud.view, np.arange(len(depth_z)), side="right").tolist()
    start = 0
    for view, end in enumerate(ends):
        if end > start:
            in_camera = _pixel_normals(
                np.where(inside[view], depth_z[view], np.nan), K[view].astype(np.float64), cloud.pixel[start:end]
            )
            normals[start:end] = in_camera @ T_cam_world[view, :3, :3]
        start = end
    return normals


def _pixel_normals(depth_z: np.ndarray, K: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """Normals (n, 3) in the camera's frame at pixels (n, 2) of a map (H, W)."""
    to_ray = np.linalg.inv(K)
    steps = []
    for axis in range(2):
        place = np.repeat(pixel[:, None], 2 * _REACH + 1, axis=1)
        place[..., axis] += np.arange(-_REACH, _REACH + 1)
        exists = (place[..., axis] >= 0) & (place[..., axis] < depth_z.shape[1 - axis])
        column, row = np.where(exists[..., None], place, 0).astype(np.int64).transpose(2, 0, 1)
        depth = depth_z[row, column].astype(np.float64)
        depth[~exists | ~(np.isfinite(depth) & (depth > 0))] = np.nan
        inverse = torch.from_numpy(1 / depth)[:, None]
        focal = torch.full((len(pixel),), K[axis, axis], dtype=torch.float64)
        before = on_one_surface(inverse, focal)[:, 0, _REACH].numpy()
        after = on_one_surface(inverse.flip(-1), focal)[:, 0, _REACH].numpy()
        rays = np.concatenate((place, np.ones((*place.shape[:2], 1))), axis=-1) @ to_ray.T
        points = (rays * depth[..., None])[:, _REACH - 1 : _REACH + 2]
        behind, ahead = points[:, 1] - points[:, 0], points[:, 2] - points[:, 1]
        total = np.where(before[:, None], behind, 0) + np.where(after[:, None], ahead, 0)
        steps.append(total / np.maximum(before.astype(int) + after, 1)[:, None])
    normals = np.cross(*steps)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    away = np.where((normals * points[:, 1]).sum(axis=1, keepdims=True) > 0, -1, 1)
    return away * np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
