"""Metres from measured distances and GPS positions, and one focal length for photos of one camera."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from exact_rooms import PHOTO_SCALE, room
from freegeo.cameras.known import KnownCamera, Lens
from freegeo.cameras.undistortion import UndistortedPhoto, undistort
from freegeo.data.photos import MemoryPhoto, Photo
from freegeo.data.video import VideoFrame
from freegeo.errors import UserError
from freegeo.export.pixels import corner_K
from freegeo.export.reconstruction import METRIC_MODEL, Reconstruction, Scale
from freegeo.geometry.camera import project
from freegeo.geometry.se3 import camera_centres, transform_points
from freegeo.metres import Gps, in_metres, local_positions, read_scale, require_in_view
from freegeo.posed import is_one_camera, with_one_camera
from freegeo.types import ImageBatch

FACTOR = 2.5


def photos_of(scene: Reconstruction) -> list[MemoryPhoto]:
    pixels = np.zeros((*scene.photo_hw[0], 3), np.uint8)
    return [MemoryPhoto(name, pixels) for name in scene.names]


def shrunk(scene: Reconstruction) -> Reconstruction:
    """The scene in a unit of FACTOR metres."""
    T = scene.T_cam_world.copy()
    T[:, :3, 3] /= FACTOR
    return replace(scene, depth_z=scene.depth_z / np.float32(FACTOR), T_cam_world=T)


def two_places(scene: Reconstruction, views=(0, 2)) -> tuple[str, np.ndarray]:
    """A text for --scale with the true distance of what two photos show in their middle, and the points."""
    points, words = [], []
    for view in views:
        row, column = scene.image_hw[0] // 2, scene.image_hw[1] // 3 + 5 * view
        ray = np.linalg.solve(scene.K[view].astype(np.float64), [column, row, 1.0])
        camera = ray * scene.depth_z[view, row, column]
        T = scene.T_cam_world[view].astype(np.float64)
        points.append(T[:3, :3].T @ (camera - T[:3, 3]))
        # The centre of a model pixel is between two pixels of a photo of twice its size.
        u, v = (np.array([column, row]) + 0.5 - scene.offset_xy[view]) * PHOTO_SCALE - 0.5
        words.append(f"{scene.names[view]}:{u:g},{v:g}")
    points = np.stack(points)
    return f"{words[0]} {words[1]} = {np.linalg.norm(points[0] - points[1]):.6f}", points


def test_a_measured_distance_brings_everything_to_metres_together():
    scene = room(crop=3)
    small, photos = shrunk(scene), photos_of(scene)
    text, _ = two_places(scene)
    result = in_metres(small, read_scale(text, photos), photos)
    assert result.scale.value == pytest.approx(FACTOR, rel=1e-4) and result.scale.spread is None
    np.testing.assert_allclose(result.depth_z, scene.depth_z, rtol=1e-4)
    np.testing.assert_allclose(result.T_cam_world, scene.T_cam_world, rtol=1e-4, atol=1e-4)
    assert small.scale is None and np.array_equal(small.T_cam_world[:, :3, :3], result.T_cam_world[:, :3, :3])


def test_points_and_mesh_are_in_metres_too(tmp_path):
    import trimesh

    scene = room()
    for name, one in (("before", shrunk(scene)), ("after", shrunk(scene).scaled(FACTOR, source="a test"))):
        one.export(tmp_path / name, ["ply", "mesh"])
    for file in ("points.ply", "mesh.ply"):
        before, after = (trimesh.load(tmp_path / name / file) for name in ("before", "after"))
        assert np.ptp(after.vertices, axis=0) == pytest.approx(FACTOR * np.ptp(before.vertices, axis=0), rel=1e-2)
        assert b"metres (from a test)" in (tmp_path / "after" / file).read_bytes()[:400]


def test_several_distances_in_a_file_give_a_median_and_a_spread(tmp_path, caplog):
    scene = room()
    small, photos = shrunk(scene), photos_of(scene)
    lines = [two_places(scene, views)[0] for views in ((0, 2), (1, 3), (0, 3))]
    file = tmp_path / "distances.txt"
    file.write_text("# measured with a tape\n\n" + "\n".join(lines))
    scale = in_metres(small, read_scale(str(file), photos), photos).scale
    assert scale.value == pytest.approx(FACTOR, rel=1e-3) and scale.spread < 1e-3 and "3 measured" in scale.source
    assert not caplog.records
    start, _, metres = lines[0].rpartition("=")
    file.write_text("\n".join([*lines[1:], f"{start}= {2 * float(metres)}"]))
    assert in_metres(small, read_scale(str(file), photos), photos).scale.value == pytest.approx(FACTOR, rel=1e-3)
    assert "differ by" in caplog.text


@pytest.mark.parametrize(
    "text, words",
    [
        ("twelve", "neither gps, nor a distance"),
        ("photo 0.JPG:1,2 photo 1.JPG:3,4 = -1", "is no distance"),
        ("photo 0.JPG:1,2 = 4", "is no distance"),
        ("photo 9.JPG:1,2 photo 1.JPG:3,4 = 1", "no photo photo 9.JPG"),
        ("photo 0.JPG:500,2 photo 1.JPG:3,4 = 1", "outside the photo"),
        ("photo 0.JPG:1,2 photo 0.JPG:1,2 = 1", "one place twice"),
        ("gps", "0 of 4 photos have a GPS position"),
    ],
)
def test_what_is_no_scale_is_refused_in_a_sentence(text, words):
    with pytest.raises(UserError, match=words):
        read_scale(text, photos_of(room()))


def test_a_place_without_depth_is_refused():
    scene = room()
    hole = replace(scene, depth_z=np.where(np.arange(64) < 32, np.nan, scene.depth_z).astype(np.float32))
    photos = photos_of(scene)
    with pytest.raises(UserError, match=r"no depth at photo 0\.JPG:4,4"):
        in_metres(hole, read_scale("photo 0.JPG:4,4 photo 1.JPG:100,50 = 1", photos), photos)


def test_pixels_of_photos_with_distortion_are_those_of_the_original():
    scene = room()
    _, points = two_places(scene)
    K = corner_K(scene)
    size = tuple(scene.photo_hw[0])
    photos, words = [], []
    for view, photo in enumerate(photos_of(scene)):
        straight = undistort(photo, KnownCamera(K=K[view], lens=Lens("SIMPLE_RADIAL", (-0.1,)), size_hw=size))
        photos.append(UndistortedPhoto(straight.photo, straight.original, K[view]))
    for view, point in zip((0, 2), points, strict=True):
        seen = transform_points(torch.from_numpy(scene.T_cam_world[view]).double(), torch.from_numpy(point)[None])
        place = project(seen, torch.from_numpy(K[view])).numpy()
        u, v = photos[view].to_original(place)[0] - 0.5
        words.append(f"{scene.names[view]}:{u:.4f},{v:.4f}")
    text = f"{words[0]} {words[1]} = {np.linalg.norm(points[0] - points[1])}"
    assert in_metres(shrunk(scene), read_scale(text, photos), photos).scale.value == pytest.approx(FACTOR, rel=1e-3)


def test_a_distance_is_believed_more_than_a_model_and_says_so(caplog):
    scene = room()
    photos = photos_of(scene)
    metric = replace(shrunk(scene), scale=Scale(value=9.0, source=METRIC_MODEL))
    result = in_metres(metric, read_scale(two_places(scene)[0], photos), photos)
    assert result.scale.source == "a measured distance"
    assert "2.5 times what the metres from a metric model say" in caplog.text


# GPS ------------------------------------------------------------------------------------------------------------------


def gps_of(scene: Reconstruction, noise: float = 0.0, seed: int = 0) -> Gps:
    """True positions in a turned frame, with noise relative to the path; the last one is far off with noise."""
    centres = camera_centres(torch.from_numpy(scene.T_cam_world).double()).numpy()
    generator = np.random.default_rng(seed)
    turned = centres @ np.array([[0, 1.0, 0], [0, 0, 1], [1, 0, 0]])
    turned += noise * np.ptp(centres, axis=0).max() * generator.standard_normal(turned.shape)
    return Gps(tuple(range(len(scene))), tuple(map(tuple, turned.tolist())))


def test_gps_gives_the_scale_and_leaves_outliers_out():
    scene = room(views=8)
    photos = photos_of(scene)
    exact = in_metres(shrunk(scene), gps_of(scene), photos).scale
    assert exact.value == pytest.approx(FACTOR, rel=1e-4) and exact.spread < 1e-3
    noisy = gps_of(scene, noise=0.02)
    off = replace(noisy, positions=(*noisy.positions[:-1], (9.0, 9.0, 9.0)))
    found = in_metres(shrunk(scene), off, photos).scale
    assert found.value == pytest.approx(FACTOR, rel=0.1) and 0.005 < found.spread < 0.15


def test_gps_that_does_not_fit_or_a_straight_path_is_refused():
    scene = room(views=8)
    photos = photos_of(scene)
    with pytest.raises(UserError, match="too little to tell the scale"):
        in_metres(shrunk(scene), gps_of(scene, noise=1.0), photos)
    straight = np.tile(np.eye(4, dtype=np.float32), (8, 1, 1))
    straight[:, 0, 3] = np.arange(8)
    with pytest.raises(UserError, match="on one line"):
        in_metres(replace(scene, T_cam_world=straight), gps_of(scene), photos)


def test_known_cameras_in_metres_are_believed_more_than_gps():
    scene = replace(room(), scale=Scale(value=1.0, source="the known cameras in a file"))
    assert in_metres(scene, gps_of(shrunk(scene)), photos_of(scene)) is scene


def test_local_positions_are_metres_east_north_and_up():
    # One minute of latitude is a nautical mile, and a degree of longitude at 60 degrees north is half of one at 0.
    places = local_positions(
        np.array([[60.0, 179.9999, 10.0], [60 + 1 / 60, 179.9999, 10.0], [60.0, -179.9999, np.nan]])
    )
    assert places[1, 1] - places[0, 1] == pytest.approx(1857, abs=2)
    assert places[2, 0] - places[0, 0] == pytest.approx(0.0002 * 111320 * 0.5, rel=0.01)
    assert np.allclose(places[:, 2], 0)


def test_positions_come_from_exif_data(tmp_path):
    files = []
    for k in range(4):
        exif = Image.Exif()
        gps = exif.get_ifd(0x8825)
        gps.update({1: "S", 2: (33.0, 51.0, 30.0 + k), 3: "E", 4: (151.0, 12.0, 30.0 * (k % 2)), 5: b"\x00", 6: 5.0})
        files.append(tmp_path / f"{k}.jpg")
        Image.fromarray(np.full((8, 8, 3), 60 * k, np.uint8)).save(files[-1], exif=exif if k < 3 else Image.Exif())
    found = read_scale("gps", [Photo(file.name, file, (8, 8)) for file in files])
    assert found.views == (0, 1, 2)
    assert found.positions[0][1] - found.positions[1][1] == pytest.approx(30.8, abs=0.2)  # a second of latitude
    with pytest.raises(UserError, match="2 of 2 photos"):
        read_scale("gps", [Photo(file.name, file, (8, 8)) for file in files[:2]])


# One camera -----------------------------------------------------------------------------------------------------------


def test_photos_of_one_camera_share_the_median_focal_length(caplog):
    scene = room(views=5, crop=3)
    factors = np.array([0.98, 1.0, 1.01, 1.02, 0.7], np.float32)
    K = scene.K.copy()
    K[:, 0, 0] *= factors
    K[:, 1, 1] *= factors
    photos = photos_of(scene)
    result, about = with_one_camera(replace(scene, K=K), photos)
    np.testing.assert_allclose(result.K, scene.K, rtol=1e-5)
    assert about["cameras"][0]["photos"] == 5
    assert about["cameras"][0]["focal_px"] == pytest.approx(corner_K(scene)[0, 0, 0], rel=1e-5)
    assert "give --no-one-camera" in caplog.text
    # Of another size: another camera. A single photo of one stays as it is.
    photos[4] = MemoryPhoto(photos[4].name, np.zeros((10, 20, 3), np.uint8))
    result, about = with_one_camera(replace(scene, K=K), photos)
    assert about["cameras"][0]["photos"] == 4 and np.array_equal(result.K[4], K[4])


def test_frames_of_a_video_are_of_one_camera_without_a_word():
    frame = object.__new__(VideoFrame)
    assert is_one_camera([frame, frame]) and not is_one_camera([frame, *photos_of(room())])


def test_photos_with_other_exif_data_are_of_other_cameras(tmp_path):
    scene, photos = room(), []
    for k, name in enumerate(("0.jpg", "1.jpg", "2.jpg", "3.jpg")):
        exif = Image.Exif()
        exif[0x0110] = "Zoom"
        exif.get_ifd(0x8769)[0x920A] = 24.0 if k < 2 else 70.0
        Image.fromarray(np.zeros((96, 128, 3), np.uint8)).save(tmp_path / name, exif=exif)
        photos.append(Photo(name, tmp_path / name, (96, 128)))
    K = scene.K.copy()
    K[2:, (0, 1), (0, 1)] *= 3
    result, about = with_one_camera(replace(scene, K=K), photos)
    assert [one["photos"] for one in about["cameras"]] == [2, 2]
    assert np.allclose(result.K[2, 0, 0], 3 * scene.K[2, 0, 0])


def test_a_place_that_is_cut_off_for_the_model_is_refused_before_any_prediction():
    scene = room(crop=3)
    photos = photos_of(scene)
    batch = ImageBatch(
        images=torch.zeros(len(scene), 3, *scene.image_hw), names=scene.names,
        **{name: torch.from_numpy(getattr(scene, name)) for name in ("photo_hw", "scale_xy", "offset_xy")},
    )  # fmt: skip
    require_in_view(read_scale(two_places(scene)[0], photos), batch, photos)
    name = scene.names[0]
    with pytest.raises(UserError, match=f"{name}:0,0 lies in the part of the photo that is cut off"):
        require_in_view(read_scale(f"{name}:0,0 {name}:60,50 = 1", photos), batch, photos)


def test_gps_positions_in_one_place_are_refused_before_any_prediction():
    places = local_positions(np.array([[47.0, 8.0, 400.0]] * 3)).tolist()
    with pytest.raises(UserError, match="all have the same one"):
        require_in_view(Gps((0, 1, 2), tuple(map(tuple, places))), None, [])
