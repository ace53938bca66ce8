"""Chunks put together: a seam for every two that share frames, a place for each, and the pieces that they form."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import combinations
from typing import Any, Literal

import numpy as np
import torch

from freegeo.geometry.sim3 import Sim3
from freegeo.sequence.alignment import INLIER, Depths, Seam, align, gap
from freegeo.sequence.chunks import Chunk, common_rows
from freegeo.sequence.graph import Edge, Placed, Sight, place, place_in_world

Kind = Literal["neighbours", "bridge", "loop"]
"""What a seam joins: chunks that follow each other, others that share frames, or a loop to the sequence."""
Load = Callable[[int], Depths]
Seams = Mapping[tuple[int, int], Seam]
"""By the numbers of two chunks, the smaller first."""
CONTRADICTED = "in this part of the sequence loops contradict each other or the seams between neighbours: none is used."
_OPEN = 4
"""Chunks that are held in memory."""


@dataclass(frozen=True, kw_only=True)
class Joint:
    """A seam between two chunks of an assembly."""

    first: int
    second: int
    kind: Kind
    seam: Seam
    gap: float | None
    """Median distance between the two surfaces as they are placed, relative to the depth; None: in two pieces."""
    reason: str | None
    """Why it has no part in where the chunks are, in a sentence; None: it has."""

    @property
    def doubt(self) -> str | None:
        """What is doubtful where it is used, in a sentence; known cameras and other seams may leave surfaces apart."""
        if self.seam.doubt is None and self.gap is not None and self.gap > INLIER:
            return f"as they are placed, the two surfaces are {self.gap:.0%} of their depth apart."
        return self.seam.doubt

    def as_dict(self) -> dict[str, Any]:
        """Return what reconstruction.json says of it."""
        seam = self.seam
        rms = None if math.isnan(seam.rms) else seam.rms  # JSON has no NaN.
        return {
            "first": self.first, "second": self.second, "frames": seam.frames, "kind": self.kind,
            "inliers": seam.inliers, "rms": rms, "scale": float(seam.sim3.s), "gap": self.gap,
            "used": self.reason is None, "reason": self.reason or self.doubt,
        }  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Assembly:
    """Where chunks are, and which belong together."""

    joints: list[Joint]
    sim3: list[Sim3]
    """Of each chunk: from its own frame to that of its piece."""
    pieces: list[list[int]]
    """Chunks by their numbers, without those of loops; the piece with most frames first."""
    frames: list[list[int]]
    """Of each piece, ascending. A frame of several pieces belongs to the first of them, and a piece without a frame of
    its own is none."""
    world: int | None = None
    """Number of the piece that is in the world of known cameras."""
    odd: list[int] = field(default_factory=list)
    """Frames whose known poses contradict the others, and have no part in where the chunks are."""


def seams_between(
    chunks: Sequence[Chunk],
    load: Load,
    *,
    fixed_scale: bool = False,
    measured: Mapping[tuple[int, int], Seam] | None = None,
    known: Seams | None = None,
) -> dict[tuple[int, int], Seam]:
    """Align every two chunks that share frames, or that measured points join.

    Args:
        chunks: those of the sequence in its order, and those that tie it together.
        load: reads the prediction of a chunk by its number here.
        fixed_scale: lengths of all chunks have one unit, such as metres: seams turn and move only.
        measured: seams by points that matches measure in two chunks (`align_points`).
        known: seams that were measured before.
    """
    read, found, by_points = lru_cache(maxsize=_OPEN)(load), dict(known or {}), measured or {}
    for pair in combinations(range(len(chunks)), 2):
        rows, own = common_rows(*(chunks[number] for number in pair)), by_points.get(pair)
        if rows and pair not in found:
            found[pair] = align(
                read(pair[0]), read(pair[1]), rows, fixed_scale=fixed_scale, measured=None if own is None else own.sim3
            )
        elif own is not None:
            found.setdefault(pair, own)
    return found


def broken(chunks: Sequence[Chunk], seams: Seams) -> list[tuple[int, int]]:
    """Return the seams between neighbours of the sequence that do not hold."""
    return [(a, b) for (a, b), seam in seams.items() if seam.reason is not None and _kind(chunks, a, b) == "neighbours"]


def assemble(
    chunks: Sequence[Chunk], seams: Seams, load: Load, *, fixed_scale: bool = False, placed: bool = False,
    poses: Mapping[int, np.ndarray] | None = None,
) -> Assembly:  # fmt: skip
    """Place chunks so that they fit at their seams.

    Args:
        chunks: as for `seams_between`.
        seams: its result.
        load: reads the prediction of a chunk by its number here.
        fixed_scale: as for `seams_between`.
        placed: the chunks are in one frame already, as with known cameras: nothing is moved.
        poses: known `T_cam_world` (4, 4) of some frames; a piece that has them in two places or more is in their world.
    """
    read = lru_cache(maxsize=_OPEN)(load)

    def apart(a: int, b: int, sim3: Sequence[Sim3]) -> float | None:
        return gap(read(a), read(b), common_rows(chunks[a], chunks[b]), sim3[a], sim3[b])

    if placed:
        same = [Sim3.identity() for _ in chunks]
        joints = [
            Joint(first=a, second=b, kind=_kind(chunks, a, b), seam=seam, gap=apart(a, b, same), reason=None)
            for (a, b), seam in seams.items()
        ]
        pieces = [[number for number, chunk in enumerate(chunks) if chunk.tie is None]]
        return Assembly(joints=joints, sim3=same, pieces=pieces, frames=_own_frames(chunks, pieces))
    good = [pair for pair, seam in seams.items() if seam.reason is None]
    edges = [Edge.of(a, b, seams[a, b], robust=_kind(chunks, a, b) == "loop") for a, b in good]
    sights = _sights(chunks, read, poses) if poses else []

    def places(edges: Sequence[Edge]) -> Placed:
        found = place(len(chunks), edges, fixed_scale=fixed_scale)
        return place_in_world(found, edges, sights) if sights else found

    found = places(edges)
    loops = {pair for pair in good if _kind(chunks, *pair) == "loop"}
    # Which one is wrong cannot be told: of places that look alike several may agree, against a true loop.
    contradicted = loops & _connected(len(chunks), good, [trust == 0 for trust in found.trust])
    if contradicted:
        edges = [edge for pair, edge in zip(good, edges, strict=True) if pair not in contradicted]
        found = places(edges)
    of = {number: k for k, piece in enumerate(found.pieces) for number in piece}
    joints = []
    for (a, b), seam in seams.items():
        reason = CONTRADICTED if (a, b) in contradicted else seam.reason
        distance = apart(a, b, found.sim3) if of[a] == of[b] else None
        joints.append(
            Joint(first=a, second=b, kind=_kind(chunks, a, b), seam=seam, gap=distance, reason=reason)
        )  # fmt: skip
    pieces = [[number for number in piece if chunks[number].tie is None] for piece in found.pieces]
    pieces.sort(key=lambda piece: (-len({frame for number in piece for frame in chunks[number].frames}), piece))
    frames = _own_frames(chunks, pieces)
    pieces, frames = [piece for piece, own in zip(pieces, frames, strict=True) if own], [own for own in frames if own]
    seen = [(one.frame, far) for one, far in zip(sights, found.doubted, strict=True) if one.chunk in found.world]
    return Assembly(
        joints=joints, sim3=found.sim3, pieces=pieces, frames=frames,
        world=next((k for k, piece in enumerate(pieces) if piece[0] in found.world), None),
        odd=sorted({frame for frame, _ in seen} - {frame for frame, far in seen if not far}),
    )  # fmt: skip


def _sights(chunks: Sequence[Chunk], read: Load, poses: Mapping[int, np.ndarray]) -> list[Sight]:
    """Return where the chunks of the sequence see the photos with known poses."""
    found = []
    for number, chunk in enumerate(chunks):
        own = [(row, frame) for row, frame in enumerate(chunk.frames) if frame in poses]
        if chunk.tie is not None or not own:
            continue
        part = read(number)
        T, usable = part.cameras()[0], part.valid_pixels()
        for row, frame in own:
            if usable[row].any():
                predicted, given = (torch.from_numpy(np.asarray(one, np.float64)) for one in (T[row], poses[frame]))
                depth = float(np.median(part.depth_z[row][usable[row]]))
                found.append(Sight(chunk=number, frame=frame, predicted=predicted, known=given, depth=depth))
    return found


def _connected(count: int, pairs: Sequence[tuple[int, int]], chosen: Sequence[bool]) -> set[tuple[int, int]]:
    """Return the pairs of chunks that other pairs connect with one of the chosen ones, and these."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not any(chosen):
        return set()
    first, second = np.array(pairs).T
    part = connected_components(coo_array((np.ones(len(pairs)), (first, second)), shape=(count, count)), False)[1]
    found = set(part[first[np.array(chosen)]].tolist())
    return {pair for pair in pairs if part[pair[0]] in found}


def _own_frames(chunks: Sequence[Chunk], pieces: Sequence[Sequence[int]]) -> list[list[int]]:
    """Return the frames of each piece that no piece before it has, ascending."""
    taken: set[int] = set()
    found = []
    for piece in pieces:
        own = {frame for number in piece for frame in chunks[number].frames} - taken
        taken |= own
        found.append(sorted(own))
    return found


def _kind(chunks: Sequence[Chunk], a: int, b: int) -> Kind:
    ties = [chunks[number].tie for number in (a, b)]
    if "loop" in ties:
        return "loop"
    return "neighbours" if ties == [None, None] and b == a + 1 else "bridge"
