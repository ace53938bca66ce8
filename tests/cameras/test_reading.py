"""Names, sizes and EXIF turns are brought together with the photos, or refused; partial cameras are said."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from cameras.conftest import HW, write
from freegeo.cameras import colmap, plain
from freegeo.cameras.convention import check_convention
from freegeo.cameras.exif import exif_focal
from freegeo.cameras.known import KnownCameras, Lens
from freegeo.cameras.reading import read_cameras
from freegeo.cameras.undistortion import undistort
from freegeo.data.photos import MemoryPhoto, open_photos
from freegeo.errors import UserError


def numbered(known: KnownCameras, names: list[str]) -> KnownCameras:
    return replace(known, names=tuple(names), cameras=known.cameras[: len(names)])


def stored(folder: Path, names: list[str], size_hw=HW, orientation: int | None = None) -> list:
    """Grey photo files in folders, possibly with an EXIF orientation, as photos."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        image = Image.fromarray(np.full((*size_hw, 3), 90, np.uint8))
        exif = Image.Exif()
        if orientation is not None:
            exif[0x0112] = orientation
        image.save(folder / name, exif=exif)
    return open_photos([folder / name for name in names])


def order(read: KnownCameras, known: KnownCameras) -> list[int | None]:
    """For each photo, whose camera it got."""
    return [
        None if one.T_cam_world is None else next(
            k for k, other in enumerate(known.cameras) if np.allclose(one.T_cam_world, other.T_cam_world, atol=1e-9)
        )
        for one in read.cameras
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("of_file", "of_photos", "expected"),
    [
        (["a.png", "b.png", "c.png"], ["c.png", "a.png", "b.png"], [2, 0, 1]),
        (["images/a.jpg", "images/b.jpg"], ["b.png", "a.png"], [1, 0]),
        (["./train/r_0", "./train/r_1"], ["r_1.png", "r_0.png"], [1, 0]),
        (["left/a.png", "right/a.png"], ["right/a.png", "left/a.png"], [1, 0]),
        (["in/left/a.jpg", "in/right/a.jpg"], ["right/a.png", "left/a.png"], [1, 0]),
        (["a.png", "b.png"], ["a.png", "z.png", "b.png"], [0, None, 1]),
        (["frame-000000", "frame-000001"], ["frame-000001.color.png", "frame-000000.color.png"], [1, 0]),
        (["shot.1.png", "shot.2.png"], ["shot.2.png", "shot.1.png"], [1, 0]),
        (["left\\a.png", "right\\a.png"], ["right/a.png", "left/a.png"], [1, 0]),
    ],
)
def test_names_find_their_photos(of_file, of_photos, expected, known, tmp_path):
    plain.write(numbered(known, of_file), tmp_path / "c.json")
    photos = stored(tmp_path / "photos", of_photos)
    assert order(read_cameras(tmp_path / "c.json", photos), known) == expected


def test_an_ending_decides_between_two_of_one_stem(known, tmp_path):
    plain.write(numbered(known, ["a.jpg", "a.png"]), tmp_path / "c.json")
    assert order(read_cameras(tmp_path / "c.json", stored(tmp_path / "p", ["a.png"])), known) == [1]


@pytest.mark.parametrize(
    ("of_file", "of_photos", "words"),
    [
        (
            ["x.png", "y.png"],
            ["a.png", "b.png"],
            r"cameras are of other photos: it names x.png, y.png, and the photos are",
        ),
        (["l/a.png", "r/a.png"], ["a.png"], r"the photo a.png may be l/a.png or r/a.png"),
        (["a.png", "b.png"], ["l/a.png", "r/a.png"], r"the camera a.png fits the photos l/a.png and r/a.png"),
    ],
)
def test_names_that_cannot_be_told_are_refused(of_file, of_photos, words, known, tmp_path):
    plain.write(numbered(known, of_file), tmp_path / "c.json")
    with pytest.raises(UserError, match=words):
        read_cameras(tmp_path / "c.json", stored(tmp_path / "p", of_photos))


def test_photos_without_a_camera_are_said(known, scene, tmp_path, caplog):
    plain.write(known.select([0, 3]), tmp_path / "c.json")
    read = read_cameras(tmp_path / "c.json", scene.photos)
    assert read.has_pose.tolist() == read.has_K.tolist() == [True, False, False, True, False]
    assert [r.getMessage() for r in caplog.records if r.levelname == "WARNING"] == [
        f"{tmp_path}/c.json has cameras of 2 of 5 photos; unknown: 01.png, 02.png, 04.png."
    ]


def test_cameras_without_a_photo_are_noted_and_no_doubt(known, scene, tmp_path, caplog):
    plain.write(known, tmp_path / "c.json")
    caplog.set_level("INFO")
    assert read_cameras(tmp_path / "c.json", scene.photos[:3]).has_pose.all()
    assert "2 cameras are of no photo here: 03.png, 04.png" in caplog.text
    assert not [record for record in caplog.records if record.levelname == "WARNING"]


@pytest.mark.parametrize(
    ("photo_hw", "accepted"),
    [((72, 96), True), ((71, 96), True), ((288, 384), True), ((37, 49), True), ((143, 192), True),
     ((144, 180), False), ((72, 90), False), ((192, 144), False), ((142, 192), False)],
)  # fmt: skip
def test_intrinsics_follow_a_resize_and_refuse_a_crop(photo_hw, accepted, known, tmp_path):
    plain.write(known.select([0]), tmp_path / "c.json")
    photos = [MemoryPhoto("00.png", np.zeros((*photo_hw, 3), np.uint8))]
    if not accepted:
        with pytest.raises(UserError, match=r"of an image of 192 x 144, which has another shape: .* cut or turned"):
            read_cameras(tmp_path / "c.json", photos)
        return
    read = read_cameras(tmp_path / "c.json", photos).cameras[0]
    corners = np.array([[0, 0, 1], [HW[1], HW[0], 1]]) @ np.linalg.inv(known.cameras[0].K).T
    np.testing.assert_allclose((corners @ read.K.T)[:, :2], [[0, 0], photo_hw[::-1]], atol=1e-9)
    assert read.size_hw == photo_hw


@pytest.mark.parametrize("orientation", [6, 8])
def test_cameras_of_a_photo_as_it_is_stored_turn_with_it(orientation, known, scene, matches, tmp_path):
    """The photos of the room are stored lying, with the EXIF entry that turns them upright."""
    turned = [np.rot90(photo.pixels, 1 if orientation == 6 else -1) for photo in scene.photos]
    (tmp_path / "p").mkdir()
    for photo, pixels in zip(scene.photos, turned, strict=True):
        exif = Image.Exif()
        exif[0x0112] = orientation
        Image.fromarray(pixels).save(tmp_path / "p" / photo.name, exif=exif)
    photos = open_photos([tmp_path / "p" / photo.name for photo in scene.photos])
    np.testing.assert_array_equal(photos[0].read(), scene.photos[0].pixels)
    # Cameras of the stored photos, made from those of the upright ones: the same rays, other axes and pixels.
    turn = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    turn = turn if orientation == 6 else turn.T
    height, width = HW
    cameras = []
    for one in known.cameras:
        fx, fy, cx, cy = one.K[0, 0], one.K[1, 1], one.K[0, 2], one.K[1, 2]
        centre = (cy, width - cx) if orientation == 6 else (height - cy, cx)
        K = np.array([[fy, 0, centre[0]], [0, fx, centre[1]], [0, 0, 1]])
        cameras.append(replace(one, T_cam_world=turn @ one.T_cam_world, K=K, size_hw=(width, height)))
    colmap.write(replace(known, cameras=tuple(cameras)), tmp_path / "model")
    read = read_cameras(tmp_path / "model", photos)
    for one, other in zip(read.cameras, known.cameras, strict=True):
        np.testing.assert_allclose(one.T_cam_world, other.T_cam_world, atol=1e-9)
        np.testing.assert_allclose(one.K, other.K, atol=1e-9)
    assert check_convention(read, matches).outcome == "accepted"


def test_tangential_distortion_turns_with_the_photo(known, tmp_path):
    """A place in the stored photo and the same place in the upright one are on the same ray."""
    lens = Lens("OPENCV", (-0.1, 0.02, 0.01, -0.02))
    K = np.array([[150.0, 0, 90], [0, 160, 70], [0, 0, 1]])
    one = replace(known.cameras[0], lens=lens, K=K)
    names = ["00.png"]
    colmap.write(KnownCameras(names=("00.png",), cameras=(one,), source=""), tmp_path / "model")
    photo = stored(tmp_path / "p", names, HW, orientation=6)[0]
    read = read_cameras(tmp_path / "model", [photo]).cameras[0]
    place = np.array([[20.0, 30.0], [100.0, 80.0]])
    upright = np.stack((HW[0] - place[:, 1], place[:, 0]), axis=1)
    rays = [
        (undistort(p, c).from_original(x) - undistort(p, c).K[:2, 2]) / undistort(p, c).K[[0, 1], [0, 1]]
        for p, c, x in ((MemoryPhoto("", np.zeros((*HW, 3), np.uint8)), one, place), (photo, read, upright))
    ]
    np.testing.assert_allclose(rays[1], np.stack((-rays[0][:, 1], rays[0][:, 0]), axis=1), atol=1e-7)


@pytest.mark.parametrize(
    ("format", "orientation", "size_hw", "words"),
    [
        ("colmap", 3, HW, "cannot be known whether"),
        ("colmap", 6, (192, 192), "another shape"),
        ("colmap", 6, HW[::-1], None),
        ("cameras.json", 3, HW, None),
        ("poses", 6, HW, "cannot be known whether"),
        ("poses", 1, HW, None),
        ("poses", None, HW, None),
        ("colmap", 5, HW, "another shape"),
    ],
)
def test_a_turn_that_cannot_be_known_is_refused(format, orientation, size_hw, words, known, tmp_path):
    """The size of the stored photo is given; the cameras are of a photo of 192 x 144."""
    path = write(format, known.select([0]), tmp_path, "w2c-opencv" if format != "poses" else "c2w-opencv").path
    photos = stored(tmp_path / "p", ["00.png"], size_hw, orientation)
    if words is None:
        read = read_cameras(path, photos).cameras[0]
        np.testing.assert_allclose(read.T_cam_world, known.cameras[0].T_cam_world, atol=1e-9)
        return
    with pytest.raises(UserError, match=words):
        read_cameras(path, photos)


@pytest.mark.parametrize(("orientation", "refused"), [(6, True), (1, False)])
def test_the_size_of_a_square_photo_does_not_tell_its_turn(orientation, refused, known, tmp_path):
    square = replace(known.cameras[0], size_hw=(192, 192))
    colmap.write(KnownCameras(names=("00.png",), cameras=(square,), source=""), tmp_path / "model")
    photos = stored(tmp_path / "p", ["00.png"], (96, 96), orientation)
    if refused:
        with pytest.raises(UserError, match="turned by its EXIF data, and it cannot be known whether"):
            read_cameras(tmp_path / "model", photos)
    else:
        assert read_cameras(tmp_path / "model", photos).has_pose.all()


def test_lengths_are_metres_when_the_file_or_the_user_says_so(known, scene, tmp_path):
    for of_file in (False, True):
        plain.write(replace(known, metric=of_file), tmp_path / "c.json")
        assert read_cameras(tmp_path / "c.json", scene.photos).metric == of_file
        assert read_cameras(tmp_path / "c.json", scene.photos, metric=True).metric


EXIF, FOCAL, FOCAL_35 = 0x8769, 0x920A, 0xA405
RESOLUTION, UNIT, WIDTH = 0xA20E, 0xA210, 0xA002


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({}, None),
        ({FOCAL_35: 36}, 36 / (36**2 + 24**2) ** 0.5 * 50),
        ({FOCAL_35: 0, FOCAL: 5.0, RESOLUTION: 80.0, UNIT: 4}, 400.0),
        ({FOCAL: 5.0, RESOLUTION: 2032.0, UNIT: 2, WIDTH: 80}, 200.0),
        ({FOCAL: 5.0}, None),
        ({FOCAL: 5.0, RESOLUTION: 100.0, UNIT: 9}, None),
    ],
)
def test_focal_lengths_of_exif_data(fields, expected, tmp_path):
    exif = Image.Exif()
    exif.get_ifd(EXIF).update(fields)
    Image.fromarray(np.zeros((30, 40, 3), np.uint8)).save(tmp_path / "p.jpg", exif=exif)
    found = exif_focal(tmp_path / "p.jpg", (30, 40))
    assert found == (None if expected is None else pytest.approx(expected))


@pytest.mark.filterwarnings("ignore:Corrupt EXIF data")
def test_damaged_exif_data_have_no_focal_length(tmp_path):
    Image.fromarray(np.zeros((30, 40, 3), np.uint8)).save(tmp_path / "p.jpg", exif=b"Exif\0\0MM\0*\0\0\0\x08\xff\xff")
    assert exif_focal(tmp_path / "p.jpg", (30, 40)) is None
