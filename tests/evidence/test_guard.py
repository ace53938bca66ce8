"""The guard: it takes what the matches prove, refuses what they do not, and says when they cannot tell."""

import json
from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from evidence_tools import exact_matches, truth, turned, without_matches
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.guard import SCENES, GuardSettings, Measurement, Reference, State, Verdict, states, try_states
from freegeo.evidence.matches import Matches, Outcome
from freegeo.evidence.scores import PairScores

scene = cache(truth)
WRONG = 2.0
"""Degrees by which the frozen model's cameras are turned."""


@cache
def matches() -> Matches:
    return exact_matches(scene(), noise_px=0.2)


def off_by(degrees: float, *, depth: float = 1.0, shift: float = 0.0, seed: int = 0) -> Candidate:
    """The room with turned cameras, scaled depth, and depth maps that are bent against each other."""
    T = turned(scene().T_cam_world, degrees, seed)
    bend = (
        1
        + shift
        * torch.linspace(-1, 1, len(T))[:, None, None]
        * torch.tensor([1.0, -1.0]).repeat(len(T))[: len(T), None, None]
    )
    return replace(scene(), T_cam_world=T, depth_z=scene().depth_z * depth * bend)


def verdict(predict, frozen: Candidate | None = None, **settings) -> Verdict:
    return judged([predict], [reference(frozen or off_by(WRONG))], settings=GuardSettings(**settings))


def reference(frozen: Candidate, of: Matches | None = None):
    """Makes the reference of a scene."""
    return lambda: Reference.of(frozen, of or matches())


def judged(predict, references, **options) -> Verdict:
    """The verdict on scenes; each is predicted by a function of the state, which may give a sentence instead."""
    return try_states(lambda number, tried: map(predict[number], tried), references, **options)


def test_an_adapter_that_makes_cameras_right_is_used():
    found = verdict(lambda state: off_by(WRONG * (1 - state.strength * state.steps)))
    assert found.outcome == "adapted"
    assert found.chosen is not None and found.chosen.state == State(steps=1.0, strength=1.0)
    assert found.chosen.probability == 1
    assert found.chosen.measured.epipolar_px < 0.5 * found.frozen.epipolar_px
    assert "Adaptation helped" in found.reason and "100 % sure" in found.reason
    assert len(found.trials) == len(states()) == 7


def test_an_adapter_that_makes_cameras_worse_is_not():
    found = verdict(lambda state: off_by(WRONG * (1 + state.strength * state.steps)))
    assert (found.outcome, found.chosen) == ("frozen", None)
    assert "fit worse" in found.reason
    assert all(trial.gain < 0 and trial.probability < 0.1 for trial in found.trials)


def test_an_adapter_that_changes_nothing_is_not():
    found = verdict(lambda state: off_by(WRONG))
    assert found.outcome == "frozen"
    assert {trial.gain for trial in found.trials} == {0.0}
    assert "do not prove" in found.reason


def test_too_strong_an_adapter_is_used_with_less_strength():
    # Right at half strength, as wrong as before at full strength.
    found = verdict(lambda state: off_by(abs(WRONG - 2 * WRONG * state.strength * state.steps)))
    assert found.outcome == "adapted"
    assert found.chosen is not None
    assert found.chosen.state.strength * found.chosen.state.steps == 0.5


def test_of_equal_states_the_weakest_is_used():
    found = verdict(lambda state: off_by(0))
    assert found.chosen is not None
    assert found.chosen.state == State(steps=1.0, strength=0.25)


def test_depth_that_drifts_from_the_cameras_is_refused_though_cameras_are_better():
    found = verdict(lambda state: off_by(0.5, depth=1.08))
    assert found.outcome == "frozen"
    assert all(trial.veto is not None and "scale" in trial.veto for trial in found.trials)
    assert "drift apart in scale" in found.reason


def test_depth_maps_that_agree_less_are_refused_though_cameras_are_better():
    found = verdict(lambda state: off_by(0, shift=0.04), drift=1.0)
    assert found.outcome == "frozen"
    assert all(trial.veto is not None and "agree less" in trial.veto for trial in found.trials)


def test_cameras_that_look_away_are_refused():
    half = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
    flip = torch.where(torch.arange(len(scene()))[:, None, None] % 2 == 0, half, torch.eye(4, dtype=torch.float64))
    found = verdict(lambda state: replace(scene(), T_cam_world=flip @ scene().T_cam_world))
    assert found.outcome == "frozen"
    assert all(trial.veto is not None for trial in found.trials)


@pytest.mark.parametrize("outcome", list(Outcome)[1:])
def test_without_matches_there_is_no_verdict_and_nothing_is_predicted(outcome):
    def predict(state):
        raise AssertionError("predicted in vain")

    found = judged([predict], [reference(off_by(WRONG), without_matches(matches(), outcome))])
    assert (found.outcome, found.chosen, found.trials) == ("unknown", None, ())
    assert found.reason.startswith("Not enough matches to judge: none of the ")


def test_few_pairs_or_few_views_are_no_evidence():
    assert len(matches().pairs) >= 8
    few = verdict(lambda state: scene(), pairs=len(matches().pairs) + 1)
    assert few.outcome == "unknown"
    assert f"{len(matches().pairs)} pairs of photos have some" in few.reason
    alone = replace(
        matches(), names=(*matches().names, "a", "b", "c"), photo_hw=np.tile(matches().photo_hw[:1], (9, 1)),
        match_hw=np.tile(matches().match_hw[:1], (9, 1)),
        view_start=np.append(matches().view_start, [matches().view_start[-1]] * 3),
    )  # fmt: skip
    more = scene().select([0, 1, 2, 3, 4, 5, 0, 1, 2])
    uncovered = judged([lambda state: more], [reference(more, alone)])
    assert uncovered.outcome == "unknown"
    assert "they cover 6 of 9 photos" in uncovered.reason


def test_the_verdict_depends_on_nothing_but_its_inputs():
    one, two = (verdict(lambda state: off_by(WRONG * (1 - 0.1 * state.strength))) for _ in range(2))
    assert [trial.probability for trial in one.trials] == [trial.probability for trial in two.trials]
    assert one.reason == two.reason


def test_world_frame_and_scale_of_a_state_do_not_matter():
    def moved(state):
        turn = torch.eye(4, dtype=torch.float64)
        turn[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
        T = scene().T_cam_world @ turn
        T[:, :3, 3] *= 3
        return replace(scene(), T_cam_world=T, depth_z=scene().depth_z * 3)

    plain, other = verdict(lambda state: scene()), verdict(moved)
    assert plain.outcome == other.outcome == "adapted"
    assert plain.trials[0].gain == pytest.approx(other.trials[0].gain, abs=1e-3)


def test_scenes_are_judged_together():
    references = [reference(off_by(WRONG, seed=seed)) for seed in (0, 1)]
    helped = judged([lambda state: scene()] * 2, references)
    assert helped.outcome == "adapted"
    assert helped.pairs == 2 * len(matches().pairs)
    mixed = judged([lambda state: scene(), lambda state: off_by(3 * WRONG, seed=1)], references)
    assert mixed.outcome == "frozen"
    # One scene without matches has no say, and the other covers half of the photos.
    unknown = judged([lambda state: scene()] * 2, [references[0], reference(scene(), without_matches(matches()))])
    assert unknown.outcome == "unknown"
    assert "6 of 12 photos" in unknown.reason


class Scored:
    """Stands for a `Reference` where only the rule counts: a prediction is its errors in pixels, one of each pair."""

    def __init__(self, frozen: float = 2.0, *, matched: bool = True, drift: float = 0.0, seed: int = 0):
        self.candidate, self.drift = frozen, drift
        self.matches = matches() if matched else without_matches(matches())
        self.noise = np.random.default_rng(seed).uniform(0.5, 1.5, len(self.matches.pairs))

    def measure(self, error: float | np.ndarray) -> Measurement:
        own = self.matches
        scores = PairScores(pairs=own.pairs, values=error * self.noise, used=own.counts, reason=own.reason())
        drift = (self.drift if error is not self.candidate else 0.0) if len(own.pairs) else float("nan")
        return Measurement(epipolar=scores, reprojection=scores, drift=drift, agreement=0.9, agreement_before=0.9)


def scored(errors, references: list[Scored], **options) -> Verdict:
    """The verdict where `errors` takes scene and state and gives the error in pixels, or a sentence."""
    makers = [lambda one=one: one for one in references]
    return try_states(lambda number, tried: [errors(number, state) for state in tried], makers, **options)


def test_a_scene_that_says_nothing_of_scale_hides_no_drift_of_the_others():
    references = [Scored(drift=0.08), Scored(drift=0.08, seed=1), Scored(matched=False)]
    found = scored(lambda number, state: 1.0, references, settings=GuardSettings(views=0.5))
    assert found.outcome == "frozen"
    assert "drift apart in scale" in found.reason


def test_a_state_that_one_scene_refuses_is_refused_for_all():
    def errors(broken):
        return lambda number, state: "scene 1: lost." if number == 1 and state.strength in broken else 1.0

    references = [Scored(seed=seed) for seed in range(3)]
    found = scored(errors({0.25, 0.5}), references)
    assert found.chosen is not None and found.chosen.state == State(steps=1.0, strength=0.75)
    assert len(found.trials) == 5
    broken = scored(errors({1.0, 0.75, 0.5, 0.25}), references)
    assert (broken.outcome, broken.reason) == ("frozen", "Adaptation cannot be used: scene 1: lost.")


# -- chunks of a sequence


def test_a_pair_of_frames_in_two_chunks_counts_once_with_the_mean_of_its_gains():
    frames, twice = tuple(range(len(scene()))), [Scored(), Scored()]

    def errors(number, state):
        return (1.0, 0.5)[number] * (1 + 0.1 * state.strength)

    apart, same = scored(errors, twice), scored(errors, twice, views=[frames, frames])
    assert (apart.pairs, same.pairs) == (2 * len(matches().pairs), len(matches().pairs))
    assert same.trials[0].gain == pytest.approx(apart.trials[0].gain)
    # Frames that two chunks share are covered by either of them.
    lost = [Scored(), Scored(matched=False)]
    assert scored(errors, lost).outcome == "unknown"
    assert scored(errors, lost, views=[frames, frames]).outcome == "adapted"
    # By which numbers the frames of a chunk go changes nothing.
    alone, moved = (scored(errors, twice[:1], views=views) for views in (None, [[10 * n + 3 for n in frames]]))
    assert json.dumps(alone.as_dict()) == json.dumps(moved.as_dict())


def test_the_same_pairs_twice_make_no_verdict_surer():
    frames = tuple(range(len(scene())))
    # Some pairs are a little better, others a little worse.
    mixed = np.where(np.arange(len(matches().pairs)) % 2, 1.7, 2.2)
    once, twice, apart = (
        scored(lambda number, state: mixed, [Scored()] * n, views=views)
        for n, views in ((1, None), (2, [frames, frames]), (2, None))
    )
    assert 0.5 < once.trials[0].probability < 1
    assert once.trials[0].probability == twice.trials[0].probability < apart.trials[0].probability


def test_of_many_chunks_some_choose_the_state_and_all_confirm_it():
    count, tried = SCENES + 8, Counter()

    def errors(number, state):
        tried[number] += 1
        return 2 - state.strength * state.steps

    views = [tuple(range(6 * number, 6 * number + 6)) for number in range(count)]
    found = scored(errors, [Scored(seed=seed) for seed in range(count)], views=views)
    assert found.outcome == "adapted" and found.chosen is not None
    assert found.chosen.state == State(steps=1.0, strength=1.0)
    assert (found.scenes, found.judged, found.pairs) == (count, count, count * len(matches().pairs))
    assert Counter(tried.values()) == {7: SCENES, 1: 8}
    assert tried[0] == tried[count - 1] == 7, "the choice reaches from the first chunk to the last"
    assert f"This is {found.chosen.state}, chosen on {SCENES} of {count} chunks and confirmed on all." in found.reason
    assert [trial.state for trial in found.trials] == [found.chosen.state]


def test_all_chunks_may_be_sure_of_what_some_are_not():
    count = SCENES + 8
    choosing = {round(place) for place in np.linspace(0, count - 1, SCENES)}
    half = np.where(np.arange(len(matches().pairs)) % 2, 1.7, 2.25)

    references = [Scored(seed=seed) for seed in range(count)]
    alone = scored(lambda number, state: half, [references[number] for number in sorted(choosing)])
    assert alone.outcome == "frozen"
    assert 0.5 < alone.trials[0].probability < GuardSettings().probability
    assert scored(lambda number, state: half if number in choosing else 1.0, references).outcome == "adapted"


def test_what_the_other_chunks_do_not_confirm_is_not_used():
    count = SCENES + 24
    choosing = {round(place) for place in np.linspace(0, count - 1, SCENES)}
    references = [Scored(seed=seed) for seed in range(count)]
    found = scored(lambda number, state: 1.0 if number in choosing else 3.0, references)
    assert (found.outcome, found.chosen, found.judged) == ("frozen", None, count)
    assert "not confirmed on all" in found.reason
    lost = scored(lambda number, state: 1.0 if number in choosing else f"{number}: lost.", references)
    assert lost.outcome == "frozen" and lost.reason.startswith("Adaptation cannot be used: 1: lost.")
    worse = scored(lambda number, state: 3.0, references)
    assert (worse.outcome, worse.scenes, worse.judged) == ("frozen", count, SCENES)
    assert f"This rests on {SCENES} of {count} scenes." in worse.reason


def test_chunks_without_matches_choose_nothing():
    count, dark, asked = SCENES + 2, {0, 7}, Counter()

    def errors(number, state):
        asked[number] += 1
        return 1.0

    references = [Scored(matched=number not in dark, seed=number) for number in range(count)]
    assert scored(errors, references, views=[range(6)] * count).outcome == "adapted"
    assert {number for number, times in asked.items() if times == 1} == dark


def test_a_verdict_is_plain_numbers():
    found = verdict(lambda state: off_by(WRONG * (1 - 0.5 * state.strength)))
    written = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    assert written["outcome"] == "adapted" and written["reason"] == found.reason
    assert written["trials"][written["chosen"]]["strength"] == found.chosen.state.strength
    assert written["trials"][0]["epipolar_px"] < written["frozen"]["epipolar_px"]
    nothing = judged([], [reference(scene(), without_matches(matches()))]).as_dict()
    assert json.loads(json.dumps(nothing, allow_nan=False))["frozen"]["epipolar_px"] is None
