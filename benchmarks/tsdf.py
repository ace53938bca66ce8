"""CPU seconds of fusing 40 depth maps (640 x 480) of a furnished box room at 2 cm, and of extracting the mesh.

Run: python benchmarks/tsdf.py [--frames 40] [--truncation 0.15] [--device cpu]
Budget: 8 CPU seconds for the fusion of 40 frames on one core.
"""

import argparse
import time
from pathlib import Path

import torch
from record import write_result

from freegeo.fusion.tsdf import TsdfVolume

ROOM = torch.tensor([6.0, 3.0, 5.0], dtype=torch.float64)
BOXES = [([1.0, 1.8, 1.0], [2.2, 3.0, 2.0]), ([4.0, 2.2, 3.0], [5.2, 3.0, 4.2]), ([2.6, 0.5, 4.2], [3.6, 3.0, 4.9])]
HEIGHT, WIDTH, FOCAL = 480, 640, 525.0


def camera(index: int, count: int) -> torch.Tensor:
    """World-to-camera matrix number `index` of a turn through the middle of the room."""
    yaw = torch.tensor(2 * torch.pi * index / count, dtype=torch.float64)
    forward = torch.stack([yaw.sin(), torch.tensor(0.15, dtype=torch.float64), yaw.cos()])
    forward = forward / forward.norm()
    down = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    right = torch.linalg.cross(down, forward)
    right = right / right.norm()
    R = torch.stack([right, torch.linalg.cross(forward, right), forward])
    centre = ROOM / 2 - 0.8 * forward
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3], T[:3, 3] = R, -R @ centre
    return T


def render(T: torch.Tensor, K: torch.Tensor) -> torch.Tensor:
    """Exact z-depth (480, 640) float32 of the room seen from one camera."""
    v, u = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    rays = torch.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], torch.ones_like(u)], dim=-1).double()
    directions = rays @ T[:3, :3]
    origin = -T[:3, :3].mT @ T[:3, 3]
    near, far = (0 - origin) / directions, (ROOM - origin) / directions
    depth = torch.maximum(near, far).amin(dim=-1)
    for low, high in BOXES:
        a = (torch.tensor(low, dtype=torch.float64) - origin) / directions
        b = (torch.tensor(high, dtype=torch.float64) - origin) / directions
        enter, leave = torch.minimum(a, b).amax(dim=-1), torch.maximum(a, b).amin(dim=-1)
        depth = torch.where((enter < leave) & (enter > 0) & (enter < depth), enter, depth)
    return depth.float()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--voxel", type=float, default=0.02)
    parser.add_argument("--truncation", type=float, default=0.15)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "tsdf.json")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)

    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    cameras = [camera(index, options.frames) for index in range(options.frames)]
    depths = [render(T, K).to(options.device) for T in cameras]
    TsdfVolume(voxel=options.voxel, truncation=options.truncation, device=options.device).integrate(
        depths[0], K, cameras[0]
    )

    volume = TsdfVolume(voxel=options.voxel, truncation=options.truncation, device=options.device)
    wall, cpu = time.perf_counter(), time.process_time()
    for depth, T in zip(depths, cameras, strict=True):
        volume.integrate(depth, K, T)
    if options.device != "cpu":
        torch.cuda.synchronize()
    fusion = {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}
    wall, cpu = time.perf_counter(), time.process_time()
    mesh = volume.extract_mesh()
    extraction = {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}

    write_result(
        options.out,
        settings={
            "frames": options.frames,
            "image_hw": [HEIGHT, WIDTH],
            "voxel_m": options.voxel,
            "truncation_m": options.truncation,
            "device": options.device,
            "threads": options.threads,
        },
        results={
            "fusion": fusion,
            "extraction": extraction,
            "blocks": volume.block_count,
            "vertices": len(mesh.vertices),
            "triangles": len(mesh.triangles),
        },
    )


if __name__ == "__main__":
    main()
