"""Seconds of filtering a generated room's exact depth (about 1 M pixels) and of writing each export format.

Run: python benchmarks/export.py [--views 8] [--side 364] [--threads 2]
Budget: 10 s per format for 1 M points on two cores (measured on one); COLMAP writes 100 k points with tracks.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from record import write_result

from freegeo.data.procedural import render, sample_rooms
from freegeo.export.base import MAX_TRACKS
from freegeo.export.formats import FORMATS, export, filter_reconstruction
from freegeo.export.reconstruction import Reconstruction
from freegeo.fusion.settings import FilterSettings

PHOTO_SCALE = 4


def room(views: int, side: int, seed: int) -> Reconstruction:
    """Exact depth and cameras, with photos of four times the resolution."""
    rendered = render(sample_rooms([seed], frames=views), side, side)
    return Reconstruction(
        depth_z=rendered.depth_z[0].numpy(),
        conf=np.ones((views, side, side), np.float32),
        T_cam_world=rendered.T_cam_world[0].numpy(),
        K=rendered.K[0].numpy(),
        images=(rendered.images[0].permute(0, 2, 3, 1) * 255).round().byte().numpy(),
        names=tuple(f"{view:03d}.jpg" for view in range(views)),
        photo_hw=np.full((views, 2), side * PHOTO_SCALE),
        scale_xy=np.full((views, 2), 1 / PHOTO_SCALE),
        offset_xy=np.zeros((views, 2)),
    )


def measured(work) -> tuple[object, dict[str, float]]:
    """Result of `work()`, and the wall-clock and processor seconds it took."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, {"wall_s": round(time.perf_counter() - wall, 3), "cpu_s": round(time.process_time() - cpu, 3)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--side", type=int, default=364)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "export.json")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)

    small = room(2, 56, options.seed)
    with tempfile.TemporaryDirectory() as folder:
        export(small, folder, list(FORMATS))  # imports and first calls are not what is measured

    scene = room(options.views, options.side, options.seed)
    _, filtering = measured(lambda: filter_reconstruction(scene))
    everything = filter_reconstruction(scene, settings=FilterSettings(drop_share=0, flying=False, multi_view=False))
    formats = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in FORMATS:
            paths, seconds = measured(lambda name=name: export(scene, Path(folder) / name, [name], filtered=everything))
            megabytes = sum(path.stat().st_size for path in paths) / 1e6
            formats[name] = seconds | {"megabytes": round(megabytes, 1)}
    pixels = scene.depth_z.size
    write_result(
        options.out,
        settings={
            "views": options.views,
            "image_hw": [options.side, options.side],
            "points": min(pixels, 1_000_000),
            "colmap_points": MAX_TRACKS,
            "seed": options.seed,
            "threads": options.threads,
        },
        results={"filtering": filtering, "formats": formats},
        packages=("torch", "numpy", "trimesh", "pycolmap"),
    )


if __name__ == "__main__":
    main()
