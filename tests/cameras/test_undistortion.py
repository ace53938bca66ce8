"""Undistorted photos are those of a pinhole: exact places, exact half pixels, nothing invisible at the border."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from cameras.conftest import DOMAIN, ROOM
from freegeo.cameras.convention import check_convention
from freegeo.cameras.known import KnownCamera, KnownCameras, Lens
from freegeo.cameras.undistortion import LENSES, undistort, undistorted
from freegeo.data.photos import MemoryPhoto
from freegeo.data.procedural import render, sample_rooms
from freegeo.errors import UserError
from freegeo.evidence.matches import find_matches

HW = (144, 192)
K = np.array([[170.0, 0, 94], [0, 168, 74], [0, 0, 1]])
EXAMPLES = [
    Lens("SIMPLE_RADIAL", (-0.15,)),
    Lens("RADIAL", (0.1, -0.05)),
    Lens("OPENCV", (-0.2, 0.05, 0.003, -0.002)),
    Lens("OPENCV_FISHEYE", (0.02, -0.01, 0.003, -0.0005)),
    Lens("FULL_OPENCV", (-0.1, 0.05, 0.001, 0.002, 0.01, 0.05, 0.01, 0.002)),
]


def by_hand(lens: Lens, rays: np.ndarray) -> np.ndarray:
    """COLMAP's formulas: where rays (n, 2) with z = 1 appear on the image plane."""
    x, y = rays.T
    r2 = x * x + y * y
    if lens.model == "OPENCV_FISHEYE":
        r, theta = np.sqrt(r2), np.arctan(np.sqrt(r2))
        bent = theta * (1 + sum(k * theta ** (2 * n + 2) for n, k in enumerate(lens.params)))
        factor = np.where(r > 0, bent / np.maximum(r, 1e-12), 1.0)
        return rays * factor[:, None]
    k1, k2, p1, p2, k3, k4, k5, k6 = {
        "SIMPLE_RADIAL": lambda p: (p[0], *[0] * 7),
        "RADIAL": lambda p: (*p, *[0] * 6),
        "OPENCV": lambda p: (*p, *[0] * 4),
        "FULL_OPENCV": lambda p: p,
    }[lens.model](lens.params)
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return np.stack(
        (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y),
        axis=1,
    )


def grey(size_hw=HW) -> MemoryPhoto:
    return MemoryPhoto("a.png", np.zeros((*size_hw, 3), np.uint8))


def border(size_hw=HW) -> np.ndarray:
    height, width = size_hw
    u, v = np.linspace(0, width, 50), np.linspace(0, height, 50)
    return np.concatenate(
        [np.stack((u, np.full(50, end)), 1) for end in (0, height)]
        + [np.stack((np.full(50, end), v), 1) for end in (0, width)]
    )


@pytest.mark.parametrize("lens", EXAMPLES, ids=lambda lens: lens.model)
def test_places_follow_the_formulas_and_their_inverse(lens):
    photo = undistort(grey(), KnownCamera(K=K, lens=lens))
    rng = np.random.default_rng(1)
    place = rng.uniform(0, HW[::-1], (200, 2))
    rays = (place - photo.K[:2, 2]) / photo.K[[0, 1], [0, 1]]
    expected = by_hand(lens, rays) * K[[0, 1], [0, 1]] + K[:2, 2]
    np.testing.assert_allclose(photo.to_original(place), expected, atol=1e-9)
    np.testing.assert_allclose(photo.from_original(photo.to_original(place)), place, atol=1e-4)


@pytest.mark.parametrize("lens", EXAMPLES, ids=lambda lens: lens.model)
def test_the_whole_photo_is_visible_and_no_focal_length_could_be_smaller(lens):
    photo = undistort(grey(), KnownCamera(K=K, lens=lens))
    np.testing.assert_array_equal(photo.K[:2, 2], [HW[1] / 2, HW[0] / 2])
    assert photo.K[0, 0] / photo.K[1, 1] == pytest.approx(K[0, 0] / K[1, 1])
    places = photo.to_original(border())
    slack = np.minimum(places, np.array(HW[::-1]) - places).min()
    # The border was looked at in other places.
    assert -1e-3 < slack < 0.1
    assert (photo.camera.lens, photo.camera.size_hw, photo.size_hw) == (None, HW, HW)


@pytest.mark.parametrize("lens", EXAMPLES, ids=lambda lens: lens.model)
def test_pixels_come_from_where_the_map_says(lens):
    """A photo whose colours are the places of its pixels shows, undistorted, the places that `to_original` gives."""
    v, u = np.mgrid[: HW[0], : HW[1]]
    ramp = MemoryPhoto("a.png", np.stack((u, v, 0 * u), axis=-1).astype(np.uint8))
    photo = undistort(ramp, KnownCamera(K=K, lens=lens))
    centres = np.stack((u, v), axis=-1).reshape(-1, 2) + 0.5
    expected = photo.to_original(centres) - 0.5
    error = np.abs(photo.read()[..., :2].reshape(-1, 2) - expected)[np.all(expected > 1, axis=1)]
    # Rounding to bytes is half a step; a half pixel's mistake would move the mean by as much.
    assert error.max() < 0.6
    signed = (photo.read()[..., :2].reshape(-1, 2) - expected).mean(axis=0)
    assert np.abs(signed).max() < 0.05


def test_a_distorted_room_is_the_undistorted_one():
    """Photos taken through a lens, undistorted, equal the pinhole's photos, and their cameras fit the matches."""
    lens = Lens("OPENCV", (-0.25, 0.06, 0.002, -0.003))
    rooms = sample_rooms([ROOM], domain=DOMAIN, frames=3)
    large = render(rooms, 432, 576)
    K_large = large.K[0, 0].double().numpy() + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    K_lens = np.array([[190.0, 0, 95], [0, 188, 73], [0, 0, 1]])
    images = (large.images[0].permute(0, 2, 3, 1) * 255).numpy()
    photos = [MemoryPhoto(f"{k}.png", through_lens(image, K_large, K_lens, lens)) for k, image in enumerate(images)]
    given = [KnownCamera(T_cam_world=T.double().numpy(), K=K_lens, lens=lens) for T in large.T_cam_world[0]]
    for k, photo in enumerate(photos):
        result = undistort(photo, given[k])
        expected = through_lens(images[k], K_large, result.K, None)
        difference = np.abs(result.read().astype(float) - expected)
        assert difference.mean() < 1.5
        for part in ((slice(0, 72), slice(0, 96)), (slice(72, 144), slice(96, 192))):
            shift, _ = cv2.phaseCorrelate(result.read()[part].mean(-1), expected[part].mean(-1))
            assert np.hypot(*shift) < 0.1
        assert difference.mean() < 0.3 * np.abs(photo.pixels.astype(float) - expected).mean()


def through_lens(image: np.ndarray, K_image: np.ndarray, K_new: np.ndarray, lens: Lens | None) -> np.ndarray:
    """Resample a large pinhole image (H, W, 3) as a camera with a lens sees it, `HW` pixels, from the formulas."""
    v, u = np.mgrid[: HW[0], : HW[1]] + 0.5
    plane = (np.stack((u, v), -1).reshape(-1, 2) - K_new[:2, 2]) / K_new[[0, 1], [0, 1]]
    rays = plane
    for _ in range(100 if lens else 0):
        rays = rays + plane - by_hand(lens, rays)
    place = rays * K_image[[0, 1], [0, 1]] + K_image[:2, 2]
    size = np.array(image.shape[1::-1])
    grid = torch.from_numpy(place / size * 2 - 1).reshape(1, *HW, 2)
    source = torch.from_numpy(image).double().permute(2, 0, 1)[None]
    # Blurred to the small pixels first.
    source = torch.nn.functional.avg_pool2d(source, 3, stride=1, padding=1, count_include_pad=False)
    sampled = torch.nn.functional.grid_sample(source, grid, padding_mode="border", align_corners=False)
    return sampled[0].permute(1, 2, 0).round().clamp(0, 255).byte().numpy()


def test_cameras_fit_the_matches_of_undistorted_photos_and_not_of_distorted_ones():
    lens = Lens("RADIAL", (-0.35, 0.1))
    large = render(sample_rooms([ROOM], domain=DOMAIN, frames=4), 432, 576)
    K_large = large.K[0, 0].double().numpy() + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    K_lens = np.array([[190.0, 0, 95], [0, 190, 73], [0, 0, 1]])
    images = (large.images[0].permute(0, 2, 3, 1) * 255).numpy()
    photos = [MemoryPhoto(f"{k}.png", through_lens(image, K_large, K_lens, lens)) for k, image in enumerate(images)]
    cameras = tuple(KnownCamera(T_cam_world=T.double().numpy(), K=K_lens, lens=lens) for T in large.T_cam_world[0])
    known = KnownCameras(names=tuple(photo.name for photo in photos), cameras=cameras, source="f")
    seen, pinholes = undistorted(photos, known)
    right = check_convention(pinholes, find_matches(seen))
    bent = replace(known, cameras=tuple(replace(one, lens=None) for one in known.cameras))
    ignored = check_convention(bent, find_matches(photos))
    assert right.errors["w2c-opencv"] < 0.15
    assert ignored.errors["w2c-opencv"] > 3 * right.errors["w2c-opencv"]


def test_a_fisheye_of_150_degrees_loses_field_of_view_and_says_so(caplog):
    focal = 96 / np.radians(75)
    wide = KnownCamera(K=np.array([[focal, 0, 96], [0, focal, 72], [0, 0, 1]]), lens=Lens("OPENCV_FISHEYE", (0.0,) * 4))
    known = KnownCameras(names=("a.png",), cameras=(wide,), source="f")
    (photo,), pinholes = undistorted([grey()], known)
    assert pinholes.cameras[0].lens is None
    field = 2 * np.degrees(np.arctan(96 / photo.K[0, 0]))
    assert field == pytest.approx(110)
    places = photo.to_original(border())
    assert (places >= 0).all() and (places <= HW[::-1]).all()
    assert caplog.messages == ["1 of 1 photos are undistorted; a.png shows 110 x 94 of 150 x 112 degrees afterwards."]


def test_a_weak_lens_is_no_doubt(caplog):
    known = KnownCameras(names=("a.png",), cameras=(KnownCamera(K=K, lens=EXAMPLES[1]),), source="f")
    undistorted([grey()], known)
    assert not caplog.records


@pytest.mark.parametrize("lens", [None, Lens("OPENCV", (0.0,) * 4), Lens("SIMPLE_RADIAL", (0.0,))])
def test_photos_without_distortion_stay_what_they_are(lens):
    photo, camera = grey(), KnownCamera(K=K, lens=lens)
    known = KnownCameras(names=("a.png",), cameras=(camera,), source="f")
    (same,), pinholes = undistorted([photo], known)
    assert same is photo
    assert pinholes.cameras[0].lens is None
    np.testing.assert_array_equal(pinholes.cameras[0].K, K)


def test_a_fisheye_without_numbers_bends_nevertheless():
    camera = KnownCamera(K=K, lens=Lens("OPENCV_FISHEYE", (0.0,) * 4))
    photo = undistort(grey(), camera)
    corner = photo.to_original(np.array([[0.0, 0.0]])) - K[:2, 2]
    pinhole = -photo.K[:2, 2] / photo.K[[0, 1], [0, 1]] * K[[0, 1], [0, 1]]
    assert np.linalg.norm(corner) < 0.95 * np.linalg.norm(pinhole)


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (KnownCamera(K=K, lens=Lens("FOV", (0.9,))), "model FOV cannot be undistorted; known are SIMPLE_RADIAL"),
        (KnownCamera(K=K, lens=Lens("RADIAL", (0.1,))), "RADIAL has 2 finite numbers"),
        (KnownCamera(K=K, lens=Lens("SIMPLE_RADIAL", (float("nan"),))), "1 finite numbers"),
        (KnownCamera(lens=EXAMPLES[0]), "distortion and intrinsics are needed"),
        (KnownCamera(K=K), "distortion and intrinsics are needed"),
        (
            KnownCamera(K=K, lens=Lens("SIMPLE_RADIAL", (-2e6,))),
            "too little around the optical axis, or its numbers are",
        ),
    ],
)
def test_lenses_that_cannot_be_undistorted(camera, words):
    with pytest.raises(UserError, match=words):
        undistort(grey(), camera)


def test_photos_too_large_for_opencv_are_refused():
    photo = MemoryPhoto("pano.png", np.broadcast_to(np.zeros(3, np.uint8), (10, 32_767, 3)))
    with pytest.raises(UserError, match=r"pano.png: the lens .RADIAL. cannot be undistorted: sides of more than 32766"):
        undistort(photo, KnownCamera(K=np.array([[9e3, 0, 16e3], [0, 9e3, 5], [0, 0, 1]]), lens=EXAMPLES[1]))


def test_a_fold_of_the_polynomial_is_never_shown():
    """Beyond a radius this lens bends rays back into the image; the undistorted photo ends before."""
    photo = undistort(grey(), KnownCamera(K=K, lens=Lens("SIMPLE_RADIAL", (-0.6,))))
    corner = np.linalg.norm(np.array(HW) / 2 / photo.K[[1, 0], [1, 0]])
    assert corner < (1 / (3 * 0.6)) ** 0.5


def test_all_lenses_have_an_example():
    assert {lens.model for lens in EXAMPLES} == set(LENSES)
