import json

import matplotlib.image
import pytest
import torch

from freegeo.errors import UserError
from freegeo.geometry.camera import K_from_fov
from freegeo.training.config import TrainConfig
from freegeo.training.curve import plot_learning_curve, read_log
from freegeo.training.pool import render_rooms
from freegeo.training.report_card import (
    GATES,
    KEPT,
    MODES,
    card_tables,
    report_card,
    score_room,
    score_rooms,
    zero_motion_rotation_deg,
)
from freegeo.training.state import averaged, new_state
from freegeo.types import Prediction


@pytest.fixture(scope="module")
def truth():
    return render_rooms([20_000_000, 20_000_001], "test-id", 8, (48, 64))


def perfect(truth, views):
    views = list(views)
    K = K_from_fov(*truth.fov_vh[:, views].unbind(-1), truth.images.shape[-2:])
    depth = truth.depth_z[:, views].float()
    return Prediction(depth_z=depth, conf=torch.ones_like(depth), T_cam_world=truth.T_cam_world[:, views], K=K)


def test_a_perfect_prediction_scores_perfectly(truth):
    scores = score_room(perfect(truth, range(8)), truth, 1, range(8), True)
    assert scores["auc30"] > 0.99
    assert scores["f1"] > 0.99
    for name in ("rotation_deg", "translation_deg", "fov_deg", "abs_rel"):
        assert scores[name] < 0.1, name


def test_a_scaled_scene_scores_the_same_and_a_wrong_lens_is_seen(truth):
    prediction = perfect(truth, KEPT)
    T = prediction.T_cam_world.clone()
    T[..., :3, 3] *= 0.25
    scaled = Prediction(depth_z=prediction.depth_z / 4, conf=prediction.conf, T_cam_world=T, K=prediction.K)
    scores = score_room(scaled, truth, 0, KEPT, False)
    assert scores["auc30"] > 0.99
    assert scores["abs_rel"] < 1e-3
    K = prediction.K.clone()
    K[..., 0, 0] *= 1.1
    wrong = Prediction(depth_z=prediction.depth_z, conf=prediction.conf, T_cam_world=prediction.T_cam_world, K=K)
    assert 2 < score_room(wrong, truth, 0, KEPT, False)["fov_deg"] < 8


def test_standing_still_is_far_off(truth):
    assert 10 < zero_motion_rotation_deg(truth) < 90


@pytest.mark.slow
def test_report_card_has_gates_gaps_and_tables(tmp_path):
    model = averaged(new_state(TrainConfig()))
    card = report_card(model, tmp_path / "card.json", side=64, domains={"val-id": 3, "val-light": 2})
    assert json.loads((tmp_path / "card.json").read_text()) == card
    assert card["domains"]["val-id"]["mean"].keys() == set(MODES)
    assert card["gates"].keys() == {gate.metric for gate in GATES}
    assert not card["gates"]["auc30"]["reached"]
    for entry in card["domains"].values():
        gap = entry["gap"]["auc30"]
        assert gap["low"] <= gap["mean"] <= gap["high"]
        difference = entry["mean"]["8->4"]["auc30"] - entry["mean"]["4"]["auc30"]
        assert gap["mean"] == pytest.approx(difference, abs=1e-9)
    tables = card_tables(card)
    assert tables.count("| val-light") == 4
    assert len({line.count("|") for line in tables.split("\n\n")[0].splitlines()}) == 1


def test_evaluation_repeats_itself():
    model = averaged(new_state(TrainConfig()))
    first, second = (score_rooms(model, "val-id", 2, side=48) for _ in range(2))
    assert first.mean("8->4") == second.mean("8->4")


def log_line(kind, views, **values):
    return json.dumps({"kind": kind, "step": views // 10, "views": views, "s": 1.0, **values})


def test_learning_curve_is_drawn_and_repeated_lines_count_once(tmp_path):
    terms = dict.fromkeys(("translation", "points", "matching", "depth", "field_of_view", "rotation"), 0.5)
    names = ("auc30", "auc15", "auc05", "rotation_deg", "translation_deg", "fov_deg")
    modes = {mode: dict.fromkeys(names, 0.2) for mode in MODES}
    lines = [log_line("step", views, zero_motion=1.0, **terms) for views in (100, 200, 300, 200, 300, 400)]
    log = tmp_path / "log.jsonl"
    log.write_text("\n".join(lines) + "\n")
    assert [line["views"] for line in read_log(log)] == [100, 200, 300, 400]
    without, width, _ = matplotlib.image.imread(plot_learning_curve(log, tmp_path / "losses.png")).shape
    log.write_text("\n".join([*lines, log_line("evaluation", 400, **modes)]) + "\n")
    with_scores, same_width, _ = matplotlib.image.imread(plot_learning_curve(log, tmp_path / "curve.png")).shape
    # A run that was never scored has one row of panels, not a second one that is empty.
    assert width == same_width and 1.5 * without < with_scores < 2 * without


def test_a_missing_log_is_named(tmp_path):
    with pytest.raises(UserError, match="no such training log"):
        read_log(tmp_path / "log.jsonl")
