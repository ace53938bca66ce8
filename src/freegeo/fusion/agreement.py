"""What the other views say about each pixel's depth: how many agree with it, and how many contradict it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from freegeo.fusion.quantile import quantile
from freegeo.geometry.reproject import reproject
from freegeo.geometry.se3 import camera_centres

__all__ = [
    "Lookup",
    "Surface",
    "Surfaces",
    "Votes",
    "look_up",
    "nearest_views",
    "prepare",
    "relative_slope",
    "tolerance_from",
    "tolerance_of",
    "vote",
]

MAX_NEIGHBOURS = 6
"""Other views that a view's pixels are compared with."""
PREPARED = 32
"""Views whose prepared pixels are kept; neighbours in a sequence meet again within so many."""
TOLERANCE_RANGE = (0.02, 0.15)
"""Range of the tolerance that `tolerance_of` estimates."""
QUANTILE, _SPREAD = 0.25, 8.0
TOLERANCE_NEIGHBOURS = 2
"""Views that a view's differences are measured to, for the tolerance."""
_LARGEST_SLOPE = 0.2


@dataclass(frozen=True, kw_only=True)
class Votes:
    """Votes on every pixel of a view, (H, W) int16; a view votes only if the pixel's point falls into its image."""

    agree: Tensor
    """Other views whose surface lies where this pixel's does."""
    contradict: Tensor
    """Other views that see through this pixel's surface, or whose surface this pixel sees through."""
    asked: Tensor
    """Other views whose image the pixel's point falls into."""


@dataclass(frozen=True, kw_only=True)
class Surface:
    """The usable pixels of one view, prepared for `look_up`."""

    depth_z: Tensor
    """(H, W); NaN where not usable."""
    allowed: Tensor
    """(H, W) relative depth difference that counts as the same surface: the tolerance and the slope."""
    barrier: Tensor
    """(H + 1, W + 1) depth before which a point between four pixels floats in front of all of their surfaces."""


@dataclass(frozen=True, kw_only=True)
class Surfaces:
    """The usable pixels of S views, for `look_up`."""

    of: Callable[[int], Surface]
    """Prepares a view when it is asked for; the latest `PREPARED` are kept."""
    image_hw: tuple[int, int]
    T_cam_world: Tensor
    """(S, 4, 4)."""
    K: Tensor
    """(S, 3, 3)."""
    inside: Tensor | None
    """(S, H, W) bool: false where the image is padding; None: no padding."""


@dataclass(frozen=True, kw_only=True)
class Lookup:
    """One view's pixels compared with the depth map of another."""

    asked: Tensor
    """(H, W) bool: usable, and inside what the target's image shows."""
    agrees: Tensor
    """(H, W) bool: the nearest target pixel has the expected depth."""
    sees_through: Tensor
    """(H, W) bool: the target pixels around the projection (up to four) are all farther than expected."""
    nearest: Tensor
    """(H, W) int64: flat index of the nearest target pixel; meaningless where not asked."""
    pixel: Tensor
    """(H, W, 2) column and row of the projection in the target; meaningless where not asked."""
    difference: Tensor
    """(H, W) measured / expected - 1 at the nearest target pixel; NaN where not asked or not usable there."""


def prepare(
    depth_z: Tensor,
    T_cam_world: Tensor,
    K: Tensor,
    usable: Tensor,
    *,
    tolerance: float,
    inside: Tensor | None = None,
) -> Surfaces:
    """Prepare depth maps (S, H, W) for comparisons with a relative `tolerance`; only `usable` pixels take part.

    Maps and masks are read view by view, as the comparisons need them, so they must not change before the last one.
    `inside` (S, H, W) is false where an image is padding, which does not count as a place that its view looks at.
    """

    @lru_cache(maxsize=PREPARED)
    def of(view: int) -> Surface:
        known = torch.where(usable[view], depth_z[view], torch.nan)
        allowed = tolerance + relative_slope(known)
        front = torch.nn.functional.pad((known / (1 + allowed)).nan_to_num(torch.inf), (1, 1, 1, 1), value=torch.inf)
        barrier = -torch.nn.functional.max_pool2d(-front[None], 2, stride=1)[0]
        # Where none of the four pixels is usable, a barrier of 0 contradicts nothing.
        return Surface(depth_z=known, allowed=allowed, barrier=torch.where(barrier.isinf(), 0.0, barrier))

    height, width = depth_z.shape[1:]
    return Surfaces(of=of, image_hw=(height, width), T_cam_world=T_cam_world, K=K, inside=inside)


def vote(surfaces: Surfaces, neighbours: Tensor | None = None) -> Iterator[tuple[int, Votes]]:
    """Let the views vote on each other's usable pixels; yields each view and the votes on it when they are complete.

    A pixel's point is carried into another view. If that view has a surface there, it agrees; if it sees farther, one
    of the two pixels is wrong, and both get a contradiction; if it sees something nearer, the point is hidden and gets
    no vote. `neighbours` (S, n) are the views to compare with, by default `nearest_views`.
    """
    if neighbours is None:
        neighbours = nearest_views(surfaces.T_cam_world)
    others = neighbours.tolist()
    waiting = Counter(view for source, targets in enumerate(others) for view in (source, *targets))
    open_votes: dict[int, Votes] = {}

    def votes_on(view: int) -> Votes:
        if view not in open_votes:
            agree, contradict, asked = torch.zeros((3, *surfaces.image_hw), dtype=torch.int16, device=surfaces.K.device)
            open_votes[view] = Votes(agree=agree, contradict=contradict, asked=asked)
        return open_votes[view]

    for source in _close_together(others):
        own = votes_on(source)
        for target in others[source]:
            seen = look_up(surfaces, source, target)
            own.asked.add_(seen.asked)
            own.agree.add_(seen.agrees)
            own.contradict.add_(seen.sees_through)
            # One vote per pair of views and pixel, however many points land on it.
            hit = torch.zeros_like(own.asked, dtype=torch.bool)
            hit.view(-1)[seen.nearest[seen.sees_through]] = True
            votes_on(target).contradict.add_(hit)
        for view in (source, *others[source]):
            waiting[view] -= 1
            if not waiting[view]:
                yield view, open_votes.pop(view)


def _close_together(others: list[list[int]]) -> list[int]:
    """Order of views in which those that are compared with each other are close, so that few votes stay open."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    pairs = [(source, target) for source, targets in enumerate(others) for target in targets]
    if not pairs:
        return list(range(len(others)))
    rows, columns = np.array(pairs).T
    graph = coo_array((np.ones(len(pairs)), (rows, columns)), shape=(len(others), len(others))).tocsr()
    return reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True).tolist()


def look_up(surfaces: Surfaces, source: int, target: int) -> Lookup:
    """Compare the usable pixels of view `source` with the depth of view `target`."""
    width = surfaces.image_hw[1]
    surface = surfaces.of(target)
    there = reproject(
        surfaces.of(source).depth_z,
        K_source=surfaces.K[source],
        T_source_world=surfaces.T_cam_world[source],
        K_target=surfaces.K[target],
        T_target_world=surfaces.T_cam_world[target],
        target_hw=surfaces.image_hw,
    )
    asked = there.in_view
    pixel = torch.where(asked[..., None], there.pixel, 0.0)
    column, row = (pixel + 0.5).floor().long().unbind(-1)
    nearest = row * width + column
    if surfaces.inside is not None:
        asked = asked & surfaces.inside[target].flatten()[nearest]
    difference = surface.depth_z.flatten()[nearest] / there.depth_z - 1
    difference = torch.where(asked, difference, torch.nan)
    # The barrier between the pixels (u, v) and (u + 1, v + 1) has the index (u + 1, v + 1).
    after = (pixel.floor() + 1).long()
    barrier = surface.barrier.flatten()[after[..., 1] * (width + 1) + after[..., 0]]
    return Lookup(
        asked=asked,
        agrees=difference.abs() <= surface.allowed.flatten()[nearest],  # false for NaN
        sees_through=asked & (there.depth_z < barrier),
        nearest=nearest,
        pixel=pixel,
        difference=difference,
    )


def relative_slope(depth_z: Tensor) -> Tensor:
    """Relative depth change (..., H, W) to the next pixel, at most .2: the flatter side of each axis, both axes added.

    `depth_z` (..., H, W) holds NaN where it is not known; the slope is 0 there.
    """
    total = torch.zeros_like(depth_z)
    for dim in (-1, -2):
        step = depth_z.diff(dim=dim).abs().nan_to_num(torch.inf)
        edge = torch.full_like(depth_z.narrow(dim, 0, 1), torch.inf)
        total += torch.minimum(torch.cat((edge, step), dim), torch.cat((step, edge), dim)) / depth_z
    return total.clamp(max=_LARGEST_SLOPE).nan_to_num(0.0)


def nearest_views(T_cam_world: Tensor, count: int = MAX_NEIGHBOURS) -> Tensor:
    """Indices (S, min(count, S - 1)) of the views most like each view: distance of centres and angle between axes.

    Distances count in units of the median distance, angles in units of 45 degrees.
    """
    centres, axes = camera_centres(T_cam_world), T_cam_world[..., 2, :3]
    distance = torch.linalg.vector_norm(centres[:, None] - centres[None], dim=-1)
    angle = torch.arccos((axes @ axes.mT).clamp(-1, 1))
    unlike = distance / distance.median().clamp(min=1e-8) + angle / (torch.pi / 4)
    unlike.fill_diagonal_(torch.inf)
    return unlike.argsort(dim=-1, stable=True)[:, : min(count, len(T_cam_world) - 1)]


def tolerance_of(depth_z: Tensor, T_cam_world: Tensor, K: Tensor, usable: Tensor) -> float:
    """Tolerance for `prepare` from how well these maps agree: 0.02 to 0.15.

    It is 8 times the lower quartile of the relative differences between each view and its two nearest (2.5 standard
    deviations of normal noise); hidden points differ more, so the median would overestimate. Exact depth gets the
    lower bound; a network whose views disagree by some per cent is not filtered to nothing.
    """
    surfaces = prepare(depth_z, T_cam_world, K, usable, tolerance=0.0)
    others = nearest_views(T_cam_world, TOLERANCE_NEIGHBOURS).tolist()

    def differences() -> Iterator[np.ndarray]:
        for source, targets in enumerate(others):
            for target in targets:
                difference = look_up(surfaces, source, target).difference.abs()
                yield difference[~difference.isnan()].cpu().numpy()

    return tolerance_from(float(quantile(differences, QUANTILE)))


def tolerance_from(quartile: float) -> float:
    """Return the tolerance for a lower quartile of relative differences (`tolerance_of`); nan: nothing is compared."""
    low, high = TOLERANCE_RANGE
    return low if np.isnan(quartile) else min(max(_SPREAD * quartile, low), high)
