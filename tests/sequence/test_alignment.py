"""Properties of the alignment of two chunks that share frames."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from exact_rooms import room
from freegeo.errors import FreeGeoError, UserError
from freegeo.geometry.camera import project
from freegeo.geometry.sim3 import Sim3, umeyama
from freegeo.sequence.alignment import DOUBTFUL_INLIERS, FEWEST_INLIERS, FEWEST_PIXELS, align, align_points, gap

ROWS = [(2, 0), (3, 1)]
MOVE = Sim3.exp(torch.tensor([0.4, -1.1, 0.3, 2.0, -1.0, 0.5, 0.9], dtype=torch.float64))
"""From the room to the frame of the second chunk."""


def chunk(frames, move=None, *, noise=0.0, outliers=0.0, seed=0):
    """Some frames of an exact room in a frame of their own, with relative noise and a share of wrong depths."""
    whole = room(views=6)
    scale = 1.0 if move is None else float(move.s)
    T = torch.from_numpy(whole.T_cam_world[frames]).double()
    rng = np.random.default_rng(seed)
    depth = whole.depth_z[frames].astype(np.float64) * scale
    depth *= np.exp(noise * rng.standard_normal(depth.shape))
    wrong = rng.random(depth.shape) < outliers
    depth[wrong] *= rng.uniform(0.2, 4.0, wrong.sum())
    return replace(
        whole,
        **{name: getattr(whole, name)[frames] for name in ("images", "photo_hw", "scale_xy", "offset_xy", "K")},
        depth_z=depth,
        conf=np.ones_like(depth),
        names=tuple(whole.names[frame] for frame in frames),
        T_cam_world=(T if move is None else move.apply_to_cameras(T)).numpy(),
    )


def displacement(found, true, chunk):
    """Largest distance between two places of a chunk's cameras and points 1 unit before them, in units of the room."""
    inverse = torch.linalg.inv(torch.from_numpy(chunk.T_cam_world))
    places = torch.cat((inverse[:, :3, 3], inverse[:, :3, 3] + inverse[:, :3, 2] / true.s))
    return float(torch.linalg.vector_norm(found.apply(places) - true.apply(places), dim=-1).max())


def size_of(chunk):
    return float(np.nanmedian(chunk.depth_z))


def test_exact_chunks_are_aligned_exactly():
    first, second = chunk([0, 1, 2, 3]), chunk([2, 3, 4, 5], MOVE)
    seam = align(first, second, ROWS)
    assert seam.reason is None
    assert displacement(seam.sim3, MOVE.inverse(), second) < 1e-4 * size_of(first)
    assert (seam.frames, seam.inliers) == (2, 1.0)
    assert seam.rms < 1e-5
    assert gap(first, second, ROWS, Sim3.identity(), seam.sim3) < 1e-5
    assert gap(first, second, ROWS, MOVE, MOVE @ seam.sim3) < 1e-5


@pytest.mark.parametrize("seed", range(3))
def test_noise_and_outliers_leave_the_truth(seed):
    first = chunk([0, 1, 2, 3], noise=0.01, outliers=0.1, seed=seed)
    second = chunk([2, 3, 4, 5], MOVE, noise=0.01, outliers=0.1, seed=seed + 10)
    seam = align(first, second, ROWS)
    assert seam.reason is None
    assert displacement(seam.sim3, MOVE.inverse(), second) < 1e-3 * size_of(first)
    assert 0.75 < seam.inliers < 0.9


def points_of(chunk, rows):
    """World points (N, 3) and depths (N,) of some frames, by an inverse of the projection that is not the module's."""
    points, depths = [], []
    for row in rows:
        height, width = chunk.depth_z.shape[1:]
        v, u = np.mgrid[:height, :width]
        z = chunk.depth_z[row].ravel()
        rays = np.linalg.inv(chunk.K[row].astype(np.float64)) @ np.stack((u.ravel(), v.ravel(), np.ones(u.size)))
        T = np.linalg.inv(chunk.T_cam_world[row])
        points.append((T[:3, :3] @ (rays * z)).T + T[:3, 3])
        depths.append(z)
    return torch.from_numpy(np.concatenate(points)), torch.from_numpy(np.concatenate(depths))


@pytest.mark.parametrize("fixed_scale", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_equals_a_general_solver_of_the_same_problem(fixed_scale):
    move = Sim3.exp(MOVE.log() * torch.tensor([1, 1, 1, 1, 1, 1, 0.0])) if fixed_scale else MOVE
    first = chunk([0, 1, 2, 3], noise=0.03, outliers=0.1)
    second = chunk([2, 3, 4, 5], move, noise=0.03, outliers=0.1, seed=5)
    first.depth_z[..., np.arange(64) % 3 > 0] = np.nan  # fewer pixels for the general solver
    seam = align(first, second, ROWS[:1], fixed_scale=fixed_scale)
    (x, z_x), (y, z_y) = points_of(second, [0]), points_of(first, [2])
    x, z_x, y, z_y = (values[z_y.isfinite()] for values in (x, z_x, y, z_y))

    def residuals(step):
        sim3 = seam.sim3 @ Sim3.exp(torch.from_numpy(np.append(step, 0.0) if fixed_scale else step))
        distance = torch.linalg.vector_norm(y - sim3.apply(x), dim=-1)
        return (distance / (sim3.s * z_x * z_y).sqrt()).numpy()

    free = 6 if fixed_scale else 7
    width = min(1.5 * float(np.median(residuals(np.zeros(free)))), 0.05)
    true = (seam.sim3.inverse() @ move.inverse()).log()[:free].numpy()
    solved = least_squares(residuals, true, loss="cauchy", f_scale=width, x_scale="jac", xtol=1e-9, ftol=1e-12).x
    assert np.abs(true).max() > 1e-3
    assert np.abs(solved).max() < 1e-3  # in units of the second chunk, whose depth is 5
    assert float(seam.sim3.s) == 1.0 or not fixed_scale


def test_the_chunks_are_exchangeable():
    """Least squares of one side would make the other chunk smaller, seam by seam."""
    first, second = chunk([0, 1, 2, 3], noise=0.1), chunk([2, 3, 4, 5], MOVE, noise=0.1, seed=1)
    there, back = align(first, second, ROWS), align(second, first, [(j, i) for i, j in ROWS])
    assert (there.sim3 @ back.sim3).log().abs().max() < 1e-4
    assert there.inliers == pytest.approx(back.inliers, abs=1e-3)


def test_scale_and_frame_of_both_chunks_do_not_matter():
    first, second = chunk([0, 1, 2, 3], noise=0.02), chunk([2, 3, 4, 5], noise=0.02, seed=1)
    plain = align(first, second, ROWS)
    other = Sim3.exp(torch.tensor([-0.5, 0.2, 2.0, 30.0, 4.0, -9.0, -1.0], dtype=torch.float64))
    second_moved = chunk([2, 3, 4, 5], MOVE, noise=0.02, seed=1)
    moved = align(chunk([0, 1, 2, 3], other, noise=0.02), second_moved, ROWS)
    back = other.inverse() @ moved.sim3
    assert displacement(back, plain.sim3 @ MOVE.inverse(), second_moved) < 1e-4 * size_of(first)
    assert (moved.inliers, moved.rms) == pytest.approx((plain.inliers, plain.rms), rel=1e-3)
    assert moved.reason is None


def test_only_the_order_of_confidences_counts():
    first, second = chunk([0, 1, 2, 3], noise=0.05), chunk([2, 3, 4, 5], MOVE, noise=0.05, seed=1)
    rng = np.random.default_rng(0)
    conf = rng.uniform(1, 2, first.conf.shape)
    plain = align(replace(first, conf=conf), second, ROWS).sim3
    assert torch.equal(align(replace(first, conf=np.exp(20 * conf)), second, ROWS).sim3.t, plain.t)
    assert not torch.equal(align(first, second, ROWS).sim3.t, plain.t)


def test_confident_pixels_count_more():
    first, second = chunk([0, 1, 2, 3]), chunk([2, 3, 4, 5], MOVE)
    half = first.depth_z.shape[2] // 2
    first.depth_z[2:, :, half:] *= 1.04
    sure_of_left, sure_of_right = np.ones_like(first.conf), np.ones_like(first.conf)
    sure_of_left[..., :half] = 5
    sure_of_right[..., half:] = 5
    true = float(1 / MOVE.s)
    left, right = (
        float(align(replace(first, conf=conf), second, ROWS).sim3.s) / true for conf in (sure_of_left, sure_of_right)
    )
    assert abs(left - 1) < abs(right - 1)


def test_far_points_do_not_decide():
    """Relative to its own depth a pixel counts alike near and far, whatever unit the far ones are off by."""
    first, second = chunk([0, 1, 2, 3]), chunk([2, 3, 4, 5], MOVE)
    first.depth_z[2:, :8] *= 50  # a window onto hills, whose depth the second chunk sees 4 % nearer
    second.depth_z[:2, :8] *= 50 * 0.96
    seam = align(first, second, ROWS)
    assert displacement(seam.sim3, MOVE.inverse(), second) < 0.01 * size_of(first)
    x, y = points_of(second, [0, 1])[0], points_of(first, [2, 3])[0]
    assert displacement(umeyama(x, y), MOVE.inverse(), second) > 0.04 * size_of(first)


def test_fixed_scale_keeps_metres():
    rigid = Sim3.exp(torch.tensor([0.4, -1.1, 0.3, 2.0, -1.0, 0.5, 0.0], dtype=torch.float64))
    first, second = chunk([0, 1, 2, 3], noise=0.02), chunk([2, 3, 4, 5], rigid, noise=0.02, seed=1)
    seam = align(first, second, ROWS, fixed_scale=True)
    assert float(seam.sim3.s) == 1.0
    assert displacement(seam.sim3, rigid.inverse(), second) < 5e-3 * size_of(first)
    tenfold = align(first, chunk([2, 3, 4, 5], MOVE), ROWS, fixed_scale=True)
    assert tenfold.reason is not None


def test_one_flat_wall_is_enough():
    first, second = chunk([0, 1, 2, 3]), chunk([2, 3, 4, 5], MOVE)
    first.depth_z[2:], second.depth_z[:2] = 3.0, 3.0 * float(MOVE.s)
    seam = align(first, second, ROWS[:1])
    assert seam.reason is None
    assert displacement(seam.sim3, MOVE.inverse(), second) < 1e-4 * size_of(first)


def test_pixels_without_depth_in_one_chunk_are_left_out():
    first, second = chunk([0, 1, 2, 3]), chunk([2, 3, 4, 5], MOVE)
    first.depth_z[2, :24], second.depth_z[0, 30:] = np.nan, 0.0
    seam = align(first, second, ROWS)
    assert seam.pixels == 48 * 64 + (30 - 24) * 64
    assert displacement(seam.sim3, MOVE.inverse(), second) < 1e-4 * size_of(first)


def test_sky_is_left_out():
    first, second = chunk([0, 1, 2, 3]), chunk([2, 3, 4, 5], MOVE)
    sky = np.zeros(first.depth_z.shape, np.float32)
    sky[2:, :20] = 1.0
    first.depth_z[2:, :20] = 9.0
    assert align(replace(first, sky=sky), second, ROWS).inliers == 1.0


def test_a_frame_that_is_wrong_in_one_chunk_is_outvoted():
    first, second = chunk([0, 1, 2, 3, 4]), chunk([2, 3, 4, 5], MOVE)
    wrong = second.T_cam_world.copy()
    wrong[0] = wrong[3]
    seam = align(first, replace(second, T_cam_world=wrong), [(2, 0), (3, 1), (4, 2)])
    assert displacement(seam.sim3, MOVE.inverse(), second) < 0.02 * size_of(first)
    assert 0.6 < seam.inliers < 0.8


def test_what_cannot_be_trusted_is_named():
    first, second = chunk([0, 1, 2, 3]), chunk([2, 3, 4, 5], MOVE)

    def reason(one=first, other=second, rows=ROWS):
        said = align(one, other, rows).reason
        assert said is not None
        assert said.endswith(".")
        return said

    other_room = room(views=4, seed=8)
    assert "do not fit together" in reason(other=other_room)
    assert align(first, second, [(2, 2), (3, 3)]).doubt is not None
    assert "one colour" in reason(one=replace(first, images=np.full_like(first.images, 7)))
    assert "cut or scaled" in reason(other=replace(second, offset_xy=second.offset_xy + 3))
    huge = Sim3(s=torch.tensor(50.0, dtype=torch.float64), R=MOVE.R, t=MOVE.t)
    assert "50 times as large" in reason(other=chunk([2, 3, 4, 5], huge))
    few = replace(first, depth_z=np.where(np.arange(64) < 1, first.depth_z, np.nan))
    assert align(few, second, ROWS[:1]).pixels < FEWEST_PIXELS
    assert "only 48 pixels" in reason(one=few, rows=ROWS[:1])
    none = align(replace(first, depth_z=np.full_like(first.depth_z, np.nan)), second, ROWS)
    assert (none.pixels, none.inliers) == (0, 0.0)
    assert none.reason is not None
    assert gap(replace(first, depth_z=np.full_like(first.depth_z, np.nan)), second, ROWS, MOVE, MOVE) is None


def test_a_seam_that_fits_badly_is_used_and_doubted():
    first, second = chunk([0, 1, 2, 3]), chunk([2, 3, 4, 5], MOVE)
    wrong = np.random.default_rng(0).random(second.depth_z.shape) < 0.5
    bad = replace(second, depth_z=np.where(wrong, 2 * second.depth_z, second.depth_z))
    seam = align(first, bad, ROWS)
    assert FEWEST_INLIERS < seam.inliers < DOUBTFUL_INLIERS
    assert seam.reason is None
    assert seam.doubt is not None
    assert f"{seam.inliers:.0%}" in seam.doubt
    assert align(first, second, ROWS).doubt is None


def test_points_that_matches_measure_make_the_seam_whatever_depth_says():
    first, second = chunk([0, 1, 2, 3]), chunk([1, 2, 3, 4], MOVE)
    rows = [(1, 0), (2, 1), (3, 2)]
    bent = replace(second, depth_z=second.depth_z * np.float32(1.4))
    by_depth, by_points = align(first, bent, rows), align(first, bent, rows, measured=MOVE.inverse())
    assert not by_depth.by_matches
    assert by_points.by_matches and by_points.weight == 1
    assert by_points.reason is None and by_points.doubt is not None
    assert float((by_depth.sim3 @ MOVE).log().abs().max()) > 0.1


@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_points_that_are_known_in_both_chunks_say_how_they_lie(wrong):
    rng = np.random.default_rng(0)
    points = torch.from_numpy(rng.uniform((-2, -1, 2), (2, 1, 6), (60, 3)))
    moved = MOVE.apply(points)
    lost = rng.choice(60, int(60 * wrong), replace=False)
    moved[lost] += torch.from_numpy(rng.normal(0, 2, (len(lost), 3)))
    depths = torch.stack((points[:, 2], points[:, 2] * MOVE.s))
    seam = align_points(points, moved, depths)
    assert seam is not None and seam.by_matches and seam.frames == 0
    assert float((seam.sim3 @ MOVE).log().abs().max()) < 1e-6
    assert seam.inliers == pytest.approx(1 - wrong, abs=0.05)


def test_too_few_points_or_points_that_contradict_each_other_make_no_seam():
    rng = np.random.default_rng(0)
    points = torch.from_numpy(rng.uniform((-2, -1, 2), (2, 1, 6), (60, 3)))
    depths = torch.ones(2, 60, dtype=torch.float64) * points[:, 2]
    assert align_points(points[:9], points[:9], depths[:, :9]) is None
    assert align_points(points, torch.from_numpy(rng.permutation(points.numpy())), depths) is None
    assert align_points(torch.zeros(20, 3).double(), torch.zeros(20, 3).double(), depths[:, :20]) is None


def test_a_narrow_strip_does_not_fix_a_turn():
    def strip(one):
        wall = 3 * np.exp(0.02 * np.random.default_rng(len(one)).standard_normal(one.depth_z.shape))
        return replace(one, depth_z=np.where(np.arange(64) // 3 == 10, wall, np.nan))

    said = align(strip(chunk([0, 1, 2])), strip(chunk([2, 3, 4, 5])), [(2, 0)]).reason
    assert said is not None
    assert "narrow" in said


def test_blank_frames_among_the_shared_ones_are_left_out():
    first, second = chunk([0, 1, 2, 3]), chunk([2, 3, 4, 5], MOVE)
    images = first.images.copy()
    images[3] = 0
    second.depth_z[1] = 1.0
    seam = align(replace(first, images=images), second, ROWS)
    assert (seam.frames, seam.inliers, seam.reason) == (1, 1.0, None)


def test_nothing_to_align_is_an_error():
    first = chunk([0, 1, 2, 3])
    with pytest.raises(FreeGeoError, match="common frame"):
        align(first, first, [])
    with pytest.raises(UserError, match="no cameras"):
        align(replace(first, K=None), first, ROWS)


def test_points_are_those_of_the_pixels():
    """The reference points of this file project onto their pixels."""
    one = chunk([0, 1])
    points, _ = points_of(one, [1])
    T = torch.from_numpy(one.T_cam_world[1])
    pixels = project(points @ T[:3, :3].mT + T[:3, 3], torch.from_numpy(one.K[1]).double())
    assert float((pixels[70] - torch.tensor([6.0, 1.0])).abs().max()) < 1e-6
