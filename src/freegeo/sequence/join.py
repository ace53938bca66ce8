"""Chunks of one piece, placed in one frame, become one prediction: every frame once (docs/sequences.md, "Joining")."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
import torch

from freegeo.geometry.rotation import mean_rotation
from freegeo.geometry.se3 import camera_centres, from_Rt
from freegeo.geometry.sim3 import Sim3
from freegeo.sequence.alignment import Depths
from freegeo.sequence.chunks import Chunk

SAME_SURFACE = 0.1
"""Relative difference of two chunks' depth up to which they are averaged; of more, one of them is wrong there."""
_LEAST_WEIGHT = 1e-6
_OPEN = 3
"""Chunks that are held in memory: a frame is in two of them, or three where they overlap by more than half."""


class ChunkResult(Depths, Protocol):
    """What is joined of a chunk; `freegeo.export.reconstruction.Reconstruction` has it."""

    @property
    def scale(self) -> Any:
        """What lengths being metres rests on, or None."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class Member:
    """A chunk of a piece."""

    chunk: Chunk
    sim3: Sim3
    """From the frame of the chunk to that of the piece."""
    load: Callable[[], ChunkResult]
    """Reads its prediction."""


class Joined:
    """The frames of a piece; arrays come in blocks, so that memory does not grow with their number.

    Where chunks overlap, depth and cameras pass from one chunk to the next: a chunk's weight falls towards its ends.
    """

    def __init__(self, members: Sequence[Member], frames: Sequence[int]):
        """Take the chunks of one piece, in their order, and the frames to return, all of which they have."""
        self.members, self.frames = members, frames
        self._of: dict[int, list[tuple[int, int, float]]] = {frame: [] for frame in frames}
        ends = min(m.chunk.frames[0] for m in members), max(m.chunk.frames[-1] for m in members)
        for number, member in enumerate(members):
            for row, weight in enumerate(weights(member.chunk, *ends)):
                self._of.get(member.chunk.frames[row], []).append((number, row, weight))
        self._open = lru_cache(maxsize=_OPEN)(lambda number: self.members[number].load())
        self._usable = lru_cache(maxsize=_OPEN)(lambda number: self._open(number).valid_pixels())
        self.T_cam_world, self.K = self._cameras()

    def blocks(self, name: str, factors: np.ndarray | None = None) -> Iterator[np.ndarray] | None:
        """Yield `depth_z`, `conf`, `images` or `sky` frame by frame, each (1, ...); None: no sky.

        Depth is multiplied by the factor of its frame, of `factors` (n,).
        """
        if name == "sky" and self._open(0).sky is None:
            return None
        factor_of = {} if factors is None else dict(zip(self.frames, factors, strict=True))
        joins = {
            "depth_z": lambda frame: self._depth(frame) * np.float32(factor_of.get(frame, 1.0)), "conf": self._conf,
        }  # fmt: skip
        join = joins.get(name, lambda frame: self._best(name, frame))
        return (join(frame)[None] for frame in self.frames)

    def _cameras(self) -> tuple[np.ndarray, np.ndarray]:
        """Cameras (n, 4, 4) and (n, 3, 3) float64 in the frame of the piece: means of the chunks' ones."""
        found = []
        for member in self.members:
            T, K = (torch.from_numpy(np.asarray(values, np.float64)) for values in member.load().cameras())
            found.append((member.sim3.to(torch.float64).apply_to_cameras(T), K))
        T_all, K_all = [], []
        for frame in self.frames:
            parts = self._of[frame]
            T = torch.stack([found[number][0][row] for number, row, _ in parts])
            share = torch.tensor([weight for _, _, weight in parts], dtype=torch.float64)
            share = share / share.sum()
            if len(parts) == 1:
                T_all.append(T[0])
            else:
                R = mean_rotation(T[:, :3, :3], share)
                T_all.append(from_Rt(R, -R @ (share[:, None] * camera_centres(T)).sum(0)))
            K_all.append(
                (share[:, None, None] * torch.stack([found[number][1][row] for number, row, _ in parts])).sum(0)
            )
        K = torch.stack(K_all)
        K[:, 2] = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)  # Shares may sum to 1 but for rounding.
        return torch.stack(T_all).numpy(), K.numpy()

    def _depth(self, frame: int) -> np.ndarray:
        """Depth (H, W): the mean of what chunks say where they agree, else that of the chunk with more weight."""
        parts = self._of[frame]
        scales = [np.float32(float(self.members[number].sim3.s)) for number, _, _ in parts]
        depth = np.stack([self._open(n).depth_z[row] * s for (n, row, _), s in zip(parts, scales, strict=True)])
        if len(parts) == 1:
            return depth[0]
        usable = np.stack([self._usable(number)[row] for number, row, _ in parts])
        weight = np.stack([share * self._open(number).conf[row] for number, row, share in parts])
        weight = np.where(usable, np.maximum(weight, _LEAST_WEIGHT), 0.0)
        best = np.take_along_axis(depth, weight.argmax(0)[None], 0)[0]
        with np.errstate(invalid="ignore", divide="ignore"):
            agree = usable & (np.abs(depth / best - 1) <= SAME_SURFACE)
        weight = np.where(agree, weight, 0.0)
        total = weight.sum(0)
        mean = np.where(agree, weight * depth, 0.0).sum(0) / np.maximum(total, _LEAST_WEIGHT)
        return np.where(total > 0, mean, best).astype(np.float32)

    def _conf(self, frame: int) -> np.ndarray:
        parts = self._of[frame]
        share = np.array([weight for _, _, weight in parts])
        values = np.stack([self._open(number).conf[row] for number, row, _ in parts])
        return np.tensordot(share / share.sum(), values, 1).astype(np.float32)

    def _best(self, name: str, frame: int) -> np.ndarray:
        """Return what the chunk with the largest weight has of a frame."""
        number, row, _ = max(self._of[frame], key=lambda part: part[2])
        return getattr(self._open(number), name)[row]


def weights(chunk: Chunk, first: int, last: int) -> list[float]:
    """Return the weight of each of a chunk's frames: its distance to the chunk's ends, where those are not the piece's.

    `first` and `last` are the frames at the ends of the piece.
    """
    start, end = chunk.frames[0], chunk.frames[-1]
    found = []
    for frame in chunk.frames:
        before = frame - start + 1 if start > first else len(chunk.frames)
        after = end - frame + 1 if end < last else len(chunk.frames)
        found.append(float(min(before, after)))
    return found
