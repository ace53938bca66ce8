"""A prediction refined by the photos, for `run`, `reconstruct` and `refine` alike (docs/refinement.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from freegeo.evidence.candidate import Candidate
from freegeo.evidence.guard import Reference
from freegeo.evidence.refinement import Refinement, bring_depth, refine
from freegeo.export.reconstruction import Reconstruction
from freegeo.fusion.tracks import Tracks
from freegeo.guarded import scene_matches
from freegeo.types import PhotoLike


@dataclass(frozen=True, kw_only=True, eq=False)
class Refined:
    """What came of a refinement."""

    result: Reconstruction
    """With refined cameras and depth; the prediction as it was where these are refused."""
    tracks: Tracks | None
    """Points that were measured in the photos, in the result's frame; None where the refinement is refused."""
    about: dict[str, Any]
    """JSON-like: `accepted`, `reason` (a sentence), `lacking` (what a refused one lacks: `matches` to begin with, a
    `fit` of matches and prediction, or `proof` by held-out pairs), `probability`, `pairs`, and scores `frozen`,
    `before`, `after` as `Measurement.as_dict`. The epipolar error of `after` is that of pairs that had no part in the
    adjustment."""


def refine_by_photos(
    prediction: Reconstruction,
    photos: Sequence[PhotoLike],
    *,
    frozen: Reconstruction | None = None,
    store: Path | None = None,
    device: str = "cpu",
) -> Refined:
    """Refine a prediction by matches between its photos, or say why not; bad input is no error.

    Args:
        prediction: of the frozen or of an adapted model.
        photos: the same, in the same order.
        frozen: prediction of the frozen model where `prediction` is that of an adapted one: pairs are chosen by it, and
            scores compared on the surfaces that it sees.
        store: file for the matches; None: they are not stored.
        device: where depth maps are compared.
    """
    if not prediction.has_cameras:
        return _refused(prediction, "The model predicts no cameras, so there are none to refine.")
    base = frozen or prediction
    matches = scene_matches(photos, base, store, device=device)
    found = refine(prediction, matches)
    if not len(matches.pairs):
        return _refused(prediction, found.reason)
    reference = Reference.of(Candidate.of(base, device), matches)
    scores = {
        "before": reference.measure(Candidate.of(prediction, device)).as_dict(),
        "after": None if found.after_px is None else {"epipolar_px": float(np.median(found.after_px))},
    }
    if frozen is not None:
        scores["frozen"] = reference.measure(reference.candidate).as_dict()
    result = prediction
    if found.accepted:
        result, _ = bring_depth(prediction, found)
        scores["after"] = reference.measure(Candidate.of(result, device)).as_dict() | (scores["after"] or {})
    return Refined(result=result, tracks=found.tracks if found.accepted else None, about=_about(found, scores))


def _refused(prediction: Reconstruction, reason: str) -> Refined:
    return Refined(result=prediction, tracks=None, about=_about(Refinement(accepted=False, reason=reason), {}))


def _about(found: Refinement, scores: dict[str, Any]) -> dict[str, Any]:
    return {
        "accepted": found.accepted,
        "reason": found.reason,
        "lacking": None if found.accepted else _lacking(found),
        "probability": found.probability,
        "pairs": 0 if found.pairs is None else len(found.pairs),
        "frozen": None, "before": None, "after": None, **scores,
    }  # fmt: skip


def _lacking(found: Refinement) -> str:
    if found.after_px is not None:
        return "proof"
    return "matches" if found.T_cam_world is None else "fit"
