"""Did it help? The answer follows the verdicts, marks what is used, and says what to try where it is not yes."""

import pytest

from freegeo.cli.jobs import say_known
from freegeo.export.reconstruction import METRIC_MODEL
from freegeo.report.answer import HEADER, LACKING, OVERLAP, answer, rescaled

SCORES = {
    "epipolar_px": 2.0, "reprojection_px": 3.0, "scale_drift": 0.01, "depth_agreement": 0.9,
    "depth_agreement_frozen": 0.9, "matches": 1200,
}  # fmt: skip
WHOLE = {**SCORES, "steps": 1.0, "strength": 1.0, "probability": 0.4, "gain": 0.1, "veto": None}
HALF = {**WHOLE, "strength": 0.5, "probability": 0.95, "epipolar_px": 1.5}
RECIPE = {"hold": 1.0, "steps": 100, "lr": 3e-5}
NOTHING = {name: 0 if name == "matches" else None for name in SCORES}


def summary(**changes):
    return {
        "recipe": RECIPE, "verdict": None, "refinement": None, "adapter": None, "rejected_adapter": None,
        "filters": {"pixels": 1}, **changes,
    }  # fmt: skip


def verdict(outcome, trials=(WHOLE, HALF), chosen=None, used="verdict"):
    return {
        "outcome": outcome, "reason": "Because.", "pairs": 9, "used": used, "frozen": SCORES if trials else NOTHING,
        "trials": trials, "chosen": chosen,
    }  # fmt: skip


def refinement(accepted, **changes):
    after = {**SCORES, "epipolar_px": 0.1}
    return {
        "accepted": accepted, "reason": "Refined so.", "lacking": None if accepted else "proof", "probability": 0.97,
        "pairs": 9, "frozen": None, "before": SCORES, "after": after, **changes,
    }  # fmt: skip


def test_nothing_was_asked_of_a_plain_reconstruction():
    assert answer({}) is None
    assert answer(summary(recipe=None)) is None


def rows(found):
    assert all(len(row) == len(HEADER) for row in found.rows)
    return [row[0] for row in found.rows]


def test_an_adapter_that_helped_needs_no_advice():
    found = answer(summary(verdict=verdict("adapted", chosen=1), adapter="adapter"))
    assert [(part.what, part.outcome, part.sentence) for part in found.parts] == [("Adaptation", "yes", "Because.")]
    assert rows(found) == ["frozen", "adapted", "adapted, strength 0.5, 100 % of steps (used)"]
    assert found.rows[-1][1:] == ("1.50", "3.00", "10.0", "1,200", "95")
    assert found.advice == ()


def test_known_cameras_are_not_advised_to_be_refined():
    known = summary(verdict=verdict("frozen"), rejected_adapter="Because.", known_cameras={"poses": 3})
    assert "--refine" not in " ".join(answer(known).advice)


def test_an_adapter_that_did_not_help_is_not_used():
    found = answer(summary(verdict=verdict("frozen"), rejected_adapter="Because."))
    assert found.parts[0].outcome == "no"
    assert rows(found) == ["frozen (used)", "adapted"]
    text = " ".join(found.advice)
    assert "--refine ba" in text and "--steps (now 100)" in text and "--hold" not in text
    free = answer(summary(verdict=verdict("frozen"), recipe={**RECIPE, "hold": 0.0}, refinement=refinement(True)))
    assert "--hold 1 (now 0)" in " ".join(free.advice) and "--refine" not in " ".join(free.advice)


def test_a_reported_verdict_leaves_the_adapter_in_use():
    reported = verdict("frozen", used="adapter")
    assert rows(answer(summary(verdict=reported, adapter="adapter"))) == ["frozen", "adapted (used)"]
    better = verdict("adapted", chosen=1, used="adapter")
    found = answer(summary(verdict=better, adapter="adapter"))
    assert rows(found) == ["frozen", "adapted (used)", "adapted, strength 0.5, 100 % of steps"]


def test_too_few_matches_ask_for_more_overlap():
    found = answer(summary(verdict=verdict("unknown", ())))
    assert (found.parts[0].outcome, found.rows, found.advice) == ("unknown", (), (OVERLAP,))


@pytest.mark.parametrize(
    ("changes", "outcome", "words"),
    [
        ({"rejected_adapter": "the loss grew.", "verdict": None}, "no", "The loss grew."),
        ({"rejected_adapter": "no numbers.", "verdict": verdict("adapted", chosen=0)}, "no", "No numbers."),
        ({"adapter": "adapter"}, "unknown", "not asked (--guard off)"),
        ({"adapter": "adapter", "filters": None}, "unknown", "predicts no cameras"),
    ],
)
def test_without_a_verdict_the_reason_is_told(changes, outcome, words):
    (part,) = answer(summary(**changes)).parts
    assert part.outcome == outcome and words in part.sentence


def test_a_refined_result_is_the_one_in_use():
    found = answer(summary(verdict=verdict("adapted", chosen=0), adapter="adapter", refinement=refinement(True)))
    assert [part.outcome for part in found.parts] == ["yes", "yes"]
    assert rows(found) == ["frozen", "adapted", "refined (used)"]
    assert found.rows[-1][1] == "0.10"
    assert rows(answer(summary(recipe=None, refinement=refinement(True)))) == ["frozen", "refined (used)"]
    saved = answer(summary(recipe=None, adapter="a/", refinement=refinement(True, frozen=None)))
    assert rows(saved) == ["adapted", "refined (used)"]


def test_contradictions_are_compared_with_the_frozen_ones_on_the_same_pixels():
    trial = {**WHOLE, "depth_agreement": 0.88, "depth_agreement_frozen": 0.885}
    found = answer(summary(verdict=verdict("adapted", [trial], chosen=0), adapter="adapter"))
    assert [row[HEADER.index("contradicted pixels, %")] for row in found.rows] == ["10.0", "12.0 (frozen: 11.5)"]


def test_depth_that_contradicts_itself_more_is_said():
    worse = refinement(True, after={**SCORES, "depth_agreement": 0.8})
    told = answer(summary(recipe=None, refinement=worse)).parts[0].sentence
    assert told.endswith("in 20 % of the pixels (frozen: 10 % of the same ones): they are less exact than the cameras.")
    as_adapted = refinement(True, before={**SCORES, "depth_agreement": 0.8}, after={**SCORES, "depth_agreement": 0.8})
    assert answer(summary(recipe=None, refinement=as_adapted)).parts[0].sentence == "Refined so."
    assert answer(summary(recipe=None, refinement=refinement(True))).parts[0].sentence == "Refined so."


@pytest.mark.parametrize("lacking", LACKING)
def test_a_refused_refinement_changes_nothing_and_says_what_it_lacks(lacking):
    after = {"epipolar_px": 1.9} if lacking == "proof" else None
    found = answer(summary(recipe=None, refinement=refinement(False, lacking=lacking, after=after)))
    assert found.parts[0].outcome == "no" and "stay as they were predicted" in found.parts[0].sentence
    assert rows(found) == ["frozen (used)", "refined, refused"][: 2 if after else 1]
    assert found.advice == (LACKING[lacking],)


def test_with_known_cameras_the_scores_are_said_to_be_those_of_predicted_ones():
    one = answer(summary(verdict=verdict("adapted", chosen=0), adapter="adapter", known_cameras={"poses": 4}))
    assert one.parts[0].sentence == "Because. These are the cameras that the model sees; the result has the known ones."


@pytest.mark.parametrize(
    ("source", "factor"),
    [("a measured distance", 2.5), ("the known cameras in cameras.json", None), (METRIC_MODEL, None), (None, None)],
)
def test_known_cameras_in_metres_of_another_source_are_not_as_given(source, factor, capsys):
    known = {
        "source": "cameras.json", "poses": 3, "intrinsics": 2, "metric": False, "scale": 2.0, "rotation_deg": None,
        "position": None,
    }  # fmt: skip
    scale = None if source is None else {"value": 2.5, "source": source, "spread": None}
    facts = {"known_cameras": known, "scale": scale}
    assert rescaled(facts) == factor
    say_known(facts)
    said = capsys.readouterr().out
    assert ("positions times 2.5" in said) == (factor is not None)
    assert f"depth times {2 * (factor or 1):g}" in said
