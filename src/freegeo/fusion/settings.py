"""Settings of which pixels become points, and how many: defaults that the command line shows too.

This module loads no torch.
"""

from __future__ import annotations

from dataclasses import dataclass

from freegeo.errors import UserError

DROP_SHARE = 0.4
"""Least confident share of the pixels that exports leave out, as the published ones do."""
MAX_POINTS = 1_000_000
"""Most points of a cloud; of more, a random choice is kept."""


@dataclass(frozen=True, kw_only=True)
class FilterSettings:
    """Which filters run, and how strictly."""

    drop_share: float = DROP_SHARE
    """Least confident share of the pixels to remove, 0 to below 1; 0 switches the filter off."""
    flying: bool = True
    """Remove pixels between surfaces."""
    multi_view: bool = True
    """Remove pixels that more views contradict than confirm."""
    min_agreeing: int = 0
    """Other views that must agree with a pixel. 0 keeps what one view alone sees; more makes sparse, sure clouds."""
    min_asked: int = 1
    """`min_agreeing` is asked only of pixels whose point falls into this many other images; 0: of all pixels."""
    tolerance: float | None = None
    """Relative depth difference of one surface in two views; None reads it off the data."""
    sky_limit: float = 0.3
    """Remove pixels with at least this much sky, where the model gives it; above 1 switches the filter off. The models
    that give it fill the depth of these pixels with that of the farthest others."""

    def __post_init__(self) -> None:
        """Raise UserError for values outside their ranges."""
        if not 0 <= self.drop_share < 1:
            raise UserError(f"The share of points to drop must be from 0 to below 1, got {self.drop_share}.")
        if self.tolerance is not None and not self.tolerance > 0:
            raise UserError(f"The depth tolerance between views must be positive, got {self.tolerance}.")
        if self.min_agreeing < 0 or self.min_asked < 0:
            raise UserError(f"Views must be counted from 0, got {self.min_agreeing} and {self.min_asked}.")
