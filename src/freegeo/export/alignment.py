"""Reconstructions of the same views brought into one world frame and scale."""

from __future__ import annotations

import numpy as np
import torch

from freegeo.export.reconstruction import Reconstruction
from freegeo.geometry.depth import valid_depth
from freegeo.geometry.rotation import mean_rotation
from freegeo.geometry.se3 import camera_centres
from freegeo.geometry.sim3 import Sim3


def align(estimate: Reconstruction, reference: Reconstruction) -> Sim3:
    """Similarity from an estimate's world frame to a reference's, both of the same views and size.

    The scale is the median ratio of depths, the rotation the mean over the cameras, the translation the median over
    their centres. Unlike a fit to the centres alone it also works for cameras on a line or in one place.
    """
    return similarity(estimate.depth_z, estimate.cameras()[0], reference.depth_z, reference.cameras()[0])


def similarity(depth: np.ndarray, T: np.ndarray, depth_reference: np.ndarray, T_reference: np.ndarray) -> Sim3:
    """Return what `align` does, for depth maps (S, H, W) and cameras (S, 4, 4)."""
    scale = median_ratio(depth_reference, depth)
    cameras, goal = torch.from_numpy(T).double(), torch.from_numpy(T_reference).double()
    R = mean_rotation(goal[:, :3, :3].mT @ cameras[:, :3, :3])
    t = (camera_centres(goal) - scale * camera_centres(cameras) @ R.mT).median(0).values
    return Sim3(s=torch.tensor(scale, dtype=torch.float64), R=R, t=t)


def median_ratio(reference: np.ndarray, estimate: np.ndarray) -> float:
    """Median of reference / estimate over pixels valid in both; 1 when there is none."""
    valid = valid_pixels(reference) & valid_pixels(estimate)
    return float(np.median(reference[valid] / estimate[valid])) if valid.any() else 1.0


def valid_pixels(depth_z: np.ndarray) -> np.ndarray:
    """Mask of usable depth, as `freegeo.geometry.depth.valid_depth`."""
    return valid_depth(torch.from_numpy(depth_z)).numpy()


def moved_cameras(T_cam_world: np.ndarray, move: Sim3) -> np.ndarray:
    """Cameras (S, 4, 4) float32 after a similarity of their world."""
    return move.apply_to_cameras(torch.from_numpy(T_cam_world).double()).float().numpy()
