"""The check of conventions: what is accepted, refused, and left open, beyond the four readings of every format."""

from dataclasses import replace

import numpy as np
import pytest

from cameras.conftest import matrices
from freegeo.cameras.convention import READINGS, check_convention, matrix_of, pairs_to_check, pose_of
from freegeo.cameras.known import KnownCamera, KnownCameras, Lens
from freegeo.errors import UserError
from freegeo.evidence.matches import Matches


def with_poses(known: KnownCameras, poses) -> KnownCameras:
    cameras = tuple(replace(one, T_cam_world=T) for one, T in zip(known.cameras, poses, strict=True))
    return replace(known, cameras=cameras)


def poses(known: KnownCameras) -> np.ndarray:
    return np.stack([one.T_cam_world for one in known.cameras])


@pytest.mark.parametrize("reading", READINGS)
def test_poses_and_matrices_are_inverse_readings(reading, known):
    matrix = matrices(known, reading)
    np.testing.assert_allclose(pose_of(matrix, reading), poses(known), atol=1e-12)
    np.testing.assert_allclose(matrix_of(poses(known), reading), matrix, atol=1e-12)


def test_unit_and_world_do_not_matter(known, matches):
    world = np.eye(4)
    world[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    world[:3, 3] = (5, -7, 2)
    moved = poses(known) @ world
    moved[:, :3, 3] *= 1000
    assert check_convention(with_poses(known, moved), matches).outcome == "accepted"


def in_other_order(T):
    return T[[3, 0, 4, 1, 2]]


def with_one_unit_off(T):
    T = T.copy()
    centre = -T[2, :3, :3].T @ T[2, :3, 3]
    T[2, :3, 3] = -T[2, :3, :3] @ (1000 * centre)
    return T


def with_two_in_another_world(T):
    T = T.copy()
    T[3:, :3, 3] += [[1.0, 0, 0], [1.0, 0, 0]]
    return T


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (in_other_order, "do not fit these photos under any reading .*in another order"),
        (with_one_unit_off, "the cameras of 1 of 5 photos do not fit the others: 02.png"),
        (with_two_in_another_world, "do not fit"),
    ],
)
def test_cameras_that_fit_no_reading_are_refused(spoil, words, known, matches):
    found = check_convention(with_poses(known, spoil(poses(known))), matches)
    with pytest.raises(UserError, match=words):
        found.require()


def test_a_wrong_focal_length_is_refused_unless_it_fits(known, matches):
    def scaled(factor):
        K = known.cameras[0].K * [[factor], [factor], [1]]
        K[:2, 2] = known.cameras[0].K[:2, 2]
        return replace(known, cameras=tuple(replace(one, K=K) for one in known.cameras))

    assert check_convention(scaled(1.02), matches).outcome == "accepted"
    assert check_convention(scaled(3.0), matches).outcome == "refused"


def test_missing_intrinsics_are_fitted_or_given(known, matches):
    bare = replace(known, cameras=tuple(replace(one, K=None) for one in known.cameras))
    fitted = check_convention(bare, matches)
    assert fitted.outcome == "accepted"
    given = check_convention(bare, matches, K=np.stack([one.K for one in known.cameras]))
    exact = check_convention(known, matches)
    assert given.errors == exact.errors
    assert fitted.errors["w2c-opencv"] < 3 * exact.errors["w2c-opencv"]


def test_photos_without_a_pose_take_no_part(known, matches):
    cameras = (*known.cameras[:3], KnownCamera(), KnownCamera(K=known.cameras[4].K))
    found = check_convention(replace(known, cameras=cameras), matches)
    assert (found.outcome, found.pairs) == ("accepted", 3)


def straight_path(way) -> tuple[KnownCameras, np.ndarray, np.ndarray]:
    """Three cameras that move without a turn, their poses, and what they see."""
    points = np.random.default_rng(0).uniform([-2, -2, 4], [2, 2, 9], (80, 3))
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, :3, 3] = np.outer([0, 1, 2.2], way)
    cameras = tuple(KnownCamera(T_cam_world=t, K=PATH_K, size_hw=PATH_HW) for t in T)
    return KnownCameras(names=("a", "b", "c"), cameras=cameras, source="f"), T, points


PATH_K, PATH_HW = np.array([[200.0, 0, 100], [0, 200, 80], [0, 0, 1]]), (160, 200)


@pytest.mark.parametrize("way", [(0, 0, -0.5), (-0.4, 0, 0), (0, 0.3, 0), (0.2, 0.3, -0.4)])
def test_a_straight_path_is_told_from_its_reverse_by_what_lies_behind(way):
    """Without a turn two readings differ in the sign of the way only, and the two others may be the same cameras."""
    known, T, points = straight_path(way)
    matches = seen(points, T, PATH_K, PATH_HW)
    found = check_convention(known, matches)
    assert found.outcome == "accepted"
    assert (found.errors["c2w-opencv"], found.behind["c2w-opencv"]) == (pytest.approx(0, abs=0.01), True)
    reverse = check_convention(replace(known, convention="c2w-opencv", cameras=tuple(
        replace(one, T_cam_world=np.linalg.inv(one.T_cam_world)) for one in known.cameras
    )), matches)  # fmt: skip
    assert reverse.outcome == "refused"
    assert "they fit as world-to-camera with OpenCV axes" in reverse.sentence


@pytest.mark.parametrize(("flatness", "outcome"), [(0.95, "unchecked"), (0.3, "refused")])
def test_readings_that_fit_alike_are_left_open_only_where_the_photos_cannot_tell(flatness, outcome):
    """The cameras nod and the points are so far away that the way up, along which they shift, hardly shows."""
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (3, 1, 1))
    for k, angle in enumerate(np.radians([0, 0.35, 0.8])):
        T[k, :3, :3] = [[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]]
    T[:, 1, 3] = [0, -0.1, 0.2]
    points = rng.uniform([-200, -200, 400], [200, 200, 900], (80, 3))
    cameras = tuple(KnownCamera(T_cam_world=t, K=PATH_K, size_hw=PATH_HW) for t in T)
    known = KnownCameras(names=("a", "b", "c"), cameras=cameras, source="f")
    matches = seen(points, T, PATH_K, PATH_HW, flatness, noise=0.3)
    found = check_convention(known, matches)
    assert found.outcome == outcome, found.sentence
    assert "cannot be checked" in found.sentence if outcome == "unchecked" else "apart" in found.sentence


def seen(
    points: np.ndarray, T: np.ndarray, K: np.ndarray, size: tuple[int, int], flatness: float = 0.3, noise: float = 0.0
) -> Matches:
    """Matches of points in all views."""
    count, views = len(points), len(T)
    places = []
    for pose in T:
        pixel = (points @ pose[:3, :3].T + pose[:3, 3]) @ K.T
        shaken = np.random.default_rng(1).normal(0, noise, (count, 2))
        places.append(pixel[:, :2] / pixel[:, 2:] - 0.5 + shaken * len(places))
    pairs = np.stack(np.triu_indices(views, 1), axis=1)
    rows = np.arange(count)
    return Matches(
        names=tuple("abcdefgh"[:views]),
        photo_hw=np.tile(size, (views, 1)),
        match_hw=np.tile(size, (views, 1)),
        keypoints=np.concatenate(places),
        view_start=count * np.arange(views + 1),
        pairs=pairs,
        pair_start=count * np.arange(len(pairs) + 1),
        ends=np.concatenate([np.stack((rows + count * i, rows + count * j), axis=1) for i, j in pairs]),
        flatness=np.full(len(pairs), flatness),
        tried=pairs,
        outcome=np.zeros(len(pairs), np.int64),
        candidates=np.full(len(pairs), count),
        fingerprint="",
    )


def test_few_matches_and_few_poses_are_a_warning(known, matches, caplog):
    found = check_convention(known, matches.only(np.array([], dtype=np.int64)))
    found.require()
    assert "not enough matches between the photos to check the cameras (0 in 0 pairs)" in caplog.text
    alone = replace(known, cameras=(known.cameras[0], *[KnownCamera()] * 4))
    assert check_convention(alone, matches).outcome == "unchecked"
    assert "1 of 5 photos have a pose" in check_convention(alone, matches).sentence


def test_distortion_and_other_photos_are_a_mistake_of_the_caller(known, matches):
    with pytest.raises(ValueError, match="cameras of 4 photos and matches of 5"):
        check_convention(known.select([0, 1, 2, 3]), matches)
    bent = replace(known, cameras=tuple(replace(one, lens=Lens("RADIAL", (0.1, 0))) for one in known.cameras))
    with pytest.raises(ValueError, match="undistort the photos"):
        check_convention(bent, matches)


def test_many_photos_are_compared_with_their_neighbours():
    assert len(pairs_to_check(16)) == 120
    pairs = pairs_to_check(40)
    assert len(pairs) == 120
    assert set(pairs.ravel()) == set(range(40))
    assert (pairs[:, 0] < pairs[:, 1]).all()
