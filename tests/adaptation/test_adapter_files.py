"""Adapters come back bit for bit, peft reads ours, the authors' layout passes both ways, the rest is refused."""

import json
import math
import shutil
from pathlib import Path

import peft
import pytest
import torch
from safetensors.torch import load_file, save_file

from freegeo.adaptation.adapter import Adapter, is_adapted
from freegeo.adaptation.adapter_files import (
    adapter_metadata,
    export_published,
    find_adapter,
    load_adapter,
    lora_layers,
    own_names,
    read_camera_token,
    read_peft,
    require_fitting,
    save_adapter,
)
from freegeo.errors import FreeGeoError, UserError
from freegeo.models.catalog import build_empty
from freegeo.models.spec import LoadedFrom
from tiny_models import attach, noise, outputs, same, tiny_da3, tiny_vggt, trained

IMAGES = noise(4)
MODELS = {"da3": tiny_da3, "vggt": tiny_vggt}
PUBLISHED_LAYER = {"da3": "blocks.2.attn.qkv", "vggt": "aggregator.frame_blocks.0.attn.qkv"}
METADATA = {"recipe": {"name": "scene"}, "seed": 42}


@pytest.fixture(params=MODELS)
def build(request):
    return MODELS[request.param]


def saved(build, folder: Path) -> tuple[Adapter, list[torch.Tensor]]:
    """Save a trained adapter and return it with the outputs of its model."""
    adapter = trained(build())
    save_adapter(adapter, folder, METADATA)
    return adapter, outputs(adapter.model, IMAGES)


def test_saved_and_loaded_is_the_same_adapter(build, tmp_path):
    adapter, adapted = saved(build, tmp_path)
    model = build()
    loaded = load_adapter(model, tmp_path)
    wanted = adapter.named_parameters()
    assert all(torch.equal(value, wanted[name]) for name, value in loaded.named_parameters().items())
    assert same(outputs(model, IMAGES), adapted)
    assert not [name for name, parameter in model.named_parameters() if parameter.requires_grad]
    assert same(outputs(loaded.detach(), IMAGES), outputs(build(), IMAGES))
    merged = load_adapter(model, tmp_path).merge()
    for found, target in zip(outputs(merged, IMAGES), adapted, strict=True):
        torch.testing.assert_close(found, target, rtol=1e-4, atol=1e-4)


def test_saving_twice_writes_the_same_tensors(build, tmp_path):
    saved(build, tmp_path / "one")
    save_adapter(load_adapter(build(), tmp_path / "one"), tmp_path / "two", METADATA)
    for name in ("adapter_model.safetensors", "camera_token.safetensors"):
        one, two = load_file(tmp_path / "one" / name), load_file(tmp_path / "two" / name)
        assert one.keys() == two.keys()
        assert all(torch.equal(one[key], two[key]) for key in one)


def test_the_page_says_what_the_adapter_is(build, tmp_path):
    model = build()
    weights = {
        "file": "model.safetensors", "fingerprint": "0123", "sha256": {"model.safetensors": "4567"},
        "hub_id": "somebody/model", "revision": "89ab",
    }  # fmt: skip
    model.loaded_from = LoadedFrom(model=model.spec.name, licence="none", **weights)
    files = save_adapter(attach(model), tmp_path, METADATA)
    metadata = adapter_metadata(tmp_path)
    assert metadata == {
        "format": 1, "base": {"model": model.spec.name, **weights, "licence": "none"},
        "strength": 1.0, **METADATA,
    }  # fmt: skip
    assert sorted(tmp_path.iterdir()) == sorted(files)
    config = json.loads((tmp_path / "adapter_config.json").read_text())
    assert config["target_modules"] == sorted(attach(build()).layers)
    assert (config["peft_type"], config["r"], config["lora_alpha"], config["inference_mode"]) == ("LORA", 4, 4, True)


def test_peft_itself_loads_our_folder(build, tmp_path):
    adapter, adapted = saved(build, tmp_path)
    bare = build()
    token_owner, _, token_name = bare.camera_token_name.rpartition(".")
    setattr(bare.get_submodule(token_owner), token_name, adapter.camera_token)
    wrapped = peft.PeftModel.from_pretrained(bare, tmp_path)
    assert same(outputs(wrapped.get_base_model(), IMAGES), adapted)


def test_an_adapter_that_peft_trained_loads_here(build, tmp_path):
    wrapped = peft.get_peft_model(
        build(), peft.LoraConfig(r=2, lora_alpha=6, target_modules=build().adapter_targets(), init_lora_weights=False)
    )
    wrapped.save_pretrained(tmp_path)
    model = build()
    load_adapter(model, tmp_path)
    assert same(outputs(model, IMAGES), outputs(wrapped.get_base_model().eval(), IMAGES))


@pytest.mark.parametrize("name", ["latest", "epoch_2"])
def test_the_published_layout_passes_both_ways(build, name, tmp_path):
    adapter = trained(build())
    adapted = outputs(adapter.model, IMAGES)
    files = export_published(adapter, tmp_path, name)
    folder = tmp_path / f"{name}_lora_peft"
    assert sorted(path.relative_to(tmp_path).as_posix() for path in files) == [
        f"{name}_lora.pt", f"{name}_lora_peft/adapter_config.json", f"{name}_lora_peft/adapter_model.safetensors"
    ]  # fmt: skip
    assert sorted(path for path in tmp_path.rglob("*") if path.is_file()) == sorted(files)
    model = build()
    loaded = load_adapter(model, folder)
    assert same(outputs(model, IMAGES), adapted)
    wanted = adapter.named_parameters()
    assert all(torch.equal(value, wanted[key]) for key, value in loaded.named_parameters().items())


@pytest.mark.parametrize("name", MODELS)
def test_published_files_have_the_published_names(name, tmp_path):
    adapter = trained(MODELS[name]())
    export_published(adapter, tmp_path)
    tensors = load_file(tmp_path / "latest_lora_peft" / "adapter_model.safetensors")
    assert f"base_model.model.{PUBLISHED_LAYER[name]}.lora_A.weight" in tensors
    assert f"base_model.model.{PUBLISHED_LAYER[name]}.lora_B.weight" in tensors
    assert len(tensors) == 2 * len(adapter.layers)
    token = torch.load(tmp_path / "latest_lora.pt", weights_only=True)
    assert token.keys() == {"camera_token"}
    assert token["camera_token"].dtype == torch.float32
    assert torch.equal(token["camera_token"], adapter.camera_token)


# Layers of the published files: docs/method.md, "Adapter files".
PUBLISHED_LAYERS = {
    "da3-giant": [
        f"blocks.{i}.{part}" for i in range(13, 40) for part in ("attn.qkv", "attn.proj", "mlp.w12", "mlp.w3")
    ],
    "vggt-1b": [
        f"aggregator.{kind}_blocks.{i}.{part}"
        for kind in ("frame", "global")
        for i in range(24)
        for part in ("attn.qkv", "attn.proj", "mlp.fc1", "mlp.fc2")
    ],
}


@pytest.mark.parametrize("name", PUBLISHED_LAYERS)
def test_the_published_layers_are_all_that_an_adapter_sits_on(name):
    model = build_empty(name)
    tensors = {f"{layer}.lora_A.weight": torch.zeros(1) for layer in PUBLISHED_LAYERS[name]}
    assert lora_layers(own_names(model, tensors)) == sorted(model.adapter_targets())


def test_a_published_da3_adapter_is_one_of_its_backbone(tmp_path):
    """The authors load theirs with peft onto the backbone alone."""
    adapter = trained(tiny_da3())
    adapted = outputs(adapter.model, IMAGES)
    export_published(adapter, tmp_path)
    bare = tiny_da3()
    backbone = bare.get_submodule(bare.published_adapter_root)
    backbone.camera_token = adapter.camera_token
    peft.PeftModel.from_pretrained(backbone, tmp_path / "latest_lora_peft")
    assert same(outputs(bare, IMAGES), adapted)


def test_a_published_adapter_needs_its_camera_token(build, tmp_path):
    export_published(trained(build()), tmp_path)
    (tmp_path / "latest_lora.pt").unlink()
    with pytest.raises(UserError, match=r"latest_lora\.pt: the camera token of latest_lora_peft is missing"):
        load_adapter(build(), tmp_path / "latest_lora_peft")


def test_nothing_in_a_published_token_file_is_executed(build, tmp_path):
    export_published(trained(build()), tmp_path)
    torch.save({"camera_token": torch.zeros(1), "path": Path("/")}, tmp_path / "latest_lora.pt")
    with pytest.raises(UserError, match="never runs code from a checkpoint"):
        load_adapter(build(), tmp_path / "latest_lora_peft")
    torch.save({"camera_token": torch.zeros(1), "more": torch.zeros(1)}, tmp_path / "latest_lora.pt")
    with pytest.raises(UserError, match="expected only camera_token, found camera_token, more"):
        load_adapter(build(), tmp_path / "latest_lora_peft")


def refused(model, folder: Path, words: str) -> None:
    """A refusal is one sentence or two, and the model is as it was."""
    before = outputs(model, IMAGES)
    with pytest.raises(UserError, match=words) as error:
        load_adapter(model, folder)
    assert "\n" not in str(error.value)
    assert str(folder) in str(error.value) or "adapter targets" in str(error.value)
    assert same(outputs(model, IMAGES), before)
    attach(model).detach()


def test_an_adapter_of_another_model_is_refused(tmp_path):
    saved(tiny_da3, tmp_path / "da3")
    saved(tiny_vggt, tmp_path / "vggt")
    refused(tiny_vggt(), tmp_path / "da3", "made for tiny-da3, not for tiny-vggt")
    refused(tiny_da3(), tmp_path / "vggt", "made for tiny-vggt, not for tiny-da3")
    for name, model in (("da3", tiny_vggt()), ("vggt", tiny_da3())):
        (tmp_path / name / "freegeo.json").unlink()
        refused(model, tmp_path / name, f"no linear layers of {model.spec.name}.*belongs to another model")


def test_an_adapter_of_another_checkpoint_is_refused(tmp_path):
    model = tiny_da3()
    model.loaded_from = LoadedFrom(model="tiny-da3", file="a.safetensors", fingerprint="aaaa", licence="none")
    save_adapter(attach(model), tmp_path, METADATA)
    other = tiny_da3(seed=5)
    other.loaded_from = LoadedFrom(model="tiny-da3", file="b.safetensors", fingerprint="bbbb", licence="none")
    refused(other, tmp_path, r"another checkpoint of tiny-da3 \(aaaa, this is bbbb\)")


def test_whether_an_adapter_fits_is_known_without_the_weights(tmp_path):
    model = tiny_da3()
    model.loaded_from = LoadedFrom(model="tiny-da3", file="a.safetensors", fingerprint="aaaa", licence="none")
    save_adapter(attach(model), tmp_path, METADATA)
    empty = tiny_da3().to("meta")
    require_fitting(empty, tmp_path, "aaaa")
    assert not is_adapted(empty)
    with pytest.raises(UserError, match="another checkpoint of tiny-da3"):
        require_fitting(empty, tmp_path, "bbbb")
    (tmp_path / "freegeo.json").unlink()
    with pytest.raises(UserError, match="no linear layers of tiny-vggt"):
        require_fitting(tiny_vggt().to("meta"), tmp_path, "aaaa")


@pytest.mark.parametrize("missing", ["adapter_config.json", "adapter_model.safetensors"])
def test_a_folder_without_one_of_the_files_is_no_adapter(missing, tmp_path):
    saved(tiny_da3, tmp_path)
    (tmp_path / missing).unlink()
    refused(tiny_da3(), tmp_path, "not an adapter folder")


def test_no_folder_at_all(tmp_path):
    refused(tiny_da3(), tmp_path / "nowhere", "not an adapter folder")


@pytest.mark.parametrize("rank", [1, 1 << 40])
def test_a_rank_that_is_not_that_of_the_matrices_is_refused_before_there_is_room_for_it(tmp_path, rank):
    model = tiny_da3()
    save_adapter(trained(model), tmp_path, METADATA)
    config = json.loads((tmp_path / "adapter_config.json").read_text())
    (tmp_path / "adapter_config.json").write_text(json.dumps({**config, "r": rank}))
    with pytest.raises(UserError, match=f"not of the rank {rank} that"):
        load_adapter(tiny_da3(), tmp_path)


@pytest.mark.parametrize("strength", [math.nan, math.inf, -1e9, 1e300])
def test_a_strength_that_no_adapter_has_is_refused(tmp_path, strength):
    model = tiny_da3()
    save_adapter(trained(model), tmp_path, METADATA)
    about = json.loads((tmp_path / "freegeo.json").read_text())
    (tmp_path / "freegeo.json").write_text(json.dumps({**about, "strength": strength}))
    refused(tiny_da3(), tmp_path, "freegeo.json: the strength is .*, as none is")


def test_damaged_files_are_named(tmp_path):
    saved(tiny_da3, tmp_path / "short")
    weights = tmp_path / "short" / "adapter_model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-10])
    refused(tiny_da3(), tmp_path / "short", "truncated")
    saved(tiny_da3, tmp_path / "config")
    (tmp_path / "config" / "adapter_config.json").write_text("{")
    with pytest.raises(FreeGeoError, match="damaged file"):
        load_adapter(tiny_da3(), tmp_path / "config")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"peft_type": "LOHA"}, "holds a LOHA adapter; only LoRA"),
        ({"use_rslora": True}, "uses use_rslora; only plain LoRA"),
        ({"rank_pattern": {"attn.qkv": 2}, "use_dora": True}, "uses rank_pattern, use_dora"),
        ({"alpha_pattern": {"attn.qkv": 2}}, "uses alpha_pattern"),
        ({"bias": "all"}, "uses bias"),
        ({"lora_bias": True}, "uses lora_bias"),
        ({"target_parameters": ["attn.qkv.weight"]}, "uses target_parameters"),
        ({"a_setting_of_a_later_peft": {"on": True}}, "uses a_setting_of_a_later_peft"),
        ({"init_lora_weights": "pissa"}, "initialised by pissa, which changes the weights of the model"),
        ({"init_lora_weights": "pissa_niter_4"}, "initialised by pissa_niter_4"),
        ({"init_lora_weights": "olora"}, "initialised by olora"),
        ({"init_lora_weights": "corda"}, "initialised by corda"),
        ({"init_lora_weights": "loftq"}, "initialised by loftq"),
        ({"init_lora_weights": "lora_ga"}, "initialised by lora_ga"),
        ({"r": 0}, "are not those of an adapter"),
        ({"r": "4"}, "are not those of an adapter"),
        ({"lora_alpha": math.nan}, "are not those of an adapter"),
        ({"lora_alpha": None}, "are not those of an adapter"),
    ],
)
def test_adapters_that_compute_something_else_are_refused(change, words, plain, tmp_path):
    path = shutil.copytree(plain, tmp_path / "copy") / "adapter_config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    refused_when_read(path.parent, words)


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Path:
    """A saved adapter, to copy and spoil."""
    folder = tmp_path_factory.mktemp("plain") / "adapter"
    save_adapter(trained(tiny_da3()), folder, METADATA)
    return folder


def refused_when_read(folder: Path, words: str) -> None:
    """A refusal that needs no model."""
    with pytest.raises(UserError, match=words) as error:
        read_peft(folder)
    assert "\n" not in str(error.value)
    assert str(folder) in str(error.value)


@pytest.mark.filterwarnings("ignore:.*EVA config")
@pytest.mark.parametrize("start", [True, False, "gaussian", "orthogonal", "mica", "eva"])
def test_every_initialisation_that_is_accepted_computes_what_peft_computes(start, tmp_path):
    wrapped = peft.get_peft_model(
        tiny_da3(), peft.LoraConfig(r=2, lora_alpha=2, target_modules=tiny_da3().adapter_targets())
    )
    wrapped.peft_config["default"].init_lora_weights = start
    for name, parameter in wrapped.named_parameters():
        if "lora_B" in name:
            torch.nn.init.normal_(parameter, std=0.1, generator=torch.Generator().manual_seed(3))
    wrapped.save_pretrained(tmp_path)
    model = tiny_da3()
    load_adapter(model, tmp_path)
    by_peft = peft.PeftModel.from_pretrained(tiny_da3(), tmp_path).get_base_model().eval()
    assert not same(outputs(model, IMAGES), outputs(tiny_da3(), IMAGES))
    assert same(outputs(model, IMAGES), outputs(by_peft, IMAGES))


@pytest.mark.filterwarnings("ignore:.*changes the base weights")
@pytest.mark.parametrize("start", ["pissa", "olora"])
def test_an_adapter_that_changes_the_model_is_refused_until_peft_has_converted_it(start, tmp_path):
    targets = tiny_da3().adapter_targets()
    config = peft.LoraConfig(r=2, lora_alpha=2, target_modules=targets, init_lora_weights=start)
    wrapped = peft.get_peft_model(tiny_da3(), config)
    wrapped.peft_config["default"].init_lora_weights = True  # what peft asks for before a later conversion
    wrapped.save_pretrained(tmp_path / "start")
    wrapped.peft_config["default"].init_lora_weights = start
    for name, parameter in wrapped.named_parameters():
        if "lora_B" in name:
            parameter.data += 0.05
    wrapped.save_pretrained(tmp_path / "plain")
    refused(tiny_da3(), tmp_path / "plain", f"initialised by {start}.*path_initial_model_for_weight_conversion")
    wrapped.save_pretrained(tmp_path / "converted", path_initial_model_for_weight_conversion=str(tmp_path / "start"))
    model = tiny_da3()
    load_adapter(model, tmp_path / "converted")
    for found, wanted in zip(outputs(model, IMAGES), outputs(wrapped.get_base_model().eval(), IMAGES), strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_adapters_with_values_that_are_not_finite_are_refused(value, plain, tmp_path):
    """Published adapters have the same two files, in a folder of this name."""
    folder = shutil.copytree(plain, tmp_path / "latest_lora_peft")
    path = folder / "adapter_model.safetensors"
    tensors = load_file(path)
    tensors[sorted(tensors)[5]][1, 0] = value
    save_file(tensors, path)
    refused_when_read(folder, "1 tensors hold values that are not finite")


def test_camera_tokens_with_values_that_are_not_finite_are_refused(plain, tmp_path):
    ours = shutil.copytree(plain, tmp_path / "ours")
    token = load_file(ours / "camera_token.safetensors")["camera_token"] * math.nan
    save_file({"camera_token": token}, ours / "camera_token.safetensors")
    refused(tiny_da3(), ours, r"camera_token\.safetensors: 1 tensors hold values that are not finite")
    torch.save({"camera_token": token}, tmp_path / "latest_lora.pt")
    with pytest.raises(UserError, match=r"latest_lora\.pt: 1 tensors hold values that are not finite"):
        read_camera_token(tmp_path / "latest_lora_peft")


def test_adapters_in_eight_bits_are_refused(plain, tmp_path):
    path = shutil.copytree(plain, tmp_path / "copy") / "adapter_model.safetensors"
    save_file({name: value.to(torch.float8_e4m3fn) for name, value in load_file(path).items()}, path)
    refused_when_read(path.parent, "stored as float8_e4m3fn.*Use weights in float32")


def test_our_own_adapter_needs_its_camera_token(build, tmp_path):
    saved(build, tmp_path)
    (tmp_path / "camera_token.safetensors").unlink()
    refused(build(), tmp_path, "this file of the adapter is missing")


@pytest.mark.parametrize(
    "place", ["out", "out/adapter", "out/adapter/adapter_config.json", "out/adapter/adapter_model.safetensors", "~/out"]
)
def test_an_adapter_is_found_in_the_folder_of_its_run(place, plain, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    shutil.copytree(plain, tmp_path / "out" / "adapter")
    assert find_adapter(place if place.startswith("~") else tmp_path / place) == tmp_path / "out" / "adapter"


def test_loading_takes_the_folder_of_a_run(build, tmp_path):
    _, adapted = saved(build, tmp_path / "adapter")
    model = build()
    load_adapter(model, tmp_path)
    assert same(outputs(model, IMAGES), adapted)


def test_a_folder_with_published_adapters_stands_for_the_only_one(tmp_path):
    adapter = trained(tiny_da3())
    export_published(adapter, tmp_path, "latest")
    assert find_adapter(tmp_path) == tmp_path / "latest_lora_peft"
    export_published(adapter, tmp_path, "epoch_2")
    with pytest.raises(UserError, match=r"several adapters \(epoch_2_lora_peft, latest_lora_peft\)"):
        find_adapter(tmp_path)


@pytest.mark.parametrize("content", ["[]", "{}", '{"format": 1, "base": "da3-base"}', '{"base": {"model": "x"}}'])
def test_a_page_that_says_nothing_is_refused(content, tmp_path):
    (tmp_path / "freegeo.json").write_text(content)
    with pytest.raises(UserError, match="does not describe an adapter"):
        adapter_metadata(tmp_path)


@pytest.mark.parametrize("content", ["[]", "{}", '"LORA"'])
def test_a_configuration_that_says_nothing_is_refused(content, plain, tmp_path):
    folder = shutil.copytree(plain, tmp_path / "copy")
    (folder / "adapter_config.json").write_text(content)
    refused_when_read(folder, "holds a different adapter; only LoRA")


def test_a_page_of_a_newer_format_is_refused(tmp_path):
    saved(tiny_da3, tmp_path)
    path = tmp_path / "freegeo.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format": 99}))
    refused(tiny_da3(), tmp_path, r"newer freegeo \(format 99\)")


def test_loading_onto_an_adapted_model_is_refused(tmp_path):
    saved(tiny_da3, tmp_path)
    model = tiny_da3()
    load_adapter(model, tmp_path)
    with pytest.raises(UserError, match="already carries an adapter"):
        load_adapter(model, tmp_path)
