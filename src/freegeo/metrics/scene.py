"""The score of one reconstruction against a scene whose cameras and depth are known in memory (generated rooms)."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch import Tensor

from freegeo.data.scene import Scene
from freegeo.errors import UserError
from freegeo.geometry.camera import resize_K
from freegeo.geometry.resample import resize_nearest
from freegeo.metrics.cloud import f1_rel5
from freegeo.metrics.depth import score_depth
from freegeo.metrics.pose import pair_errors, pose_auc

PRINTED = ("auc05", "auc15", "auc30", "abs_rel", "f1_rel5")


class Reconstructed(Protocol):
    """What is scored: arrays or tensors depth_z (S, H, W), T_cam_world (S, 4, 4), K (S, 3, 3)."""

    @property
    def depth_z(self) -> Any:
        """(S, H, W)."""
        ...

    @property
    def T_cam_world(self) -> Any:
        """(S, 4, 4)."""
        ...

    @property
    def K(self) -> Any:
        """(S, 3, 3)."""
        ...


def evaluate(reconstruction: Reconstructed, scene: Scene) -> dict[str, float]:
    """Score a reconstruction of all photos of a scene, in the same order.

    Returns auc03, auc05, auc15, auc30 (fractions), abs_rel (after one median scale), f1_rel5 (fraction; threshold 5 %
    of the mean depth, ground truth = points of the scene's views). UserError when the scene has no cameras or depth in
    memory, or another number of views.
    """
    if scene.T_cam_world is None or scene.K is None or scene.depth_z is None:
        raise UserError(f"{scene.name}: no cameras and depth in memory to compare with.")
    depth_z, T_cam_world, K = (
        torch.as_tensor(value) for value in (reconstruction.depth_z, reconstruction.T_cam_world, reconstruction.K)
    )
    if len(depth_z) != len(scene):
        raise UserError(f"{scene.name}: has {len(scene)} views, the reconstruction {len(depth_z)}.")
    size = (depth_z.shape[-2], depth_z.shape[-1])
    depth_true, K_true = at_size(scene.depth_z, scene.K, size)
    scores = pose_auc(pair_errors(T_cam_world, scene.T_cam_world).worst_deg)
    scores["abs_rel"] = float(score_depth(depth_z, depth_true).abs_rel)
    scores["f1_rel5"] = f1_rel5(depth_z, K, T_cam_world, depth_true, K_true, scene.T_cam_world).fscore
    return scores


def at_size(depth_z: Tensor, K: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Resize ground truth to a prediction's size: nearest depth, scaled intrinsics."""
    return resize_nearest(depth_z, size), resize_K(K, (depth_z.shape[-2], depth_z.shape[-1]), size)
