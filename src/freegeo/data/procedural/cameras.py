"""Camera trajectories inside a room: arcs that look inwards and walks that look outwards.

Source: docs/embedded-model.md, "How the rooms are made" (families, steps, jitter, long baselines of walks).
The room frame has its origin in the middle of the floor, z up. All functions are vectorised over rooms and read their
randomness from uniform numbers in [0, 1], so that a room does not depend on the batch it is sampled in.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

ARC_SHARE = 0.6
STEP_DEG = (10.6, 21.4)
"""Range of a trajectory's turn from one view to the next; its own steps vary by 5 % around it."""
WALL_MARGIN_M = 0.4
WALK_STEP_M = (0.36, 0.6)
WALK_RADIUS = (0.2, 0.45)
"""Half axes of a walk over those of the room. Farther out the walls are so near that a fifth of the rooms had next to
no overlap between every second view."""

TRAJECTORY_NUMBERS = 16
"""Uniform numbers that describe a trajectory as a whole."""
FRAME_NUMBERS = 8
"""Uniform numbers of one frame."""


def camera_poses(
    half_extent_m: Tensor, trajectory: Tensor, jitter: Tensor, *, pace: float = 1.0
) -> tuple[Tensor, Tensor]:
    """Poses of S views in each of B rooms.

    Args:
        half_extent_m: (B, 3) half width, half depth and full height of the room.
        trajectory: (B, `TRAJECTORY_NUMBERS`) uniform numbers.
        jitter: (B, S, `FRAME_NUMBERS`) uniform numbers.
        pace: factor on turns and steps from one view to the next.

    Returns:
        `T_cam_room` (B, S, 4, 4), OpenCV axes, and `is_arc` (B,) bool.
    """
    is_arc = trajectory[:, 0] < ARC_SHARE
    direction = torch.where(trajectory[:, 1] < 0.5, -1.0, 1.0)
    step = _between(trajectory[:, 2], *(math.radians(angle) for angle in STEP_DEG))
    turns = pace * step[:, None] * _between(jitter[..., 0], 0.95, 1.05)
    turns = (direction[:, None] * turns).cumsum(1) - direction[:, None] * turns[:, :1]
    inner = half_extent_m[:, :2] - WALL_MARGIN_M

    arc_position, arc_yaw, arc_pitch = _arc(inner, turns, trajectory)
    walk_position, walk_yaw, walk_pitch = _walk(inner, turns, direction * step, trajectory, jitter, pace)
    position = torch.where(is_arc[:, None, None], arc_position, walk_position)
    yaw = torch.where(is_arc[:, None], arc_yaw, walk_yaw) + _around(jitter[..., 1], math.radians(0.8))
    pitch = torch.where(is_arc[:, None], arc_pitch, walk_pitch) + _around(jitter[..., 2], math.radians(2.0))
    roll = _around(jitter[..., 3], math.radians(3.0))
    position = position + torch.cat([_around(jitter[..., 4:6], 0.02), _around(jitter[..., 6:7], 0.05)], dim=-1)
    # Jitter and ellipses stay inside by construction; the clamp guarantees it.
    limit = half_extent_m[:, None, :2] - 0.75 * WALL_MARGIN_M
    position = torch.cat([torch.clamp(position[..., :2], -limit, limit), position[..., 2:]], dim=-1)
    return look(position, yaw, pitch, roll), is_arc


def _between(uniform: Tensor, low: float, high: float) -> Tensor:
    return low + (high - low) * uniform


def _around(uniform: Tensor, amplitude: float) -> Tensor:
    return (2.0 * uniform - 1.0) * amplitude


def _arc(inner: Tensor, turns: Tensor, trajectory: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Cameras around a target near the middle: the bearing from the target turns, the camera looks back at it."""
    frames = turns.shape[1]
    target = _around(trajectory[:, 3:5], 0.18) * inner
    bearing = 2.0 * math.pi * trajectory[:, 5:6] + turns
    cosine, sine = bearing.cos(), bearing.sin()
    # Distance to an ellipse around the target that touches the nearer walls: smooth, and always inside.
    reach = inner - target.abs()
    radius = 1.0 / torch.sqrt((cosine / reach[:, :1]) ** 2 + (sine / reach[:, 1:]) ** 2)
    progress = torch.linspace(0.0, 1.0, frames, device=turns.device)
    share = torch.lerp(_between(trajectory[:, 6:7], 0.7, 1.0), _between(trajectory[:, 7:8], 0.7, 1.0), progress)
    radius = radius * share
    height = _heights(trajectory, progress)
    position = torch.stack(
        [target[:, :1] + radius * cosine, target[:, 1:] + radius * sine, height.expand_as(radius)], dim=-1
    )
    target_height = _between(trajectory[:, 10:11], 0.5, 1.2)
    return position, bearing + math.pi, torch.atan2(target_height - height, radius)


def _walk(
    inner: Tensor, turns: Tensor, signed_step: Tensor, trajectory: Tensor, jitter: Tensor, pace: float
) -> tuple[Tensor, Tensor, Tensor]:
    """A walk along an ellipse while the gaze, outwards at first, pans at its own rate."""
    frames = turns.shape[1]
    axes = inner * _between(trajectory[:, 3:4], *WALK_RADIUS)
    stride = signed_step.abs() * axes.mean(1) * _between(trajectory[:, 4], 0.85, 1.3)
    stride = pace * stride.clamp(*WALK_STEP_M) * signed_step.sign()
    angle = 2.0 * math.pi * trajectory[:, 5]
    angles = [angle]
    for frame in range(1, frames):
        # Midpoint rule: the ellipse's speed half a step ahead is used for the whole step.
        middle = angle + 0.5 * stride / _ellipse_speed(axes, angle)
        angle = angle + stride * _between(jitter[:, frame, 7], 0.95, 1.05) / _ellipse_speed(axes, middle)
        angles.append(angle)
    path = torch.stack(angles, dim=1)
    height = _heights(trajectory, torch.linspace(0.0, 1.0, frames, device=turns.device))
    position = torch.stack([axes[:, :1] * path.cos(), axes[:, 1:] * path.sin(), height.expand_as(path)], dim=-1)
    outwards = torch.atan2(path[:, :1].sin() / axes[:, 1:], path[:, :1].cos() / axes[:, :1])
    yaw = outwards + _around(trajectory[:, 6:7], math.radians(35.0)) + turns
    pitch = _around(trajectory[:, 7:8], math.radians(9.0)).expand_as(yaw) - math.radians(5.0)
    return position, yaw, pitch


def _ellipse_speed(axes: Tensor, angle: Tensor) -> Tensor:
    return torch.hypot(axes[:, 0] * angle.sin(), axes[:, 1] * angle.cos())


def _heights(trajectory: Tensor, progress: Tensor) -> Tensor:
    return torch.lerp(_between(trajectory[:, 8:9], 1.0, 1.8), _between(trajectory[:, 9:10], 1.0, 1.8), progress)


def look(position: Tensor, yaw: Tensor, pitch: Tensor, roll: Tensor) -> Tensor:
    """`T_cam_room` (..., 4, 4) of cameras at `position` (..., 3): x right, y down, z forward; yaw from x towards y."""
    cos_pitch = pitch.cos()
    forward = torch.stack([yaw.cos() * cos_pitch, yaw.sin() * cos_pitch, pitch.sin()], dim=-1)
    level = torch.stack([yaw.sin(), -yaw.cos(), torch.zeros_like(yaw)], dim=-1)
    down = torch.linalg.cross(forward, level)
    cos_roll, sin_roll = roll.cos()[..., None], roll.sin()[..., None]
    right, down = cos_roll * level + sin_roll * down, cos_roll * down - sin_roll * level
    rotation = torch.stack([right, down, forward], dim=-2)
    pose = torch.zeros(*position.shape[:-1], 4, 4, dtype=position.dtype, device=position.device)
    pose[..., :3, :3] = rotation
    pose[..., :3, 3] = -(rotation @ position[..., None])[..., 0]
    pose[..., 3, 3] = 1.0
    return pose
