import os
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from fixture_tools import fixture_path
from freegeo.benchmark import scene_score
from freegeo.benchmark.frames import fusion_frames
from freegeo.benchmark.scene_score import (
    SceneReference,
    load_reference,
    score_scene_poses,
    score_scene_surface,
)
from freegeo.data.datasets import registry as datasets
from freegeo.errors import UserError
from freegeo.fusion.mesh import read_mesh
from freegeo.metrics.cloud import ReferenceCloud
from parity_benchmark import read_published_prediction, select_views

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
    fixed = replace(datasets.constants("eth3d"), samples=1000)
    reference = SceneReference(cloud=cloud, box=(np.zeros(3), np.zeros(3)), constants=fixed)
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
    monkeypatch.setattr(scene_score, "read_mesh", lambda path: reads.append(path) or read_mesh(path))
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
    fixed = replace(datasets.constants("scannetpp"), down_sample=0.0)
    box = (np.zeros(3), np.ones(3))
    reference = SceneReference(cloud=ReferenceCloud(np.stack(box)), box=box, constants=fixed)
    near, far = np.array([[1.05, 1, 1]]), np.array([[9.0, 9, 9]])
    assert reference.score(np.concatenate([near, far])) == reference.score(near)
    assert reference.score(far).fscore == 0
