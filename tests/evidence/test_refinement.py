"""Refinement by bundle adjustment: how much better cameras get, what stays as it was, and what is refused."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from evidence_tools import matched, moved_world, turned, without_matches
from exact_rooms import room
from freegeo.errors import UserError
from freegeo.evidence import bundle
from freegeo.evidence.bundle import BundleSettings, cluster, shared_cameras, solve
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.matches import Matches, Outcome
from freegeo.evidence.refinement import bring_depth, parallax_px, refine
from freegeo.evidence.tracks import join_matches
from freegeo.export.colmap import write_colmap
from freegeo.export.reconstruction import Reconstruction
from freegeo.geometry.camera import project
from freegeo.geometry.se3 import transform_points
from freegeo.metrics.pose import pair_errors

pytest.importorskip("pycolmap", reason="needs the extra colmap")
VIEWS = 6
NOISE_PX = 0.1


@cache
def scene(views: int = VIEWS) -> Reconstruction:
    return room(views=views, hw=(72, 96), seed=5)


def perturbed(scene: Reconstruction, degrees: float = 2.0, focal: float = 1.02, seed: int = 0) -> Reconstruction:
    """Cameras turned on the spot and moved, and one wrong focal length."""
    T_true, K_true = scene.cameras()
    T = turned(torch.from_numpy(T_true).double(), degrees, seed).numpy()
    T[:, :3, 3] += np.random.default_rng(seed).normal(0, np.deg2rad(degrees), (len(T), 3))
    K = K_true.copy()
    K[:, (0, 1), (0, 1)] *= focal
    return replace(scene, T_cam_world=T.astype(np.float32), K=K)


def pose_error(T: np.ndarray, scene: Reconstruction) -> float:
    """Median over pairs of the larger angle, degrees."""
    errors = pair_errors(torch.from_numpy(np.asarray(T)).double(), torch.from_numpy(scene.cameras()[0]).double())
    return float(errors.worst_deg.median())


@cache
def exact() -> Matches:
    return matched(scene(), noise_px=NOISE_PX)


@cache
def refined(seed: int = 0):
    return refine(perturbed(scene(), seed=seed), exact())


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_pose_errors_fall_to_a_fifth(seed):
    wrong = perturbed(scene(), focal=1.02 if seed % 2 else 0.98, seed=seed)
    result = refine(wrong, exact())
    assert result.accepted, result.reason
    assert pose_error(result.T_cam_world, scene()) < 0.2 * pose_error(wrong.T_cam_world, scene())
    focal = result.K[:, 0, 0] / scene().K[:, 0, 0]
    assert np.abs(focal - 1).max() < 0.004
    assert result.refined.all()


def test_held_out_errors_fall_to_the_noise_of_the_matches():
    result = refined()
    assert result.probability == 1.0
    assert len(result.pairs) == len(result.before_px) == len(result.after_px) >= 6
    # The Sampson distance of normal noise s is |N(0, s)|, of median 0.6745 s.
    assert np.median(result.after_px) < 1.5 * 0.6745 * NOISE_PX < 0.2 * np.median(result.before_px)
    assert np.median(result.error_px) < 2 * NOISE_PX
    assert result.share_good > 0.95


def test_intrinsics_of_photos_and_model_are_the_same_camera():
    result = refined()
    assert result.photo_K[:, 0, 0] == pytest.approx(result.K[:, 0, 0] / scene().scale_xy[:, 0])
    # The middle of the image, counted from the corner.
    corner = (result.K[:, :2, 2] + 0.5 - scene().offset_xy) / scene().scale_xy
    assert result.photo_K[:, :2, 2] == pytest.approx(corner - 0.5)


def test_the_first_view_and_the_scale_of_the_prediction_stay():
    wrong = perturbed(scene())
    result = refined()
    assert np.abs(result.T_cam_world[0] - wrong.T_cam_world[0]).max() < 1e-6
    moved, without = bring_depth(wrong, result)
    assert without == ()
    assert np.median(moved.depth_z / wrong.depth_z) == pytest.approx(1, abs=0.01)
    size = np.linalg.norm(centres(result.T_cam_world)[1:], axis=1)
    assert np.median(size / np.linalg.norm(centres(scene().T_cam_world)[1:], axis=1)) == pytest.approx(1, abs=0.02)


def centres(T: np.ndarray) -> np.ndarray:
    """Camera centres (S, 3) from the first one."""
    c = -np.einsum("nij,ni->nj", T[:, :3, :3], T[:, :3, 3])
    return c - c[0]


def test_world_frame_and_unit_of_the_prediction_do_not_matter():
    wrong = perturbed(scene())
    other = moved_world(Candidate.of(wrong))
    elsewhere = replace(wrong, T_cam_world=other.T_cam_world.numpy().astype(np.float32), depth_z=other.depth_z.numpy())
    result = refine(elsewhere, exact())
    assert result.accepted
    assert pose_error(result.T_cam_world, scene()) == pytest.approx(
        pose_error(refined().T_cam_world, scene()), abs=0.01
    )
    assert np.linalg.norm(centres(result.T_cam_world), axis=1)[1:] == pytest.approx(
        3.7 * np.linalg.norm(centres(refined().T_cam_world), axis=1)[1:], rel=1e-2
    )


def test_the_result_is_the_same_every_time():
    again = refine(perturbed(scene()), exact())
    for name in ("T_cam_world", "K", "error_px", "before_px", "after_px"):
        assert np.array_equal(getattr(again, name), getattr(refined(), name)), name
    assert again.reason == refined().reason


def test_tracks_are_the_matched_pixels_not_projections():
    tracks, K = refined().tracks, refined().K
    T = torch.from_numpy(refined().T_cam_world)[tracks.view]
    there = project(transform_points(T, torch.from_numpy(tracks.xyz)[tracks.point]), torch.from_numpy(K)[tracks.view])
    off = np.linalg.norm((there.numpy() - tracks.pixel) / scene().scale_xy[tracks.view], axis=1)
    assert off == pytest.approx(refined().error_px, abs=1e-3)
    assert np.bincount(tracks.point).min() >= 2
    photo = (tracks.pixel + 0.5 - scene().offset_xy[tracks.view]) / scene().scale_xy[tracks.view] - 0.5
    distance = np.linalg.norm(photo[:, None] - exact().keypoints[None], axis=2).min(axis=1)
    assert distance.max() < 1e-6


def test_the_colmap_model_holds_the_measured_points(tmp_path):
    import pycolmap

    moved, _ = bring_depth(perturbed(scene()), refined())
    write_colmap(moved, refined().tracks, tmp_path / "0")
    model = pycolmap.Reconstruction(tmp_path / "0")
    assert model.num_points3D() == len(refined().tracks)
    # In photo pixels: the errors of the matches, not those of re-projections, which are 0.
    tracks = refined().tracks
    of_points = np.bincount(tracks.point, weights=refined().error_px) / np.bincount(tracks.point)
    assert model.compute_mean_reprojection_error() == pytest.approx(of_points.mean(), rel=1e-3)


def test_a_third_of_wrong_matches_does_no_harm():
    wrong = perturbed(scene())
    result = refine(wrong, matched(scene(), wrong=0.3))
    assert result.accepted, result.reason
    assert pose_error(result.T_cam_world, scene()) < 0.3 * pose_error(wrong.T_cam_world, scene())


def test_networks_mean_the_middle_by_half_the_width():
    height, width = scene().image_hw
    K = scene().K.copy()
    K[:, :2, 2] = width / 2, height / 2
    start, camera = shared_cameras(replace(scene(), K=K))
    assert np.array_equal(start.K.numpy(), scene().K.astype(np.float64))
    assert set(camera) == {0}


def test_photos_of_one_size_share_a_focal_length():
    K = scene().K.copy()
    K[:, (0, 1), (0, 1)] *= np.linspace(0.9, 1.1, VIEWS, dtype=np.float32)[:, None]
    other = scene().photo_hw.copy()
    other[3:] += 2
    predicted = replace(scene(), K=K, photo_hw=other)
    start, camera = shared_cameras(predicted)
    assert camera.tolist() == [0, 0, 0, 1, 1, 1]
    assert len(np.unique(start.K[:, 0, 0])) == 2
    alone, camera = shared_cameras(predicted, share_focal=False)
    assert camera.tolist() == list(range(VIEWS))
    assert alone.K[:, 0, 0].numpy() == pytest.approx(K[:, 0, 0], rel=1e-6)


def test_focal_lengths_of_their_own_are_found():
    K = scene().K.copy()
    K[:, (0, 1), (0, 1)] *= np.linspace(0.97, 1.03, VIEWS, dtype=np.float32)[:, None]
    start, camera = shared_cameras(replace(scene(), K=K), share_focal=False)
    clean = matched(scene(), noise_px=0)
    found = solve(start, camera, clean, join_matches(clean))
    assert found is not None
    assert found[0].candidate.K[:, 0, 0].numpy() == pytest.approx(scene().K[:, 0, 0], rel=0.002)


# What is refused.


def refused(scene: Reconstruction, matches: Matches, word: str) -> None:
    result = refine(scene, matches)
    assert not result.accepted
    assert word in result.reason, result.reason
    assert result.reason.endswith(".")
    with pytest.raises(ValueError, match="not accepted"):
        bring_depth(scene, result)


def turning() -> Reconstruction:
    """All photos from one place: the first camera, turned by 6 degrees from photo to photo."""
    height, width = 72, 96
    K = scene().K
    wide = np.full((VIEWS, height, width), 3.0, np.float32)
    T = np.tile(np.eye(4, dtype=np.float32), (VIEWS, 1, 1))
    for view, angle in enumerate(np.deg2rad(6.0) * np.arange(VIEWS)):
        T[view, :3, :3] = [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    rays = (grid - K[0, :2, 2]) / K[0, 0, 0]
    # Seen from its centre, a sphere has the same surface in every photo.
    wide[:] = 3.0 / np.sqrt(1 + (rays**2).sum(axis=-1))
    return replace(scene(), T_cam_world=T, depth_z=wide)


@pytest.mark.parametrize("focal", [1.0, 1.05])
@pytest.mark.parametrize("noise_px", [0.1, 0.5])
def test_photos_from_one_place_are_refused(focal, noise_px):
    still = turning()
    matches = matched(still, noise_px=noise_px)
    assert len(matches.pairs) >= 6
    refused(perturbed(still, degrees=1, focal=focal), matches, "one place")


def test_parallax_tells_turns_from_walks():
    assert parallax_px(Candidate.of(turning()), matched(turning(), noise_px=0.3)) < 0.6
    assert parallax_px(Candidate.of(scene()), exact()) > 2


def plane() -> Reconstruction:
    """Six cameras on a line before a wall."""
    T = np.tile(np.eye(4, dtype=np.float32), (VIEWS, 1, 1))
    T[:, 0, 3] = -0.25 * np.arange(VIEWS)
    T[:, 1, 3] = 0.1 * np.sin(np.arange(VIEWS))
    return replace(scene(), T_cam_world=T, depth_z=np.full((VIEWS, 72, 96), 3.0, np.float32))


def test_a_flat_wall_ends_in_a_verdict_and_never_in_worse_cameras():
    wrong = perturbed(plane(), degrees=1, focal=1.0)
    result = refine(wrong, matched(plane()))
    assert result.reason
    assert not result.accepted or pose_error(result.T_cam_world, plane()) < pose_error(wrong.T_cam_world, plane())


def test_clusters_without_overlap_are_refused():
    refused(perturbed(scene()), matched(scene(), joined=lambda i, j: (i < 3) == (j < 3)), "3 of 6 photos hang together")


def test_a_chain_that_leaves_one_photo_out_is_refined_without_it():
    lonely = matched(scene(), joined=lambda i, j: 5 not in (i, j))
    wrong = perturbed(scene())
    result = refine(wrong, lonely)
    assert result.accepted, result.reason
    assert result.refined.tolist() == [True] * 5 + [False]
    moved, without = bring_depth(wrong, result)
    assert without == (scene().names[5],)
    factors = [np.median(moved.depth_z[v] / wrong.depth_z[v]) for v in range(VIEWS)]
    assert factors[5] == pytest.approx(np.median(factors[:5]), rel=1e-5)
    # It keeps its pose relative to the one that was predicted to look most alike: the least turn and way.
    inside = [np.abs(follow(moved, v) - follow(wrong, v)).max() for v in range(5)]
    assert min(inside) < 1e-5
    R, centre = wrong.T_cam_world[:, :3, :3], np.linalg.inv(wrong.T_cam_world)[:, :3, 3]
    turn = np.arccos(np.clip((np.einsum("nii->n", R[:5] @ R[5].T) - 1) / 2, -1, 1))
    way = np.linalg.norm(centre[:5] - centre[5], axis=1) / np.median(wrong.depth_z)
    assert int(np.argmin(inside)) == int(np.argmin(turn + way))


def test_a_chain_in_which_every_photo_hangs_on_the_next_proves_nothing():
    chain = matched(scene(8), noise_px=NOISE_PX, joined=lambda i, j: j == i + 1)
    assert len(chain.pairs) == 7
    refused(perturbed(scene(8)), chain, "pairs that had no part in it fit to 0.5 px")
    assert refine(perturbed(scene(8)), matched(scene(8), noise_px=NOISE_PX, joined=lambda i, j: j <= i + 2)).accepted


def follow(scene: Reconstruction, view: int) -> np.ndarray:
    T = scene.T_cam_world.astype(np.float64)
    return T[5] @ np.linalg.inv(T[view])


def test_a_photo_at_a_scale_of_its_own_is_not_refined():
    wrong = perturbed(scene())
    depth = wrong.depth_z.copy()
    depth[5] *= 2
    result = refine(replace(wrong, depth_z=depth), exact())
    assert result.accepted, result.reason
    assert result.refined.tolist() == [True] * 5 + [False]
    depth[3:5] *= 2
    refused(replace(wrong, depth_z=depth), exact(), "fit together in the end")


def test_wrong_matches_for_the_most_part_are_refused():
    result = refine(perturbed(scene()), matched(scene(), wrong=0.9))
    assert not result.accepted


def test_random_matches_are_refused():
    for seed in range(3):
        assert not refine(perturbed(scene()), matched(scene(), wrong=1.0, seed=seed)).accepted


def test_mirrored_photos_are_refused():
    mirrored = exact()
    for views in ([1, 3, 5], [0, 1, 2, 3, 4, 5]):
        keypoints = exact().keypoints.copy()
        rows = np.isin(exact().view_of, views)
        keypoints[rows, 0] = scene().photo_hw[0, 1] - 1 - keypoints[rows, 0]
        mirrored = replace(exact(), keypoints=keypoints)
        assert not refine(perturbed(scene()), mirrored).accepted


def test_identical_photos_and_photos_without_matches_are_refused():
    refused(perturbed(scene()), without_matches(exact(), Outcome.NO_MOTION), "the same picture")
    refused(perturbed(scene()), without_matches(exact()), "None of the")
    # Even where their matches slip through: nothing moves.
    same = replace(
        scene(), **{n: np.repeat(getattr(scene(), n)[:1], VIEWS, axis=0) for n in ("depth_z", "T_cam_world")}
    )
    refused(perturbed(same), matched(same), "one place")


def test_few_points_and_few_pairs_are_refused():
    few = np.concatenate([np.arange(a, a + 3) for a in exact().pair_start[:-1]])
    thin = replace(exact(), ends=exact().ends[few], pair_start=3 * np.arange(len(exact().pairs) + 1))
    refused(perturbed(scene()), thin, "30 are needed")
    chain = matched(scene(), joined=lambda i, j: j - i == 1)
    refused(perturbed(scene()), chain, "5 pairs")


def test_a_prediction_that_is_right_is_left_alone_or_not_harmed():
    result = refine(scene(), exact())
    assert not result.accepted or pose_error(result.T_cam_world, scene()) < 0.1


def test_a_focal_length_that_runs_away_is_refused(monkeypatch):
    monkeypatch.setattr("freegeo.evidence.refinement.FOCAL_CHANGE", 1.001)
    refused(perturbed(scene()), exact(), "focal length ran away")


def test_points_that_contradict_the_depth_are_refused():
    generator = np.random.default_rng(0)
    noise = np.exp(generator.normal(0, 1, scene().depth_z.shape)).astype(np.float32)
    refused(replace(perturbed(scene()), depth_z=scene().depth_z * noise), exact(), "contradict the predicted depth")


@pytest.mark.parametrize("fault", [np.nan, 0.0])
def test_views_without_depth_do_not_matter(fault):
    wrong = perturbed(scene())
    depth = wrong.depth_z.copy()
    depth[2] = fault
    result = refine(replace(wrong, depth_z=depth), exact())
    assert result.accepted, result.reason
    assert pose_error(result.T_cam_world, scene()) < 0.2 * pose_error(wrong.T_cam_world, scene())
    _, without = bring_depth(replace(wrong, depth_z=depth), result)
    assert without == (scene().names[2],)


def test_a_reconstruction_without_cameras_and_other_matches_are_mistakes():
    with pytest.raises(UserError, match="no cameras"):
        refine(replace(scene(), T_cam_world=None, K=None), exact())
    with pytest.raises(ValueError, match="views"):
        refine(scene(4), exact())


def test_pycolmap_is_asked_for(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pycolmap", None)
    with pytest.raises(UserError, match="freegeo\\[colmap\\]"):
        refine(perturbed(scene()), exact())


def test_a_solver_that_fails_is_a_verdict(monkeypatch):
    monkeypatch.setattr(bundle, "_bundle", lambda *arguments: None)
    refused(perturbed(scene()), exact(), "found no cameras")


# Depth.


@pytest.mark.parametrize("affine", [False, True])
def test_depth_that_is_off_by_a_factor_in_each_view_is_brought_back(affine):
    factors = np.array([0.8, 0.9, 1.0, 1.0, 1.1, 1.3], np.float32)[:, None, None]
    wrong = perturbed(scene())
    wrong = replace(wrong, depth_z=wrong.depth_z * factors)
    result = refine(wrong, exact())
    assert result.accepted, result.reason
    moved, _ = bring_depth(wrong, result, affine=affine)
    ratio = np.median(moved.depth_z / scene().depth_z, axis=(1, 2))
    assert ratio / np.median(ratio) == pytest.approx(1, abs=0.02)


def test_an_affine_error_of_inverse_depth_is_brought_back_by_the_affine_fit_only():
    wrong = perturbed(scene())
    wrong = replace(wrong, depth_z=1 / (0.8 / wrong.depth_z + 0.08))
    result = refine(wrong, exact())
    assert result.accepted, result.reason
    spread = {}
    for affine in (False, True):
        ratio = bring_depth(wrong, result, affine=affine)[0].depth_z / scene().depth_z
        spread[affine] = np.median(np.abs(ratio / np.median(ratio) - 1))
    assert spread[True] < 0.01 < spread[False]


def test_cameras_and_everything_else_stay_when_depth_is_brought():
    wrong = perturbed(scene())
    moved, _ = bring_depth(wrong, refined())
    assert np.abs(moved.T_cam_world - refined().T_cam_world).max() < 1e-5
    for name in ("conf", "images", "names", "scale_xy"):
        assert getattr(moved, name) is getattr(wrong, name)


def test_gates_shrink_to_the_last():
    gates = BundleSettings().gates_px(np.array([[600, 1024], [512, 512]]))
    assert gates == [128, 32, 8, 2]
    assert BundleSettings().gates_px(np.array([[10, 12]])) == [2]
    assert cluster(join_matches(exact()), VIEWS, 8).all()


# -- depth of a second prediction


@pytest.mark.parametrize(("second", "told"), [("exact", True), ("worse", False), (None, False)])
def test_the_depth_that_the_measured_points_fit_better_is_used(monkeypatch, second, told):
    from freegeo.refined import refine_by_photos

    exact, matches = scene(), matched(scene())
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(exact.depth_z.shape, generator=generator).numpy()
    T = turned(torch.from_numpy(exact.T_cam_world).double(), 2).float().numpy()
    first = replace(exact, depth_z=exact.depth_z * np.exp(0.05 * noise), T_cam_world=T)
    # Another factor in each view, which has no say.
    factors = np.linspace(0.5, 2, VIEWS, dtype=np.float32)[:, None, None]
    answers = {"exact": exact.depth_z * factors, "worse": exact.depth_z * factors * np.exp(0.1 * noise)}
    monkeypatch.setattr("freegeo.refined.scene_matches", lambda *arguments, **options: matches)
    asked = []

    def again(priors):
        asked.append(priors)
        return None if second is None else replace(first, depth_z=answers[second].astype(np.float32))

    found = refine_by_photos(first, [], again=again)
    assert found.about["accepted"] and found.about["told"] is told
    assert asked[0].whole_cameras
    np.testing.assert_allclose(asked[0].T_cam_world[0].numpy(), found.result.T_cam_world, atol=1e-6)
    wanted, factor = (answers["exact"] if told else first.depth_z), found.result.depth_z
    ratio = factor / wanted
    np.testing.assert_allclose(ratio, ratio[:, :1, :1] * np.ones_like(ratio), rtol=1e-4)
    assert len(found.about["misfit"]) == (1 if second is None else 2)
    assert (found.about["misfit"][-1] < found.about["misfit"][0]) is told
