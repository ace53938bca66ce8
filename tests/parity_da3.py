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

from fixture_tools import DEVICE, read_tensors, relative_error
from freegeo.geometry.se3 import to_4x4
from freegeo.models import reference
from freegeo.models.catalog import build_empty
from freegeo.models.checkpoints import build_on_meta, load_weights
from freegeo.models.da3 import DA3
from freegeo.models.da3_config import KEYS, DA3Config
from freegeo.models.images import IMAGE_MEAN, IMAGE_STD
from freegeo.models.spec import AdaptationDefaults, ModelSpec
from freegeo.types import Features, Prediction, ViewTokens
from parity_da3_functions import FUNCTIONS

NETWORK = 1e-4
ANY_VIEW = ("tiny-mlp", "tiny-swiglu", "tiny-mixed")
KEY_LISTS = ("da3-small", "da3-base", "da3-large", "da3-giant")
Check = Callable[[], float]


def cases(folder: Path) -> Iterator[tuple[str, Check]]:
    """Name and check of every any-view case, function case and key list in `folder`."""
    for model in ANY_VIEW:
        config = folder / model / "config.json"
        for case in json.loads(config.read_text())["cases"] if config.is_file() else ():
            if (folder / model / case["file"]).is_file():
                yield f"{model}.{case['name']}", lambda model=model, case=case: check_network(folder / model, case)
    for name, check in FUNCTIONS.items():
        path = folder / "functions" / name
        if path.is_file():
            yield f"functions.{path.stem}", lambda check=check, path=path: check(path)
    for preset in KEY_LISTS:
        path = folder / f"keys-{preset}.json"
        if path.is_file():
            yield f"keys.{preset}", lambda preset=preset, path=path: check_keys(preset, path)


def build(folder: Path) -> DA3:
    """Build and load the small model of a fixture folder."""
    model = build_on_meta(lambda: empty_model(folder))
    load_weights(model, folder / "weights.safetensors", KEYS, folder.name)
    return model.eval().to(DEVICE)


def empty_model(folder: Path) -> DA3:
    """Build the small model of a fixture folder without weights."""
    values = json.loads((folder / "config.json").read_text())
    net, head = values["net"], values["head"]
    config = DA3Config(
        width=net["embed_dim"], depth=net["depth"], heads=net["num_heads"], out_layers=tuple(net["out_layers"]),
        alt_start=net["alt_start"], qknorm_start=net["qknorm_start"], rope_start=net["rope_start"],
        head_features=head["features"], head_channels=tuple(head["out_channels"]),
        ffn="mlp" if net["ffn_layer"] == "mlp" else "swiglu", cat_token=net["cat_token"],
        camera_encoder_depth=values["cam_enc"]["trunk_depth"], camera_encoder_heads=values["cam_enc"]["num_heads"],
    )  # fmt: skip
    spec = ModelSpec(
        name=folder.name, patch_size=14, default_side=504, loss_layers=config.out_layers, reference="saddle_balanced",
        special_tokens=1, weights_licence="none", adaptation=AdaptationDefaults(temperature=10.0, scene_lr=3e-5),
        takes="cameras",
    )  # fmt: skip
    return DA3(config, spec)


@torch.no_grad()
def check_network(folder: Path, case: dict) -> float:
    """Compare tokens, features, cameras and dense maps; the reference view must be the recorded one."""
    model, wanted = build(folder), read_tensors(folder / case["file"])
    # The recorded images are already normalised; the model normalises by itself.
    mean, std = (torch.tensor(v, device=DEVICE)[:, None, None] for v in (IMAGE_MEAN, IMAGE_STD))
    tokens = model.embed(wanted["images"] * std + mean)
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
    mean, std = (torch.tensor(v, device=DEVICE)[:, None, None] for v in (IMAGE_MEAN, IMAGE_STD))
    aggregated(model, model.embed(wanted["images"] * std + mean), case, known)
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
    aliases = KEYS.aliases
    state = build_empty(preset).state_dict()
    ours = {f"model.{name}": tuple(value.shape) for name, value in state.items() if name not in aliases}
    wanted = {name: shape for name, shape in wanted.items() if not name.startswith("model.gs_head.")}
    tied = {f"model.{name}" for name in aliases}
    return 0.0 if ours == wanted and tied == set(listed["tied_aliases"]) else math.inf
