"""Scores against matches: the noise floor with true cameras, rising with the error, blind to frame and scale."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from evidence_tools import exact_matches, moved_world, truth, turned, without_matches
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.matches import Matches, Outcome
from freegeo.evidence.scores import depth_scale, epipolar, off_edges, reprojection, two_view

scene, crop = cache(truth), 7


@cache
def exact() -> Matches:
    return exact_matches(scene())


@cache
def noisy() -> Matches:
    return exact_matches(scene(), noise_px=0.3)


def test_exact_matches_of_true_cameras_have_no_error():
    assert len(exact().pairs) >= 8
    assert epipolar(scene(), exact()).mean < 1e-3
    assert reprojection(scene(), exact()).mean < 0.05
    angles = two_view(scene(), exact())
    assert np.nanmedian(angles.rotation_deg) < 0.05
    assert np.nanmedian(angles.translation_deg) < 0.2
    assert angles.area() > 0.95


def test_true_cameras_give_the_noise_of_the_matches():
    # The Sampson distance of a match with normal noise s in each coordinate is |N(0, s)|: median 0.6745 s.
    assert epipolar(scene(), noisy()).mean == pytest.approx(0.6745 * 0.3, rel=0.1)
    # A reprojection error is the length of two such errors in two coordinates, about 1.1774 sqrt(2) s and more.
    assert 1.1 * 1.1774 * 0.3 < reprojection(scene(), noisy()).mean < 2 * 1.1774 * 0.3


@pytest.mark.parametrize("score", [epipolar, reprojection])
def test_errors_of_the_cameras_raise_the_error_in_pixels(score):
    degrees = (0, 0.25, 0.5, 1, 2, 4, 8)
    means = [score(replace(scene(), T_cam_world=turned(scene().T_cam_world, d)), noisy()).mean for d in degrees]
    assert means == sorted(means)
    assert means[3] > 4 * means[0]


def test_two_view_angles_are_those_of_the_error():
    errors = {}
    for degrees in (0, 2, 8):
        wrong = replace(scene(), T_cam_world=turned(scene().T_cam_world, degrees))
        errors[degrees] = two_view(wrong, exact())
    medians = [np.nanmedian(angles.rotation_deg) for angles in errors.values()]
    # Two independent turns by d degrees differ by sqrt(2) d on average.
    assert medians[0] < 0.05
    assert medians[1] == pytest.approx(2 * 2**0.5, rel=0.4)
    assert medians[2] == pytest.approx(8 * 2**0.5, rel=0.4)
    areas = [angles.area() for angles in errors.values()]
    assert areas == sorted(areas, reverse=True)


def test_a_wrong_focal_length_raises_the_epipolar_error():
    means = []
    for factor in (1, 1.02, 1.05, 1.1):
        K = scene().K.clone()
        K[:, (0, 1), (0, 1)] *= factor
        means.append(epipolar(replace(scene(), K=K), noisy()).mean)
    assert means == sorted(means)
    assert means[-1] > 1.5 * means[0]


def test_epipolar_error_is_blind_to_depth_and_reprojection_is_not():
    noise = torch.randn(len(scene()), 1, 1, generator=torch.Generator().manual_seed(0))
    bumpy = replace(scene(), depth_z=scene().depth_z * (1 + 0.03 * noise))
    assert epipolar(bumpy, noisy()).mean == epipolar(scene(), noisy()).mean
    assert reprojection(bumpy, noisy()).mean > reprojection(scene(), noisy()).mean


@pytest.mark.parametrize("factor", [0.93, 1.0, 1.06])
def test_the_scale_of_depth_against_poses_is_found(factor):
    drifted = replace(scene(), depth_z=scene().depth_z * factor)
    found = depth_scale(drifted, noisy())
    assert found.factor == pytest.approx(1 / factor, abs=0.004)
    assert found.drift == pytest.approx(abs(1 / factor - 1), abs=0.004)
    assert found.error_px <= reprojection(drifted, noisy()).mean
    assert epipolar(drifted, noisy()).mean == epipolar(scene(), noisy()).mean


def test_a_scale_beyond_the_range_is_at_its_end():
    assert depth_scale(replace(scene(), depth_z=scene().depth_z * 1.5), noisy()).factor == pytest.approx(0.9, abs=2e-3)


def test_world_frame_and_scale_do_not_matter():
    wrong = replace(scene(), T_cam_world=turned(scene().T_cam_world, 1))
    other = moved_world(wrong)
    for score in (epipolar, reprojection):
        np.testing.assert_allclose(score(other, noisy()).values, score(wrong, noisy()).values, rtol=1e-3)
    np.testing.assert_allclose(two_view(other, noisy()).rotation_deg, two_view(wrong, noisy()).rotation_deg, atol=1e-3)
    assert depth_scale(other, noisy()).factor == pytest.approx(depth_scale(wrong, noisy()).factor, abs=1e-3)


def test_models_that_crop_or_shrink_photos_get_the_same_scores():
    """The same cameras at the size of the photos, cropped, and twice as large: the same places, so the same errors."""
    cropped = truth(crop=crop)
    larger = replace(
        scene(),
        K=torch.cat((2 * scene().K[:, :2], scene().K[:, 2:]), dim=1),
        scale_xy=2 * scene().scale_xy,
        offset_xy=2 * scene().offset_xy,
    )
    larger.K[:, :2, 2] += 0.5
    expected = epipolar(scene(), noisy()).values
    np.testing.assert_allclose(epipolar(larger, noisy()).values, expected, rtol=1e-6)
    np.testing.assert_allclose(epipolar(cropped, noisy()).values, expected, rtol=1e-4)
    assert 0 < reprojection(cropped, noisy()).used.sum() < reprojection(scene(), noisy()).used.sum()
    np.testing.assert_allclose(reprojection(cropped, noisy()).mean, reprojection(scene(), noisy()).mean, rtol=0.2)


def test_errors_count_in_pixels_of_the_shrunk_photos():
    halved = replace(noisy(), match_hw=noisy().match_hw // 2)
    np.testing.assert_allclose(epipolar(scene(), halved).values, epipolar(scene(), noisy()).values / 2, rtol=1e-6)
    np.testing.assert_allclose(reprojection(scene(), halved).mean, reprojection(scene(), noisy()).mean / 2, rtol=1e-6)


def test_without_matches_there_is_no_score_and_a_reason():
    nothing = without_matches(noisy(), Outcome.FEW_KEYPOINTS)
    for result in (epipolar(scene(), nothing), reprojection(scene(), nothing)):
        assert np.isnan(result.mean) and np.isnan(result.median)
        assert result.reason is not None and "texture" in result.reason
    assert np.isnan(two_view(scene(), nothing).area())
    assert two_view(scene(), nothing).reason is not None
    scale = depth_scale(scene(), nothing)
    assert np.isnan(scale.factor) and scale.reason is not None


def test_without_depth_the_reason_names_it():
    blind = replace(scene(), depth_z=torch.full_like(scene().depth_z, torch.nan))
    assert epipolar(blind, noisy()).reason is None
    result = reprojection(blind, noisy())
    assert np.isnan(result.values).all() and "depth" in str(result.reason)
    assert np.isnan(depth_scale(blind, noisy()).drift)


def test_depth_edges_are_left_out_and_a_fixed_set_is_kept():
    torn = scene().depth_z.clone()
    torn[:, ::2] *= 1.2
    assert not off_edges(replace(scene(), depth_z=torn), noisy()).any()
    smooth = off_edges(scene(), noisy())
    assert 0.3 < smooth.mean() <= 1
    assert reprojection(replace(scene(), depth_z=torn), noisy()).reason is not None
    kept = reprojection(replace(scene(), depth_z=torn), noisy(), keep=smooth)
    assert kept.used.sum() == smooth.sum()
    assert kept.mean > reprojection(scene(), noisy(), keep=smooth).mean


def test_points_behind_a_camera_make_it_worse_not_better():
    away = scene().T_cam_world.clone()
    half_turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
    away[1] = half_turn @ away[1]
    wrong = replace(scene(), T_cam_world=away)
    values, before = reprojection(wrong, noisy()).values, reprojection(scene(), noisy()).values
    concerned = (noisy().pairs == 1).any(axis=1) & ~np.isnan(before)
    assert concerned.sum() >= 2
    assert (values[concerned] > 20 * before[concerned]).all()
    np.testing.assert_allclose(values[~concerned], before[~concerned])


def test_cameras_that_collapse_into_one_place_have_a_large_finite_error():
    T = scene().T_cam_world.clone()
    T[:, :3, 3] = 0
    result = epipolar(replace(scene(), T_cam_world=T), noisy())
    assert np.isfinite(result.values).all()
    assert result.mean > 5 * epipolar(scene(), noisy()).mean


def test_a_few_wrong_pairs_do_not_move_the_median():
    keypoints = noisy().keypoints.copy()
    first = noisy().ends[: noisy().pair_start[1], 1]
    keypoints[first] = keypoints[first[::-1]]
    spoiled = replace(noisy(), keypoints=keypoints)
    assert epipolar(scene(), spoiled).mean > 1.5 * epipolar(scene(), noisy()).mean
    assert epipolar(scene(), spoiled).median == pytest.approx(epipolar(scene(), noisy()).median, rel=0.2)


def test_another_number_of_views_is_refused():
    fewer = scene().select([0, 1, 2])
    for score in (epipolar, two_view, reprojection, depth_scale, off_edges):
        with pytest.raises(ValueError, match="views"):
            score(fewer, noisy())


def test_a_candidate_reads_a_reconstruction():
    from exact_rooms import room

    source = room()
    candidate = Candidate.of(source)
    assert len(candidate) == len(source)
    np.testing.assert_array_equal(candidate.depth_z.numpy(), source.depth_z)
    assert candidate.T_cam_world.dtype == candidate.K.dtype == torch.float64
