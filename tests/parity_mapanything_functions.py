"""MapAnything's pure functions against recorded inputs and outputs; a check returns its worst error over tolerance."""

import json
import math
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor
from torch.nn import functional as F

from fixture_tools import DEVICE, read_tensors, relative_error
from freegeo.data.photos import load_photos
from freegeo.geometry.rays import intrinsics_from_rays
from freegeo.geometry.rotation import matrix_to_quat_xyzw, quat_xyzw_to_matrix
from freegeo.models.mapanything import camera_to_world, dense_maps, metres, world_points
from freegeo.models.mapanything_images import plan_size, preprocess, size_for
from freegeo.models.mapanything_priors import (
    TINY,
    DenseEncoder,
    GlobalEncoder,
    along_rays,
    depth_factor,
    depth_hints,
    rays_of,
    relative_poses,
    translation_factor,
)
from freegeo.models.transformer import position_table
from parity_vggt_functions import synthetic

FUNCTION = 1e-5
LEVEL = 1 / 255
PIXEL = 1e-6
CPU = torch.device("cpu")


def check_rotation(path: Path) -> float:
    values = read_tensors(path)
    quat = torch.stack([values["quat_ref"], values["quat_view"]], dim=1)
    trans = torch.stack([values["trans_ref"], values["trans_view"]], dim=1)
    relative, moved = relative_poses(quat, trans)
    return max(
        relative_error(quat_xyzw_to_matrix(values["quat_in"]), values["quat_to_mat"]),
        relative_error(matrix_to_quat_xyzw(values["mat_in"]), values["mat_to_quat"]),
        relative_error(relative[:, 1], values["relative_quat"]),
        relative_error(moved[:, 1], values["relative_trans"]),
    ) / FUNCTION  # fmt: skip


def check_rays(path: Path) -> float:
    values = read_tensors(path)
    rays = rays_of(values["intrinsics"], tuple(values["depth_z"].shape[-2:]))
    unit = F.normalize(values["user_rays"], dim=-1)
    return max(
        relative_error(rays, values["rays"]),
        relative_error(unit, values["user_rays_unit"]),
        relative_error(along_rays(values["depth_z"], rays), values["depth_along_ray_K"]),
        relative_error(along_rays(values["depth_z"], unit), values["depth_along_ray_user"]),
    ) / FUNCTION  # fmt: skip


def check_intrinsics(path: Path) -> float:
    values = read_tensors(path)
    errors = []
    for case in (name.removesuffix(".true") for name in values if name.endswith(".true")):
        height, width = (int(part[1:]) for part in case.split("_")[1:])
        v, u = torch.meshgrid(*(torch.arange(n, device=DEVICE).float() for n in (height, width)), indexing="ij")
        noise = torch.stack([(0.7 * u + 0.3 * v).sin(), (0.2 * u - 0.9 * v).cos(), (0.5 * v).sin()], dim=-1)
        rays = rays_of(values[f"{case}.true"], (height, width)) + values[f"{case}.noise"] * noise
        found = intrinsics_from_rays(rays / rays.norm(dim=-1, keepdim=True))
        errors.append(relative_error(found, values[f"{case}.fp64"]))
    return max(errors) / FUNCTION


def check_normalise(path: Path) -> float:
    values = read_tensors(path)
    depth, trans = values["depth"], values["trans"]
    every = torch.ones(1, len(depth), dtype=torch.bool, device=DEVICE)
    hints = depth_hints(depth[None], every, every)
    factor = translation_factor(trans)
    return max(
        relative_error(depth_factor(depth), values["depth_factor"]),
        relative_error(hints["depth_encoder"][0].expm1()[0, :, 0], values["depth_normalised"]),
        relative_error(hints["depth_encoder"][0][0, :, 0], values["depth_encoded"]),
        relative_error(hints["depth_scale_encoder"][0][0, :, 0], values["depth_scale_encoded"]),
        relative_error(factor, values["trans_factor"]),
        relative_error(trans / factor[:, None, None], values["trans_normalised"]),
        relative_error((factor + TINY).log(), values["trans_scale_encoded"]),
    ) / FUNCTION  # fmt: skip


@torch.no_grad()
def check_encoders(path: Path) -> float:
    values = read_tensors(path)
    built = {"dense": DenseEncoder(2, (6, 5, 7), 8, patch_size=4), "global": GlobalEncoder(3, (5, 6, 7), 8)}
    found: dict[str, Tensor] = {}
    for name, encoder in built.items():
        prefix = f"{name}.weights."
        weights = {key.removeprefix(prefix): value for key, value in values.items() if key.startswith(prefix)}
        encoder.load_state_dict(weights)
        found[name] = encoder.to(DEVICE)(values[f"{name}.in"])
    return max(
        relative_error(found["dense"], values["dense.out"]), relative_error(found["global"][:, 0], values["global.out"])
    ) / FUNCTION  # fmt: skip


def check_activations(path: Path) -> float:
    values = read_tensors(path)
    rays, distance, conf, ambiguous = dense_maps(values["dense_raw"])
    if not torch.equal(~ambiguous, values["mask"]):
        return math.inf
    quat = F.normalize(values["pose_raw"][:, 3:], dim=-1, eps=TINY)
    T = camera_to_world(values["pose_raw"], torch.ones(len(quat), device=DEVICE))
    return max(
        relative_error(rays, values["ray_directions"]),
        relative_error(distance, values["depth_along_ray"]),
        relative_error(conf, values["conf"]),
        relative_error(quat, values["cam_quats"]),
        relative_error(T[:, :3, 3], values["cam_trans"]),
        relative_error(metres(values["scale_raw"]), values["scale"]),
    ) / FUNCTION  # fmt: skip


def check_compose(path: Path) -> float:
    values = read_tensors(path)
    rays, factor, distance = values["ray_directions"], values["scale"], values["depth_unscaled"]
    T = camera_to_world(torch.cat([values["trans_unscaled"], values["quats"]], dim=-1), factor)
    still = torch.eye(4, device=DEVICE).expand(len(T), 4, 4)
    along = factor[:, None, None] * distance
    return max(
        relative_error(T, values["T_world_cam"]),
        relative_error(along, values["depth_along_ray"]),
        relative_error(along * rays[..., 2], values["depth_z"]),
        relative_error(world_points(rays, distance, T, factor), values["world_points"]),
        relative_error(world_points(rays, distance, still, factor), values["cam_points"]),
    ) / FUNCTION  # fmt: skip


def check_position_table(path: Path) -> float:
    values = read_tensors(path)
    errors = []
    for name in (n for n in values if n != "pos_embed"):
        rows, columns = (int(part[1:]) // 14 for part in name.split("_"))
        factor = ((rows + 0.1) / 37, (columns + 0.1) / 37)
        errors.append(
            relative_error(position_table(values["pos_embed"], (rows, columns), scale_factor=factor), values[name])
        )
    return max(errors) / FUNCTION


def check_preprocess(path: Path) -> float:
    """Sizes and intrinsics of the table, then sampled pixels of the pictures that the second file holds."""
    table = json.loads(path.read_text())
    scenes = [list(size_for(scene["average_aspect"], 518, 14)[::-1]) == scene["target_wh"] for scene in table["scenes"]]
    if not all([*map(check_sizes, table["sizes"]), *scenes]):
        return math.inf
    pixels = path.with_name("preprocess_pixels.safetensors")
    values = read_tensors(pixels, CPU) if pixels.is_file() else {}
    return max((check_pixels(case, values) for case in table["pixels"] if values), default=0.0)


def check_sizes(row: dict) -> bool:
    """The size of one photo, where it is cut, and its intrinsics where upstream cuts at the same place with them."""
    photo = (row["height"], row["width"])
    plan = plan_size(photo, size_for(row["width"] / row["height"], 518, 14))
    same = list(plan.target[::-1]) == row["target_wh"] and list(plan.resized[::-1]) == row["resized_wh"]
    if not same or [plan.left, plan.top] != row["crop_left_top"]:
        return False
    if row["crop_left_top_with_K"] != row["crop_left_top"]:
        return True
    K, wanted = torch.tensor(row["K"]).double(), torch.tensor(row["K_out"]).double()
    ours = K.clone()
    ours[:2] *= plan.scale
    # A place counted from the corner of the photo goes to its scale times that, plus the offset.
    ours[:2, 2] += torch.tensor(plan.offset_xy(photo)) + 0.5 * plan.scale - 0.5
    return bool((ours - wanted).abs().max() <= PIXEL * max(row["width"], row["height"]))


def check_pixels(case: dict, values: dict[str, Tensor]) -> float:
    """Sampled pixels of a picture that was written as a file and read back through the photo loader."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "picture.png"
        Image.fromarray(synthetic(case["width"], case["height"])).save(file)
        batch = preprocess(load_photos([file]), side=518, patch=14)
    if list(batch.images.shape[-2:]) != case["out_hw"]:
        return math.inf
    rows, columns = values[f"{case['id']}.yx"].long().unbind(1)
    return float((batch.images[0][:, rows, columns].T - values[f"{case['id']}.rgb"]).abs().max()) / LEVEL


FUNCTIONS: dict[str, Callable[[Path], float]] = {
    "rotation.safetensors": check_rotation,
    "rays.safetensors": check_rays,
    "intrinsics_from_rays.safetensors": check_intrinsics,
    "normalise.safetensors": check_normalise,
    "encoders.safetensors": check_encoders,
    "activations.safetensors": check_activations,
    "compose.safetensors": check_compose,
    "dino_pos_embed.safetensors": check_position_table,
    "preprocess.json": check_preprocess,
}
