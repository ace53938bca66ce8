import math

import pytest
import torch

from freegeo.errors import UserError
from freegeo.geometry.se3 import from_Rt
from freegeo.metrics.pose import area_under_curve, pair_errors, pose_auc, score_poses
from rotations import rotation_of


def trajectory(views: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    R = rotation_of(torch.randn(views, 3, generator=generator, dtype=torch.float64))
    return from_Rt(R, torch.randn(views, 3, generator=generator, dtype=torch.float64))


def test_a_similarity_of_the_ground_truth_is_perfect():
    T = trajectory(6)
    R = rotation_of(torch.tensor([0.3, -1.0, 0.5], dtype=torch.float64))
    world = from_Rt(R, torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    moved = T @ world
    moved[:, :3, 3] *= 2.5
    assert all(value == 1 for value in score_poses(moved, T).values())


def test_a_known_rotation_gives_its_angle():
    T = trajectory(2)
    turn = from_Rt(rotation_of(torch.tensor([0.0, 0.0, math.radians(7)], dtype=torch.float64)), torch.zeros(3).double())
    errors = pair_errors(torch.stack([T[0], turn @ T[1]]), T)
    assert errors.rotation_deg.item() == pytest.approx(7, abs=1e-5)


def test_the_sign_of_the_direction_is_folded_away():
    T = trajectory(4)
    negated = T.clone()
    negated[:, :3, 3] *= -1
    assert pair_errors(negated, T).translation_deg.max() < 1e-4


def test_no_baseline_fails_by_ninety_degrees():
    T = trajectory(3)
    T[:, :3, 3] = 0
    assert pair_errors(T, T).translation_deg.tolist() == pytest.approx([90.0] * 3)


def test_a_nan_fails_its_pairs_and_stays_in_the_denominator():
    T = trajectory(4)
    broken = T.clone()
    broken[3, 0, 1] = float("nan")
    auc = score_poses(broken, T)
    assert auc["auc03"] == pytest.approx(0.5)
    broken = T.clone()
    broken[0, 0, 3] = float("nan")
    assert score_poses(broken, T)["auc30"] == 0


def test_the_curve_counts_errors_below_each_whole_degree_and_the_last_edge():
    errors = torch.tensor([0.5, 1.0, 3.0, 3.1])
    # below 1: one, below 2: two, up to 3: three of four
    assert area_under_curve(errors, 3).item() == pytest.approx((1 + 2 + 3) / 12)


def test_one_view_has_no_score():
    assert math.isnan(score_poses(trajectory(1), trajectory(1))["auc30"])


def test_scenes_can_be_scored_together():
    a, b, gt = trajectory(5, 1), trajectory(5, 2), trajectory(5, 3)
    together = area_under_curve(pair_errors(torch.stack([a, b]), torch.stack([gt, gt])).worst_deg, 30)
    alone = [pose_auc(pair_errors(T, gt).worst_deg)["auc30"] for T in (a, b)]
    assert together.tolist() == pytest.approx(alone)


def test_different_views_are_refused():
    with pytest.raises(UserError, match="same views"):
        pair_errors(trajectory(3), trajectory(4))
    with pytest.raises(UserError, match="whole number"):
        area_under_curve(torch.ones(3), 2.5)
