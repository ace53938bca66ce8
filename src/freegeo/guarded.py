"""An adapter under guard: matches between the photos decide whether it is used, in which state (docs/guard.md).

`harm` needs no matches: it sees what no adaptation that is of use does to a prediction.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from freegeo.adaptation.adapted import Adapted
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.dense import co_visible
from freegeo.evidence.guard import Reference, State, Verdict, try_states
from freegeo.evidence.matches import ALL_PAIRS_UP_TO, Matches, choose_pairs, find_matches, stored_matches
from freegeo.export.reconstruction import Reconstruction
from freegeo.types import ImageBatch, PhotoLike, Priors

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
    """A scene, or a chunk of a sequence, as the guard sees it; images and depth maps are made or read when needed."""

    photos: Sequence[PhotoLike]
    batch: Callable[[], ImageBatch]
    """Returns the photos as images for the model."""
    frozen: Callable[[], Reconstruction] | None = None
    """Returns the prediction of all photos by the frozen model; None: it is made anew each time."""
    priors: Priors | None = None
    """What the model is told of the photos."""
    store: Path | None = None
    """File for the matches; None: they are not stored."""
    matches: Matches | None = None
    """What judges; None: matches of the photos, made or read here."""
    name: str = "the scene"
    """In messages, where there are several."""
    frames: tuple[int, ...] | None = None
    """Numbers of the photos in the sequence that this is a chunk of; None: no other scene has any of them."""

    @classmethod
    def in_memory(
        cls, photos: Sequence[PhotoLike], batch: ImageBatch, frozen: Reconstruction | None = None, **more: Any
    ) -> Evidence:
        """Return a scene whose images, and prediction if there is one, are in memory."""
        return cls(photos=photos, batch=lambda: batch, frozen=None if frozen is None else lambda: frozen, **more)

    def frozen_prediction(self) -> Reconstruction:
        """Return what `frozen` returns, which must be given."""
        assert self.frozen is not None
        return self.frozen()


def judge_adapter(
    adapted: Adapted,
    scenes: Sequence[Evidence],
    predict: Callable[[ImageBatch, Priors | None], Reconstruction | None],
    *,
    device: str,
    select: bool,
) -> Verdict:
    """Judge an adapter by its scenes' photos, one scene after another.

    Args:
        adapted: a finished adapter, attached to its model, with states after shares of the steps (`guard.SHARES`).
        scenes: photos and frozen predictions, which all are given. Matches stay in memory, nothing else does.
        predict: predicts images with the model as it is, told what is known of them; None when it gives no finite
            numbers.
        device: where depth maps are compared.
        select: bring the adapter into the state that the verdict allows; with strength 0 where it allows none.

    Returns:
        The verdict, its reason followed by what is used. Without `select` the adapter is as it was.
    """
    adapter = adapted.adapter
    final = {name: value.detach().cpu().clone() for name, value in adapter.named_parameters().items()}
    kept = {**adapted.earlier, 1.0: final}
    matches = {number: scene.matches for number, scene in enumerate(scenes) if scene.matches is not None}
    whole = State(steps=1.0, strength=1.0)

    def put(state: State) -> None:
        adapter.load(kept[state.steps])
        adapter.set_strength(state.strength)

    def reference(number: int) -> Reference:
        scene = scenes[number]
        frozen = scene.frozen_prediction()
        if number not in matches:
            matches[number] = scene_matches(scene.photos, frozen, scene.store, device=device)
        return Reference.of(Candidate.of(frozen, device), matches[number])

    def predicted(number: int, states: Sequence[State]) -> Generator[Candidate | str]:
        scene, batch = scenes[number], scenes[number].batch()
        # A mean over scenes does not show one that is lost; the rule sees it where there is one scene.
        before = scene.frozen_prediction() if len(scenes) > 1 else None
        for state in states:
            put(state)
            found = predict(batch, scene.priors)
            if found is None:
                yield "its predictions are no finite numbers."
            elif before is not None and (wrong := harm(before, found)):
                yield f"{scene.name}: {wrong}"
            else:
                yield Candidate.of(found, device)

    frames = [scene.frames for scene in scenes if scene.frames is not None]
    try:
        verdict = try_states(
            predicted, [partial(reference, number) for number in range(len(scenes))], views=frames or None
        )
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
