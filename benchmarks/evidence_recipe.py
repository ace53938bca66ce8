"""What recipe `evidence` is worth beside recipe `scene` and bundle adjustment alone, on generated rooms.

    python benchmarks/evidence_recipe.py record -o out/evidence --domains test-id tex --rooms 6 [--start 0] [--seed 44]
    python benchmarks/evidence_recipe.py report out/evidence

`record` adapts the embedded model to frames 0 to 11 of each room (256 x 192 photos) by both recipes, predicts sets of
frames (some of which adaptation never saw), refines the frozen predictions of the same sets by bundle adjustment, and
writes one file a room; rooms that have a file are skipped. `report` prints the table of docs/guard.md: means over rooms
of the change against the frozen model, with paired 95 % intervals. Where the photos prove no cameras to learn from,
`evidence` is the frozen model, and where bundle adjustment is refused, so is that. One thread.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from guard import ADAPTED_TO, SETS, command_line
from text_tables import change, in_order, plain, signed, table

from freegeo import files
from freegeo.adaptation import recipe as recipes
from freegeo.adaptation.adapt import adapt
from freegeo.adaptation.samples import SceneImages
from freegeo.data.procedural import get_domain, photograph_room
from freegeo.errors import NoEvidenceError
from freegeo.evidence.matches import find_matches
from freegeo.evidence.refinement import bring_depth, refine
from freegeo.metrics.scene import evaluate
from freegeo.models.catalog import load_model
from freegeo.models.precision import Compute
from freegeo.pipeline import predict
from freegeo.taught import lesson

SCORED = {**SETS, "half-8": [list(range(8, 16))]}
METRICS = ("auc15", "auc30", "f1_rel5", "abs_rel")
WAYS = ("scene", "evidence", "bundle")


def record(folder: Path, domain: str, room: int, seed: int) -> None:
    """Adapt to one room in both ways and write its file."""
    file = folder / f"{domain}-{room:03d}-seed{seed}.json"
    if file.is_file():
        return
    started = time.process_time()
    scene = photograph_room(next(iter(get_domain(domain).seeds(1, start=room))), domain, frames=16)
    model = load_model("freegeo-tiny")
    batch = model.preprocess(scene.photos)
    scores, seconds, refused = {"frozen": {}, "bundle": {}}, {}, []
    for name, sets in SCORED.items():
        found = [predict(model, batch.select(frames)) for frames in sets]
        scores["frozen"][name] = scored(found, scene, sets)
        for k, frames in enumerate(sets):
            refinement = refine(found[k], find_matches(scene.select(frames).photos))
            if refinement.accepted:
                found[k] = bring_depth(found[k], refinement)[0]
            else:
                refused.append([name, refinement.reason])
        scores["bundle"][name] = scored(found, scene, sets)
    seconds["frozen and bundle"] = time.process_time() - started
    own = batch.select(ADAPTED_TO)
    images = SceneImages.from_batch("room", own)
    told = None
    for recipe in (recipes.scene(model.spec), recipes.evidence(model.spec)):
        started = time.process_time()
        if recipe.cameras:
            try:
                found = lesson("the room", scene.select(ADAPTED_TO).photos, predict(model, own), seed=seed)
            except NoEvidenceError as error:
                told = str(error)
                scores[recipe.name] = scores["frozen"]
                continue
            images = replace(images, targets=found.targets)
        made = adapt(model, [images], recipe, seed=seed, compute=Compute())
        seconds[recipe.name] = time.process_time() - started
        scores[recipe.name] = {
            name: scored([predict(model, batch.select(frames)) for frames in sets], scene, sets)
            for name, sets in SCORED.items()
        }
        made.adapter.detach()
    content = {"domain": domain, "scores": scores, "refused": told, "bundle_refused": refused, "seconds": seconds}
    files.write_json(file, content)
    print(file.name, {name: round(value) for name, value in seconds.items()}, told or "taught", flush=True)


def scored(found: list, scene, sets: list[list[int]]) -> list[float]:
    """Mean scores over sets of frames."""
    rows = [evaluate(one, scene.select(frames)) for one, frames in zip(found, sets, strict=True)]
    return [float(np.mean([row[metric] for row in rows])) for metric in METRICS]


PHOTOS = {
    "seen-4": "4 of the photos",
    "seen-8": "8 of the photos",
    "seen-12": "all 12",
    "unseen-4": "4 never seen",
    "half-8": "8, of which 4 never seen",
    "all-16": "16, of which 4 never seen",
}
SHOWN = {"auc15": "AUC@15", "auc30": "AUC@30", "f1_rel5": "F1 (5 %)"}
BY_DOMAIN = ("seen-4", "seen-8", "unseen-4", "half-8")


def report(folder: Path) -> None:
    """Print the tables of docs/guard.md, "Learning from the matches"."""
    rooms = [files.read_json(file) for file in sorted(folder.glob("*.json"))]
    taught = [room for room in rooms if room["refused"] is None]
    whole = sum(all(name != "seen-12" for name, _ in room["bundle_refused"]) for room in rooms)
    print(f"{len(rooms)} rooms, {len(taught)} with cameras to learn, bundle adjustment of all 12 accepted in {whole}")
    for ways, group in (("all rooms", rooms), ("rooms with cameras to learn", taught)):
        lines = []
        for name, photos in PHOTOS.items() if group else ():
            for row, (metric, score) in enumerate(SHOWN.items()):
                frozen = plain(float(np.mean([scored_as(room, "frozen", name, metric) for room in group])))
                cells = [change(gains(group, way, name, metric)) for way in WAYS]
                lines.append(["" if row else photos, score, frozen, *cells])
        header = ("photos", "score", "frozen", "`scene`", "`evidence`", "bundle adjustment alone")
        print(f"\n{ways}\n\n{table(header, lines)}")
    lines = []
    for domain in in_order(room["domain"] for room in rooms):
        group = [room for room in rooms if room["domain"] == domain]
        cells = [" / ".join(signed(gains(group, way, name, "auc15").mean()) for name in BY_DOMAIN) for way in WAYS]
        lines.append([domain, len(group), sum(room["refused"] is None for room in group), *cells])
    header = ("rooms", "", "with cameras to learn", "`scene`", "`evidence`", "bundle adjustment alone")
    print(f"\nAUC@15 at {' / '.join(PHOTOS[name] for name in BY_DOMAIN)}\n\n{table(header, lines)}")
    for way in ("frozen and bundle", "scene", "evidence"):
        seconds = [room["seconds"][way] for room in rooms if way in room["seconds"]]
        print(f"CPU seconds, {way}: {np.mean(seconds):.0f}" if seconds else f"{way}: none")


def scored_as(room: dict, way: str, name: str, metric: str) -> float:
    """The recorded score."""
    return room["scores"][way][name][METRICS.index(metric)]


def gains(rooms: list[dict], way: str, name: str, metric: str) -> np.ndarray:
    """Change of a score against the frozen model, for each room."""
    return np.array([scored_as(room, way, name, metric) - scored_as(room, "frozen", name, metric) for room in rooms])


if __name__ == "__main__":
    command_line(__doc__, record, report)
