import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy.spatial import cKDTree

from exact_rooms import PHOTO_SCALE, room
from freegeo.data.procedural import render, sample_rooms
from freegeo.errors import FreeGeoError, UserError
from freegeo.export.depth_png import depth_names, write_depth
from freegeo.export.formats import FORMATS, export, filter_reconstruction
from freegeo.export.mesh import fuse, voxel_size, write_mesh
from freegeo.export.nerfstudio import opengl_camera_to_world
from freegeo.export.pixels import masks_for_model
from freegeo.export.reconstruction import Reconstruction
from freegeo.fusion.settings import FilterSettings
from freegeo.geometry.depth import depth_to_world

EVERYTHING = FilterSettings(drop_share=0, flying=False, multi_view=False)


def test_every_format_is_written_once_and_points_are_shared(tmp_path):
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    scene = room()
    written = export(scene, tmp_path, [*FORMATS, "ply"], max_points=500, max_tracks=100)
    assert len(set(written)) == len(written)
    assert all(path.is_file() for path in written)
    on_disk = {p.relative_to(tmp_path) for p in tmp_path.rglob("*") if p.is_file()}
    assert on_disk == {p.relative_to(tmp_path) for p in written}
    assert len(trimesh.load(tmp_path / "points.ply").vertices) == 500
    assert len(trimesh.load(tmp_path / "scene.glb").geometry["points"].vertices) == 500
    np.testing.assert_array_equal(Reconstruction.load(tmp_path).depth_z, scene.depth_z)


def test_all_stands_for_every_format_and_each_is_where_it_says(tmp_path):
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    written = room().export(str(tmp_path), ["ply", "all"], max_points=100, max_tracks=50)
    for format in FORMATS.values():
        place = tmp_path / format.path
        assert any(path == place or place in path.parents for path in written), format.name


def test_only_formats_without_points_can_do_without_cameras(tmp_path):
    flat = replace(room(), T_cam_world=None, K=None)
    for format in FORMATS.values():
        if format.needs_cameras:
            with pytest.raises(UserError, match="no cameras"):
                flat.export(tmp_path, [format.name])
        else:
            assert flat.export(tmp_path / format.name, [format.name])


def test_a_reconstruction_exports_what_its_filters_and_masks_leave(tmp_path):
    scene = room()
    masks = [np.zeros(tuple(hw), np.uint8) for hw in scene.photo_hw]
    masks[1][20:40, 20:40] = 1
    assert room().export(tmp_path / "default") == [tmp_path / "default" / n for n in ("points.ply", "scene.glb")]
    scene.export(tmp_path, ["ply"], filters=EVERYTHING, masks=masks)
    kept, _ = filter_reconstruction(scene, masks=masks_for_model(scene, masks), settings=EVERYTHING)
    assert 0 < len(trimesh.load(tmp_path / "points.ply").vertices) == kept.sum() < kept.size / 10


def test_filters_decide_what_is_exported(tmp_path):
    scene = room()
    masks = np.zeros(scene.depth_z.shape, bool)
    masks[1, 10:20, 10:20] = True
    filtered = filter_reconstruction(scene, masks=masks, settings=EVERYTHING)
    export(scene, tmp_path, ["ply"], filtered=filtered)
    loaded = trimesh.load(tmp_path / "points.ply")
    assert len(loaded.vertices) == 100
    assert {tuple(c) for c in loaded.colors[:, :3]} <= {tuple(c) for c in scene.images[1, 10:20, 10:20].reshape(-1, 3)}


def test_bad_requests(tmp_path):
    with pytest.raises(UserError, match=r"Unknown export format 'obj'\. Choose from npz, ply"):
        export(room(), tmp_path, ["npz", "obj"])
    flat = replace(room(), T_cam_world=None, K=None)
    with pytest.raises(UserError, match="no cameras"):
        export(flat, tmp_path, ["npz", "ply"])
    assert list(tmp_path.iterdir()) == []
    assert {p.name for p in export(flat, tmp_path, ["npz", "depth"])} >= {"prediction.npz", "depth.json"}


def test_nerfstudio_cameras_project_points_to_the_photos(tmp_path):
    scene = room(4, (48, 64), 7, 5)
    export(scene, tmp_path, ["nerfstudio"], photo_folder="../photos", max_points=100)
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert content["camera_model"] == "OPENCV"
    assert (tmp_path / content["ply_file_path"]).is_file()
    photos = render(sample_rooms([7], frames=4), 48 * PHOTO_SCALE, 64 * PHOTO_SCALE)
    world = depth_to_world(photos.depth_z[0], photos.K[0], photos.T_cam_world[0])
    for view, frame in enumerate(content["frames"]):
        assert frame["file_path"] == f"../photos/{scene.names[view]}"
        assert (frame["h"], frame["w"]) == (96, 128)
        row, column = 30, 70
        point = np.append(world[view, row, column].numpy(), 1.0)
        x, y, z, _ = np.linalg.inv(np.array(frame["transform_matrix"])) @ point
        assert z < 0, "OpenGL cameras look along -z"
        place = (frame["cx"] - frame["fl_x"] * x / z, frame["cy"] + frame["fl_y"] * y / z)
        np.testing.assert_allclose(place, (column + 0.5, row + 0.5), atol=1e-2)


def test_opengl_axes_turn_the_camera_and_leave_its_place():
    matrix = opengl_camera_to_world(np.eye(4)[None])[0]
    np.testing.assert_array_equal(matrix @ (0, 1, 0, 0), (0, -1, 0, 0))
    np.testing.assert_array_equal(matrix @ (0, 0, -1, 0), (0, 0, 1, 0))


def test_depth_maps_come_back_within_half_a_step(tmp_path):
    depth = room().depth_z.copy()
    depth[0, 0, 0], depth[1, 2, 3] = np.nan, 0.0
    scene = replace(room(), depth_z=depth)
    write_depth(scene, tmp_path)
    content = json.loads((tmp_path / "depth.json").read_text())
    for view, name in enumerate(scene.names):
        with Image.open(tmp_path / content["maps"][name]) as image:
            values = np.array(image)
            assert float(image.info["depth_scale"]) == content["scale"]
        assert values.dtype == np.uint16
        valid = np.nan_to_num(depth[view]) > 0
        np.testing.assert_array_equal(values > 0, valid)
        np.testing.assert_allclose(values[valid] * content["scale"], depth[view][valid], atol=0.51 * content["scale"])


def test_depth_names_stay_apart():
    assert depth_names(("a.jpg", "sub/b.JPG")) == ["a.png", "sub/b.png"]
    assert depth_names(("a.jpg", "a.png")) == ["a.jpg.png", "a.png.png"]


def test_the_mesh_of_exact_depth_is_the_room(tmp_path):
    views, hw, seed = 4, (96, 128), 7
    scene = room(views, hw, seed)
    keep, _ = filter_reconstruction(scene, settings=EVERYTHING)
    voxel = voxel_size(scene, keep)
    mesh = fuse(scene, keep, voxel=voxel)
    fine = render(sample_rooms([seed], frames=views), 3 * hw[0], 3 * hw[1])
    truth = depth_to_world(fine.depth_z[0], fine.K[0], fine.T_cam_world[0]).reshape(-1, 3).numpy()
    to_truth, _ = cKDTree(truth).query(mesh.vertices)
    to_mesh, _ = cKDTree(mesh.vertices).query(truth)
    assert np.quantile(to_truth, 0.99) < 2 * voxel
    assert np.quantile(to_mesh, 0.95) < 2 * voxel
    write_mesh(scene, keep, tmp_path / "mesh.ply")
    loaded = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert loaded.vertices.shape == mesh.vertices.shape
    assert loaded.faces.shape == mesh.triangles.shape
    _, nearest = cKDTree(depth_to_points(scene)).query(loaded.vertices)
    difference = loaded.visual.vertex_colors[:, :3].astype(float) - scene.images.reshape(-1, 3)[nearest]
    assert np.median(np.abs(difference)) < 12


def depth_to_points(scene):
    maps = (torch.from_numpy(a) for a in (scene.depth_z, scene.K, scene.T_cam_world))
    return depth_to_world(*maps).reshape(-1, 3).numpy()


def test_meshes_that_cannot_be(tmp_path):
    scene = room()
    nothing = np.zeros(scene.depth_z.shape, bool)
    with pytest.raises(FreeGeoError, match="No depth is left"):
        write_mesh(scene, nothing, tmp_path / "mesh.ply")
    with pytest.raises(UserError, match="positive"):
        write_mesh(scene, ~nothing, tmp_path / "mesh.ply", voxel=0.0)
    assert list(tmp_path.iterdir()) == []


def test_masks_of_photos_reach_the_right_model_pixels():
    scene = room(4, (48, 64), 7, 5)
    masks = [np.zeros((96, 128), np.uint8) for _ in range(4)]
    masks[2][20:22, 30:32] = 255  # the photo area of the resized pixel (row 10, column 15), cropped by 5 columns
    result = masks_for_model(scene, masks)
    assert result.shape == scene.depth_z.shape
    assert np.argwhere(result).tolist() == [[2, 10, 10]]
    own = [np.ones(scene.image_hw, bool)] * 4
    assert masks_for_model(scene, own).all()


def test_masks_of_another_size_are_refused():
    scene = room()
    with pytest.raises(UserError, match=r"mask of photo 1.JPG has the size 10 x 10, but the photo is 96 x 128"):
        masks_for_model(scene, [np.ones((96, 128)), np.ones((10, 10)), np.ones((96, 128)), np.ones((96, 128))])
    with pytest.raises(UserError, match="1 masks for 4 views"):
        masks_for_model(scene, [np.ones((96, 128))])
