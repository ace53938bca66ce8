import errno
import json
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from bench_tools import DATASET, ROOMS, task
from freegeo.benchmark import adapters, stored
from freegeo.benchmark.predict import Predictor, predict_all, true_cameras
from freegeo.benchmark.score import evaluate_all
from freegeo.benchmark.stored import read_stored
from freegeo.benchmark.tasks import (
    DAMAGED,
    FRAME_RULES,
    PREDICTION_FILE,
    TASK_FILE,
    Problem,
    choose_frames,
    finish,
    is_finished,
    run_each,
    stored_tasks,
)
from freegeo.data.datasets.registry import load_scene
from freegeo.errors import FreeGeoError, UserError
from tiny_models import tiny_da3


@pytest.mark.slow
def test_given_cameras_change_the_prediction_and_are_scored_with(setup):
    posed = replace(setup, given_cameras=True, out=setup.out / "posed")
    assert predict_all(Predictor(setup), [task()]) == predict_all(Predictor(posed), [task()]) == []
    alone, given = (read_stored(task(), one.out) for one in (setup, posed))
    assert not torch.equal(alone.prediction.depth_z, given.prediction.depth_z)
    assert dict(stored_tasks(posed.out))[task()]["configuration"]["given_cameras"]
    scores = {}
    for one in (setup, posed):
        store = {row.metric: row.value for row in evaluate_all(one.data, one.out).rows}
        scores[one.out] = store
    assert scores[setup.out].keys() == scores[posed.out].keys()
    # Both kinds in one folder cannot be compared.
    predict_all(Predictor(replace(posed, out=setup.out)), [task(views=8)])
    with pytest.raises(UserError, match="given_cameras"):
        evaluate_all(setup.data, setup.out)


def test_true_cameras_belong_to_the_models_images(setup):
    scene = load_scene(setup.data, DATASET, ROOMS[0])
    predictor = Predictor(setup)
    batch = predictor.model.preprocess(list(scene.photos))
    cameras = true_cameras(scene, batch)
    width = batch.image_hw[1]
    torch.testing.assert_close(cameras.K[0, :, 0, 2] / width, scene.K[:, 0, 2] / 64, atol=1e-3, rtol=0)
    torch.testing.assert_close(cameras.K[0, :, 0, 0] / width, scene.K[:, 0, 0] / 64, atol=1e-3, rtol=0)
    assert torch.equal(cameras.T_cam_world[0].double(), scene.T_cam_world.double())


@pytest.mark.parametrize("rule", FRAME_RULES)
def test_frames_ascend_and_depend_on_the_seed_alone(rule):
    for views in (4, 8, 16):
        frames = choose_frames(rule, 40, views, 43)
        assert frames == choose_frames(rule, 40, views, 43) == sorted(set(frames))
        assert len(frames) == views
        assert choose_frames(rule, 3, views, 43) == [0, 1, 2]


def test_the_two_families_choose_four_frames_differently():
    eight = choose_frames("da3", 40, 8, 43)
    assert set(choose_frames("da3", 40, 4, 43)) < set(eight)
    assert choose_frames("vggt", 40, 4, 43) == eight[::2]
    assert choose_frames("da3", 40, 4, 43) != eight[::2]
    assert choose_frames("vggt", 40, 8, 43) == eight


def test_neighbours_stand_in_a_row():
    assert np.diff(choose_frames("neighbours", 16, 8, 45)).tolist() == [1] * 7
    assert np.diff(choose_frames("neighbours", 16, 4, 45)).tolist() == [2] * 3
    with pytest.raises(UserError, match="da3"):
        choose_frames("last", 16, 4, 45)


def test_a_task_of_other_settings_is_not_taken_for_finished(tmp_path):
    one = task()
    assert not is_finished(one, tmp_path, {"model": "a"})
    finish(one, tmp_path, {"model": "a"}, frames=[0])
    assert is_finished(one, tmp_path, {"model": "a"})
    with pytest.raises(UserError, match="model"):
        is_finished(one, tmp_path, {"model": "b"})
    assert not is_finished(one, tmp_path, {"model": "b"}, overwrite=True)
    assert [found for found, _ in stored_tasks(tmp_path)] == [one]


def test_a_failing_item_does_not_stop_the_others_but_a_bug_does():
    def work(number):
        if number == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        done.append(number)

    def explain(number, error):
        return Problem(dataset="d", scene=str(number), stage="predict", what="x", reason=error.strerror)

    done = []
    problems = run_each([1, 2, 3], work, explain)
    assert done == [1, 3]
    without_memory = RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried")
    assert len(run_each([0, 1], Mock(side_effect=[without_memory, None]), lambda item, error: problems[0])) == 1
    assert [problem.scene for problem in problems] == ["2"]
    with pytest.raises(TypeError):
        run_each([None], lambda item: item + 1, explain)
    assert not issubclass(KeyboardInterrupt, DAMAGED)


def test_a_stopped_run_continues_where_it_was(setup, monkeypatch):
    tasks = [task(variant, scene=scene) for scene in ROOMS for variant in ("frozen", "adapted")]
    assert predict_all(Predictor(setup), tasks) == []
    whole = {one: read_stored(one, setup.out).prediction.depth_z for one in tasks}
    for one in tasks[2:]:
        (one.folder(setup.out) / TASK_FILE).unlink()
    kept = [(one.folder(setup.out) / PREDICTION_FILE).stat().st_mtime_ns for one in tasks[:2]]

    predicted = []
    again = Predictor(setup)
    monkeypatch.setattr(adapters, "adapt", lambda *_, **__: pytest.fail("the adapter is there"))
    assert predict_all(again, tasks, on_task=predicted.append) == []
    assert set(predicted) == set(tasks[2:])
    assert [(one.folder(setup.out) / PREDICTION_FILE).stat().st_mtime_ns for one in tasks[:2]] == kept
    assert all(torch.equal(read_stored(one, setup.out).prediction.depth_z, whole[one]) for one in tasks)


def test_what_is_stored_is_what_the_model_says(predictor):
    """The adapted prediction differs from the frozen one, and the model is left without its adapter."""
    one, eight_to_four, adapted = task(), task("8to4", rule="experiment"), task("adapted")
    assert predict_all(predictor, [one, eight_to_four, adapted]) == []
    scene = load_scene(predictor.setup.data, DATASET, ROOMS[0])
    samples = {one: choose_frames("da3", 16, 4, 43), eight_to_four: choose_frames("experiment", 16, 8, 43)}
    for entry, encoded in samples.items():
        found = read_stored(entry, predictor.setup.out)
        model = predictor.model
        with torch.no_grad():
            tokens = model.embed(model.preprocess([scene.photos[i] for i in encoded]).images[None])
            features = model.aggregate(tokens, reference="first")
            kept = [encoded.index(frame) for frame in found.frames]
            expected = model.decode(features.select(kept))
        torch.testing.assert_close(found.prediction.depth_z, expected.depth_z[0], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(found.prediction.T_cam_world, expected.T_cam_world[0], rtol=1e-3, atol=1e-4)
    frozen, changed = (read_stored(entry, predictor.setup.out).prediction.depth_z for entry in (one, adapted))
    assert not torch.equal(frozen, changed)


def test_equal_recipes_share_an_adapter_and_epochs_can_be_chosen(setup):
    epochs = replace(setup, changes={"epochs": 2, "batch": 1, "sets_per_scene": 1})
    first = Predictor(replace(epochs, epoch=0, out=setup.out / "first"))
    last = Predictor(replace(epochs, out=setup.out / "last"))
    jobs = last.adapter_jobs([task("adapted"), task("anchors-mixed"), task("anchors-top")])
    assert len({job.digest for job in jobs}) == len(jobs) == 2
    for one in (first, last):
        assert predict_all(one, [task("adapted")]) == []
    depths = [read_stored(task("adapted"), one.setup.out).prediction.depth_z for one in (first, last)]
    assert not torch.equal(*depths)
    per_scene = Predictor(replace(setup, adapt_per="scene"))
    assert len(per_scene.adapter_jobs([task("adapted", scene=scene) for scene in ROOMS])) == 2


def test_a_full_disk_and_a_damaged_room_are_reported_by_name(predictor, monkeypatch):
    written = []

    def full(path, arrays):
        if not written:
            written.append(path)
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        return write(path, arrays)

    write = stored.write_npz
    monkeypatch.setattr(stored, "write_npz", full)
    load_scene(predictor.setup.data, DATASET, ROOMS[1])
    room = predictor.setup.data / DATASET / f"{ROOMS[1]}.npz"
    room.write_bytes(room.read_bytes()[:1000])
    tasks = [task(), task(seed=44), task(scene=ROOMS[1]), task(scene="7")]
    problems = predict_all(predictor, tasks)
    assert [(problem.scene, problem.stage) for problem in problems] == [
        (ROOMS[0], "predict"), (ROOMS[1], "predict"), ("7", "predict"),
    ]  # fmt: skip
    assert "No space left" in problems[0].reason
    assert "damaged" in problems[1].reason
    assert [one for one, _ in stored_tasks(predictor.setup.out)] == [task(seed=44)]


def test_a_room_too_small_to_adapt_to_is_left_out(predictor, monkeypatch):
    whole = load_scene(predictor.setup.data, DATASET, ROOMS[0])
    rooms = {ROOMS[0]: whole, ROOMS[1]: whole.select([0, 1])}
    monkeypatch.setattr("freegeo.benchmark.adapters.load_scene", lambda data, dataset, name: rooms[name])
    (problem,) = predict_all(predictor, [task("adapted")])
    assert (problem.scene, problem.stage) == (ROOMS[1], "adapt")
    assert "2 frames" in problem.reason
    assert len(stored_tasks(predictor.setup.out)) == 1


@pytest.mark.parametrize(
    ("family", "recipe", "asked", "evaluated", "adapted"),
    [
        ("vggt", "released-vggt", None, "fp32", "fp16"),
        ("da3", "released-da3", None, "bf16", "fp16"),
        ("vggt", "paper", None, "fp32", "fp16"),
        ("vggt", "scene", None, "fp32", "bf16"),
        (None, "paper", None, "bf16", "fp16"),
        ("vggt", "released-vggt", "bf16", "bf16", "bf16"),
    ],
)
def test_a_published_model_is_evaluated_and_adapted_in_its_published_precision(
    setup, monkeypatch, family, recipe, asked, evaluated, adapted
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    predictor = Predictor(replace(setup, device="cuda", precision=asked, recipe=recipe))
    model = tiny_da3()
    model.spec = replace(model.spec, adaptation=replace(model.spec.adaptation, published=family))
    predictor.__dict__["model"] = model  # as loaded, but for the move to a GPU that is not there
    found = predictor.configuration(task("adapted"))
    assert (found["precision"], found["adaptation"]["precision"]) == (evaluated, adapted)
    assert predictor.configuration(task("frozen"))["precision"] == evaluated


def test_precision_on_a_cpu_is_fp32_for_everything(predictor):
    found = predictor.configuration(task("adapted"))
    assert (found["precision"], found["adaptation"]["precision"]) == ("fp32", "fp32")


def test_an_adapter_that_should_not_be_used_is_said_in_every_run_and_scored_all_the_same(setup, caplog):
    broken = replace(setup, changes={"steps": 1, "batch": 1, "lr": 100.0})
    assert predict_all(Predictor(broken), [task("adapted")]) == []
    sentence = f"the adapter for {DATASET} "
    assert ["worse at its own task" in text for text in caplog.messages if sentence in text] == [True]
    caplog.clear()
    predictor = Predictor(broken)
    [job] = predictor.adapter_jobs([task("adapted")])
    assert predictor.adapt(job) == []
    assert sentence in caplog.text


def test_an_adaptation_that_diverges_is_a_problem_of_its_tasks(setup):
    lost = replace(setup, changes={"steps": 20, "batch": 1, "lr": 100.0})
    problems = predict_all(Predictor(lost), [task("adapted"), task("frozen")])
    assert [problem.stage for problem in problems] == ["adapt", "predict"]
    assert "adaptation diverged" in problems[0].reason and "Lower --lr (now 100)" in problems[0].reason
    assert [one.variant for one, _ in stored_tasks(lost.out)] == ["frozen"]


def test_recipe_scene_is_the_same_for_every_dataset(setup):
    recipe = Predictor(replace(setup, recipe="scene")).recipe(DATASET)
    assert (recipe.name, recipe.steps) == ("scene", 2)


def test_recipe_evidence_is_refused_as_the_benchmark_makes_no_cameras_to_learn(setup):
    with pytest.raises(UserError, match="does not make the cameras that recipe 'evidence' learns from"):
        Predictor(replace(setup, recipe="evidence")).recipe(DATASET)


@pytest.mark.parametrize(
    "change",
    [
        {"dataset": "../../.."}, {"dataset": "/etc"}, {"variant": "../../../../.."}, {"scene": "other"}, {"views": 5},
        {"scene": 3}, {"new": 1}, None,
    ],
    ids=str,
)  # fmt: skip
def test_a_task_belongs_to_the_folder_that_it_lies_in(tmp_path, change):
    one = task()
    finish(one, tmp_path, {"model": "tiny"}, frames=[0])
    path = one.folder(tmp_path) / TASK_FILE
    outside = tmp_path.parent / f"{tmp_path.name}-outside"
    outside.mkdir()
    record = json.loads(path.read_text())
    assert stored_tasks(tmp_path) == [(one, record)]
    path.write_text(json.dumps([] if change is None else {**record, "task": {**record["task"], **change}}))
    with pytest.raises(FreeGeoError, match=r"task\.json: .*predict again"):
        evaluate_all(tmp_path / "data", tmp_path)
    assert sorted(path.parent.iterdir()) == [path]
