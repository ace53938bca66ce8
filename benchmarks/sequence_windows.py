"""What drawing view sets inside chunks is worth: walks of 64 frames through generated rooms, in chunks of 16.

    python benchmarks/sequence_windows.py -o out/windows.jsonl --domains big test-id --rooms 3 [--start 0]

Adapts the embedded model to each walk (256 x 192 photos) four times: view sets from anywhere or inside windows, of
random frames or of frames in a row. Writes the scores of every chunk, a line for each adapter, and prints the mean
changes against the frozen model (docs/sequences.md). One thread; an adapter takes about a minute.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

from freegeo.adaptation import recipe as recipes
from freegeo.adaptation.adapt import adapt
from freegeo.adaptation.samples import SceneImages
from freegeo.adaptation.views import chunk_windows
from freegeo.data.procedural import get_domain, photograph_room
from freegeo.metrics.scene import evaluate
from freegeo.models.catalog import load_model
from freegeo.models.precision import Compute
from freegeo.pipeline import predict

FRAMES, CHUNK, OVERLAP, SEED = 64, 16, 8, 43
CHUNKS = [list(range(start, start + CHUNK)) for start in range(0, FRAMES - OVERLAP, CHUNK - OVERLAP)]
METRICS = ("auc15", "auc30", "abs_rel", "f1_rel5")
ARMS = [(kind, windows) for kind in ("random", "row") for windows in (False, True)]


def record(file: Path, domain: str, room: int) -> None:
    """Adapt to one walk in all ways, and add the scores of its chunks to the file."""
    scene = photograph_room(next(iter(get_domain(domain).seeds(1, start=room))), domain, frames=FRAMES)
    model = load_model("freegeo-tiny")
    batch = model.preprocess(scene.photos)
    images = SceneImages.from_batch("walk", batch)

    def score(arm: str) -> None:
        rows = [evaluate(predict(model, batch.select(frames)), scene.select(frames)) for frames in CHUNKS]
        line = {"domain": domain, "room": room, "arm": arm, **{m: [row[m] for row in rows] for m in METRICS}}
        with file.open("a") as out:
            out.write(json.dumps(line) + "\n")

    score("frozen")
    for kind, inside in ARMS:
        plan = replace(recipes.scene(model.spec), neighbours=kind == "row")
        seen = replace(images, windows=chunk_windows(CHUNKS) if inside else None)
        made = adapt(model, [seen], plan, seed=SEED, compute=Compute())
        score(f"{kind}, {'windows' if inside else 'anywhere'}")
        made.adapter.detach()


def report(file: Path) -> None:
    """Print the mean change of each arm over the walks that have it, and that of the worst chunk."""
    walks: dict[tuple[str, int], dict[str, dict]] = defaultdict(dict)
    for line in map(json.loads, file.read_text().splitlines()):
        walks[line["domain"], line["room"]][line["arm"]] = line
    for arm in ["frozen", *(f"{kind}, {'windows' if inside else 'anywhere'}" for kind, inside in ARMS)]:
        told, done = [], [walk for walk in walks.values() if arm in walk]
        for metric in METRICS:
            change = [np.subtract(walk[arm][metric], walk["frozen"][metric]) for walk in done]
            value = np.mean([walk["frozen"][metric] for walk in done] if arm == "frozen" else change)
            worst = np.max(change) if metric == "abs_rel" else np.min(change)
            told.append(f"{metric} {value:+.4f} ({worst:+.3f})")
        print(f"{arm:20} {len(done)} walks:", ", ".join(told))


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--domains", nargs="+", default=["big", "test-id"])
    parser.add_argument("--rooms", type=int, default=3)
    parser.add_argument("--start", type=int, default=0)
    options = parser.parse_args()
    options.output.parent.mkdir(parents=True, exist_ok=True)
    for domain in options.domains:
        for room in range(options.start, options.start + options.rooms):
            record(options.output, domain, room)
    report(options.output)


if __name__ == "__main__":
    main()
