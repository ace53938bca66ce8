"""What the embedded model makes of images of other sizes than those it was trained on.

    python benchmarks/sizes.py [--rooms 12] [--out FILE]      (--report: print the table of FILE again)

Prints the scores of 8 photos of generated rooms (`test-id`, 256 x 192) by `process_res` (docs/photos.md, "The size that
the model sees"). One thread.
"""

from __future__ import annotations

import argparse
import json
import logging
from pathlib import Path

import torch
from record import write_result
from text_tables import interval, plain, table

import freegeo
from freegeo.data.procedural import get_domain, photograph_room
from freegeo.metrics.scene import evaluate

SIDES = (48, 64, 72, 80, 88, 96, 104, 112, 120, 128, 144, 192)
SCORES = {"auc15": "AUC@15", "auc30": "AUC@30", "f1_rel5": "F1 (5 %)", "abs_rel": "abs-rel"}


def measure(rooms: int) -> dict[str, list[dict[str, float]]]:
    """Side in pixels -> scores of every room."""
    model = freegeo.load_model("freegeo-tiny")
    scenes = [photograph_room(seed, "test-id").select(range(8)) for seed in get_domain("test-id").seeds(rooms)]
    found = {}
    for side in SIDES:
        results = [freegeo.reconstruct(model, scene.photos, process_res=side) for scene in scenes]
        scores = [evaluate(result, scene) for result, scene in zip(results, scenes, strict=True)]
        found[str(side)] = [{name: float(row[name]) for name in SCORES} for row in scores]
        print(f"{side} pixels", flush=True)
    return found


def text(found: dict[str, list[dict[str, float]]], default: int) -> str:
    """Mean scores by side, and the change of AUC@30 against the default."""
    rows = []
    for side, rooms in found.items():
        means = [plain(sum(room[name] for room in rooms) / len(rooms), 2) for name in SCORES]
        change = [room["auc30"] - usual["auc30"] for room, usual in zip(rooms, found[str(default)], strict=True)]
        rows.append([side, len(rooms), *means, interval(change)])
    return table(("side", "rooms", *SCORES.values(), f"AUC@30 against {default}"), rows)


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=12)
    parser.add_argument("--out", type=Path, default=Path("sizes.json"))
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    if not options.report:
        logging.disable(logging.WARNING)
        torch.set_num_threads(1)
        settings = {"rooms": options.rooms, "default": freegeo.load_model("freegeo-tiny").spec.default_side}
        write_result(options.out, settings=settings, results=measure(options.rooms), show=False)
    record = json.loads(options.out.read_text(encoding="utf-8"))
    print(text(record["results"], record["settings"]["default"]))


if __name__ == "__main__":
    main()
