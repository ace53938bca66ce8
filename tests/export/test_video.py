"""The fly-through: its way through the cameras, its pictures, and the file."""

from dataclasses import replace

import av
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from exact_rooms import room
from freegeo.errors import FreeGeoError
from freegeo.export import video
from freegeo.export.base import KEPT_NAME, Before
from freegeo.export.flight import BACKGROUND, WINDOW, Painter, plan_flight
from freegeo.export.formats import export
from freegeo.export.kept import save_kept
from freegeo.export.video import flythrough, picture_size, write_video
from freegeo.fusion.filtering import FilterReport
from freegeo.fusion.settings import FilterSettings


def everything(scene):
    return np.ones(scene.depth_z.shape, bool)


def some(scene, views):
    """Views of a scene, in an order."""
    many = ("depth_z", "conf", "images", "photo_hw", "scale_xy", "offset_xy", "T_cam_world", "K")
    values = {name: getattr(scene, name)[views] for name in many}
    return replace(scene, **values, names=tuple(f"{number} of {view}" for number, view in enumerate(views)))


def moved(scene, scale=2.5):
    """The same scene in another world, of another size."""
    R = Rotation.from_euler("xyz", (20, 30, 10), degrees=True).as_matrix()
    T = scene.T_cam_world.astype(np.float64)
    centres = -np.einsum("sji,sj->si", T[:, :3, :3], T[:, :3, 3])
    T[:, :3, :3] = T[:, :3, :3] @ R.T
    T[:, :3, 3] = -np.einsum("sij,sj->si", T[:, :3, :3], scale * centres @ R.T + (1, 2, 3))
    return replace(scene, T_cam_world=T.astype(np.float32), depth_z=scene.depth_z * np.float32(scale))


def centres(T_cam_world):
    return np.linalg.inv(T_cam_world)[:, :3, 3]


def nearest_view(flight, scene):
    """For each picture, the view whose camera is closest."""
    distance = np.linalg.norm(centres(flight.T_cam_world)[:, None] - centres(scene.T_cam_world)[None], axis=-1)
    return distance.argmin(axis=1)


def frames_of(path):
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        return stream.codec_context, [frame.to_ndarray(format="rgb24") for frame in file.decode(stream)]


def test_a_flight_is_smooth_and_passes_every_camera():
    scene = room(8, seed=3)
    flight = plan_flight(scene, everything(scene))
    rotations = flight.T_cam_world[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (len(flight), 1, 1)), atol=1e-9
    )
    places = centres(flight.T_cam_world)
    speed = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert np.abs(np.diff(speed)).max() < 0.1 * speed.max(), "no jerk"
    turn = np.linalg.norm(Rotation.from_matrix(rotations[1:] @ rotations[:-1].mT).as_rotvec(), axis=1)
    assert np.degrees(turn.max()) < 5
    for centre in centres(scene.T_cam_world):
        assert np.linalg.norm(places - centre, axis=1).min() < 0.15 * flight.depth


def test_photos_in_any_order_are_passed_on_a_short_way_and_a_walk_in_its_order():
    scene = room(8, seed=3)
    assert (np.diff(nearest_view(plan_flight(scene, everything(scene)), scene)) >= 0).all()
    mixed = some(scene, [5, 0, 3, 7, 1, 4, 2, 6])
    flight = plan_flight(mixed, everything(mixed))
    passed = np.array([5, 0, 3, 7, 1, 4, 2, 6])[nearest_view(flight, mixed)]
    steps = np.diff(passed)
    assert (steps >= 0).all() or (steps <= 0).all(), "the way of the camera that took them"


def test_the_picture_of_a_camera_is_its_photo():
    scene = room(4, (96, 128), seed=5)
    painter = Painter(scene, everything(scene), float(np.median(scene.depth_z)), scene.image_hw, 1.0)
    picture = painter.draw(scene.T_cam_world[1].astype(np.float64), scene.K[1, (0, 1), (0, 1)])
    # The cameras' principal point is half a pixel off the middle of the grid, so edges of textures differ.
    error = np.abs(picture - scene.images[1]).mean(axis=-1)
    assert np.median(error) < 5
    assert (error > 40).mean() < 0.03


def test_surfaces_have_no_holes_between_the_views_and_nothing_is_seen_through_them():
    scene = room(6, (96, 128), seed=3)
    flight = plan_flight(scene, everything(scene))
    painter = Painter(scene, everything(scene), flight.depth, (144, 192), 1.5)
    for number in range(0, len(flight), 16):
        picture = painter.draw(flight.T_cam_world[number], flight.focal[number])
        empty = (picture == BACKGROUND).all(axis=-1)
        # Single empty pixels are holes; what no photo shows is empty in larger parts.
        lone = empty[1:-1, 1:-1] & ~empty[:-2, 1:-1] & ~empty[2:, 1:-1]
        assert lone.mean() < 0.001


def test_pictures_of_many_views_show_those_nearby_only():
    scene = some(room(4), [0, 1, 2, 3] * 8)
    scene.T_cam_world[16:, :3, 3] += 100
    painter = Painter(scene, everything(scene), 2.0, (48, 64), 1.0)
    picture = painter.draw(scene.T_cam_world[0].astype(np.float64), np.array((50.0, 50.0)))
    assert len(painter._views) == WINDOW
    assert max(painter._views) < 16
    assert (picture == BACKGROUND).all(axis=-1).mean() < 0.1


def test_a_camera_that_stands_still_shows_a_few_views_in_whole():
    scene = some(room(1), [0] * 40)
    flight = plan_flight(scene, everything(scene))
    painter = Painter(scene, everything(scene), flight.depth, (48, 64), 1.0)
    picture = painter.draw(flight.T_cam_world[0], flight.focal[0])
    assert len(painter._views) == WINDOW
    assert (picture == BACKGROUND).all(axis=-1).mean() < 0.1
    assert np.ptp(centres(flight.T_cam_world), axis=0).max() > 0.05 * flight.depth, "the flight moves"


def test_the_file_is_what_browsers_play_and_the_same_each_time(tmp_path, short_flights):
    scene = room(3, (36, 49))
    for name in ("a", "b"):
        assert export(scene, tmp_path / name, ["video"]).files == [tmp_path / name / "flythrough.mp4"]
    context, frames = frames_of(tmp_path / "a" / "flythrough.mp4")
    assert (context.name, context.pix_fmt) == ("h264", "yuv420p")
    assert len(frames) == 6
    assert frames[0].shape == (144, 196, 3) == (*picture_size(scene.image_hw)[0], 3)
    assert np.abs(np.diff(np.stack(frames).astype(int), axis=0)).mean() > 1, "it moves"
    contents = [(tmp_path / name / "flythrough.mp4").read_bytes() for name in ("a", "b")]
    assert contents[0] == contents[1]
    assert contents[0].index(b"moov") < contents[0].index(b"mdat"), "it plays before it is there in whole"


def test_before_and_after_show_the_same_place_side_by_side(tmp_path, short_flights):
    scene = room(3, (48, 64))
    earlier = moved(scene)
    earlier.save(tmp_path / "frozen")
    before = Before(folder=tmp_path / "frozen")
    with_labels = next(flythrough(scene, everything(scene), before=before))
    (height, width), _ = picture_size(scene.image_hw)
    assert with_labels.shape == (height, 2 * width, 3)
    left, right = with_labels[:, :width].astype(int), with_labels[:, width:].astype(int)
    below = slice(height // 5, None), slice(2, -2)
    difference = np.abs(left[below] - right[below]).mean(axis=-1)
    assert np.median(difference) < 3 and (difference > 40).mean() < 0.03
    assert (left != right).any(), "the labels differ"
    alone = next(flythrough(scene, everything(scene)))
    scene.save(tmp_path / "same")
    same = next(flythrough(scene, everything(scene), before=Before(folder=tmp_path / "same")))
    np.testing.assert_array_equal(same, alone, err_msg="nothing is shown twice")
    np.testing.assert_array_equal(right[below], alone[below])


def test_before_has_the_filters_and_masks_of_after(tmp_path, short_flights):
    scene = room(3, (48, 64))
    earlier = moved(scene)
    earlier.save(tmp_path / "frozen")
    masks = everything(scene)
    masks[:, :, 32:] = False
    save_kept(tmp_path / "frozen", (everything(scene), FilterReport(pixels=masks.size, removed={}, tolerance=None)))
    (_, width), _ = picture_size(scene.image_hw)

    def drawn(**settings):
        before = Before(folder=tmp_path / "frozen", **settings)
        left = next(flythrough(scene, masks, before=before, masks=masks))[:, :width]
        return (left != BACKGROUND).any(axis=-1).mean()

    few = FilterSettings(drop_share=0, flying=False, multi_view=False)
    assert drawn(filters=few) < 0.8 * drawn(), "as asked for now, not as stored"
    (tmp_path / "frozen" / KEPT_NAME).unlink()
    assert drawn() < 0.8


def test_a_single_photo_is_seen_from_a_small_circle(short_flights):
    scene = room(1)
    flight = plan_flight(scene, everything(scene))
    away = np.linalg.norm(centres(flight.T_cam_world) - centres(scene.T_cam_world)[0], axis=1)
    assert 0.02 < away.max() / flight.depth < 0.1
    pictures = np.stack(list(flythrough(scene, everything(scene)))).astype(int)
    assert np.abs(np.diff(pictures, axis=0)).mean() > 1


def test_without_h264_it_is_vp9_and_without_both_a_sentence(tmp_path, monkeypatch):
    pictures = [np.full((32, 48, 3), value, np.uint8) for value in (0, 100, 200)]
    real = video._encodes
    monkeypatch.setattr(video, "_encodes", lambda name: name != "libx264" and real(name))
    context, frames = frames_of(write_video(pictures, tmp_path / "a.mp4"))
    assert ("vp9" in context.name, len(frames)) == (True, 3)
    monkeypatch.setattr(video, "_encodes", lambda name: False)
    with pytest.raises(FreeGeoError, match=r"encodes neither H\.264 nor VP9"):
        write_video(pictures, tmp_path / "b.mp4")
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
