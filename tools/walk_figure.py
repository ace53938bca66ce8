"""Draw the cameras of results of a generated walk from above, with the true path: docs/figures/walk.png.

    python benchmarks/sequences.py walk --work W [--refine]      # results below W
    python tools/walk_figure.py RESULT... -o docs/figures/walk.png

The photos are those of `benchmarks/sequences.py` with its default seed; each path is aligned to the true one.
"""

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import torch
from matplotlib import pyplot as plt

from freegeo.data.procedural import walk
from freegeo.export.reconstruction import Reconstruction
from freegeo.geometry.se3 import camera_centres
from freegeo.geometry.sim3 import align_cameras

SEED, DOMAIN, FRAMES = 20_000_000, "test-id", 300


def main() -> None:
    """Read the command line and write the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", nargs="+", type=Path)
    parser.add_argument("--titles", nargs="+", default=["chunks as predicted", "refined, and all photos together"])
    parser.add_argument("-o", "--output", type=Path, required=True)
    arguments = parser.parse_args()
    true = walk(SEED, DOMAIN, FRAMES).T_cam_world.double()
    count = len(arguments.results)
    figure, axes = plt.subplots(1, count, figsize=(4 * count, 4), layout="constrained", sharex=True, sharey=True)
    for part, folder, title in zip(axes, arguments.results, arguments.titles, strict=True):
        result = Reconstruction.load(folder)
        own = true[[int(Path(name).stem) for name in result.names]]
        aligned = align_cameras(own, torch.from_numpy(result.cameras()[0]).double(), ransac=False).T_cam_world
        for T, style, label in ((true, {"color": "0.75", "linewidth": 4}, "true"), (aligned, {}, "found")):
            x, y, _ = camera_centres(T).T.numpy()
            part.plot(x, y, label=label, **style)
        part.set(title=title, aspect="equal", xlabel="m")
    axes[0].legend(loc="upper right")
    axes[0].set_ylabel("m")
    figure.savefig(arguments.output, dpi=100)


if __name__ == "__main__":
    main()
