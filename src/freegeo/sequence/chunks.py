"""Which frames of a sequence are predicted together (docs/sequences.md, "Chunks")."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from freegeo.errors import UserError

OrderRule = Literal["auto", "given", "similar"]
"""Order of photos that are predicted in chunks: as they are given, by what they show, or by what they show unless
neighbours look alike (docs/sequences.md, "Order")."""
OVERLAP = 0.5
"""Share of a chunk that is in the next one too, unless it is given."""


@dataclass(frozen=True, kw_only=True)
class Chunk:
    """Frames that a model sees together."""

    frames: tuple[int, ...]
    """Ascending."""
    tie: Literal["loop", "bridge"] | None = None
    """What it ties together, where it gives no frames to the result: two places that look alike, or the frames around
    a seam that does not hold."""

    def __str__(self) -> str:
        """Return its frames, such as "12-35", or "12-19 and 280-287"."""
        return " and ".join(f"{run[0]}-{run[-1]}" for run in runs(self.frames))


def plan_chunks(count: int, size: int, overlap: int) -> list[Chunk]:
    """Cut `count` frames into chunks of `size`, each of which shares `overlap` frames with the one before it.

    Every chunk but the last is full, and the last one has more than `overlap` frames.

    Raises:
        UserError: a size below 2, or an overlap that is not from 1 to size - 1.
    """
    if size < 2:
        raise UserError(f"a chunk has at least 2 photos (--chunk), got {size}.")
    if not 1 <= overlap < size:
        raise UserError(
            f"neighbouring chunks of {size} photos share from 1 to {size - 1} of them (--overlap), got {overlap}."
        )
    step = size - overlap
    chunks = max(1, -(-(count - overlap) // step))
    return [Chunk(frames=tuple(range(k * step, min(k * step + size, count)))) for k in range(chunks)]


def bridge(first: Chunk, second: Chunk, size: int) -> Chunk:
    """Return the frames around the middle of what two neighbouring chunks share, at most `size`."""
    middle = (second.frames[0] + first.frames[-1] + 1) // 2
    start, end = max(first.frames[0], middle - size // 2), min(second.frames[-1] + 1, middle + size - size // 2)
    return Chunk(frames=tuple(range(start, end)), tie="bridge")


def common_rows(first: Chunk, second: Chunk) -> list[tuple[int, int]]:
    """Return the places of the frames that two chunks share: (row in first, row in second)."""
    place = {frame: row for row, frame in enumerate(second.frames)}
    return [(row, place[frame]) for row, frame in enumerate(first.frames) if frame in place]


def runs(numbers: Sequence[int]) -> Iterator[list[int]]:
    """Split ascending numbers into runs without gaps."""
    run: list[int] = []
    for number in numbers:
        if run and number != run[-1] + 1:
            yield run
            run = []
        run.append(number)
    if run:
        yield run
