"""Pi3 and Pi3X against recorded networks; each check returns its worst error over the tolerance."""

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from fixture_tools import DEVICE, read_tensors, recorded_cases, relative_error
from freegeo.geometry.se3 import inverse
from freegeo.models.catalog import build_empty
from freegeo.models.checkpoints import build_on_meta, load_weights
from freegeo.models.pi3 import Pi3
from freegeo.models.pi3_config import KEYS, Pi3Config, Pi3XConfig, build
from freegeo.models.pi3_priors import Given, pixel_slopes, prepare
from freegeo.models.spec import NO_REFERENCE, AdaptationDefaults, ModelSpec
from freegeo.types import ViewTokens
from parity_pi3_functions import FUNCTIONS

NETWORK = 1e-4
GRADIENT = 1e-3
MODELS = ("tiny-pi3", "tiny-pi3x", "tiny-pi3x-smallvar")
CPU = torch.device("cpu")


def cases(folder: Path) -> Iterator[tuple[str, Callable[[], float]]]:
    """Yield name and check of every case that the folder holds."""
    yield from recorded_cases(folder, dict.fromkeys(MODELS, check_network), FUNCTIONS, check_gradients)
    for name in ("pi3", "pi3x"):
        path = folder / f"keys-{name}.json"
        if path.is_file():
            yield f"keys.{name}", lambda name=name, path=path: check_keys(name, path)


def build_tiny(folder: Path) -> Pi3:
    """Build and load the small model of a fixture folder."""
    model = build_on_meta(lambda: empty_model(folder))
    load_weights(model, folder / "weights.safetensors", KEYS, folder.name)
    return model.eval().to(DEVICE)


def empty_model(folder: Path) -> Pi3:
    """Build the small model of a fixture folder without weights."""
    values = json.loads((folder / "config.json").read_text())
    encoder, decoder, heads = (values[k] for k in ("encoder", "decoder", "head_decoders"))
    config = Pi3Config(
        width=decoder["width"], pairs=decoder["depth"] // 2, heads=decoder["heads"], registers=decoder["registers"],
        encoder_depth=encoder["depth"], encoder_heads=encoder["heads"], encoder_registers=encoder["registers"],
        position_grid=encoder["pos_grid"], head_width=heads["width"], head_depth=heads["depth"],
        head_heads=heads["heads"], dense_out=heads["dense_out"], camera_out=heads["camera_out"],
    )  # fmt: skip
    if values["kind"] == "pi3x":
        conv, metric = values["conv_head"], values["metric_decoder"]
        after = values["pose_injection_after_blocks"]
        assert all(block % 2 for block in after)
        x = Pi3XConfig(
            head_channels=tuple(conv["channels"]), head_units=conv["res_blocks"], head_hidden=conv["last_channels"],
            scale_width=metric["width"], scale_depth=metric["depth"], scale_heads=metric["heads"],
            scale_out=metric["out"], pose_pairs=tuple(block // 2 for block in after),
        )  # fmt: skip
        config = replace(config, x=x)
    spec = ModelSpec(
        name=folder.name, patch_size=14, default_side=574, loss_layers=(config.readout,), reference=NO_REFERENCE,
        special_tokens=config.registers, weights_licence="none", metric=config.x is not None,
        takes="nothing" if config.x is None else "parts",
        adaptation=AdaptationDefaults(temperature=1.0, scene_lr=3e-5),
    )  # fmt: skip
    return build(config, spec)


def given(wanted: dict[str, Tensor], case: dict) -> Given:
    """Prepare the recorded priors of a case as the reference implementation does."""
    views, image_hw = wanted["images"].shape[:2], tuple(wanted["images"].shape[-2:])
    priors = case.get("priors", {})

    def mask(name: str, there: bool) -> Tensor:
        if f"mask_add_{name}" in wanted:
            return wanted[f"mask_add_{name}"].cpu().bool()
        if f"mask_add_{name}" in priors:
            return torch.tensor(priors[f"mask_add_{name}"]).bool()
        return torch.full(views, there)

    rays = slopes(wanted, image_hw) if {"rays", "intrinsics"} & set(priors) else None
    return prepare(
        wanted["poses"].cpu() if "poses" in priors else None, rays,
        wanted["depths"].float().cpu() if "depths" in priors else None,
        has_pose=mask("pose", "poses" in priors), has_rays=mask("ray", rays is not None),
        has_depth=mask("depth", "depths" in priors), counted=torch.ones(views, dtype=torch.bool), device=DEVICE,
    )  # fmt: skip


def slopes(values: dict[str, Tensor], image_hw: tuple[int, int]) -> Tensor:
    """Return the slopes of recorded intrinsics, counted from the image's corner, or of recorded rays."""
    if "intrinsics" not in values:
        rays = values["rays"].cpu()
        return (rays[..., :2] / (rays[..., 2:] + 1e-6)).movedim(-1, -3)
    K = values["intrinsics"].cpu().clone()
    K[..., :2, 2] -= 0.5
    return pixel_slopes(K, image_hw)


@torch.no_grad()
def check_network(folder: Path, case: dict) -> float:
    """Compare every recorded tensor of a case, from the encoder to the points."""
    model, wanted = build_tiny(folder), read_tensors(folder / case["file"])
    inputs = {"images", "depths", "intrinsics", "poses", "mask_add_depth", "mask_add_ray", "mask_add_pose"}
    inputs |= {"rays"} if case["name"] == "priors-partial" else set()
    known = given(wanted, case)
    ours = found_tensors(model, wanted, known)
    compared = set(wanted) - inputs
    assert compared <= set(ours), compared - set(ours)
    if known.depth is not None:
        # Depth that no view of a scene uses has no part in anything.
        views = known.depth[1].any(1, keepdim=True).expand_as(known.depth[1]).flatten().bool()
        for values in (ours, wanted):
            values["depth_tokens"] = values["depth_tokens"][views]
    return max(relative_error(ours[name], wanted[name]) for name in compared) / NETWORK


def found_tensors(model: Pi3, wanted: dict[str, Tensor], known: Given) -> dict[str, Tensor]:
    """Run the stages, and name what passes through them as the recordings do."""
    named: dict[str, Tensor] = {}

    def keep(name: str):
        def hook(module, inputs, output):
            named.setdefault(f"{name}.in", inputs[0])
            named.setdefault(name, output)

        return hook

    hooks = [block.register_forward_hook(keep(f"block.{i}")) for i, block in enumerate(model.decoder)]
    for name in ("point_decoder", "conf_decoder", "camera_decoder", "camera_head", "metric_decoder", "ray_embed"):
        if hasattr(model, name):
            hooks.append(getattr(model, name).register_forward_hook(keep(name)))
    if hasattr(model, "depth_encoder"):
        hooks.append(model.depth_encoder.register_forward_hook(keep("depth_tokens")))
    tokens = model.embed(wanted["images"].float())
    pairs, readout = model.config.pairs, model.config.readout
    layers = range(pairs + 1)
    if model.config.x is None:
        features = model.aggregate(tokens, layers=layers)
    else:
        found = model.levels_with(tokens, known, set(layers))
        features = replace(model.aggregate(tokens), levels=found)
    prediction = model.decode(features, want=("depth", "cameras", "points"))
    for hook in hooks:
        hook.remove()
    special, batch = model.config.registers, wanted["images"].shape[:2]
    both = {pair: torch.cat(features.levels[pair][::-1], dim=2) for pair in range(pairs)}
    width = model.config.width
    ours = {f"block.{2 * pair}": both[pair][..., :width] for pair in both}
    ours |= {f"block.{2 * pair + 1}": both[pair][..., width:] for pair in both}
    ours |= {"patch_tokens": tokens.tokens.flatten(0, 1), "tokens_in": named["block.0.in"].unflatten(0, batch)}
    ours["features"] = both[pairs - 1]
    ours["readout"] = model.point_decoder.first_norm(both[pairs - 1])
    assert relative_error(ours["readout"][:, :, special:], features.levels[readout][0]) < 1e-6
    ours |= {f"{name}_hidden": named[f"{name}_decoder"].unflatten(0, batch) for name in ("point", "conf", "camera")}
    ours["trans3"], ours["rot9"] = (value.unflatten(0, batch) for value in named["camera_head"])
    points = prediction.points[..., :3]
    metric = torch.ones(batch[0], device=points.device) if prediction.scale is None else prediction.scale[:, 0]
    local = local_of(prediction, points)
    ours |= {
        "camera_poses": inverse(prediction.T_cam_world), "points": points, "local_points": local, "metric": metric,
        "conf": (prediction.conf - 1).log(), "rays": local / local.norm(dim=-1, keepdim=True),
    }  # fmt: skip
    if model.config.x is not None:
        ours["metric_hidden"] = named["metric_decoder"]
        for name in ("ray_embed", "depth_tokens"):
            if name in named:
                ours[{"ray_embed": "ray_tokens"}.get(name, name)] = named[name]
        if known.T_cam_world is not None:
            ours["poses_normalised"] = inverse(known.T_cam_world)
        terms = [named[f"block.{2 * pair + 1}"] for pair in model.config.x.pose_pairs]
        for number, (pair, before) in enumerate(zip(model.config.x.pose_pairs, terms, strict=True)):
            term = ours[f"block.{2 * pair + 1}"] - before.view_as(both[pair][..., width:])
            ours[f"inject.{number}"] = term[:, :, special:]
    return ours


def local_of(prediction, points: Tensor) -> Tensor:
    """Return points in the frames of their cameras."""
    R, t = prediction.T_cam_world[..., :3, :3], prediction.T_cam_world[..., :3, 3]
    return torch.einsum("bsij,bshwj->bshwi", R, points) + t[:, :, None, None]


def check_gradients(path: Path, recompute: bool) -> float:
    """Compare the loss and the recorded parameters' gradients through the features and the readout."""
    model, wanted = build_tiny(path.parent).requires_grad_(True).train(), read_tensors(path)
    model.set_recompute(recompute)
    tokens: ViewTokens = model.embed(wanted["images"].float())
    case = {"priors": {"poses": True} if "poses" in wanted else {}}
    last, readout = model.config.last_pair, model.config.readout
    if model.config.x is None:
        levels = model.aggregate(tokens, layers=(last, readout)).levels
    else:
        levels = model.levels_with(tokens, given(wanted, case), {last, readout})
    features = torch.cat(levels[last][::-1], dim=2)
    loss = features.square().mean() + (model.point_decoder.first_norm(features) * wanted["probe"]).mean()
    loss.backward()
    gradients = {f"grad.{name}": p.grad for name, p in model.named_parameters() if p.grad is not None}
    recorded = {name: value for name, value in wanted.items() if name.startswith("grad.")}
    assert recorded and set(recorded) <= set(gradients)
    errors = [relative_error(gradients[name], value) for name, value in recorded.items()]
    return max(relative_error(loss, wanted["loss"].squeeze()), *errors) / GRADIENT


def check_keys(name: str, path: Path) -> float:
    """Compare names and shapes of the model built on the meta device with the stored list, constants left out."""
    wanted = {k: tuple(v) for k, v in json.loads(path.read_text()).items() if not k.startswith(KEYS.skipped)}
    ours = {name: tuple(value.shape) for name, value in build_empty(name).state_dict().items()}
    return 0.0 if ours == wanted else math.inf
