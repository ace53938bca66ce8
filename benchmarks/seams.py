"""Seams of real predictions: how many are trusted, and how many of those between frames that do not belong together.

The embedded model reconstructs frames 0-9 and 6-15 of generated rooms as two chunks. The seam over their four common
frames is compared with seams that must be named: frames in reversed order, other frames of the room, the next room, and
black frames. `error` is how far a seam moves the second chunk, relative to depth, from where fits of both chunks to the
true surfaces put it; a chunk that is bent has an error even with the best seam.

Run: python benchmarks/seams.py [--rooms 6] [--first 6] [--domains val-id,val-tex,...] [-o FILE.json]
     python benchmarks/seams.py --report FOLDER      (the tables of docs/sequences.md, from all files of a folder)
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from record import write_result
from text_tables import plain, table

import freegeo
from freegeo.data.photos import MemoryPhoto
from freegeo.data.procedural import RenderedViews, get_domain, photograph_room, render, sample_rooms
from freegeo.export.reconstruction import Reconstruction
from freegeo.geometry.depth import depth_to_world
from freegeo.models.api import ReconstructionModel
from freegeo.sequence.alignment import Seam, align
from freegeo.types import PhotoLike

DOMAINS = "val-id,val-light,val-lowtex,val-tex,val-big,val-sparse"
FIRST, SECOND, SHARED = range(10), range(6, 16), [(6 + k, k) for k in range(4)]
TOO_FAR = 0.25
"""Error above which a seam counts as a bad one in the table."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=6, help="of each domain")
    parser.add_argument("--first", type=int, default=6, help="number of the first room; the limits were set on 0 to 5")
    parser.add_argument("--domains", default=DOMAINS)
    parser.add_argument("-o", "--output", type=Path, default=Path("benchmarks/results/seams.json"))
    parser.add_argument("--report", type=Path, metavar="FOLDER", help="measure nothing, print what is there")
    arguments = parser.parse_args()
    if arguments.report:
        report(arguments.report)
        return
    torch.set_num_threads(1)
    model = freegeo.load_model("freegeo-tiny")
    rows: dict[str, list[Seam]] = {name: [] for name in ("true", "reversed", "other frames", "other room", "black")}
    errors = []
    for domain in arguments.domains.split(","):
        previous = None
        for seed in get_domain(domain).seeds(arguments.rooms, start=arguments.first):
            scene = photograph_room(seed, domain)
            first, second = chunks(model, scene.photos)
            seam = align(first, second, SHARED)
            rows["true"].append(seam)
            room = sample_rooms([seed], domain=get_domain(domain), frames=len(scene.photos))
            errors.append(error(render(room, *first.image_hw), first, second, seam))
            rows["reversed"].append(align(first, second, [(6 + k, 3 - k) for k in range(4)]))
            rows["other frames"].append(align(first, second, [(6 + k, 6 + k) for k in range(4)]))
            if previous is not None:
                rows["other room"].append(align(previous, second, SHARED))
            previous = first
            rows["black"].append(align(*chunks(model, darkened(scene.photos)), SHARED))
    results = {name: summary(seams) for name, seams in rows.items()}
    trusted = np.array([seam.reason is None and seam.doubt is None for seam in rows["true"]])
    results["errors of trusted seams"] = error_summary(np.array(errors)[trusted])
    results["errors of named seams"] = error_summary(np.array(errors)[~trusted])
    settings = {"rooms": arguments.rooms, "first": arguments.first, "domains": arguments.domains}
    write_result(arguments.output, settings=settings, results=results)


LABELS = {
    "true": "the true ones",
    "reversed": "frames in reversed order",
    "other frames": "other frames of the room (six later)",
    "other room": "another room",
    "black": "black frames",
}


def report(folder: Path) -> None:
    """Print the tables of docs/sequences.md, "Seams"."""
    for file in sorted(folder.glob("*.json")):
        record = json.loads(file.read_text(encoding="utf-8"))
        results = record["results"]
        rows = []
        for name, label in LABELS.items():
            found = results[name]
            rows.append([label, found["seams"], found["trusted"], " / ".join(map(plain, found["inliers"].values()))])
        print(f"{record['settings']}\n")
        header = ("seams over four frames", "seams", "trusted", "share of inliers: least / 10 % / median / 90 % / most")
        print(table(header, rows))
        for name in ("errors of trusted seams", "errors of named seams"):
            print(f"\n{name}: {results[name]}")
        print()


def chunks(model: ReconstructionModel, photos: tuple[PhotoLike, ...]) -> list[Reconstruction]:
    return [freegeo.reconstruct(model, [photos[i] for i in frames]) for frames in (FIRST, SECOND)]


def darkened(photos: tuple[PhotoLike, ...]) -> tuple[PhotoLike, ...]:
    black = np.zeros((*photos[0].read().shape[:2], 3), np.uint8)
    return tuple(MemoryPhoto(p.name, black) if 6 <= i < 10 else p for i, p in enumerate(photos))


def error(truth: RenderedViews, first: Reconstruction, second: Reconstruction, seam: Seam) -> float:
    """Median distance between the second chunk's points by the seam and by the truth, relative to depth."""
    to_world = [
        align(true_chunk(truth, chunk, frames), chunk, [(k, k) for k in range(len(frames))]).sim3
        for chunk, frames in ((first, FIRST), (second, SECOND))
    ]
    T, K = second.cameras()
    depth = torch.from_numpy(second.depth_z).double()
    points = depth_to_world(depth, torch.from_numpy(K).double(), torch.from_numpy(T).double()).reshape(-1, 3)
    distance = torch.linalg.vector_norm((to_world[0] @ seam.sim3).apply(points) - to_world[1].apply(points), dim=-1)
    return float((distance / (to_world[1].s * depth.flatten())).median())


def true_chunk(truth: RenderedViews, chunk: Reconstruction, frames: range) -> Reconstruction:
    """Put the true depth and cameras of some frames, rendered at the model's size, in place of a prediction."""
    depth, T, K = (values[0, list(frames)].numpy() for values in (truth.depth_z, truth.T_cam_world, truth.K))
    return replace(chunk, depth_z=depth, conf=np.ones_like(depth), T_cam_world=T, K=K)


def summary(seams: list[Seam]) -> dict[str, object]:
    shares = [seam.inliers for seam in seams]
    low, lower, median, upper, high = np.percentile(shares, [0, 10, 50, 90, 100]).round(3).tolist()
    return {
        "seams": len(seams), "trusted": sum(seam.reason is None and seam.doubt is None for seam in seams),
        "used": sum(seam.reason is None for seam in seams),
        "inliers": {"least": low, "10 %": lower, "median": median, "90 %": upper, "most": high},
    }  # fmt: skip


def error_summary(errors: np.ndarray) -> dict[str, object]:
    if len(errors) == 0:
        return {"seams": 0}
    return {
        "seams": len(errors), "median": round(float(np.median(errors)), 3), "most": round(float(errors.max()), 3),
        f"above {TOO_FAR}": int((errors > TOO_FAR).sum()),
    }  # fmt: skip


if __name__ == "__main__":
    main()
