from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from freegeo.geometry import se3
from freegeo.geometry.camera import K_from_fov
from freegeo.geometry.depth import unproject
from freegeo.geometry.rotation import matrix_to_quat_xyzw
from freegeo.training.batches import to_batch
from freegeo.training.config import TrainConfig
from freegeo.training.objective import (
    Choice,
    camera_terms,
    camera_tokens,
    cell_depth_term,
    cell_targets,
    depth_terms,
    geometry_terms,
    objective,
    zero_motion_rotation,
)
from freegeo.training.state import new_state
from freegeo.types import Features


@pytest.fixture(scope="module")
def batch(request):
    return to_batch(request.getfixturevalue("rooms"))


def features_of(batch, channels=4):
    samples, views, _, height, width = batch.images.shape
    grid = (height // 8, width // 8)
    token = torch.zeros(samples, views, 1, channels)
    patches = torch.zeros(samples, views, grid[0] * grid[1], channels)
    return Features(levels=dict.fromkeys((3, 5, 7, 9), (patches, token)), image_hw=(height, width), grid_hw=grid)


def camera_reader(encoding):
    return SimpleNamespace(cam_dec=lambda token: encoding, config=SimpleNamespace(out_layers=(3, 5, 7, 9)))


def true_encoding(batch):
    quat = matrix_to_quat_xyzw(batch.T_world_cam[..., :3, :3])
    return torch.cat([batch.T_world_cam[..., :3, 3], quat, batch.fov_vh], dim=-1)


def test_true_cameras_cost_nothing(batch):
    terms = camera_terms(camera_reader(true_encoding(batch)), features_of(batch), batch, TrainConfig())
    for name, value in terms.items():
        assert value < 1e-5, name


def test_standing_still_costs_the_zero_motion_value(batch):
    encoding = true_encoding(batch)
    encoding[..., 3:7] = torch.tensor([0.0, 0.0, 0.0, 1.0])
    config = TrainConfig()
    terms = camera_terms(camera_reader(encoding), features_of(batch), batch, config)
    torch.testing.assert_close(terms["rotation"], config.weights.rotation * zero_motion_rotation(batch))
    assert terms["rotation"] > 0.05


def test_translation_is_judged_against_the_baseline(batch):
    encoding = true_encoding(batch)
    encoding[..., :3] *= 1.5
    near = camera_terms(camera_reader(encoding), features_of(batch), batch, TrainConfig())["translation"]
    double = batch.T_world_cam.clone()
    double[..., :3, 3] *= 2
    larger = replace(batch, T_world_cam=double)
    encoding = true_encoding(larger)
    encoding[..., :3] *= 1.5
    far = camera_terms(camera_reader(encoding), features_of(batch), larger, TrainConfig())["translation"]
    torch.testing.assert_close(near, far, rtol=0.02, atol=0)


def test_cell_targets_agree_with_unprojection(batch):
    height, width = batch.depth_z.shape[-2:]
    K = K_from_fov(*batch.fov_vh.unbind(-1), (height, width))
    # Pixel middles stand half a pixel right of the integer centres that `unproject` uses.
    K[..., 0, 2] -= 0.5
    K[..., 1, 2] -= 0.5
    camera = unproject(batch.depth_z, K)
    R, t = batch.T_world_cam[..., :3, :3], batch.T_world_cam[..., :3, 3]
    world = torch.einsum("bsij,bshwj->bshwi", R, camera) + t[:, :, None, None]
    torch.testing.assert_close(cell_targets(batch, 8).point, world[:, :, 4::8, 4::8], atol=1e-4, rtol=1e-4)


def test_true_rays_and_points_cost_nothing(batch):
    """The linear read-out is replaced by one that knows the answer: only then is its layout tested as well."""
    targets = cell_targets(batch, 4)
    origin = batch.T_world_cam[:, :, None, None, :3, 3].expand_as(targets.direction)
    values = torch.cat([targets.direction, origin, targets.point], dim=-1)  # B S 2h 2w 9
    h, w = batch.images.shape[-2] // 8, batch.images.shape[-1] // 8
    tokens = values.unflatten(2, (h, 2)).unflatten(4, (w, 2)).permute(0, 1, 2, 4, 3, 5, 6).flatten(4).flatten(2, 3)
    rays, points = geometry_terms(SimpleNamespace(geometry=lambda _: tokens), features_of(batch), batch)
    assert max(rays, points) < 1e-5


def test_true_cell_depth_costs_nothing(batch):
    h, w = (n // 8 for n in batch.images.shape[-2:])
    log_depth = batch.depth_z[..., 1::2, 1::2].log()  # B S 4h 4w
    tokens = log_depth.unflatten(2, (h, 4)).unflatten(4, (w, 4)).transpose(3, 4).flatten(4).flatten(2, 3)
    right = SimpleNamespace(log_depth=lambda _: tokens)
    assert cell_depth_term(right, features_of(batch), batch) < 1e-5
    off = SimpleNamespace(log_depth=lambda _: tokens + 0.1)
    torch.testing.assert_close(cell_depth_term(off, features_of(batch), batch), torch.tensor(0.1))


def test_true_depth_has_no_error_and_confidence_no_pull_on_depth(batch):
    depth = batch.depth_z[:, :1].clone().requires_grad_()
    terms = depth_terms(depth, 2 * torch.ones_like(depth), batch.depth_z[:, :1], TrainConfig())
    assert max(terms["depth"], terms["gradient"]) < 1e-5
    off = (batch.depth_z[:, :1] * 1.1).requires_grad_()
    terms = depth_terms(off, 2 * torch.ones_like(off), batch.depth_z[:, :1], TrainConfig())
    torch.testing.assert_close(terms["depth"], TrainConfig().weights.depth * torch.tensor(1.1).log())
    assert not terms["confidence"].requires_grad


def test_confidence_is_best_where_it_says_what_the_error_is(batch):
    conf = torch.tensor(1.5, requires_grad=True)
    shape = batch.depth_z[:, :1].shape
    # 0.3 / 0.2 = 1.5 is the best confidence for a log error of 0.2.
    wrong = batch.depth_z[:, :1] * torch.tensor(0.2).exp()
    terms = depth_terms(wrong, conf.expand(shape), batch.depth_z[:, :1], TrainConfig())
    (gradient,) = torch.autograd.grad(terms["confidence"], conf)
    assert gradient.abs() < 1e-5


def test_objective_reaches_every_parameter_that_training_owns(batch):
    config = TrainConfig(depth_views=1)
    state = new_state(config)
    # A fresh model's last layers are tiny, not zero: everything except unused parts must receive a gradient.
    terms = objective(state.model, state.read_outs, batch, config, 0, torch.Generator().manual_seed(0))
    assert all(torch.isfinite(value) for value in terms.values())
    torch.stack(list(terms.values())).sum().backward()
    without = [name for name, parameter in state.model.named_parameters() if parameter.grad is None]
    unused = ("head.scratch.output_conv1_aux.", "head.scratch.output_conv2_aux.")
    assert all(name.startswith(unused) for name in without), without
    assert all(parameter.grad is not None for parameter in state.read_outs.parameters())


def test_choice_takes_one_view_of_some_samples(batch):
    chosen = Choice(samples=torch.tensor([1]), view=2)
    torch.testing.assert_close(chosen.of(batch.depth_z), batch.depth_z[1:, 2:3])
    assert chosen.of(features_of(batch)).levels[5][0].shape[:2] == (1, 1)


def test_given_cameras_reach_their_samples_only_and_train_the_encoder(batch):
    state = new_state(TrainConfig())
    told = replace(batch, cameras_given=torch.tensor([False, True]))
    tokens, learned = (camera_tokens(state.model, one, torch.Generator().manual_seed(0)) for one in (told, batch))
    assert torch.equal(tokens[0], learned[0]) and not torch.allclose(tokens[1], learned[1])
    image_hw = tuple(batch.images.shape[-2:])
    poses, K = se3.normalise_poses(se3.inverse(batch.T_world_cam)), K_from_fov(*batch.fov_vh.unbind(-1), image_hw)
    expected = state.model.encode_cameras(poses, K, image_hw)
    torch.testing.assert_close(tokens[1], expected[1], atol=1e-4, rtol=1e-4)
    config = TrainConfig(depth_views=1)
    terms = objective(state.model, state.read_outs, told, config, 1, torch.Generator().manual_seed(0))
    torch.stack(list(terms.values())).sum().backward()
    assert all(parameter.grad is not None for parameter in state.model.cam_enc.parameters())


def test_the_unit_of_given_cameras_is_seen_with_two_views_only(batch):
    model = new_state(TrainConfig()).model
    told = replace(batch, cameras_given=torch.tensor([True, True]))
    pair = replace(
        told, images=told.images[:, :2], T_world_cam=told.T_world_cam[:, :2], fov_vh=told.fov_vh[:, :2],
        depth_z=told.depth_z[:, :2],
    )  # fmt: skip
    first, second = (torch.Generator().manual_seed(seed) for seed in (0, 1))
    assert not torch.allclose(camera_tokens(model, pair, first), camera_tokens(model, pair, second), atol=1e-3)
    torch.testing.assert_close(
        camera_tokens(model, told, first), camera_tokens(model, told, second), atol=1e-3, rtol=0
    )  # fmt: skip
