"""What the embedded model makes of images of other sizes than it was trained on, and of other reference views.

    python benchmarks/choices.py [--rooms 12] [--out FILE]      (--report: print the tables of FILE again)

Prints the scores of 8 photos of generated rooms (`test-id`, 256 x 192) by `process_res` (docs/photos.md, "The size that
the model sees") and by `reference` (docs/embedded-model.md, "Model card"). One thread.
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
from freegeo.models.api import ReconstructionModel

CHOICES: dict[str, tuple] = {
    "process_res": (48, 64, 72, 80, 88, 96, 104, 112, 120, 128, 144, 192),
    "reference": ("first", "middle", "saddle_balanced", "saddle_sim_range"),
}
SCORES = {"auc15": "AUC@15", "auc30": "AUC@30", "f1_rel5": "F1 (5 %)", "abs_rel": "abs-rel"}


def measure(model: ReconstructionModel, rooms: int) -> dict[str, dict[str, list[dict[str, float]]]]:
    """Option -> value -> scores of every room."""
    scenes = [photograph_room(seed, "test-id").select(range(8)) for seed in get_domain("test-id").seeds(rooms)]
    found: dict[str, dict[str, list[dict[str, float]]]] = {}
    for option, values in CHOICES.items():
        found[option] = {}
        for value in values:
            results = [freegeo.reconstruct(model, scene.photos, **{option: value}) for scene in scenes]
            scores = [evaluate(result, scene) for result, scene in zip(results, scenes, strict=True)]
            found[option][str(value)] = [{name: float(row[name]) for name in SCORES} for row in scores]
            print(f"{option} {value}", flush=True)
    return found


def text(option: str, found: dict[str, list[dict[str, float]]], default: str) -> str:
    """Mean scores by value, and the change of AUC@30 against the model's default."""
    rows = []
    for value, rooms in found.items():
        means = [plain(sum(room[name] for room in rooms) / len(rooms), 2) for name in SCORES]
        change = [room["auc30"] - usual["auc30"] for room, usual in zip(rooms, found[default], strict=True)]
        rows.append([value, len(rooms), *means, interval(change)])
    return table((f"`{option}`", "rooms", *SCORES.values(), f"AUC@30 against {default}"), rows)


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=12)
    parser.add_argument("--out", type=Path, default=Path("choices.json"))
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    if not options.report:
        logging.disable(logging.WARNING)
        torch.set_num_threads(1)
        model = freegeo.load_model("freegeo-tiny")
        defaults = {"process_res": str(model.spec.default_side), "reference": model.spec.reference}
        settings = {"rooms": options.rooms, "defaults": defaults}
        write_result(options.out, settings=settings, results=measure(model, options.rooms), show=False)
    record = json.loads(options.out.read_text(encoding="utf-8"))
    for option, found in record["results"].items():
        print(f"{text(option, found, record['settings']['defaults'][option])}\n")


if __name__ == "__main__":
    main()
