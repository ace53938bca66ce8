import numpy as np
import pytest
import torch

from freegeo.errors import UserError
from freegeo.geometry.se3 import from_Rt
from freegeo.metrics.cloud import f1_rel5, morton_order, nearest_distances, score_clouds, voxel_average
from rotations import rotation_of

RNG = np.random.default_rng(0)


def test_distances_equal_brute_force_in_query_order():
    query, reference = RNG.normal(size=(300, 3)), RNG.normal(size=(200, 3)) * 5
    brute = np.sqrt(((query[:, None] - reference[None]) ** 2).sum(-1)).min(axis=1)
    np.testing.assert_allclose(nearest_distances(query, reference), brute, rtol=1e-12)


def test_morton_order_is_a_permutation_that_keeps_neighbours_together():
    points = RNG.uniform(size=(2000, 3))
    order = morton_order(points)
    assert sorted(order) == list(range(2000))
    steps = np.linalg.norm(np.diff(points[order], axis=0), axis=1).mean()
    assert steps < 0.4 * np.linalg.norm(np.diff(points, axis=0), axis=1).mean()


def test_voxel_average_of_far_apart_points_does_not_mix_them():
    # More than 2^21 cells wide: the cell codes alone would not be unique.
    points = np.array([[0.0, 0, 0], [0.001, 0, 0], [2.0**22, 0, 0], [2.0**21, 1.0, 0]])
    averaged = voxel_average(points, 0.9)
    assert len(averaged) == 3
    assert [0.0005, 0.0, 0.0] in averaged.tolist()


def test_an_empty_cloud_scores_infinite_distances():
    score = score_clouds(np.empty((0, 3)), RNG.normal(size=(5, 3)), threshold=1.0, down_sample=0.1)
    assert score.acc == score.comp == score.overall == float("inf")
    assert score.precision == score.recall == score.fscore == 0


def test_the_threshold_is_strict():
    zero, half = np.zeros((1, 3)), np.array([[0.5, 0, 0]])
    assert score_clouds(half, zero, threshold=0.5).fscore == 0
    assert score_clouds(half, zero, threshold=0.501).fscore == 1


def test_bad_clouds_are_refused():
    with pytest.raises(UserError, match="finite"):
        score_clouds(np.full((2, 3), np.nan), np.zeros((2, 3)), threshold=1)
    with pytest.raises(UserError, match="shape"):
        score_clouds(np.zeros((2, 2)), np.zeros((2, 3)), threshold=1)
    with pytest.raises(UserError):
        nearest_distances(np.zeros((2, 3)), np.zeros((0, 3)))


def _small_scene():
    generator = torch.Generator().manual_seed(3)
    R = rotation_of(0.2 * torch.randn(8, 3, generator=generator))
    T = from_Rt(R, torch.randn(8, 3, generator=generator))
    K = torch.tensor([[20.0, 0, 12], [0, 20.0, 9], [0, 0, 1]]).expand(8, 3, 3)
    return 2 + torch.rand(8, 18, 24, generator=generator), K, T


def test_f1_rel5_does_not_see_a_similarity():
    depth, K, T = _small_scene()
    world = from_Rt(rotation_of(torch.tensor([0.5, 0.2, -0.8])), torch.tensor([3.0, -1.0, 2.0]))
    moved = T @ world
    moved[:, :3, 3] *= 0.4
    score = f1_rel5(0.4 * depth, K, moved, depth, K, T)
    assert score.fscore == 1
    assert score.overall < 1e-4


def test_f1_rel5_moves_nothing_that_is_posed():
    depth, K, T = _small_scene()
    assert f1_rel5(depth, K, T, depth, K, T, posed=True).fscore == 1
    assert f1_rel5(1.3 * depth, K, T, depth, K, T, posed=True).fscore < 0.5


def test_f1_rel5_asks_for_the_points_of_all_views():
    depth, K, T = _small_scene()
    kept = (0, 2, 4, 6)
    chosen = list(kept)
    score = f1_rel5(depth[chosen], K[chosen], T[chosen], depth, K, T, views=kept)
    assert score.precision == 1
    assert 0.4 < score.recall < 1
    with pytest.raises(UserError):
        f1_rel5(depth[:3], K[:3], T[:3], depth, K, T, views=kept)
