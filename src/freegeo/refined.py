"""A prediction refined by the photos, for the commands and for Python alike (docs/refinement.md)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from freegeo.data.photos import MAX_VIEWS, load_photos
from freegeo.errors import UserError
from freegeo.evidence import refinement
from freegeo.evidence.bundle import pycolmap_module
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.guard import Reference
from freegeo.evidence.refinement import Refinement, bring_depth, depth_misfit
from freegeo.export.reconstruction import METRIC_MODEL, Reconstruction
from freegeo.fusion.tracks import Tracks
from freegeo.guarded import scene_matches
from freegeo.models.precision import choose_device
from freegeo.types import PhotoLike, Priors

if TYPE_CHECKING:
    from freegeo.data.photos import PhotoSource

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, eq=False)
class Refined:
    """What came of a refinement."""

    result: Reconstruction
    """With refined cameras and depth; the prediction as it was where these are refused."""
    tracks: Tracks | None
    """Points that were measured in the photos, in the result's frame; None where the refinement is refused."""
    about: dict[str, Any]
    """JSON-like: `accepted`, `reason` (a sentence), `lacking` (what a refused one lacks: `matches` to begin with, a
    `fit` of matches and prediction, or `proof` by held-out pairs), `probability`, `pairs`, `told` (whether depth is
    that of a second prediction, told the refined cameras), `misfit` of both predictions' depth (`depth_misfit`), and
    scores `frozen`, `before`, `after` as `Measurement.as_dict`. The epipolar error of `after` is that of pairs that had
    no part in the adjustment."""


def refine(
    reconstruction: Reconstruction,
    photos: PhotoSource,
    *,
    frozen: Reconstruction | None = None,
    device: str | None = None,
    max_views: int = MAX_VIEWS,
) -> Refined:
    """Bring a reconstruction's cameras to the matches between its photos by bundle adjustment, and its depth to them.

    `about["accepted"]` of what comes back says whether matches that had no part in it fit better then, and
    `about["reason"]` why or why not; a refused refinement leaves the reconstruction as it was. Needs extra `colmap`.

    Args:
        reconstruction: of the frozen or of an adapted model.
        photos: those that it was made from; what `freegeo.load_photos` takes or returned.
        frozen: reconstruction by the frozen model where the other one is that of an adapted model.
        device: where depth maps are compared; None: the best available.
        max_views: as it was given to `freegeo.reconstruct`.

    Raises:
        UserError: photos of another reconstruction, or no pycolmap.
    """
    pycolmap_module()
    found = load_photos(photos, max_views)
    if [photo.name for photo in found] != list(reconstruction.names):
        raise UserError(
            f"the {len(found)} photos are not those of the reconstruction, which has {len(reconstruction)} views "
            f"(first: {reconstruction.names[0]}). Give the same photos in the same order."
        )
    return refine_by_photos(reconstruction, found, frozen=frozen, device=str(choose_device(device)))


def refine_by_photos(
    prediction: Reconstruction,
    photos: Sequence[PhotoLike],
    *,
    frozen: Reconstruction | None = None,
    store: Path | None = None,
    device: str = "cpu",
    again: Callable[[Priors], Reconstruction | None] | None = None,
) -> Refined:
    """Refine a prediction by matches between its photos, or say why not; bad input is no error.

    Args:
        prediction: of the frozen or of an adapted model.
        photos: the same, in the same order.
        frozen: prediction of the frozen model where `prediction` is that of an adapted one: pairs are chosen by it, and
            scores compared on the surfaces that it sees.
        store: file for the matches; None: they are not stored.
        device: where depth maps are compared.
        again: predicts the same photos once more, told the refined cameras; None when it has no usable answer. Its
            depth is taken where the measured points fit it better. None: the prediction's depth is used.
    """
    if not prediction.has_cameras:
        return _refused(prediction, "The model predicts no cameras, so there are none to refine.")
    base = frozen or prediction
    matches = scene_matches(photos, base, store, device=device)
    found = refinement.refine(prediction, matches)
    if not len(matches.pairs):
        return _refused(prediction, found.reason)
    reference = Reference.of(Candidate.of(base, device), matches)
    scores = {
        "before": reference.measure(Candidate.of(prediction, device)).as_dict(),
        "after": None if found.after_px is None else {"epipolar_px": float(np.median(found.after_px))},
    }
    if frozen is not None:
        scores["frozen"] = reference.measure(reference.candidate).as_dict()
    result, depth = prediction, {"told": False, "misfit": None}
    if found.accepted:
        source, depth = _better_depth(prediction, found, again)
        result, _ = bring_depth(source, found)
        scores["after"] = reference.measure(Candidate.of(result, device)).as_dict() | (scores["after"] or {})
        if prediction.scale is not None and prediction.scale.source != METRIC_MODEL:
            logger.warning(
                "Lengths were brought to metres from %s before the refinement, which moves surfaces and cameras, so "
                "that they fit these metres no more exactly. Bring the refined result to metres instead: give --scale "
                "together with --refine ba to `freegeo run` or `freegeo reconstruct`.",
                prediction.scale.source,
            )  # fmt: skip
    return Refined(
        result=result, tracks=found.tracks if found.accepted else None, about=_about(found, {**scores, **depth})
    )


def _better_depth(
    prediction: Reconstruction, found: Refinement, again: Callable[[Priors], Reconstruction | None] | None
) -> tuple[Reconstruction, dict[str, Any]]:
    """Return the prediction whose depth the measured points fit better, and facts about that."""
    misfit = [depth_misfit(prediction, found)]
    if again is not None:
        assert found.T_cam_world is not None and found.K is not None
        T_cam_world, K = (torch.from_numpy(value).double()[None] for value in (found.T_cam_world, found.K))
        second = again(Priors(T_cam_world=T_cam_world, K=K))
        if second is not None:
            misfit.append(depth_misfit(second, found))
            if misfit[1] < misfit[0]:
                return replace(second, scale=prediction.scale), {"told": True, "misfit": misfit}
    return prediction, {"told": False, "misfit": misfit}


def _refused(prediction: Reconstruction, reason: str) -> Refined:
    return Refined(result=prediction, tracks=None, about=_about(Refinement(accepted=False, reason=reason), {}))


def _about(found: Refinement, scores: dict[str, Any]) -> dict[str, Any]:
    return {
        "accepted": found.accepted,
        "reason": found.reason,
        "lacking": None if found.accepted else _lacking(found),
        "probability": found.probability,
        "pairs": 0 if found.pairs is None else len(found.pairs),
        "told": False, "misfit": None, "frozen": None, "before": None, "after": None, **scores,
    }  # fmt: skip


def _lacking(found: Refinement) -> str:
    if found.after_px is not None:
        return "proof"
    return "matches" if found.T_cam_world is None else "fit"
