"""CPU seconds of matching photos of 12 megapixels, and of scoring one candidate against the matches.

The photos are views of a textured plane with 2000 keypoints each, as JPEG files of 4000 x 3000 pixels; decoding and
shrinking count. With --photos, those of a folder are enlarged to that size instead.

Run: python benchmarks/evidence.py [--views 32] [--photos FOLDER] [--device cpu] [--threads 1]
Budget: 40 CPU seconds for matching 32 photos, 1 second for the scores of one candidate.
"""

import argparse
import io
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image
from record import write_result

from freegeo.data.photos import load_photos
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.dense import co_visible, depth_agreement
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
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "evidence.json")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    cv2.setNumThreads(options.threads)

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
    write_result(
        options.out,
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
            "all scores": {key: round(sum(cost[key] for cost in costs.values()), 3) for key in ("wall_s", "cpu_s")},
        },
        packages=("torch", "numpy", "opencv-python-headless"),
    )


if __name__ == "__main__":
    main()
