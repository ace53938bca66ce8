"""Output folders of a sequence: a walk along a ring-shaped corridor, in chunks, with seams, loops and pieces."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from freegeo import files
from freegeo.export.kept import save_kept
from freegeo.export.reconstruction import Reconstruction
from freegeo.fusion.filtering import FilterReport
from freegeo.sequence.chunks import runs

RADIUS, HALF_WIDTH, HALF_HEIGHT = 10.0, 1.5, 1.2
CHUNK, OVERLAP = 24, 8


@dataclass(frozen=True)
class Ring:
    """Exact depth and cameras of frames spread over one turn; y points down, the camera looks ahead."""

    frames: int
    hw: tuple[int, int]

    def camera(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        angle = 2 * np.pi * frame / self.frames
        place = RADIUS * np.array([np.sin(angle), 0, -np.cos(angle)])
        forward, down = np.array([np.cos(angle), 0, np.sin(angle)]), np.array([0.0, 1, 0])
        R = np.stack((np.cross(down, forward), down, forward))
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, -R @ place
        height, width = self.hw
        focal = 0.8 * width
        return T, np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])

    def view(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Depth (H, W) float32 and colours (H, W, 3) uint8: walls, floor and ceiling with a pattern of tiles."""
        T, K = self.camera(frame)
        v, u = np.mgrid[: self.hw[0], : self.hw[1]]
        rays = np.stack(((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(self.hw)), -1) @ T[:3, :3]
        place = -T[:3, :3].T @ T[:3, 3]
        flat = HALF_HEIGHT / np.maximum(np.abs(rays[..., 1]), 1e-9)
        a, b = (rays[..., ::2] ** 2).sum(-1), rays[..., ::2] @ place[::2]
        inner, outer = (
            b**2 - a * (RADIUS**2 - (RADIUS - HALF_WIDTH) ** 2),
            b**2 - a * (RADIUS**2 - (RADIUS + HALF_WIDTH) ** 2),
        )
        near = np.where((inner > 0) & (b < 0), (-b - np.sqrt(np.maximum(inner, 0))) / a, np.inf)
        depth = np.minimum(np.minimum(flat, np.where(near > 0, near, np.inf)), (-b + np.sqrt(outer)) / a)
        x, y, z = np.moveaxis(place + depth[..., None] * rays, -1, 0)
        turn = np.arctan2(x, -z)
        tiles = (np.floor(turn * 24 / np.pi) + np.floor(y * 2) + np.floor(np.hypot(x, z))).astype(int) % 2
        hue = np.stack((1 + np.cos(turn), 1 + np.sin(turn), 1 + np.cos(3 * turn)), -1) / 2
        return depth.astype(np.float32), (255 * (0.25 + 0.45 * hue + 0.3 * tiles[..., None])).clip(0, 255).astype(
            np.uint8
        )


def ring(frames: int, hw: tuple[int, int], chosen: range | None = None, folder: Path | None = None) -> Reconstruction:
    """Some frames of the walk; with a folder, the maps lie in files there instead of memory."""
    scene, chosen = Ring(frames, hw), range(frames) if chosen is None else chosen
    shapes = {"depth_z": np.float32, "conf": np.float32, "images": np.uint8}
    maps = {}
    for name, kind in shapes.items():
        shape = (len(chosen), *hw, 3) if name == "images" else (len(chosen), *hw)
        maps[name] = np.empty(shape, kind) if folder is None else np.memmap(folder / name, kind, "w+", shape=shape)
    for row, frame in enumerate(chosen):
        maps["depth_z"][row], maps["images"][row] = scene.view(frame)
        maps["conf"][row] = 1 / maps["depth_z"][row] + np.linspace(0, 0.1, hw[1])
    cameras = [scene.camera(frame) for frame in chosen]
    return Reconstruction(
        **maps,
        T_cam_world=np.stack([T for T, _ in cameras]),
        K=np.stack([K for _, K in cameras]),
        names=tuple(f"frame_{frame:05d}.jpg" for frame in chosen),
        photo_hw=np.tile([2 * hw[0], 2 * hw[1]], (len(chosen), 1)),
        scale_xy=np.full((len(chosen), 2), 0.5),
        offset_xy=np.zeros((len(chosen), 2)),
    )


def sequence_of(frames: int, *, cut: int | None = None, missing: int | None = None, unused: int | None = None) -> dict:
    """The key `sequence` of reconstruction.json.

    Args:
        frames: of the whole walk.
        cut: the seam before this chunk failed, and a second piece begins there.
        missing: this chunk has no result, and a piece ends before it.
        unused: the seam before this chunk failed, and a bridge is used instead.
    """
    step, count = CHUNK - OVERLAP, 1 + max(0, -(-(frames - CHUNK) // (CHUNK - OVERLAP)))
    chunks, seams, piece = [], [], 0
    for number in range(count):
        first, last = number * step, min(number * step + CHUNK, frames) - 1
        gone, apart = number == missing, number in (cut, None if missing is None else missing + 1)
        piece += apart
        reason = "its frames are black." if gone else None
        chunks.append({
            "number": number, "first": first, "last": last, "frames": last - first + 1,
            "piece": None if gone else piece, "reason": reason, "refined": None if gone else number % 3 > 0,
        })  # fmt: skip
        if number == 0 or gone or number - 1 == missing:
            continue
        used = not apart and number != unused
        seams.append({
            "first": number - 1, "second": number, "frames": OVERLAP, "kind": "neighbours",
            "inliers": 0.9 - 0.01 * (number % 7) if used else 0.12, "rms": 0.01 + 0.002 * (number % 5),
            "scale": 1 + 0.01 * (number % 4), "gap": 0.008 if used else None, "used": used,
            "reason": None if used else "only 12 % of the pixels that both chunks see agree.",
        })  # fmt: skip
    if unused is not None:
        seams.append(
            {**seams[0], "first": unused - 2, "second": unused + 1, "frames": 2, "kind": "bridge", "used": True}
        )
    loops = [{"first": 2, "second": frames - 3, "similarity": 0.981, "matches": 212, "used": True, "reason": None}]
    loops.append({
        "first": frames // 8, "second": frames // 2, "similarity": 0.962, "matches": 9, "used": False,
        "reason": "Only 9 of 431 matches agree with one motion of the camera.",
    })  # fmt: skip
    pieces, taken = [], set()
    for number in range(piece + 1):
        own = [c for c in chunks if c["piece"] == number]
        span = sorted({frame for c in own for frame in range(c["first"], c["last"] + 1)} - taken)
        taken.update(span)
        folder = f"pieces/{number + 1}" if number else "."
        ranges = [[run[0], run[-1]] for run in runs(span)]
        pieces.append({"folder": folder, "first": span[0], "last": span[-1], "frames": len(span), "ranges": ranges})
    return {
        "frames": frames, "order": "given", "chunk": CHUNK, "overlap": OVERLAP, "chunks": chunks, "seams": seams,
        "loops": loops, "pieces": pieces,
    }  # fmt: skip


def write_sequence(folder: Path, frames: int = 60, hw: tuple[int, int] = (24, 32), **faults: int) -> list[Path]:
    """Write the folder of the first piece and those of the others; faults as `sequence_of`."""
    sequence = sequence_of(frames, **faults)
    folders = []
    for piece in reversed(sequence["pieces"]):
        place = folder / piece["folder"]
        place.mkdir(parents=True, exist_ok=True)
        found = ring(frames, hw, range(piece["first"], piece["last"] + 1))
        found.save(place)
        keep = found.conf > np.quantile(found.conf, 0.2)
        removed = {"confidence": int((~keep).sum())}
        save_kept(place, (keep, FilterReport(pixels=keep.size, removed=removed, tolerance=None)))
        files.write_json(
            place / "reconstruction.json",
            {
                "format": 1, "model": "example", "images": list(found.names), "sequence": sequence,
                "seconds": {"prediction": 60.0}, "warnings": [],
            },
        )  # fmt: skip
        folders.insert(0, place)
    return folders
