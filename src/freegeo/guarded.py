"""An adapter under guard: matches between the photos decide whether it is used, in which state (docs/guard.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from freegeo.adaptation.adapt import Adapted
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.dense import co_visible
from freegeo.evidence.guard import Reference, State, Verdict, try_states
from freegeo.evidence.matches import ALL_PAIRS_UP_TO, Matches, choose_pairs, find_matches, stored_matches
from freegeo.export.reconstruction import Reconstruction
from freegeo.types import ImageBatch, PhotoLike


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

    def put(state: State) -> None:
        adapter.load(kept[state.steps])
        adapter.set_strength(state.strength)

    def predicted(state: State) -> list[Candidate] | None:
        put(state)
        found = [predict(scene.batch) for scene in scenes]
        return [Candidate.of(one, device) for one in found if one is not None] if None not in found else None

    references = [
        Reference.of(
            Candidate.of(scene.frozen, device), scene_matches(scene.photos, scene.frozen, scene.store, device=device)
        )
        for scene in scenes
    ]
    try:
        verdict = try_states(predicted, references)
    finally:
        put(State(steps=1.0, strength=1.0))
    if not select:
        used = "The adapter is used as it was trained (--guard report)."
    elif verdict.chosen is not None:
        put(verdict.chosen.state)
        adapter.settle()
        used = f"It is used with {verdict.chosen.state}."
    else:
        adapter.set_strength(0.0)
        used = "The frozen model is used."
    return replace(verdict, reason=f"{verdict.reason} {used}")
