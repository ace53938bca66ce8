"""VGGT reproduces recorded numbers; its variants, limits and ways to read photos are as described."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

TESTS = Path(__file__).parents[1]
sys.path.append(str(TESTS))  # parity_vggt.py is shared with the full parity run and lies beside this folder

from freegeo.data.photos import load_photos  # noqa: E402
from freegeo.errors import UserError  # noqa: E402
from freegeo.geometry.camera import photo_K  # noqa: E402
from freegeo.models.catalog import build_empty  # noqa: E402
from freegeo.models.vggt import CameraHead  # noqa: E402
from freegeo.models.vggt_config import VGGTConfig  # noqa: E402
from freegeo.models.vggt_images import apply_plan, plan_size, preprocess  # noqa: E402
from freegeo.types import Priors  # noqa: E402
from parity_vggt import build, cases  # noqa: E402
from parity_vggt_functions import synthetic  # noqa: E402

FOLDER = TESTS / "fixtures" / "vggt"
RECORDED = dict(cases(FOLDER))


@pytest.fixture(scope="module")
def model():
    return build(FOLDER / "tiny-smallvar")


@pytest.fixture
def photos(tmp_path):
    def write(*sizes_wh):
        for k, (width, height) in enumerate(sizes_wh):
            Image.fromarray(synthetic(width, height)).save(tmp_path / f"{k}.png")
        return load_photos(tmp_path)

    return write


def test_recorded_cases_are_found():
    assert len(RECORDED) == 8


@pytest.mark.parametrize("check", RECORDED.values(), ids=RECORDED.keys())
def test_recorded_case(check: Callable[[], float]):
    assert check() <= 1


def test_trainable_values_at_rank_32():
    model = build_empty("vggt-1b")
    linears = [model.get_submodule(name) for name in model.adapter_targets()]
    assert len(linears) == 2 * 24 * 4
    lora = sum(32 * (linear.in_features + linear.out_features) for linear in linears)
    assert lora == 25_165_824
    assert lora + model.get_parameter(model.camera_token_name).numel() == 25_167_872


def test_both_variants_share_the_architecture_and_differ_in_the_licence():
    free, commercial = build_empty("vggt-1b"), build_empty("vggt-1b-commercial")
    assert free.config == commercial.config
    assert "non-commercial" in free.spec.weights_licence
    assert commercial.spec.weights_licence.startswith("VGGT License")
    assert (free.spec.loss_layers, free.spec.special_tokens, free.spec.default_side) == ((4, 11, 17, 23), 5, 504)


@torch.no_grad()
def test_other_references_and_known_cameras_are_refused(model):
    tokens = model.embed(torch.rand(1, 3, 3, 28, 28))
    with pytest.raises(UserError, match="first view as reference"):
        model.aggregate(tokens, reference="saddle_balanced")
    priors = Priors(T_cam_world=torch.eye(4).repeat(1, 3, 1, 1), K=torch.eye(3).repeat(1, 3, 1, 1))
    with pytest.raises(UserError, match="takes no cameras"):
        model.aggregate(tokens, priors=priors)


@torch.no_grad()
def test_points_are_read_only_when_asked_for(model):
    features = model.aggregate(model.embed(torch.rand(1, 2, 3, 28, 42)))
    assert model.decode(features).points is None
    found = model.decode(features, want=("points",))
    assert found.points.shape == (1, 2, 28, 42, 4)
    assert (found.points[..., 3] > 1).all() and found.depth_z is None


def test_camera_steps_do_not_send_gradients_into_each_other():
    torch.manual_seed(0)
    head = CameraHead(channels=16, depth=1, heads=2)
    token = torch.randn(1, 3, 16)
    head(token, steps=2)[1].sum().backward()
    assert head.empty_pose_tokens.grad is None, "the second step must not see how the first one came about"
    head(token, steps=1)[0].sum().backward()
    assert head.empty_pose_tokens.grad.abs().max() > 0


def test_a_config_whose_last_layer_is_not_read_is_refused(model):
    values = {**vars(model.config), "depth": model.config.depth + 1}
    with pytest.raises(ValueError, match="out_layers must ascend to the last layer"):
        VGGTConfig(**values)


def test_upstream_pads_mixed_sizes_white_around_the_centre(model, photos):
    batch = model.preprocess(photos((64, 48), (48, 64)), mixed="upstream")
    assert batch.images.shape == (2, 3, 504, 504)
    assert torch.equal(batch.scale_xy, torch.full((2, 2), 7.875, dtype=torch.float64))
    assert batch.offset_xy.tolist() == [[0.0, 63.0], [63.0, 0.0]]
    assert (batch.images[0, :, :63] == 1).all() and (batch.images[0, :, 441:] == 1).all()
    assert (batch.images[1, :, :, :63] == 1).all() and not (batch.images[1, :, :, 63:70] == 1).all()


def test_the_odd_pixel_of_a_border_is_at_the_end(photos):
    batch = preprocess(photos((70, 21), (70, 28)), side=70, patch=7, mixed="upstream")
    assert batch.images.shape == (2, 3, 28, 70)
    assert batch.offset_xy.tolist() == [[0.0, 3.0], [0.0, 0.0]]
    assert (batch.images[0, :, [0, 2, 24, 27]] == 1).all()
    assert not (batch.images[0, :, 3] == 1).all() and not (batch.images[0, :, 23] == 1).all()


def test_intrinsics_return_to_the_photo(model, photos):
    batch = model.preprocess(photos((90, 160), (120, 160)))
    assert all(n % 14 == 0 for n in batch.images.shape[-2:])
    K = torch.tensor([[[100.0, 0.0, 44.0], [0.0, 110.0, 80.0], [0.0, 0.0, 1.0]]]).repeat(2, 1, 1).double()
    assert torch.allclose(photo_K(batch.model_K(K), batch.scale_xy, batch.offset_xy), K)


def test_a_mark_lands_where_scale_and_offset_say(tmp_path):
    pixels = np.full((180, 110, 3), 128, np.uint8)
    pixels[80:84, 50:54] = (255, 0, 0)
    Image.fromarray(pixels).save(tmp_path / "mark.png")
    batch = preprocess(load_photos(tmp_path), side=70, patch=14)
    redness = (batch.images[0, 0] - batch.images[0, 1]).clamp(min=0)
    rows, columns = torch.meshgrid(*(torch.arange(n) + 0.5 for n in redness.shape), indexing="ij")
    found = torch.stack([(redness * axis).sum() / redness.sum() for axis in (columns, rows)])
    expected = torch.tensor([52.0, 82.0]) * batch.scale_xy[0] + batch.offset_xy[0]
    assert (found - expected).abs().max() < 0.1


@pytest.mark.parametrize("size_wh", [(13, 40), (400, 4)])
def test_photos_smaller_than_a_patch_are_refused(photos, size_wh):
    with pytest.raises(UserError, match=r"0\.png: a photo of \d+ x \d+ pixels is too small or too narrow"):
        preprocess(photos(size_wh), side=518, patch=14)


@pytest.mark.parametrize("size_wh", [(504, 494), (520, 481), (640, 27), (511, 300), (27, 640)])
def test_shrinking_by_area_equals_opencv_also_where_a_side_grows(size_wh):
    cv2 = pytest.importorskip("cv2")
    pixels = synthetic(*size_wh)
    plan = plan_size(pixels.shape[:2], side=504, patch=14)
    assert plan.step == "area"
    ours = apply_plan(torch.from_numpy(pixels), plan).numpy().astype(int)
    wanted = cv2.resize(pixels, plan.resized[::-1], interpolation=cv2.INTER_AREA).astype(int)
    assert np.abs(ours - wanted).max() <= 1
