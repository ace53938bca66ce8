"""Depth at the resolution of the photo, from a map at the model's: interpolation that the photo's edges guide.

It adds no detail that the model did not see. Where the four map pixels around a place belong to one surface, their
inverse depth is interpolated linearly, which is exact for planes. Elsewhere, at the edges of objects and beside pixels
without depth, 16 map pixels vote, each with a weight that falls with its distance and with the difference between its
colour and the photo's (joint bilateral). Only the surface with more weight behind it counts, so that nothing hangs
between two of them. Every value lies in the range of the map pixels that it was made of.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from freegeo.export.pixels import map_places

ONE_SURFACE = 1.05
"""Largest ratio of the depths of neighbouring pixels that are one surface whatever is around them."""
SLOPE = 0.5
"""Largest change of the step in inverse depth, as a share of it, from one pair of pixels on a slope to the next."""
COLOUR_SPREAD = 20.0
"""Standard deviation of the weight that falls with the difference in colour, in levels of 255 in each channel."""
SPREAD = 0.7
"""Standard deviation of the weight that falls with distance, in pixels of the map."""
BAND = 1 << 18
"""Pixels of the photo that are computed at a time."""
_REACH = range(-1, 3)
"""Map pixels that vote, in rows and columns, from the one before a place."""
_PADDING = 2


def upsampled_depth(
    depth: np.ndarray,
    known: np.ndarray,
    image: np.ndarray,
    photo: np.ndarray,
    scale_xy: np.ndarray,
    offset_xy: np.ndarray,
) -> np.ndarray:
    """Return the depth (h, w) float32 of a photo's pixels; 0 where the map has none.

    A pixel of the photo has depth if the map pixel that it falls into is known; where the model did not see the photo,
    nothing is extrapolated. What is not known has no vote anywhere.

    Args:
        depth: (H, W) map of the model.
        known: (H, W) bool, the pixels of it that are used; their depth is finite and positive.
        image: (H, W, 3) uint8, what the model saw.
        photo: (h, w, 3) uint8.
        scale_xy: (2,) from the photo to the model's image, as in `Reconstruction`.
        offset_xy: (2,).
    """
    # Edges repeat outwards, so that every place has all its neighbours; copies of unknown pixels stay unknown.
    inverse = np.pad(
        np.divide(1.0, depth, out=np.zeros(depth.shape), where=known).astype(np.float32), _PADDING, mode="edge"
    )
    colours = np.pad(image.astype(np.float32), (*[(_PADDING, _PADDING)] * 2, (0, 0)), mode="edge")
    rows, columns = (
        _Places.along(photo.shape[axis], known.shape[axis], scale_xy[1 - axis], offset_xy[1 - axis]) for axis in (0, 1)
    )
    # One cell for every four pixels: whether they are one surface.
    beside, below = _joined(inverse), _joined(inverse.T).T
    smooth = beside[:-1] & beside[1:] & below[:, :-1] & below[:, 1:]
    found = np.zeros(photo.shape[:2], np.float32)
    step = max(1, BAND // photo.shape[1])
    for start in range(0, photo.shape[0], step):
        band = slice(start, start + step)
        found[band] = _band(inverse, colours, smooth, photo[band], rows.part(band), columns)
    return found


@dataclass(frozen=True)
class _Places:
    """Where the pixels of one axis of a photo are in a map that is padded by `_PADDING` pixels."""

    before: np.ndarray
    """(n,) the map's pixel before the centre of each."""
    share: np.ndarray
    """(n,) float32 of the way from there to the next."""
    own: np.ndarray
    """(n,) the map's pixel that each falls into."""
    seen: np.ndarray
    """(n,) bool, whether it falls into one."""

    @classmethod
    def along(cls, count: int, side: int, scale: float, offset: float) -> _Places:
        """Return the places of `count` pixels in a map of `side` pixels."""
        at, own, seen = map_places(count, side, scale, offset)
        at = np.clip(at, -1, side) + _PADDING
        before = np.floor(at).astype(np.int64)
        return cls(before, (at - before).astype(np.float32), own + _PADDING, seen)

    def part(self, which: slice) -> _Places:
        """Return those of some pixels."""
        return _Places(self.before[which], self.share[which], self.own[which], self.seen[which])


def _joined(inverse: np.ndarray) -> np.ndarray:
    """Whether each pixel (H, W - 1) and the next one in its row are one surface: close in depth, or on one slope."""
    step = np.diff(inverse)
    first, second = inverse[:, :-1], inverse[:, 1:]
    close = np.maximum(first, second) <= ONE_SURFACE * np.minimum(first, second)
    # Inverse depth is linear on a plane, so that the steps before and after are like this one.
    bend = np.pad(np.abs(np.diff(step)), ((0, 0), (1, 1)), constant_values=np.inf)
    straight = np.maximum(bend[:, :-1], bend[:, 1:]) <= SLOPE * np.abs(step)
    return (close | straight) & (first > 0) & (second > 0)


def _band(
    inverse: np.ndarray, colours: np.ndarray, smooth: np.ndarray, photo: np.ndarray, rows: _Places, columns: _Places
) -> np.ndarray:
    """Depth of some rows of a photo."""
    known = (inverse[rows.own[:, None], columns.own] > 0) & rows.seen[:, None] & columns.seen
    # Linear in the columns for the few rows of the map, then in the rows for every row of the photo.
    first, last = rows.before[0], rows.before[-1] + 2
    across = inverse[first:last]
    across = across[:, columns.before] * (1 - columns.share) + across[:, columns.before + 1] * columns.share
    low, share = rows.before - first, rows.share[:, None]
    blended = across[low] * (1 - share) + across[low + 1] * share
    row, column = np.nonzero(known & ~smooth[rows.before[:, None], columns.before])
    blended[row, column] = _voted(inverse, colours, photo[row, column], rows, columns, row, column)
    return np.divide(1.0, blended, out=np.zeros_like(blended), where=known)


def _voted(
    inverse: np.ndarray, colours: np.ndarray, pixels: np.ndarray, rows: _Places, columns: _Places,
    row: np.ndarray, column: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Inverse depth (n,) of single pixels of the photo with their colours (n, 3), from 16 pixels of the map each."""
    i, j = rows.before[row], columns.before[column]
    down, right = rows.share[row], columns.share[column]
    pixels = pixels.astype(np.float32)
    values = np.empty((len(_REACH) ** 2, len(row)), np.float32)
    weights = np.empty_like(values)
    for k, (y, x) in enumerate((y, x) for y in _REACH for x in _REACH):
        values[k] = inverse[i + y, j + x]
        far = ((y - down) ** 2 + (x - right) ** 2) / (2 * SPREAD**2)
        unlike = ((colours[i + y, j + x] - pixels) ** 2).sum(-1) / (2 * 3 * COLOUR_SPREAD**2)
        # A floor, so that a colour which no neighbour has leaves the vote to the distance.
        weights[k] = np.exp(-far) * (np.exp(-unlike) + 1e-6) * (values[k] > 0)
    # Two surfaces at most are told apart: the middle between the nearest and the farthest depth separates them.
    largest = values.max(0)
    smallest = np.where(values > 0, values, np.inf).min(0)
    near = values > np.sqrt(largest * smallest)
    near |= largest <= ONE_SURFACE * smallest
    nearer = (weights * near).sum(0)
    chosen = weights * np.where(nearer >= (weights * ~near).sum(0), near, ~near)
    total = chosen.sum(0)
    return (chosen * values).sum(0) / total
