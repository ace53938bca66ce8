"""Which way is up in a reconstruction, for files whose readers expect the ground below.

Nothing measures gravity. What is known: photos are upright (their EXIF orientation is applied), and who holds a camera
holds it level more often than not. So the cameras' x axes are about horizontal and their y axes point about down. Where
the points show a large plane about at right angles to that, it is a floor, a table or a ceiling, and its normal is the
better answer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MOST_ROLL_DEG = 30.0
"""A camera agrees with the others on up if it is rolled by less."""
PITCH_WEIGHT = 0.05
"""How far the cameras' mean up counts beside their x axes, which looking up or down does not tilt."""
MOST_TILT_DEG = 30.0
"""A plane may be the floor if its normal is so close to the cameras' up."""
LEAST_SHARE = 0.05
"""Least share of the points on the floor."""
FLAT_SHARE = 0.01
"""A point is on a plane up to this share of the median distance of the points from their middle."""
NORMAL_ERROR_DEG = 20.0
"""Its own normal and the plane's differ by less then; a plane through things that are no plane fails by this."""
DRAWS = 500


@dataclass(frozen=True, kw_only=True)
class Up:
    """A direction in the world, and what it rests on."""

    direction: np.ndarray
    """(3,) float64, of unit length."""
    source: str
    """As it reads after "up is"."""


def find_up(T_cam_world: np.ndarray, points: np.ndarray, normals: np.ndarray) -> Up | None:
    """Return which way is up; None where the cameras disagree.

    They agree when more than half of them were held within `MOST_ROLL_DEG` of level.

    Args:
        T_cam_world: (S, 4, 4).
        points: (n, 3) in the world; some thousands will do.
        normals: (n, 3) of the points, 0 where they are not known.
    """
    of_cameras = cameras_up(T_cam_world[:, :3, :3].astype(np.float64))
    if of_cameras is None:
        return None
    plane = _plane_near(of_cameras, points.astype(np.float64), normals)
    if plane is None:
        return Up(direction=of_cameras, source="the mean up of the cameras, since no floor was found")
    normal, share = plane
    return Up(direction=normal, source=f"the normal of a plane with {100 * share:.0f} % of the points")


def cameras_up(R: np.ndarray) -> np.ndarray | None:
    """Return which way is up (3,) by cameras (S, 3, 3) alone, most of them held level; None where they disagree."""
    right, up = R[:, 0], -R[:, 1]
    limit = np.sin(np.deg2rad(MOST_ROLL_DEG))
    best: np.ndarray = np.zeros(len(R), dtype=bool)
    for first in up:
        level = _is_level(right, up, first, limit)
        found = _mean_up(right[level], up[level])
        level = _is_level(right, up, found, limit)
        if level.sum() > best.sum():
            best = level
    return _mean_up(right[best], up[best]) if best.sum() > len(R) / 2 else None


def _is_level(right: np.ndarray, up: np.ndarray, direction: np.ndarray, limit: float) -> np.ndarray:
    return (np.abs(right @ direction) < limit) & (up @ direction > 0)


def _mean_up(right: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the direction close to the mean up and at right angles to the x axes, as far as these leave a choice."""
    found = np.linalg.solve(right.T @ right / len(right) + PITCH_WEIGHT * np.eye(3), up.mean(axis=0))
    return found / np.linalg.norm(found)


def _plane_near(up: np.ndarray, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Return normal and share of the points of the largest plane whose normal is near `up`; None without one."""
    middle = np.median(points, axis=0)
    limit = FLAT_SHARE * float(np.median(np.linalg.norm(points - middle, axis=1)))
    level = np.abs(normals @ up) > np.cos(np.deg2rad(MOST_TILT_DEG + NORMAL_ERROR_DEG))
    flat = (points - middle)[level]
    if len(flat) < 3:
        return None
    corners = flat[np.random.default_rng(0).integers(0, len(flat), (DRAWS, 3))]
    drawn = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(drawn, axis=1)
    near = np.abs(drawn @ up) > np.cos(np.deg2rad(MOST_TILT_DEG)) * np.maximum(length, 1e-12)
    best = np.zeros(len(flat), dtype=bool)
    for corner, normal in zip(corners[near, 0], drawn[near] / length[near, None], strict=True):
        alike = np.abs(normals[level] @ normal) > np.cos(np.deg2rad(NORMAL_ERROR_DEG))
        on_it = alike & (np.abs((flat - corner) @ normal) < limit)
        if on_it.sum() > best.sum():
            best = on_it
    if best.sum() < max(3, LEAST_SHARE * len(points)):
        return None
    on_plane = flat[best] - flat[best].mean(axis=0)
    normal = np.linalg.svd(on_plane, full_matrices=False)[2][2]
    return np.sign(normal @ up) * normal, float(best.sum() / len(points))


def upright_rotation(up: np.ndarray, T_cam_world: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) float64 from the world to axes with y up, in which the first camera's heading is -z."""
    R = T_cam_world[0, :3, :3].astype(np.float64)
    # A camera that looks straight up or down has no heading, but the top of its photo has one.
    heading = R[2] if np.abs(R[2] @ up) < np.cos(np.deg2rad(10)) else -R[1] * np.sign(-(R[2] @ up))
    right = np.cross(heading, up)
    right /= np.linalg.norm(right)
    return np.stack((right, up, np.cross(right, up)))
