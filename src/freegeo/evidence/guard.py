"""Did an adaptation help this scene? The verdict of the photos' matches, and the adapter state that it allows.

The frozen model's prediction and those of some states of the adapter (steps, strength) are compared by scores of the
same matches, pair by pair. An adapted state is taken only where the evidence for it is strong, and no sign of harm that
matches do not see speaks against it; else the frozen model stays. The rule, what it is worth and what it misses:
docs/guard.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from freegeo.evidence.candidate import Candidate
from freegeo.evidence.dense import CoVisible, co_visible, confirmed_share
from freegeo.evidence.matches import Matches
from freegeo.evidence.scores import PairScores, carried, epipolar, off_edges

__all__ = ["GuardSettings", "Measurement", "Reference", "State", "Trial", "Verdict", "judge", "states", "try_states"]

STRENGTHS = (1.0, 0.75, 0.5, 0.25)
SHARES = (0.25, 0.5, 0.75)
"""Shares of the steps after which the adapter's state is kept, besides the last step."""
SCENES = 12
"""Most scenes, or chunks of a sequence, on which all states are tried. Of more, an even choice says which state is the
best, and all of them whether that one is better than the frozen model."""
CHOOSING = 0.5
"""Probability of being better, on the even choice, from which a state is looked at on all scenes."""
_FLOOR_S1, _FLOOR_S2 = 0.05, 0.1
"""Matching pixels below which errors say nothing, added before the logarithm."""

Outcome = Literal["adapted", "frozen", "unknown"]


@dataclass(frozen=True, kw_only=True)
class GuardSettings:
    """How strong the evidence for an adapted state must be."""

    probability: float = 0.9
    """Least probability, by bootstrap over pairs, that the state is better than the frozen model."""
    pairs: int = 6
    """Fewest pairs of views with scores."""
    views: float = 0.75
    """Least share of the views that these pairs cover."""
    depth_loss: float = 0.01
    """Largest allowed loss of the share of pixels whose depth other views confirm."""
    drift: float = 0.01
    """Largest allowed growth of the disagreement in scale between depth and camera positions."""
    draws: int = 200
    """Bootstrap draws."""
    seed: int = 0


@dataclass(frozen=True, kw_only=True, order=True)
class State:
    """A state of an adapter: after a share of the training steps, applied with a strength."""

    steps: float
    """Share of the steps, above 0 to 1."""
    strength: float
    """0 is the frozen model, 1 the adapter as it was trained."""

    def __str__(self) -> str:
        """Return a phrase such as "strength 0.5 after 75 % of the steps"."""
        after = "all" if self.steps == 1 else f"{100 * self.steps:g} %"
        return f"strength {self.strength:g} after {after} of the steps"


@dataclass(frozen=True, kw_only=True, eq=False)
class Measurement:
    """The scores of one prediction."""

    epipolar: PairScores
    """Cameras against matches."""
    reprojection: PairScores
    """Cameras and depth against matches."""
    drift: float
    """Distance from 1 of the factor between the scales of depth and of camera positions; nan without evidence."""
    agreement: float
    """Share of pixels whose depth the other views confirm (`compared_agreement`)."""
    agreement_before: float
    """The same of the frozen prediction, on the same pixels."""

    @property
    def epipolar_px(self) -> float:
        """Median over the pairs of their epipolar error, matching pixels; nan without evidence."""
        return _median(self.epipolar.values)

    @property
    def reprojection_px(self) -> float:
        """Median over the pairs of their reprojection error, matching pixels; nan without evidence."""
        return _median(self.reprojection.values)

    def as_dict(self) -> dict[str, float | None]:
        """Return the scores as JSON-like values, with the number of matches; what is unknown is None."""
        return {
            "epipolar_px": _number(self.epipolar_px),
            "reprojection_px": _number(self.reprojection_px),
            "scale_drift": _number(self.drift),
            "depth_agreement": _number(self.agreement),
            "depth_agreement_frozen": _number(self.agreement_before),
            "matches": int(self.epipolar.used.sum()),
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """One state of the adapter, compared with the frozen model."""

    state: State
    measured: Measurement
    gain: float
    """Mean over pairs of the fall of log(S1 + .05) + log(S2 + .1): above 0 is better; nan without a common pair."""
    spread: float
    """Standard error of the gain."""
    probability: float
    """Share of bootstrap draws of the pairs in which the gain is above 0; 0 without evidence."""
    veto: str | None
    """Why the state is refused whatever the gain; None: it is not."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Verdict:
    """What the evidence says about an adaptation."""

    outcome: Outcome
    """`adapted`: a state of the adapter is better; `frozen`: none is for certain; `unknown`: too few matches."""
    reason: str
    """The verdict in one sentence."""
    frozen: Measurement
    trials: Sequence[Trial] = field(default_factory=tuple)
    chosen: Trial | None = None
    """The trial to use; None: the frozen model."""
    pairs: int = 0
    """Pairs of views that had a say; a pair that several chunks of a sequence hold counts once."""
    scenes: int = 1
    """Scenes, or chunks of a sequence, that were there to judge by."""
    judged: int = 1
    """How many of them `frozen` and `trials` rest on."""
    used: Literal["verdict", "adapter"] = "verdict"
    """Whether the result follows the verdict, or is the adapter's as it was trained."""

    def as_dict(self) -> dict[str, Any]:
        """Return the verdict as JSON-like values; what is unknown is None."""
        return {
            "outcome": self.outcome,
            "reason": self.reason,
            "pairs": self.pairs,
            "scenes": self.scenes,
            "judged": self.judged,
            "used": self.used,
            "frozen": self.frozen.as_dict(),
            "trials": [
                {
                    "steps": trial.state.steps, "strength": trial.state.strength, **trial.measured.as_dict(),
                    "gain": _number(trial.gain), "probability": trial.probability, "veto": trial.veto,
                }
                for trial in self.trials
            ],
            "chosen": None if self.chosen is None else list(self.trials).index(self.chosen),
        }  # fmt: skip


def states() -> list[State]:
    """Return the states that are tried: the last step with every strength, and earlier steps with full strength."""
    return [
        *(State(steps=1.0, strength=strength) for strength in STRENGTHS),
        *(State(steps=share, strength=1.0) for share in SHARES),
    ]


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference:
    """The frozen prediction that others are compared with, and what is computed of it once."""

    candidate: Candidate
    matches: Matches
    keep: np.ndarray
    """(M, 2) bool, match ends whose depth counts, the same for all predictions."""
    common: CoVisible
    """Pixels that several views see by the frozen prediction."""

    @classmethod
    def of(cls, frozen: Candidate, matches: Matches) -> Reference:
        """Prepare a frozen prediction."""
        return cls(candidate=frozen, matches=matches, keep=off_edges(frozen, matches), common=co_visible(frozen))

    def measure(self, candidate: Candidate) -> Measurement:
        """Score a prediction of the same photos."""
        agreement, before = self.compared_agreement(candidate)
        ends = carried(candidate, self.matches, keep=self.keep)
        return Measurement(
            epipolar=epipolar(candidate, self.matches),
            reprojection=ends.reprojection(),
            drift=ends.depth_scale().drift,
            agreement=agreement,
            agreement_before=before,
        )

    def compared_agreement(self, candidate: Candidate) -> tuple[float, float]:
        """Shares of pixels whose depth other views confirm: of a prediction, and of the frozen one.

        Each is the mean over two sets of pixels, those that several views see by the one and by the other prediction.
        On one set alone the prediction that chose it would have the advantage: its surfaces are not hidden there.
        """
        own = self.common if candidate is self.candidate else co_visible(candidate)
        tolerance = min(own.tolerance, self.common.tolerance)
        after, before = (
            sum(confirmed_share(one, pixels, tolerance) for pixels in (self.common, own)) / 2
            for one in (own, self.common)
        )
        return after, before


def try_states(
    predict: Callable[[int, Sequence[State]], Iterable[Candidate | str]],
    references: Sequence[Callable[[], Reference]],
    *,
    views: Sequence[Sequence[int]] | None = None,
    settings: GuardSettings | None = None,
) -> Verdict:
    """Predict with the states of an adapter (`states`), and judge them; without enough matches nothing is predicted.

    One scene after another is looked at, so that the depth maps of only one need memory. Of more than `SCENES` scenes
    those between an even choice are predicted with the best state alone, which counts only if it is better on all.

    Args:
        predict: takes the number of a scene and states, and gives one prediction of all its photos for each state; or a
            sentence why the adapter cannot be used in this state, which leaves the state out for all scenes.
        references: make the frozen prediction of a scene; each is called up to twice. Pairs of all scenes are judged
            together.
        views: numbers of each scene's photos in the sequence that the scenes are chunks of; None: no two scenes share a
            photo. Several predictions of one pair of photos count as one, with the mean of their gains.
        settings: None: the defaults.
    """
    settings = settings or GuardSettings()
    bases, matches = (list(parts) for parts in zip(*map(_frozen_scores, references), strict=True))
    numbers = _numbers(matches, views)
    every = range(len(references))
    whole = _together(bases, numbers, every)
    missing = too_little(whole, matches, settings, photos=len(np.unique(np.concatenate(numbers))))
    if missing:
        return Verdict(outcome="unknown", reason=missing, frozen=whole, scenes=len(bases), judged=len(bases))
    look = _Scenes(predict, references)

    def judged(scenes: Sequence[int], one: Mapping[State, list[Measurement]], lost: Mapping[State, str]) -> Verdict:
        base = _together([bases[number] for number in scenes], numbers, scenes)
        found = [(state, _together(each, numbers, scenes)) for state, each in one.items()]
        probability = settings.probability if len(scenes) == len(every) else CHOOSING
        verdict = judge(base, found, replace(settings, probability=probability), unusable=lost)
        return replace(verdict, scenes=len(every), judged=len(scenes))

    if len(every) <= SCENES:
        return judged(every, *look.measured(every, states()))
    some = _even_choice([number for number in every if _known(bases[number]).any()])
    measured, lost = look.measured(some, states())
    first = judged(some, measured, lost)
    where = f"{len(some)} of {len(every)} {'scenes' if views is None else 'chunks'}"
    if first.chosen is None:
        return replace(first, reason=f"{first.reason} This rests on {where}.")
    best = first.chosen.state
    rest = [number for number in every if number not in some]
    more, lost = look.measured(rest, [best])
    last = judged([*some, *rest], {state: [*measured[state], *each] for state, each in more.items()}, lost)
    how = "confirmed" if last.chosen is not None else "not confirmed"
    return replace(last, reason=f"{last.reason} This is {best}, chosen on {where} and {how} on all.")


def _frozen_scores(make: Callable[[], Reference]) -> tuple[Measurement, Matches]:
    reference = make()
    return reference.measure(reference.candidate), reference.matches


@dataclass(frozen=True)
class _Scenes:
    """Scenes that states of an adapter are measured on, each in a call of its own, which leaves no depth maps."""

    predict: Callable[[int, Sequence[State]], Iterable[Candidate | str]]
    references: Sequence[Callable[[], Reference]]

    def measured(
        self, scenes: Sequence[int], tried: Sequence[State]
    ) -> tuple[dict[State, list[Measurement]], dict[State, str]]:
        """Return the measurements of the states that could be used in all scenes, and why others could not."""
        found: dict[State, list[Measurement]] = {state: [] for state in tried}
        unusable: dict[State, str] = {}
        for number in scenes:
            for state, scores in self._of_one(number, list(found)):
                if isinstance(scores, str):
                    unusable[state] = scores
                    del found[state]
                else:
                    found[state].append(scores)
        return found, unusable

    def _of_one(self, scene: int, tried: Sequence[State]) -> list[tuple[State, Measurement | str]]:
        if not tried:
            return []
        reference = self.references[scene]()
        candidates = zip(tried, self.predict(scene, tried), strict=True)
        return [(state, one if isinstance(one, str) else reference.measure(one)) for state, one in candidates]


def _even_choice(scenes: Sequence[int]) -> list[int]:
    """Return `SCENES` of scenes, evenly spread; all where there are no more."""
    places = np.linspace(0, len(scenes) - 1, min(SCENES, len(scenes))).round().astype(int)
    return [scenes[place] for place in places]


def _numbers(matches: Sequence[Matches], views: Sequence[Sequence[int]] | None) -> list[np.ndarray]:
    """Numbers of each scene's photos among those of all scenes."""
    if views is not None:
        return [np.asarray(one, np.int64) for one in views]
    starts = np.cumsum([0, *map(len, matches)])
    return [start + np.arange(len(one)) for start, one in zip(starts, matches, strict=False)]


def _together(measured: Sequence[Measurement], numbers: Sequence[np.ndarray], scenes: Sequence[int]) -> Measurement:
    """Scores of several scenes as one: pairs of photos side by side, other numbers as means over the scenes with one.

    `numbers` are those of the photos of all scenes (`_numbers`).
    """
    if len(measured) == 1:
        return measured[0]
    photos = [numbers[scene] for scene in scenes]
    return Measurement(
        epipolar=_side_by_side([one.epipolar for one in measured], photos),
        reprojection=_side_by_side([one.reprojection for one in measured], photos),
        drift=_mean([one.drift for one in measured]),
        agreement=_mean([one.agreement for one in measured]),
        agreement_before=_mean([one.agreement_before for one in measured]),
    )


def _side_by_side(scores: Sequence[PairScores], photos: Sequence[np.ndarray]) -> PairScores:
    return PairScores(
        pairs=np.concatenate([own[one.pairs] for one, own in zip(scores, photos, strict=True)]),
        values=np.concatenate([one.values for one in scores]),
        used=np.concatenate([one.used for one in scores]),
        reason=None if any(one.reason is None for one in scores) else scores[0].reason,
    )


def judge(
    frozen: Measurement,
    found: Sequence[tuple[State, Measurement]],
    settings: GuardSettings,
    *,
    unusable: Mapping[State, str] | None = None,
) -> Verdict:
    """Compare the scores of adapter states with those of the frozen model, and choose.

    `unusable` says why states could not be measured.
    """
    trials = [_trial(state, measured, frozen, settings) for state, measured in found]
    usable = [t for t in trials if t.veto is None and t.probability >= settings.probability]
    pairs = len(_by_pair(np.zeros(len(frozen.epipolar.pairs)), frozen))
    if not usable:
        return Verdict(
            outcome="frozen", reason=_why_not(trials, pairs, unusable or {}), frozen=frozen, trials=tuple(trials),
            pairs=pairs,
        )  # fmt: skip
    best = max(usable, key=lambda trial: trial.gain)
    # Within the noise of the best the least change is the safest.
    near = [trial for trial in usable if trial.gain >= best.gain - best.spread]
    chosen = min(near, key=lambda trial: (trial.state.strength, trial.state.steps))
    reason = (
        f"Adaptation helped by the matches between the photos: {_changes(frozen, chosen.measured)} over {pairs} pairs "
        f"({100 * chosen.probability:.0f} % sure)."
    )
    return Verdict(outcome="adapted", reason=reason, frozen=frozen, trials=tuple(trials), chosen=chosen, pairs=pairs)


def too_little(
    frozen: Measurement, matches: Sequence[Matches], settings: GuardSettings, *, photos: int | None = None
) -> str | None:
    """Return why the matches of scenes cannot judge, in one sentence; None when they can.

    `photos` is how many different ones the scenes have; None: none is in two scenes.
    """
    reasons = [reason for reason in (one.reason() for one in matches) if reason]
    if len(reasons) == len(matches):
        return f"Not enough matches to judge: {reasons[0][0].lower()}{reasons[0][1:]}"
    known = _known(frozen)
    covered, pairs = len(np.unique(frozen.epipolar.pairs[known])), len(_by_pair(np.zeros(len(known)), frozen))
    if pairs < settings.pairs:
        return (
            f"Not enough matches to judge: {pairs} pairs of photos have some, {settings.pairs} are needed. "
            "Photos that overlap more, or are sharper and brighter, have more."
        )
    photos = sum(len(one) for one in matches) if photos is None else photos
    if covered < settings.views * photos:
        return (
            f"Not enough matches to judge: they cover {covered} of {photos} photos. Leave out photos that "
            "overlap with no other, or add some between."
        )
    return None


def _known(measured: Measurement) -> np.ndarray:
    """Pairs (P,) with both scores."""
    return np.isfinite(measured.epipolar.values) & np.isfinite(measured.reprojection.values)


def _objective(measured: Measurement) -> np.ndarray:
    """J of every pair (P,), lower is better; nan without evidence, inf where every point is behind a camera."""
    return np.log(measured.epipolar.values + _FLOOR_S1) + np.log(measured.reprojection.values + _FLOOR_S2)


def _by_pair(values: np.ndarray, frozen: Measurement) -> np.ndarray:
    """Mean (D,) of values (P,) for each pair of photos with both scores, in the order of their first ones."""
    known = _known(frozen)
    _, first, group = np.unique(frozen.epipolar.pairs[known], axis=0, return_index=True, return_inverse=True)
    means = np.bincount(group.reshape(-1), values[known], minlength=len(first)) / np.bincount(group.reshape(-1))
    return means[np.argsort(first)]


def _trial(state: State, measured: Measurement, frozen: Measurement, settings: GuardSettings) -> Trial:
    with np.errstate(invalid="ignore"):  # of pairs without both scores
        fall = _by_pair(_objective(frozen) - _objective(measured), frozen)
    veto = _veto(measured, frozen, fall, settings)
    gain = spread = float("nan")
    probability = 0.0
    if np.isfinite(fall).all():
        draws = np.random.default_rng(settings.seed).integers(0, len(fall), (settings.draws, len(fall)))
        means = fall[draws].mean(axis=1)
        gain, spread, probability = float(fall.mean()), float(means.std()), float((means > 0).mean())
    return Trial(state=state, measured=measured, gain=gain, spread=spread, probability=probability, veto=veto)


def _veto(measured: Measurement, frozen: Measurement, fall: np.ndarray, settings: GuardSettings) -> str | None:
    if not np.isfinite(fall).all():
        return "points that both photos see lie behind a camera"
    before, after = measured.agreement_before, measured.agreement
    if before - after > settings.depth_loss:
        return f"depth maps agree less ({100 * before:.1f} % -> {100 * after:.1f} % of the pixels)"
    if measured.drift - frozen.drift > settings.drift:
        return f"depth and camera positions drift apart in scale ({frozen.drift:.1%} -> {measured.drift:.1%})"
    return None


def _why_not(trials: Sequence[Trial], pairs: int, unusable: Mapping[State, str]) -> str:
    if not trials:
        return f"Adaptation cannot be used: {next(iter(unusable.values()))}"
    vetoed = [trial for trial in trials if trial.veto is not None and trial.probability > 0]
    if all(trial.gain < 0 for trial in trials):
        return f"Adaptation made the matches between the photos fit worse over {pairs} pairs."
    if len(vetoed) == len(trials) and vetoed:
        return f"Adaptation did harm that matches do not see: {vetoed[0].veto}."
    best = max((trial.probability for trial in trials), default=0.0)
    return (
        f"The matches between the photos do not prove that adaptation helped ({100 * best:.0f} % sure over {pairs} "
        "pairs)."
    )


def _changes(before: Measurement, after: Measurement) -> str:
    return (
        f"epipolar error {before.epipolar_px:.2f} -> {after.epipolar_px:.2f} px, reprojection error "
        f"{before.reprojection_px:.2f} -> {after.reprojection_px:.2f} px"
    )


def _mean(values: Sequence[float]) -> float:
    """Mean of those values that are known; nan without any."""
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _median(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")
