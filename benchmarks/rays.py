"""Cameras of rays against those of the camera head: the frozen embedded model on generated rooms.

    python benchmarks/rays.py [--rooms 24] [--out FILE]      (--report: print the table of FILE again)

Prints the area under the recall curve at 5, 15 and 30 degrees of 8 views, per domain, and the difference with its 95 %
interval by bootstrap over rooms (docs/models/da3.md, "Cameras from rays"). One thread, some minutes.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from record import write_result
from text_tables import interval, plain, table

from freegeo.metrics.pose import area_under_curve, pair_errors
from freegeo.models.catalog import load_model
from freegeo.training.pool import image_size
from freegeo.training.report_card import ASPECT, evaluation_rooms

DOMAINS = ("test-id", "tex", "big", "sparse", "light")
LIMITS_DEG = (5, 15, 30)
ROOMS_AT_ONCE = 8


@torch.no_grad()
def scores(domain: str, rooms: int) -> np.ndarray:
    """Areas (2, rooms, 3): camera head and rays, rooms, limits."""
    model, found = load_model("freegeo-tiny"), []
    size = image_size(model.spec.default_side, ASPECT, model.spec.patch_size)
    for first in range(0, rooms, ROOMS_AT_ONCE):
        batch = evaluation_rooms(domain, first, min(ROOMS_AT_ONCE, rooms - first), size)
        features = model.aggregate(model.embed(batch.images.float() / 255))
        poses = [model.decode(features, want=(want,)).T_cam_world.double() for want in ("cameras", "ray_cameras")]
        for room, truth in enumerate(batch.T_cam_world.double()):
            errors = [pair_errors(pose[room], truth).worst_deg for pose in poses]
            found.append([[float(area_under_curve(error, limit)) for limit in LIMITS_DEG] for error in errors])
    return np.array(found).transpose(1, 0, 2)


def text(areas: dict[str, list]) -> str:
    """The table: camera head, rays, and the difference, for each domain and all together."""
    everything = {domain: np.array(found) for domain, found in areas.items()}
    rows = []
    for domain, (head, rays) in {**everything, "all": np.concatenate(list(everything.values()), axis=1)}.items():
        for column, limit in enumerate(LIMITS_DEG):
            means = (plain(found[:, column].mean()) for found in (head, rays))
            rows.append([f"{domain} ({len(head)})", f"AUC@{limit}", *means, interval((rays - head)[:, column])])
    return table(("rooms", "score", "camera head", "rays", "difference"), rows)


def main() -> None:
    """Print a table of all domains."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=24)
    parser.add_argument("--out", type=Path, default=Path("rays.json"))
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    if not options.report:
        torch.set_num_threads(1)
        areas = {domain: scores(domain, options.rooms).tolist() for domain in DOMAINS}
        write_result(options.out, settings={"rooms": options.rooms}, results=areas, show=False)
    print(text(json.loads(options.out.read_text())["results"]))


if __name__ == "__main__":
    main()
