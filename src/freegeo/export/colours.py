"""Maps as pictures: the colours of depth, in the files and in the report alike."""

from __future__ import annotations

import numpy as np

from freegeo.fusion.quantile import Parts, quantile

DEPTH_MAP = "viridis_r"
"""Colour map of depth, by its name in matplotlib."""
INVALID_GREY = 128
"""Colour of pixels without a value."""


def log_range(parts: Parts) -> tuple[float, float]:
    """Common range of positive maps, from the 2nd to the 98th percentile; (1, 2) without valid values."""

    def valid():
        return (part[np.isfinite(part) & (part > 0)] for part in parts())

    low, high = (float(quantile(valid, share)) for share in (0.02, 0.98))
    if np.isnan(low):
        return 1.0, 2.0
    return (low, high) if high > low * 1.0001 else (low / 1.05, high * 1.05)


def log_colours(values: np.ndarray, limits: tuple[float, float], name: str) -> np.ndarray:
    """Colours (..., 3) uint8 of positive values on a logarithmic scale; what is not positive or finite is grey."""
    usable = np.isfinite(values) & (values > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.log(values / limits[0]) / np.log(limits[1] / limits[0])
    return coloured(share, usable, name)


def coloured(share: np.ndarray, usable: np.ndarray, name: str) -> np.ndarray:
    """Colours (..., 3) uint8 of values from 0 to 1 in a colour map of matplotlib; those not usable are grey."""
    index = np.clip(np.where(usable, share, 0) * 255, 0, 255).astype(np.uint8)
    return np.where(usable[..., None], colour_table(name)[index], np.uint8(INVALID_GREY))


def colour_table(name: str) -> np.ndarray:
    """The 256 colours (256, 3) uint8 of a colour map of matplotlib."""
    from matplotlib import colormaps

    return (colormaps[name](np.linspace(0, 1, 256))[:, :3] * 255).round().astype(np.uint8)
