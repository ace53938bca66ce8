"""Cameras of rays against those of the camera head: the frozen embedded model on generated rooms.

    python benchmarks/rays.py --rooms 24

Prints the area under the recall curve at 5, 15 and 30 degrees of 8 views, per domain, and the difference with its 95 %
interval by bootstrap over rooms (docs/models/da3.md, "Cameras from rays"). One thread, some minutes.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch

from freegeo.metrics.pose import area_under_curve, pair_errors
from freegeo.models.catalog import load_model
from freegeo.training.report_card import evaluation_rooms

DOMAINS = ("test-id", "tex", "big", "sparse", "light")
LIMITS_DEG = (5, 15, 30)
ROOMS_AT_ONCE = 8
IMAGE_HW = (48, 64)
DRAWS = 2000


@torch.no_grad()
def scores(domain: str, rooms: int) -> np.ndarray:
    """Areas (2, rooms, 3): camera head and rays, rooms, limits."""
    model, found = load_model("freegeo-tiny"), []
    for first in range(0, rooms, ROOMS_AT_ONCE):
        batch = evaluation_rooms(domain, first, min(ROOMS_AT_ONCE, rooms - first), IMAGE_HW)
        features = model.aggregate(model.embed(batch.images.float() / 255))
        poses = [model.decode(features, want=(want,)).T_cam_world.double() for want in ("cameras", "ray_cameras")]
        for room, truth in enumerate(batch.T_cam_world.double()):
            errors = [pair_errors(pose[room], truth).worst_deg for pose in poses]
            found.append([[float(area_under_curve(error, limit)) for limit in LIMITS_DEG] for error in errors])
    return np.array(found).transpose(1, 0, 2)


def main() -> None:
    """Print a table of all domains."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=24)
    options = parser.parse_args()
    torch.set_num_threads(1)
    everything = {domain: scores(domain, options.rooms) for domain in DOMAINS}
    for domain, areas in {**everything, "all": np.concatenate(list(everything.values()), axis=1)}.items():
        head, rays = areas
        drawn = np.random.default_rng(0).integers(0, len(head), (DRAWS, len(head)))
        low, high = np.quantile((rays - head)[drawn].mean(axis=1), (0.025, 0.975), axis=0)
        for column, limit in enumerate(LIMITS_DEG):
            difference = (rays - head)[:, column].mean()
            print(
                f"{domain:8s} AUC@{limit:<2d} head {head[:, column].mean():.3f}  rays {rays[:, column].mean():.3f}"
                f"  difference {difference:+.3f} [{low[column]:+.3f}, {high[column]:+.3f}]"
            )


if __name__ == "__main__":
    main()
