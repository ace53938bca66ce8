"""Pi3 and Pi3X reproduce recorded numbers; all views are alike, and what is known of them is used as described."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image
from torch import nn

TESTS = Path(__file__).parents[1]
sys.path.append(str(TESTS))  # the parity modules are shared with the full parity run and lie beside this folder

from fixture_tools import relative_error  # noqa: E402
from freegeo.adaptation.adapt import adapt  # noqa: E402
from freegeo.adaptation.adapter import count_trainable  # noqa: E402
from freegeo.data.photos import load_photos  # noqa: E402
from freegeo.errors import UserError  # noqa: E402
from freegeo.geometry.local_points import K_from_local_points  # noqa: E402
from freegeo.geometry.rotation import closest_rotation  # noqa: E402
from freegeo.geometry.se3 import from_Rt  # noqa: E402
from freegeo.models.catalog import build_empty  # noqa: E402
from freegeo.models.images import read_some  # noqa: E402
from freegeo.models.memory import shape_of  # noqa: E402
from freegeo.models.pi3_priors import given_of, pose_tables, turn  # noqa: E402
from freegeo.models.precision import Compute  # noqa: E402
from freegeo.types import Priors, ViewTokens  # noqa: E402
from parity_pi3 import cases  # noqa: E402
from parity_vggt_functions import synthetic  # noqa: E402
from rotations import rotation_of  # noqa: E402
from tiny_models import noise, noise_scene, quick, tiny_pi3, tiny_pi3x  # noqa: E402

RECORDED = dict(cases(TESTS / "fixtures" / "pi3"))
VIEWS = 4
CAUTION = build_empty("pi3").spec.adaptation.caution


def random_rotations(count: int, generator: torch.Generator) -> torch.Tensor:
    return rotation_of(torch.randn(count, 3, generator=generator, dtype=torch.float64))


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module", params=[tiny_pi3, tiny_pi3x], ids=["pi3", "pi3x"])
def model(request):
    return request.param()


@pytest.fixture(scope="module")
def pi3x():
    return tiny_pi3x()


@pytest.fixture(scope="module")
def cameras() -> tuple[torch.Tensor, torch.Tensor]:
    """Poses (1, S, 4, 4), float64, and intrinsics of views of noise."""
    generator = torch.Generator().manual_seed(5)
    T = from_Rt(random_rotations(VIEWS, generator), torch.randn(VIEWS, 3, generator=generator, dtype=torch.float64))
    K = torch.tensor([[40.0, 0, 15.5], [0, 38.0, 14.5], [0, 0, 1]]).repeat(VIEWS, 1, 1)
    return T[None], K[None]


def test_recorded_cases_are_found():
    assert len(RECORDED) == 18


@pytest.mark.parametrize("check", RECORDED.values(), ids=RECORDED.keys())
def test_recorded_case(check: Callable[[], float]):
    assert check() <= 1


@pytest.mark.parametrize("name", ["pi3", "pi3x"])
def test_trainable_values_at_rank_32(name):
    built = build_empty(name)
    assert len(built.adapter_targets()) == 36 * 4
    assert count_trainable(built, 32) == 18_874_368


@torch.no_grad()
def test_all_views_are_alike(model):
    order = [2, 0, 3, 1]
    tokens = model.embed(noise(VIEWS)[None])
    found = model.decode(model.aggregate(tokens), want=("depth", "cameras", "points"))
    shuffled = model.decode(model.aggregate(tokens.select(order)), want=("depth", "cameras", "points"))
    for name in ("depth_z", "conf", "T_cam_world", "K", "points"):
        assert relative_error(getattr(shuffled, name), getattr(found, name)[:, order]) <= 1e-4


@torch.no_grad()
def test_features_of_fewer_views_differ_and_share_the_tokens(model):
    tokens, kept = model.embed(noise(VIEWS)[None]), [0, 2]
    layers = range(model.config.pairs + 1)
    every, few = (
        model.aggregate(tokens, layers=layers).select(kept),
        model.aggregate(tokens.select(kept), layers=layers),
    )
    alone = model.aggregate(model.embed(noise(VIEWS)[kept][None]), layers=layers)
    for level in layers:
        assert relative_error(few.levels[level][0], alone.levels[level][0]) <= 1e-5
        assert relative_error(few.levels[level][0], every.levels[level][0]) > 1e-4


@torch.no_grad()
def test_each_view_is_read_out_alone_but_for_the_metres(model):
    features = model.aggregate(model.embed(noise(VIEWS)[None]))
    every, some = model.decode(features), model.decode(features.select([1, 3]))
    factor = 1.0 if some.scale is None else some.scale[0, 0] / every.scale[0, 0]
    assert relative_error(some.depth_z, every.depth_z[:, [1, 3]] * factor) <= 1e-5
    assert relative_error(some.K, every.K[:, [1, 3]]) <= 1e-5
    assert relative_error(some.T_cam_world[..., :3, :3], every.T_cam_world[:, [1, 3], :3, :3]) <= 1e-5
    assert (some.scale is None) == (not model.spec.metric)


@torch.no_grad()
def test_depth_intrinsics_and_cameras_give_the_world_points(model):
    """Local points lie off the pixels' rays of one K, so the depths agree and the middle of the image does."""
    found = model.decode(model.aggregate(model.embed(noise(VIEWS)[None])), want=("depth", "cameras", "points"))
    local = torch.einsum("bsij,bshwj->bshwi", found.T_cam_world[..., :3, :3], found.points[..., :3])
    local = local + found.T_cam_world[..., None, None, :3, 3]
    assert relative_error(local[..., 2], found.depth_z) <= 1e-5
    assert torch.equal(found.points[..., 3], found.conf)
    assert torch.equal(found.K[..., :2, 2], torch.full((1, VIEWS, 2), 15.5))


@torch.no_grad()
def test_what_losses_compare_has_no_special_tokens(model):
    tokens = model.embed(noise(2)[None])
    [(patch, special)] = model.aggregate(tokens, layers=model.spec.loss_layers).levels.values()
    assert patch.shape == (1, 2, 16, model.feature_channels) and special.shape[2] == 0
    assert shape_of(model).channels == model.feature_channels != 2 * model.config.width
    assert model.camera_token_name is None


def test_no_other_view_can_be_the_reference(model):
    tokens = model.embed(noise(3)[None])
    with torch.no_grad():
        for rule in ("first", "none"):
            model.aggregate(tokens, reference=rule)
    with pytest.raises(UserError, match="treats all views alike"):
        model.aggregate(tokens, reference="middle")


def test_layers_wishes_and_missing_levels_are_named(model):
    tokens = model.embed(noise(2)[None])
    with pytest.raises(UserError, match="has layers 0 to 2"):
        model.aggregate(tokens, layers=[3])
    with pytest.raises(UserError, match="does not predict tracks"):
        model.decode(model.aggregate(tokens), want=("tracks",))
    with pytest.raises(UserError, match="lack"):
        model.decode(model.aggregate(tokens, layers=model.spec.loss_layers))


def test_adapter_targets_are_the_linears_that_the_features_go_through(model):
    used = set()
    hooks = [
        module.register_forward_hook(lambda *_, name=name: used.add(name))
        for name, module in model.named_modules()
        if isinstance(module, nn.Linear)
    ]
    with torch.no_grad():
        tokens = model.embed(noise(2)[None])
        used.clear()
        model.aggregate(tokens)
    for hook in hooks:
        hook.remove()
    assert used == set(model.adapter_targets())


def test_an_adaptation_learns(model):
    fresh = type(model)(model.config, model.spec)
    fresh.load_state_dict(model.state_dict())
    result = adapt(fresh.requires_grad_(False).eval(), [noise_scene(8)], quick(model, steps=12, hold=0.5), seed=42)
    learned = [terms["intra"] for terms in result.curve]
    assert sum(learned[-4:]) < sum(learned[:4])
    assert result.trouble is None


def test_whoever_adapts_pi3_is_warned(caplog):
    model = tiny_pi3()
    model.spec = replace(model.spec, adaptation=replace(model.spec.adaptation, caution=CAUTION))
    adapt(model, [noise_scene(4)], quick(model, steps=1), seed=42)
    assert CAUTION in caplog.messages
    assert "worse after adapting it" in CAUTION


def test_pi3_takes_nothing_beside_photos(cameras):
    model, (T, K) = tiny_pi3(), cameras
    with pytest.raises(UserError, match="takes no cameras"):
        model.aggregate(model.embed(noise(VIEWS)[None]), priors=Priors(T_cam_world=T, K=K))


def last_level(model, tokens: ViewTokens, priors: Priors | None = None) -> torch.Tensor:
    with torch.no_grad():
        return model.aggregate(tokens, priors=priors).levels[model.config.last_pair][0]


def test_the_frame_and_unit_of_known_poses_do_not_matter(pi3x, cameras):
    T, _ = cameras
    tokens = pi3x.embed(noise(VIEWS)[None])
    told = last_level(pi3x, tokens, Priors(T_cam_world=T))
    assert relative_error(told, last_level(pi3x, tokens)) > 1e-3
    generator = torch.Generator().manual_seed(6)
    move = from_Rt(random_rotations(1, generator), torch.randn(1, 3, generator=generator, dtype=torch.float64))
    moved = T @ move
    moved[..., :3, 3] *= 7
    assert relative_error(last_level(pi3x, tokens, Priors(T_cam_world=moved)), told) <= 1e-5


def test_any_part_may_be_known(pi3x, cameras):
    T, K = cameras
    tokens = pi3x.embed(noise(VIEWS)[None])
    depth = torch.rand(1, VIEWS, 32, 32, generator=torch.Generator().manual_seed(7)) + 1
    depth[:, 1] = 0
    some = torch.tensor([False, True, True, False])
    nothing = last_level(pi3x, tokens)
    found = {
        "K": last_level(pi3x, tokens, Priors(K=K)),
        "K of some": last_level(pi3x, tokens, Priors(K=K, has_K=some)),
        "poses of some": last_level(pi3x, tokens, Priors(T_cam_world=T, has_pose=some)),
        "depth of some": last_level(pi3x, tokens, Priors(depth_z=depth)),
        "all": last_level(pi3x, tokens, Priors(T_cam_world=T, K=K, depth_z=depth)),
    }
    for one in found.values():
        assert relative_error(one, nothing) > 1e-3
    # A view's placeholder has no part in anything.
    other = T.clone()
    other[:, ~some] = torch.eye(4, dtype=T.dtype)
    other[:, ~some, :3, 3] = 100
    again = last_level(pi3x, tokens, Priors(T_cam_world=other, has_pose=some))
    assert relative_error(again, found["poses of some"]) <= 1e-6
    one = Priors(T_cam_world=T, has_pose=torch.tensor([True, False, False, False]))
    assert torch.equal(last_level(pi3x, tokens, one), nothing)


@torch.no_grad()
def test_known_poses_are_prepared_in_float32_under_autocast(cameras):
    T, _ = cameras
    x = torch.randn(2, VIEWS * 16, 16, generator=torch.Generator().manual_seed(10))

    def turned() -> list[torch.Tensor]:
        given = given_of(Priors(T_cam_world=T), (32, 32), T.device)
        tables = pose_tables(given.T_cam_world[0], (4, 4), 16)
        return [given.T_cam_world, *(turn(x, tables, what) for what in ("query", "value", "output"))]

    exact = turned()
    with Compute(precision="bf16").autocast():
        for found, expected in zip(turned(), exact, strict=True):
            assert torch.equal(found, expected)


@torch.no_grad()
def test_what_losses_compare_is_read_in_float32_under_autocast(model):
    with Compute(precision="bf16").autocast():
        tokens = model.embed(noise(2)[None])
        levels = model.aggregate(tokens, layers=[model.config.last_pair, model.config.readout]).levels
    readout = levels[model.config.readout][0]
    assert torch.equal(readout, model.point_decoder.first_norm(levels[model.config.last_pair][0]))


def test_what_stands_for_unknown_intrinsics_has_no_part(pi3x, cameras):
    _, K = cameras
    tokens, some = pi3x.embed(noise(VIEWS)[None]), torch.tensor([True, False, True, False])
    told = last_level(pi3x, tokens, Priors(K=K, has_K=some))
    other = K.clone()
    other[:, ~some] = torch.nan
    assert torch.equal(last_level(pi3x, tokens, Priors(K=other, has_K=some)), told)


@pytest.mark.parametrize("near", [0.0, 1e-6, 1e-2])
def test_the_gradient_of_the_closest_rotation_is_finite_and_right(near):
    generator = torch.Generator().manual_seed(8)
    matrix = random_rotations(20, generator) + near * torch.randn(20, 3, 3, generator=generator, dtype=torch.float64)
    matrix.requires_grad_(True)
    assert torch.autograd.gradcheck(closest_rotation, matrix, eps=1e-6, atol=1e-5)
    single = matrix.detach().float().requires_grad_(True)
    closest_rotation(single).sum().backward()
    assert single.grad.isfinite().all()


def test_intrinsics_come_from_points_whatever_a_few_of_them_are():
    height, width = 24, 32
    generator = torch.Generator().manual_seed(9)
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    depth = 1 + torch.rand(height, width, generator=generator)
    points = torch.stack(((u - 15.5) / 30 * depth, (v - 11.5) / 33 * depth, depth), dim=-1)
    exact = K_from_local_points(points, torch.ones(height, width))
    assert relative_error(exact, torch.tensor([[30, 0, 15.5], [0, 33, 11.5], [0, 0, 1]])) <= 1e-5
    wild = points.clone()
    wild[torch.rand(height, width, generator=generator) < 0.05] *= torch.tensor([9.0, -5.0, 1.0])
    wild[0, 0], wild[3, 3, 2] = torch.nan, -1
    robust = K_from_local_points(wild, torch.ones(height, width))
    assert relative_error(robust, exact) <= 1e-3


@pytest.fixture
def photos(tmp_path):
    for k, (width, height) in enumerate([(400, 300), (200, 300), (400, 300)]):
        Image.fromarray(synthetic(width, height)).save(tmp_path / f"{k}.png")
    return load_photos(tmp_path)


def test_photos_of_other_shapes(model, photos):
    cut, squashed, padded = (model.preprocess(photos, mixed=rule) for rule in ("crop", "upstream", "pad"))
    assert squashed.image_hw[1] > squashed.image_hw[0]
    scale = squashed.scale_xy[1]
    assert squashed.seen_share().min() == 1 and scale[0] / scale[1] > 1.9
    assert cut.seen_share()[1] < 0.8 and relative_error(cut.scale_xy[1, 0], cut.scale_xy[1, 1]) < 0.02
    assert not padded.inside().all()


@pytest.mark.parametrize("rule", ["crop", "upstream", "pad"])
def test_some_of_many_photos_are_read_as_beside_all_of_them(model, photos, rule):
    whole, some = model.preprocess(photos, mixed=rule), read_some(model, photos, [2, 1], rule)
    assert some.names == ("2.png", "1.png")
    assert torch.equal(some.images, whole.images[[2, 1]])
    assert torch.equal(some.scale_xy, whole.scale_xy[[2, 1]])
