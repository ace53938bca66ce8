"""The term that keeps what the model says with all views: it holds, and is announced."""

import pytest
import torch

from freegeo.adaptation.adapt import adapt
from freegeo.adaptation.losses import feature_distance
from freegeo.errors import UserError
from tiny_models import noise, noise_scene, quick, tiny_da3, tiny_vggt

VIEWS = 8
LENGTH = {"steps": 12, "sets_per_scene": 2, "distinct_seeds": 2}


def adapted(build, **changes):
    model = build()
    return model, adapt(model, [noise_scene(VIEWS)], quick(model, **LENGTH, **changes), seed=42)


def all_view_drift(model, result, recipe) -> float:
    """How far the features of all views have moved."""
    with torch.no_grad():
        tokens = model.embed(noise(VIEWS)[None])
        moved = model.aggregate(tokens, layers=model.spec.loss_layers).levels
        with result.adapter.off():
            frozen = model.aggregate(tokens, layers=model.spec.loss_layers).levels
    return float(feature_distance(moved, frozen, recipe.loss)[0])


@pytest.mark.parametrize("build", [tiny_da3, tiny_vggt])
def test_features_of_all_views_stay_nearer_and_the_student_still_learns(build):
    drift, learned = {}, {}
    for hold in (0.0, 2.0):
        model, result = adapted(build, hold=hold)
        drift[hold] = all_view_drift(model, result, result.recipe)
        learned[hold] = [terms["intra"] for terms in result.curve]
    assert 0 < drift[2.0] < 0.7 * drift[0.0]
    assert sum(learned[2.0][-4:]) < sum(learned[2.0][:4])


def test_the_term_is_announced_and_part_of_the_total():
    _, plain = adapted(tiny_da3)
    _, held = adapted(tiny_da3, hold=0.5)
    assert "hold" not in plain.curve[0]
    # The untrained adapter changes nothing, so that the first step has nothing to hold.
    assert held.curve[0]["hold"] == pytest.approx(0, abs=1e-5)
    assert held.curve[0]["total"] == pytest.approx(plain.curve[0]["total"], abs=1e-4)
    last = held.curve[-1]
    assert last["hold"] > 0
    assert last["total"] == pytest.approx(last["intra"] + last["cross"] + last["hold"], rel=1e-5)


@pytest.mark.parametrize("weight", [-1, float("nan"), float("inf")])
def test_a_weight_that_is_no_number_from_zero_is_refused(weight):
    with pytest.raises(UserError, match=f"--hold must be 0 or more and finite, got {weight}"):
        quick(tiny_da3(), hold=weight)
