import json
from functools import partial

import pytest

from freegeo.models.catalog import load_model
from freegeo.training import config, loop
from freegeo.training.config import TrainConfig


@pytest.fixture
def small_run(monkeypatch):
    """A run of ten steps on six rooms."""
    small = partial(
        TrainConfig, minutes=0.0, side=64, views_per_step=4, rooms=6, rooms_per_shard=2, rooms_at_start=0, frames=4,
        warmup_views=8, depth_views=1, evaluate_every=20,
    )  # fmt: skip
    monkeypatch.setattr(config, "TrainConfig", small)
    monkeypatch.setattr(loop, "LOG_EVERY_STEPS", 2)
    monkeypatch.setattr(loop, "EVALUATION_ROOMS", 2)


@pytest.mark.slow
@pytest.mark.usefixtures("small_run")
def test_training_leaves_weights_and_a_learning_curve_and_goes_on(freegeo, tmp_path):
    run = tmp_path / "run"
    outcome = freegeo("train-tiny", run, "--views", 40)
    assert outcome.code == 0, outcome.err
    assert load_model("freegeo-tiny", checkpoint=run / loop.WEIGHTS).spec.name == "freegeo-tiny"
    assert (run / "learning-curve.png").stat().st_size > 20_000
    assert str(run / loop.WEIGHTS) in outcome.out
    card = tmp_path / "card.json"
    scored = freegeo(
        "models", "score", "freegeo-tiny", "--checkpoint", run / loop.WEIGHTS, "--domains", "val-id,val-light",
        "--rooms", 2, "-o", card,
    )  # fmt: skip
    assert scored.code == 0, scored.err
    assert "| val-light (2) | 8->4 |" in scored.out
    assert "auc30 0." in scored.out and "not reached" in scored.out
    assert list(json.loads(card.read_text())["domains"]) == ["val-id", "val-light"]
    known = freegeo(
        "models", "score", "freegeo-tiny", "--cameras", "--checkpoint", run / loop.WEIGHTS, "--domains", "val-id",
        "--rooms", 2, "-o", card,
    )  # fmt: skip
    assert known.code == 0, known.err
    assert "| val-id (2) | 8 | given |" in known.out
    assert "no-such" in freegeo("models", "score", "freegeo-tiny", "--domains", "no-such").sentence()
    again = freegeo("train-tiny", run, "--views", 40)
    assert again.code == 0
    other = freegeo("train-tiny", run, "--views", 40, "--seed", 3)
    assert other.code == 2
    assert "another seed" in other.sentence()
