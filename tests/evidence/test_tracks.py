"""Tracks joined from matches, and their triangulation with exact and with wrong cameras."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from evidence_tools import exact_matches, moved_world, truth, turned, without_matches
from freegeo.evidence.matches import Matches, Outcome
from freegeo.evidence.tracks import join_matches, pose_change, triangulate

scene = cache(truth)


def chained(ends: list[tuple[int, int]], views: list[int]) -> Matches:
    """Matches between keypoints 0, 1, ... that lie in `views` (sorted)."""
    view = np.array(views)
    count = int(view.max()) + 1
    pairs = sorted({(views[a], views[b]) for a, b in ends})
    grouped = [[e for e in ends if (views[e[0]], views[e[1]]) == pair] for pair in pairs]
    return Matches(
        names=tuple("abcdefgh"[:count]),
        photo_hw=np.full((count, 2), 100),
        match_hw=np.full((count, 2), 100),
        keypoints=np.stack((np.arange(len(views)), np.arange(len(views))), axis=1).astype(float),
        view_start=np.searchsorted(view, np.arange(count + 1)),
        pairs=np.array(pairs),
        pair_start=np.concatenate(([0], np.cumsum([len(g) for g in grouped]))),
        ends=np.array([e for g in grouped for e in g]),
        flatness=np.zeros(len(pairs)),
        tried=np.array(pairs),
        outcome=np.full(len(pairs), int(Outcome.VERIFIED)),
        candidates=np.array([len(g) for g in grouped]),
        fingerprint="chained",
    )


def test_matches_that_share_keypoints_are_one_track():
    # Keypoints 0, 1 in view 0; 2, 3 in view 1; 4 in view 2.
    tracks = join_matches(chained([(0, 2), (2, 4), (1, 3)], [0, 0, 1, 1, 2]))
    assert len(tracks) == 2
    found = {tuple(tracks.keypoint[tracks.point == p].tolist()) for p in range(2)}
    assert found == {(0, 2, 4), (1, 3)}
    assert (np.diff(tracks.point) >= 0).all()


def test_a_track_with_two_places_in_one_photo_is_left_out():
    # 0 - 2 - 4 - 3: keypoints 2 and 3 are both in view 1; 1 - 5 is another, good track.
    tracks = join_matches(chained([(0, 2), (2, 4), (3, 4), (1, 5)], [0, 0, 1, 1, 2, 2]))
    assert tracks.keypoint.tolist() == [1, 5]
    assert len(tracks) == 1


def test_pairs_can_be_left_out_to_judge_by_them():
    matches = chained([(0, 2), (2, 4), (1, 3)], [0, 0, 1, 1, 2])
    assert join_matches(matches, np.array([1])).keypoint.tolist() == [2, 4]
    assert len(join_matches(matches, np.array([], dtype=int))) == 0


def test_true_cameras_triangulate_exact_matches_exactly():
    matches = exact_matches(scene())
    tracks = join_matches(matches)
    points = triangulate(scene(), matches, tracks)
    assert points.reason is None
    assert points.share > 0.99
    assert points.median_px < 1e-3
    assert np.nanmax(points.error_px) < 0.05
    depth_range = float(scene().depth_z.max())
    assert np.nanmax(np.abs(points.xyz)) < 3 * depth_range
    assert (points.angle_deg >= 0).all() and points.angle_deg.max() > 5


def test_errors_of_the_cameras_raise_the_reprojection_error():
    matches = exact_matches(scene(), noise_px=0.3)
    tracks = join_matches(matches)
    means = []
    for degrees in (0, 0.5, 1, 2, 4):
        wrong = replace(scene(), T_cam_world=turned(scene().T_cam_world, degrees))
        means.append(triangulate(wrong, matches, tracks).median_px)
    assert means == sorted(means)
    assert means[0] < 0.3


def test_world_frame_and_scale_do_not_matter():
    matches = exact_matches(scene(), noise_px=0.3)
    tracks = join_matches(matches)
    one, two = (triangulate(s, matches, tracks) for s in (scene(), moved_world(scene())))
    np.testing.assert_allclose(two.error_px, one.error_px, atol=1e-3)
    np.testing.assert_allclose(two.angle_deg, one.angle_deg, atol=1e-3)


def test_cameras_in_one_place_triangulate_nothing():
    matches = exact_matches(scene())
    same_pixels = replace(matches, keypoints=np.tile([40.0, 30.0], (len(matches.keypoints), 1)))
    one_place = torch.eye(4, dtype=torch.float64).repeat(len(scene()), 1, 1)
    collapsed = replace(scene(), T_cam_world=one_place, K=scene().K[:1].expand(len(scene()), -1, -1))
    points = triangulate(collapsed, same_pixels, join_matches(matches))
    assert np.isnan(points.xyz).all()
    assert np.isnan(points.median_px)
    assert points.reason is not None


def test_without_matches_there_are_no_tracks_and_a_reason():
    nothing = without_matches(exact_matches(scene()))
    tracks = join_matches(nothing)
    points = triangulate(scene(), nothing, tracks)
    assert len(tracks) == 0
    assert np.isnan(points.median_px) and np.isnan(points.share)
    assert points.reason is not None


def test_pose_change_is_the_angle_of_the_move():
    T = scene().T_cam_world
    assert pose_change(T, moved_world(scene()).T_cam_world).worst_deg.max() < 0.05  # its arc cosine resolves no less
    angles = pose_change(T, turned(T, 2)).rotation_deg
    assert float(angles.mean()) == pytest.approx(2 * 2**0.5, rel=0.4)
