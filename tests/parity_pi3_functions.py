"""Pi3's pure functions against recorded inputs and outputs; each check returns its worst error over the tolerance."""

import json
import math
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch
from PIL import Image
from torch.nn import functional as F

from fixture_tools import DEVICE, read_tensors, relative_error
from freegeo.data.photos import load_photos
from freegeo.geometry.local_points import K_from_local_points
from freegeo.geometry.rotation import closest_rotation
from freegeo.geometry.se3 import inverse
from freegeo.models.dpt import confidence, uv_axes
from freegeo.models.pi3 import LinearHead, camera_to_world, local_points
from freegeo.models.pi3_config import PI3
from freegeo.models.pi3_images import plan_size, preprocess
from freegeo.models.pi3_priors import pixel_slopes, pose_tables, prepare, turn
from freegeo.models.pi3x import LARGEST_LOG_DEPTH
from freegeo.models.transformer import position_table
from parity_vggt_functions import check_rope, synthetic

FUNCTION = 1e-5
FOCAL = 1e-6
LEVEL = 1.01 / 255
CPU = torch.device("cpu")
PIXELS = PI3.pixels


def check_rotation(path: Path) -> float:
    """Compare the rotations and the gradients through the nine numbers, in float64 as they were recorded."""
    values = read_tensors(path, CPU)
    nine = values["m9"].double().requires_grad_(True)
    found = closest_rotation(F.normalize(nine.unflatten(-1, (3, 3)), dim=-1, eps=1e-12))
    (found * values["grad_in"].double()).sum().backward()
    T = camera_to_world(torch.zeros(len(nine), 3), values["m9"])
    return max(
        relative_error(T[:, :3, :3], values["R"]) / FUNCTION,
        relative_error(found, values["R"]) / FUNCTION,
        relative_error(nine.grad, values["grad_out"]) / FUNCTION,
    )


def check_intrinsics(path: Path) -> float:
    values = read_tensors(path)
    weight = values["conf_logit"].sigmoid()
    errors = []
    for name, repetitions in (("weighted_focal", 0), ("huber_focal", 5)):
        K = K_from_local_points(values["local_points"], weight, repetitions)
        errors.append(relative_error(torch.stack((K[:, 0, 0], K[:, 1, 1]), dim=-1), values[name]))
    middle = torch.tensor([(values["conf_logit"].shape[-1] - 1) / 2, (values["conf_logit"].shape[-2] - 1) / 2])
    assert torch.equal(K[0, :2, 2].cpu(), middle)
    return max(errors) / FOCAL


def check_prope(path: Path) -> float:
    values = read_tensors(path)
    errors = []
    for case in sorted({name.split(".")[0] for name in values}):
        of = {name.split(".", 1)[1]: value for name, value in values.items() if name.startswith(f"{case}.")}
        for scene, poses in enumerate(of["poses"]):
            q, k, v = (of[name][scene] for name in "qkv")
            tables = pose_tables(inverse(poses), tuple(of["grid_hw"].tolist()), q.shape[-1])
            q, k, v = turn(q, tables, "query"), turn(k, tables, "value"), turn(v, tables, "value")
            out = turn(F.scaled_dot_product_attention(q, k, v), tables, "output")
            for name, ours in (("q_out", q), ("k_out", k), ("attention", out)):
                errors.append(relative_error(ours, of[name][scene]))
    return max(errors) / FUNCTION


def check_uv(path: Path) -> float:
    errors = []
    for name, wanted in read_tensors(path, CPU).items():
        rows, columns, height, width = (int(part[1:]) for part in name.split("_"))
        u, v = uv_axes((rows, columns), width / height)
        ours = torch.stack((u.expand(rows, -1), v[:, None].expand(-1, columns)))
        errors.append(relative_error(ours, wanted))
    return max(errors) / FUNCTION


@torch.no_grad()
def check_linear_head(path: Path) -> float:
    values = read_tensors(path)
    head = LinearHead(2, 3, 14).to(DEVICE)
    head.load_state_dict({name: values[name] for name in ("proj.weight", "proj.bias")})
    return relative_error(head(values["tokens"], (2, 3)).permute(0, 2, 3, 1), values["map"]) / FUNCTION


def check_activations(path: Path) -> float:
    """Compare element by element, since depths span many orders of magnitude."""
    values = read_tensors(path)
    raw, pi3x = values["raw"], local_points(values["raw"], LARGEST_LOG_DEPTH)
    pairs = [
        (local_points(raw), values["local_points_pi3"]), (pi3x, values["local_points_pi3x"]),
        (confidence(values["conf_logit"]), values["conf_freegeo"]),
        (1 - 1 / confidence(values["conf_logit"].double()), values["conf_sigmoid"]),
        (F.normalize(torch.cat([raw[:, :2], torch.ones_like(raw[:, :1])], dim=1), dim=1).permute(0, 2, 3, 1),
         values["rays_pi3x"]),
    ]  # fmt: skip
    return max(float(((ours - wanted) / wanted).abs().max()) for ours, wanted in pairs) / FUNCTION


def check_camera(path: Path) -> float:
    values = read_tensors(path)
    T = camera_to_world(values["trans3"], values["rot9"])
    moved = T.clone()
    moved[..., :3, 3] *= values["metric"][:, None, None]
    return max(
        relative_error(T, values["camera_poses_pi3"]), relative_error(inverse(T), values["T_cam_world_pi3"]),
        relative_error(moved, values["camera_poses_pi3x"]), relative_error(inverse(moved), values["T_cam_world_pi3x"]),
    ) / FUNCTION  # fmt: skip


def check_priors(path: Path) -> float:
    values = read_tensors(path, CPU)
    worst = []
    for case in sorted({name.split(".")[0] for name in values}):
        of = {name.removeprefix(f"{case}."): value for name, value in values.items() if name.startswith(f"{case}.")}
        poses, depths = of.get("in.poses"), of.get("in.depths")
        views = of["mask_pose"].shape
        whole = torch.ones(views, dtype=torch.bool)
        rays = None
        if "in.intrinsics" in of:
            K = of["in.intrinsics"].clone()
            K[..., :2, 2] -= 0.5
            rays = pixel_slopes(K, tuple(depths.shape[-2:]))
        elif "in.rays" in of:
            rays = (of["in.rays"][..., :2] / (of["in.rays"][..., 2:] + 1e-6)).movedim(-1, -3)
        found = prepare(
            poses, rays, depths, has_pose=of.get("in.mask_add_pose", whole if poses is not None else ~whole).bool(),
            has_rays=whole, has_depth=of.get("in.mask_add_depth", whole if depths is not None else ~whole).bool(),
            counted=whole, device=CPU,
        )  # fmt: skip
        posed = torch.zeros(views, dtype=torch.bool)
        for scene, chosen in enumerate(found.posed):
            posed[scene, list(chosen)] = True
        if not torch.equal(posed, of["mask_pose"].bool()):
            return math.inf
        if found.T_cam_world is not None:
            worst.append(relative_error(inverse(found.T_cam_world), of["poses_normalised"]))
        if found.rays is not None:
            worst.append(relative_error(found.rays[0], of["ray_input"]))
        if found.depth is not None:
            # Depth that no view of a scene uses has no part in anything.
            scenes = of["mask_depth"].any(1)
            worst.append(relative_error(found.depth[0][scenes], of["depth_input"][scenes]))
    return max(worst) / FUNCTION


def check_positions(path: Path) -> float:
    values = read_tensors(path)
    table = next(value for name, value in values.items() if not name.startswith("h")).float()
    errors = []
    for name, wanted in values.items():
        if name.startswith("h"):
            grid_hw = tuple(int(part[1:]) // 14 for part in name.split("_"))
            errors.append(relative_error(position_table(table, grid_hw, size=grid_hw, antialias=True), wanted))
    return max(errors) / FUNCTION


def check_preprocess(path: Path) -> float:
    """Sizes of the table, then sampled pixels of the pictures that the second file holds."""
    table = json.loads(path.read_text())
    for row in table["sizes"]:
        if plan_size((row["height"], row["width"]), 14, PIXELS) != (row["out_height"], row["out_width"]):
            return math.inf
    pixels = path.with_name("preprocess_pixels.safetensors")
    values = read_tensors(pixels, CPU) if pixels.is_file() else {}
    return max((check_pixels(case, values) for case in table["pixels"] if values), default=0.0)


def check_pixels(case: dict, values: dict[str, torch.Tensor]) -> float:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "picture.png"
        Image.fromarray(synthetic(case["width"], case["height"])).save(file)
        batch = preprocess(load_photos([file]), patch=14, pixels=PIXELS)
    rows, columns = values[f"{case['id']}.yx"].long().unbind(1)
    found = (batch.images[0][:, rows, columns].T * 255).round()
    return float((found - values[f"{case['id']}.rgb"].float()).abs().max()) / (255 * LEVEL)


FUNCTIONS: dict[str, Callable[[Path], float]] = {
    "rotation.safetensors": check_rotation,
    "intrinsics.safetensors": check_intrinsics,
    "rope2d.safetensors": check_rope,
    "prope.safetensors": check_prope,
    "uv.safetensors": check_uv,
    "linear_head.safetensors": check_linear_head,
    "activations.safetensors": check_activations,
    "camera.safetensors": check_camera,
    "priors.safetensors": check_priors,
    "dino_pos_embed.safetensors": check_positions,
    "preprocess.json": check_preprocess,
}
