"""The coloured point cloud of depth maps with cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from freegeo.errors import UserError
from freegeo.fusion.filtering import confident_pixels, flying_pixels
from freegeo.fusion.settings import DROP_SHARE, MAX_POINTS
from freegeo.geometry.depth import depth_to_world, valid_depth

__all__ = ["PointCloud", "coloured_points", "thin_pixels", "thin_points"]


@dataclass(frozen=True, kw_only=True)
class PointCloud:
    """World points with the pixel each one comes from."""

    points: np.ndarray
    """(n, 3) float32 world coordinates, OpenCV axes."""
    colours: np.ndarray
    """(n, 3) uint8 RGB."""
    conf: np.ndarray
    """(n,) float32."""
    view: np.ndarray
    """(n,) int32 index of the view."""
    pixel: np.ndarray
    """(n, 2) int32 column and row in the view's depth map."""

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points)

    def select(self, index: np.ndarray) -> PointCloud:
        """Return the points of an index array or a mask."""
        return PointCloud(
            points=self.points[index],
            colours=self.colours[index],
            conf=self.conf[index],
            view=self.view[index],
            pixel=self.pixel[index],
        )


def coloured_points(
    depth_z: np.ndarray,
    conf: np.ndarray,
    T_cam_world: np.ndarray,
    K: np.ndarray,
    images: np.ndarray,
    *,
    keep: np.ndarray | None = None,
    drop_share: float = DROP_SHARE,
    drop_flying: bool = True,
    max_points: int | None = MAX_POINTS,
    seed: int = 0,
) -> PointCloud:
    """World points of the pixels that pass the filters, in the order view, row, column.

    Args:
        depth_z: (S, H, W).
        conf: (S, H, W), higher is better.
        T_cam_world: (S, 4, 4).
        K: (S, 3, 3) pixels of the maps.
        images: (S, H, W, 3) uint8.
        keep: (S, H, W) bool; only these pixels are considered. Default all with valid depth.
        drop_share: share in [0, 1) of the least confident pixels to leave out.
        drop_flying: leave out pixels between surfaces (`filtering.flying_pixels`).
        max_points: a seeded random choice of so many points when there are more; None keeps all.
        seed: of that choice.

    Raises:
        UserError: `drop_share` is outside [0, 1), or `max_points` is below 1.
    """
    if not 0 <= drop_share < 1:
        raise UserError(f"The share of points to drop must be from 0 to below 1, got {drop_share}.")
    depth, K_tensor, T = (torch.from_numpy(np.ascontiguousarray(a)).float() for a in (depth_z, K, T_cam_world))
    usable = torch.empty(depth.shape, dtype=torch.bool)
    for view in range(len(depth)):
        usable[view] = valid_depth(depth[view])
        if keep is not None:
            usable[view] &= torch.from_numpy(keep[view])
        if drop_flying:
            usable[view] &= ~flying_pixels(depth[view : view + 1], K_tensor[view : view + 1])[0]
    usable = confident_pixels(torch.from_numpy(np.ascontiguousarray(conf)), usable, drop_share=drop_share)
    index = thin_pixels(usable.numpy(), max_points=max_points, seed=seed)
    view, row, column = np.unravel_index(index, depth_z.shape)
    ends = np.searchsorted(view, np.arange(len(depth)), side="right").tolist()
    points = np.empty((len(index), 3), np.float32)
    start = 0
    for one, end in enumerate(ends):
        if end > start:
            world = depth_to_world(depth[one : one + 1], K_tensor[one : one + 1], T[one : one + 1])[0].numpy()
            points[start:end] = world[row[start:end], column[start:end]]
        start = end
    return PointCloud(
        points=points,
        colours=images.reshape(-1, 3)[index],
        conf=conf.reshape(-1)[index].astype(np.float32),
        view=view.astype(np.int32),
        pixel=np.stack((column, row), axis=-1).astype(np.int32),
    )


def thin_points(index: np.ndarray, *, max_points: int | None, seed: int) -> np.ndarray:
    """Return at most `max_points` of `index` (n,), a seeded choice in the order given; UserError for less than 1."""
    chosen = _chosen(len(index), max_points, seed)
    return index if chosen is None else index[chosen]


def thin_pixels(keep: np.ndarray, *, max_points: int | None, seed: int) -> np.ndarray:
    """Return flat indices (n,) int64 of at most `max_points` kept pixels of masks (S, H, W), as `thin_points` chooses.

    The choice depends on the number of kept pixels alone, so no list of all of them is made.
    """
    counts = [int(np.count_nonzero(one)) for one in keep]
    chosen = _chosen(sum(counts), max_points, seed)
    if chosen is None:
        return np.flatnonzero(keep)
    ends = np.cumsum(counts)
    parts = np.split(chosen, np.searchsorted(chosen, ends))
    found = [
        np.flatnonzero(keep[view])[part - (ends[view] - counts[view])] + view * keep[view].size
        for view, part in enumerate(parts[: len(keep)])
        if len(part)
    ]
    return np.concatenate([np.zeros(0, np.int64), *found])


def _chosen(count: int, max_points: int | None, seed: int) -> np.ndarray | None:
    """Return sorted numbers of at most `max_points` of `count` things; None: all of them."""
    if max_points is not None and max_points < 1:
        raise UserError(f"The number of points must be at least 1, got {max_points}.")
    if max_points is None or count <= max_points:
        return None
    return np.sort(np.random.default_rng(seed).choice(count, size=max_points, replace=False, shuffle=False))
