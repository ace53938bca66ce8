"""Seconds and peak memory of filtering and exporting long reconstructions that are mapped from their file.

The scene is a long hall, with exact depth, that a camera walks through: ten centimetres a view, swaying. Every step
runs in a process of its own. `peak_mb` is its largest resident memory, into which pages of the mapped file count that
the system could drop at any time; `own_mb` is without these (largest of samples).

Run: nice python benchmarks/streaming.py [--views 60 120 240] [--steps filter ply ...] [--hw 378 504]
"""

import argparse
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from record import write_result

from freegeo.export.formats import export, filter_reconstruction
from freegeo.export.kept import load_kept, save_kept
from freegeo.export.reconstruction import Reconstruction, save_streamed

STEPS = ("filter", "ply", "glb", "colmap", "nerfstudio", "tum", "depth", "mesh")
BLOCK = 8
STEP_M = 0.1
HALF_WIDTH_M, HALF_HEIGHT_M, MARGIN_M = 3.0, 1.5, 4.0


def cameras(views: int, hw: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """`T_cam_world` and `K` of a walk along z."""
    number = np.arange(views)
    yaw = 0.4 * np.sin(number / 9)
    centre = np.stack((0.8 * np.sin(number / 13), 0.1 * np.sin(number / 5), STEP_M * number), axis=-1)
    R = np.zeros((views, 3, 3))  # camera to world
    R[:, 0, 0], R[:, 0, 2], R[:, 1, 1], R[:, 2, 0], R[:, 2, 2] = np.cos(yaw), np.sin(yaw), 1, -np.sin(yaw), np.cos(yaw)
    T = np.tile(np.eye(4), (views, 1, 1))
    T[:, :3, :3] = R.transpose(0, 2, 1)
    T[:, :3, 3] = -np.einsum("nij,nj->ni", T[:, :3, :3], centre)
    K = np.array([[0.8 * hw[1], 0, (hw[1] - 1) / 2], [0, 0.8 * hw[1], (hw[0] - 1) / 2], [0, 0, 1]])
    return T.astype(np.float32), np.tile(K, (views, 1, 1)).astype(np.float32)


def hall(T: np.ndarray, K: np.ndarray, hw: tuple[int, int], length: float) -> tuple[np.ndarray, np.ndarray]:
    """Exact depth (H, W) and the image (H, W, 3) of one view: a box with a pattern on its walls."""
    v, u = np.mgrid[: hw[0], : hw[1]]
    ray = np.stack(((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(hw)), axis=-1) @ T[:3, :3]
    centre = -T[:3, :3].T @ T[:3, 3]
    high = np.array([HALF_WIDTH_M, HALF_HEIGHT_M, length + MARGIN_M])
    low = np.array([-HALF_WIDTH_M, -HALF_HEIGHT_M, -MARGIN_M])
    with np.errstate(divide="ignore"):
        depth = (np.where(ray > 0, high - centre, low - centre) / ray).min(axis=-1)
    point = centre + depth[..., None] * ray
    image = 128 + 90 * np.sin(point * (3.0, 5.0, 2.0)).clip(-1, 1)
    return depth.astype(np.float32), image.astype(np.uint8)


def write_hall(folder: Path, views: int, hw: tuple[int, int]) -> None:
    """Write the reconstruction block by block."""
    T, K = cameras(views, hw)

    def blocks(name: str) -> Iterator[np.ndarray] | None:
        return None if name == "sky" else (make(name, start) for start in range(0, views, BLOCK))

    def make(name: str, start: int) -> np.ndarray:
        rows = [hall(T[view], K[view], hw, STEP_M * views) for view in range(start, min(start + BLOCK, views))]
        depth, images = (np.stack(parts) for parts in zip(*rows, strict=True))
        noise = np.random.default_rng(start).random(depth.shape, dtype=np.float32)
        return {"depth_z": depth, "images": images, "conf": 1 + noise + 3 / depth}[name]

    save_streamed(
        folder, names=[f"{view:05d}.jpg" for view in range(views)], photo_hw=np.tile(hw, (views, 1)),
        scale_xy=np.ones((views, 2)), offset_xy=np.zeros((views, 2)), T_cam_world=T, K=K, blocks=blocks,
    )  # fmt: skip


def run_step(step: str, folder: Path) -> None:
    """Do one step in this process, and print its seconds and memory."""
    samples, stop = [memory("RssAnon")], threading.Event()

    def watch() -> None:
        while not stop.wait(0.02):
            samples.append(memory("RssAnon"))

    threading.Thread(target=watch, daemon=True).start()
    begin, cpu = time.perf_counter(), time.process_time()
    reconstruction = Reconstruction.load(folder)
    loaded = time.perf_counter()
    if step == "filter":
        save_kept(folder, filter_reconstruction(reconstruction))
    elif step != "load":
        filtered = load_kept(folder, reconstruction.depth_z.shape)
        export(reconstruction, folder / "out", [step], filtered=filtered)
    end = time.perf_counter()
    stop.set()
    print(json.dumps({
        "load_s": round(loaded - begin, 2), "wall_s": round(end - loaded, 2),
        "cpu_s": round(time.process_time() - cpu, 2), "peak_mb": memory("VmHWM"), "own_mb": max(samples),
    }))  # fmt: skip


def memory(name: str) -> int:
    """Return a value of this process's memory in MB (Linux)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:")) // 1000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, nargs="+", default=[60, 120, 240])
    parser.add_argument("--steps", nargs="+", default=["load", *STEPS])
    parser.add_argument("--hw", type=int, nargs=2, default=(378, 504))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "streaming.json")
    parser.add_argument("--step", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.step:
        run_step(options.step, options.folder)
        return
    results: dict[str, dict] = {}
    for views in options.views:
        with tempfile.TemporaryDirectory() as folder:
            begin = time.perf_counter()
            write_hall(Path(folder), views, tuple(options.hw))
            size = (Path(folder) / "prediction.npz").stat().st_size // 1_000_000
            results[str(views)] = {"file_mb": size, "write_s": round(time.perf_counter() - begin, 1)}
            for step in options.steps:
                command = [sys.executable, __file__, "--step", step, "--folder", folder]
                done = subprocess.run(
                    [*command, "--threads", str(options.threads)], stdout=subprocess.PIPE, text=True, check=True
                )
                results[str(views)][step] = json.loads(done.stdout)
                print(views, step, done.stdout.strip(), file=sys.stderr, flush=True)
    settings = {"image_hw": list(options.hw), "threads": options.threads}
    write_result(options.out, settings=settings, results=results, packages=("torch", "numpy", "trimesh", "pycolmap"))


if __name__ == "__main__":
    main()
