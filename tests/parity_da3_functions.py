"""DA3's pure functions against recorded inputs and outputs; each check returns its worst error over the tolerance."""

import json
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from fixture_tools import DEVICE, read_tensors, relative_error
from freegeo.errors import UserError
from freegeo.geometry.camera import decode_camera_to_world, encode_camera_to_world
from freegeo.geometry.rays import cameras_from_rays
from freegeo.geometry.se3 import inverse, normalise_poses, to_4x4
from freegeo.models import reference
from freegeo.models.da3 import Backbone
from freegeo.models.da3_config import DA3Config
from freegeo.models.da3_images import apply_plan, plan_size, preprocess
from freegeo.models.da3_metric import fill_sky, to_metres
from freegeo.models.dpt import uv_embedding
from freegeo.models.images import normalise
from freegeo.models.transformer import grid_rope, rotate
from freegeo.types import Prediction

FUNCTION = 1e-5
INTRINSICS = 1e-4
GREY_LEVEL = 0.0176
MOST_PIXELS = 0.02
METHOD = "upper_bound_resize"
"""The recordings' name of the way photos are read here; they hold others too."""
CPU = torch.device("cpu")


class MemoryPhoto:
    """A photo whose pixels are in memory."""

    def __init__(self, pixels: np.ndarray):
        self.name, self.size_hw, self._pixels = "memory", pixels.shape[:2], pixels

    def read(self) -> np.ndarray:
        return self._pixels


def check_pos_embed(path: Path) -> float:
    values = read_tensors(path)
    backbone = Backbone(
        DA3Config(width=4, depth=2, heads=1, out_layers=(0, 1, 2, 3), alt_start=2, qknorm_start=9, rope_start=9,
                  head_features=8, head_channels=(4, 4, 4, 4))
    )  # fmt: skip
    backbone.pos_embed = torch.nn.Parameter(values["pos_embed"])
    errors = []
    for name in (n for n in values if n.startswith("out.")):
        height, width = (int(n) for n in name.removeprefix("out.").split("x"))
        ours = backbone.position_embedding((height // 14, width // 14)).detach()
        errors.append(relative_error(ours, values[name]))
    return max(errors) / FUNCTION


def check_uv_embed(path: Path) -> float:
    errors = []
    for name, wanted in read_tensors(path).items():
        if name.startswith("embed."):
            rows, columns, height, width, channels = (int(n) for n in re.findall(r"\d+", name))
            errors.append(relative_error(uv_embedding(channels, (rows, columns), width / height, DEVICE), wanted))
    return max(errors) / FUNCTION


def check_rope(path: Path) -> float:
    values = read_tensors(path)
    errors = []
    for k in range(3):
        x = values[f"x.{k}"]
        grid = tuple(values[f"grid_hw.{k}"].tolist())
        for kind, layout in (("local", "grid"), ("global", "flat")):
            ours = rotate(x, grid_rope(grid, 1, x.shape[-1], layout, DEVICE))
            errors.append(relative_error(ours, values[f"{kind}.{k}"]))
    return max(errors) / FUNCTION


def check_pose_encoding(path: Path) -> float:
    values = read_tensors(path)
    image_hw = tuple(values["image_size_hw"].tolist())
    T_cam_world, K = decode_camera_to_world(values["dec.pose_enc"], image_hw)
    K_error = ((K - values["dec.intrinsics"]).abs() / values["dec.intrinsics"].abs().clamp_min(1e-12)).max()
    encoded = encode_camera_to_world(inverse(values["enc.c2w"]), values["enc.intrinsics"], image_hw)
    return max(
        relative_error(T_cam_world[..., :3, :], values["dec.w2c"]) / FUNCTION,
        float(K_error) / INTRINSICS,
        relative_error(encoded, values["enc.pose_enc"]) / FUNCTION,
    )


def check_normalize_extrinsics(path: Path) -> float:
    values = read_tensors(path)
    names = [n.removeprefix("in.") for n in values if n.startswith("in.")]
    return max(relative_error(normalise_poses(values[f"in.{k}"]), values[f"out.{k}"]) for k in names) / FUNCTION


def check_reference_view(path: Path) -> float:
    values = read_tensors(path)
    for name, wanted in values.items():
        rule, _, k = name.partition(".")
        x = values[f"x.{k}"]
        if rule in reference.RULES and not torch.equal(reference.RULES[rule](x[:, :, 0]), wanted):
            return math.inf
        if rule == "reordered":
            order = reference.view_order(x[:, :, 0], "saddle_balanced")
            if not torch.equal(x if order is None else reference.take_views(x, order), wanted):
                return math.inf
    return 0.0


def check_ray_pose(path: Path) -> float:
    values = read_tensors(path)
    image_hw = tuple(values["image_size_hw"].tolist())
    errors = []
    for k in (0, 1):
        generator = torch.Generator().manual_seed(0)
        T, K = cameras_from_rays(values[f"ray.{k}"], values[f"ray_conf.{k}"], image_hw, generator=generator)
        wanted_K = values[f"intrinsics.{k}"]
        K_error = ((K - wanted_K).abs() / wanted_K.abs().clamp_min(1.0)).max()
        errors += [
            relative_error(T, to_4x4(values[f"extrinsics.{k}"])) / FUNCTION,
            float(K_error) / INTRINSICS,
        ]
    return max(errors)


def check_metric_alignment(path: Path) -> float:
    values = read_tensors(path)
    errors = []
    for k in range(3):
        depth, conf, K, T, metric, sky = (
            values[f"{name}.{k}"] for name in ("depth", "depth_conf", "intrinsics", "extrinsics", "metric_depth", "sky")
        )
        # The recorded filling is that of the any-view depth.
        found = to_metres(Prediction(depth_z=depth, conf=conf, K=K, T_cam_world=to_4x4(T)), metric, sky)
        ours = {
            "out_depth": found.depth_z, "out_depth_conf": found.conf, "out_extrinsics": found.T_cam_world[..., :3, :],
            "out_scale": found.scale[0, 0], "mono_sky_depth": fill_sky(depth, sky),
        }  # fmt: skip
        errors += [relative_error(value, values[f"{name}.{k}"]) for name, value in ours.items()]
    return max(errors) / FUNCTION


def check_image_sizes(path: Path) -> float:
    """Sizes, steps and intrinsics of the table, single photos and batches of mixed sizes, of the way we read photos."""
    table = json.loads(path.read_text())
    rows, batches = ([row for row in table[key] if row["method"] == METHOD] for key in ("rows", "mixed_batches"))
    assert rows and batches
    exact = all(check_size_row(row) for row in rows) and all(check_batch_row(row) for row in batches)
    return 0.0 if exact else math.inf


def check_size_row(row: dict) -> bool:
    width, height = row["input_wh"]
    try:
        plan = plan_size((height, width), row["process_res"], 14)
    except UserError:
        return min(row["final_wh"]) < 14 or min(row["bounded_wh"]) < 7
    fx, fy, cx, cy = row["K_in"]
    across, down = plan.final[1] / width, plan.final[0] / height
    K = [fx * across, fy * down, cx * across, cy * down]
    return (
        plan.bounded == tuple(row["bounded_wh"][::-1])
        and plan.final == tuple(row["final_wh"][::-1])
        and (plan.bound_step, plan.final_step) == (row["bound_interp"], row["final_op"])
        and np.allclose(K, row["K_out"], rtol=1e-6)
    )


def check_batch_row(row: dict) -> bool:
    photos = [MemoryPhoto(np.zeros((h, w, 3), np.uint8)) for w, h in row["inputs_wh"]]
    batch = preprocess(photos, side=row["process_res"], patch=14, mixed="upstream")
    K = batch.model_K(torch.tensor([[[k[0], 0, k[2]], [0, k[1], k[3]], [0, 0, 1]] for k in row["K_in"]]))
    ours = torch.stack([K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2]], dim=-1)
    return list(batch.images.shape) == row["batch_shape"] and np.allclose(ours, row["K_out"], rtol=1e-5)


def check_image_pixels(path: Path) -> float:
    values = read_tensors(path, CPU)
    errors = []
    for name in (n for n in values if n.startswith("out.") and METHOD in n):
        _, k, _, side = name.split(".")
        pixels = values[f"in.{k}"]
        plan = plan_size(tuple(pixels.shape[:2]), int(side), 14)
        ours = normalise(apply_plan(pixels, plan).permute(2, 0, 1).float() / 255)
        difference = (ours - values[name]).abs()
        off = (difference > 1e-4).float().mean()
        errors.append(max(float(difference.max()) / GREY_LEVEL, float(off) / MOST_PIXELS))
    return max(errors)


FUNCTIONS: dict[str, Callable[[Path], float]] = {
    "pos_embed.safetensors": check_pos_embed,
    "uv_embed.safetensors": check_uv_embed,
    "rope.safetensors": check_rope,
    "pose_encoding.safetensors": check_pose_encoding,
    "normalize_extrinsics.safetensors": check_normalize_extrinsics,
    "reference_view.safetensors": check_reference_view,
    "ray_pose.safetensors": check_ray_pose,
    "metric_alignment.safetensors": check_metric_alignment,
    "image_sizes.json": check_image_sizes,
    "image_pixels.safetensors": check_image_pixels,
}
