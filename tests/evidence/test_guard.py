"""The guard: it takes what the matches prove, refuses what they do not, and says when they cannot tell."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from evidence_tools import exact_matches, truth, turned, without_matches
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.guard import GuardSettings, Reference, State, Verdict, states, try_states
from freegeo.evidence.matches import Matches, Outcome

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
    reference = Reference.of(frozen or off_by(WRONG), matches())
    return try_states(lambda state: [predict(state)], [reference], settings=GuardSettings(**settings))


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

    found = try_states(predict, [Reference.of(off_by(WRONG), without_matches(matches(), outcome))])
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
    uncovered = try_states(lambda state: [more], [Reference.of(more, alone)])
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
    references = [Reference.of(off_by(WRONG, seed=seed), matches()) for seed in (0, 1)]
    helped = try_states(lambda state: [scene(), scene()], references)
    assert helped.outcome == "adapted"
    assert helped.pairs == 2 * len(matches().pairs)
    mixed = try_states(lambda state: [scene(), off_by(3 * WRONG, seed=1)], references)
    assert mixed.outcome == "frozen"
    # One scene without matches has no say, and the other covers half of the photos.
    unknown = try_states(
        lambda state: [scene()] * 2, [references[0], Reference.of(scene(), without_matches(matches()))]
    )
    assert unknown.outcome == "unknown"
    assert "6 of 12 photos" in unknown.reason


def test_a_verdict_is_plain_numbers():
    found = verdict(lambda state: off_by(WRONG * (1 - 0.5 * state.strength)))
    written = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    assert written["outcome"] == "adapted" and written["reason"] == found.reason
    assert written["trials"][written["chosen"]]["strength"] == found.chosen.state.strength
    assert written["trials"][0]["epipolar_px"] < written["frozen"]["epipolar_px"]
    nothing = try_states(lambda state: [], [Reference.of(scene(), without_matches(matches()))]).as_dict()
    assert json.loads(json.dumps(nothing, allow_nan=False))["frozen"]["epipolar_px"] is None
