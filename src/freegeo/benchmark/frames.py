"""The input of the fusion: a stored prediction turned into metric depth maps with cameras, frame by frame."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from freegeo.data.datasets.base import DatasetConstants
from freegeo.data.datasets.registry import constants, valid_mask
from freegeo.data.scene import Scene, SceneTruth
from freegeo.errors import UserError
from freegeo.geometry.camera import resize_K
from freegeo.geometry.resample import resize_nearest
from freegeo.geometry.sim3 import align_cameras
from freegeo.types import Prediction


@dataclass(frozen=True)
class FusionFrame:
    """One frame ready for the fusion."""

    depth_z: Tensor
    """(H, W) float32 metres; values that are not finite or not positive are holes."""
    K: Tensor
    """(3, 3) float32."""
    T_cam_world: Tensor
    """(4, 4), in the frame of the ground truth."""


def fusion_frames(scene: Scene, prediction: Prediction, *, posed: bool = False) -> Iterator[FusionFrame]:
    """Align a prediction with the ground-truth cameras and yield its frames at the size they are fused at.

    Args:
        scene: the frames of the prediction, in its order, with ground truth.
        prediction: depth (S, h, w), T_cam_world (S, 4, 4) and K (S, 3, 3) at the network's size.
        posed: fuse with the known cameras; the scale of the depth is estimated all the same.

    Raises:
        UserError: views do not match or something is missing. FreeGeoError: the cameras cannot be aligned.

    Source: docs/benchmark.md, "Fusion and scoring".
    """
    truth, known_T, known_K = require_truth(scene)
    fixed = constants(truth.dataset)
    depth, T, K = require_prediction(scene, prediction)
    aligned = align_cameras(known_T, T.double())
    for index, photo in enumerate(scene.photos):
        size_hw = fixed.fusion_hw or photo.size_hw
        resized = _resized(depth[index].float(), truth.camera_hw[index], size_hw, fixed)
        metric = _masked(resized, valid_mask(truth, index, size_hw)) * float(aligned.sim3.s)
        if posed:
            camera = _posed_K(known_K[index].float(), truth, index, size_hw, fixed)
            yield FusionFrame(metric, camera, known_T[index])
        else:
            camera = resize_K(K[index].float(), (depth.shape[-2], depth.shape[-1]), size_hw)
            yield FusionFrame(metric, camera, aligned.T_cam_world[index])


def require_truth(scene: Scene) -> tuple[SceneTruth, Tensor, Tensor]:
    """Ground-truth files, poses and intrinsics of a scene; UserError when it has none."""
    if scene.truth is None or scene.T_cam_world is None or scene.K is None:
        raise UserError(f"Scene {scene.name} has no ground truth to be scored against.")
    return scene.truth, scene.T_cam_world, scene.K


def require_prediction(scene: Scene, prediction: Prediction) -> tuple[Tensor, Tensor, Tensor]:
    """Depth, poses and intrinsics of a prediction, on the CPU.

    UserError when one is missing or the views are not the scene's.
    """
    depth, T, K = prediction.depth_z, prediction.T_cam_world, prediction.K
    if depth is None or T is None or K is None:
        raise UserError(f"The prediction of scene {scene.name} lacks depth or cameras and cannot be scored.")
    views = len(scene.photos)
    if (len(depth), len(T), len(K)) != (views,) * 3:
        raise UserError(f"The prediction of scene {scene.name} has {len(depth)} views, the chosen frames are {views}.")
    return depth.cpu(), T.cpu(), K.cpu()


def _resized(depth: Tensor, camera_hw: tuple[int, int], size_hw: tuple[int, int], fixed: DatasetConstants) -> Tensor:
    if fixed.fusion_hw is None:
        return resize_nearest(depth, size_hw)
    import cv2

    at_camera = resize_nearest(depth, camera_hw).numpy()
    return torch.from_numpy(cv2.resize(at_camera, size_hw[::-1], interpolation=cv2.INTER_LINEAR))


def _masked(depth: Tensor, mask: np.ndarray | None) -> Tensor:
    """Set depth that must not be fused to 0; with a mask by a product, as published: NaN and infinity become NaN."""
    if mask is None:
        return torch.where(depth.isfinite() & (depth > 0), depth, 0.0)
    if tuple(mask.shape) != tuple(depth.shape):
        raise UserError(f"A mask of {mask.shape} does not fit a depth map of {tuple(depth.shape)}.")
    return depth * (torch.from_numpy(mask) & depth.isfinite())


def _posed_K(K: Tensor, truth: SceneTruth, index: int, size_hw: tuple[int, int], fixed: DatasetConstants) -> Tensor:
    if fixed.fusion_hw is None:
        return K
    shifted = K.clone()
    shifted[:2, 2] += fixed.posed_centre_shift
    return resize_K(shifted, truth.camera_hw[index], size_hw)
