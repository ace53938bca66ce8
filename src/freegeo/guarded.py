"""An adapter under guard: matches between the photos decide whether it is used, in which state (docs/guard.md).

`harm` needs no matches: it sees what no adaptation that is of use does to a prediction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from freegeo.adaptation.adapt import Adapted
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.dense import co_visible
from freegeo.evidence.guard import Reference, State, Verdict, try_states
from freegeo.evidence.matches import ALL_PAIRS_UP_TO, Matches, choose_pairs, find_matches, stored_matches
from freegeo.export.reconstruction import Reconstruction
from freegeo.types import ImageBatch, PhotoLike

HARM = 3.0
"""Factor, up or down, between distances of cameras and depth. Useful runs were seen to change it by up to 1.15, runs
that were lost by 12 and more."""
_SPREAD_FLOOR = 0.02
"""Distance of cameras as a share of depth, added before comparing: photos from one place have none."""


def harm(before: Reconstruction, after: Reconstruction) -> str | None:
    """Return what is so wrong with an adapted prediction that it is used in no mode, in one sentence; None: nothing.

    Args:
        before: by the frozen model.
        after: of the same photos, with the adapter.
    """
    usable = [int(one.valid_pixels().sum()) for one in (before, after)]
    if 2 * usable[1] < usable[0]:
        share = usable[1] / usable[0]
        return f"with the adapter only {share:.0%} of the pixels with usable depth are left."
    if not before.has_cameras or len(before) < 2:
        return None
    was, now = (_spread(one) + _SPREAD_FLOOR for one in (before, after))
    if now * HARM < was:
        return f"with the adapter the cameras collapse: {was / now:.0f} times closer together, compared with depth."
    if now > was * HARM:
        return (
            "with the adapter depth and camera positions drift apart in scale: the cameras are "
            f"{now / was:.0f} times farther from each other, compared with depth."
        )
    return None


def _spread(prediction: Reconstruction) -> float:
    """Median distance between two cameras over the median depth."""
    T = prediction.cameras()[0].astype(np.float64)
    centres = -np.einsum("sji,sj->si", T[:, :3, :3], T[:, :3, 3])
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1)[np.triu_indices(len(T), 1)]
    return float(np.median(apart) / np.median(prediction.depth_z[prediction.valid_pixels()]))


def scene_matches(
    photos: Sequence[PhotoLike], prediction: Reconstruction, store: Path | None, *, device: str = "cpu"
) -> Matches:
    """Match the photos of a scene, or read their matches from `store`, which they are written to otherwise.

    All pairs of few photos; of many, those that see the most of each other by the prediction.
    """
    share = None
    if len(photos) > ALL_PAIRS_UP_TO:
        share = co_visible(Candidate.of(prediction, device)).share
    pairs = choose_pairs(len(photos), share)
    return find_matches(photos, pairs) if store is None else stored_matches(store, photos, pairs)


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """A scene as the guard sees it."""

    photos: Sequence[PhotoLike]
    batch: ImageBatch
    frozen: Reconstruction
    """Prediction of all photos by the frozen model."""
    store: Path | None = None
    """File for the matches; None: they are not stored."""
    matches: Matches | None = None
    """What judges; None: matches of the photos, made or read here."""


def judge_adapter(
    adapted: Adapted,
    scenes: Sequence[Evidence],
    predict: Callable[[ImageBatch], Reconstruction | None],
    *,
    device: str,
    select: bool,
) -> Verdict:
    """Judge an adapter by its scenes' photos.

    Args:
        adapted: a finished adapter, attached to its model, with states after shares of the steps (`guard.SHARES`).
        scenes: photos and frozen predictions.
        predict: predicts the photos of a scene with the model as it is; None when it gives no finite numbers.
        device: where depth maps are compared.
        select: bring the adapter into the state that the verdict allows; with strength 0 where it allows none.

    Returns:
        The verdict, its reason followed by what is used. Without `select` the adapter is as it was.
    """
    adapter = adapted.adapter
    final = {name: value.detach().cpu().clone() for name, value in adapter.named_parameters().items()}
    kept = {**adapted.earlier, 1.0: final}

    whole = State(steps=1.0, strength=1.0)

    def put(state: State) -> None:
        adapter.load(kept[state.steps])
        adapter.set_strength(state.strength)

    def predicted(state: State) -> list[Candidate] | None:
        put(state)
        found = [predict(scene.batch) for scene in scenes]
        return [Candidate.of(one, device) for one in found if one is not None] if None not in found else None

    references = [
        Reference.of(
            Candidate.of(scene.frozen, device),
            scene.matches or scene_matches(scene.photos, scene.frozen, scene.store, device=device),
        )
        for scene in scenes
    ]
    try:
        verdict = try_states(predicted, references)
    finally:
        put(whole)
    if not select:
        used = "The adapter is used as it was trained (--guard report)."
        if verdict.chosen is not None and verdict.chosen.state != whole:
            used = f"That is with {verdict.chosen.state}. {used}"
    elif verdict.chosen is not None:
        put(verdict.chosen.state)
        adapter.settle()
        used = f"It is used with {verdict.chosen.state}."
    else:
        adapter.set_strength(0.0)
        used = "The frozen model is used."
    return replace(verdict, reason=f"{verdict.reason} {used}", used="verdict" if select else "adapter")
