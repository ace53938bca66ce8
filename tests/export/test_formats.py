import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy.spatial import cKDTree

from exact_rooms import PHOTO_SCALE, room
from freegeo.data.photos import MemoryPhoto
from freegeo.data.procedural import render, sample_rooms
from freegeo.errors import FreeGeoError, UserError
from freegeo.export.depth_files import depth_names
from freegeo.export.formats import FORMATS, check_formats, chosen_formats, export, filter_reconstruction
from freegeo.export.mesh import fuse, voxel_size, write_mesh
from freegeo.export.nerfstudio import opengl_camera_to_world
from freegeo.export.pixels import masks_for_model
from freegeo.export.reconstruction import METRIC_MODEL, Reconstruction, Scale
from freegeo.files import LEDGER_FILE
from freegeo.fusion.settings import FilterSettings
from freegeo.geometry.depth import depth_to_world

EVERYTHING = FilterSettings(drop_share=0, flying=False, multi_view=False)
NOTHING = FilterSettings(min_agreeing=50, min_asked=0)


def names_in(folder):
    """Everything in a folder but the ledger."""
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()} - {LEDGER_FILE}


def photos_of(scene):
    return [
        MemoryPhoto(name, np.full((*hw, 3), 40 * i, np.uint8))
        for i, (name, hw) in enumerate(zip(scene.names, scene.photo_hw.tolist(), strict=True))
    ]


@pytest.mark.parametrize("name", ["images/photo 0.JPG", "masks/photo 0.png", "depth/photo 0.png", "transforms.json"])
def test_photos_masks_depth_and_cameras_of_a_data_set_are_not_replaced(tmp_path, name):
    scene = room()
    photos = [MemoryPhoto(n, np.zeros((*hw, 3), np.uint8)) for n, hw in zip(scene.names, scene.photo_hw, strict=True)]
    own = tmp_path / name
    own.parent.mkdir(exist_ok=True)
    own.write_text("somebody's own")
    masks = np.ones(scene.depth_z.shape, bool)
    for _ in range(2):
        with pytest.raises(UserError, match="freegeo did not write it"):
            export(scene, tmp_path, ["nerfstudio", "depth"], photos=photos, masks=masks)
        assert own.read_text() == "somebody's own"
    own.unlink()
    for _ in range(2):
        assert own in export(scene, tmp_path, ["nerfstudio", "depth"], photos=photos, masks=masks).files


def test_every_format_is_written_once_and_points_are_shared(tmp_path, short_flights):
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    pytest.importorskip("rerun", reason="needs the extra rerun")
    pytest.importorskip("OpenEXR", reason="needs the extra exr")
    scene = room()
    written = export(scene, tmp_path, [*FORMATS, "ply"], max_points=500, max_tracks=100).files
    assert len(set(written)) == len(written)
    assert all(path.is_file() for path in written)
    assert names_in(tmp_path) == {p.relative_to(tmp_path).as_posix() for p in written}
    assert len(trimesh.load(tmp_path / "points.ply").vertices) == 500
    assert len(trimesh.load(tmp_path / "scene.glb").geometry["points"].vertices) == 500
    np.testing.assert_array_equal(Reconstruction.load(tmp_path).depth_z, scene.depth_z)


def test_all_stands_for_every_format_and_each_is_where_it_says(tmp_path, short_flights):
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    pytest.importorskip("rerun", reason="needs the extra rerun")
    pytest.importorskip("OpenEXR", reason="needs the extra exr")
    written = room().export(str(tmp_path), ["ply", "all"], max_points=100, max_tracks=50).files
    for format in FORMATS.values():
        place = tmp_path / format.path
        assert any(path == place or place in path.parents for path in written), format.name


def test_the_page_about_formats_has_a_row_for_each():
    page = (Path(__file__).parents[2] / "docs" / "formats.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `([\w-]+)` \|", page, re.MULTILINE) == list(FORMATS)


def test_only_formats_without_points_can_do_without_cameras(tmp_path):
    flat = replace(room(), T_cam_world=None, K=None)
    for format in FORMATS.values():
        if format.needs_cameras:
            with pytest.raises(UserError, match="no cameras"):
                flat.export(tmp_path, [format.name])
        else:
            assert flat.export(tmp_path / format.name, [format.name]).files
    assert {p.name for p in flat.export(tmp_path / "all", ["all"]).files} >= {"prediction.npz", "depth.json"}


def test_a_reconstruction_exports_what_its_filters_and_masks_leave(tmp_path):
    scene = room()
    masks = [np.zeros(tuple(hw), np.uint8) for hw in scene.photo_hw]
    masks[1][20:40, 20:40] = 1
    default = room().export(tmp_path / "default")
    assert default.files == [tmp_path / "default" / n for n in ("points.ply", "scene.glb")]
    assert default.failed == {}
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
    for names in ([], [""], [","]):
        with pytest.raises(UserError, match=r"No export format is named\. Choose from npz, ply"):
            export(room(), tmp_path, names)
    for values in ({"voxel": 0.0}, {"max_points": 0}, {"max_tracks": -1}):
        with pytest.raises(UserError, match="must be"):
            export(room(), tmp_path, ["npz", "ply"], **values)
    flat = replace(room(), T_cam_world=None, K=None)
    with pytest.raises(UserError, match="no cameras"):
        flat.export(tmp_path, ["npz", "ply"])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("names", [["ply,glb"], ["ply, glb"], ["PLY", "glb"], [" ply ", "glb,ply"], ["ply,", ",glb"]])
def test_formats_may_be_separated_by_commas(names):
    assert chosen_formats(names) == ["ply", "glb"]


def test_a_format_that_can_never_be_written_is_refused_but_left_out_of_all(caplog):
    assert "colmap" in check_formats(["all"], ["a.jpg", "b.jpg"])
    with pytest.raises(UserError, match="there is one photo"):
        check_formats(["all", "colmap"], ["a.jpg"])
    assert check_formats(["all"], ["a.jpg"]) == [name for name in FORMATS if name != "colmap"]
    assert "'all' leaves out colmap: a COLMAP model needs points that two views see" in caplog.text


def nothing_kept(scene):
    return filter_reconstruction(scene, settings=NOTHING)


def test_formats_with_nothing_to_write_do_not_cost_the_others(tmp_path, caplog):
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    scene = room()
    result = export(scene, tmp_path, ["all"], filtered=nothing_kept(scene))
    assert set(result.failed) - {"rerun"} == {"ply", "glb", "mesh", "colmap", "video"}
    assert {p.name for p in result.files} >= {"prediction.npz", "transforms.json", "depth.json"}
    for format, reason in result.failed.items():
        assert "multi-view" in reason and "Loosen the filters" in reason
        assert f"Format {format} is not written: {reason}" in caplog.text
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert "ply_file_path" not in content
    assert len(content["frames"]) == len(scene)
    with pytest.raises(FreeGeoError, match="nothing was written: no point is left"):
        scene.export(tmp_path, ["ply"], filters=NOTHING)


def test_depth_that_is_not_a_number_is_not_called_a_matter_of_filters(tmp_path):
    lost = replace(room(), depth_z=np.full_like(room().depth_z, np.nan))
    filtered = filter_reconstruction(lost, settings=EVERYTHING)
    result = export(lost, tmp_path, ["npz", "ply", "depth", "mesh"], filtered=filtered)
    assert list(result.failed) == ["ply", "depth", "mesh"]
    assert all("no depth of the prediction is usable" in reason for reason in result.failed.values())


def test_without_cameras_the_formats_that_need_none_are_written(tmp_path):
    flat = replace(room(), T_cam_world=None, K=None)
    result = export(flat, tmp_path, ["ply", "depth"])
    assert list(result.failed) == ["ply"]
    assert names_in(tmp_path) == {"depth/depth.json", *(f"depth/photo {i}.png" for i in range(4))}


# -- nothing of an earlier export is left


def test_exports_replace_earlier_ones_and_spare_other_files(tmp_path):
    scene = room()
    export(scene, tmp_path, ["depth", "ply", "glb"])
    (tmp_path / "depth" / "mine.png").write_text("mine")
    (tmp_path / "mesh.ply").write_text("mine")
    renamed = replace(scene, names=("other.jpg", *scene.names[1:]))
    filtered = nothing_kept(scene)
    assert list(export(renamed, tmp_path, ["depth", "ply", "mesh"], filtered=filtered).failed) == ["ply", "mesh"]
    maps = {"other.png", *(f"photo {i}.png" for i in range(1, 4))}
    assert names_in(tmp_path) == {"scene.glb", "mesh.ply", "depth/mine.png", "depth/depth.json"} | {
        f"depth/{name}" for name in maps
    }
    assert (tmp_path / "mesh.ply").read_text() == "mine"


def test_names_that_lead_out_of_the_folder_are_refused_before_anything_is_written(tmp_path):
    scene, out = room(), tmp_path / "out"
    for name in ("../x.jpg", "/x.jpg", "a/../../x.jpg", "..", "", "a\nb.jpg"):
        bad = replace(scene, names=(name, *scene.names[1:]))
        for format in ("depth", "nerfstudio", "colmap"):
            with pytest.raises(UserError, match="cannot be the name of a file"):
                export(bad, out, ["npz", format])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("length", [200, 251, 255])
def test_long_names_fit(tmp_path, length):
    stems = [("客厅" * 60)[: (length - 5) // 3] + str(i) for i in range(4)]
    scene = replace(room(), names=tuple(f"{s}{'x' * (length - 4 - len(s.encode()))}.tif" for s in stems))
    assert {len(name.encode()) for name in scene.names} == {length}
    export(scene, tmp_path, ["depth", "nerfstudio"], photos=photos_of(scene))
    maps = json.loads((tmp_path / "depth" / "depth.json").read_text())["maps"]
    assert list(maps) == list(scene.names)
    assert all((tmp_path / "depth" / name).is_file() for name in maps.values())
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert all((tmp_path / frame["file_path"]).is_file() for frame in frames)


def test_names_that_would_become_too_long_are_cut_and_stay_apart():
    names = [f"{'x' * 251}.jpg", f"{'x' * 251}.png", f"{'x' * 250}y.png"]
    cut = depth_names(names)
    assert len(set(cut)) == 3
    assert all(len(name) == 255 and name.endswith(".png") for name in cut)


def test_nerfstudio_cameras_project_points_to_the_photos(tmp_path):
    scene = room(4, (48, 64), 7, 5)
    export(scene, tmp_path, ["nerfstudio"], max_points=100)
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert content["camera_model"] == "OPENCV"
    assert (tmp_path / content["ply_file_path"]).is_file()
    photos = render(sample_rooms([7], frames=4), 48 * PHOTO_SCALE, 64 * PHOTO_SCALE)
    world = depth_to_world(photos.depth_z[0], photos.K[0], photos.T_cam_world[0])
    for view, frame in enumerate(content["frames"]):
        assert frame["file_path"] == f"images/{scene.names[view]}"
        assert (frame["h"], frame["w"]) == (96, 128)
        row, column = 30, 70
        point = np.append(world[view, row, column].numpy(), 1.0)
        x, y, z, _ = np.linalg.inv(np.array(frame["transform_matrix"])) @ point
        assert z < 0, "OpenGL cameras look along -z"
        place = (frame["cx"] - frame["fl_x"] * x / z, frame["cy"] + frame["fl_y"] * y / z)
        np.testing.assert_allclose(place, (column + 0.5, row + 0.5), atol=1e-2)


@pytest.mark.parametrize("scale", [None, Scale(value=2.0, source=METRIC_MODEL)])
def test_files_for_other_tools_say_the_unit(tmp_path, scale):
    scene = replace(room(), scale=scale)
    scene.export(tmp_path, ["ply", "glb", "mesh", "colmap", "depth"], max_tracks=20, voxel=0.2)
    said = "lengths are metres (from a metric model)" if scale else "lengths are up to scale"
    for name in ("points.ply", "mesh.ply"):
        assert f"\ncomment {said}\n".encode() in (tmp_path / name).read_bytes().split(b"end_header")[0]
    assert said in (tmp_path / "colmap" / "README.txt").read_text().lower()
    assert trimesh.load(tmp_path / "scene.glb").metadata["lengths"] == scene.lengths
    assert json.loads((tmp_path / "depth" / "depth.json").read_text())["lengths"] == scene.lengths


def test_opengl_axes_turn_the_camera_and_leave_its_place():
    matrix = opengl_camera_to_world(np.eye(4)[None])[0]
    np.testing.assert_array_equal(matrix @ (0, 1, 0, 0), (0, -1, 0, 0))
    np.testing.assert_array_equal(matrix @ (0, 0, -1, 0), (0, 0, 1, 0))


def test_depth_maps_come_back_within_half_a_step(tmp_path):
    depth = room().depth_z.copy()
    depth[0, 0, 0], depth[1, 2, 3] = np.nan, 0.0
    scene = replace(room(), depth_z=depth)
    export(scene, tmp_path, ["depth"])
    content = json.loads((tmp_path / "depth" / "depth.json").read_text())
    for view, name in enumerate(scene.names):
        with Image.open(tmp_path / "depth" / content["maps"][name]) as image:
            values = np.array(image)
            assert float(image.info["depth_scale"]) == content["scale"]
        assert values.dtype == np.uint16
        valid = np.nan_to_num(depth[view]) > 0
        np.testing.assert_array_equal(values > 0, valid)
        np.testing.assert_allclose(values[valid] * content["scale"], depth[view][valid], atol=0.51 * content["scale"])


def test_depth_names_stay_apart():
    assert depth_names(("a.jpg", "sub/b.JPG")) == ["a.png", "sub/b.png"]
    assert depth_names(("a.jpg", "a.png")) == ["a.jpg.png", "a.png"]
    assert depth_names(("a.jpg", "a.png", "a.jpg.png")) == ["a.jpg.png", "a.png.png", "a.jpg.png.png"]


def test_depth_maps_follow_the_masks_but_not_the_filters_and_say_so(tmp_path):
    scene = room()
    masks = [np.zeros(tuple(hw), np.uint8) for hw in scene.photo_hw]
    masks[1][20:40, 20:40] = 1
    flat = replace(scene, T_cam_world=None, K=None)
    for name, cameras, formats in (("posed", scene, ["depth", "glb"]), ("flat", flat, ["depth"])):
        cameras.export(tmp_path / name, formats, masks=masks, filters=NOTHING)
        content = json.loads((tmp_path / name / "depth" / "depth.json").read_text())
        assert "outside the masks" in content["meaning"] and "not applied" in content["meaning"]
        with Image.open(tmp_path / name / "depth" / content["maps"][scene.names[1]]) as image:
            np.testing.assert_array_equal(np.array(image) > 0, masks_for_model(scene, masks)[1])
        with Image.open(tmp_path / name / "depth" / content["maps"][scene.names[0]]) as image:
            assert not np.array(image).any()


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


def test_a_string_is_one_name():
    assert chosen_formats("ply") == check_formats("ply", ["a.jpg"]) == ["ply"]
