"""DA3 of single views and the nested model: what follows from their parts; recorded numbers are in test_da3.py."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

TESTS = Path(__file__).parents[1]
sys.path.append(str(TESTS))  # the parity modules are shared with the full parity run and lie beside this folder

import freegeo  # noqa: E402
from fixture_tools import relative_error  # noqa: E402
from freegeo import pipeline  # noqa: E402
from freegeo.errors import UserError  # noqa: E402
from freegeo.fusion.settings import FilterSettings  # noqa: E402
from freegeo.models import catalog, da3_config  # noqa: E402
from freegeo.models.api import embed_in_chunks  # noqa: E402
from freegeo.models.da3_config import NESTED_KEYS, SINGLE_VIEW_KEYS  # noqa: E402
from freegeo.models.da3_metric import METRIC_DEPTH, METRIC_SKY, SKY, DA3Nested, fill_sky, quantile  # noqa: E402
from freegeo.models.spec import ModelEntry  # noqa: E402
from freegeo.pipeline import predict  # noqa: E402
from freegeo.types import Features, ImageBatch, Priors  # noqa: E402
from parity_da3 import build_nested, small_config  # noqa: E402
from tiny_models import attach, noise, outputs, same, tiny_da3, tiny_nested, tiny_single_view, trained  # noqa: E402

FOLDER = TESTS / "fixtures" / "da3"
IMAGES = noise(4)


@pytest.fixture(scope="module")
def nested() -> DA3Nested:
    return tiny_nested()


def features_of(model, images=IMAGES) -> Features:
    with torch.no_grad():
        return model.aggregate(model.embed(images[None]))


def with_metric(features: Features, depth: torch.Tensor, sky: torch.Tensor) -> Features:
    return replace(features, extra={METRIC_DEPTH: depth, METRIC_SKY: sky})


# -- single views


@torch.no_grad()
def test_single_views_do_not_see_each_other():
    model = tiny_single_view()
    together, alone = model.read_maps(features_of(model)), model.read_maps(features_of(model, IMAGES[[2]]))
    for name, values in together.items():
        assert relative_error(values[:, [2]], alone[name]) <= 1e-5


@torch.no_grad()
def test_sky_gets_the_depth_of_the_farthest_pixels_and_never_becomes_points():
    depth, sky = torch.rand(1, 2, 16, 16) + 1, torch.zeros(1, 2, 16, 16)
    sky[:, :, :4] = torch.linspace(SKY, 1, 16)
    filled = fill_sky(depth, sky)
    assert torch.equal(filled[:, :, 4:], depth[:, :, 4:])
    assert torch.allclose(filled[:, :, :4], torch.quantile(depth[:, :, 4:], 0.99))
    assert FilterSettings().sky_limit == SKY
    for nearly in (torch.zeros_like(sky), torch.ones_like(sky)):
        nearly[0, 0, 0, :10] = 1 - nearly[0, 0, 0, :10]
        assert torch.equal(fill_sky(depth, nearly), depth)


def test_quantiles_are_those_of_torch():
    values = torch.rand(101, generator=torch.Generator().manual_seed(1))
    for share in (0.0, 0.5, 0.99, 0.123, 1.0):
        assert torch.allclose(quantile(values, share), torch.quantile(values, share))
    assert quantile(torch.tensor([3.0]), 0.5) == 3


def test_what_a_single_view_model_cannot_do_is_refused():
    model = tiny_single_view()
    features = features_of(model)
    with pytest.raises(UserError, match="tiny-single-view looks at each photo by itself: it has no cross-view layers"):
        attach(model)
    with pytest.raises(UserError, match="does not predict cameras"):
        model.decode(features, want=("depth", "cameras"))
    with pytest.raises(UserError, match="takes no known cameras"):
        model.aggregate(model.embed(IMAGES[None]), priors=Priors())
    with pytest.raises(UserError, match="reference"):
        model.aggregate(model.embed(IMAGES[None]), reference="best")


def test_python_refuses_what_a_model_cannot_do_and_warns_of_what_it_lacks(caplog, monkeypatch):
    monkeypatch.setattr(pipeline, "_warned_of", [])
    photos, model = [np.full((32, 32, 3), 40 * k, np.uint8) for k in range(3)], tiny_single_view()
    with pytest.raises(UserError, match="has no cross-view layers"):
        freegeo.adapt(model, photos)
    with pytest.raises(UserError, match="tiny-single-view finds no cameras from rays"):
        freegeo.reconstruct(model, photos, pose_from="rays")
    with pytest.raises(UserError, match="cameras come from camera or rays, not 'sky'"):
        freegeo.reconstruct(model, photos, pose_from="sky")
    model.spec = replace(model.spec, caution="Depth has an unknown focal length.")
    for _ in range(2):
        assert not freegeo.reconstruct(model, photos, device="cpu").has_cameras
    assert caplog.text.count("Depth has an unknown focal length.") == 1


# -- nested


@torch.no_grad()
def test_all_lengths_have_one_factor(nested):
    depth = torch.rand(1, 4, 32, 32, generator=torch.Generator().manual_seed(2)) + 1
    features = with_metric(features_of(nested), depth, torch.zeros_like(depth))
    want = ("depth", "cameras", "rays")
    found, plain = nested.decode(features, want=want), nested.da3.decode(features, want=want)
    factor, spread = found.scale[0].tolist()
    assert relative_error(found.depth_z, factor * plain.depth_z) <= 1e-6
    assert relative_error(found.T_cam_world[..., :3, 3], factor * plain.T_cam_world[..., :3, 3]) <= 1e-6
    assert relative_error(found.rays[..., 3:6], factor * plain.rays[..., 3:6]) <= 1e-6
    assert torch.equal(found.T_cam_world[..., :3, :3], plain.T_cam_world[..., :3, :3])
    assert torch.equal(found.rays[..., :3], plain.rays[..., :3]) and torch.equal(found.K, plain.K)
    assert spread > 0
    twice = nested.decode(with_metric(features, 2 * depth, torch.zeros_like(depth)))
    assert relative_error(twice.depth_z, 2 * found.depth_z) <= 1e-6
    assert twice.scale[0, 1] == pytest.approx(spread, rel=1e-5)


@torch.no_grad()
def test_depth_in_metres_is_found_where_both_parts_agree(nested):
    features = features_of(nested)
    plain = nested.da3.decode(features)
    # Metric depth is at a focal length of 300 pixels.
    metric = 7 * plain.depth_z * 300 / plain.K[..., :2, :2].diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
    scale = nested.decode(with_metric(features, metric, torch.zeros_like(metric))).scale[0]
    assert torch.allclose(scale, torch.tensor([7.0, 0.0]), atol=1e-4)
    one = features.select([1])
    alone = nested.decode(with_metric(one, metric[:, [1]], torch.zeros_like(metric[:, [1]]))).scale[0]
    assert alone[0] == pytest.approx(7, rel=1e-5) and alone[1].isnan()


@torch.no_grad()
def test_photos_of_sky_have_no_metres_and_say_so(nested, caplog):
    features = features_of(nested)
    plain = nested.da3.decode(features)
    for sky in (torch.ones_like(plain.depth_z), torch.full_like(plain.depth_z, SKY)):
        found = nested.decode(with_metric(features, plain.depth_z, sky))
        assert found.scale is None and torch.equal(found.depth_z, plain.depth_z)
        assert "Lengths are up to scale, not metres" in caplog.text
        caplog.clear()


@torch.no_grad()
def test_a_prediction_says_that_it_is_metric(nested):
    zeros = torch.zeros(4, 2, dtype=torch.float64)
    batch = ImageBatch(
        images=IMAGES, names=tuple("abcd"), photo_hw=torch.full((4, 2), 32), scale_xy=zeros + 1, offset_xy=zeros
    )
    found = predict(nested, batch)
    assert found.lengths == "metres (from a metric model)"
    assert found.scale.value > 0 and found.scale.spread > 0
    assert found.sky.shape == found.depth_z.shape
    by_rays = predict(nested, batch, pose_from="rays")
    assert relative_error(torch.from_numpy(by_rays.K), torch.from_numpy(found.K)) > 1e-3
    assert predict(tiny_single_view(), batch).scale is predict(tiny_da3(), batch).scale is None


@torch.no_grad()
def test_metric_maps_travel_with_tokens_and_features(nested):
    tokens = nested.embed(IMAGES[None])
    features = nested.aggregate(tokens)
    assert features.extra.keys() == {METRIC_DEPTH, METRIC_SKY}
    chosen = nested.aggregate(tokens.select([0, 2])).extra
    assert all(torch.equal(chosen[name], value[:, [0, 2]]) for name, value in features.extra.items())
    assert all(torch.equal(features.select([0, 2]).extra[name], chosen[name]) for name in chosen)
    in_chunks = embed_in_chunks(nested, IMAGES, device=torch.device("cpu")).extra
    assert all(relative_error(in_chunks[name], value) <= 1e-5 for name, value in features.extra.items())
    layers = nested.spec.loss_layers
    with pytest.raises(UserError, match="Embed the images without `layers`"):
        nested.decode(nested.aggregate(nested.embed(IMAGES[None], layers=layers)))


def test_an_adapter_acts_on_the_any_view_part_alone():
    model, anyview = tiny_nested(), tiny_da3()
    before = outputs(model, IMAGES)
    adapter = trained(model)
    assert adapter.model is model.da3 and adapter.model.spec is model.spec
    changed = {name for name, p in model.named_parameters() if p.requires_grad}
    assert changed and all(name.startswith("da3.") for name in changed)
    assert sum(p.numel() for p in adapter.parameters()) == sum(p.numel() for p in trained(anyview).parameters())
    assert not same(outputs(model, IMAGES), before)
    adapter.detach()
    assert same(outputs(model, IMAGES), before)


# -- checkpoints


def official(folder: Path, part: str) -> dict[str, torch.Tensor]:
    return {
        name.replace("model.", f"model.{part}", 1): v for name, v in load_file(folder / "weights.safetensors").items()
    }


def entry_of(build, keys) -> ModelEntry:
    return ModelEntry(name="small", about="", licence="none", parameters=0, build=build, keys=keys)


def test_official_names_load_strictly(tmp_path, monkeypatch):
    wanted = build_nested(FOLDER / "tiny-nested")
    parts = (small_config(FOLDER / "tiny-mlp"), small_config(FOLDER / "tiny-mono"))
    (anyview, spec), (single, _) = parts
    state = official(FOLDER / "tiny-mlp", "da3.") | official(FOLDER / "tiny-mono", "da3_metric.")
    state["model.da3.gs_head.weight"] = torch.zeros(3)
    entry = entry_of(lambda: DA3Nested(anyview, single, spec), NESTED_KEYS)
    monkeypatch.setattr(da3_config, "ENTRIES", (entry,))
    save_file(state, tmp_path / "model.safetensors")
    loaded = catalog.load_model("small", checkpoint=tmp_path)
    assert all(torch.equal(value, loaded.state_dict()[name]) for name, value in wanted.state_dict().items())
    assert loaded.adaptable().loaded_from is loaded.loaded_from is not None
    for change, text in (
        ({"model.da3_metric.head.scratch.sky_output_conv2.0.bias": None}, "1 missing"),
        ({"model.da3_metric.head.norm.weight": torch.zeros(64)}, "1 unexpected"),
    ):
        bad = {name: value for name, value in {**state, **change}.items() if value is not None}
        save_file(bad, tmp_path / "model.safetensors")
        with pytest.raises(UserError, match=text):
            catalog.load_model("small", checkpoint=tmp_path)


def test_a_single_view_checkpoint_is_not_taken_for_another_model(monkeypatch):
    (anyview, spec), (single, _) = (small_config(FOLDER / name) for name in ("tiny-mlp", "tiny-mono"))
    monkeypatch.setattr(da3_config, "ENTRIES", (entry_of(lambda: DA3Nested(anyview, single, spec), NESTED_KEYS),))
    with pytest.raises(UserError, match="does not fit small"):
        catalog.load_model("small", checkpoint=FOLDER / "tiny-mono" / "weights.safetensors")
    monkeypatch.setattr(
        da3_config, "ENTRIES", (entry_of(lambda: da3_config.build_single_view(single, spec), SINGLE_VIEW_KEYS),)
    )
    catalog.load_model("small", checkpoint=FOLDER / "tiny-mono" / "weights.safetensors")
    with pytest.raises(UserError, match="does not fit small"):
        catalog.load_model("small", checkpoint=FOLDER / "tiny-mlp" / "weights.safetensors")
