"""What a model is told of its views beforehand: only what it was trained to use, and a sentence about the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from freegeo.errors import UserError
from freegeo.models.spec import NO_REFERENCE, ModelSpec
from freegeo.types import Priors

__all__ = ["require_usable", "usable", "usable_by_both"]


def usable(priors: Priors, spec: ModelSpec) -> tuple[Priors | None, str | None]:
    """Return what a model can take of what is known of a view set, and one sentence on what it cannot.

    A model that takes whole cameras has no use for depth alone, or for intrinsics alone. One that takes parts has none
    for a single pose, and where the first view is its reference, none for poses without that of the first view.

    Returns:
        The priors, None where there is nothing left of them; the sentence, None where nothing is left out.
    """
    if spec.takes == "nothing":
        return None, f"{spec.name} takes no cameras: it sees the photos alone."
    if spec.takes == "parts":
        return _parts(priors, spec)
    if priors.whole_cameras:
        return priors, None
    known = [part for part, value in (("poses", priors.T_cam_world), ("intrinsics", priors.K)) if value is not None]
    part = f"{known[0]} alone are" if len(known) == 1 else "only a part of them is"
    return None, (
        f"{spec.name} takes poses and intrinsics of all photos, or none; {part} known, so it sees the photos alone."
    )


def usable_by_both(priors: Priors, kept: Sequence[int], spec: ModelSpec) -> Priors | None:
    """Return what a model can take of a view set and of its `kept` views alone, so that both are told the same.

    Else a student would be taught what poses say that it is not told.
    """
    found = usable(priors, spec)[0]
    if found is None or found.T_cam_world is None:
        return found
    of_kept = usable(found.select(kept), spec)[0]
    if of_kept is not None and of_kept.T_cam_world is not None:
        return found
    return _without_poses(found)


def _parts(priors: Priors, spec: ModelSpec) -> tuple[Priors | None, str | None]:
    """Leave poses out that say nothing about where views are to each other or to the reference."""
    if priors.T_cam_world is None:
        return priors, None
    count = priors.T_cam_world.shape[1] if priors.has_pose is None else int(priors.has_pose.sum())
    first = priors.has_pose is None or bool(priors.has_pose[0])
    if count > 1 and (first or spec.reference == NO_REFERENCE):
        return priors, None
    reason = (
        "poses relative to the first photo, whose own is not known"
        if count > 1
        else "poses of two or more photos, and only one is known"
    )
    left = _without_poses(priors)
    sentence = f"{spec.name} takes {reason}: poses are left out"
    return left, f"{sentence}." if left is not None else f"{sentence}, so it sees the photos alone."


def _without_poses(priors: Priors) -> Priors | None:
    """Return the rest of priors; None where there is none."""
    left = replace(priors, T_cam_world=None, has_pose=None)
    return None if left.K is None and left.depth_z is None else left


def require_usable(priors: Priors, spec: ModelSpec) -> None:
    """Raise UserError for priors that a model cannot take; what says nothing to one that takes parts is no error."""
    found, reason = usable(priors, spec)
    if found is None and spec.takes != "parts":
        raise UserError(f"{reason} Leave the priors out.")
