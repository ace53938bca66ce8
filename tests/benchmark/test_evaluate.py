import os
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from fixture_tools import fixture_path
from freegeo.benchmark import evaluate
from freegeo.benchmark.evaluate import (
    SceneReference,
    load_reference,
    mean_over_seeds,
    read_published_prediction,
    score_scene_poses,
    score_scene_surface,
    select_views,
    with_mean,
)
from freegeo.benchmark.frames import fusion_frames
from freegeo.data.datasets import registry as datasets
from freegeo.errors import FreeGeoError, UserError
from freegeo.fusion.mesh import read_mesh
from freegeo.metrics.cloud import ReferenceCloud

FOLDER = fixture_path("benchmark")


@pytest.fixture(scope="module")
def pipes():
    scene = datasets.load_scene(FOLDER / "datasets", "eth3d", "pipes")
    return scene, read_published_prediction(FOLDER / "predictions" / "eth3d" / "pipes.npz")


def test_ground_truth_as_prediction_is_perfect(pipes):
    scene, prediction = pipes
    auc = score_scene_poses(scene, replace(prediction, T_cam_world=scene.T_cam_world))
    assert all(value == 1 for value in auc.values())


def test_known_cameras_keep_their_place(pipes):
    scene, prediction = pipes
    for index, frame in enumerate(fusion_frames(scene, prediction, posed=True)):
        assert torch.equal(frame.T_cam_world, scene.T_cam_world[index])
        assert torch.equal(frame.K, scene.K[index])


def test_views_must_be_those_of_the_scene(pipes):
    scene, prediction = pipes
    with pytest.raises(UserError, match="views"):
        score_scene_poses(scene, select_views(prediction, [0, 1, 2]))
    with pytest.raises(UserError, match="lacks"):
        score_scene_poses(scene, replace(prediction, K=None))
    with pytest.raises(UserError, match="ground truth"):
        score_scene_poses(replace(scene, truth=None), prediction)


def test_an_empty_fusion_is_flagged_and_scored_as_published(pipes):
    scene, prediction = pipes
    cloud = ReferenceCloud(np.zeros((1, 3)), down_sample=10.0)
    rules = replace(datasets.protocol("eth3d"), samples=1000)
    reference = SceneReference(cloud=cloud, box=(np.zeros(3), np.zeros(3)), protocol=rules)
    score = score_scene_surface(
        scene, replace(prediction, depth_z=torch.zeros_like(prediction.depth_z)), reference=reference
    )
    assert score.empty_mesh
    assert score.triangles == 0
    assert np.isfinite(score.cloud.overall)


def test_prepared_ground_truth_is_kept_until_the_mesh_changes(pipes, tmp_path, monkeypatch):
    scene, _ = pipes
    mesh = tmp_path / "mesh.ply"
    shutil.copy(scene.truth.surface, mesh)
    scene = replace(scene, truth=replace(scene.truth, surface=mesh))
    fresh = load_reference(scene)
    first = load_reference(scene, cache=tmp_path / "kept")
    reads = []
    monkeypatch.setattr(evaluate, "read_mesh", lambda path: reads.append(path) or read_mesh(path))
    again = load_reference(scene, cache=tmp_path / "kept")
    assert not reads
    for one in (first, again):
        np.testing.assert_array_equal(one.cloud.points, fresh.cloud.points)
        np.testing.assert_array_equal(one.box, fresh.box)
    sample = fresh.cloud.points[::7] + 0.01
    assert again.score(sample) == fresh.score(sample)
    os.utime(mesh, (1, 1))
    load_reference(scene, cache=tmp_path / "kept")
    assert reads == [mesh]


def test_points_outside_the_grown_box_do_not_count():
    rules = replace(datasets.protocol("scannetpp"), down_sample=0.0)
    box = (np.zeros(3), np.ones(3))
    reference = SceneReference(cloud=ReferenceCloud(np.stack(box)), box=box, protocol=rules)
    near, far = np.array([[1.05, 1, 1]]), np.array([[9.0, 9, 9]])
    assert reference.score(np.concatenate([near, far])) == reference.score(near)
    assert reference.score(far).fscore == 0


def test_means_are_plain():
    scores = {"a": {"auc03": 0.2}, "b": {"auc03": 0.6}}
    assert with_mean(scores)["mean"]["auc03"] == pytest.approx(0.4)
    runs = [with_mean(scores), with_mean({"a": {"auc03": 1.0}})]
    assert mean_over_seeds(runs)["auc03"] == pytest.approx(0.6)
    for bad in ({}, {"mean": {"auc03": 1.0}}):
        with pytest.raises(UserError):
            with_mean(bad)


def test_stored_predictions_may_carry_an_extra_dimension(tmp_path):
    depth = np.ones((2, 3, 4, 1), np.float32)
    pose, K = np.tile(np.eye(4, dtype=np.float32)[:3], (2, 1, 1)), np.tile(np.eye(3, dtype=np.float32), (2, 1, 1))
    np.savez(tmp_path / "a.npz", depth=depth, extrinsics=pose, intrinsics=K)
    prediction = read_published_prediction(tmp_path / "a.npz")
    assert prediction.depth_z.shape == (2, 3, 4)
    assert prediction.T_cam_world.shape == (2, 4, 4)
    np.savez(tmp_path / "b.npz", depth=depth)
    with pytest.raises(FreeGeoError, match="readable"):
        read_published_prediction(tmp_path / "b.npz")
    with pytest.raises(UserError):
        read_published_prediction(tmp_path / "missing.npz")
