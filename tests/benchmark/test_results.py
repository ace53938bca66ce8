import csv
import json
from dataclasses import replace

import pytest
import torch

from bench_tools import CONFIGURATION, DATASET, ROOMS, store_truth, task
from freegeo.benchmark.results import COLUMNS, Row, choose, paired, read_results, rows_of, write_results
from freegeo.benchmark.score import EMPTY_SURFACE, evaluate_all
from freegeo.benchmark.tasks import PREDICTION_FILE, finish
from freegeo.data.datasets.registry import load_scene
from freegeo.errors import UserError
from freegeo.files import write_json


@pytest.fixture
def out(tmp_path, small_rooms):
    return tmp_path / "out"


@pytest.fixture
def data(tmp_path):
    return tmp_path / "data"


def values(result, one):
    return {row.metric: row.value for row in result.rows if (row.scene, row.seed) == (one.scene, one.seed)}


def test_an_exact_prediction_scores_as_one(data, out):
    one = task(views=8)
    store_truth(data, out, one)
    result = evaluate_all(data, out)
    assert result.problems == []
    found = values(result, one)
    assert found["auc03"] == found["auc30"] == found["delta1"] == 1
    assert found["abs_rel"] < 1e-5
    assert found["f1_rel5"] > 0.7
    assert found["precision"] > 0.9
    assert found["fscore"] > 0.6
    assert found["seconds"] == 0.5


def test_the_table_has_one_row_per_task_and_metric_and_reads_back(data, out):
    store_truth(data, out, task())
    result = evaluate_all(data, out)
    assert len({(row.item, row.metric) for row in result.rows}) == len(result.rows) > 10
    assert read_results(out) == result.rows
    with result.files[0].open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    assert len(rows) == len(result.rows)
    assert {row["frames"] for row in rows} == {"4"}
    with pytest.raises(UserError, match="evaluate"):
        read_results(data)


def test_scores_are_kept_until_the_prediction_changes(data, out, monkeypatch):
    one = task()
    store_truth(data, out, one)
    first = evaluate_all(data, out).rows
    monkeypatch.setattr("freegeo.benchmark.score.score_scene_surface", lambda *_, **__: pytest.fail("scored again"))
    assert evaluate_all(data, out).rows == first
    store_truth(data, out, one)
    with pytest.raises(pytest.fail.Exception, match="again"):
        evaluate_all(data, out)


def test_bad_predictions_are_reported_and_no_metric_is_invented(data, out):
    good, far, lost, cut, missing = (task(seed=seed) for seed in (43, 44, 45, 46, 47))
    exact = store_truth(data, out, good)
    store_truth(data, out, far, depth_z=torch.full_like(exact.depth_z, 1e6))
    poses = exact.T_cam_world.clone()
    poses[1] = torch.nan
    store_truth(data, out, lost, T_cam_world=poses)
    store_truth(data, out, cut)
    path = cut.folder(out) / PREDICTION_FILE
    path.write_bytes(path.read_bytes()[:500])
    result = evaluate_all(data, out, wanted=[good, far, lost, cut, missing])

    reasons = {problem.what: problem.reason for problem in result.problems}
    assert len(reasons) == 6
    assert reasons["surface (4 views, seed 44, frozen)"] == EMPTY_SURFACE
    assert "not finite" in reasons["poses (4 views, seed 45, frozen)"]
    assert "NaN" in reasons["surface (4 views, seed 45, frozen)"]
    assert "non-finite" in reasons["points (4 views, seed 45, frozen)"]
    assert values(result, lost)["abs_rel"] < 1e-5, "depth does not need the poses"
    assert "damaged" in reasons["4 views, seed 46, frozen"]
    assert "no stored" in reasons["4 views, seed 47, frozen"]
    assert values(result, good)["fscore"] > 0.3
    assert values(result, far)["fscore"] == 0
    assert not {"overall", "acc", "comp"} & set(values(result, far))
    assert "fscore" not in values(result, lost)
    assert 0 < values(result, lost)["auc30"] <= 0.5
    assert values(result, cut) == values(result, missing) == {}


def test_a_missing_surface_leaves_the_poses(data, out):
    one = task()
    store_truth(data, out, one)
    (data / DATASET / f"{ROOMS[0]}.ply").unlink()
    load = load_scene(data, DATASET, ROOMS[0])
    assert load.truth.surface.is_file(), "rooms are rendered again"
    load.truth.surface.write_bytes(b"ply\n")
    result = evaluate_all(data, out)
    assert [problem.what.split()[0] for problem in result.problems] == ["surface"]
    assert values(result, one)["auc03"] == 1
    load.truth.surface.unlink()
    assert evaluate_all(data, out).problems == []


@pytest.mark.parametrize(
    "change", [{"model": "other"}, {"precision": "bf16"}, {"checkpoint": "abc"}], ids=lambda change: next(iter(change))
)
def test_mixed_settings_are_refused_by_name(data, out, change):
    store_truth(data, out, task())
    store_truth(data, out, task(seed=44), CONFIGURATION | change)
    with pytest.raises(UserError, match=f"{next(iter(change))}: "):
        evaluate_all(data, out)


def test_adapters_of_one_variant_must_be_made_alike(data, out):
    def adapted(**changes):
        about = {"per": "dataset", "epoch": None, "recipe": {"lr": 1e-3}, "seed": 42, "scenes": list(ROOMS), **changes}
        return CONFIGURATION | {"adaptation": about}

    store_truth(data, out, task("adapted"), adapted())
    store_truth(data, out, task("rank-8"), adapted(recipe={"lr": 1e-4}))
    evaluate_all(data, out)
    store_truth(data, out, task("adapted", seed=44), adapted(recipe={"lr": 1e-4}))
    with pytest.raises(UserError, match=r"adaptation\.recipe\.lr: 0\.001 there, 0\.0001 now"):
        evaluate_all(data, out)


def test_measured_features_become_rows(data, out):
    one = task("features-frozen")
    write_json(one.folder(out) / "measured.json", {"mse": 0.25, "cosine": 0.5})
    finish(one, out, CONFIGURATION, frames=[0, 1, 2, 3], adapter=None)
    assert values(evaluate_all(data, out), one) == {"mse": 0.25, "cosine": 0.5}


def test_pairs_share_scene_and_seed_and_scenes_are_drawn_whole():
    def made(scene, seed, value, variant):
        return rows_of(replace(task(variant, scene=scene), seed=seed), "m", 4, {"auc30": value})

    before = [row for scene in ROOMS for seed in (43, 44) for row in made(scene, seed, 0.5, "frozen")]
    after = made(ROOMS[0], 43, 0.7, "adapted") + made(ROOMS[1], 43, 0.6, "adapted") + made("other", 43, 0.0, "adapted")
    interval = paired(before, after)
    assert interval.mean == pytest.approx(0.15)
    assert (interval.low, interval.high) == pytest.approx((0.1, 0.2))
    assert paired(before, made("other", 43, 0.0, "adapted")) is None
    with pytest.raises(UserError, match="several"):
        paired(before + before, after)
    assert choose(after, scene="other", seed=43) == [after[2]]


def test_lines_are_json(tmp_path):
    fields = dict.fromkeys(COLUMNS, "x") | {"views": 4, "frames": 4, "seed": 1, "value": 0.5}
    _, lines = write_results(tmp_path, [Row(**fields)])
    assert json.loads(lines.read_text()) == fields
