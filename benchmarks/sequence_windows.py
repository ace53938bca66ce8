"""What drawing view sets inside chunks is worth: walks of 64 frames through generated rooms, in chunks of 16.

    python benchmarks/sequence_windows.py -o out/windows.jsonl --domains big test-id --rooms 3 [--start 0]

Adapts the embedded model to each walk (256 x 192 photos) four times: view sets from anywhere or inside windows, of
random frames or of frames in a row. Writes the scores of every chunk, a line for each adapter (those that the file has
are not made again), and prints the mean changes against the frozen model (docs/sequences.md). One thread; an adapter
takes a minute or two.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
from text_tables import plain, signed, table

from freegeo.adaptation import recipe as recipes
from freegeo.adaptation.adapt import adapt
from freegeo.adaptation.samples import SceneImages
from freegeo.adaptation.views import chunk_windows
from freegeo.data.procedural import get_domain, photograph_room
from freegeo.files import atomic_path
from freegeo.metrics.scene import evaluate
from freegeo.models.catalog import load_model
from freegeo.models.precision import Compute
from freegeo.pipeline import predict

FRAMES, CHUNK, OVERLAP, SEED = 64, 16, 8, 43
CHUNKS = [list(range(start, start + CHUNK)) for start in range(0, FRAMES - OVERLAP, CHUNK - OVERLAP)]
METRICS = ("auc15", "auc30", "abs_rel", "f1_rel5")
ARMS = [(kind, windows) for kind in ("random", "row") for windows in (False, True)]


def record(file: Path, domain: str, room: int) -> None:
    """Adapt to one walk in all ways, and add the scores of its chunks to the file; those that are there are kept."""
    there = {line["arm"] for line in lines_of(file) if (line["domain"], line["room"]) == (domain, room)}
    if len(there) == len(ARMS) + 1:
        return
    scene = photograph_room(next(iter(get_domain(domain).seeds(1, start=room))), domain, frames=FRAMES)
    model = load_model("freegeo-tiny")
    batch = model.preprocess(scene.photos)
    images = SceneImages.from_batch("walk", batch)

    def score(arm: str) -> None:
        rows = [evaluate(predict(model, batch.select(frames)), scene.select(frames)) for frames in CHUNKS]
        line = {"domain": domain, "room": room, "arm": arm, **{m: [row[m] for row in rows] for m in METRICS}}
        with atomic_path(file) as part:
            part.write_text("".join(json.dumps(one) + "\n" for one in [*lines_of(file), line]))

    if "frozen" not in there:
        score("frozen")
    for kind, inside in ARMS:
        if arm_name(kind, inside) in there:
            continue
        plan = replace(recipes.scene(model.spec), neighbours=kind == "row")
        seen = replace(images, windows=chunk_windows(CHUNKS) if inside else None)
        made = adapt(model, [seen], plan, seed=SEED, compute=Compute())
        score(arm_name(kind, inside))
        made.adapter.detach()


def report(file: Path) -> None:
    """Print the mean change of each arm over the walks that have it, and that of the worst chunk."""
    walks: dict[tuple[str, int], dict[str, dict]] = defaultdict(dict)
    for line in lines_of(file):
        walks[line["domain"], line["room"]][line["arm"]] = line
    rows = []
    for arm in ["frozen", *(arm_name(kind, inside) for kind, inside in ARMS)]:
        done, cells = [walk for walk in walks.values() if arm in walk], []
        for metric in METRICS if done else ():
            digits = 4 if metric == "abs_rel" else 3
            if arm == "frozen":
                cells.append(plain(float(np.mean([walk["frozen"][metric] for walk in done])), digits))
                continue
            change = [np.subtract(walk[arm][metric], walk["frozen"][metric]) for walk in done]
            worst = np.max(change) if metric == "abs_rel" else np.min(change)
            cells.append(f"{signed(float(np.mean(change)), digits)} ({signed(float(worst))})")
        rows += [[arm, len(done), *cells]] if done else []
    print(table(("view sets", "walks", "AUC@15", "AUC@30", "depth error", "F1 (5 %)"), rows))


def lines_of(file: Path) -> list[dict]:
    """What was recorded."""
    return [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []


def arm_name(kind: str, inside: bool) -> str:
    """How the view sets of an adapter were drawn."""
    return f"{kind}, {'windows' if inside else 'anywhere'}"


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
