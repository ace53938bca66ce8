"""DA3 against recorded numbers of the reference implementation: networks, pure functions, key lists.

`cases(folder)` yields one check per recorded case; a check returns its worst error divided by the tolerance of the
recordings' README, so that it passes up to 1.
"""

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from torch import Tensor

from fixture_tools import DEVICE, read_tensors, recorded_cases, relative_error
from freegeo.geometry.se3 import to_4x4
from freegeo.models import reference
from freegeo.models.catalog import build_empty, entry
from freegeo.models.checkpoints import build_on_meta, load_weights
from freegeo.models.da3 import DA3
from freegeo.models.da3_config import KEYS, SINGLE_VIEW_KEYS, DA3Config
from freegeo.models.da3_metric import METRIC_DEPTH, METRIC_SKY, DA3Nested, DA3SingleView, fill_sky
from freegeo.models.images import IMAGE_MEAN, IMAGE_STD
from freegeo.models.spec import AdaptationDefaults, ModelSpec
from freegeo.types import Features, Prediction, ViewTokens
from parity_da3_functions import FUNCTIONS

NETWORK = 1e-4
ANY_VIEW = ("tiny-mlp", "tiny-swiglu", "tiny-mixed")
SINGLE_VIEW, NESTED = "tiny-mono", "tiny-nested"
KEY_LISTS = (
    "da3-small", "da3-base", "da3-large", "da3-giant", "da3mono-large", "da3metric-large", "da3nested-giant-large",
)  # fmt: skip
STARTS = ("alt_start", "qknorm_start", "rope_start")
Check = Callable[[], float]


def cases(folder: Path) -> Iterator[tuple[str, Check]]:
    """Name and check of every network case, function case and key list in `folder`."""
    networks = {model: NETWORKS.get(model, check_network) for model in (*ANY_VIEW, SINGLE_VIEW, NESTED)}
    yield from recorded_cases(folder, networks, FUNCTIONS)
    for preset in KEY_LISTS:
        path = folder / f"keys-{preset}.json"
        if path.is_file():
            yield f"keys.{preset}", lambda preset=preset, path=path: check_keys(preset, path)


def build(folder: Path) -> DA3:
    """Build and load the small any-view model of a fixture folder."""
    model = build_on_meta(lambda: empty_model(folder))
    load_weights(model, folder / "weights.safetensors", KEYS, folder.name)
    return model.eval().to(DEVICE)


def build_single_view(folder: Path) -> DA3SingleView:
    """Build and load the small single-view model of a fixture folder."""
    model = build_on_meta(lambda: DA3SingleView(*small_config(folder)))
    load_weights(model, folder / "weights.safetensors", SINGLE_VIEW_KEYS, folder.name)
    return model.eval().to(DEVICE)


def build_nested(folder: Path) -> DA3Nested:
    """Build the small nested model of a fixture folder from the two models beside it."""
    values = json.loads((folder / "config.json").read_text())
    anyview = build(folder.parent / values["anyview"]["fixture"])
    metric = build_single_view(folder.parent / values["metric"]["fixture"])
    model = build_on_meta(lambda: DA3Nested(anyview.config, metric.config, anyview.spec))
    state = {f"da3.{name}": value for name, value in anyview.state_dict().items()}
    state |= {f"da3_metric.{name}": value for name, value in metric.state_dict().items()}
    model.load_state_dict(state, assign=True)
    for parameter in model.parameters():
        parameter.requires_grad_(False)
    return model.eval().to(DEVICE)


def empty_model(folder: Path) -> DA3:
    """Build the small any-view model of a fixture folder without weights."""
    return DA3(*small_config(folder))


def small_config(folder: Path) -> tuple[DA3Config, ModelSpec]:
    """Read the architecture of a fixture folder's small model; starts of -1 there are "never" here."""
    values = json.loads((folder / "config.json").read_text())
    net, head = values["net"], values["head"]
    starts = {name: net[name] if net[name] >= 0 else net["depth"] for name in STARTS}
    camera = values.get("cam_enc", {"trunk_depth": 0, "num_heads": 1})
    config = DA3Config(
        width=net["embed_dim"], depth=net["depth"], heads=net["num_heads"], out_layers=tuple(net["out_layers"]),
        **starts, head_features=head["features"], head_channels=tuple(head["out_channels"]),
        ffn="mlp" if net["ffn_layer"] == "mlp" else "swiglu", cat_token=net["cat_token"],
        camera_encoder_depth=camera["trunk_depth"], camera_encoder_heads=camera["num_heads"],
    )  # fmt: skip
    spec = ModelSpec(
        name=folder.name, patch_size=14, default_side=504, loss_layers=config.out_layers, reference="saddle_balanced",
        special_tokens=1, weights_licence="none", adaptation=AdaptationDefaults(temperature=10.0, scene_lr=3e-5),
        takes="cameras",
    )  # fmt: skip
    return config, spec


@torch.no_grad()
def check_network(folder: Path, case: dict) -> float:
    """Compare tokens, features, cameras and dense maps; the reference view must be the recorded one."""
    model, wanted = build(folder), read_tensors(folder / case["file"])
    tokens = model.embed(images_of(wanted))
    known = None
    if "extrinsics_in" in wanted:
        # The recorded network takes poses as they come; normalising them was left to its callers.
        known = model.encode_cameras(to_4x4(wanted["extrinsics_in"]), wanted["intrinsics_in"], tokens.image_hw)
    features = aggregated(model, tokens, case, known)
    ours = found_tensors(model, tokens, features, model.decode(features, want=("depth", "cameras", "rays")))
    if known is not None:
        ours["cam_enc"] = known
    if "ref_idx" in wanted:
        order = model.view_order(tokens, case["ref_view_strategy"])
        chosen = torch.zeros_like(wanted["ref_idx"]) if order is None else order[:, 0]
        if not torch.equal(chosen, wanted["ref_idx"]):
            return math.inf
    ours |= block_outputs(model, tokens, case, known, wanted)
    compared = [name for name in wanted if name in ours]
    assert {"depth", "extrinsics", "intrinsics", "pose_enc"} <= set(compared)
    return max(relative_error(ours[name], wanted[name]) for name in compared) / NETWORK


def aggregated(model: DA3, tokens: ViewTokens, case: dict, known: Tensor | None) -> Features:
    """Aggregate as the case says, with the camera tokens of known cameras or the learned ones."""
    if known is None:
        return model.aggregate(tokens, reference=case["ref_view_strategy"])
    return model.mix(tokens, model.config.out_layers, None, known)


@torch.no_grad()
def check_single_view(folder: Path, case: dict) -> float:
    """Compare the blocks' last tokens, features, depth before and after sky is filled, and sky."""
    model, wanted = build_single_view(folder), read_tensors(folder / case["file"])
    tokens = model.embed(images_of(wanted))
    features = model.aggregate(tokens)
    found, raw = model.decode(features), model.read_maps(features)["depth_z"]
    ours = {
        "depth": found.depth_z,
        "sky": found.sky,
        "depth_raw": raw,
        f"block.{model.config.depth - 1}": tokens.tokens,
    }
    for layer, (patch, special) in features.levels.items():
        ours |= {f"feat.{layer}": patch, f"cam.{layer}": special[..., 0, :]}
    assert set(ours) <= set(wanted)
    return max(relative_error(ours[name], wanted[name]) for name in ours) / NETWORK


@torch.no_grad()
def check_nested(folder: Path, case: dict) -> float:
    """Compare both parts, the scale, and the result in metres."""
    model, wanted = build_nested(folder), read_tensors(folder / case["file"])
    tokens = model.embed(images_of(wanted))
    features = model.aggregate(tokens, reference=case["ref_view_strategy"])
    found, anyview = model.decode(features), model.da3.decode(features)
    order = model.da3.view_order(tokens, case["ref_view_strategy"])
    if order is None or not torch.equal(order[:, 0], wanted["ref_idx"]):
        return math.inf
    ours = {
        "anyview.depth": anyview.depth_z,
        "anyview.depth_conf": anyview.conf,
        "metric.depth": fill_sky(features.extra[METRIC_DEPTH], features.extra[METRIC_SKY]),
        "metric.sky": found.sky,
        "depth": found.depth_z,
        "depth_conf": found.conf,
        "extrinsics": found.T_cam_world[..., :3, :],
        "intrinsics": found.K,
        "scale_factor": found.scale[0, 0],
    }
    return max(relative_error(value, wanted[name]) for name, value in ours.items()) / NETWORK


def images_of(wanted: dict[str, Tensor]) -> Tensor:
    """Return recorded images in [0, 1]: they are recorded normalised, and the models normalise by themselves."""
    mean, std = (torch.tensor(v, device=DEVICE)[:, None, None] for v in (IMAGE_MEAN, IMAGE_STD))
    return wanted["images"] * std + mean


def found_tensors(model: DA3, tokens: ViewTokens, features: Features, prediction: Prediction) -> dict[str, Tensor]:
    """Name our results as the recordings do."""
    named = {
        "depth": prediction.depth_z,
        "depth_conf": prediction.conf,
        "ray": prediction.rays[..., :6],
        "ray_conf": prediction.rays[..., 6],
        "extrinsics": prediction.T_cam_world[..., :3, :],
        "intrinsics": prediction.K,
        "pose_enc": model.cam_dec(features.levels[max(features.levels)][1][..., 0, :]),
    }
    for layer, (patch, special) in features.levels.items():
        named |= {f"feat.{layer}": patch, f"cam.{layer}": special[..., 0, :]}
    return named


def block_outputs(model: DA3, tokens: ViewTokens, case: dict, known: Tensor | None, wanted: dict) -> dict[str, Tensor]:
    """Record the output of every block in the internal view order, as the recordings have it."""
    seen: dict[str, Tensor] = {}
    shape = tokens.tokens.shape
    hooks = [
        block.register_forward_hook(lambda _m, _i, out, i=i: seen.__setitem__(f"block.{i}", out.reshape(shape)))
        for i, block in enumerate(model.backbone["pretrained"].blocks)
    ]
    aggregated(model, model.embed(images_of(wanted)), case, known)
    for hook in hooks:
        hook.remove()
    order = None if known is not None else model.view_order(tokens, case["ref_view_strategy"])
    early = model.config.alt_start - 1
    if order is not None and f"block.{early}" in seen:
        seen[f"block.{early}"] = reference.take_views(seen[f"block.{early}"], order)
    return seen


def check_keys(preset: str, path: Path) -> float:
    """Compare names and shapes of a preset built on the meta device with a stored list."""
    listed = json.loads(path.read_text())
    wanted = {name: tuple(shape) for name, shape in listed["shapes"].items()}
    rules = entry(preset).keys
    aliases, skipped = rules.aliases, tuple(f"model.{name}" for name in rules.skipped)
    state = build_empty(preset).state_dict()
    ours = {f"model.{name}": tuple(value.shape) for name, value in state.items() if name not in aliases}
    wanted = {name: shape for name, shape in wanted.items() if not name.startswith(skipped)}
    tied = {f"model.{name}" for name in aliases}
    return 0.0 if ours == wanted and tied == set(listed["tied_aliases"]) else math.inf


NETWORKS = {SINGLE_VIEW: check_single_view, NESTED: check_nested}
"""Checks of the networks that are not any-view models."""
