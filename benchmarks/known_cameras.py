"""What known cameras are worth to the embedded model: generated rooms, with and without them, frozen and adapted.

Run: python benchmarks/known_cameras.py [--domains test-id,big,...] [--rooms 25] [--views 4,8] [--steps 100]
         [--checkpoint FILE] [--out FILE]
     python benchmarks/known_cameras.py --report FOLDER

For each room, the first photos of the path. `told`: the model is told the true cameras and predicts its own; `posed`:
the same with the known cameras in place of these, and the scale that their distances give; `measured`: with depth
brought to the points that matches measure, as `freegeo run --cameras` writes it. `after` and `after, measured`: the
model sees the photos alone, and the known cameras are used after prediction. `--steps 0` leaves adaptation out.
Printed: means of the frozen model, and changes against it with their intervals, paired over rooms; with --report, from
all files of a folder.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import logging
from pathlib import Path

import numpy as np
import torch
from record import write_result
from text_tables import in_order, interval, plain
from text_tables import table as text_table

import freegeo
from freegeo.cameras.known import KnownCamera, KnownCameras
from freegeo.data.procedural import get_domain, photograph_room
from freegeo.data.scene import Scene
from freegeo.evidence.matches import Matches, find_matches
from freegeo.metrics.scene import evaluate
from freegeo.models.api import ReconstructionModel
from freegeo.models.images import read_photos
from freegeo.pipeline import predict
from freegeo.posed import priors_of, with_known_cameras, with_measured_depth

DOMAINS = "test-id,big,tex,sparse"
SCORES = ("auc05", "auc15", "auc30", "f1_rel5", "abs_rel")


def cameras_of(scene: Scene) -> KnownCameras:
    """Return the true cameras of a room, rotations exact to double precision."""
    assert scene.T_cam_world is not None and scene.K is not None
    cameras = []
    for T, K in zip(scene.T_cam_world.double().numpy(), scene.K.double().numpy(), strict=True):
        u, _, vh = np.linalg.svd(T[:3, :3])
        pose, corner = T.copy(), K.copy()
        pose[:3, :3] = u @ vh
        corner[:2, 2] += 0.5
        cameras.append(KnownCamera(T_cam_world=pose, K=corner))
    names = tuple(photo.name for photo in scene.photos)
    return KnownCameras(names=names, cameras=tuple(cameras), source=scene.name, metric=True)


def scores_of(
    model: ReconstructionModel, scene: Scene, known: KnownCameras, matches: Matches, way: str
) -> dict[str, dict[str, float]]:
    """Score the model as it is, alone and with the cameras."""
    batch = read_photos(model, scene.photos)
    alone = predict(model, batch)
    told = predict(model, batch, priors=priors_of(known, batch))
    after, posed = with_known_cameras(alone, known), with_known_cameras(told, known)
    found = {
        way: alone,
        f"{way}, after": after.result,
        f"{way}, after, measured": with_measured_depth(after, known, matches).result,
        f"{way}, told": told,
        f"{way}, posed": posed.result,
        f"{way}, measured": with_measured_depth(posed, known, matches).result,
    }
    return {name: {metric: float(evaluate(one, scene)[metric]) for metric in SCORES} for name, one in found.items()}


def room(model: ReconstructionModel, seed: int, domain: str, views: int, steps: int) -> dict:
    """Measure one room."""
    whole = photograph_room(seed, domain, frames=max(16, views))
    scene = whole.select(range(views))
    known = cameras_of(scene)
    matches = find_matches(scene.photos)
    scores = scores_of(model, scene, known, matches, "frozen")
    for way, cameras in (("adapted", None), ("adapted with cameras", known)) if steps else ():
        result = freegeo.adapt(model, scene.photos, steps=steps, guard="off", cameras=cameras, trust_cameras=True)
        scores |= scores_of(model, scene, known, matches, way)
        result.adapter.detach()
    return {"domain": domain, "seed": seed, "views": views, "scores": scores}


WAYS = {
    "after": "cameras returned, scale by their distances",
    "after, measured": "the same, depth by measured points",
    "told": "cameras told",
    "measured": "cameras told and returned, depth by measured points",
}


def report(rows: list[dict]) -> None:
    """Print the tables of docs/scale.md."""
    adapted = [row for row in rows if "adapted" in row["scores"]]
    frozen = [row for row in rows if "adapted" not in row["scores"]]
    if frozen:
        print(f"frozen\n\n{table(frozen, 'frozen')}")
    for kind in ("frozen", "adapted", "adapted with cameras") if adapted else ():
        print(f"\n{kind}, in the rooms that were adapted to\n\n{table(adapted, kind)}")


def table(rows: list[dict], kind: str) -> str:
    """Means of the frozen model alone, and changes against them, for all rooms and for each domain."""
    domains = in_order(row["domain"] for row in rows)
    groups = {"all": rows} | {domain: [row for row in rows if row["domain"] == domain] for domain in domains}
    lines = []
    for views in sorted({row["views"] for row in rows}):
        for name, members in groups.items():
            own = [row["scores"] for row in members if row["views"] == views]
            for metric, score in (("f1_rel5", "F1 (5 %)"), ("abs_rel", "abs-rel"), ("auc30", "AUC@30")):
                base = np.array([found["frozen"][metric] for found in own])
                changes = ([found[f"{kind}, {way}"][metric] for found in own] - base for way in WAYS)
                cells = [plain(base.mean()), *map(interval, changes)]
                lines.append([views, f"{name} ({len(own)})", score, *cells])
    return text_table(("photos", "rooms", "", "alone", *WAYS.values()), lines)


def main() -> None:
    """Measure, or print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--domains", default=DOMAINS)
    parser.add_argument("--rooms", type=int, default=25)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--views", default="4,8")
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--report", type=Path, metavar="FOLDER", help="measure nothing, print what is there")
    arguments = parser.parse_args()
    if arguments.report:
        records = (json.loads(file.read_text(encoding="utf-8")) for file in sorted(arguments.report.rglob("*.json")))
        report([row for record in records for row in record["results"]["rows"]])
        return
    logging.disable(logging.WARNING)
    torch.set_num_threads(1)
    model = freegeo.load_model("freegeo-tiny", checkpoint=arguments.checkpoint)
    rows = []
    for domain in arguments.domains.split(","):
        for seed in get_domain(domain).seeds(arguments.rooms, start=arguments.first):
            for views in map(int, arguments.views.split(",")):
                rows.append(room(model, seed, domain, views, arguments.steps))
            print(domain, seed, flush=True)
    report(rows)
    if arguments.out:
        settings = {name: str(value) for name, value in vars(arguments).items()}
        write_result(arguments.out, settings=settings, results={"rows": rows}, show=False)


if __name__ == "__main__":
    main()
