"""Depth maps as files: what they hold, and depth at the size of the photos."""

import json
import logging
import xml.etree.ElementTree as ET
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from exact_rooms import room
from freegeo.cameras.trajectories import read_kitti
from freegeo.data.photos import MemoryPhoto
from freegeo.data.procedural import render, sample_rooms
from freegeo.errors import UserError
from freegeo.export.formats import check_formats, export
from freegeo.export.pixels import mask_for_photo
from freegeo.export.reconstruction import Scale
from freegeo.export.upsampling import upsampled_depth
from freegeo.fusion.filtering import FilterReport

DEPTH_FORMATS = ["depth", "depth-color", "depth-npy"]


def photos_of(scene):
    """The photos of a room: its images, enlarged."""
    return [
        MemoryPhoto(name, cv2.resize(image, hw[::-1], interpolation=cv2.INTER_CUBIC))
        for name, image, hw in zip(scene.names, scene.images, scene.photo_hw.tolist(), strict=True)
    ]


# -- at the photos' size, against truth


@pytest.mark.parametrize(("seed", "factor"), [(3, 4), (11, 6)])
def test_edges_are_closer_to_the_truth_than_bilinear_ones_and_planes_are_exact(seed, factor):
    hw = (60, 80)
    rooms = sample_rooms([seed], frames=1)
    low, high = render(rooms, *hw), render(rooms, hw[0] * factor, hw[1] * factor)
    truth, depth = high.depth_z[0, 0].numpy(), low.depth_z[0, 0].numpy()
    photo = (high.images[0, 0].permute(1, 2, 0) * 255).round().byte().numpy()
    image = cv2.resize(photo, hw[::-1], interpolation=cv2.INTER_AREA)
    scale = np.full(2, 1 / factor)
    found = upsampled_depth(depth, np.ones(hw, bool), image, photo, scale, np.zeros(2))
    bilinear = cv2.resize(depth, truth.shape[::-1], interpolation=cv2.INTER_LINEAR)
    around = np.ones((3, 3), np.uint8)
    near, far = cv2.erode(depth, around), cv2.dilate(depth, around)
    edge = np.kron(far > 1.1 * near, np.ones((factor, factor))) > 0
    error, plain = (np.abs(np.log(one / truth)) for one in (found, bilinear))
    assert edge.sum() > 1000
    assert error[edge].mean() < 0.5 * plain[edge].mean()
    blind = upsampled_depth(depth, np.ones(hw, bool), image * 0, photo * 0, scale, np.zeros(2))
    assert error[edge].mean() < 0.8 * np.abs(np.log(blind / truth))[edge].mean(), "the photo tells where edges are"
    hanging = 0.05  # as far from the truth as pixels between two surfaces are
    assert (error[edge] > hanging).mean() < 0.5 * (plain[edge] > hanging).mean()
    assert error[~edge].mean() < 1.05 * plain[~edge].mean() < 0.005


@settings(max_examples=25, deadline=None, derandomize=True, database=None)
@given(
    seed=st.integers(0, 10_000), scale=st.floats(0.15, 1.6), offset=st.tuples(*[st.floats(-4, 4)] * 2),
    hw=st.tuples(st.integers(5, 30), st.integers(5, 30)), share=st.floats(0, 1),
)  # fmt: skip
def test_depth_lies_between_that_of_the_neighbours_and_only_where_the_map_has_some(seed, scale, offset, hw, share):
    generator = np.random.default_rng(seed)
    height, width = 9, 12
    depth = generator.choice([1.0, 1.02, 5.0], (height, width)) * generator.uniform(0.9, 1.1, (height, width))
    known = generator.random((height, width)) < share
    depth[~known] = generator.choice([np.nan, np.inf, 0.0, 1e9], (~known).sum())
    image, photo = (generator.integers(0, 256, (*size, 3), dtype=np.uint8) for size in ((height, width), hw))
    found = upsampled_depth(depth, known, image, photo, np.full(2, scale), np.array(offset))
    assert found.dtype == np.float32
    for row in range(hw[0]):
        for column in range(hw[1]):
            y, x = (row + 0.5) * scale + offset[1], (column + 0.5) * scale + offset[0]
            j, i = int(np.floor(y)), int(np.floor(x))
            if not (0 <= j < height and 0 <= i < width and known[j, i]):
                assert found[row, column] == 0
                continue
            top, left = int(np.floor(y - 0.5)) - 1, int(np.floor(x - 0.5)) - 1
            window = np.s_[max(top, 0) : top + 4, max(left, 0) : left + 4]
            neighbours = depth[window][known[window]]
            assert neighbours.min() * (1 - 1e-5) <= found[row, column] <= neighbours.max() * (1 + 1e-5)


def test_bands_do_not_show(monkeypatch):
    scene = room(1, (48, 64), 11)
    given = (scene.depth_z[0], scene.depth_z[0] > 2, scene.images[0], photos_of(scene)[0].pixels)
    mapping = (scene.scale_xy[0], scene.offset_xy[0])
    whole = upsampled_depth(*given, *mapping)
    monkeypatch.setattr("freegeo.export.upsampling.BAND", 300)
    np.testing.assert_array_equal(upsampled_depth(*given, *mapping), whole)
    assert (whole > 0).any() and (whole == 0).any()


# -- the files


@pytest.mark.parametrize("size", ["model", "photo"])
def test_all_depth_files_agree_and_say_what_they_are(tmp_path, size, caplog):
    pytest.importorskip("OpenEXR", reason="needs the extra exr")
    import OpenEXR

    caplog.set_level(logging.INFO, "freegeo")
    depth = room(crop=6).depth_z.copy()
    depth[0, 10:20, 10:20] = np.nan
    scene = replace(room(crop=6), depth_z=depth)
    masks = np.ones(depth.shape, bool)
    masks[1, :, :30] = False
    export(scene, tmp_path, [*DEPTH_FORMATS, "depth-exr"], masks=masks, photos=photos_of(scene), depth_size=size)
    told = {name: json.loads((tmp_path / name / "depth.json").read_text()) for name in (*DEPTH_FORMATS, "depth-exr")}
    for folder, about in told.items():
        assert ("interpolated" in about["size"]) == (size == "photo")
        assert (f"{folder}: the size of the maps is" in caplog.text) == (size == "photo")
        assert list(about["maps"]) == list(scene.names)
        assert about["lengths"] == "up to scale"
    for view, name in enumerate(scene.names):
        values = np.load(tmp_path / "depth-npy" / told["depth-npy"]["maps"][name])
        known = masks[view] & np.isfinite(depth[view])
        if size == "model":
            np.testing.assert_array_equal(values, np.where(known, depth[view], 0))
        else:
            assert values.shape == tuple(scene.photo_hw[view])
            np.testing.assert_array_equal(values > 0, mask_for_photo(scene, view, known))
            assert not values[:, :12].any(), "what was cut away has no depth"
        with OpenEXR.File(str(tmp_path / "depth-exr" / told["depth-exr"]["maps"][name])) as file:
            np.testing.assert_array_equal(file.channels()["Y"].pixels, values)
        png = cv2.imread(str(tmp_path / "depth" / told["depth"]["maps"][name]), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(png > 0, values > 0)
        np.testing.assert_allclose(png * told["depth"]["scale"], values, atol=0.51 * told["depth"]["scale"])
        with Image.open(tmp_path / "depth-color" / told["depth-color"]["maps"][name]) as image:
            assert image.mode == "RGB"
            grey = (np.asarray(image) == 128).all(-1)
        np.testing.assert_array_equal(grey, values == 0)


def test_pictures_of_one_depth_have_one_colour_in_all_photos(tmp_path):
    scene = room()
    depth = scene.depth_z.copy()
    depth[:, :4, :4] = 2.5
    depth[0, 20:, 20:] *= 100
    scale = Scale(value=2.0, source="<known> cameras & more")
    export(replace(scene, depth_z=depth, scale=scale), tmp_path, ["depth-color"])
    about = json.loads((tmp_path / "depth-color" / "depth.json").read_text())
    assert about["nearest"] < 2.5 < about["farthest"]
    pictures = [np.asarray(Image.open(tmp_path / "depth-color" / name)).astype(int) for name in about["maps"].values()]
    assert len({tuple(picture[2, 2]) for picture in pictures}) == 1
    assert pictures[0][2, 2].sum() > pictures[0][-1, -1].sum(), "near is bright"
    texts = [element.text for element in ET.parse(tmp_path / "depth-color" / "legend.svg").iter() if element.text]
    assert any("<known> cameras & more" in text for text in texts)
    assert f"{about['nearest']:.3g}" in texts and f"{about['farthest']:.3g}" in texts


def test_masks_that_leave_no_depth_are_told_and_no_file_is_written(tmp_path, caplog):
    masks = np.zeros(room().depth_z.shape, bool)
    done = export(room(), tmp_path, DEPTH_FORMATS, masks=masks)
    assert done.files == [] and list(done.failed) == DEPTH_FORMATS
    assert caplog.text.count("the masks leave no usable pixel") == len(DEPTH_FORMATS)
    assert not [path for path in tmp_path.rglob("*") if path.suffix in (".png", ".npy", ".json", ".svg")]


def test_depth_at_the_photos_size_needs_the_photos(tmp_path):
    with pytest.raises(UserError, match="interpolated by these, and they are not at hand"):
        export(room(), tmp_path, ["ply", "depth-npy"], depth_size="photo")
    assert list(tmp_path.iterdir()) == []
    export(room(), tmp_path, ["kitti"], depth_size="photo")


def test_a_missing_package_is_named_and_left_out_of_all(monkeypatch, caplog):
    import importlib.util

    find = importlib.util.find_spec
    monkeypatch.setattr("freegeo.export.depth_files.find_spec", lambda name: None if name == "OpenEXR" else find(name))
    with pytest.raises(UserError, match=r"pip install 'freegeo\[exr\]'"):
        check_formats(["depth-exr"], ["a.jpg"])
    assert "depth-exr" not in check_formats(["all"], ["a.jpg", "b.jpg"])
    assert "'all' leaves out depth-exr" in caplog.text


# -- nerfstudio's own depth and masks


def test_nerfstudio_gets_depth_of_the_points_and_masks_of_the_user_or_neither(tmp_path, caplog):
    scene, photos = room(), photos_of(room())
    keep = np.zeros(scene.depth_z.shape, bool)
    keep[:, 10:30, 10:30] = True
    masks = np.ones(keep.shape, bool)
    masks[2, :, 40:] = False
    filtered = (keep, FilterReport(pixels=keep.size, removed={}, tolerance=None))
    export(scene, tmp_path, ["nerfstudio"], filtered=filtered, masks=masks, photos=photos)
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert content["depth_unit_scale_factor"] == 0.001
    for view, frame in enumerate(content["frames"]):
        depth = np.load(tmp_path / frame["depth_file_path"]) * content["depth_unit_scale_factor"]
        np.testing.assert_array_equal(depth > 0, mask_for_photo(scene, view, keep[view]))
        middle = depth[40, 40]
        np.testing.assert_allclose(middle, scene.depth_z[view, 20, 20], rtol=0.1)
        with Image.open(tmp_path / frame["mask_path"]) as image:
            np.testing.assert_array_equal(np.asarray(image) > 0, mask_for_photo(scene, view, masks[view]))
    # Without masks, photos or points an earlier export's files go, and none is named.
    export(scene, tmp_path, ["nerfstudio"])
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert "depth_unit_scale_factor" not in content
    assert not {"depth_file_path", "mask_path"} & set(content["frames"][0])
    assert not (tmp_path / "nerfstudio-depth").exists() and not (tmp_path / "masks").exists()
    assert "transforms.json has no depth" in caplog.text


def test_a_kitti_trajectory_is_read_as_the_cameras(tmp_path):
    scene = room()
    export(scene, tmp_path, ["kitti"])
    found = read_kitti(tmp_path / "trajectory-kitti.txt").cameras
    poses = np.linalg.inv(scene.T_cam_world.astype(np.float64))
    np.testing.assert_allclose(np.stack([one.matrix for one in found]), poses, atol=1e-9)
