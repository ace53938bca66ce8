"""MapAnything against recorded numbers of the reference implementation: networks, gradients, functions, key list.

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
from freegeo.geometry.rotation import matrix_to_quat_xyzw
from freegeo.geometry.se3 import inverse
from freegeo.models.catalog import build_empty
from freegeo.models.checkpoints import build_on_meta, load_weights
from freegeo.models.mapanything import FUSED, SCALE, MapAnything, camera_to_world, dense_maps, metres
from freegeo.models.mapanything_config import KEYS, MapAnythingConfig, spec_of
from freegeo.models.mapanything_priors import Hints, along_rays, depth_hints, pose_hints, ray_hints, rays_of
from freegeo.types import Features, Priors, ViewTokens
from parity_mapanything_functions import FUNCTIONS

NETWORK = 1e-4
GRADIENT = 1e-3
MODELS = ("tiny-base", "tiny-smallvar")
KEY_LIST = "keys-map-anything.json"
CONDITIONS = {
    "rays": "ray_dirs_encoder", "depth": "depth_encoder", "depth_scale": "depth_scale_encoder",
    "rot": "cam_rot_encoder", "trans": "cam_trans_encoder", "trans_scale": "cam_trans_scale_encoder",
}  # fmt: skip
Check = Callable[[], float]


def cases(folder: Path) -> Iterator[tuple[str, Check]]:
    """Name and check of every network case, gradient, function case and the key list in `folder`."""
    yield from recorded_cases(folder, dict.fromkeys(MODELS, check_network), FUNCTIONS, check_gradients)
    if (folder / KEY_LIST).is_file():
        yield "keys.map-anything", lambda: check_keys(folder / KEY_LIST)


def build(folder: Path) -> MapAnything:
    """Build and load the small model of a fixture folder."""
    model = build_on_meta(lambda: empty_model(folder))
    load_weights(model, folder / "weights.safetensors", KEYS, folder.name)
    return model.eval().to(DEVICE)


def empty_model(folder: Path) -> MapAnything:
    """Build the small model of a fixture folder without weights."""
    values = json.loads((folder / "config.json").read_text())
    encoder, net, dense = (values[k] for k in ("encoder", "info_sharing", "dpt"))
    config = MapAnythingConfig(
        width=net["dim"], heads=net["num_heads"], depth=net["depth"], encoder_depth=encoder["depth"],
        position_grid=encoder["pos_grid"], out_layers=(*net["indices"], net["depth"] - 1),
        dense_encoder=tuple(values["dense_rep_encoder"]["intermediate_dims"]),
        global_encoder=tuple(values["global_rep_encoder"]["intermediate_dims"]),
        head_features=dense["features"], head_channels=tuple(dense["layer_dims"]),
        pose_hidden=values["pose_head"]["hidden"], scale_hidden=values["scale_head"]["hidden"],
    )  # fmt: skip
    return MapAnything(config, spec_of(folder.name, config, "none", side=518))


@torch.no_grad()
def check_network(folder: Path, case: dict) -> float:
    """Compare encoder, conditioning, every block and level, raw heads and what is made of them."""
    model, wanted = build(folder), read_tensors(folder / case["file"])
    hints = recorded_hints(case, wanted)
    tokens = model.embed(wanted["images"])
    streams = {}
    hooks = [
        block.register_forward_hook(lambda _, __, out, i=i: streams.__setitem__(f"block.{i}", out))
        for i, block in enumerate(model.info_sharing.self_attention_blocks)
    ]
    features = model.mix(tokens, None, hints)
    for hook in hooks:
        hook.remove()
    batch = wanted["images"].shape[:2]
    streams = {name: x if int(name[6:]) % 2 == 0 else x.unflatten(0, batch) for name, x in streams.items()}
    ours = streams | found_tensors(model, tokens, features, hints)
    if priors_can_say(case, wanted):
        through = model.aggregate(tokens, priors=recorded_priors(case, wanted))
        assert relative_error(through.extra[FUSED], wanted["fused"]) <= NETWORK
    inputs = {"images", *(name for name in wanted if name.startswith("in."))}
    # The class token of a level is read by nothing, and is not computed here.
    compared = [name for name in wanted if name not in inputs and not name.endswith(".cls")]
    assert set(compared) <= set(ours), set(compared) - set(ours)
    return max(relative_error(ours[name], wanted[name]) for name in compared) / NETWORK


def recorded_hints(case: dict, wanted: dict[str, Tensor]) -> Hints:
    """What the encoders read in a recorded case; a flag differs by view and scene, which `Priors` cannot say."""
    batch, (height, width) = wanted["images"].shape[:2], wanted["images"].shape[-2:]

    def seen(kind: str) -> Tensor:
        mask = torch.zeros(batch, dtype=torch.bool)
        mask[:, case.get(f"{kind}_views", [])] = True
        return mask

    inputs = {name[3:]: value.cpu() for name, value in wanted.items() if name.startswith("in.")}
    metric = inputs["is_metric"] > 0 if "is_metric" in inputs else torch.ones(batch, dtype=torch.bool)
    hints: dict = {}
    rays = None
    if "ray_directions" in inputs:
        rays = torch.nn.functional.normalize(inputs["ray_directions"], dim=-1)
        hints |= ray_hints(rays, seen("ray"))
    if "intrinsics" in inputs:
        known = seen("K")
        K = torch.where(known[..., None, None], inputs["intrinsics"], torch.eye(3))
        rays = rays_of(K, (height, width))
        hints |= ray_hints(rays, known)
    if "depth_z" in inputs:
        hints |= depth_hints(along_rays(inputs["depth_z"], rays), seen("depth"), metric)
    if "T_world_cam" in inputs:
        T = inputs["T_world_cam"]
        hints |= pose_hints(matrix_to_quat_xyzw(T[..., :3, :3]), T[..., :3, 3], seen("pose"), metric)
    if "quat" in inputs:
        hints |= pose_hints(inputs["quat"], inputs["trans"], seen("pose"), metric)
    return hints


def recorded_priors(case: dict, wanted: dict[str, Tensor]) -> Priors:
    """The same through the package's own door."""
    S = wanted["images"].shape[1]
    inputs = {name[3:]: value.cpu() for name, value in wanted.items() if name.startswith("in.")}

    def seen(kind: str) -> Tensor | None:
        return torch.tensor([view in case[f"{kind}_views"] for view in range(S)]) if f"{kind}_views" in case else None

    return Priors(
        T_cam_world=inverse(inputs["T_world_cam"]) if "T_world_cam" in inputs else None,
        K=inputs.get("intrinsics"), depth_z=inputs.get("depth_z"), has_pose=seen("pose"), has_K=seen("K"),
        metric="is_metric" not in inputs or bool(inputs["is_metric"].all()),
    )  # fmt: skip


def priors_can_say(case: dict, wanted: dict[str, Tensor]) -> bool:
    """Whether `Priors` hold all of a case: not rays, quaternions, flags that differ, or the pose of one view alone."""
    flags = wanted.get("in.is_metric", torch.ones(1))
    return not {"in.ray_directions", "in.quat"} & set(wanted) and len(flags.unique()) == 1 and case["views"] > 1


def found_tensors(model: MapAnything, tokens: ViewTokens, features: Features, hints: Hints) -> dict[str, Tensor]:
    """Name our results as the recordings do."""
    found = model.decode(features, want=("depth", "cameras", "points"))
    last = max(features.levels)
    batch = features.levels[last][0].shape[:2]
    levels = [level.flatten(0, 1) for level in model.dense_levels(features)]
    raw, pose_raw = model.dense(levels, features.grid_hw), model.pose_head(levels[-1])
    rays, distance, _, _ = dense_maps(raw)
    factor = metres(model.scale_head(features.extra[SCALE]))
    T_world_cam = camera_to_world(pose_raw, factor.flatten())
    quat = torch.nn.functional.normalize(pose_raw[:, 3:], dim=-1)
    named = {
        "enc_patch": tokens.tokens[:, :, :-1],
        "enc_cls": tokens.tokens[:, :, -1],
        "fused": features.extra[FUSED],
        "pose_raw": pose_raw.unflatten(0, batch),
        "ray_directions": rays.unflatten(0, batch),
        "depth_along_ray": factor[..., None, None] * distance.unflatten(0, batch),
        "mask_logits": raw[:, 5].unflatten(0, batch),
        "conf": found.conf,
        "world_points": found.points[..., :3],
        "depth_z": found.depth_z,
        "metric_scale": found.scale[:, 0],
        "cam_quats": quat.unflatten(0, batch),
        "cam_trans": T_world_cam[:, :3, 3].unflatten(0, batch),
        "T_world_cam": inverse(found.T_cam_world),
        "intrinsics": found.K,
    }
    named |= {f"level.{i}.patch": patch for i, (patch, _) in features.levels.items()}
    fused, last_token = features.extra[FUSED], tokens.tokens[:, :, -1:]
    x = torch.cat([fused, last_token], dim=2)
    for layer in model.config.out_layers:
        named[f"level.{layer}.scale"] = model.info_sharing.aggregate(x, model.scale_token, [layer])[1]
    for name, encoder in CONDITIONS.items():
        if encoder in hints:
            values, known = (x.to(DEVICE) for x in hints[encoder])
            encoded = model.get_submodule(encoder)(values.float().flatten(0, 1)).unflatten(0, batch)
            added = torch.where(known[..., None, None], encoded, 0.0)
            named[f"cond.{name}"] = added if name in ("rays", "depth") else added[:, :, 0]
    return named


def check_gradients(path: Path, recompute: bool) -> float:
    """Compare the loss and every recorded gradient through the three levels."""
    model, wanted = build(path.parent).requires_grad_(True).train(), read_tensors(path)
    model.set_recompute(recompute)
    features = model.aggregate(model.embed(wanted["images"]), layers=model.spec.loss_layers)
    products = [level[0] * wanted[f"probe.{layer}"] for layer, level in features.levels.items()]
    loss = sum(product.mean() + product.square().mean() for product in products)
    loss.backward()
    gradients = {f"grad.{name}": p.grad for name, p in model.named_parameters() if p.grad is not None}
    recorded = {name: value for name, value in wanted.items() if name.startswith("grad.")}
    assert recorded and set(recorded) <= set(gradients)
    errors = [relative_error(gradients[name], value) for name, value in recorded.items()]
    return max(relative_error(loss, wanted["loss"].squeeze()), *errors) / GRADIENT


def check_keys(path: Path) -> float:
    """Compare names and shapes of the preset built on the meta device with the stored list."""
    wanted = {k: tuple(v) for k, v in json.loads(path.read_text()).items()}
    ours = {name: tuple(value.shape) for name, value in build_empty("map-anything").state_dict().items()}
    return 0.0 if ours == wanted else math.inf
