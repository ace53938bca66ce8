"""The example plug-in comes in through its entry point, and the same engine adapts and reconstructs with it."""

import importlib.metadata
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file

import freegeo
from freegeo.adaptation.adapt import adapt
from freegeo.adaptation.adapter import count_trainable
from freegeo.adaptation.adapter_files import export_published, load_adapter, save_adapter
from freegeo.adaptation.recipe import named
from freegeo.errors import FreeGeoError, UserError
from freegeo.models import catalog
from freegeo.models.api import ReconstructionModel
from tiny_models import noise, noise_scene, outputs, quick, same, trained

EXAMPLE = Path(__file__).parents[2] / "examples" / "plugin-model"
IMAGES = noise(4)


@pytest.fixture(autouse=True)
def installed(monkeypatch):
    """Pretend that the example is installed: on the path, with the entry points its project file declares."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    points = [
        importlib.metadata.EntryPoint(name, value, group)
        for group, entries in project["entry-points"].items()
        for name, value in entries.items()
    ]
    monkeypatch.syspath_prepend(EXAMPLE / "src")
    monkeypatch.setattr(
        importlib.metadata, "entry_points", lambda *, group: [point for point in points if point.group == group]
    )
    yield
    for name in [name for name in sys.modules if name.startswith("freegeo_toy")]:
        del sys.modules[name]


def load() -> ReconstructionModel:
    return freegeo.load_model("toy")


@pytest.fixture
def photos(tmp_path):
    generator = np.random.default_rng(0)
    (tmp_path / "photos").mkdir()
    for number in range(5):
        pixels = generator.integers(0, 256, (60, 90, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / "photos" / f"{number}.png")
    return freegeo.load_photos(tmp_path / "photos")


def test_the_catalog_lists_it_after_our_own_models():
    assert catalog.names()[-1] == "toy"
    assert catalog.entry("toy").licence == "Apache-2.0"
    with pytest.raises(UserError, match=r"unknown model 'toys'.*toy"):
        catalog.entry("toys")


def test_an_entry_point_that_names_something_else_is_refused(monkeypatch):
    point = importlib.metadata.EntryPoint("broken", "freegeo_toy:LICENCE", catalog.PLUGIN_GROUP)
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda *, group: [point])
    with pytest.raises(FreeGeoError, match=r"plug-in 'broken' \(freegeo_toy:LICENCE\) is no ModelEntry"):
        catalog.entry("broken")


def test_listing_it_does_not_import_its_architecture():
    catalog.entry("toy")
    assert "freegeo_toy.model" not in sys.modules


def test_it_loads_with_the_weights_it_ships():
    model = load()
    drawn = importlib.import_module("freegeo_toy.weights").draw()
    # The last bit of a normal number depends on the processor; rounded to half, that is the next number at most.
    for name, value in model.state_dict().items():
        torch.testing.assert_close(value, drawn[name].float(), rtol=2**-10, atol=2**-24)
    assert (model.loaded_from.model, model.loaded_from.licence) == ("toy", "Apache-2.0")
    assert sum(parameter.numel() for parameter in model.parameters()) == catalog.entry("toy").parameters
    assert model.spec.name == catalog.entry("toy").name


def test_a_checkpoint_of_another_model_is_refused(tmp_path):
    save_file({"stranger": torch.zeros(1)}, tmp_path / "other.safetensors")
    with pytest.raises(UserError, match=r"does not fit toy.*missing.*1 unexpected"):
        catalog.load_model("toy", checkpoint=tmp_path / "other.safetensors")


@torch.no_grad()
def test_it_keeps_the_contract():
    model = load()
    tokens = model.embed(IMAGES[None])
    alone = model.embed(IMAGES[None, 2:3])
    torch.testing.assert_close(tokens.select([2]).tokens, alone.tokens)
    features = model.aggregate(tokens)
    assert sorted(model.aggregate(tokens, layers=[0]).levels) == [0]
    found = model.decode(features)
    assert found.depth_z.shape == found.conf.shape == (1, 4, 32, 32)
    assert found.T_cam_world.shape == (1, 4, 4, 4)
    assert found.K.shape == (1, 4, 3, 3)
    torch.testing.assert_close(found.T_cam_world[:, 0], torch.eye(4)[None])
    assert model.decode(features.select([0, 2])).depth_z.shape == (1, 2, 32, 32)
    with pytest.raises(UserError, match="toy does not predict rays"):
        model.decode(features, want=("rays",))
    with pytest.raises(UserError, match="first view as reference"):
        model.aggregate(tokens, reference="middle")


def test_the_engine_adapts_it_without_a_camera_token():
    model = load()
    frozen = outputs(model, IMAGES)
    result = adapt(model, [noise_scene(8)], quick(model, steps=12, sets_per_scene=1, distinct_seeds=1), seed=42)
    totals = [terms["total"] for terms in result.curve]
    assert totals[-1] < 0.9 * totals[0]
    assert sum(parameter.numel() for parameter in result.adapter.parameters()) == count_trainable(load(), 4)
    assert result.adapter.camera_token is None
    assert not same(outputs(model, IMAGES), frozen)
    with result.adapter.off():
        assert same(outputs(model, IMAGES), frozen)
    result.adapter.set_strength(0.0)
    assert same(outputs(model, IMAGES), frozen)
    assert same(outputs(result.adapter.detach(), IMAGES), frozen)


def test_the_recipe_that_wants_every_special_token_takes_none():
    model = load()
    recipe = named("released-vggt", model.spec, "eth3d").changed(steps=1, sets_per_scene=1)
    assert adapt(model, [noise_scene(4)], recipe, seed=42).curve[0]["total"] > 0


def test_its_adapters_are_saved_loaded_exported_and_merged(tmp_path):
    adapter = trained(load())
    adapted = outputs(adapter.model, IMAGES)
    files = save_adapter(adapter, tmp_path / "ours", {})
    assert [path.name for path in files] == ["adapter_config.json", "adapter_model.safetensors", "freegeo.json"]
    exported = export_published(adapter, tmp_path)
    assert [path.name for path in exported] == ["adapter_config.json", "adapter_model.safetensors"]
    for folder in (tmp_path / "ours", tmp_path / "latest_lora_peft"):
        model = load()
        loaded = load_adapter(model, folder)
        assert same(outputs(model, IMAGES), adapted)
        for found, wanted in zip(outputs(loaded.merge(), IMAGES), adapted, strict=True):
            torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)


def test_photos_become_a_reconstruction_before_and_after(photos):
    model = load()
    frozen = freegeo.reconstruct(model, photos)
    result = freegeo.adapt(model, photos, recipe=quick(model, steps=2), guard="off")
    adapted = freegeo.reconstruct(model, photos, adapter=result.adapter)
    assert frozen.depth_z.shape == adapted.depth_z.shape == (5, 40, 64)
    assert not np.array_equal(frozen.depth_z, adapted.depth_z)
