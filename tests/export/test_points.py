from dataclasses import replace

import numpy as np
import pytest
import trimesh

from exact_rooms import cloud_of, room
from freegeo.data.procedural import sample_rooms
from freegeo.errors import FreeGeoError, UserError
from freegeo.export.glb import FRUSTUM_SHARE, NODE, OPENCV_TO_GLTF, frustum_corners, order_colours, write_glb
from freegeo.export.ply import write_ply
from freegeo.fusion.normals import point_normals
from freegeo.fusion.points import PointCloud


def write_scene(scene, cloud, path):
    return write_glb(cloud, scene.T_cam_world, scene.K, scene.image_hw, path, lengths=scene.lengths)


def normals_of(scene, cloud):
    return point_normals(cloud, scene.depth_z, scene.T_cam_world, scene.K, scene.inside())


def test_points_project_back_to_their_pixels_and_carry_their_colours():
    scene = room()
    cloud = cloud_of(scene, drop_share=0.0, drop_flying=False)
    assert len(cloud) == scene.depth_z.size
    T, K = scene.T_cam_world[cloud.view], scene.K[cloud.view]
    camera = np.einsum("nij,nj->ni", T[:, :3, :3], cloud.points) + T[:, :3, 3]
    pixel = np.einsum("nij,nj->ni", K, camera)
    np.testing.assert_allclose(pixel[:, :2] / pixel[:, 2:], cloud.pixel, atol=2e-3)
    column, row = cloud.pixel.T
    np.testing.assert_allclose(camera[:, 2], scene.depth_z[cloud.view, row, column], rtol=1e-4)
    np.testing.assert_array_equal(cloud.colours, scene.images[cloud.view, row, column])


def test_the_least_confident_share_is_left_out():
    scene = room()
    conf = np.random.default_rng(0).permutation(scene.conf.size).reshape(scene.conf.shape).astype(np.float32)
    cloud = cloud_of(replace(scene, conf=conf), drop_share=0.4, drop_flying=False)
    assert len(cloud) == pytest.approx(0.6 * conf.size, abs=2)
    assert cloud.conf.min() >= 0.4 * conf.size - 2
    assert len(cloud_of(scene, drop_share=0.4, drop_flying=False)) == conf.size, "a constant confidence ranks nothing"


def test_invalid_depth_and_masked_pixels_give_no_point():
    scene = room()
    depth = scene.depth_z.copy()
    depth[0, 0, :3] = (0.0, np.nan, np.inf)
    keep = np.ones(depth.shape, bool)
    keep[1] = False
    cloud = cloud_of(replace(scene, depth_z=depth), drop_share=0.0, drop_flying=False, keep=keep)
    assert len(cloud) == depth.size - 3 - depth[1].size
    assert np.isfinite(cloud.points).all()
    assert 1 not in cloud.view


def test_thinning_is_seeded_and_keeps_the_order():
    scene = room()
    first, again, other = (cloud_of(scene, max_points=100, seed=seed) for seed in (1, 1, 2))
    assert len(first) == 100
    np.testing.assert_array_equal(first.points, again.points)
    assert not np.array_equal(first.points, other.points)
    assert (np.diff(first.view) >= 0).all()
    with pytest.raises(UserError, match="at least 1"):
        cloud_of(scene, max_points=0)
    with pytest.raises(UserError, match="share"):
        cloud_of(scene, drop_share=1.0)


def test_ply_reopens_with_the_same_points_colours_and_normals(tmp_path):
    scene = room()
    cloud = cloud_of(scene)
    normals = normals_of(scene, cloud)
    normals[3] = 0
    path = write_ply(cloud, tmp_path / "deep" / "points.ply", lengths="up to scale", normals=normals)
    loaded = trimesh.load(path)
    np.testing.assert_array_equal(loaded.vertices.astype(np.float32), cloud.points)
    np.testing.assert_array_equal(loaded.colors[:, :3], cloud.colours)
    raw = loaded.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(np.stack([raw[name] for name in ("nx", "ny", "nz")], axis=-1), normals)
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["points.ply"]
    header = path.read_bytes().split(b"end_header")[0].decode()
    assert "comment lengths are up to scale" in header and "0 0 0: not known" in header


def test_normals_are_those_of_the_surfaces_and_point_into_the_room():
    scene = room()
    cloud = cloud_of(scene, drop_share=0.0)
    normals = normals_of(scene, cloud)
    in_room = sample_rooms([3], frames=4)
    R, half = in_room.T_room_world[0, :3].numpy(), in_room.size[0, 0].numpy()
    places, directions = cloud.points @ R[:, :3].T + R[:, 3], normals @ R[:, :3].T
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    # The walls, the floor and the ceiling; where they meet, neighbours are on both.
    for axis in range(3):
        for side in (-1, 1):
            end = in_room.center[0, 0].numpy()[axis] + side * half[axis]
            on_it = np.abs(places[:, axis] - end) < 0.002
            if on_it.sum() > 100:
                angle = np.degrees(np.arccos(np.clip(-side * directions[on_it, axis], -1, 1)))
                assert np.quantile(angle, 0.9) < 1, (axis, side)


def test_normals_do_not_reach_over_the_edge_of_a_surface_or_of_the_photo():
    scene = room(1, (12, 16))
    depth = np.full_like(scene.depth_z, 2.0)
    depth[:, :, 8:] = 4.0
    depth[:, 5, 3] = np.nan
    flat = replace(scene, depth_z=depth, T_cam_world=np.eye(4, dtype=np.float32)[None])
    cloud = cloud_of(flat, drop_share=0.0, drop_flying=False)
    normals = normals_of(flat, cloud)
    np.testing.assert_allclose(normals, np.tile((0, 0, -1), (len(cloud), 1)), atol=1e-4)
    depth[:, :, 9:] = np.nan
    alone = cloud.pixel[:, 0] == 8
    unknown = normals_of(replace(flat, depth_z=depth), cloud.select(alone))
    np.testing.assert_array_equal(unknown, 0)


def test_glb_reopens_with_the_same_points_colours_and_cameras(tmp_path):
    scene = room()
    cloud = cloud_of(scene)
    loaded = trimesh.load(write_scene(scene, cloud, tmp_path / "scene.glb"))
    assert set(loaded.geometry) == {"points", "camera_000", "camera_001", "camera_002", "camera_003"}
    points = loaded.geometry["points"]
    np.testing.assert_array_equal(points.vertices, cloud.points)
    np.testing.assert_array_equal(points.colors[:, :3], cloud.colours)
    for view, colour in enumerate(order_colours(4)):
        camera = loaded.geometry[f"camera_{view:03d}"]
        assert isinstance(camera, trimesh.Trimesh)
        np.testing.assert_array_equal(np.unique(camera.visual.vertex_colors[:, :3], axis=0), [colour])


def test_frusta_stand_where_the_cameras_are_and_look_where_they_look(tmp_path):
    scene = room()
    loaded = trimesh.load(write_scene(scene, cloud_of(scene), tmp_path / "scene.glb"))
    for view in range(len(scene)):
        T = scene.T_cam_world[view].astype(np.float64)
        camera = np.asarray(loaded.geometry[f"camera_{view:03d}"].vertices) @ T[:3, :3].T + T[:3, 3]
        depth = FRUSTUM_SHARE * np.median(scene.depth_z)
        width = 0.03 * depth
        assert -width < camera[:, 2].min() < width
        assert camera[:, 2].max() == pytest.approx(depth, rel=0.2)
        at_centre = np.linalg.norm(camera, axis=-1) < 2 * width
        assert at_centre.sum() == 16, "four beams start at the centre, four corners each"


def test_a_point_in_front_of_the_first_camera_is_at_minus_z_and_up_is_plus_y(tmp_path):
    cloud = PointCloud(
        points=np.array([[0, 0, 2], [0, -1, 2]], np.float32),
        colours=np.array([[255, 0, 0], [0, 255, 0]], np.uint8),
        conf=np.ones(2, np.float32),
        view=np.zeros(2, np.int64),
        pixel=np.zeros((2, 2), np.int64),
    )
    K = np.array([[[50, 0, 32], [0, 50, 24], [0, 0, 1]]], np.float32)
    file = write_glb(cloud, np.eye(4, dtype=np.float32)[None], K, (48, 64), tmp_path / "a.glb", lengths="up to scale")
    loaded = trimesh.load(file)
    turn, name = loaded.graph.get("points")
    np.testing.assert_array_equal(turn[:3, :3], OPENCV_TO_GLTF)
    np.testing.assert_array_equal(
        trimesh.transform_points(loaded.geometry[name].vertices, turn), [[0, 0, -2], [0, 1, -2]]
    )
    np.testing.assert_array_equal(loaded.graph.get("camera_000")[0], turn)
    np.testing.assert_array_equal(loaded.graph.get(NODE)[0], turn)
    assert loaded.geometry["camera_000"].vertices[:, 2].max() > 0.1


def test_frustum_corners_are_the_image_corners():
    scene = room()
    height, width = scene.image_hw
    corners = frustum_corners(scene.T_cam_world[1], scene.K[1], (height, width), 0.5)
    T = scene.T_cam_world[1]
    camera = corners @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(camera[0], 0, atol=1e-5)
    np.testing.assert_allclose(camera[1:, 2], 0.5, rtol=1e-5)
    pixels = camera[1:] @ scene.K[1].T
    expected = [(-0.5, -0.5), (width - 0.5, -0.5), (width - 0.5, height - 0.5), (-0.5, height - 0.5)]
    np.testing.assert_allclose(pixels[:, :2] / pixels[:, 2:], expected, atol=1e-3)


def test_nothing_is_written_without_points(tmp_path):
    scene = room()
    empty = cloud_of(scene).select(np.zeros(0, np.int64))
    with pytest.raises(FreeGeoError, match="no point is left"):
        write_ply(empty, tmp_path / "points.ply", lengths="up to scale", normals=np.zeros((0, 3)))
    with pytest.raises(FreeGeoError, match="no point is left"):
        write_scene(scene, empty, tmp_path / "scene.glb")
    assert list(tmp_path.iterdir()) == []
