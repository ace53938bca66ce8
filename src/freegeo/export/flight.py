"""A smooth flight along the cameras of a reconstruction, and pictures of its points from there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from freegeo.export.reconstruction import Reconstruction
from freegeo.fusion.quantile import median

MOST_STOPS = 400
"""Views that the flight passes; of more, so many, evenly spread."""
FRAMES_PER_VIEW, LEAST_FRAMES, MOST_FRAMES = 20, 96, 400
SMOOTHING = 0.6
"""Standard deviation of the smoothing, in mean steps from view to view."""
DETOUR = 1.3
"""Photos are passed in their own order if that is at most so much longer than from each to the nearest one left."""
SWAY = 0.06
"""Radius of the circle of a flight around one camera, as a share of the depth, where there is no longer way."""
WINDOW = 12
"""Views whose points a picture shows, those nearest to its camera."""
MOST_POINTS = 600_000
"""Most points of a picture."""
GROWTH = 1.15
"""Side of a drawn point in distances to the next one."""
LARGEST_SIDE = 16
NEAREST = 0.05
"""Points nearer to the camera than this share of the median depth are not drawn: they would hide everything."""
BACKGROUND = (24, 26, 30)
_GAP = 0.97


@dataclass(frozen=True, kw_only=True)
class Flight:
    """The cameras of F pictures."""

    T_cam_world: np.ndarray
    """(F, 4, 4) float64."""
    focal: np.ndarray
    """(F, 2) focal lengths in pixels of the reconstruction's maps."""
    depth: float
    """Median depth of the scene, the unit of distances between cameras."""

    def __len__(self) -> int:
        """Return the number of pictures."""
        return len(self.T_cam_world)


def plan_flight(reconstruction: Reconstruction, keep: np.ndarray) -> Flight:
    """Return a flight from view to view, at constant speed and smoothed; a circle around cameras in one place.

    Photos are passed in their order where that is a way (a walk, a video), otherwise from each to the nearest one left.

    Args:
        reconstruction: with cameras.
        keep: (S, H, W) bool, pixels that are points; at least one.
    """
    from scipy.ndimage import gaussian_filter1d
    from scipy.spatial.transform import Rotation, Slerp

    T_cam_world, K = (a.astype(np.float64) for a in reconstruction.cameras())
    views = range(len(reconstruction))
    depth = float(median(lambda: (reconstruction.depth_z[view][keep[view]] for view in views)))
    focal = K[:, (0, 1), (0, 1)]
    stops = np.unique(np.linspace(0, len(reconstruction) - 1, min(len(reconstruction), MOST_STOPS)).astype(np.int64))
    distance = _distances(T_cam_world[stops], T_cam_world[stops], depth)
    order = _order(distance)
    legs, stops = distance[order[:-1], order[1:]], stops[order]
    if legs.sum() < SWAY:
        circle = _circle(T_cam_world[stops[0]], depth)
        return Flight(T_cam_world=circle, focal=focal[stops[:1]].repeat(len(circle), axis=0), depth=depth)
    poses = np.linalg.inv(T_cam_world[stops])
    # Two cameras in one place would leave the order open.
    along = np.concatenate(([0.0], np.cumsum(legs + 1e-6)))
    count = int(np.clip(FRAMES_PER_VIEW * (len(stops) - 1), LEAST_FRAMES, MOST_FRAMES))
    place = np.linspace(0, along[-1], count)
    sigma = SMOOTHING * count / (len(stops) - 1)
    centres = np.stack([np.interp(place, along, poses[:, axis, 3]) for axis in range(3)], axis=-1)
    quats = Slerp(along, Rotation.from_matrix(poses[:, :3, :3]))(place).as_quat()
    signs = np.cumprod(np.concatenate(([1.0], np.where((quats[1:] * quats[:-1]).sum(-1) < 0, -1.0, 1.0))))
    smooth = np.tile(np.eye(4), (count, 1, 1))
    smooth[:, :3, 3] = gaussian_filter1d(centres, sigma, axis=0, mode="nearest")
    turned = gaussian_filter1d(quats * signs[:, None], sigma, axis=0, mode="nearest")
    smooth[:, :3, :3] = Rotation.from_quat(turned).as_matrix()
    focals = np.stack([np.interp(place, along, focal[stops, axis]) for axis in range(2)], axis=-1)
    return Flight(
        T_cam_world=np.linalg.inv(smooth), focal=gaussian_filter1d(focals, sigma, axis=0, mode="nearest"), depth=depth
    )


def _circle(T_cam_world: np.ndarray, depth: float) -> np.ndarray:
    """Cameras (F, 4, 4) on a circle in the image plane of one camera, looking at the same point ahead."""
    from scipy.spatial.transform import Rotation

    angle = np.linspace(0, 2 * np.pi, LEAST_FRAMES, endpoint=False)
    moves = np.tile(np.eye(4), (LEAST_FRAMES, 1, 1))
    x, y = SWAY * np.sin(angle), SWAY * (np.cos(angle) - 1) / 2
    moves[:, :3, :3] = Rotation.from_rotvec(np.stack((y, -x, 0 * x), axis=-1)).as_matrix()
    moves[:, 0, 3], moves[:, 1, 3] = x * depth, y * depth
    return np.linalg.inv(moves) @ T_cam_world


def _distances(one: np.ndarray, other: np.ndarray, depth: float) -> np.ndarray:
    """Distances (n, m) between cameras (n, 4, 4) and (m, 4, 4): way in depths plus turn in radians."""
    centres = [-np.einsum("sji,sj->si", T[:, :3, :3], T[:, :3, 3]) for T in (one, other)]
    way = np.linalg.norm(centres[0][:, None] - centres[1][None], axis=-1) / depth
    trace = np.einsum("sij,tij->st", one[:, :3, :3], other[:, :3, :3])
    return way + np.arccos(np.clip((trace - 1) / 2, -1, 1))


def _order(distance: np.ndarray) -> np.ndarray:
    """Return the order (n,) in which views of these distances (n, n) are passed."""
    given = np.arange(len(distance))
    tours = [_nearest_tour(distance, start) for start in given]
    tour = min(tours, key=lambda order: _length(distance, order))
    return given if _length(distance, given) <= DETOUR * _length(distance, tour) else tour


def _nearest_tour(distance: np.ndarray, start: int) -> np.ndarray:
    left = distance.copy()
    order = [start]
    for _ in range(len(distance) - 1):
        left[:, order[-1]] = np.inf
        order.append(int(left[order[-1]].argmin()))
    return np.array(order)


def _length(distance: np.ndarray, order: np.ndarray) -> float:
    return float(distance[order[:-1], order[1:]].sum())


@dataclass(frozen=True, kw_only=True)
class _Points:
    """Points of one view, in random order."""

    xyz: np.ndarray
    """(n, 3) float32."""
    rgb: np.ndarray
    """(n,) int64, a byte a colour."""
    side: np.ndarray
    """(n,) float32: width and height of what a point stands for."""


class Painter:
    """Draws a reconstruction's points from the cameras of a flight; holds the points of a few views at a time."""

    def __init__(
        self, reconstruction: Reconstruction, keep: np.ndarray, depth: float, size_hw: tuple[int, int], scale: float
    ):
        """Prepare pictures.

        Args:
            reconstruction: with cameras.
            keep: (S, H, W) bool, pixels that are points.
            depth: median depth of the scene.
            size_hw: height and width of the pictures.
            scale: their pixels for one of the reconstruction's, in each direction.
        """
        self._reconstruction, self._keep, self._depth = reconstruction, keep, depth
        self._size_hw, self._scale = size_hw, scale
        height, width = reconstruction.image_hw
        self._stride = int(np.ceil((height * width * min(len(keep), WINDOW) / MOST_POINTS) ** 0.5))
        self._views: dict[int, _Points] = {}

    def draw(self, T_cam_world: np.ndarray, focal: np.ndarray) -> np.ndarray:
        """Return the picture (H, W, 3) float32, from 0 to 255, of a camera (4, 4) with focal lengths (2,)."""
        parts = self._near(T_cam_world)
        xyz, rgb, side = (np.concatenate([getattr(p, name)[:n] for p, n in parts]) for name in ("xyz", "rgb", "side"))
        height, width = self._size_hw
        camera = xyz @ T_cam_world[:3, :3].T.astype(np.float32) + T_cam_world[:3, 3].astype(np.float32)
        near = NEAREST * self._depth
        z = np.maximum(camera[:, 2], near)
        pixels = focal * self._scale
        u = camera[:, 0] / z * np.float32(pixels[0]) + np.float32((width - 1) / 2)
        v = camera[:, 1] / z * np.float32(pixels[1]) + np.float32((height - 1) / 2)
        sides = np.clip(np.rint(side / z * np.float32(GROWTH * pixels[0])), 1, LARGEST_SIDE).astype(np.int64)
        left, top = np.rint(u - (sides - 1) / 2), np.rint(v - (sides - 1) / 2)
        seen = (camera[:, 2] > near) & (left > -LARGEST_SIDE) & (left < width) & (top > -LARGEST_SIDE) & (top < height)
        # The nearest point of a pixel is the largest key: inverse depth first, then colour, so that ties are settled.
        key = ((near / z[seen] * (2**31 - 1)).astype(np.int64) << 24) | rgb[seen]
        return self._filled(self._nearest(key, left[seen], top[seen], sides[seen]))

    def _nearest(self, key: np.ndarray, left: np.ndarray, top: np.ndarray, sides: np.ndarray) -> np.ndarray:
        """Return the largest key (H, W) of the squares over each pixel, 0 where there is none."""
        height, width = self._size_hw
        rim = LARGEST_SIDE
        wide = width + 2 * rim
        canvas = torch.zeros((height + 2 * rim) * wide, dtype=torch.int64)
        corner = torch.from_numpy(((top + rim) * wide + left + rim).astype(np.int64))
        keys, lengths = torch.from_numpy(key), torch.from_numpy(sides)
        for length in range(1, LARGEST_SIDE + 1):
            chosen = lengths == length
            if chosen.any():
                start, value = corner[chosen], keys[chosen]
                for row in range(length):
                    for column in range(length):
                        canvas.scatter_reduce_(0, start + (row * wide + column), value, "amax")
        return canvas.view(height + 2 * rim, wide)[rim:-rim, rim:-rim].numpy()

    @staticmethod
    def _filled(key: np.ndarray) -> np.ndarray:
        """Return the colours (H, W, 3) float32 of keys (H, W), with the small holes closed that surfaces have."""
        import cv2

        picture = (key & 0xFFFFFF).astype("<u4").view(np.uint8).reshape(*key.shape, 4)[..., 2::-1].astype(np.float32)
        picture[key == 0] = BACKGROUND
        inverse = (key >> 24).astype(np.float32)
        closed = cv2.morphologyEx(inverse, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8), borderType=cv2.BORDER_REPLICATE)
        front = (inverse >= _GAP * closed).astype(np.float32)
        weight = cv2.blur(front, (5, 5))
        around = cv2.blur(picture * front[..., None], (5, 5))
        gap = (front == 0) & (weight > 0)
        picture[gap] = around[gap] / weight[gap][:, None]
        return picture

    def _near(self, T_cam_world: np.ndarray) -> list[tuple[_Points, int]]:
        """Return the points of the nearest views, and how many of each are drawn: fewer of those farther away."""
        cameras = self._reconstruction.cameras()[0].astype(np.float64)
        chosen, share = np.arange(len(cameras)), np.ones(len(cameras))
        if len(cameras) > WINDOW:
            distance = _distances(T_cam_world[None], cameras, self._depth)[0]
            nearest = np.argsort(distance, kind="stable")[: WINDOW + 1]
            chosen, closer = np.sort(nearest[:-1]), distance[nearest[-1]] - distance
            # Half as close as the closest one is close enough; the first that is left out has 0.
            if closer.max() > 0:
                share = np.clip(2 * closer / closer.max(), 0, 1)
        self._views = {view: self._views.get(view) or self._points(view) for view in chosen.tolist()}
        return [(part, round(share[view] * len(part.rgb))) for view, part in self._views.items()]

    def _points(self, view: int) -> _Points:
        r, step = self._reconstruction, self._stride
        cameras, intrinsics = r.cameras()
        T_world_cam, K = np.linalg.inv(cameras[view].astype(np.float64)), intrinsics[view].astype(np.float64)
        rows, columns = np.nonzero(self._keep[view, step // 2 :: step, step // 2 :: step])
        mixed = np.random.default_rng(view).permutation(len(rows))
        row, column = (step // 2 + step * index[mixed] for index in (rows, columns))
        depth = r.depth_z[view][row, column].astype(np.float64)
        rays = np.stack((column, row, np.ones(len(row))), axis=-1) @ np.linalg.inv(K).T
        xyz = (depth[:, None] * rays) @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
        colour = r.images[view][row, column].astype(np.int64)
        return _Points(
            xyz=xyz.astype(np.float32),
            rgb=(colour[:, 0] << 16) | (colour[:, 1] << 8) | colour[:, 2],
            side=(step * depth / np.sqrt(K[0, 0] * K[1, 1])).astype(np.float32),
        )
