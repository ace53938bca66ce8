"""Which way is up: found from cameras and floor, and what the GLB file makes of it."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from exact_rooms import cloud_of, room
from freegeo.export.formats import export
from freegeo.export.glb import NODE, OPENCV_TO_GLTF, UP_UNKNOWN
from freegeo.export.gravity import find_up, upright_rotation
from freegeo.fusion.normals import point_normals

ROOM_UP = np.array([0.0, 0.0, 1.0])
"""In the world of the generated rooms, which stand upright."""


def up_of(scene):
    cloud = cloud_of(scene)
    normals = point_normals(cloud, scene.depth_z, scene.T_cam_world, scene.K, scene.inside())
    return find_up(scene.T_cam_world, cloud.points, normals)


def turned(scene, R):
    """The same scene in a world that is turned by R."""
    T = scene.T_cam_world.copy()
    T[:, :3, :3] = T[:, :3, :3] @ R.T.astype(np.float32)
    return replace(scene, T_cam_world=T)


def rolled(scene, turns):
    """The cameras of photos that were taken rolled by quarter turns, which nothing says, about their axes."""
    T = scene.T_cam_world.copy()
    for view, quarter in enumerate(turns):
        roll = Rotation.from_euler("z", 90 * quarter, degrees=True).as_matrix().astype(np.float32)
        T[view, :3] = roll @ T[view, :3]
    return replace(scene, T_cam_world=T)


def angle_deg(a, b):
    return np.degrees(np.arccos(np.clip(a @ b, -1, 1)))


@pytest.mark.parametrize("seed", [1, 3, 5, 8])
def test_the_floor_is_level_in_the_glb_scene_and_its_vertices_are_those_of_the_other_files(tmp_path, seed):
    R = Rotation.random(rng=seed).as_matrix()
    scene = turned(room(8, seed=seed), R)
    export(scene, tmp_path, ["glb", "ply"])
    loaded = trimesh.load(tmp_path / "scene.glb")
    assert "the normal of a plane" in loaded.metadata["up"]
    points = trimesh.load(tmp_path / "points.ply").vertices
    np.testing.assert_array_equal(loaded.geometry["points"].vertices, points)
    turn, _ = loaded.graph.get(NODE)
    np.testing.assert_array_equal(loaded.graph.get("points")[0], turn)
    assert angle_deg(turn[:3, :3] @ R @ ROOM_UP, np.array([0, 1, 0])) < 2
    for view, centre in enumerate(np.linalg.inv(scene.T_cam_world)[:, :3, 3]):
        matrix, name = loaded.graph.get(f"camera_{view:03d}")
        np.testing.assert_array_equal(matrix, turn)
        corners = np.asarray(loaded.geometry[name].vertices)
        assert np.linalg.norm(corners - centre, axis=1).min() < 0.02, "the frustum stands where its camera is"
    ahead = turn[:3, :3] @ scene.T_cam_world[0, 2, :3]
    assert ahead[2] < 0 and abs(ahead[0]) < 1e-3, "the first camera's heading is -z"


def test_photos_that_were_taken_rolled_do_not_count():
    scene = room(8, seed=5)
    cloud = cloud_of(scene)
    normals = point_normals(cloud, scene.depth_z, scene.T_cam_world, scene.K, scene.inside())
    found = find_up(rolled(scene, (0, 1, 0, 0, 2, 0, 3, 0)).T_cam_world, cloud.points, normals)
    assert found is not None
    assert angle_deg(found.direction, ROOM_UP) < 2


def test_without_a_floor_up_is_that_of_the_cameras_but_not_their_pitch():
    down = Rotation.from_euler("x", -35, degrees=True).as_matrix()
    T = np.tile(np.eye(4, dtype=np.float32), (6, 1, 1))
    for view in range(6):
        T[view, :3, :3] = down @ Rotation.from_euler("y", 60 * view, degrees=True).as_matrix()
    points, normals = np.random.default_rng(0).normal(size=(2, 3000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for cameras in (T, T[:3]):
        found = find_up(cameras, points, normals)
        assert found is not None and "no floor was found" in found.source
        assert angle_deg(found.direction, np.array([0, -1, 0])) < 5


def test_cameras_that_disagree_leave_the_world_as_it_is(tmp_path, caplog):
    caplog.set_level("INFO")
    scene = rolled(room(4), (0, 1, 2, 3))
    export(scene, tmp_path, ["glb", "ply"])
    loaded = trimesh.load(tmp_path / "scene.glb")
    assert loaded.metadata["up"] == UP_UNKNOWN
    assert f"scene.glb: up is {UP_UNKNOWN}" in caplog.text
    np.testing.assert_array_equal(loaded.graph.get("points")[0][:3, :3], OPENCV_TO_GLTF)
    assert up_of(rolled(room(2), (0, 1))) is None, "one against one"


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 0, -1), (0, 0, 1)])
def test_a_rotation_for_a_camera_that_looks_ahead_up_or_down(up):
    turn = upright_rotation(np.array(up, float), np.eye(4)[None])
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)
    np.testing.assert_allclose(turn @ up, (0, 1, 0), atol=1e-12)
