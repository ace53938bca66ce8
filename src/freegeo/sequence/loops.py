"""Loops: two frames far apart in a sequence that show one place, found by likeness and proved by matches.

docs/sequences.md, "Loops", describes the rules and what they were measured on.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from freegeo.evidence.candidate import Candidate
from freegeo.evidence.matches import Matches, find_matches
from freegeo.evidence.scores import epipolar
from freegeo.sequence.order import SAME_PICTURE, new_pictures

if TYPE_CHECKING:
    from freegeo.types import PhotoLike

__all__ = ["Agreement", "Loop", "agrees", "loop_candidates", "loop_frames", "verified"]

logger = logging.getLogger(__name__)

MUTUAL = 3
"""Each frame of a candidate is among so many far frames that are most like the other."""
FEWEST_PAIRS = 2
"""Each of the two frames must have verified matches with so many of the three around the other one."""
LEAST_SHARE = 0.9
"""Share of keypoints that match across a loop, over that of neighbours at one end which are about as alike."""
LARGEST_RATIO, ALWAYS_GOOD_PX = 2.0, 2.0
"""The epipolar error across a loop may be so many times that at its ends, and always so many matching pixels."""
_ROWS = 1024
"""Rows of the matrix of similarities in memory at once."""


@dataclass(frozen=True, kw_only=True)
class Loop:
    """Two frames that may show one place, and what the photos around them say."""

    first: int
    second: int
    similarity: float
    """Of the frames' descriptors."""
    matches: int
    """Verified matches of the two frames with the three around the other one, all five pairs together."""
    frames: Sequence[int]
    """The photos that were matched: three around the first frame, then three around the second, ascending."""
    reason: str | None
    """Why it is not a loop, in one sentence; None: it is used."""


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Whether a loop chunk's predicted cameras fit the matches across the loop."""

    error_px: float
    """Median over pairs across the loop of their epipolar error, matching pixels."""
    own_px: float
    """The same for pairs at one end."""
    reason: str | None
    """Why the loop must not be used, in one sentence; None: it agrees."""


def loop_candidates(descriptors: np.ndarray, *, apart: int, most: int | None = None) -> list[tuple[int, int, float]]:
    """Find pairs of frames that are far apart in the sequence and look alike: (first, second, similarity).

    The least similarity is the sequence's own: the median over frames that are a sixth of `apart` from each other. Each
    of the two frames is among the `MUTUAL` far frames most like the other. The same picture twice is no candidate: it
    says nothing about the way from one to the other. Of candidates that lie within half of
    `apart` of each other at both ends only the most similar is kept. Most similar first.

    Args:
        descriptors: (N, C) unit vectors of the frames in the order of the sequence.
        apart: least distance of the two frames in the sequence, at least 6; the size of a chunk is a good choice.
        most: largest number of candidates; None: one for every `apart` frames, and at least 8.

    Raises:
        ValueError: `apart` is below 6, so that the frames around both ends would be the same.
    """
    if apart < 6:
        raise ValueError(f"the ends of a loop must be at least 6 frames apart; apart is {apart}")
    count, step = len(descriptors), max(1, apart // 6)
    new = np.flatnonzero(new_pictures(descriptors))
    if count <= apart or len(new) <= step:
        return []
    least = float(np.median(_alike(descriptors, new[:-step], new[step:])))
    first, second = _mutual(descriptors, new, apart)
    similarity = _alike(descriptors, first, second)
    order = np.argsort(-similarity, kind="stable")
    kept: list[tuple[int, int, float]] = []
    for i, j, value in zip(first[order].tolist(), second[order].tolist(), similarity[order].tolist(), strict=True):
        if value < least or len(kept) == (max(8, count // apart) if most is None else most):
            break
        if all(max(abs(i - a), abs(j - b)) > apart // 2 for a, b, _ in kept):
            kept.append((i, j, value))
    return kept


def loop_frames(first: int, second: int, count: int, size: int) -> tuple[int, ...]:
    """Return the frames of a loop chunk, ascending: half of them around each end, none twice, all below `count`.

    Ends so near to each other that the halves would overlap have one stretch of frames around both.

    Args:
        first: the earlier end.
        second: the later end.
        count: frames of the sequence.
        size: frames of the chunk, at least 2; a shorter sequence gives all its frames.
    """
    size = min(size, count)
    halves = (size - size // 2, size // 2)
    starts = [min(max(0, end - half // 2), count - half) for end, half in zip((first, second), halves, strict=True)]
    if starts[0] + halves[0] > starts[1]:
        start = min(max(0, (first + second + 1 - size) // 2), count - size)
        return tuple(range(start, start + size))
    return tuple(frame for start, half in zip(starts, halves, strict=True) for frame in range(start, start + half))


def verified(
    candidates: Sequence[tuple[int, int, float]],
    photos: Sequence[PhotoLike],
    descriptors: np.ndarray,
    *,
    match: Callable[[Sequence[int]], Matches] | None = None,
) -> list[Loop]:
    """Match the photos around both ends of each candidate; a `Loop` with a reason is refused.

    Three frames around each end are matched with each other. They are so far apart that neighbours at one end are about
    as alike as the two ends. Both frames must have verified matches with `FEWEST_PAIRS` of the three frames around the
    other, and the share of keypoints that match must be as large as between neighbours: in a place that only looks
    alike, what is the same (a wall, a floor) matches, and everything else does not.

    Args:
        candidates: from `loop_candidates`.
        photos: of all frames; six are read for each candidate.
        descriptors: (N, C) of all frames.
        match: matches all pairs of some frames, or reads their matches; None: `find_matches`.
    """

    def found(frames: Sequence[int]) -> Matches:
        return find_matches([photos[frame] for frame in frames])

    return [_verified(candidate, len(photos), descriptors, match or found) for candidate in candidates]


def agrees(candidate: Candidate, frames: Sequence[int], loop: Loop, matches: Matches) -> Agreement:
    """Compare the cameras predicted for a loop chunk with the matches across the loop.

    A joint prediction of two different places puts them together wrongly, and the matches between them then lie off the
    epipolar lines. What a model's error usually is, the pairs at one end tell: across the loop it may be
    `LARGEST_RATIO` times as large, and always `ALWAYS_GOOD_PX`.

    Args:
        candidate: the prediction of the loop chunk.
        frames: the frame of each of its views.
        loop: what `verified` returned.
        matches: of the six photos of `loop.frames`, all pairs, as `verified` made them. Frames that are not in the
            chunk are left out.
    """
    view = {frame: view for view, frame in enumerate(frames)}
    common = [row for row, frame in enumerate(loop.frames) if frame in view]
    # A frame that the chunk lacks is stood in for by any view; its pairs are left out.
    seen = candidate.select([view.get(frame, 0) for frame in loop.frames])
    scores = epipolar(seen, matches.only(np.flatnonzero(np.isin(matches.pairs, common).all(1))))
    across = _across(scores.pairs)
    error, own = (_median(scores.values[chosen]) for chosen in (across, ~across))
    largest = max(ALWAYS_GOOD_PX, LARGEST_RATIO * own) if np.isfinite(own) else ALWAYS_GOOD_PX
    return Agreement(error_px=error, own_px=own, reason=_disagreement(error, largest))


def _alike(descriptors: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Similarity (n,) of pairs of frames."""
    return np.einsum("nc,nc->n", descriptors[first], descriptors[second])


def _mutual(descriptors: np.ndarray, frames: np.ndarray, apart: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of some frames, the earlier first, each of which is among the other's `MUTUAL` most similar far frames."""
    best = []
    for start in range(0, len(frames), _ROWS):
        rows = frames[start : start + _ROWS]
        similarity = descriptors[rows] @ descriptors[frames].T
        similarity[(np.abs(rows[:, None] - frames) < apart) | (similarity > 1 - SAME_PICTURE)] = -np.inf
        chosen = np.argsort(-similarity, axis=1, kind="stable")[:, :MUTUAL]
        row, rank = np.nonzero(np.take_along_axis(similarity, chosen, axis=1) > -np.inf)
        best.append(np.stack((rows[row], frames[chosen[row, rank]])))
    pairs, times = np.unique(np.sort(np.concatenate(best, axis=1), axis=0), axis=1, return_counts=True)
    first, second = pairs[:, times == 2]
    return first, second


def _verified(
    found: tuple[int, int, float],
    count: int,
    descriptors: np.ndarray,
    match: Callable[[Sequence[int]], Matches],
) -> Loop:
    first, second, similarity = found
    frames = _around(first, second, _step(descriptors, first, second, similarity), count)
    found_matches = match(frames)
    pairs, ends = found_matches.pairs, [frames.index(first), frames.index(second)]
    across, own = _across(pairs) & np.isin(pairs, ends).any(1), ~_across(pairs)
    partners = min(int((across & (pairs == end).any(1)).sum()) for end in ends)
    shares = found_matches.counts / np.diff(found_matches.view_start)[pairs].max(1)
    share = float(shares[across].max() / shares[own].max()) if across.any() and own.any() else float("nan")
    return Loop(
        first=first,
        second=second,
        similarity=similarity,
        matches=int(found_matches.counts[across].sum()),
        frames=frames,
        reason=_refusal(partners, share),
    )


def _refusal(partners: int, share: float) -> str | None:
    if partners < FEWEST_PAIRS:
        return (
            f"One of the two frames has matches with {partners} of 3 photos around the other, and it takes "
            f"{FEWEST_PAIRS}: they look alike, and do not show one place."
        )
    if np.isnan(share):
        return "The photos around each of the two frames do not match among themselves, so there is nothing to go by."
    if share < LEAST_SHARE:
        return (
            f"The two frames have {share:.0%} as many matches as photos next to each other: "
            "a part of them looks the same, and not the place."
        )
    return None


def _disagreement(error: float, largest: float) -> str | None:
    if np.isnan(error):
        return "None of the matched frames of both ends is part of the prediction."
    if error > largest:
        return (
            f"In the joint prediction the matches between the two frames are {error:.1f} pixels from where they should "
            f"be; up to {largest:.1f} would do."
        )
    return None


def _step(descriptors: np.ndarray, first: int, second: int, similarity: float) -> int:
    """Return how far apart neighbours at the ends are about as alike as the ends are, at least 1."""
    ends, largest = np.array([first, second]), max(1, (second - first - 1) // 4)
    for step in range(1, largest):
        there = np.concatenate((ends - step, ends + step))
        inside = (there >= 0) & (there < len(descriptors))
        if np.median(_alike(descriptors, np.tile(ends, 2)[inside], there[inside])) <= similarity:
            return step
    return largest


def _around(first: int, second: int, step: int, count: int) -> tuple[int, ...]:
    """Three frames `step` apart at each end, with it and inside the sequence, ascending."""
    before = first - step if first >= step else first
    after = second - step if second + step < count else second - 2 * step
    return tuple(start + k * step for start in (before, after) for k in range(3))


def _across(pairs: np.ndarray) -> np.ndarray:
    """Which pairs (P, 2) of the six views join the two ends."""
    return (pairs < 3).sum(1) == 1


def _median(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else float("nan")
