"""The 3D scene of a report: a level frame for display, and its points packed for the page."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

from freegeo.export.glb import frustum_corners
from freegeo.export.gravity import cameras_up
from freegeo.report.result import MANY_VIEWS, Result, Stage, even_choice

MAX_KEPT, MAX_REMOVED = 36_000, 9_000
"""Most kept and removed points of one stage in the page."""
MAX_KEPT_OF_MANY = 100_000
"""Most kept points with more than `MANY_VIEWS` views, which show a larger place."""
MOST_CAMERAS = 100
"""Cameras that are drawn; of more, these and a line through all of them."""
MOST_PATH = 2_000
"""Most corners of that line."""
ERROR_LIMIT = 0.3
"""Relative depth error at the end of the colour scale."""
NO_ERROR = 255
YAW, PITCH, STEEP = 0.4, 0.45, 0.95
"""Angles of the first view in radians, to the right and from above; steep over cameras that look all round, where
walls would hide what is between them."""
LOOK_ALL_ROUND = 0.5
"""Length of the mean viewing direction below which cameras do."""
FILLED = 0.93
"""Share of the picture that the first view fills."""


def level_rotation(T_cam_world: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) from the world to x right, y up, z towards the viewer, for cameras (S, 4, 4).

    Up is that of cameras that are held level (`freegeo.export.gravity`), otherwise the mean of the cameras' own;
    forward is their mean viewing direction, made level.
    """
    R = T_cam_world[:, :3, :3].astype(np.float64)
    found = cameras_up(R)
    up = _unit(-R[:, 1].mean(0), -R[0, 1]) if found is None else found
    forward = R[:, 2].mean(0)
    # Cameras that look all round or straight down have no level mean direction; then the first camera's x axis is used.
    right = _unit(np.cross(forward, up), np.cross(np.cross(up, R[0, 0]), up), least=0.05)
    return np.stack((right, up, np.cross(right, up)))


def _unit(vector: np.ndarray, otherwise: np.ndarray, least: float = 1e-6) -> np.ndarray:
    chosen = vector if np.linalg.norm(vector) > least else otherwise
    return chosen / np.linalg.norm(chosen)


def most_kept(result: Result) -> int:
    """Most kept points of a stage in the page."""
    return MAX_KEPT if len(result.names) <= MANY_VIEWS else MAX_KEPT_OF_MANY


def drawn_cameras(result: Result) -> list[int]:
    """Views whose cameras are drawn."""
    return even_choice(len(result.names), MOST_CAMERAS)


def scene_data(result: Result) -> dict[str, Any]:
    """Everything the page's 3D view needs, as JSON-like values; UserError without cameras."""
    final = result.final
    assert final.T_cam_world is not None
    level = level_rotation(final.T_cam_world)
    points = {stage.key: stage.world_points() @ level.T.astype(np.float32) for stage in result.stages.values()}
    seen = points[final.key][final.keep] if final.keep.any() else points[final.key].reshape(-1, 3)
    target = np.quantile(seen, (0.03, 0.97), axis=0).mean(axis=0)
    radius = float(np.quantile(np.linalg.norm(seen - target, axis=1), 0.9)) or 1.0
    spacing = float(np.median(_covered(final)[final.keep])) if final.keep.any() else radius / 100
    yaw, pitch = first_angles(final)
    return {
        "target": _rounded(target),
        "radius": radius,
        "yaw": yaw,
        "pitch": pitch,
        "stages": [
            {
                "key": stage.key,
                "label": stage.label,
                **_packed(stage, points[stage.key], result.images, spacing, most_kept(result)),
                "cameras": _cameras(stage, drawn_cameras(result), level, frustum_depth(stage, 0.1 * radius)),
                "path": _path(stage, level) if result.is_path else [],
                "spacing": spacing,
            }
            for stage in result.stages.values()
        ],
    }


def first_angles(stage: Stage) -> tuple[float, float]:
    """Angles of the first view of the level frame in radians: to the right, and from above."""
    assert stage.T_cam_world is not None
    mean_direction = stage.T_cam_world[:, 2, :3].astype(np.float64).mean(0)
    return YAW, STEEP if np.linalg.norm(mean_direction) < LOOK_ALL_ROUND else PITCH


def first_view(
    stage: Stage, level: np.ndarray, centre: np.ndarray, *, frusta: float, fov: float, aspect: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the page's first view for another viewer: all cameras and nearly all points just fill the picture.

    Args:
        stage: whose kept points and cameras are shown.
        level: rotation (3, 3) from the world to the level frame.
        centre: (3,) in the world, of the points.
        frusta: how deep cameras are drawn.
        fov: vertical field of view in radians.
        aspect: width over height of the picture.

    Returns:
        Place of the eye (3,), and the place (3,) it looks at, as far away as `centre`.
    """
    yaw, pitch = first_angles(stage)
    back = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    right = np.array([np.cos(yaw), 0, -np.sin(yaw)])
    axes = np.stack((right, np.cross(back, right), back)) @ level
    points = kept_points(stage) @ axes.T
    corners = np.array(_cameras(stage, list(range(len(stage.depth_z))), axes, frusta)).reshape(-1, 3)
    tall = FILLED * np.tan(fov / 2)

    def reach(axis: int, slope: float) -> float:
        """Of all that is to be inside a plane of the view, the most of what the eye must not fall below."""
        values, ends = (np.sign(slope) * x[:, axis] + abs(slope) * x[:, 2] for x in (points, corners))
        middle, high, most = np.quantile(values, (0.5, 0.98, 1))
        return float(max(min(most, high + 0.5 * (high - middle)), ends.max()))

    slopes = (tall * aspect, tall)
    both = [(reach(axis, slope), reach(axis, -slope)) for axis, slope in enumerate(slopes)]
    away = max((first + second) / (2 * slope) for (first, second), slope in zip(both, slopes, strict=True))
    eye = np.array([*((first - second) / 2 for first, second in both), away]) @ axes
    return eye, eye - axes[2] * ((eye - centre) @ axes[2])


def kept_points(stage: Stage) -> np.ndarray:
    """World points (n, 3) of the kept pixels, or of all where none is kept."""
    points = stage.world_points()
    return points[stage.keep] if stage.keep.any() else points.reshape(-1, 3)


def _packed(stage: Stage, points: np.ndarray, images: np.ndarray, spacing: float, most: int) -> dict[str, Any]:
    """Points as base64: xyz float32, RGB, confidence rank, error, kept flag, size, one array after the other.

    The size of a point is what its pixel covers, and more when points were left out: `spacing` times
    2 ** ((byte - 128) / 16).
    """
    rng = np.random.default_rng(0)
    valid = np.isfinite(points).all(-1) & (stage.depth_z > 0)
    kept = _choice(np.flatnonzero(stage.keep & valid), most, rng)
    removed = _choice(np.flatnonzero(~stage.keep & valid), MAX_REMOVED, rng)
    # In random order, so that no part of the points is always drawn over another.
    index = rng.permutation(np.concatenate((kept, removed)))
    flag = stage.keep.reshape(-1)[index]
    left_out = max(1.0, int(stage.keep.sum()) / most) ** 0.5
    size = _covered(stage).reshape(-1)[index] * left_out
    arrays = (
        points.reshape(-1, 3)[index].astype("<f4"),
        images.reshape(-1, 3)[index],
        _ranks(stage.conf.reshape(-1)[index], flag),
        _error_bytes(stage, index),
        flag.astype(np.uint8),
        np.clip(128 + 16 * np.log2(size / spacing), 0, 255).astype(np.uint8),
    )
    packed = base64.b64encode(b"".join(a.tobytes() for a in arrays)).decode("ascii")
    return {"count": len(index), "points": packed}


def _choice(index: np.ndarray, most: int, rng: np.random.Generator) -> np.ndarray:
    return index if len(index) <= most else rng.choice(index, most, replace=False)


def _ranks(conf: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Percentile (n,) uint8 of each confidence among the kept points: 0 the least confident, 100 the most."""
    levels = np.sort(conf[kept])
    if len(levels) == 0 or levels[0] == levels[-1]:
        return np.full(len(conf), 100, dtype=np.uint8)
    return (100 * np.searchsorted(levels, conf, side="right") / len(levels)).astype(np.uint8)


def _error_bytes(stage: Stage, index: np.ndarray) -> np.ndarray:
    if stage.error is None:
        return np.full(len(index), NO_ERROR, dtype=np.uint8)
    error = stage.error.reshape(-1)[index]
    scaled = np.clip(np.nan_to_num(error) / ERROR_LIMIT, 0, 1) * (NO_ERROR - 1)
    return np.where(np.isfinite(error), scaled, NO_ERROR).astype(np.uint8)


def _cameras(stage: Stage, views: list[int], level: np.ndarray, depth: float) -> list[list[list[float]]]:
    """Five corners of each camera's frustum: centre, then the image's corners clockwise from top left."""
    assert stage.T_cam_world is not None
    assert stage.K is not None
    hw = stage.depth_z.shape[1], stage.depth_z.shape[2]
    corners = [frustum_corners(stage.T_cam_world[view], stage.K[view], hw, depth) @ level.T for view in views]
    return [[_rounded(corner) for corner in camera] for camera in corners]


def frustum_depth(stage: Stage, most: float) -> float:
    """How deep frusta are drawn: `most`, or less where the cameras that are drawn of many would hide each other."""
    assert stage.T_cam_world is not None
    count = len(stage.T_cam_world)
    if count <= MOST_CAMERAS:
        return most
    places = _centres(stage)[even_choice(count, MOST_CAMERAS)]
    step = float(np.median(np.linalg.norm(np.diff(places, axis=0), axis=1)))
    return min(most, max(step, 0.2 * most))


def _centres(stage: Stage) -> np.ndarray:
    """Positions of the cameras (S, 3) float64."""
    assert stage.T_cam_world is not None
    T = stage.T_cam_world.astype(np.float64)
    return -np.einsum("sij,si->sj", T[:, :3, :3], T[:, :3, 3])


def _path(stage: Stage, level: np.ndarray) -> list[list[float]]:
    """Positions of the cameras, one after the other; empty where all of them are drawn."""
    assert stage.T_cam_world is not None
    if len(stage.T_cam_world) <= MOST_CAMERAS:
        return []
    centres = _centres(stage)[even_choice(len(stage.T_cam_world), MOST_PATH)]
    return [_rounded(centre) for centre in centres @ level.T]


def _covered(stage: Stage) -> np.ndarray:
    """Width (S, H, W) that each pixel covers at its depth."""
    assert stage.K is not None
    return stage.depth_z / np.sqrt(stage.K[:, 0, 0] * stage.K[:, 1, 1])[:, None, None]


def _rounded(vector: np.ndarray) -> list[float]:
    return [float(f"{value:.5g}") for value in vector]
