import json
from dataclasses import replace

import pytest

from freegeo.geometry.camera import K_from_fov
from freegeo.metrics.pose import pair_errors
from freegeo.models.catalog import load_model
from freegeo.training.camera_card import (
    METRICS,
    VIEWS,
    WHOLE_GAIN,
    WITH,
    WITHOUT,
    camera_card,
    camera_tables,
    distance_ratio,
    predict_both,
    score_posed,
)
from freegeo.training.report_card import KEPT, evaluation_rooms
from freegeo.types import Prediction


@pytest.fixture(scope="module")
def truth():
    return evaluation_rooms("val-id", 0, 2, (48, 64))


@pytest.fixture(scope="module")
def model():
    return load_model("freegeo-tiny")


def test_depth_counts_in_the_unit_of_the_cameras(truth):
    chosen = list(KEPT)
    K = K_from_fov(*truth.fov_vh[:, chosen].unbind(-1), truth.images.shape[-2:])
    depth = truth.depth_z[:, chosen].float()
    T = truth.T_cam_world[:, chosen].clone()
    T[..., :3, 3] *= 0.2
    right = Prediction(depth_z=0.2 * depth, T_cam_world=T, K=K)
    assert distance_ratio(truth.T_cam_world[0, chosen], T[0]).item() == pytest.approx(5, rel=1e-3)
    scores = score_posed(right, truth, 1, KEPT)
    # The true points are those of all eight views.
    assert scores["abs_rel_posed"] < 1e-3 and scores["f1_posed"] > 0.95
    wrong = score_posed(Prediction(depth_z=0.26 * depth, T_cam_world=T, K=K), truth, 1, KEPT)
    assert wrong["abs_rel_posed"] == pytest.approx(0.3, abs=1e-3)
    assert wrong["abs_rel"] < 1e-3 and wrong["f1_posed"] < 0.5 < wrong["f1"]


def test_the_embedded_model_tells_true_cameras_from_those_of_other_rooms(model):
    rooms = evaluation_rooms("val-big", 0, 8, (48, 64))
    wanted = rooms.T_cam_world[:, list(KEPT)]

    def translation_deg(prediction):
        errors = [pair_errors(found, true) for found, true in zip(prediction.T_cam_world, wanted, strict=True)]
        return sum(float(error.translation_deg.median()) for error in errors) / len(errors)

    swapped = predict_both(model, replace(rooms, T_cam_world=rooms.T_cam_world.roll(1, 0)), KEPT)
    without, true, other = (
        translation_deg(one) for one in (swapped[WITHOUT], predict_both(model, rooms, KEPT)[WITH], swapped[WITH])
    )
    assert true < without - 0.5 and true < other - 0.5


def test_card_and_tables(tmp_path, model):
    card = camera_card(model, tmp_path / "card.json", side=64, domains={"val-id": 2})
    assert json.loads((tmp_path / "card.json").read_text()) == card
    for summary in card["domains"]["val-id"]["views"].values():
        without, known = summary["mean"][WITHOUT], summary["mean"][WITH]
        for name in METRICS:
            assert summary["gap"][name]["mean"] == pytest.approx(known[name] - without[name], abs=1e-9)
        assert summary["gap"][WHOLE_GAIN]["mean"] == pytest.approx(known["f1_posed"] - without["f1"], abs=1e-9)
    assert camera_tables(card).count("| val-id") == 3 * len(VIEWS)
