"""Chunks put together: a seam for every two that share frames, a place for each, and the pieces that they form."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Any, Literal

from freegeo.geometry.sim3 import Sim3
from freegeo.sequence.alignment import Depths, Seam, align, gap
from freegeo.sequence.chunks import Chunk, common_rows
from freegeo.sequence.graph import Edge, place

Kind = Literal["neighbours", "bridge", "loop"]
"""What a seam joins: chunks that follow each other, others that share frames, or a loop to the sequence."""
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

    def as_dict(self) -> dict[str, Any]:
        """Return what reconstruction.json says of it."""
        seam = self.seam
        return {
            "first": self.first, "second": self.second, "frames": seam.frames, "kind": self.kind,
            "inliers": seam.inliers, "rms": seam.rms, "scale": float(seam.sim3.s), "gap": self.gap,
            "used": self.reason is None, "reason": self.reason or seam.doubt,
        }  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Assembly:
    """Where chunks are, and which belong together."""

    joints: list[Joint]
    sim3: list[Sim3]
    """Of each chunk: from its own frame to that of its piece."""
    pieces: list[list[int]]
    """Chunks by their numbers, without those of loops; the piece with most frames first."""


def assemble(
    chunks: Sequence[Chunk], load: Callable[[int], Depths], *, fixed_scale: bool = False, placed: bool = False
) -> Assembly:
    """Align chunks where they share frames, and place them.

    Args:
        chunks: those of the sequence in its order, and those of loops.
        load: reads the prediction of a chunk by its number here.
        fixed_scale: lengths of all chunks have one unit, such as metres: seams turn and move only.
        placed: the chunks are in one frame already, as with known cameras: seams are measured, and nothing is moved.
    """
    read = lru_cache(maxsize=_OPEN)(load)
    pairs = [(a, b) for a, b in combinations(range(len(chunks)), 2) if common_rows(chunks[a], chunks[b])]
    seams = {
        (a, b): align(read(a), read(b), common_rows(chunks[a], chunks[b]), fixed_scale=fixed_scale) for a, b in pairs
    }
    if placed:
        return Assembly(
            joints=[
                Joint(
                    first=a, second=b, kind=_kind(chunks, a, b), seam=seam, reason=None,
                    gap=gap(read(a), read(b), common_rows(chunks[a], chunks[b]), Sim3.identity(), Sim3.identity()),
                )
                for (a, b), seam in seams.items()
            ],
            sim3=[Sim3.identity() for _ in chunks],
            pieces=[[number for number, chunk in enumerate(chunks) if not chunk.loop]],
        )  # fmt: skip
    good = [pair for pair in pairs if seams[pair].reason is None]
    edges = [
        Edge.of(a, b, seams[a, b], robust=seams[a, b].doubt is not None or _kind(chunks, a, b) == "loop")
        for a, b in good
    ]
    found = place(len(chunks), edges, fixed_scale=fixed_scale)
    trust = dict(zip(good, found.trust, strict=True))
    of = {number: k for k, piece in enumerate(found.pieces) for number in piece}
    joints = []
    for a, b in pairs:
        reason = seams[a, b].reason
        if reason is None and trust[a, b] == 0:
            reason = "it contradicts the other seams."
        together = of[a] == of[b]
        apart = None
        if together:
            apart = gap(read(a), read(b), common_rows(chunks[a], chunks[b]), found.sim3[a], found.sim3[b])
        joints.append(
            Joint(
                first=a, second=b, kind=_kind(chunks, a, b), seam=seams[a, b], gap=apart,
                reason=reason,
            )
        )  # fmt: skip
    pieces = [[number for number in piece if not chunks[number].loop] for piece in found.pieces]
    size = {k: len({frame for number in piece for frame in chunks[number].frames}) for k, piece in enumerate(pieces)}
    order = sorted((k for k in size if pieces[k]), key=lambda k: (-size[k], pieces[k]))
    return Assembly(joints=joints, sim3=found.sim3, pieces=[pieces[k] for k in order])


def _kind(chunks: Sequence[Chunk], a: int, b: int) -> Kind:
    if chunks[a].loop or chunks[b].loop:
        return "loop"
    return "neighbours" if b == a + 1 else "bridge"
