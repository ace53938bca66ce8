import shutil

import numpy as np
import pytest
import torch

from fixture_tools import fixture_path
from freegeo.data.colmap_files import read_cameras, read_images
from freegeo.data.datasets import eth3d, scannetpp, sevenscenes
from freegeo.data.datasets import registry as datasets
from freegeo.data.scene import Scene
from freegeo.errors import FreeGeoError, UserError

BENCH = fixture_path("benchmark", "datasets")


def test_published_scene_lists_have_the_published_lengths():
    assert (len(eth3d.SCENES), len(sevenscenes.SCENES), len(scannetpp.SCENES)) == (11, 7, 20)
    assert datasets.scene_names(BENCH, "hiroom") == ["20241230/828805/cam_sampled_06", "20241230/000001/cam_sampled_00"]


def test_eth3d_keeps_file_order_and_drops_filtered_frames():
    scene = datasets.load_scene(BENCH, "eth3d", "delivery_area")
    names = [photo.name for photo in scene.photos]
    assert names[:3] == ["DSC_0690.JPG", "DSC_0686.JPG", "DSC_0687.JPG"]
    assert not {f"DSC_0{number}.JPG" for number in eth3d.EXCLUDED["delivery_area"]} & set(names)
    assert len(scene) == 10


def test_text_and_binary_models_agree(tmp_path):
    """The binary scene rewritten as text gives the same cameras."""
    model = BENCH / "scannetpp" / "1ada7a0617" / "merge_dslr_iphone" / "colmap" / "sparse_render_rgb"
    cameras, images = read_cameras(model), read_images(model)
    lines = [
        f"{c.number} {c.model} {c.size_hw[1]} {c.size_hw[0]} {' '.join(map(repr, c.params))}" for c in cameras.values()
    ]
    (tmp_path / "cameras.txt").write_text("# cameras\n" + "\n".join(lines) + "\n")
    assert read_cameras(tmp_path) == cameras
    text = "".join(f"{n} {_quaternion(i.T_cam_world)} {i.camera} {i.name}\n\n" for n, i in enumerate(images))
    (tmp_path / "images.txt").write_text("# images\n" + text)
    again = read_images(tmp_path)
    assert [(i.name, i.camera) for i in again] == [(i.name, i.camera) for i in images]
    np.testing.assert_allclose([i.T_cam_world for i in again], [i.T_cam_world for i in images], atol=1e-12)


def _quaternion(T: np.ndarray) -> str:
    from freegeo.geometry.rotation import matrix_to_quat_xyzw, quat_xyzw_to_wxyz

    quat_wxyz = quat_xyzw_to_wxyz(matrix_to_quat_xyzw(torch.tensor(T[:3, :3])))
    return " ".join(repr(float(value)) for value in (*quat_wxyz, *T[:3, 3]))


def test_a_damaged_model_is_reported(tmp_path):
    (tmp_path / "cameras.bin").write_bytes(b"\x01\0\0\0\0\0\0\0\x07")
    with pytest.raises(FreeGeoError, match=r"cameras\.bin"):
        read_cameras(tmp_path)
    with pytest.raises(UserError, match="neither"):
        read_images(tmp_path)


def test_poses_are_rigid_and_views_can_be_chosen():
    for dataset, name in (("eth3d", "pipes"), ("7scenes", "stairs"), ("scannetpp", "09c1414f1b")):
        scene = datasets.load_scene(BENCH, dataset, name)
        R = scene.T_cam_world[:, :3, :3]
        torch.testing.assert_close(R @ R.mT, torch.eye(3).expand_as(R), atol=1e-5, rtol=0)
        chosen = scene.select([4, 1])
        assert [photo.name for photo in chosen.photos] == [scene.photos[4].name, scene.photos[1].name]
        assert torch.equal(chosen.K[1], scene.K[1])
        assert chosen.truth.depth == (scene.truth.depth[4], scene.truth.depth[1])


def test_photos_are_decoded_lazily():
    photo = datasets.load_scene(BENCH, "7scenes", "stairs").photos[0]
    assert photo.read().shape == (*photo.size_hw, 3)


def test_only_the_file_name_decides_about_depth(tmp_path):
    """A data folder with `color` in its name keeps its masks."""
    root = tmp_path / "color_data"
    shutil.copytree(BENCH / "7scenes", root)
    scene = sevenscenes.load_scene(root, "stairs")
    assert any(path is not None for path in scene.truth.depth)
    index = next(i for i, path in enumerate(scene.truth.depth) if path)
    assert sevenscenes.valid_mask(scene.truth, index, (48, 64)).any()


def test_a_depth_file_of_the_wrong_size_is_an_error():
    truth = datasets.load_scene(BENCH, "eth3d", "pipes").truth
    index = next(i for i, path in enumerate(truth.depth) if path)
    with pytest.raises(FreeGeoError, match="bytes"):
        eth3d.read_depth(truth.depth[index], (48, 65))
    with pytest.raises(FreeGeoError, match="mask"):
        eth3d.valid_mask(truth, index, (48, 65))


@pytest.mark.parametrize(
    ("dataset", "name"),
    [
        ("eth3d", "pipes"),
        ("7scenes", "stairs"),
        ("scannetpp", "09c1414f1b"),
        ("hiroom", "20241230/828805/cam_sampled_06"),
    ],
)
def test_true_depth_is_metres_and_nothing_where_the_dataset_masks(dataset, name):
    scene = datasets.load_scene(BENCH, dataset, name)
    index = next(i for i, path in enumerate(scene.truth.depth) if path)
    stored = datasets.get_dataset(dataset).read_depth(scene.truth.depth[index], scene.photos[index].size_hw)
    found = datasets.true_depth(scene, stored.shape)
    assert found.shape == (len(scene), *stored.shape)
    kept = datasets.valid_mask(scene.truth, index, stored.shape) & np.isfinite(stored)
    np.testing.assert_array_equal(found[index].numpy(), np.where(kept, stored, 0))
    assert 0.1 < found[index][found[index] > 0].median() < 20
    half = datasets.true_depth(scene, (stored.shape[0] // 2, stored.shape[1] // 2))
    np.testing.assert_array_equal(half, found[:, : stored.shape[0] // 2 * 2 : 2, : stored.shape[1] // 2 * 2 : 2])
    without = [i for i, path in enumerate(scene.truth.depth) if path is None]
    assert all(not found[i].any() for i in without)
    if without:
        assert datasets.true_depth(scene.select(without), stored.shape) is None


@pytest.mark.parametrize(
    ("dataset", "scene"), [("eth3d", "nowhere"), ("7scenes", "fire"), ("hiroom", "a/b/c"), ("dtu", "x")]
)
def test_what_is_missing_is_named(dataset, scene):
    with pytest.raises(UserError, match=r"no such folder|no dataset"):
        datasets.load_scene(BENCH, dataset, scene)


def test_a_scene_with_views_that_do_not_match_is_refused():
    photos = datasets.load_scene(BENCH, "7scenes", "stairs").photos
    with pytest.raises(UserError, match="views"):
        Scene(name="x", photos=photos, K=torch.eye(3)[None])
    assert datasets.constants("hiroom").truth == "points"
