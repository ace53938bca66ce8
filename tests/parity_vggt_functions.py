"""VGGT's pure functions against recorded inputs and outputs; each check returns its worst error over the tolerance."""

import json
import math
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from fixture_tools import DEVICE, read_tensors, relative_error
from freegeo.data.photos import load_photos
from freegeo.geometry.camera import decode_world_to_camera
from freegeo.geometry.depth import depth_to_world, unproject, valid_depth
from freegeo.geometry.rotation import matrix_to_quat_xyzw, quat_xyzw_to_matrix
from freegeo.geometry.se3 import inverse, to_4x4
from freegeo.models.dpt import depth_maps, uv_embedding
from freegeo.models.transformer import position_table, rope_table, rotate
from freegeo.models.vggt import CameraHead, point_map
from freegeo.models.vggt_images import plan_size, preprocess

FUNCTION = 1e-5
NETWORK = 1e-4
OPENCV_LEVEL = 2 / 255
MEAN = 1e-3
MODE = "longest504"
"""The recordings' name of the way photos are read here; they hold others too."""
CPU = torch.device("cpu")


def check_rotation(path: Path) -> float:
    values = read_tensors(path)
    return max(
        relative_error(quat_xyzw_to_matrix(values["quat_in"]), values["quat_to_mat"]) / FUNCTION,
        relative_error(matrix_to_quat_xyzw(values["mat_in"]), values["mat_to_quat"]) / FUNCTION,
    )


def check_pose_encoding(path: Path) -> float:
    values = read_tensors(path)
    image_hw = tuple(values["image_hw"].tolist())
    errors = []
    for kind, pose in (("dec", values["dec_pose"]), ("roundtrip", values["enc_pose"])):
        T_cam_world, K = decode_world_to_camera(pose, image_hw)
        errors += [
            relative_error(T_cam_world[..., :3, :], values[f"{kind}_extrinsics"]),
            relative_error(K, values[f"{kind}_intrinsics"]),
        ]
    return max(errors) / FUNCTION


def check_geometry(path: Path) -> float:
    values = read_tensors(path)
    if not torch.equal(valid_depth(values["depth"]), values["valid_mask"]):
        return math.inf
    T_cam_world, K = to_4x4(values["extrinsic"]), values["intrinsic"]
    return max(
        relative_error(unproject(values["depth"], K), values["cam_points"]) / FUNCTION,
        relative_error(depth_to_world(values["depth"], K, T_cam_world), values["world_points"]) / FUNCTION,
        relative_error(inverse(to_4x4(values["se3_in"])), values["se3_inverse"]) / FUNCTION,
    )


def check_rope(path: Path) -> float:
    values = read_tensors(path)
    errors = []
    for name in (n.removesuffix(".x") for n in values if n.endswith(".x")):
        for x, positions, wanted in zip(*(values[f"{name}.{part}"] for part in ("x", "pos", "y")), strict=True):
            ours = rotate(x[None], rope_table(positions, x.shape[-1]))
            errors.append(relative_error(ours[0], wanted))
    return max(errors) / FUNCTION


def check_position_table(path: Path) -> float:
    values = read_tensors(path)
    errors = []
    for name in (n for n in values if n != "pos_embed"):
        height, width = (int(part[1:]) // 14 for part in name.split("_"))
        ours = position_table(values["pos_embed"], (height, width), size=(height, width), antialias=True)
        errors.append(relative_error(ours, values[name]))
    return max(errors) / FUNCTION


def check_uv_embedding(path: Path) -> float:
    errors = []
    for name, wanted in read_tensors(path).items():
        if name.endswith(".embed"):
            channels, rows, columns, height, width = (int(part[1:]) for part in name[: -len(".embed")].split("_"))
            ours = 0.1 * uv_embedding(channels, (rows, columns), width / height, DEVICE)
            errors.append(relative_error(ours, wanted))
    return max(errors) / FUNCTION


def check_activations(path: Path) -> float:
    values = read_tensors(path)
    points = point_map(values["x"])["points"]
    depth = depth_maps(values["x"][:, :2])
    return max(
        relative_error(points[..., :3], values["inv_log"]) / FUNCTION,
        relative_error(points[..., 3], values["inv_log_conf"]) / FUNCTION,
        relative_error(depth["depth_z"], values["exp"][..., 0]) / FUNCTION,
        relative_error(depth["conf"], values["exp_conf"]) / FUNCTION,
    )


@torch.no_grad()
def check_camera_head(path: Path) -> float:
    values = read_tensors(path)
    head = CameraHead(channels=64, depth=1, heads=4).to(DEVICE)
    prefix = "camera_head."
    head.load_state_dict({k.removeprefix(prefix): v.float() for k, v in values.items() if k.startswith(prefix)})
    poses = head(values["tokens_last"][:, :, 0], steps=6)
    return max(relative_error(pose, values[f"pose_enc.{step}"]) for step, pose in enumerate(poses)) / NETWORK


def check_preprocess(path: Path) -> float:
    """Sizes of the table, then sampled pixels of the pictures that the second file holds, of the way we read photos."""
    table = json.loads(path.read_text())
    if not all(check_sizes(row) for row in table["sizes"]):
        return math.inf
    pixels = path.with_name("preprocess_pixels.safetensors")
    values = read_tensors(pixels, CPU) if pixels.is_file() else {}
    cases = [case for case in table["pixels"] if values and case["mode"] == MODE]
    return max((check_pixels(case, values) for case in cases), default=0.0)


def check_sizes(row: dict) -> bool:
    return list(plan_size((row["height"], row["width"]), side=504, patch=14).resized) == row["longest504"]


def check_pixels(case: dict, values: dict[str, torch.Tensor]) -> float:
    """Sampled pixels of a picture that was written as a file and read back through the photo loader."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "picture.png"
        Image.fromarray(synthetic(case["source_width"], case["source_height"])).save(file)
        batch = preprocess(load_photos([file]), side=case["target_size"], patch=14)
    if list(batch.images.shape[-2:]) != case["out_hw"]:
        return math.inf
    rows, columns = values[f"{case['id']}.yx"].long().unbind(1)
    [image] = batch.images
    return max(
        float((image[:, rows, columns].T - values[f"{case['id']}.rgb"]).abs().max()) / OPENCV_LEVEL,
        float((image.mean((1, 2)) - torch.tensor(case["channel_mean"])).abs().max()) / MEAN,
    )


def synthetic(width: int, height: int) -> np.ndarray:
    y, x = np.mgrid[:height, :width].astype(np.int64)
    channels = [3 * x + 5 * y, x * y // 7, x**2 // 11 + 2 * y**2 // 13]
    return (np.stack(channels, axis=-1) % 256).astype(np.uint8)


FUNCTIONS: dict[str, Callable[[Path], float]] = {
    "rotation.safetensors": check_rotation,
    "pose_encoding.safetensors": check_pose_encoding,
    "geometry.safetensors": check_geometry,
    "rope2d.safetensors": check_rope,
    "dino_pos_embed.safetensors": check_position_table,
    "dpt_pos_embed.safetensors": check_uv_embedding,
    "activations.safetensors": check_activations,
    "camera_head_iters.safetensors": check_camera_head,
    "preprocess.json": check_preprocess,
}
