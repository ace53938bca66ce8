"""VGGT against recorded numbers of the reference implementation: networks, gradients, pure functions, key list.

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
from freegeo.geometry.depth import depth_to_world
from freegeo.models.catalog import build_empty
from freegeo.models.checkpoints import build_on_meta, load_weights
from freegeo.models.spec import AdaptationDefaults, ModelSpec
from freegeo.models.vggt import VGGT
from freegeo.models.vggt_config import KEYS, VGGTConfig
from freegeo.types import Features, Prediction, ViewTokens
from parity_vggt_functions import FUNCTIONS

NETWORK = 1e-4
GRADIENT = 1e-3
MODELS = ("tiny-base", "tiny-smallvar")
KEY_LIST = "keys-vggt-1b.json"
Check = Callable[[], float]


def cases(folder: Path) -> Iterator[tuple[str, Check]]:
    """Name and check of every network case, gradient, function case and the key list in `folder`."""
    yield from recorded_cases(folder, dict.fromkeys(MODELS, check_network), FUNCTIONS, check_gradients)
    if (folder / KEY_LIST).is_file():
        yield "keys.vggt-1b", lambda: check_keys(folder / KEY_LIST)


def build(folder: Path) -> VGGT:
    """Build and load the small model of a fixture folder."""
    model = build_on_meta(lambda: empty_model(folder))
    load_weights(model, folder / "weights.safetensors", KEYS, folder.name)
    return model.eval().to(DEVICE)


def empty_model(folder: Path) -> VGGT:
    """Build the small model of a fixture folder without weights."""
    values = json.loads((folder / "config.json").read_text())
    net, encoder, camera, dense = (values[k] for k in ("aggregator", "patch_encoder", "camera_head", "dpt"))
    config = VGGTConfig(
        width=net["embed_dim"], depth=net["depth"], heads=net["num_heads"], registers=net["num_register_tokens"],
        encoder_depth=encoder["depth"], encoder_heads=encoder["num_heads"], position_grid=encoder["pos_grid"],
        camera_depth=camera["trunk_depth"], camera_heads=camera["num_heads"],
        out_layers=tuple(dense["intermediate_layer_idx"]),
        head_features=dense["features"], head_channels=tuple(dense["out_channels"]),
    )  # fmt: skip
    spec = ModelSpec(
        name=folder.name, patch_size=14, default_side=504, loss_layers=config.out_layers, reference="first",
        special_tokens=config.special, weights_licence="none",
        adaptation=AdaptationDefaults(temperature=1.0, scene_lr=3e-5),
    )  # fmt: skip
    return VGGT(config, spec)


@torch.no_grad()
def check_network(folder: Path, case: dict) -> float:
    """Compare patch tokens, every list entry, every camera step, cameras, dense maps and unprojected points."""
    model, wanted = build(folder), read_tensors(folder / case["file"])
    tokens = model.embed(wanted["images"])
    features = model.aggregate(tokens)
    ours = found_tensors(model, tokens, features, model.decode(features, want=("depth", "cameras", "points")))
    assert set(wanted) - {"images"} <= set(ours)
    return max(relative_error(ours[name], wanted[name]) for name in wanted if name != "images") / NETWORK


def found_tensors(model: VGGT, tokens: ViewTokens, features: Features, found: Prediction) -> dict[str, Tensor]:
    """Name our results as the recordings do."""
    named = {
        "patch_tokens": tokens.tokens.flatten(0, 1),
        "depth": found.depth_z[..., None],
        "depth_conf": found.conf,
        "world_points": found.points[..., :3],
        "world_points_conf": found.points[..., 3],
        "extrinsics": found.T_cam_world[..., :3, :],
        "intrinsics": found.K,
        "world_points_from_depth": depth_to_world(found.depth_z, found.K, found.T_cam_world),
    }
    named |= {f"tokens.{layer}": torch.cat(level[::-1], dim=2) for layer, level in features.levels.items()}
    camera_tokens = features.levels[max(features.levels)][1][..., 0, :]
    return named | {f"pose_enc.{step}": pose for step, pose in enumerate(model.camera_head(camera_tokens))}


def check_gradients(path: Path, recompute: bool) -> float:
    """Compare the loss and every parameter's gradient through two list entries."""
    model, wanted = build(path.parent).requires_grad_(True).train(), read_tensors(path)
    model.aggregator.recompute = recompute
    levels = model.aggregate(model.embed(wanted["images"]), layers=(1, 3)).levels
    loss = sum(torch.cat(levels[layer], dim=2).square().mean() for layer in (1, 3))
    loss.backward()
    gradients = {f"grad.{name}": p.grad for name, p in model.named_parameters() if p.grad is not None}
    recorded = {name: value for name, value in wanted.items() if name.startswith("grad.")}
    assert recorded and set(recorded) <= set(gradients)
    errors = [relative_error(gradients[name], value) for name, value in recorded.items()]
    return max(relative_error(loss, wanted["loss"].squeeze()), *errors) / GRADIENT


def check_keys(path: Path) -> float:
    """Compare names and shapes of the preset built on the meta device with the stored list, tracking left out."""
    wanted = {k: tuple(v) for k, v in json.loads(path.read_text()).items() if not k.startswith("track_head.")}
    ours = {name: tuple(value.shape) for name, value in build_empty("vggt-1b").state_dict().items()}
    return 0.0 if ours == wanted else math.inf
