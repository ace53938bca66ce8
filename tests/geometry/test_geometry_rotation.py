import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file

from fixture_tools import fixture_path, relative_error
from freegeo.geometry import rotation
from rotations import rotation_of

axes = (
    st.tuples(*[st.floats(-1, 1)] * 3)
    .map(lambda a: torch.tensor(a, dtype=torch.float64))
    .filter(lambda a: a.norm() > 0.1)
)
near_special = st.sampled_from([0.0, math.pi]).flatmap(lambda c: st.floats(-1e-3, 1e-3).map(lambda d: abs(c - abs(d))))
angles = st.one_of(st.floats(0, math.pi), near_special, st.just(0.0), st.floats(0, 1e-7))


def test_recorded_conversions():
    recorded = load_file(fixture_path("vggt", "functions", "rotation.safetensors"))
    assert relative_error(rotation.quat_xyzw_to_matrix(recorded["quat_in"]), recorded["quat_to_mat"]) < 1e-5
    assert relative_error(rotation.matrix_to_quat_xyzw(recorded["mat_in"]), recorded["mat_to_quat"]) < 1e-5


def test_half_turn_takes_the_first_of_equal_axes():
    matrix = 2 * torch.full((3, 3), 1 / 3) - torch.eye(3)  # half turn about (1, 1, 1)
    assert torch.allclose(rotation.matrix_to_quat_xyzw(matrix), torch.tensor([3**-0.5] * 3 + [0.0]), atol=1e-6)


def test_orders_by_hand():
    assert rotation.quat_wxyz_to_xyzw(torch.tensor([1.0, 2, 3, 4])).tolist() == [2, 3, 4, 1]
    assert rotation.quat_xyzw_to_wxyz(torch.tensor([2.0, 3, 4, 1])).tolist() == [1, 2, 3, 4]


@given(axis=axes, angle=angles, length=st.floats(0.01, 100))
@settings(max_examples=150, deadline=None)
def test_quaternion_round_trip(axis, angle, length):
    axis = axis / axis.norm()
    quat = torch.cat((axis * math.sin(angle / 2), torch.tensor([math.cos(angle / 2)], dtype=torch.float64)))
    back = rotation.matrix_to_quat_xyzw(rotation.quat_xyzw_to_matrix(quat * length))
    assert back[3] >= 0
    assert min((back - quat).abs().max(), (back + quat).abs().max()) < 1e-7


@given(axis=axes, angle=angles)
@settings(max_examples=150, deadline=None)
def test_angle_between_rotations(axis, angle):
    matrix = rotation_of(axis / axis.norm() * angle)
    identity = torch.eye(3, dtype=torch.float64)
    assert rotation.rotation_angle(identity, matrix).item() == pytest.approx(angle, abs=1e-9)
    assert rotation.rotation_angle(matrix, matrix).item() == pytest.approx(0, abs=1e-9)


def test_small_angles_keep_their_digits_in_float32():
    vector = torch.tensor([1e-6, -2e-6, 3e-6])
    angle = rotation.rotation_angle(torch.eye(3), rotation_of(vector))
    assert angle.item() == pytest.approx(vector.norm().item(), rel=1e-4)


def test_one_matrix_turns_a_whole_map():
    generator = torch.Generator().manual_seed(0)
    matrix = torch.randn(2, 3, 3, generator=generator)
    vectors = torch.randn(2, 2, 5, 3, generator=generator)  # second dimension as long as the first
    expected = torch.einsum("sij,shwj->shwi", matrix, vectors)
    assert torch.allclose(rotation.rotate(matrix, vectors), expected, atol=1e-5)
    assert torch.allclose(rotation.rotate(matrix[0], vectors[0]), expected[0], atol=1e-5)


def test_no_vectors_are_turned_into_none():
    assert rotation.rotate(torch.zeros(0, 3, 3), torch.zeros(0, 3)).shape == (0, 3)
    assert rotation.rotate(torch.eye(3), torch.zeros(0, 3)).shape == (0, 3)
    assert rotation.rotate(torch.zeros(2, 3, 3), torch.zeros(2, 0, 3)).shape == (2, 0, 3)


@given(axis=axes, angle=angles, spread=st.floats(0, 1))
@settings(max_examples=50, deadline=None)
def test_mean_of_turns_to_both_sides_is_the_middle(axis, angle, spread):
    middle = rotation_of(axis / axis.norm() * angle)
    turns = spread * torch.eye(3, dtype=torch.float64)
    both = middle @ rotation_of(torch.cat((turns, -turns)))
    assert (rotation.mean_rotation(both) - middle).abs().max() < 1e-12


def test_mean_is_a_rotation_even_where_the_nearest_orthogonal_matrix_is_a_reflection():
    half_turns = rotation_of(math.pi * torch.eye(3, dtype=torch.float64))  # their mean is -I / 3
    mean = rotation.mean_rotation(half_turns)
    torch.testing.assert_close(mean @ mean.mT, torch.eye(3, dtype=torch.float64))
    assert torch.linalg.det(mean) > 0
