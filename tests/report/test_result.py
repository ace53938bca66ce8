import dataclasses

import numpy as np
import pytest
import torch

from exact_rooms import room
from example_results import disturbed, rotation_about_z, write_example
from freegeo import files
from freegeo.errors import FreeGeoError, UserError
from freegeo.geometry.sim3 import Sim3
from freegeo.report.result import align, camera_difference, load_result, moved, relative_error


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    return write_example(tmp_path_factory.mktemp("result") / "out")


def test_align_undoes_a_similarity_also_for_cameras_in_one_place():
    exact = room(4)
    change = Sim3(s=torch.tensor(2.5).double(), R=rotation_about_z(0.7), t=torch.tensor([3.0, -1, 2]).double())
    for cameras in (exact.T_cam_world, np.repeat(exact.T_cam_world[:1], 4, 0)):
        reference = dataclasses.replace(exact, T_cam_world=cameras)
        T = change.apply_to_cameras(torch.from_numpy(cameras).double()).float().numpy()
        own = dataclasses.replace(reference, T_cam_world=T, depth_z=exact.depth_z * 2.5)
        back = align(own, reference)
        assert float(back.s) == pytest.approx(1 / 2.5, rel=1e-5)
        assert torch.allclose(back.R, change.R.mT, atol=1e-5)
        assert torch.allclose(back.t, change.inverse().t, atol=1e-4)


def test_stages_share_the_frame_of_the_ground_truth(example):
    result = load_result(example)
    assert list(result.stages) == ["frozen", "adapted", "truth"]
    assert result.final.key == "adapted"
    exact = room(4)
    for key, depth_limit, angle_limit in (("frozen", 0.2, 8), ("adapted", 0.05, 2)):
        stage = result.stages[key]
        assert np.nanmean(stage.error) < depth_limit
        angle, distance = camera_difference(stage, result.truth)
        assert np.median(angle) < angle_limit
        assert np.median(distance) < 0.3
    assert np.nanmean(result.stages["frozen"].error) > 1.5 * np.nanmean(result.stages["adapted"].error)
    assert np.array_equal(result.truth.depth_z, exact.depth_z)


def test_without_ground_truth_the_frozen_one_is_moved_onto_the_adapted_one(tmp_path):
    result = load_result(write_example(tmp_path / "out", truth=False))
    assert result.truth is None
    assert result.final.error is None
    ratio = result.stages["frozen"].depth_z / result.final.depth_z
    assert np.median(ratio) == pytest.approx(1, abs=1e-3)
    assert np.median(camera_difference(result.stages["frozen"], result.final)[1]) < 0.5


def test_a_frozen_run_has_one_stage(tmp_path):
    room(3).save(tmp_path)
    result = load_result(tmp_path)
    assert list(result.stages) == ["frozen"]
    assert result.summary == {}
    files.write_json(tmp_path / "reconstruction.json", {"format": 1, "adapter": "/elsewhere"})
    assert list(load_result(tmp_path).stages) == ["adapted"]


def test_another_folder_is_moved_onto_the_first(tmp_path):
    exact = room(3)
    exact.save(tmp_path / "a")
    disturbed(exact, 0.0, 0, scale=3.0).save(tmp_path / "b")
    first, second = load_result(tmp_path / "a"), load_result(tmp_path / "b")
    assert camera_difference(second.final, first.final)[1].max() > 1
    joined = moved(second, onto=first.final)
    angle, distance = camera_difference(joined.final, first.final)
    assert angle.max() < 1e-4
    assert distance.max() < 1e-3
    assert np.allclose(joined.final.depth_z, exact.depth_z, rtol=1e-4)
    own = torch.from_numpy(second.final.world_points()[0, 0]).double()
    assert np.allclose(joined.from_own_frame.apply(own).numpy(), joined.final.world_points()[0, 0], atol=1e-3)


def test_relative_error_leaves_out_what_is_not_valid():
    depth, true = np.array([[1.0, 2.0, 0.0, 3.0]], np.float32), np.array([[2.0, 2.0, 1.0, np.nan]], np.float32)
    assert np.array_equal(relative_error(depth, true), np.array([[0.5, 0, np.nan, np.nan]], np.float32), equal_nan=True)


def test_folders_that_cannot_be_read_say_so(tmp_path):
    with pytest.raises(UserError, match="holds no reconstruction"):
        load_result(tmp_path)
    room(3).save(tmp_path)
    files.write_json(tmp_path / "reconstruction.json", {"format": 99})
    with pytest.raises(UserError, match="newer freegeo"):
        load_result(tmp_path)
    files.write_json(tmp_path / "reconstruction.json", [])
    with pytest.raises(FreeGeoError, match="damaged"):
        load_result(tmp_path)
    files.write_json(tmp_path / "reconstruction.json", {})
    room(4).save(tmp_path / "frozen")
    with pytest.raises(FreeGeoError, match="different sizes"):
        load_result(tmp_path)
