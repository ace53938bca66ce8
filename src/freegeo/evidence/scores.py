"""Scores of cameras and depth against verified matches, without ground truth (docs/evidence.md, "Scores").

All of them are per pair of views; errors are in matching pixels (`Matches.match_hw`). World frame and scale of a
candidate do not matter. A pair of nan has no evidence; a score without any pair is nan and says why.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from freegeo.evidence.candidate import Candidate
from freegeo.evidence.matches import Matches, MatchSettings, magsac
from freegeo.geometry.depth import valid_depth
from freegeo.geometry.rotation import rotation_angle
from freegeo.geometry.se3 import inverse, relative
from freegeo.metrics.pose import area_under_curve

__all__ = [
    "Carried",
    "DepthScale",
    "PairAngles",
    "PairScores",
    "carried",
    "depth_scale",
    "epipolar",
    "off_edges",
    "reprojection",
    "two_view",
]

EDGE = 0.05
"""Relative range of depth in 3 x 3 pixels from which a place counts as a depth edge."""
BEHIND = 8.0
"""A point behind a camera counts as so many times the median error."""
FEWEST = 6
"""A pair with fewer usable matches has no evidence."""
MOST_FITTED = 200
"""With twice as many matches or more, `two_view` fits every second, third, ... of them."""
FACTORS = (0.90, 1.10)
"""Range of the depth factor of `depth_scale`."""
_NO_DEPTH = "No pair of views has enough matches on smooth surfaces of known depth."


@dataclass(frozen=True, kw_only=True, eq=False)
class PairScores:
    """One error for each pair of views with matches."""

    pairs: np.ndarray
    """(P, 2) int64 views."""
    values: np.ndarray
    """(P,) float64 matching pixels, lower is better; nan where the pair has no evidence."""
    used: np.ndarray
    """(P,) int64 matches that were used."""
    reason: str | None
    """Why no pair has a value; None when one has."""

    @property
    def mean(self) -> float:
        """Mean over the pairs that have a value, unclipped; nan without any."""
        return _mean(self.values)

    @property
    def median(self) -> float:
        """Median over the pairs that have a value, which a few wrongly verified pairs do not move; nan without any."""
        known = self.values[~np.isnan(self.values)]
        return float(np.median(known)) if len(known) else float("nan")


@dataclass(frozen=True, kw_only=True, eq=False)
class PairAngles:
    """Angles between each pair's relative pose as its matches give it and as a candidate has it."""

    pairs: np.ndarray
    """(P, 2) int64 views."""
    rotation_deg: np.ndarray
    """(P,) 0 to 180; nan where the matches give no pose."""
    translation_deg: np.ndarray
    """(P,) angle between the baselines up to sign, 0 to 90; nan where the matches give no pose."""
    reason: str | None
    """Why no pair has a value; None when one has."""

    def area(self, threshold_deg: int = 30) -> float:
        """Area under the recall curve of the larger angle, 0 to 1, higher is better; nan without a pair."""
        worst = np.maximum(self.rotation_deg, self.translation_deg)
        return float(area_under_curve(torch.from_numpy(worst[~np.isnan(worst)]), threshold_deg))


@dataclass(frozen=True, kw_only=True)
class DepthScale:
    """By how much all depths disagree with the scale of the camera positions."""

    factor: float
    """Depth factor with the least reprojection error, within `FACTORS`; nan without evidence."""
    error_px: float
    """`reprojection(...).mean` with this factor."""
    reason: str | None

    @property
    def drift(self) -> float:
        """Distance of the factor from 1."""
        return abs(self.factor - 1)


def epipolar(candidate: Candidate, matches: Matches) -> PairScores:
    """S1: median Sampson distance of each pair's matches from the candidate's epipolar lines.

    It sees errors of poses and focal lengths, and nothing of depth. Two cameras in one place have no epipolar lines;
    they map the first photo onto the second by a homography, and the match's first-order distance from that counts.
    """
    sides = _sides(candidate, matches)
    pair, x, y = sides.pair, _homogeneous(sides.x), _homogeneous(sides.y)
    infinite, epipole = sides.mapping(forth=True)
    mapped = _rows(infinite[pair], x)
    line = torch.linalg.cross(epipole[pair], mapped)
    back = _rows(infinite.mT[pair], torch.linalg.cross(y, epipole[pair]))
    steep = torch.sqrt(line[:, :2].square().sum(-1) + back[:, :2].square().sum(-1))
    distance = (line * y).sum(-1).abs() / steep
    transfer = torch.linalg.vector_norm(mapped[:, :2] / mapped[:, 2:] - sides.y, dim=-1) / 2**0.5
    distance = torch.where((epipole == 0).all(-1)[pair], transfer, distance)
    values, used = _medians(distance.numpy(), matches.pair_of, len(matches.pairs))
    return _pair_scores(matches, values, used, None)


def two_view(candidate: Candidate, matches: Matches, *, settings: MatchSettings | None = None) -> PairAngles:
    """S1b: angles between the candidate's relative poses and those of essential matrices fitted to the matches.

    Only the candidate's intrinsics enter the fit (MAGSAC++, then the one of four poses with the points in front). Noisy
    for a single pair, in the translation above all where the baseline is short or the scene flat; good on average.
    """
    import cv2

    settings = settings or MatchSettings()
    sides = _sides(candidate, matches)
    x, y, K, own = (value.numpy() for value in (sides.x, sides.y, sides.K, sides.T))
    fitted = np.full((len(matches.pairs), 4, 4), np.nan)
    starts = matches.pair_start
    for pair, (low, high) in enumerate(pairwise(starts)):
        i, j = matches.pairs[pair]
        chosen = slice(low, high, max(1, (high - low) // MOST_FITTED))
        try:
            essential, mask = cv2.findEssentialMat(
                x[chosen], y[chosen], K[i], K[j], None, None, magsac(settings, settings.threshold_px)
            )
            if essential is None or essential.shape != (3, 3):
                continue
            ends = [_normalised(pixel[chosen], K[view]) for pixel, view in ((x, i), (y, j))]
            in_front, R, t, _ = cv2.recoverPose(essential, *ends, np.eye(3), mask=mask)
        except cv2.error:
            continue
        if in_front >= FEWEST:
            fitted[pair, :3, :3], fitted[pair, :3, 3] = R, t[:, 0]
    rotation = torch.rad2deg(rotation_angle(*(torch.from_numpy(m[:, :3, :3]) for m in (own, fitted)))).numpy()
    with np.errstate(invalid="ignore"):
        length = np.linalg.norm(own[:, :3, 3], axis=1)
        cosine = np.abs((own[:, :3, 3] * fitted[:, :3, 3]).sum(axis=1)) / np.where(length == 0, np.inf, length)
        translation = np.rad2deg(np.arccos(np.clip(cosine, 0, 1)))
    none = "The matches of no pair of views give a relative pose."
    reason = matches.reason() or (none if np.isnan(rotation).all() else None)
    return PairAngles(pairs=matches.pairs, rotation_deg=rotation, translation_deg=translation, reason=reason)


def off_edges(candidate: Candidate, matches: Matches) -> np.ndarray:
    """Which match ends (M, 2) lie on smooth, known depth: no range above 5 % in the 3 x 3 pixels around them."""
    return _lifted(candidate, matches)[1].numpy()


def reprojection(
    candidate: Candidate, matches: Matches, *, keep: np.ndarray | None = None, factor: float = 1.0
) -> PairScores:
    """S2: median distance of matches from where the candidate's depth and cameras put them, both directions together.

    Points behind the other camera count as `BEHIND` times the median of the others of their pair.

    Args:
        candidate: cameras and depth.
        matches: of the same photos.
        keep: (M, 2) bool, match ends whose depth is used, so that candidates are compared on the same ones; None: those
            of this candidate (`off_edges`). Ends without known depth in this candidate are left out in any case.
        factor: all depths are multiplied by it.
    """
    return carried(candidate, matches, keep=keep).reprojection(factor)


def depth_scale(candidate: Candidate, matches: Matches, *, keep: np.ndarray | None = None) -> DepthScale:
    """S2g: the factor on all depths that makes `reprojection` least; arguments as there.

    Depth and poses of a network can drift apart in scale while each of them looks better.
    """
    return carried(candidate, matches, keep=keep).depth_scale()


@dataclass(frozen=True, kw_only=True, eq=False)
class _Sides:
    """The matches in matching pixels, and a candidate's cameras for them."""

    pairs: Tensor
    """(P, 2) int64."""
    pair: Tensor
    """(M,) int64."""
    x: Tensor
    """(M, 2) float64 in the first view."""
    y: Tensor
    """(M, 2) in the second."""
    K: Tensor
    """(S, 3, 3)."""
    T: Tensor
    """(P, 4, 4) from the first view to the second."""

    def mapping(self, *, forth: bool) -> tuple[Tensor, Tensor]:
        """Matrices (P, 3, 3) and vectors (P, 3): a pixel with depth z appears at matrix @ pixel * z + vector."""
        here, there = self.pairs.T if forth else self.pairs.flip(1).T
        motion = self.T if forth else inverse(self.T)
        infinite = self.K[there] @ motion[:, :3, :3] @ torch.linalg.inv(self.K[here])
        return infinite, _rows(self.K[there], motion[:, :3, 3])


def _sides(candidate: Candidate, matches: Matches) -> _Sides:
    _same_views(candidate, matches)
    pairs = torch.from_numpy(matches.pairs)
    x, y = torch.from_numpy(matches.in_matching_pixels()[matches.ends]).unbind(1)
    return _Sides(
        pairs=pairs,
        pair=torch.from_numpy(matches.pair_of),
        x=x,
        y=y,
        K=candidate.matching_K(*map(torch.from_numpy, (matches.photo_hw, matches.match_hw))),
        T=relative(candidate.T_cam_world[pairs[:, 0]], candidate.T_cam_world[pairs[:, 1]]),
    )


def _same_views(candidate: Candidate, matches: Matches) -> None:
    if len(candidate) != len(matches):
        raise ValueError(f"a candidate of {len(candidate)} views and matches of {len(matches)} photos")


def _lifted(candidate: Candidate, matches: Matches) -> tuple[Tensor, Tensor]:
    """Depth (M, 2) at both ends of every match, nan where unknown, and where it is known and smooth (M, 2)."""
    _same_views(candidate, matches)
    view = torch.from_numpy(matches.view_of)
    pixel = candidate.in_model(view, torch.from_numpy(matches.keypoints))
    ends = torch.from_numpy(matches.ends)
    z, smooth = depth_at(candidate.depth_z.detach().cpu(), view, pixel)
    return z[ends], smooth[ends]


def depth_at(depth_z: Tensor, view: Tensor, pixel: Tensor) -> tuple[Tensor, Tensor]:
    """Depth (n,) at places (n, 2) of views (n,), and whether it is known and off depth edges.

    Inverse depth is interpolated, because it is linear on planes; unknown depth next to the place, or a place outside
    the map (S, H, W), gives nan.
    """
    height, width = depth_z.shape[1:]
    u, v = pixel.unbind(-1)
    inside = (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)
    u, v = (torch.where(inside, value, 0.0) for value in (u, v))
    column, row = u.floor().long().clamp(0, max(width - 2, 0)), v.floor().long().clamp(0, max(height - 2, 0))
    right, below = min(1, width - 1), min(1, height - 1)
    a, b = (u - column).clamp(0, 1), (v - row).clamp(0, 1)
    corners = (_known(depth_z[view, row + below * y, column + right * x]) for y in (0, 1) for x in (0, 1))
    one, two, three, four = (1 / corner for corner in corners)
    z = 1 / ((1 - b) * ((1 - a) * one + a * two) + b * ((1 - a) * three + a * four))
    z = torch.where(inside, z, torch.nan)
    around = _neighbourhood(depth_z, view, pixel.round().long())
    smooth = around.amax(-1) <= (1 + EDGE) * around.amin(-1)  # false for nan
    return z, smooth & ~z.isnan()


def _neighbourhood(depth_z: Tensor, view: Tensor, pixel: Tensor) -> Tensor:
    """The 3 x 3 depths (n, 9) around pixels (n, 2); the border is repeated."""
    height, width = depth_z.shape[1:]
    shifts = [(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)]
    around = [
        depth_z[view, (pixel[:, 1] + y).clamp(0, height - 1), (pixel[:, 0] + x).clamp(0, width - 1)] for x, y in shifts
    ]
    return _known(torch.stack(around, dim=-1))


def _known(depth_z: Tensor) -> Tensor:
    """Depth in double precision, nan where it is not usable."""
    return torch.where(valid_depth(depth_z), depth_z, torch.nan).double()


@dataclass(frozen=True, kw_only=True, eq=False)
class Carried:
    """Match ends with depth, in both directions, sorted by pair: a pixel with depth z lands at `turned` z + `shift`."""

    matches: Matches
    turned: np.ndarray
    """(3, n) homogeneous matching pixels of the other view for each unit of depth."""
    shift: np.ndarray
    """(3, n)."""
    wanted: np.ndarray
    """(2, n) the match's own pixel in the other view."""
    pair: np.ndarray
    """(n,)."""

    def reprojection(self, factor: float = 1.0) -> PairScores:
        """Return S2, as the function `reprojection`."""
        return _pair_scores(self.matches, *self._medians(factor), _NO_DEPTH)

    def depth_scale(self) -> DepthScale:
        """Return S2g, as the function `depth_scale`."""
        from scipy.optimize import minimize_scalar

        def error(factor: float) -> float:
            return _mean(self._medians(factor)[0])

        start = error(1.0)
        if np.isnan(start):
            return DepthScale(factor=float("nan"), error_px=float("nan"), reason=self.matches.reason() or _NO_DEPTH)
        found = minimize_scalar(error, bounds=FACTORS, method="bounded", options={"xatol": 5e-4})
        best, factor = min((start, 1.0), (float(found.fun), float(found.x)))
        return DepthScale(factor=factor, error_px=best, reason=None)

    def _medians(self, factor: float) -> tuple[np.ndarray, np.ndarray]:
        """Median distance (P,) of each pair with all depths times a factor, inf behind the other camera; and counts."""
        x, y, depth = self.turned * factor + self.shift
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.hypot(x / depth - self.wanted[0], y / depth - self.wanted[1])
        return _medians(np.where(depth > 0, distance, np.inf), self.pair, len(self.matches.pairs))


def carried(candidate: Candidate, matches: Matches, *, keep: np.ndarray | None = None) -> Carried:
    """Carry match ends by a candidate's depth and cameras, once for both scores; arguments as `reprojection`."""
    z, smooth = _lifted(candidate, matches)
    usable = smooth if keep is None else torch.from_numpy(keep) & ~z.isnan()
    sides = _sides(candidate, matches)
    parts = []
    for side, (own, other) in enumerate(((sides.x, sides.y), (sides.y, sides.x))):
        chosen = usable[:, side]
        pair = sides.pair[chosen]
        infinite, shift = sides.mapping(forth=side == 0)
        turned = _rows(infinite[pair], _homogeneous(own[chosen])) * z[chosen, side, None]
        parts.append((turned, shift[pair], other[chosen], pair))
    turned, shift, wanted, pair = (torch.cat(values) for values in zip(*parts, strict=True))
    order = torch.argsort(pair, stable=True)
    return Carried(
        matches=matches,
        turned=turned[order].T.numpy(),
        shift=shift[order].T.numpy(),
        wanted=wanted[order].T.numpy(),
        pair=pair[order].numpy(),
    )


def _medians(errors: np.ndarray, pair: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Median (P,) of the errors (n,) of each pair, and their number; `pair` (n,) is sorted.

    An error of inf (behind a camera) counts as `BEHIND` times the median of the others; nan for too few errors.
    """
    start = np.searchsorted(pair, np.arange(count + 1))
    values = np.full(count, np.nan)
    for number, (low, high) in enumerate(pairwise(start)):
        if high - low < FEWEST:
            continue
        own = errors[low:high]
        behind = np.isinf(own)
        if behind.all():
            # There is no median to count by.
            values[number] = np.inf
            continue
        values[number] = np.median(np.where(behind, BEHIND * np.median(own[~behind]), own) if behind.any() else own)
    return values, np.diff(start)


def _pair_scores(matches: Matches, values: np.ndarray, used: np.ndarray, no_value: str | None) -> PairScores:
    reason = (matches.reason() or no_value) if np.isnan(values).all() else None
    return PairScores(pairs=matches.pairs, values=values, used=used, reason=reason)


def _mean(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")


def _homogeneous(pixel: Tensor) -> Tensor:
    return torch.cat((pixel, torch.ones_like(pixel[:, :1])), dim=-1)


def _rows(matrix: Tensor, vectors: Tensor) -> Tensor:
    """Multiply vectors (n, 3) by matrices (n, 3, 3), one each."""
    return (matrix @ vectors[..., None])[..., 0]


def _normalised(pixel: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Image-plane coordinates (n, 2) of pixels (n, 2)."""
    rays = np.linalg.solve(K, np.vstack((pixel.T, np.ones(len(pixel)))))
    return np.ascontiguousarray((rays[:2] / rays[2]).T)
