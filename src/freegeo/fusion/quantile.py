"""Order statistics of more values than memory should hold, equal to NumPy's."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Literal

import numpy as np

__all__ = ["Parts", "median", "quantile"]

HELD = 1 << 23
"""Most values that are put into one array; of more, the parts are read again for every 16 bits of a value."""
_DIGITS = 1 << 16

Parts = Callable[[], Iterable[np.ndarray]]
"""Gives the values in parts, each an array of any shape; called several times, it gives the same each time."""


def quantile(parts: Parts, q: float, *, method: Literal["linear", "lower"] = "linear") -> np.floating:
    """Return `np.quantile` of all values together; NaN when there are none, or one of them is NaN.

    Args:
        parts: the values, floats of one type.
        q: from 0 to 1.
        method: as of `np.quantile`.
    """
    values = _joined(parts)
    if values is not None:
        return np.quantile(values, q, method=method) if values.size else np.float64(np.nan)

    def place(count: int) -> float:
        return float((count - 1) * np.float64(q))

    if method == "lower":
        return _at(parts, lambda count: [int(place(count))])[0][0]
    (low, high), count = _at(parts, lambda count: [int(place(count)), min(int(place(count)) + 1, count - 1)])
    share, step = place(count) % 1, high - low
    # NumPy's rule, which is exact at both ends.
    return low + step * share if share < 0.5 else high - step * (1 - share)


def median(parts: Parts) -> np.floating:
    """Return `np.median` of all values together; arguments and NaN as `quantile`."""
    values = _joined(parts)
    if values is not None:
        return np.median(values) if values.size else np.float64(np.nan)
    middle, _ = _at(parts, lambda count: [(count - 1) // 2, count // 2])
    return np.mean(middle)


def _joined(parts: Parts) -> np.ndarray | None:
    """All values as one array (n,); None when there are too many."""
    found, count = [np.zeros(0, np.float32)], 0
    for part in parts():
        found.append(part.ravel())
        count += part.size
        if count > HELD:
            return None
    return np.concatenate(found[1:] or found)


def _at(parts: Parts, places: Callable[[int], Sequence[int]]) -> tuple[np.ndarray, int]:
    """Values at the `places` (0: the smallest) of their count, and the count; all NaN if one of the values is.

    Floats are in the order of their bits, once those of negative ones are turned around. Each pass counts the values by
    their next 16 bits among those that begin like the wanted ones.
    """
    dtype = next(iter(parts())).dtype
    begins, rests, count = [0], None, 0
    for shift in range(8 * dtype.itemsize - 16, -1, -16):
        counts = {begin: np.zeros(_DIGITS, np.int64) for begin in begins}
        for part in parts():
            if rests is None and np.isnan(part).any():
                return np.array([np.nan, np.nan], dtype), 1
            digits = _ordered(part.ravel()) >> shift
            for begin, found in counts.items():
                same = digits if rests is None else digits[digits >> 16 == begin]
                found += np.bincount((same % _DIGITS).astype(np.int64), minlength=_DIGITS)
        if rests is None:
            count = int(counts[0].sum())
            rests = list(places(count))
            begins = [0] * len(rests)
        for number, (begin, rest) in enumerate(zip(begins, rests, strict=True)):
            up_to = counts[begin].cumsum()
            digit = int(np.searchsorted(up_to, rest, side="right"))
            rests[number] = rest - (int(up_to[digit - 1]) if digit else 0)
            begins[number] = begin * _DIGITS + digit
    return _floats(np.array(begins, f"u{dtype.itemsize}"), dtype), count


def _ordered(values: np.ndarray) -> np.ndarray:
    """Unsigned integers in the order of the floats."""
    bits = values.view(f"u{values.dtype.itemsize}")
    sign = bits.dtype.type(1 << (8 * values.dtype.itemsize - 1))
    return np.where(bits & sign, ~bits, bits | sign)


def _floats(ordered: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Inverse of `_ordered`."""
    sign = ordered.dtype.type(1 << (8 * dtype.itemsize - 1))
    return np.where(ordered & sign, ordered ^ sign, ~ordered).view(dtype)
