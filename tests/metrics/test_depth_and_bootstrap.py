import numpy as np
import pytest
import torch

from freegeo.errors import UserError
from freegeo.metrics.bootstrap import paired_interval
from freegeo.metrics.depth import score_depth


def test_the_median_scale_removes_any_scale():
    gt = torch.rand(2, 3, 8, 8) + 1
    score = score_depth(gt * 3.7, gt)
    assert score.abs_rel.tolist() == pytest.approx([0, 0], abs=1e-6)
    assert score.scale.tolist() == pytest.approx([1 / 3.7] * 2)
    assert score_depth(gt * 1.2, gt, align="none").abs_rel.tolist() == pytest.approx([0.2] * 2, rel=1e-5)


def test_delta_counts_pixels_within_a_factor():
    gt = torch.ones(1, 1, 4)
    pred = torch.tensor([[[1.24, 1.26, 0.81, 0.79]]])
    assert score_depth(pred, gt, align="none").delta1.item() == pytest.approx(0.5)


def test_invalid_pixels_do_not_count():
    gt, pred = torch.ones(1, 2, 3), torch.ones(1, 2, 3)
    gt[0, 0, 0], pred[0, 0, 1], pred[0, 1, 0] = 0, float("nan"), 50
    valid = torch.ones(1, 2, 3, dtype=torch.bool)
    valid[0, 1, 0] = False
    score = score_depth(pred, gt, valid)
    assert (score.abs_rel.item(), score.delta1.item()) == (0, 1)
    assert score_depth(pred, torch.zeros(1, 2, 3)).abs_rel.isnan()


def test_depth_of_another_shape_is_refused():
    with pytest.raises(UserError):
        score_depth(torch.ones(1, 2, 3), torch.ones(1, 2, 4))


def test_the_interval_agrees_with_the_normal_approximation():
    differences = np.random.default_rng(0).normal(0.3, 1.0, 400)
    interval = paired_interval(differences)
    half = 1.96 * differences.std() / 20
    assert interval.mean == pytest.approx(differences.mean())
    assert interval.low == pytest.approx(interval.mean - half, abs=0.02)
    assert interval.high == pytest.approx(interval.mean + half, abs=0.02)
    assert interval.excludes_zero
    assert interval == paired_interval(differences)
    assert interval != paired_interval(differences, seed=1)


def test_repeats_within_a_room_do_not_narrow_the_interval():
    rooms = np.random.default_rng(1).normal(size=50)
    single = paired_interval(rooms)
    repeated = np.repeat(rooms, 8)
    clustered = paired_interval(repeated, np.repeat(np.arange(50), 8))
    assert clustered.high - clustered.low == pytest.approx(single.high - single.low, rel=0.05)
    naive = paired_interval(repeated)
    assert naive.high - naive.low < 0.5 * (single.high - single.low)


def test_impossible_intervals_are_refused():
    for bad in ([], [float("nan")]):
        with pytest.raises(UserError):
            paired_interval(bad)
    with pytest.raises(UserError):
        paired_interval([1.0, 2.0], ["room"])
