import json

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fixture_tools import fixture_path
from freegeo.errors import UserError
from freegeo.geometry.se3 import camera_centres, from_Rt
from freegeo.geometry.sim3 import DegenerateAlignmentError, Sim3, _draw_subsets, align_cameras, umeyama
from rotations import rotation_of

CASES = json.loads(fixture_path("benchmark", "sim3", "sim3_cases.json").read_text())
ARRAYS = np.load(fixture_path("benchmark", "sim3", "sim3_cases.npz"))
OPTION_NAMES = {"sub_n": "subset_size", "inlier_thresh": "inlier_threshold", "ransac_max_iters": "iterations"}


def align_case(case):
    name = case["name"]
    options = {OPTION_NAMES[key]: value for key, value in case["options"].items()}
    seed = 42 if case["random_state"] is None else case["random_state"]
    reference, estimate = torch.from_numpy(ARRAYS[f"{name}/ext_ref"]), torch.from_numpy(ARRAYS[f"{name}/ext_est"])
    return align_cameras(reference, estimate, ransac=case["ransac"], seed=seed, **options)


@pytest.mark.parametrize("case", [case for case in CASES if not case["error"]], ids=lambda case: case["name"])
def test_recorded_alignments(case):
    result, name = align_case(case), case["name"]
    assert float(result.sim3.s) == pytest.approx(case["scale"], rel=1e-5)
    np.testing.assert_allclose(result.sim3.R, ARRAYS[f"{name}/rotation"], atol=1e-4)
    np.testing.assert_allclose(result.sim3.t, ARRAYS[f"{name}/translation"], atol=1e-4, rtol=1e-5)
    expected = ARRAYS[f"{name}/aligned_ext"]
    np.testing.assert_allclose(result.T_cam_world[:, : expected.shape[1]], expected, atol=1e-4)
    if case["ransac"]:
        assert result.inlier_threshold == pytest.approx(case["inlier_threshold"], rel=1e-4, abs=1e-6)


@pytest.mark.parametrize("case", [case for case in CASES if case["error"]], ids=lambda case: case["name"])
def test_impossible_alignments_are_refused(case):
    with pytest.raises(DegenerateAlignmentError, match="at least three views"):
        align_case(case)


def test_recorded_subsets():
    for record in json.loads(fixture_path("benchmark", "sim3", "ransac_subsets.json").read_text()):
        assert _draw_subsets(record["views"], record["sub_n"], len(record["subsets"]), 42) == record["subsets"]


def random_sim3(generator, *leading):
    def draw(*shape):
        return torch.randn((*leading, *shape), generator=generator, dtype=torch.float64)

    return Sim3(s=draw().exp(), R=rotation_of(draw(3)), t=draw(3))


@given(seed=st.integers(0, 10**6), flat=st.booleans(), weighted=st.booleans())
@settings(max_examples=40, deadline=None)
def test_umeyama_recovers_a_known_transform(seed, flat, weighted):
    generator = torch.Generator().manual_seed(seed)
    truth = random_sim3(generator, 2)
    x = torch.randn(2, 9, 3, generator=generator, dtype=torch.float64)
    if flat:
        x[..., 2] = 0.7  # coplanar: the reflection has to be ruled out
    y = truth.apply(x)
    weights = None
    if weighted:
        y[:, 0] += 100  # an outlier the weights exclude
        weights = torch.ones(2, 9, dtype=torch.float64)
        weights[:, 0] = 0
    found = umeyama(x, y, weights)
    for name in ("s", "R", "t"):
        assert torch.allclose(getattr(found, name), getattr(truth, name), atol=1e-8)
    assert torch.allclose(torch.linalg.det(found.R), torch.ones(2, dtype=torch.float64))
    assert torch.allclose(truth.inverse().apply(truth.apply(x)), x, atol=1e-9)


def test_mirrored_points_still_give_a_rotation():
    x = torch.randn(20, 3, generator=torch.Generator().manual_seed(1))
    found = umeyama(x, x * torch.tensor([1.0, 1.0, -1.0]))
    assert torch.linalg.det(found.R).item() == pytest.approx(1, abs=1e-5)
    assert found.s.dtype == torch.float32
    assert found.s > 0


def test_cameras_move_with_their_centres():
    generator = torch.Generator().manual_seed(3)
    move = random_sim3(generator)
    T = from_Rt(rotation_of(torch.randn(5, 3, generator=generator, dtype=torch.float64)), torch.ones(5, 3).double())
    moved = move.apply_to_cameras(T)
    assert torch.allclose(camera_centres(moved), move.apply(camera_centres(T)), atol=1e-10)
    assert torch.allclose(moved[:, :3, :3].mT, move.R @ T[:, :3, :3].mT, atol=1e-12)


def test_an_outlier_camera_is_found():
    generator = torch.Generator().manual_seed(5)
    R = rotation_of(torch.randn(12, 3, generator=generator, dtype=torch.float64))
    reference = from_Rt(R, torch.randn(12, 3, generator=generator, dtype=torch.float64))
    estimate = random_sim3(generator).apply_to_cameras(reference)
    estimate[4, :3, 3] += 30
    result = align_cameras(reference, estimate)
    assert not result.inliers[4]
    assert torch.allclose(result.T_cam_world[:4], reference[:4], atol=1e-8)


def test_nearly_collinear_float32_points_are_refused():
    line = torch.linspace(0, 1, 6)[:, None] * torch.tensor([0.3, 0.7, 0.2])
    with pytest.raises(DegenerateAlignmentError):
        umeyama(line, line)


def test_bad_input_is_named():
    poses = torch.eye(4).repeat(4, 1, 1)
    with pytest.raises(UserError, match="same views"):
        align_cameras(poses, poses[:3])
    with pytest.raises(UserError, match="NaN"):
        umeyama(torch.full((4, 3), float("nan")), torch.zeros(4, 3))
