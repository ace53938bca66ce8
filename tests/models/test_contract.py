"""What holds for every reconstruction model here, on small models with recorded weights."""

import copy
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import nn

TESTS = Path(__file__).parents[1]
sys.path.append(str(TESTS))  # the parity modules are shared with the full parity run and lie beside this folder

import parity_da3  # noqa: E402
import parity_mapanything  # noqa: E402
import parity_pi3  # noqa: E402
import parity_vggt  # noqa: E402
from fixture_tools import relative_error  # noqa: E402
from freegeo.errors import UserError  # noqa: E402
from freegeo.models.mapanything import MapAnything  # noqa: E402
from freegeo.models.pi3 import Pi3  # noqa: E402
from freegeo.models.spec import NO_REFERENCE  # noqa: E402
from freegeo.models.transformer import Block  # noqa: E402
from freegeo.models.vggt import VGGT  # noqa: E402
from freegeo.types import Features, ViewTokens  # noqa: E402
from tiny_models import parts_of  # noqa: E402

FIXTURES = TESTS / "fixtures"
BUILDERS = {
    "da3": lambda: parity_da3.build(FIXTURES / "da3" / "tiny-mlp"),
    "vggt": lambda: parity_vggt.build(FIXTURES / "vggt" / "tiny-smallvar"),
    "pi3": lambda: parity_pi3.build_tiny(FIXTURES / "pi3" / "tiny-pi3"),
    "pi3x": lambda: parity_pi3.build_tiny(FIXTURES / "pi3" / "tiny-pi3x-smallvar"),
    "mapanything": lambda: parity_mapanything.build(FIXTURES / "mapanything" / "tiny-smallvar"),
}
LAST, MIDDLE = -1, -2

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module", params=BUILDERS)
def model(request):
    return BUILDERS[request.param]()


def images(views: int = 5, height: int = 28, width: int = 42, batch: int = 1) -> torch.Tensor:
    return torch.rand(batch, views, 3, height, width, generator=torch.Generator().manual_seed(3))


def assert_features_close(ours: Features, wanted: Features, tolerance: float = 1e-5):
    assert ours.levels.keys() == wanted.levels.keys()
    for layer in wanted.levels:
        for mine, other in zip(ours.levels[layer], wanted.levels[layer], strict=True):
            assert relative_error(mine, other) <= tolerance


def layers_of(model) -> tuple[int, ...]:
    """Layers of blocks; Pi3's losses compare only what comes after them."""
    return tuple(range(model.config.pairs)) if isinstance(model, Pi3) else model.spec.loss_layers


def depth_without_unit(model, features: Features) -> torch.Tensor:
    """Depth before the factor to metres, which may depend on the views that are decoded together."""
    found = model.decode(features, want=("depth",))
    return found.depth_z if found.scale is None else found.depth_z / found.scale[:, :1, None, None]


def block_calls(model: nn.Module, call) -> int:
    counted = []
    hooks = [m.register_forward_hook(lambda *_: counted.append(1)) for m in model.modules() if isinstance(m, Block)]
    call()
    for hook in hooks:
        hook.remove()
    return len(counted)


@torch.no_grad()
def test_tokens_of_selected_views_equal_those_of_selected_images(model):
    # In float64: a matrix of other height may be multiplied in another order.
    model, x, kept = copy.deepcopy(model).double(), images().double(), [0, 2, 4]
    selected, alone = model.embed(x).select(kept), model.embed(x[:, kept])
    assert (selected.image_hw, selected.grid_hw, selected.extra.keys()) == (
        alone.image_hw, alone.grid_hw, alone.extra.keys(),
    )  # fmt: skip
    for one, two in zip(parts_of(selected), parts_of(alone), strict=True):
        assert relative_error(one, two) <= 1e-12


@torch.no_grad()
def test_student_shares_the_teachers_tokens(model):
    x, kept = images(), [0, 2, 4]
    tokens = model.embed(x)
    together = ViewTokens.join_views([model.embed(x[:, [i]]) for i in range(5)])
    assert_features_close(model.aggregate(together), model.aggregate(tokens))
    assert_features_close(model.aggregate(tokens.select(kept)), model.aggregate(model.embed(x[:, kept])))


@torch.no_grad()
def test_fewer_views_change_the_features_of_those_that_stay(model):
    tokens, kept = model.embed(images()), [0, 2, 4]
    of_all, of_kept = model.aggregate(tokens).select(kept), model.aggregate(tokens.select(kept))
    last = max(of_all.levels)
    assert relative_error(of_all.levels[last][0], of_kept.levels[last][0]) > 1e-4


@torch.no_grad()
def test_scenes_of_a_batch_do_not_see_each_other(model):
    tokens = model.embed(images(views=3, batch=2))
    together = model.aggregate(tokens)
    for scene in (0, 1):
        alone = model.aggregate(model.embed(images(views=3, batch=2)[[scene]]))
        of_scene = {layer: tuple(part[[scene]] for part in level) for layer, level in together.levels.items()}
        assert_features_close(replace(together, levels=of_scene), alone)


@torch.no_grad()
def test_views_after_the_first_may_come_in_any_order(model):
    order = [0, 3, 1, 4, 2]
    tokens = model.embed(images())
    features = model.aggregate(tokens)
    assert_features_close(model.aggregate(tokens.select(order)), features.select(order))
    swapped = model.aggregate(tokens.select([1, 0, 2, 3, 4])).select([1, 0, 2, 3, 4])
    last = max(features.levels)
    changed = relative_error(swapped.levels[last][0], features.levels[last][0])
    assert changed <= 1e-5 if model.spec.reference == NO_REFERENCE else changed > 1e-4


@torch.no_grad()
def test_cameras_and_maps_follow_the_order_of_the_views(model):
    order = [0, 3, 1, 4, 2]
    tokens = model.embed(images())
    found = model.decode(model.aggregate(tokens))
    shuffled = model.decode(model.aggregate(tokens.select(order)))
    for name in ("depth_z", "conf", "T_cam_world", "K"):
        assert relative_error(getattr(shuffled, name), getattr(found, name)[:, order]) <= 1e-4


@torch.no_grad()
def test_nothing_above_the_last_layer_asked_for_is_computed(model):
    tokens = model.embed(images(views=3))
    middle, last = layers_of(model)[MIDDLE], layers_of(model)[LAST]
    until_middle = block_calls(model, lambda: model.aggregate(tokens, layers=[middle]))
    until_last = block_calls(model, lambda: model.aggregate(tokens))
    blocks_per_layer = 2 if isinstance(model, VGGT | Pi3) else 1
    assert until_last - until_middle == blocks_per_layer * (last - middle)


@torch.no_grad()
def test_layers_asked_for_alone_are_the_same(model):
    tokens = model.embed(images(views=3))
    middle, last = layers_of(model)[MIDDLE], layers_of(model)[LAST]
    features = model.aggregate(tokens, layers=[middle])
    assert list(features.levels) == [middle]
    patch, special = features.levels[middle]
    wanted_patch, wanted_special = model.aggregate(tokens, layers=[middle, last]).levels[middle]
    assert torch.equal(patch, wanted_patch) and torch.equal(special, wanted_special)
    rows, columns = features.grid_hw
    assert patch.shape[:3] == (1, 3, rows * columns)
    if middle in model.spec.loss_layers:
        assert special.shape[2] == (model.spec.special_tokens if model.camera_token_name else 0)


@torch.no_grad()
def test_decoding_without_its_layers_says_which_are_missing(model):
    features = model.aggregate(model.embed(images(views=2)), layers=model.spec.loss_layers[:2])
    with pytest.raises(UserError, match=r"lack \[\d+(, \d+)?\]"):
        model.decode(features)


@torch.no_grad()
@pytest.mark.parametrize("layers", [[99], [-1], []])
def test_layers_that_do_not_exist_are_refused(model, layers):
    with pytest.raises(UserError, match="has layers 0 to"):
        model.aggregate(model.embed(images(views=2)), layers=layers)


@pytest.mark.parametrize("height_width", [(28, 40), (30, 42)])
def test_sides_must_be_multiples_of_the_patch(model, height_width):
    with pytest.raises(ValueError, match="multiples of 14"):
        model.embed(images(2, *height_width))


@torch.no_grad()
def test_unknown_rules_and_wishes_are_refused(model):
    tokens = model.embed(images(views=3))
    with pytest.raises(UserError, match="reference"):
        model.aggregate(tokens, reference="best")
    with pytest.raises(UserError, match="does not predict tracks"):
        model.decode(model.aggregate(tokens), want=("depth", "tracks"))


@torch.no_grad()
def test_only_what_is_asked_for_is_decoded(model):
    features = model.aggregate(model.embed(images(views=2)))
    depth, cameras = model.decode(features, want=("depth",)), model.decode(features, want=("cameras",))
    assert depth.depth_z.shape == (1, 2, 28, 42) == depth.conf.shape
    assert depth.T_cam_world is depth.K is depth.rays is depth.points is None
    assert cameras.T_cam_world.shape == (1, 2, 4, 4) and cameras.K.shape == (1, 2, 3, 3)
    assert cameras.depth_z is cameras.conf is None
    assert (depth.conf > 1).all()
    # MapAnything measures along rays, which point anywhere with random weights.
    assert (depth.depth_z > 0).all() or isinstance(model, MapAnything)


@torch.no_grad()
def test_chunks_of_dense_maps_join_to_those_of_single_views(model):
    features = model.aggregate(model.embed(images(views=11, height=28, width=14)))
    together = depth_without_unit(model, features)
    alone = torch.cat([depth_without_unit(model, features.select([i])) for i in range(11)], dim=1)
    assert relative_error(together, alone) <= 1e-5


@torch.no_grad()
def test_one_view_is_enough(model):
    found = model.decode(model.aggregate(model.embed(images(views=1))))
    assert found.depth_z.isfinite().all() and found.T_cam_world.isfinite().all() and found.K.isfinite().all()


def test_recomputing_blocks_changes_neither_features_nor_gradients(model):
    cross_view = next(m for m in model.modules() if hasattr(m, "recompute"))
    tokens = model.embed(images(views=3))
    token = model.get_parameter(model.camera_token_name or f"{model.adapter_targets()[0]}.bias")
    results = []
    for recompute in (False, True):
        cross_view.recompute = recompute
        token.requires_grad_(True).grad = None
        last = model.spec.loss_layers[LAST]
        loss = model.aggregate(tokens, layers=[last]).levels[last][0].square().mean()
        loss.backward()
        results.append((loss.detach(), token.grad.clone()))
    cross_view.recompute = False
    token.requires_grad_(False)
    assert torch.equal(results[0][0], results[1][0])
    assert relative_error(results[1][1], results[0][1]) <= 1e-5
    largest = results[0][1].abs()
    assert (largest.amax(dim=tuple(range(2, token.ndim))).min() if model.camera_token_name else largest.max()) > 0


def test_adapter_targets_are_all_linears_of_the_cross_view_blocks(model):
    targets = model.adapter_targets()
    assert len(set(targets)) == len(targets) > 0
    assert all(isinstance(model.get_submodule(name), nn.Linear) for name in targets)
    used = set()
    hooks = [
        module.register_forward_hook(lambda *_, name=name: used.add(name))
        for name, module in model.named_modules()
        if isinstance(module, nn.Linear)
    ]
    with torch.no_grad():
        tokens = model.embed(images(views=2))
        used.clear()
        model.aggregate(tokens)
    for hook in hooks:
        hook.remove()
    assert used == set(targets)
