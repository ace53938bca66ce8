"""How well descriptors find photos of one place, how well photos are ordered by them, and which loops are verified.

Run: python benchmarks/sequence.py [--rooms 4] [--domains val-id,val-big,...] [--scenes FOLDER...] [--threads 1]
     python benchmarks/sequence.py --report --out FILE      (the tables of docs/sequences.md)

Rooms are walks of 36 photos of 192 x 144 pixels. Two photos belong together when each sees 30 % of the other's surface
(rooms) or when the pair has verified matches that fit the true cameras (each folder of --scenes holds images/ and
cameras.json, as for benchmarks/evidence.py). Loops are sought in walks, and in sequences of two clips: 16 photos of a
room, then 16 of another one or of a room with the same walls, textures and light with other things in it.
"""

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from record import write_result
from scipy.stats import spearmanr
from text_tables import plain, table

from evidence import scene_views
from freegeo.data.photos import MemoryPhoto
from freegeo.data.procedural import RoomBatch, get_domain, render, sample_rooms
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.dense import co_visible
from freegeo.evidence.matches import find_matches
from freegeo.evidence.scores import epipolar
from freegeo.models.catalog import load_model
from freegeo.models.images import read_photos
from freegeo.models.precision import Compute
from freegeo.sequence.loops import loop_candidates, verified
from freegeo.sequence.order import descriptors, similarity_order
from freegeo.training.pool import image_size

FRAMES, CLIP, PHOTO_HW, APART = 36, 16, (144, 192), 12
TOGETHER, APART_SHARE, WRONG_PX = 0.3, 0.1, 2.0

Truth = np.ndarray
"""(S, S) how much two photos have in common: share of surface, or number of matches."""


def pooled(tokens: torch.Tensor, centred: bool) -> np.ndarray:
    """Plain mean of the patch tokens (S, P, C), also less the mean over the sequence."""
    unit = torch.nn.functional.normalize(tokens.mean(1), dim=-1)
    return torch.nn.functional.normalize(unit - unit.mean(0) if centred else unit, dim=-1).numpy()


def ways(model, images: torch.Tensor) -> dict[str, np.ndarray]:
    """Descriptors of images (S, 3, H, W) that are compared."""
    with torch.no_grad():
        parts = [model.embed(part[None], layers=model.spec.loss_layers[-1:]).tokens[0] for part in images.split(8)]
    tokens = torch.cat(parts)
    thumbnail = torch.nn.functional.adaptive_avg_pool2d(images, (4, 4)).flatten(1)
    return {
        "thumbnail of 4 x 4 pixels, centred": pooled(thumbnail[:, None], centred=True),
        "class token, centred": pooled(tokens[:, :1], centred=True),
        "mean of tokens": pooled(tokens[:, 1:], centred=False),
        "mean of tokens, centred": pooled(tokens[:, 1:], centred=True),
        "mean of kernels": descriptors(model, [images], Compute()),
    }


def precision(similarity: np.ndarray, together: np.ndarray) -> float:
    """Average precision of pairs ranked by similarity."""
    right = together[np.argsort(-similarity, kind="stable")]
    return float((np.cumsum(right) / np.arange(1, len(right) + 1))[right].mean()) if right.any() else float("nan")


def judged(found: np.ndarray, truth: Truth, least: float) -> tuple[float, float]:
    i, j = np.triu_indices(len(found), 1)
    similarity = (found @ found.T)[i, j]
    return precision(similarity, truth[i, j] > least), float(spearmanr(similarity, truth[i, j])[0])


def photographed(rooms: RoomBatch, frames: slice) -> tuple[list[MemoryPhoto], Truth]:
    views = render(replace(rooms, T_cam_room=rooms.T_cam_room[:, frames]), *PHOTO_HW)
    pixels = (views.images[0].permute(0, 2, 3, 1) * 255).round().byte().numpy()
    share = co_visible(candidate(views.T_cam_world[0], views.K[0], views.depth_z[0])).share
    return [MemoryPhoto(f"{k}.png", image) for k, image in enumerate(pixels)], np.minimum(share, share.T)


def candidate(T: torch.Tensor, K: torch.Tensor, depth_z: torch.Tensor) -> Candidate:
    ones = torch.ones(len(T), 2, dtype=torch.float64)
    return Candidate(T_cam_world=T.double(), K=K.double(), depth_z=depth_z, scale_xy=ones, offset_xy=0 * ones)


def true_matches(photos, T: torch.Tensor, K: torch.Tensor) -> Truth:
    matches = find_matches(photos)
    error = epipolar(candidate(T, K, torch.ones(len(photos), 1, 1)), matches).values
    counts = np.zeros((len(photos), len(photos)))
    counts[tuple(matches.pairs.T)] = np.where(error < WRONG_PX, matches.counts, 0)
    return counts + counts.T


def with_other_things(rooms: RoomBatch, other: RoomBatch) -> RoomBatch:
    """The same walls, textures, light and cameras; everything else from another room."""
    mixed = {
        name: torch.cat((getattr(rooms, name)[:, :1], getattr(other, name)[:, 1:]), dim=1)
        for name in ("center", "yaw", "size")
    }
    return replace(rooms, **mixed)


def counted(photos: list[MemoryPhoto], model, right: Callable[[int, int], bool | None]) -> Counter:
    """Count candidates and verified loops that are right or wrong; None: the pair does not count."""
    described = descriptors(model, (read_photos(model, [photo]).images for photo in photos), Compute())
    counts: Counter = Counter()
    for loop in verified(loop_candidates(described, apart=APART), photos, described):
        kind = right(loop.first, loop.second)
        if kind is not None:
            counts[f"{'right' if kind else 'wrong'} candidates"] += 1
            counts[f"{'right' if kind else 'wrong'} loops"] += loop.reason is None
    return counts


def ordered(described: np.ndarray, share: Truth) -> tuple[float, float]:
    """Mean share of neighbours, and share of neighbours that see next to nothing of each other."""
    mixed = np.random.default_rng(0).permutation(len(described))
    order = mixed[similarity_order(described[mixed])]
    joints = share[order[:-1], order[1:]]
    return float(joints.mean()), float((joints < APART_SHARE).mean())


def of_rooms(model, domains: list[str], rooms: int) -> dict:
    images, shares, loops, orders, given = [], [], {}, [], []
    for domain in domains:
        for seed in get_domain(domain).seeds(rooms, start=20):
            own, other = (sample_rooms([s], domain=domain, frames=FRAMES) for s in (seed, seed + 7))
            photos, share = photographed(own, slice(None))
            images.append(read_photos(model, photos).images)
            shares.append(share)
            orders.append(ordered(descriptors(model, [images[-1]], Compute()), share))
            given.append(float(np.diag(share, 1).mean()))
            clip = photos[:CLIP]
            across = lambda i, j: False if i < CLIP <= j else None  # noqa: E731
            for label, counts in (
                ("walk", counted(photos, model, lambda i, j, share=share: bool(share[i, j] > APART_SHARE))),
                ("other room", counted(clip + photographed(other, slice(CLIP))[0], model, across)),
                (
                    "same walls, other things",
                    counted(clip + photographed(with_other_things(own, other), slice(1, CLIP + 1))[0], model, across),
                ),
            ):
                loops[label] = loops.get(label, Counter()) + counts
            print(domain, seed, {label: dict(count) for label, count in loops.items()}, flush=True)
    everything = torch.cat(images)
    joint = np.zeros((len(everything), len(everything)))
    for k, share in enumerate(shares):
        joint[k * FRAMES : (k + 1) * FRAMES, k * FRAMES : (k + 1) * FRAMES] = share
    of_all = {way: judged(found, joint, TOGETHER)[0] for way, found in ways(model, everything).items()}
    of_each: dict[str, list] = {way: [] for way in of_all}
    for own, share in zip(images, shares, strict=True):
        for way, found in ways(model, own).items():
            of_each[way].append(judged(found, share, TOGETHER))
    return {
        "average precision, all rooms together": rounded(of_all),
        "average precision, rank correlation in one room": {
            way: np.nanmean(each, axis=0).round(3).tolist() for way, each in of_each.items()
        },
        "order: mean share of neighbours, joints below 10 %": np.mean(orders, axis=0).round(3).tolist(),
        "order: mean share of neighbours of the walk": round(float(np.mean(given)), 3),
        "loops": {label: dict(count) for label, count in loops.items()},
    }


def rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 3) for name, value in values.items()}


def times(model) -> dict[str, float]:
    """CPU seconds for 1000 frames of noise: descriptors, order and candidates."""
    size = image_size(model.spec.default_side, (3, 4), model.spec.patch_size)
    frames = torch.rand(1000, 3, *size, generator=torch.Generator().manual_seed(0))
    spent = {}
    start = time.process_time()
    found = descriptors(model, frames.split(8), Compute())
    spent["descriptors"] = time.process_time() - start
    for name, work in (
        ("order", lambda: similarity_order(found)),
        ("candidates", lambda: loop_candidates(found, apart=24)),
    ):
        start = time.process_time()
        work()
        spent[name] = time.process_time() - start
    return rounded(spent)


def report(record: dict) -> None:
    """Print the tables of docs/sequences.md, "Order" and "Loops"."""
    rooms = record["results"]["rooms"]
    scenes = {
        name: found for name, found in record["results"].items() if name != "rooms" and "mean of kernels" in found
    }
    rows = []
    for way, together in rooms["average precision, all rooms together"].items():
        pairs = [rooms["average precision, rank correlation in one room"][way], *(s[way] for s in scenes.values())]
        rows.append([way, plain(together, 2), *(", ".join(plain(x, 2) for x in pair) for pair in pairs)])
    print(f"{record['settings']}\n")
    print(table(("descriptor", "rooms together", "within a room", *scenes), rows))
    for name in ("order: mean share of neighbours, joints below 10 %", "order: mean share of neighbours of the walk"):
        print(f"\n{name}: {rooms[name]}")
    print(f"\nCPU seconds of 1000 frames: {record['results']['cpu_s of 1000 frames']}\n")
    kinds = ("right candidates", "wrong candidates", "right loops", "wrong loops")
    loops = [[sequence, *(counts.get(kind, 0) for kind in kinds)] for sequence, counts in rooms["loops"].items()]
    print(table(("sequence", *kinds), loops))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=4)
    parser.add_argument("--domains", default="val-id,val-big,val-tex,val-lowtex,val-sparse")
    parser.add_argument("--scenes", type=Path, nargs="*", default=[])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "sequence.json")
    parser.add_argument("--report", action="store_true", help="measure nothing, print the tables of --out")
    options = parser.parse_args()
    if options.report:
        report(json.loads(options.out.read_text(encoding="utf-8")))
        return
    torch.set_num_threads(options.threads)
    cv2.setNumThreads(options.threads)
    model = load_model("freegeo-tiny")
    results: dict = {"cpu_s of 1000 frames": times(model)}
    print(results, flush=True)
    for folder in options.scenes:
        [(photos, T, K)] = scene_views(folder)
        truth = true_matches(photos, T, K)
        found = ways(model, read_photos(model, photos).images)
        results[folder.name] = {way: [round(x, 3) for x in judged(own, truth, 0)] for way, own in found.items()}
    results["rooms"] = of_rooms(model, options.domains.split(","), options.rooms)
    write_result(
        options.out,
        settings={"rooms a domain": options.rooms, "domains": options.domains, "threads": options.threads},
        results=results,
        packages=("torch", "numpy", "scipy", "opencv-python-headless"),
        show=False,
    )


if __name__ == "__main__":
    main()
