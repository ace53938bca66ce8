"""An adapter changes nothing until trained, can be taken out without a trace, and is trained in full."""

import pytest
import torch
from torch import nn

from freegeo.adaptation.adapter import count_trainable, is_adapted
from freegeo.errors import UserError
from freegeo.models import da3_config, mapanything_config, vggt_config
from freegeo.models.catalog import build_empty
from freegeo.models.checkpoints import load_weights, save_weights
from tiny_models import attach, noise, outputs, same, tiny_da3, tiny_mapanything, tiny_vggt, trained

IMAGES = noise(4)
# docs/method.md, "Adapter files".
GIANT_COUNTS = {8: 5_311_488, 16: 10_619_904, 32: 21_236_736, 64: 42_470_400}
VGGT_COUNTS = {8: 6_293_504, 16: 12_584_960, 32: 25_167_872, 64: 50_333_696}


@pytest.fixture(params=["da3", "da3-swiglu", "vggt", "mapanything"])
def model(request):
    build = {"da3": tiny_da3, "vggt": tiny_vggt, "mapanything": tiny_mapanything}
    return (build | {"da3-swiglu": lambda: tiny_da3(ffn="swiglu")})[request.param]()


def test_a_fresh_adapter_leaves_every_output_bit_identical(model):
    before = outputs(model, IMAGES)
    attach(model, dropout=0.1)
    assert same(outputs(model.eval(), IMAGES), before)


def test_a_fresh_adapter_starts_as_published(model):
    adapter = attach(model)
    for layer in adapter.layers.values():
        bound = layer.in_features**-0.5
        start = layer.lora_A["default"].weight
        assert start.abs().max() <= bound
        assert start.std().item() == pytest.approx(bound / 3**0.5, rel=0.25)
        assert not layer.lora_B["default"].weight.any()
    assert all(torch.equal(a, b) for a, b in zip(adapter.parameters(), attach(again(model)).parameters(), strict=True))


def again(model):
    """Build the same tiny model again."""
    others = {"tiny-vggt": tiny_vggt, "tiny-mapanything": tiny_mapanything}
    return others[model.spec.name]() if model.spec.name in others else tiny_da3(ffn=model.config.ffn)


def test_what_trains_is_the_adapter_and_the_camera_token(model):
    targets = model.adapter_targets()
    adapter = attach(model)
    training = {name for name, parameter in model.named_parameters() if parameter.requires_grad}
    named = adapter.named_parameters()
    lora = {name.replace(".weight", ".default.weight") for name in named if name != "camera_token"}
    token = model.camera_token_name
    assert training == (lora | {token} if token else lora)
    assert named.get("camera_token") is (model.get_parameter(token) if token else None)
    assert sorted(adapter.layers) == sorted(targets)
    assert sum(p.numel() for p in adapter.parameters()) == count_trainable(again(model), 4)


def test_every_part_of_the_adapter_gets_a_gradient(model):
    adapter = attach(model)
    levels = model.aggregate(model.embed(IMAGES[None])).levels
    sum(part.square().sum() for level in levels.values() for part in level).backward()
    for name, parameter in adapter.named_parameters().items():
        assert parameter.grad is not None, name
        if not name.endswith("lora_A.weight"):  # B is zero, so A's gradient is too
            assert parameter.grad.abs().max() > 0, name
    assert not [name for name, p in model.named_parameters() if p.grad is not None and not p.requires_grad]


def test_off_is_the_frozen_model_and_nothing_is_forgotten(model):
    before = outputs(model, IMAGES)
    adapter = trained(model)
    adapted = outputs(model, IMAGES)
    assert not same(adapted, before)
    flags = [number % 2 == 0 for number in range(len(adapter.parameters()))]
    for parameter, flag in zip(adapter.parameters(), flags, strict=True):
        parameter.requires_grad_(flag)
        parameter.grad = torch.ones_like(parameter)
    with adapter.off():
        assert same(outputs(model, IMAGES), before)
        assert not [name for name, parameter in model.named_parameters() if parameter.requires_grad]
    assert same(outputs(model, IMAGES), adapted)
    assert [parameter.requires_grad for parameter in adapter.parameters()] == flags
    assert all((parameter.grad == 1).all() for parameter in adapter.parameters())
    token = model.camera_token_name
    assert adapter.camera_token is (model.get_parameter(token) if token else None)


def test_off_ends_when_its_block_fails():
    model = tiny_da3()
    adapter = trained(model)
    adapted = outputs(model, IMAGES)
    with pytest.raises(RuntimeError, match="inside"), adapter.off():
        raise RuntimeError("inside")
    assert same(outputs(model, IMAGES), adapted)


def test_strength_goes_from_frozen_to_adapted_without_a_jump(model):
    frozen = outputs(model, IMAGES)
    adapter = trained(model)
    adapted = outputs(model, IMAGES)
    found = {}
    for strength in (0.0, 0.499, 0.5, 0.501, 0.999, 1.0):
        adapter.set_strength(strength)
        found[strength] = outputs(model, IMAGES)
    assert same(found[0.0], frozen)
    assert same(found[1.0], adapted)
    depth = {strength: values[0] for strength, values in found.items()}
    whole = (depth[1.0] - depth[0.0]).abs().max()
    assert (depth[0.501] - depth[0.499]).abs().max() < 0.05 * whole
    assert (depth[1.0] - depth[0.999]).abs().max() < 0.05 * whole
    assert (depth[0.5] - depth[0.0]).abs().max() > 0.05 * whole
    token = model.camera_token_name
    assert adapter.camera_token is (model.get_parameter(token) if token else None)


def test_the_frozen_token_follows_a_model_that_is_moved(model):
    adapter = trained(model)
    model.double()
    with torch.no_grad():
        wanted = again(model).double().aggregate(model.embed(IMAGES[None].double())).levels
    with adapter.off(), torch.no_grad():
        found = model.aggregate(model.embed(IMAGES[None].double())).levels
        assert all(same(found[layer], wanted[layer]) for layer in wanted)
    adapter.set_strength(0.5)
    adapter.detach()
    assert {parameter.dtype for parameter in model.parameters()} == {torch.float64}


def test_off_inside_a_strength_returns_to_it():
    model = tiny_da3()
    adapter = trained(model)
    adapter.set_strength(0.5)
    half = outputs(model, IMAGES)
    with adapter.off():
        pass
    assert same(outputs(model, IMAGES), half)


def test_merging_keeps_the_outputs_and_leaves_a_plain_model(model):
    names = list(model.state_dict())
    adapter = trained(model)
    adapted = outputs(model, IMAGES)
    merged = adapter.merge()
    for found, wanted in zip(outputs(merged, IMAGES), adapted, strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)
    assert list(merged.state_dict()) == names
    attach(merged)


def test_merging_at_a_strength_keeps_that_strength():
    model = tiny_da3()
    adapter = trained(model)
    adapter.set_strength(0.3)
    wanted = outputs(model, IMAGES)
    for found, target in zip(outputs(adapter.merge(), IMAGES), wanted, strict=True):
        torch.testing.assert_close(found, target, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("build", "keys"),
    [(tiny_da3, da3_config.KEYS), (tiny_vggt, vggt_config.KEYS), (tiny_mapanything, mapanything_config.KEYS)],
)
def test_merged_weights_go_through_a_checkpoint_file(tmp_path, build, keys):
    model = build()
    adapter = trained(model)
    wanted = outputs(model, IMAGES)
    save_weights(adapter.merge(), tmp_path / "merged.safetensors", keys, {})
    again = build(seed=1)
    load_weights(again, tmp_path / "merged.safetensors", keys, "tiny")
    for found, target in zip(outputs(again, IMAGES), wanted, strict=True):
        torch.testing.assert_close(found, target, rtol=1e-4, atol=1e-4)


def test_a_detached_adapter_goes_back_as_it_was(model):
    frozen, adapter = outputs(model, IMAGES), trained(model)
    adapter.set_strength(0.5)
    adapted, flags = outputs(model, IMAGES), [parameter.requires_grad for parameter in adapter.parameters()]
    adapter.detach()
    adapter.detach()
    assert not adapter.attached and not is_adapted(model)
    with adapter.applied():
        assert adapter.is_on and is_adapted(model)
        assert same(outputs(model, IMAGES), adapted)
    assert same(outputs(model, IMAGES), frozen)
    adapter.reattach()
    assert same(outputs(model, IMAGES), adapted)
    assert [parameter.requires_grad for parameter in adapter.parameters()] == flags
    with adapter.off():
        adapter.set_strength(1.0)
        assert not is_adapted(model)
        assert same(outputs(model, IMAGES), frozen)
        with adapter.applied():
            assert not same(outputs(model, IMAGES), frozen)
        assert same(outputs(model, IMAGES), frozen)
    assert not same(outputs(model, IMAGES), adapted)


def test_an_adapter_that_is_taken_out_while_it_is_off_stays_out(model):
    frozen, adapter = outputs(model, IMAGES), trained(model)
    with adapter.off():
        adapter.detach()
    assert same(outputs(model, IMAGES), frozen)
    assert not adapter.attached


def test_an_adapter_does_not_go_back_where_another_one_is(model):
    first = trained(model)
    first.detach()
    second = trained(model, seed=2)
    with pytest.raises(UserError, match="already carries an adapter"):
        first.reattach()
    second.merge()
    with pytest.raises(UserError, match="was merged"):
        second.reattach()


def test_detaching_restores_the_model_bit_for_bit(model):
    before, weights = outputs(model, IMAGES), {k: v.clone() for k, v in model.state_dict().items()}
    plain = trained(model).detach()
    assert plain is model
    assert list(model.state_dict()) == list(weights)
    assert all(torch.equal(value, weights[name]) for name, value in model.state_dict().items())
    assert same(outputs(model, IMAGES), before)
    assert attach(model).layers


def test_a_second_adapter_is_refused_and_the_first_one_stays():
    model = tiny_da3()
    trained(model)
    adapted = outputs(model, IMAGES)
    with pytest.raises(UserError, match="already carries an adapter; detach it first"):
        attach(model)
    assert same(outputs(model, IMAGES), adapted)


def test_targets_that_the_model_lacks_are_named_and_the_model_stays_plain():
    model = tiny_da3()
    before = outputs(model, IMAGES)
    with pytest.raises(UserError, match=r"1 of 2 adapter targets .* tiny-da3 \(first: aggregator.frame_blocks.0"):
        attach(model, targets=["backbone.pretrained.blocks.2.attn.qkv", "aggregator.frame_blocks.0.attn.qkv"])
    assert same(outputs(model, IMAGES), before)
    assert not hasattr(model, "peft_config")


class Twins(nn.Module):
    """Two parts with the same layer names, one of them at the root."""

    spec, camera_token_name = tiny_da3().spec, None

    def __init__(self):
        super().__init__()
        self.mix = nn.Sequential(*(nn.Linear(3, 3) for _ in range(25)))
        self.head = nn.ModuleDict({"mix": nn.Sequential(*(nn.Linear(3, 3) for _ in range(25)))})

    def adaptable(self):
        return self

    def adapter_targets(self):
        return [f"mix.{i}" for i in range(25)]


def test_layers_whose_names_only_end_like_a_target_stay_untouched():
    model = Twins()
    adapter = attach(model)
    assert all(type(layer) is nn.Linear for layer in model.head["mix"])
    training = {name for name, parameter in model.named_parameters() if parameter.requires_grad}
    assert len(training) == len(adapter.named_parameters()) == 50
    with adapter.off():
        pass
    adapter.detach()
    assert "camera_token" not in adapter.named_parameters()


@pytest.mark.parametrize(
    ("name", "counts"),
    [("da3-giant", GIANT_COUNTS), ("da3nested-giant-large", GIANT_COUNTS), ("vggt-1b", VGGT_COUNTS)],
    ids=["da3-giant", "da3nested-giant-large", "vggt-1b"],
)
def test_trainable_parameters_are_the_published_counts(name, counts):
    model = build_empty(name)
    assert {rank: count_trainable(model, rank) for rank in counts} == counts
    attached = attach(model, rank=8)
    assert sum(parameter.numel() for parameter in attached.parameters()) == counts[8]
