"""The camera term: how far predicted cameras are from given ones, whatever the scale and the world frame (ours)."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor
from torch.nn import functional as F

from freegeo.geometry.se3 import relative

SHORTEST = 0.05
"""Pairs of cameras nearer to each other than this share of the scene's distance have no direction to learn."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraTargets:
    """Cameras of the F frames of a scene that the student's are compared with."""

    T_cam_world: Tensor
    """(F, 4, 4), in any world frame and at any scale."""
    K: Tensor
    """(F, 3, 3), pixels of the images that are adapted to; of it only the focal lengths are used."""
    known: Tensor
    """(F,) bool: frames whose camera is known; the others are in no term."""
    distance: float
    """Typical distance of what the photos show, in the unit of the translations."""

    def select(self, frames: Sequence[int]) -> Self:
        """Return the chosen frames, in the order given."""
        index = torch.as_tensor(list(frames), dtype=torch.long, device=self.known.device)
        return replace(self, T_cam_world=self.T_cam_world[index], K=self.K[index], known=self.known[index])

    def to(self, device: torch.device) -> Self:
        """Return the targets on a device."""
        return replace(self, T_cam_world=self.T_cam_world.to(device), K=self.K.to(device), known=self.known.to(device))

    def digest(self) -> str:
        """Return a fingerprint of all values."""
        values = hashlib.sha256(repr(self.distance).encode())
        for tensor in (self.T_cam_world, self.K, self.known):
            values.update(tensor.cpu().contiguous().numpy().tobytes())
        return values.hexdigest()[:16]


def camera_loss(T_cam_world: Tensor, K: Tensor, targets: CameraTargets) -> Tensor:
    """Distance of predicted cameras (S, 4, 4), (S, 3, 3) from the targets of the same S frames, a scalar.

    Sum of three means, over ordered pairs of frames, over those of them whose cameras are far enough apart, and over
    frames and axes:

        |R - R'|_F  of relative rotations    |t/|t| - t'/|t'||  of relative translations    |log(f / f')|

    0 where no two frames have known cameras. Source: docs/method.md, "Cameras as targets".
    """
    wanted = targets.T_cam_world.to(T_cam_world)
    found, target = (relative(T[:, None], T[None]) for T in (T_cam_world, wanted))
    pairs = targets.known[:, None] & targets.known[None] & ~torch.eye(len(wanted), dtype=torch.bool, device=K.device)
    apart = torch.linalg.vector_norm(target[..., :3, 3], dim=-1) > SHORTEST * targets.distance
    rotation = torch.linalg.vector_norm(found[..., :3, :3] - target[..., :3, :3], dim=(-2, -1))
    directions = [F.normalize(T[..., :3, 3], dim=-1) for T in (found, target)]
    translation = torch.linalg.vector_norm(directions[0] - directions[1], dim=-1)
    focal = (focal_lengths(K).log() - focal_lengths(targets.K.to(K)).log()).abs().mean(-1)
    return _mean(rotation, pairs) + _mean(translation, pairs & apart) + _mean(focal, targets.known)


def focal_lengths(K: Tensor) -> Tensor:
    """Focal lengths (..., 2), x first."""
    return K[..., (0, 1), (0, 1)]


def _mean(values: Tensor, chosen: Tensor) -> Tensor:
    """Mean of the chosen values, 0 without any; the others are in no gradient."""
    return torch.where(chosen, values, 0).sum() / chosen.sum().clamp(min=1)
