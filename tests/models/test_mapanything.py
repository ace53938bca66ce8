"""MapAnything reproduces recorded numbers; what it is told, its checkpoints and its ways to read photos are as said."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file

TESTS = Path(__file__).parents[1]
sys.path.append(str(TESTS))  # parity_mapanything.py is shared with the full parity run and lies beside this folder

from fixture_tools import relative_error  # noqa: E402
from freegeo.data.photos import load_photos  # noqa: E402
from freegeo.errors import UserError  # noqa: E402
from freegeo.geometry.se3 import from_Rt, inverse  # noqa: E402
from freegeo.models.catalog import build_empty  # noqa: E402
from freegeo.models.checkpoints import load_weights  # noqa: E402
from freegeo.models.mapanything import FUSED, dense_maps  # noqa: E402
from freegeo.models.mapanything_config import KEYS, MAP_ANYTHING, MapAnythingConfig  # noqa: E402
from freegeo.models.mapanything_images import preprocess  # noqa: E402
from freegeo.types import Priors  # noqa: E402
from parity_mapanything import build, cases, empty_model  # noqa: E402
from parity_vggt_functions import synthetic  # noqa: E402
from rotations import rotation_of  # noqa: E402

FOLDER = TESTS / "fixtures" / "mapanything"
WEIGHTS = FOLDER / "tiny-smallvar" / "weights.safetensors"
RECORDED = dict(cases(FOLDER))
HW = (28, 42)


@pytest.fixture(scope="module")
def model():
    return build(FOLDER / "tiny-smallvar")


@pytest.fixture(scope="module")
def tokens(model):
    with torch.no_grad():
        return model.embed(torch.rand(1, 3, 3, *HW, generator=torch.Generator().manual_seed(0)))


@pytest.fixture
def photos(tmp_path):
    def write(*sizes_wh):
        for k, (width, height) in enumerate(sizes_wh):
            Image.fromarray(synthetic(width, height)).save(tmp_path / f"{k}.png")
        return load_photos(tmp_path)

    return write


def known(**changes) -> Priors:
    """Everything that can be known of three views."""
    generator = torch.Generator().manual_seed(1)
    R = rotation_of(torch.randn(3, 3, generator=generator).double())
    t, depth = (torch.rand(*size, generator=generator).double() for size in ((3, 3), (1, 3, *HW)))
    K = torch.tensor([[30.0, 0, 20], [0, 32, 14], [0, 0, 1]]).double().repeat(1, 3, 1, 1)
    return replace(Priors(T_cam_world=from_Rt(R, t)[None], K=K, depth_z=depth + 1), **changes)


@torch.no_grad()
def fused(model, tokens, priors) -> torch.Tensor:
    return model.aggregate(tokens, priors=priors).extra[FUSED]


def test_recorded_cases_are_found():
    assert len(RECORDED) == 10


@pytest.mark.parametrize("check", RECORDED.values(), ids=RECORDED.keys())
def test_recorded_case(check: Callable[[], float]):
    assert check() <= 1


def test_trainable_values_at_rank_32():
    model = build_empty("map-anything")
    linears = [model.get_submodule(name) for name in model.adapter_targets()]
    assert len(linears) == 16 * 4 and model.camera_token_name is None
    assert sum(32 * (linear.in_features + linear.out_features) for linear in linears) == 12_582_912


def test_both_variants_share_the_architecture_and_differ_in_the_licence():
    one, two = build_empty("map-anything"), build_empty("map-anything-apache")
    assert one.config == two.config == MAP_ANYTHING
    assert "NC" in one.spec.weights_licence and two.spec.weights_licence == "Apache-2.0"
    assert (one.spec.loss_layers, one.spec.default_side, one.spec.takes) == ((7, 11, 15), 518, "parts")
    assert one.spec.metric and one.feature_channels == 1536
    # The buffer with the mark of the first view is a tensor of the file, too.
    assert sum(value.numel() for value in one.state_dict().values()) == 1_228_492_758


# What is known of the views -------------------------------------------------------------------------------------------


def test_every_part_changes_what_the_blocks_begin_with(model, tokens):
    parts = {
        "K": known(T_cam_world=None, depth_z=None), "K and depth": known(T_cam_world=None),
        "poses": known(K=None, depth_z=None), "all": known(), "metric": known(metric=True), "none": None,
    }  # fmt: skip
    found = [fused(model, tokens, priors) for priors in parts.values()]
    for i, one in enumerate(found):
        assert all((one - other).abs().max() > 1e-3 * one.abs().max() for other in found[:i])
    assert torch.equal(fused(model, tokens, Priors()), found[-1])


def test_views_of_which_nothing_is_known_stay_as_they_are(model, tokens):
    some = torch.tensor([True, False, True])
    found, alone = fused(model, tokens, known(has_pose=some, has_K=some, depth_z=None)), fused(model, tokens, None)
    assert torch.equal(found[:, 1], alone[:, 1])
    assert not torch.equal(found[:, 0], alone[:, 0]) and not torch.equal(found[:, 2], alone[:, 2])


def test_depth_that_is_not_known_of_a_view_says_nothing(model, tokens):
    depth = known().depth_z
    depth[:, 1] = 0
    found, without = fused(model, tokens, known(depth_z=depth)), fused(model, tokens, known(depth_z=None))
    assert torch.equal(found[:, 1], without[:, 1]) and not torch.equal(found[:, 0], without[:, 0])


def test_poses_are_taken_in_any_world(model, tokens):
    generator = torch.Generator().manual_seed(2)
    moved = from_Rt(rotation_of(torch.randn(3, generator=generator).double()), torch.tensor([1e4, -2e4, 5e3]).double())
    there = known(T_cam_world=known().T_cam_world @ inverse(moved))
    assert relative_error(fused(model, tokens, there), fused(model, tokens, known())) < 1e-4


def test_only_metres_tell_a_length(model, tokens):
    def times(factor, **changes):
        T = known().T_cam_world.clone()
        T[..., :3, 3] *= factor
        return fused(model, tokens, known(T_cam_world=T, depth_z=factor * known().depth_z, **changes))

    assert relative_error(times(10), times(1)) < 1e-4
    assert relative_error(times(10, metric=True), times(1, metric=True)) > 0.1


@pytest.mark.parametrize("has_pose", [(False, True, True), (True, False, False)])
def test_poses_that_say_nothing_are_left_out(model, tokens, has_pose):
    priors = known(has_pose=torch.tensor(has_pose))
    assert torch.equal(fused(model, tokens, priors), fused(model, tokens, known(T_cam_world=None)))


@torch.no_grad()
def test_what_cannot_be_used_is_refused(model, tokens):
    with pytest.raises(UserError, match="depth of a view together with its intrinsics"):
        model.aggregate(tokens, priors=known(has_K=torch.tensor([True, False, True])))
    with pytest.raises(UserError, match="depth of a view together with its intrinsics"):
        model.aggregate(tokens, priors=known(K=None))
    with pytest.raises(UserError, match="first view as reference"):
        model.aggregate(tokens, reference="saddle_balanced")


# Results --------------------------------------------------------------------------------------------------------------


@torch.no_grad()
def test_lengths_are_in_metres_by_one_factor_for_the_scene(model, tokens):
    features = model.aggregate(tokens)
    found = model.decode(features, want=("depth", "cameras", "points"))
    assert found.scale.shape == (1, 2) and found.scale[0, 0] > 0 and found.scale[0, 1].isnan()
    head = model.scale_head.output_proj
    head.bias += torch.tensor(2.0).log()
    twice = model.decode(features, want=("depth", "cameras", "points"))
    head.bias -= torch.tensor(2.0).log()
    for name in ("depth_z", "scale"):
        torch.testing.assert_close(getattr(twice, name), 2 * getattr(found, name), equal_nan=True)
    torch.testing.assert_close(twice.T_cam_world[..., :3, 3], 2 * found.T_cam_world[..., :3, 3])
    torch.testing.assert_close(twice.points[..., :3], 2 * found.points[..., :3])
    assert torch.equal(twice.T_cam_world[..., :3, :3], found.T_cam_world[..., :3, :3])


@torch.no_grad()
def test_pixels_that_the_model_calls_ambiguous_are_no_surface(model, tokens):
    features = model.aggregate(tokens)
    found = model.decode(features)
    levels = [level.flatten(0, 1) for level in model.dense_levels(features)]
    ambiguous = dense_maps(model.dense(levels, features.grid_hw))[3]
    assert torch.equal(found.sky[0] == 1, ambiguous) and torch.equal(found.sky[0] == 0, ~ambiguous)


def test_configs_that_cannot_be_are_refused(model):
    with pytest.raises(ValueError, match="out_layers must ascend to the last block"):
        MapAnythingConfig(**{**vars(model.config), "depth": model.config.depth + 2})
    with pytest.raises(ValueError, match="depth is even"):
        MapAnythingConfig(**{**vars(model.config), "depth": 3, "out_layers": (0, 1, 2)})


# Checkpoints ----------------------------------------------------------------------------------------------------------


def test_a_state_dict_with_every_name_of_a_shared_tensor_is_read(tmp_path):
    tensors = load_file(WEIGHTS)
    doubles = {}
    for name, value in tensors.items():
        for ours, other in (("dense_head.0.", "dpt_feature_head."), ("dense_head.1.", "dpt_regressor_head.")):
            if name.startswith(ours):
                doubles[other + name.removeprefix(ours)] = value.clone()
    for j in range(4):
        value = tensors[f"dense_head.0.input_process.{j}.1.weight"]
        for head in ("dense_head.0.", "dpt_feature_head."):
            doubles |= {f"{head}scratch.{name}.weight": value.clone() for name in (f"layer{j + 1}_rn", f"layer_rn.{j}")}
    assert len(doubles) == 76
    save_file(tensors | doubles, tmp_path / "all.safetensors")
    found = empty_model(FOLDER / "tiny-smallvar")
    load_weights(found, tmp_path / "all.safetensors", KEYS, "tiny")
    assert all(torch.equal(value, tensors[name].float()) for name, value in found.state_dict().items())


def test_the_first_version_is_refused_by_what_it_is(tmp_path):
    save_file({**load_file(WEIGHTS), "info_sharing.proj_embed.weight": torch.zeros(2, 2)}, tmp_path / "v1.safetensors")
    with pytest.raises(UserError, match=r"v1\.safetensors: this is the first version of MapAnything"):
        load_weights(empty_model(FOLDER / "tiny-smallvar"), tmp_path / "v1.safetensors", KEYS, "tiny")


# Images ---------------------------------------------------------------------------------------------------------------


def test_photos_of_one_shape_are_read_alike_by_all_rules(photos):
    found = photos((64, 48), (128, 96))
    batches = [preprocess(found, side=518, patch=14, mixed=mixed) for mixed in ("crop", "pad", "upstream")]
    assert batches[0].images.shape == (2, 3, 392, 518)
    for other in batches[1:]:
        assert torch.equal(other.images, batches[0].images) and torch.equal(other.offset_xy, batches[0].offset_xy)


def test_photos_of_two_shapes(photos):
    found = photos((64, 48), (48, 64), (64, 48))
    sizes = {
        mixed: tuple(preprocess(found, side=518, patch=14, mixed=mixed).image_hw)
        for mixed in ("crop", "pad", "upstream")
    }
    # Upstream takes the size of the mean aspect, 1.14; `crop` that of most photos.
    assert sizes == {"crop": (392, 518), "pad": (518, 518), "upstream": (518, 518)}
    padded = preprocess(found, side=518, patch=14, mixed="pad")
    assert (padded.images[0, :, :63] == 1).all() and (padded.images[0, :, 455:] == 1).all()
    assert not padded.inside()[0, :63].any() and padded.inside()[0, 63:455].all()
    assert (padded.seen_share() > 0.98).all()


def test_as_many_portraits_as_landscapes_meet_in_a_square(photos):
    batch = preprocess(photos((64, 48), (48, 64)), side=70, patch=14)
    assert batch.image_hw == (70, 70)
    assert torch.allclose(batch.seen_share(), torch.tensor(0.75).double(), atol=0.02)


@pytest.mark.parametrize("size_wh", [(110, 180), (301, 97)])
def test_a_mark_lands_where_scale_and_offset_say(tmp_path, size_wh):
    width, height = size_wh
    pixels = np.full((height, width, 3), 128, np.uint8)
    y, x = height // 2 - 9, width // 2 + 7
    pixels[y : y + 4, x : x + 4] = (255, 0, 0)
    Image.fromarray(pixels).save(tmp_path / "mark.png")
    batch = preprocess(load_photos(tmp_path), side=70, patch=14)
    redness = (batch.images[0, 0] - batch.images[0, 1]).clamp(min=0)
    rows, columns = torch.meshgrid(*(torch.arange(n) + 0.5 for n in redness.shape), indexing="ij")
    found = torch.stack([(redness * axis).sum() / redness.sum() for axis in (columns, rows)])
    expected = torch.tensor([x + 2.0, y + 2.0]) * batch.scale_xy[0] + batch.offset_xy[0]
    assert (found - expected).abs().max() < 0.5


@pytest.mark.parametrize("size_wh", [(13, 40), (400, 4)])
def test_photos_smaller_than_a_patch_are_refused(photos, size_wh):
    with pytest.raises(UserError, match=r"0\.png: a photo of \d+ x \d+ pixels is too small or too narrow"):
        preprocess(photos(size_wh), side=518, patch=14)
