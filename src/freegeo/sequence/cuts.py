"""Places where a sequence of photos jumps, as where two clips were put together (docs/sequences.md, "Cuts").

A chunk across such a place would be predicted as one scene, and the model's guess of how its halves lie to each other
would fit the chunks on both sides: no seam would show it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from typing import TYPE_CHECKING

import numpy as np

from freegeo.evidence.matches import Outcome, find_matches
from freegeo.sequence.order import SAME_PICTURE

if TYPE_CHECKING:
    from freegeo.types import PhotoLike

__all__ = ["Jumps", "find_cuts"]

JUMP = 2.5
"""Neighbours whose difference is larger than so many medians are looked at."""
MOST = 24
"""Most places that are looked at, those with the largest differences."""
NEAR = 3
"""Photos on each side that are matched with each other."""
_SEEN_TOGETHER = (Outcome.VERIFIED, Outcome.NO_MOTION)


@dataclass(frozen=True, kw_only=True)
class Jumps:
    """Places where a sequence jumps."""

    cuts: list[int]
    """Frames before which it is cut, ascending."""
    doubtful: list[int]
    """Frames that may not belong to the sequence, ascending: they differ from a neighbour more than is usual, no match
    leads to it, not even over the photos around them, and it is no cut."""


def find_cuts(descriptors: np.ndarray, photos: Sequence[PhotoLike]) -> Jumps:
    """Find where the sequence must be cut.

    Where neighbours differ more than is usual, the photos on both sides are matched. It is a cut where none of one side
    matches one of the other, and neighbours on each side do match: without that, nothing can be said. A frame that
    repeats the one before has no part in what is usual.

    Args:
        descriptors: (N, C) of unit length, what each frame shows.
        photos: of the frames.
    """
    difference = 1 - (descriptors[:-1] * descriptors[1:]).sum(axis=1)
    moved = difference[difference > SAME_PICTURE]
    if len(photos) < 4 or not len(moved):
        return Jumps(cuts=[], doubtful=[])
    unusual = np.flatnonzero(difference > JUMP * np.median(moved))
    looked_at = unusual[np.argsort(-difference[unusual], kind="stable")][:MOST] + 1
    cuts, doubtful = set(), set()
    for frame in looked_at.tolist():
        is_cut, odd = _looked_at(frame, photos)
        if is_cut:
            cuts.add(frame)
        elif odd is not None:
            doubtful.add(odd)
    return Jumps(cuts=sorted(cuts), doubtful=sorted(doubtful))


def _looked_at(frame: int, photos: Sequence[PhotoLike]) -> tuple[bool, int | None]:
    """Whether there is a cut before a frame, and which one of it and the frame before no match leads to, if any."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    start, end = max(0, frame - NEAR), min(len(photos), frame + NEAR)
    before, after = range(frame - start), range(frame - start, end - start)
    inner = [pair for side in (before, after) for pair in pairwise(side)]
    across = list(product(before, after))
    found = find_matches(photos[start:end], np.array(inner + across, np.int64))
    together = np.isin(found.outcome, _SEEN_TOGETHER)
    if not together[len(inner) :].any() and together[: len(inner)].all():
        return True, None
    first, second = np.array(inner + across)[together].reshape(-1, 2).T
    links = coo_array((np.ones(len(first)), (first, second)), shape=(end - start, end - start))
    part = connected_components(links, directed=False)[1]
    one, two = part[frame - start - 1], part[frame - start]
    if one == two:
        return False, None
    return False, frame - 1 if (part == one).sum() < (part == two).sum() else frame
