"""What a model is told of its views beforehand: only what it was trained to use, and a sentence about the rest."""

from __future__ import annotations

from freegeo.errors import UserError
from freegeo.models.spec import ModelSpec
from freegeo.types import Priors

__all__ = ["require_usable", "unusable", "usable"]


def unusable(priors: Priors, spec: ModelSpec) -> str | None:
    """Say in one sentence why a model cannot take priors; None where it can.

    A model that takes whole cameras has no use for depth alone, or for intrinsics alone.
    """
    if spec.takes == "nothing":
        return f"{spec.name} takes no cameras: it sees the photos alone."
    if spec.takes == "parts" or priors.whole_cameras:
        return None
    known = [part for part, value in (("poses", priors.T_cam_world), ("intrinsics", priors.K)) if value is not None]
    part = f"{known[0]} alone are" if len(known) == 1 else "only a part of them is"
    return f"{spec.name} takes poses and intrinsics of all photos, or none; {part} known, so it sees the photos alone."


def usable(priors: Priors | None, spec: ModelSpec) -> Priors | None:
    """Return what a model can take of priors: all of them, or None."""
    return None if priors is None or unusable(priors, spec) else priors


def require_usable(priors: Priors, spec: ModelSpec) -> None:
    """Raise UserError for priors that a model cannot take."""
    reason = unusable(priors, spec)
    if reason is not None:
        raise UserError(f"{reason} Leave the priors out.")
