"""Filters that decide which pixels of a reconstruction to keep."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from freegeo.errors import UserError
from freegeo.fusion.agreement import prepare, tolerance_of, vote
from freegeo.fusion.quantile import quantile
from freegeo.fusion.settings import FilterSettings
from freegeo.geometry.depth import valid_depth

__all__ = ["FilterReport", "confident_pixels", "filter_pixels", "flying_pixels", "on_one_surface"]

CONTINUATION_TOLERANCE = 0.03
"""Largest relative distance of a pixel from the straight continuation of its neighbours."""
SMALL_STEP = 0.015
"""Relative step to the next pixel up to which both lie on one surface, straight continuation or not."""
STEEPEST_SLOPE = 12.0
"""Tangent of the steepest angle (85 degrees) between a surface and the image plane that is kept."""


SKY = "sky or ambiguous"
"""Filter of what a model marks as having no depth: sky, or of MapAnything, pixels that are ambiguous to it."""


@dataclass(frozen=True, kw_only=True)
class FilterReport:
    """How many pixels each filter removed of those that were left, in the order the filters ran."""

    pixels: int
    removed: Mapping[str, int]
    """Those that ran of `outside the photo`, `invalid depth`, `mask`, `sky or ambiguous`, `confidence`, `flying`,
    `multi-view`."""
    tolerance: float | None
    """Relative depth tolerance of the multi-view filter; None when it did not run."""

    @property
    def kept(self) -> int:
        """Number of pixels that passed."""
        return self.pixels - sum(self.removed.values())

    def summary(self) -> str:
        """One line, such as "kept 60.1 % of 983040 pixels; removed: confidence 40.0 %, flying 1.2 %"."""
        parts = [f"{name} {100 * count / max(1, self.pixels):.1f} %" for name, count in self.removed.items() if count]
        kept = f"kept {100 * self.kept / max(1, self.pixels):.1f} % of {self.pixels} pixels"
        return f"{kept}; removed: {', '.join(parts)}" if parts else kept


def filter_pixels(
    depth_z: np.ndarray,
    conf: np.ndarray,
    T_cam_world: np.ndarray,
    K: np.ndarray,
    *,
    sky: np.ndarray | None = None,
    masks: np.ndarray | None = None,
    inside: np.ndarray | None = None,
    settings: FilterSettings | None = None,
) -> tuple[np.ndarray, FilterReport]:
    """Decide which pixels to keep.

    Args:
        depth_z: (S, H, W).
        conf: (S, H, W), higher is better.
        T_cam_world: (S, 4, 4).
        K: (S, 3, 3) pixels of the maps.
        sky: (S, H, W), or None when the model does not give it.
        masks: (S, H, W) bool, true where the user wants points; None: everywhere.
        inside: (S, H, W) bool, false where the image is padding; None: no padding. Padding counts as not seen by its
            view: it has no depth, and no vote on points that fall into it.
        settings: default `FilterSettings()`.

    Returns:
        `keep` (S, H, W) bool, and what was removed.

    Raises:
        UserError: masks of another shape.
    """
    settings = settings or FilterSettings()
    if masks is not None and masks.shape != depth_z.shape:
        raise UserError(f"Masks of the shape {masks.shape} do not fit depth maps of the shape {depth_z.shape}.")
    # Arrays of floats, which may be mapped from a file larger than memory, are read view by view; masks are held.
    depth, T, intrinsics = (_tensor(a).float() for a in (depth_z, T_cam_world, K))
    keep = torch.ones(depth.shape, dtype=torch.bool)
    within = _tensor(inside) if inside is not None and not inside.all() else None
    removed: dict[str, int] = {}

    def apply(name: str, passed: Callable[[int], Tensor]) -> None:
        removed[name] = 0
        for view, kept in enumerate(keep):
            gone = kept & ~passed(view)
            removed[name] += int(gone.sum())
            kept &= ~gone

    def known(view: int) -> Tensor:
        return depth[view] if within is None else torch.where(within[view], depth[view], torch.nan)

    if within is not None:
        apply("outside the photo", lambda view: within[view])
    apply("invalid depth", lambda view: valid_depth(known(view)))
    if masks is not None:
        wanted = _tensor(masks)
        apply("mask", lambda view: wanted[view].bool())
    if sky is not None and settings.sky_limit <= 1:
        seen = _tensor(sky)
        apply(SKY, lambda view: seen[view] < settings.sky_limit)
    if settings.drop_share > 0:
        confident = confident_pixels(_tensor(conf), keep, drop_share=settings.drop_share)
        apply("confidence", lambda view: confident[view])
    if settings.flying:
        apply("flying", lambda view: ~flying_pixels(known(view)[None], intrinsics[view : view + 1])[0])
    tolerance = None
    if settings.multi_view and len(depth) > 1:
        tolerance = settings.tolerance or tolerance_of(depth, T, intrinsics, keep)
        confirmed = _confirmed(depth, T, intrinsics, keep, within, tolerance, settings)
        apply("multi-view", lambda view: confirmed[view])
    return keep.numpy(), FilterReport(pixels=depth.numel(), removed=removed, tolerance=tolerance)


def _tensor(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array))


def _confirmed(
    depth_z: Tensor,
    T_cam_world: Tensor,
    K: Tensor,
    usable: Tensor,
    inside: Tensor | None,
    tolerance: float,
    settings: FilterSettings,
) -> Tensor:
    """Mask of the usable pixels that the other views do not outvote.

    A contradiction counts against both pixels involved, so clear cases (two votes more against than for) are removed
    first, and the votes on the rest are counted without them.
    """
    likely = torch.empty_like(usable)
    for view, votes in vote(prepare(depth_z, T_cam_world, K, usable, tolerance=tolerance, inside=inside)):
        likely[view] = usable[view] & (votes.contradict - votes.agree < 2)
    confirmed = torch.empty_like(usable)
    for view, votes in vote(prepare(depth_z, T_cam_world, K, likely, tolerance=tolerance, inside=inside)):
        silent = (votes.agree < settings.min_agreeing) & (votes.asked >= settings.min_asked)
        confirmed[view] = likely[view] & (votes.contradict <= votes.agree) & ~silent
    return confirmed


def confident_pixels(conf: Tensor, usable: Tensor, *, drop_share: float) -> Tensor:
    """Mask (S, H, W) of the `usable` pixels without the least confident `drop_share` of them (over all views together).

    Pixels as confident as the threshold stay, so a constant confidence drops nothing.
    """
    if drop_share <= 0:
        return usable.clone()

    def values() -> Iterator[np.ndarray]:
        for view, one in enumerate(usable):
            yield conf[view][one].detach().cpu().numpy()

    threshold = float(quantile(values, drop_share, method="lower"))
    confident = torch.empty_like(usable)
    for view, one in enumerate(usable):
        confident[view] = one & (conf[view] >= threshold)
    return confident


def flying_pixels(depth_z: Tensor, K: Tensor) -> Tensor:
    """Mask (S, H, W) of pixels whose depth lies between surfaces, as at depth edges.

    Along a row and along a column, inverse depth of a plane is linear. A pixel of a surface is close to its
    neighbour, or continues the line through the next two pixels, on at least one side, also at the surface's rim; a
    pixel between two surfaces, or an isolated one, does neither. A blurred edge is smooth, but steeper than a surface
    that a camera sees: a pixel steeper than `STEEPEST_SLOPE` on both sides is dropped too.

    Args:
        depth_z: (S, H, W); invalid depth is never continued, and is not itself flagged.
        K: (S, 3, 3) pixels of these maps.
    """
    usable = valid_depth(depth_z)
    inverse = torch.where(usable, depth_z, torch.nan).reciprocal()
    along_row = _continues(inverse, K[:, 0, 0]) if depth_z.shape[-1] > 2 else usable
    along_column = _continues(inverse.mT, K[:, 1, 1]).mT if depth_z.shape[-2] > 2 else usable
    return usable & ~(along_row & along_column)


def _continues(inverse: Tensor, focal: Tensor) -> Tensor:
    """Mask (S, H, W) of pixels that lie on the line of one of their two sides in the last dimension."""
    before, after = on_one_surface(inverse, focal), on_one_surface(inverse.flip(-1), focal).flip(-1)
    return before | after


def on_one_surface(inverse: Tensor, focal: Tensor) -> Tensor:
    """Mask (S, H, W) of the pixels that lie on one surface with the pixel before them in the last dimension.

    Args:
        inverse: (S, H, W) inverse depth, NaN where there is none.
        focal: (S,) in pixels, along that dimension.
    """
    near = torch.nn.functional.pad(inverse, (1, 0), value=torch.nan)[..., :-1]
    far = torch.nn.functional.pad(inverse, (2, 0), value=torch.nan)[..., :-2]
    steepest = STEEPEST_SLOPE / focal.to(inverse)[:, None, None]
    step = (inverse - near).abs()
    # Pixels outside the map are NaN, and comparisons with NaN are false.
    on_line = (inverse - (2 * near - far)).abs() <= CONTINUATION_TOLERANCE * inverse
    return (on_line | (step <= SMALL_STEP * inverse)) & (step <= steepest * inverse)
