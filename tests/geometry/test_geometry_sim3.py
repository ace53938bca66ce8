import json
import math

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


def wide(seed, scale=1.0):
    generator = torch.Generator().manual_seed(seed)
    return random_sim3(generator, 20), scale * torch.randn((20, 7), generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("size", [0.0, 1e-200, 1e-12, 1e-8, 1e-3, 1.0, math.pi - 1e-9])
def test_logarithms_and_exponentials_are_inverse(size):
    """Whatever the angle, from none to almost half a turn."""
    logarithm = wide(0)[1]
    axis = logarithm[:, :3] / torch.linalg.vector_norm(logarithm[:, :3], dim=-1, keepdim=True)
    logarithm = torch.cat((size * axis, logarithm[:, 3:]), dim=-1)
    torch.testing.assert_close(Sim3.exp(logarithm).log(), logarithm, atol=1e-12, rtol=1e-10)


def test_the_exponential_is_that_of_the_matrix():
    for logarithm in wide(1)[1]:
        x, y, z, *linear, scale = logarithm.tolist()
        generator = torch.tensor(
            [[scale, -z, y, linear[0]], [z, scale, -x, linear[1]], [-y, x, scale, linear[2]], [0, 0, 0, 0]],
            dtype=torch.float64,
        )
        expected, found = torch.linalg.matrix_exp(generator), Sim3.exp(logarithm)
        torch.testing.assert_close(found.s * found.R, expected[:3, :3])
        torch.testing.assert_close(found.t, expected[:3, 3])


def test_half_turns_come_back():
    turned = Sim3.exp(torch.tensor([0, math.pi, 0, 1.0, 2.0, 3.0, 0.5], dtype=torch.float64))
    again = Sim3.exp(turned.log())
    torch.testing.assert_close(again.R, turned.R)
    torch.testing.assert_close(again.t, turned.t)


def test_logarithms_have_slopes_everywhere():
    for size in (0.0, 1e-17, 1e-8, 1.0):
        logarithm = size * torch.ones(7, dtype=torch.float64)
        slope = torch.autograd.functional.jacobian(lambda step: Sim3.exp(step).log(), logarithm)
        torch.testing.assert_close(slope, torch.eye(7, dtype=torch.float64), atol=1e-6, rtol=0)


def test_the_logarithm_of_the_inverse_is_the_negative():
    sim3 = wide(2)[0]
    torch.testing.assert_close(sim3.inverse().log(), -sim3.log())


def test_products_apply_one_after_the_other():
    one, other = wide(3)[0], wide(4)[0]
    points = wide(5)[1][:, None, :3].expand(20, 6, 3)
    torch.testing.assert_close((one @ other).apply(points), one.apply(other.apply(points)))
    torch.testing.assert_close((one @ one.inverse()).log(), torch.zeros(20, 7, dtype=torch.float64))
    again = Sim3.stack([one[k] for k in range(20)])
    assert torch.equal(again.t, one.t)
    assert torch.equal(one[torch.tensor([3, 1])].s, one.s[[3, 1]])
    assert torch.equal(Sim3.identity().apply(points), points)


def test_the_symmetric_scale_is_the_same_from_both_sides():
    generator = torch.Generator().manual_seed(0)
    true = random_sim3(generator)
    x = torch.randn((4000, 3), generator=generator, dtype=torch.float64)
    y = true.apply(x + 0.3 * torch.randn(x.shape, generator=generator, dtype=torch.float64))
    x = x + 0.3 * torch.randn(x.shape, generator=generator, dtype=torch.float64)
    there, back = umeyama(x, y, scale="symmetric"), umeyama(y, x, scale="symmetric")
    torch.testing.assert_close((there @ back).log(), torch.zeros(7, dtype=torch.float64), atol=1e-10, rtol=0)
    assert float(there.s / true.s) == pytest.approx(1, abs=0.02)
    assert float(umeyama(x, y).s / true.s) < 0.95


def test_a_rigid_fit_is_the_best_of_all_rigid_ones():
    generator = torch.Generator().manual_seed(1)
    true = random_sim3(generator)
    x = torch.randn((30, 3), generator=generator, dtype=torch.float64)
    y = true.apply(x) + 0.1 * torch.randn(x.shape, generator=generator, dtype=torch.float64)
    weights = torch.rand(30, generator=generator, dtype=torch.float64)
    fit = umeyama(x, y, weights, scale="one")

    def cost(sim3):
        return float((weights * (y - sim3.apply(x)).square().sum(-1)).sum())

    assert float(fit.s) == 1.0
    for step in torch.eye(7, dtype=torch.float64)[:6]:
        assert cost(fit) < min(cost(fit @ Sim3.exp(0.01 * step)), cost(fit @ Sim3.exp(-0.01 * step)))
