"""How two chunks that share frames lie to each other: a robust similarity between the points of the same pixels.

A frame that is in both chunks has the same pixels in both, so its points are matched without any search. What is
measured, and where the limits come from: docs/sequences.md, "Seams".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from freegeo.errors import FreeGeoError
from freegeo.fusion.settings import FilterSettings
from freegeo.geometry.se3 import camera_centres, inverse, transform_points
from freegeo.geometry.sim3 import DegenerateAlignmentError, ScaleRule, Sim3, umeyama

__all__ = ["FEWEST_INLIERS", "INLIER", "Depths", "Seam", "align", "align_points", "gap"]

INLIER = 0.1
"""Two points of one pixel agree when they are closer than this share of the pixel's depth."""
FEWEST_INLIERS, DOUBTFUL_INLIERS = 0.3, 0.6
"""Shares of the shared pixels that have to agree: with fewer than the first a seam is as bad as one to another scene,
and is not used; with fewer than the second it is used and doubted."""
FEWEST_PIXELS = 100
LARGEST_SCALE = 20.0
"""A chunk that is larger or smaller than its neighbour by more than this factor is not believed."""
LARGEST_LEVERAGE = 0.5
"""Largest residual, relative to the second largest extent of the shared points: narrower ones leave a turn open."""
FEWEST_POINTS, POINT_INLIERS = 10, 0.5
"""So many points that matches measure in both chunks, and this share of them, have to agree to make a seam."""
BLANK = 2.0
"""Standard deviation of the colours (0 to 255) below which a frame shows nothing."""

_MAX_PIXELS = 20_000
_KERNEL_MEDIANS = 1.5
_WIDEST_KERNEL = 0.05
_MOST_STEPS = 50
_CONVERGED = 1e-6
_DRAWS, _DRAWN = 100, 4
"""Starts of `align_points`, and points of each."""


class Depths(Protocol):
    """What `align` reads of a chunk; `Reconstruction` has it. Arrays are (S, ...), one entry a frame."""

    @property
    def depth_z(self) -> np.ndarray:
        """Depth (S, H, W)."""
        ...

    @property
    def conf(self) -> np.ndarray:
        """Confidence (S, H, W); only its order counts."""
        ...

    @property
    def sky(self) -> np.ndarray | None:
        """Share of sky (S, H, W), or None."""
        ...

    @property
    def images(self) -> np.ndarray:
        """Images (S, H, W, 3) uint8."""
        ...

    @property
    def scale_xy(self) -> np.ndarray:
        """Scale (S, 2) from pixels of the photo to those of the maps."""
        ...

    @property
    def offset_xy(self) -> np.ndarray:
        """Offset (S, 2) that goes with it."""
        ...

    def cameras(self) -> tuple[np.ndarray, np.ndarray]:
        """Return `T_cam_world` (S, 4, 4) and `K` (S, 3, 3); UserError where there are none."""
        ...

    def valid_pixels(self) -> np.ndarray:
        """Return where the depth can be used, (S, H, W) bool."""
        ...


@dataclass(frozen=True, kw_only=True)
class Seam:
    """How the second of two chunks lies in the frame of the first, and whether that may be believed."""

    sim3: Sim3
    """Maps points of the second chunk to the first, float64; the identity where nothing could be measured."""
    frames: int
    """Shared frames that show something."""
    pixels: int
    """Pixels that were compared."""
    inliers: float
    """Share, 0 to 1, of these whose two points are closer than `INLIER` times their depth."""
    rms: float
    """Root mean square distance of the inliers, each relative to its depth; NaN without any."""
    centre: Tensor
    """Mean (3,) of the shared points in the second chunk's frame."""
    depth: float
    """Median depth of the shared pixels in the second chunk's units."""
    by_matches: bool
    """Whether points that matches measure make the seam, not the depth of shared frames."""
    reason: str | None
    """A sentence that says why the seam cannot be used; None: it can."""
    doubt: str | None
    """A sentence that says why a seam that can be used is not sure; None: it is."""

    @property
    def weight(self) -> float:
        """How much the seam counts where it meets others."""
        return 1.0 if self.by_matches else self.inliers


@dataclass(frozen=True, kw_only=True)
class _Shared:
    """Points (N, 3), depths (N,) and weights (N,) of the pixels that both chunks have."""

    first: Tensor
    second: Tensor
    depth_first: Tensor
    depth_second: Tensor
    weights: Tensor
    starts: list[Sim3]
    """Where to begin: for each frame, where its two cameras and its median depth put the second chunk."""

    def residuals(self, sim3: Sim3) -> Tensor:
        """Distances (N,) of the two points of a pixel, relative to the geometric mean of its two depths.

        Relative to its own depth, a pixel counts alike near and far. The mean of both depths makes the sum of squares
        the one that `umeyama` minimises with `symmetric`, and the residual the same when the chunks change places.
        """
        distance = torch.linalg.vector_norm(self.first - sim3.apply(self.second), dim=-1)
        return distance / (sim3.s * self.depth_first * self.depth_second).sqrt()


def align(
    first: Depths,
    second: Depths,
    rows: Sequence[tuple[int, int]],
    *,
    fixed_scale: bool = False,
    measured: Sim3 | None = None,
) -> Seam:
    """Find how the chunk `second` lies in the frame of `first`.

    The sum of a Cauchy loss of `residuals` over at most 20 000 pixels is minimised, by least squares with new weights
    in every step. The chunks are exchangeable: the other way around the transform is the inverse.

    Args:
        first: the chunk that stays.
        second: the chunk that moves.
        rows: for each frame in both, its row in `first` and in `second`.
        fixed_scale: lengths of both are in one unit (metric models, known cameras), so the scale is 1.
        measured: the seam by points that matches measure in both (`align_points`), which are surer than depth; only
            how well surfaces fit there is looked at.

    Returns:
        The seam; `reason` says why it cannot be trusted.

    Raises:
        UserError: a chunk without cameras.
        FreeGeoError: no shared frames.
    """
    if not rows:
        raise FreeGeoError("Two chunks without a common frame cannot be aligned; align those that overlap.")
    if first.depth_z.shape[1:] != second.depth_z.shape[1:] or not _same_pixels(first, second, rows):
        return _nothing(0, 0, "the shared frames were cut or scaled differently in the two chunks.")
    shown = [(i, j) for i, j in rows if not (_is_blank(first.images[i]) or _is_blank(second.images[j]))]
    if not shown:
        return _nothing(0, 0, "the shared frames show nothing: each is of one colour.")
    shared = _shared(first, second, shown, fixed_scale=fixed_scale)
    count = 0 if shared is None else len(shared.weights)
    if shared is None or count < FEWEST_PIXELS:
        return _nothing(len(shown), count, f"only {count} pixels of the shared frames have a depth in both chunks.")
    by_matches = measured is not None
    try:
        sim3 = measured or _fit(shared, "one" if fixed_scale else "symmetric")
    except DegenerateAlignmentError:
        return _nothing(len(shown), count, "the points of the shared frames lie on one line or in one place.")
    residuals = shared.residuals(sim3)
    inlying = residuals < INLIER
    inliers = float(inlying.double().mean())
    rms = float(residuals[inlying].square().mean().sqrt())
    depth = float(shared.depth_second.median())
    return Seam(
        sim3=sim3,
        frames=len(shown),
        pixels=count,
        inliers=inliers,
        rms=rms,
        centre=shared.second.mean(0),
        depth=depth,
        by_matches=by_matches,
        reason=None if by_matches else _refusal(sim3, inliers, rms, _narrowness(shared.second[inlying] / depth)),
        doubt=_doubt(inliers, by_matches=by_matches),
    )


def align_points(first: Tensor, second: Tensor, depths: Tensor, *, fixed_scale: bool = False) -> Seam | None:
    """Find how a chunk lies in the frame of another by points that are known in both; wrong ones do no harm.

    Args:
        first: points (N, 3) in the frame of the chunk that stays.
        second: the same points in the frame of the other chunk.
        depths: (2, N) how far each is from the cameras of the two chunks.
        fixed_scale: as for `align`.

    Returns:
        The seam, of no shared frames; None where too few points agree.
    """
    rng, rule = np.random.default_rng(0), "one" if fixed_scale else "symmetric"
    starts = []
    for _ in range(_DRAWS if len(first) >= FEWEST_POINTS else 0):
        drawn = rng.choice(len(first), _DRAWN, replace=False)
        with suppress(DegenerateAlignmentError):
            starts.append(umeyama(second[drawn], first[drawn], scale=rule))
    if not starts:
        return None
    shared = _Shared(
        first=first, second=second, depth_first=depths[0], depth_second=depths[1],
        weights=torch.ones(len(first), dtype=torch.float64), starts=starts,
    )  # fmt: skip
    try:
        sim3 = _fit(shared, rule)
    except DegenerateAlignmentError:
        return None
    residuals = shared.residuals(sim3)
    inlying = residuals < INLIER
    inliers = float(inlying.double().mean())
    if int(inlying.sum()) < FEWEST_POINTS or inliers < POINT_INLIERS:
        return None
    return Seam(
        sim3=sim3, frames=0, pixels=len(first), inliers=inliers, rms=float(residuals[inlying].square().mean().sqrt()),
        centre=second.mean(0), depth=float(depths[1].median()), by_matches=True, reason=None, doubt=None,
    )  # fmt: skip


def gap(
    first: Depths, second: Depths, rows: Sequence[tuple[int, int]], place_first: Sim3, place_second: Sim3
) -> float | None:
    """Median distance between the two places of a shared pixel, relative to its depth; None without shared frames.

    Args:
        first: a chunk.
        second: another.
        rows: for each frame in both, its row in `first` and in `second`.
        place_first: where `first` was put.
        place_second: where `second` was put, in the same frame.

    Returns:
        The median, or None where the chunks have no pixel in common.
    """
    shared = _shared(first, second, rows, fixed_scale=True) if rows else None
    return None if shared is None else float(shared.residuals(place_first.inverse() @ place_second).median())


def _nothing(frames: int, pixels: int, reason: str) -> Seam:
    return Seam(
        sim3=Sim3.identity(),
        frames=frames,
        pixels=pixels,
        inliers=0.0,
        rms=math.nan,
        centre=torch.zeros(3, dtype=torch.float64),
        depth=1.0,
        by_matches=False,
        reason=reason,
        doubt=None,
    )


def _same_pixels(first: Depths, second: Depths, rows: Sequence[tuple[int, int]]) -> bool:
    left, right = (list(side) for side in zip(*rows, strict=True))
    return np.array_equal(first.scale_xy[left], second.scale_xy[right]) and np.array_equal(
        first.offset_xy[left], second.offset_xy[right]
    )


def _is_blank(image: np.ndarray) -> bool:
    return float(image[::4, ::4].std(axis=(0, 1)).max()) < BLANK


def _shared(first: Depths, second: Depths, rows: Sequence[tuple[int, int]], *, fixed_scale: bool) -> _Shared | None:
    """Gather a seeded choice of the pixels that both chunks have, equally many of each frame; None without any."""
    most = max(_MAX_PIXELS // len(rows), 1)
    rng = np.random.default_rng(0)
    cameras = [chunk.cameras() for chunk in (first, second)]
    usable = [_usable(chunk) for chunk in (first, second)]
    columns: list[list[Tensor]] = []
    starts = []
    for row in rows:
        pixels = np.flatnonzero(usable[0][row[0]] & usable[1][row[1]])
        if len(pixels) == 0:
            continue
        if len(pixels) > most:
            pixels = rng.choice(pixels, most, replace=False)
        (points, depths, conf, T), (other_points, other_depths, other_conf, other_T) = (
            _pixels(chunk, T[i], K[i], i, pixels)
            for chunk, (T, K), i in zip((first, second), cameras, row, strict=True)
        )
        columns.append([points, other_points, depths, other_depths, conf, other_conf])
        ratio = torch.ones_like(depths[0]) if fixed_scale else (depths / other_depths).median()
        starts.append(_start(T, other_T, ratio))
    if not columns:
        return None
    points, other_points, depths, other_depths, conf, other_conf = map(torch.cat, zip(*columns, strict=True))
    return _Shared(
        first=points,
        second=other_points,
        depth_first=depths,
        depth_second=other_depths,
        weights=(_ranks(conf) * _ranks(other_conf)).sqrt(),
        starts=starts,
    )


def _usable(chunk: Depths) -> np.ndarray:
    valid = chunk.valid_pixels()
    return valid if chunk.sky is None else valid & (chunk.sky < FilterSettings.sky_limit)


def _pixels(
    chunk: Depths, T_cam_world: np.ndarray, K: np.ndarray, row: int, pixels: np.ndarray
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """World points (n, 3), depths (n,) and confidences (n,) of some pixels of a frame, and its camera, in float64."""
    v, u = np.unravel_index(pixels, chunk.depth_z.shape[1:])
    rays = np.linalg.solve(np.asarray(K, np.float64), np.stack((u, v, np.ones_like(u))).astype(np.float64)).T
    depth_z, conf = (torch.from_numpy(maps[row][v, u].astype(np.float64)) for maps in (chunk.depth_z, chunk.conf))
    T = torch.from_numpy(np.asarray(T_cam_world, np.float64))
    return transform_points(inverse(T), depth_z[:, None] * torch.from_numpy(rays)), depth_z, conf, T


def _start(T_first: Tensor, T_second: Tensor, ratio: Tensor) -> Sim3:
    """The transform that puts a frame's camera of the second chunk onto that of the first, with a scale."""
    R = T_first[:3, :3].mT @ T_second[:3, :3]
    return Sim3(s=ratio, R=R, t=camera_centres(T_first) - ratio * (R @ camera_centres(T_second)))


def _ranks(conf: Tensor) -> Tensor:
    """Ranks (N,) in 0..1, equal values alike: confidences are not calibrated, and differ in range between models."""
    from scipy.stats import rankdata

    return torch.from_numpy(rankdata(conf.numpy()) / len(conf))


def _fit(shared: _Shared, scale: ScaleRule) -> Sim3:
    """Minimise the robust sum of residuals from the best of the starts.

    The kernel's width is 1.5 times the median residual. In a second pass it is at most a twentieth of the depth, so
    that two chunks of which less than half agrees still meet there.
    """
    sim3 = min(shared.starts, key=lambda start: float(shared.residuals(start).median()))
    base = shared.weights / (shared.depth_first * shared.depth_second)
    for widest in (math.inf, _WIDEST_KERNEL):
        for _ in range(_MOST_STEPS):
            residuals = shared.residuals(sim3)
            width = min(max(_KERNEL_MEDIANS * float(residuals.median()), _CONVERGED), widest)
            moved = umeyama(shared.second, shared.first, base / (1 + (residuals / width).square()), scale=scale)
            step = float((shared.residuals(moved) - residuals).abs().max())
            sim3 = moved
            if step < _CONVERGED:
                break
    return sim3


def _narrowness(points: Tensor) -> float:
    """Second largest extent (standard deviation) of points (N, 3): how far they are from lying on a line."""
    if len(points) < 3:
        return 0.0
    return float(torch.linalg.eigvalsh(points.T.cov())[1].clamp(min=0).sqrt())


def _refusal(sim3: Sim3, inliers: float, rms: float, extent: float) -> str | None:
    scale = float(sim3.s)
    if not (1 / LARGEST_SCALE < scale < LARGEST_SCALE):
        return f"one chunk would be {max(scale, 1 / scale):.3g} times as large as the other."
    if inliers < FEWEST_INLIERS:
        return (
            f"the two chunks do not fit together: {inliers:.0%} of the shared pixels have one place, and "
            f"{FEWEST_INLIERS:.0%} are needed."
        )
    if rms > LARGEST_LEVERAGE * extent:
        return "the shared pixels show too narrow a part of the scene to fix how one chunk is turned to the other."
    return None


def _doubt(inliers: float, *, by_matches: bool) -> str | None:
    if inliers >= DOUBTFUL_INLIERS:
        return None
    if by_matches:
        return (
            f"the cameras fit, as matches measure them, and surfaces do not: {inliers:.0%} of the shared pixels agree."
        )
    return f"the two chunks fit badly: only {inliers:.0%} of the shared pixels have one place."
