"""Points that several views observe, as structure-from-motion tools need them, from depth maps alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from freegeo.fusion.agreement import Lookup, Surfaces, look_up, nearest_views, prepare
from freegeo.fusion.points import thin_pixels, thin_points
from freegeo.geometry.camera import project
from freegeo.geometry.se3 import inverse, transform_points

__all__ = ["Tracks", "build_tracks", "inside", "thin_tracks"]

MAX_ERROR = 4.0
"""Largest reprojection error of an observation, in pixels of the depth maps."""
_CANDIDATES_PER_POINT = 4


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """n world points with m >= 2 n observations; observation i is one of point `point[i]`, sorted by point."""

    xyz: np.ndarray
    """(n, 3) float64 world coordinates."""
    colours: np.ndarray
    """(n, 3) uint8 RGB."""
    point: np.ndarray
    """(m,) int64."""
    view: np.ndarray
    """(m,) int64; a point is observed at most once per view."""
    pixel: np.ndarray
    """(m, 2) float64 column and row in the view's depth map, centres at whole numbers."""

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.xyz)


def build_tracks(
    depth_z: np.ndarray,
    T_cam_world: np.ndarray,
    K: np.ndarray,
    images: np.ndarray,
    keep: np.ndarray,
    *,
    tolerance: float,
    max_points: int | None = None,
    max_error: float = MAX_ERROR,
    seed: int = 0,
) -> Tracks:
    """Follow kept pixels into the views that see the same surface.

    A seed pixel's point is carried into the other views; where the depth there agrees, its projection is an
    observation. The point becomes the mean of what all of its observations back-project to, and observations farther
    than `max_error` from its projection are dropped, so the remaining errors show how well the views agree. Pixels that
    an earlier view's track observed start no track of their own.

    Args:
        depth_z: (S, H, W).
        T_cam_world: (S, 4, 4).
        K: (S, 3, 3) pixels of the maps.
        images: (S, H, W, 3) uint8.
        keep: (S, H, W) bool, from `filtering.filter_pixels`.
        tolerance: relative depth difference of one surface in two views (the filter's).
        max_points: a seeded random choice of so many points; None keeps all.
        max_error: pixels of the depth maps.
        seed: of the choice.
    """
    depth, T, intrinsics = (torch.from_numpy(np.ascontiguousarray(a)).float() for a in (depth_z, T_cam_world, K))
    surfaces = prepare(depth, T, intrinsics, torch.from_numpy(keep), tolerance=tolerance)
    candidates = _candidates(keep, max_points, seed)
    used = torch.zeros_like(candidates)
    parts, first = [], 0
    for source, others in enumerate(nearest_views(T).tolist()):
        starts = torch.nonzero((candidates[source] & ~used[source]).flatten())[:, 0]
        lookups = []
        for target in others:
            seen = look_up(surfaces, source, target)
            lookups.append(seen)
            used[target].flatten()[seen.nearest.flatten()[starts][seen.agrees.flatten()[starts]]] = True
        part = _tracks_of(surfaces, source, others, lookups, starts, images, first, max_error)
        parts.append(part)
        first += len(part)
    return thin_tracks(_joined(parts), max_points, seed)


def _candidates(keep: np.ndarray, max_points: int | None, seed: int) -> Tensor:
    limit = None if max_points is None else _CANDIDATES_PER_POINT * max_points
    chosen = np.zeros(keep.size, dtype=bool)
    chosen[thin_pixels(keep, max_points=limit, seed=seed)] = True
    return torch.from_numpy(chosen.reshape(keep.shape))


def _tracks_of(
    surfaces: Surfaces,
    source: int,
    others: list[int],
    lookups: list[Lookup],
    starts: Tensor,
    images: np.ndarray,
    first: int,
    max_error: float,
) -> Tracks:
    """Tracks that start at the pixels `starts` (n,) of view `source`, numbered from `first`."""
    width = surfaces.image_hw[1]
    views = [source, *others]
    own = torch.stack((starts % width, starts // width), dim=-1).to(surfaces.K)
    pixels = torch.stack([own, *(seen.pixel.flatten(0, 1)[starts] for seen in lookups)])  # (V, n, 2)
    observed = torch.stack([torch.ones_like(starts, dtype=torch.bool), *(s.agrees.flatten()[starts] for s in lookups)])
    K, T = surfaces.K[views].double(), surfaces.T_cam_world[views].double()
    world = torch.stack([_back_projected(surfaces, view, pixels[i]) for i, view in enumerate(views)])  # (V, n, 3)
    known = observed & world.isfinite().all(-1)
    xyz = torch.where(known[..., None], world, 0.0).sum(0) / known.sum(0)[:, None].clamp(min=1)
    in_cameras = transform_points(T, xyz.expand(len(views), -1, -1))
    error = torch.linalg.vector_norm(project(in_cameras, K) - pixels, dim=-1)
    observed &= (error <= max_error) & (in_cameras[..., 2] > 0)
    enough = observed.sum(0) >= 2
    point, number = torch.nonzero(observed[:, enough].T, as_tuple=True)
    colours = images[source].reshape(-1, 3)[starts[enough].numpy()]
    return Tracks(
        xyz=xyz[enough].numpy(),
        colours=colours,
        point=point.numpy() + first,
        view=np.array(views)[number.numpy()],
        pixel=pixels[:, enough][number, point].double().numpy(),
    )


def _back_projected(surfaces: Surfaces, view: int, pixel: Tensor) -> Tensor:
    """World points (n, 3) float64 at sub-pixel places (n, 2) of a view; NaN next to an edge or unusable pixels.

    Inverse depth is interpolated, because it is linear on planes.
    """
    surface = surfaces.of(view)
    depth = surface.depth_z
    height, width = depth.shape
    low = pixel.floor().long()
    low[:, 0].clamp_(0, max(width - 2, 0))
    low[:, 1].clamp_(0, max(height - 2, 0))
    # Half a pixel beyond the outermost centres lies inside the image: continue the last cell.
    u, v = (pixel - low).double().unbind(-1)
    index = low[:, 1] * width + low[:, 0]
    right, below = min(1, width - 1), width * min(1, height - 1)
    a, b, c, d = (1 / depth.flatten()[index + step].double() for step in (0, right, below, right + below))
    inverse_depth = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
    nearest = depth.flatten()[(v.round() * below).long() + index + (u.round() * right).long()].double()
    z = 1 / inverse_depth
    allowed = 2 * surface.allowed.flatten()[index]
    z = torch.where((z / nearest - 1).abs() <= allowed, z, torch.nan)
    homogeneous = torch.cat((pixel.double(), torch.ones_like(pixel[:, :1], dtype=torch.float64)), dim=-1)
    in_camera = z[:, None] * homogeneous @ torch.linalg.inv(surfaces.K[view].double()).T
    return transform_points(inverse(surfaces.T_cam_world[view].double()), in_camera)


def _joined(parts: list[Tracks]) -> Tracks:
    names = ("xyz", "colours", "point", "view", "pixel")
    return Tracks(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def thin_tracks(tracks: Tracks, max_points: int | None, seed: int = 0) -> Tracks:
    """Return a seeded random choice of at most `max_points` points with their observations; None keeps all."""
    return _select(tracks, thin_points(np.arange(len(tracks)), max_points=max_points, seed=seed))


def inside(tracks: Tracks, masks: np.ndarray) -> Tracks:
    """Return the points all of whose observations fall on masks (S, H, W) bool, one for each view."""
    height, width = masks.shape[1:]
    column, row = np.clip(np.rint(tracks.pixel), 0, (width - 1, height - 1)).astype(np.int64).T
    outside = tracks.point[~masks[tracks.view, row, column]]
    return _select(tracks, np.setdiff1d(np.arange(len(tracks)), outside))


def _select(tracks: Tracks, chosen: np.ndarray) -> Tracks:
    number = np.full(len(tracks), -1)
    number[chosen] = np.arange(len(chosen))
    point = number[tracks.point]
    rows = point >= 0
    return Tracks(
        xyz=tracks.xyz[chosen],
        colours=tracks.colours[chosen],
        point=point[rows],
        view=tracks.view[rows],
        pixel=tracks.pixel[rows],
    )
