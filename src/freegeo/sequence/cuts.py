"""Places where a sequence of photos jumps, as where two clips were put together (docs/sequences.md, "Cuts").

A chunk across such a place would be predicted as one scene, and the model's guess of how its halves lie to each other
would fit the chunks on both sides: no seam would show it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise, product
from typing import TYPE_CHECKING

import numpy as np

from freegeo.evidence.matches import Outcome, find_matches

if TYPE_CHECKING:
    from freegeo.types import PhotoLike

__all__ = ["find_cuts"]

JUMP = 2.5
"""Neighbours whose difference is larger than so many medians are looked at."""
MOST = 24
"""Most places that are looked at, those with the largest differences."""
NEAR = 3
"""Photos on each side that are matched with each other."""
_SEEN_TOGETHER = (Outcome.VERIFIED, Outcome.NO_MOTION)


def find_cuts(descriptors: np.ndarray, photos: Sequence[PhotoLike]) -> list[int]:
    """Return the frames before which the sequence is cut, ascending.

    Where neighbours differ more than is usual, the photos on both sides are matched. It is a cut where none of one side
    matches one of the other, and neighbours on each side do match: without that, nothing can be said.

    Args:
        descriptors: (N, C) of unit length, what each frame shows.
        photos: of the frames.
    """
    if len(photos) < 4:
        return []
    difference = 1 - (descriptors[:-1] * descriptors[1:]).sum(axis=1)
    unusual = np.flatnonzero(difference > JUMP * np.median(difference))
    looked_at = unusual[np.argsort(-difference[unusual], kind="stable")][:MOST] + 1
    return sorted(int(frame) for frame in looked_at if _is_cut(int(frame), photos))


def _is_cut(frame: int, photos: Sequence[PhotoLike]) -> bool:
    start, end = max(0, frame - NEAR), min(len(photos), frame + NEAR)
    before, after = range(frame - start), range(frame - start, end - start)
    inner = [pair for side in (before, after) for pair in pairwise(side)]
    across = list(product(before, after))
    found = find_matches(photos[start:end], np.array(inner + across, np.int64))
    together = np.isin(found.outcome, _SEEN_TOGETHER)
    if together[len(inner) :].any():
        return False
    return bool(together[: len(inner)].all())
