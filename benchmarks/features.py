"""Size of the embedded model's features, by which the temperature of the relational loss is chosen.

    python benchmarks/features.py [--rooms 24] [--out FILE]      (--report: print the table of FILE again)

Root mean squares, for each kind of rooms and layer of the losses: of the features of 4 views among 8, of their two
halves (per view, and across views, normalised), and of their difference to the features of the 4 views alone
(docs/embedded-model.md, "Facts for adaptation"). One thread.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch
from record import write_result
from text_tables import plain, table
from torch import Tensor

from freegeo.models.catalog import load_model
from freegeo.training.pool import image_size
from freegeo.training.report_card import ASPECT, KEPT, evaluation_rooms

DOMAINS = ("val-id", "val-light")
AT_ONCE = 8


def squares(values: Tensor) -> float:
    """Mean square."""
    return float(values.double().square().mean())


@torch.no_grad()
def measure(domain: str, rooms: int) -> dict[str, list[float]]:
    """Layer -> root mean squares: teacher, its first and its second half of channels, teacher minus student."""
    model = load_model("freegeo-tiny")
    size = image_size(model.spec.default_side, ASPECT, model.spec.patch_size)
    found: dict[str, list[list[float]]] = {str(layer): [] for layer in model.spec.loss_layers}
    for first in range(0, rooms, AT_ONCE):
        batch = evaluation_rooms(domain, first, min(AT_ONCE, rooms - first), size)
        tokens = model.embed(batch.images.float() / 255)
        teacher, student = model.aggregate(tokens).select(KEPT), model.aggregate(tokens.select(KEPT))
        for layer, rows in found.items():
            taught, learned = (features.levels[int(layer)][0] for features in (teacher, student))
            halves = taught.chunk(2, dim=-1)
            parts = [taught, *halves, taught - learned]
            rows.append([len(taught) * squares(part) for part in parts])
    return {layer: (torch.tensor(rows).sum(0) / rooms).sqrt().tolist() for layer, rows in found.items()}


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=24)
    parser.add_argument("--out", type=Path, default=Path("features.json"))
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    if not options.report:
        torch.set_num_threads(1)
        results = {domain: measure(domain, options.rooms) for domain in DOMAINS}
        write_result(options.out, settings={"rooms": options.rooms}, results=results, show=False)
    record = json.loads(options.out.read_text(encoding="utf-8"))
    rows = [
        [f"{domain} ({record['settings']['rooms']})", layer, *(plain(value, 2) for value in values)]
        for domain, layers in record["results"].items()
        for layer, values in layers.items()
    ]
    print(
        table(("rooms", "layer", "features", "half per view", "normalised half", "difference to 4 views alone"), rows)
    )


if __name__ == "__main__":
    main()
