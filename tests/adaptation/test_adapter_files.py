"""Adapters come back bit for bit, peft reads ours, the authors' layout passes both ways, the rest is refused."""

import json
import shutil
from pathlib import Path

import peft
import pytest
import torch
from safetensors.torch import load_file, save_file

from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.adapter_files import (
    adapter_metadata,
    export_published,
    load_adapter,
    lora_layers,
    own_names,
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
    model.loaded_from = LoadedFrom(model=model.spec.name, file="model.safetensors", fingerprint="0123", licence="none")
    files = save_adapter(attach(model), tmp_path, METADATA)
    metadata = adapter_metadata(tmp_path)
    assert metadata == {
        "format": 1, "base": {"model": model.spec.name, "fingerprint": "0123", "licence": "none"}, **METADATA
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


@pytest.mark.parametrize("missing", ["adapter_config.json", "adapter_model.safetensors"])
def test_a_folder_without_one_of_the_files_is_no_adapter(missing, tmp_path):
    saved(tiny_da3, tmp_path)
    (tmp_path / missing).unlink()
    refused(tiny_da3(), tmp_path, "not an adapter folder")


def test_no_folder_at_all(tmp_path):
    refused(tiny_da3(), tmp_path / "nowhere", "not an adapter folder")


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
        ({"use_dora": True, "rank_pattern": {"attn.qkv": 2}}, "uses use_dora, rank_pattern"),
    ],
)
def test_adapters_that_compute_something_else_are_refused(change, words, tmp_path):
    saved(tiny_da3, tmp_path)
    path = tmp_path / "adapter_config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    refused(tiny_da3(), tmp_path, words)


def test_tensors_that_do_not_fit_are_counted_and_named(tmp_path):
    saved(tiny_da3, tmp_path / "whole")
    tensors = load_file(tmp_path / "whole" / "adapter_model.safetensors")
    first = next(iter(tensors))
    for case, changed, words in (
        ("less", {k: v for k, v in tensors.items() if k != first}, "1 missing"),
        ("other", tensors | {first: torch.zeros(9, 9)}, r"1 of another shape \(first: .* is \(9, 9\), expected"),
        ("more", tensors | {"base_model.model.bias": torch.zeros(1)}, r"1 unexpected \(first: bias\)"),
        ("none", {"base_model.model.bias": torch.zeros(1)}, "no LoRA matrices"),
    ):
        shutil.copytree(tmp_path / "whole", tmp_path / case)
        save_file(changed, tmp_path / case / "adapter_model.safetensors")
        refused(tiny_da3(), tmp_path / case, words)


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
