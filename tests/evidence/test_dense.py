"""Dense agreement: perfect for the truth, falling with errors of depth and cameras, on a set of pixels that stays."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from evidence_tools import VIEWS, moved_world, truth, turned
from freegeo.evidence.dense import (
    LARGEST_LOG,
    camera_difference,
    co_visible,
    confirmed_share,
    depth_agreement,
    point_difference,
    stability,
)
from freegeo.evidence.matches import choose_pairs
from freegeo.fusion.agreement import TOLERANCE_RANGE, tolerance_of
from freegeo.geometry.depth import depth_to_world

scene = cache(truth)


@cache
def fixed():
    return co_visible(scene())


def test_true_depth_is_confirmed():
    agreement = depth_agreement(scene(), fixed())
    assert agreement.reason is None
    assert agreement.mean_share > 0.97
    assert agreement.mean_log_ratio < 0.02


@pytest.mark.parametrize("spoil", ["depth", "cameras"])
def test_errors_lower_the_agreement(spoil):
    noise = torch.randn(VIEWS, 1, 1, generator=torch.Generator().manual_seed(0))
    shares, ratios = [], []
    for error in (0, 1, 2, 4, 8):
        wrong = (
            replace(scene(), depth_z=scene().depth_z * (1 + error / 100 * noise))
            if spoil == "depth"
            else replace(scene(), T_cam_world=turned(scene().T_cam_world, error))
        )
        agreement = depth_agreement(wrong, fixed())
        shares.append(agreement.mean_share)
        ratios.append(agreement.mean_log_ratio)
    assert shares == sorted(shares, reverse=True)
    assert ratios == sorted(ratios)
    assert shares[-1] < shares[0] - 0.1


@pytest.mark.parametrize("tolerance", [0.02, 0.1])
def test_the_share_of_confirmed_pixels_is_that_of_the_agreement(tolerance):
    wrong = replace(scene(), T_cam_world=turned(scene().T_cam_world, 2))
    own = co_visible(wrong)
    for one, found in ((wrong, own), (scene(), fixed())):
        for pixels in (fixed(), own):
            expected = depth_agreement(one, replace(pixels, tolerance=tolerance)).mean_share
            assert confirmed_share(found, pixels, tolerance) == expected


@pytest.mark.parametrize("error", [0.01, 0.02])
def test_the_grid_gives_the_tolerance_that_all_pixels_give(error):
    noise = error * torch.randn(scene().depth_z.shape, generator=torch.Generator().manual_seed(0))
    noisy = replace(scene(), depth_z=scene().depth_z * (1 + noise))
    usable = torch.ones_like(noisy.depth_z, dtype=torch.bool)
    expected = tolerance_of(noisy.depth_z, noisy.T_cam_world.float(), noisy.K.float(), usable)
    assert TOLERANCE_RANGE[0] < expected < TOLERANCE_RANGE[1]
    assert co_visible(noisy).tolerance == pytest.approx(expected, rel=0.1)


def test_world_frame_and_scale_do_not_matter():
    wrong = replace(scene(), T_cam_world=turned(scene().T_cam_world, 1))
    one, two = depth_agreement(wrong, fixed()), depth_agreement(moved_world(wrong), fixed())
    np.testing.assert_allclose(two.log_ratio, one.log_ratio, atol=2e-3)
    np.testing.assert_allclose(two.share, one.share, atol=5e-3)
    other = co_visible(moved_world(scene()))
    np.testing.assert_allclose(other.share, fixed().share, atol=5e-3)


def test_what_leaves_the_image_is_no_agreement():
    away = scene().T_cam_world.clone()
    away[0] = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64)) @ away[0]
    agreement = depth_agreement(replace(scene(), T_cam_world=away), fixed())
    concerned = (fixed().pairs == 0).any(axis=1)
    assert concerned.any()
    assert (agreement.share[concerned] == 0).all()
    np.testing.assert_allclose(agreement.log_ratio[concerned], LARGEST_LOG, rtol=1e-6)


def test_lost_depth_is_no_agreement():
    holes = scene().depth_z.clone()
    holes[:, :, ::2] = torch.nan
    before, after = depth_agreement(scene(), fixed()), depth_agreement(replace(scene(), depth_z=holes), fixed())
    assert after.mean_share < 0.7 * before.mean_share


def test_hidden_points_are_not_in_the_set():
    # A wall in front of everything in view 1 hides all that other views see.
    wall = scene().depth_z.clone()
    wall[1] *= 0.2
    hidden = co_visible(replace(scene(), depth_z=wall))
    assert hidden.share[0, 1] < 0.2 * fixed().share[0, 1]


def test_the_mask_limits_the_set():
    usable = torch.zeros_like(scene().depth_z, dtype=torch.bool)
    usable[:, :, :48] = True
    limited = co_visible(scene(), usable)
    assert limited.seen.any()
    assert not limited.seen[..., limited.pixel % scene().depth_z.shape[2] >= 48].any()
    assert (limited.share <= 1).all()


def test_nothing_in_common_is_said():
    away = scene().T_cam_world.clone()
    away[:, 2, 3] += 1000 * torch.arange(VIEWS)
    nothing = co_visible(replace(scene(), T_cam_world=away), torch.zeros_like(scene().depth_z, dtype=torch.bool))
    agreement = depth_agreement(scene(), nothing)
    assert np.isnan(agreement.mean_share)
    assert agreement.reason is not None


def test_co_visibility_chooses_the_pairs_that_see_most_of_each_other():
    pairs = choose_pairs(VIEWS, fixed().share, all_up_to=2, partners=1)
    common = np.minimum(fixed().share, fixed().share.T)
    np.fill_diagonal(common, -1)
    for view in range(VIEWS):
        best = tuple(sorted((view, int(common[view].argmax()))))
        assert best in {tuple(pair) for pair in pairs.tolist()}


def test_stable_predictions_differ_by_nothing_but_frame_and_scale():
    subset = [4, 0, 2]
    same, wrong = stability(
        scene(),
        [
            (subset, moved_world(scene()).select(subset)),
            (subset, replace(scene(), T_cam_world=turned(scene().T_cam_world, 3)).select(subset)),
        ],
    )
    assert same.pose_deg < 0.01
    assert same.pose_area == 1
    assert same.depth_log < 1e-5
    assert same.focal_log == 0
    assert wrong.pose_deg > 2
    assert wrong.pose_area < same.pose_area


def test_stability_sees_depth_that_bends():
    height = scene().depth_z.shape[1]
    bent = replace(scene(), depth_z=scene().depth_z * torch.linspace(0.9, 1.1, height)[:, None])
    (difference,) = stability(scene(), [(range(VIEWS), bent)])
    assert 0.02 < difference.depth_log < 0.1


def test_a_second_head_of_cameras_is_compared_by_angle_and_focal_length():
    T = moved_world(scene()).T_cam_world
    K = scene().K.clone()
    K[:, (0, 1), (0, 1)] *= 1.1
    difference = camera_difference(scene(), T, K)
    assert difference.pose_deg < 0.01
    assert difference.focal_log == pytest.approx(np.log(1.1), rel=1e-6)
    angles = [camera_difference(scene(), turned(T, degrees), K).pose_deg for degrees in (0, 1, 4)]
    assert angles == sorted(angles)


def test_a_head_of_points_is_compared_in_shares_of_depth():
    T, K = scene().T_cam_world.float(), scene().K.float()
    points = depth_to_world(scene().depth_z, K, T)
    assert point_difference(scene(), points) < 1e-5
    farther = depth_to_world(scene().depth_z * 1.1, K, T)
    found = point_difference(scene(), farther)
    # Moved along the ray by a tenth of its length, which is at least the depth.
    assert 0.1 <= found < 0.13
    assert np.isnan(point_difference(scene(), torch.full_like(points, torch.nan)))
