"""What the report says of a sequence: its chunks, seams, loops and pieces, by `sequence` of ``reconstruction.json``.

Frames and chunks are counted from 0, as in the log and in the names of files. A result holds the frames of one piece.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from freegeo.report.result import REPORT_NAME, Result

MOST_ROWS = 20
"""Longer tables show so many rows, the worst, and the others behind a click."""
MOST_NAMED = 10
"""Seams and chunks that the banner names; the tables have all."""
MOST_LOOPS_DRAWN = 60
SEAM_HEADER = ("chunks", "shared frames", "inliers, %", "RMS, % of depth", "scale", "gap, % of depth", "used")
LOOP_HEADER = ("frames", "similarity", "matches", "used")


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of a table."""

    cells: tuple[str, ...]
    is_used: bool


@dataclass(frozen=True, kw_only=True)
class Table:
    """Seams or loops; the last column says why one was not used."""

    header: tuple[str, ...]
    rows: list[Row]
    """All in order, or the worst `MOST_ROWS` of more, the worst first."""
    others: list[Row]
    """The rest, in order."""
    worst: str
    """What puts a row that was used before another, as it reads after "those with"."""


@dataclass(frozen=True, kw_only=True)
class Piece:
    """A part of the sequence that was joined."""

    name: str
    """Such as "piece 2, frames 97 to 200"."""
    link: str | None
    """Address of its report, relative to this one; None for the page itself, and where there is none."""
    is_this: bool


@dataclass(frozen=True, kw_only=True)
class Told:
    """What the page says."""

    sentences: list[str]
    problems: list[str]
    """What is missing or apart, for the banner; empty where everything was joined."""
    pieces: list[Piece]
    seams: Table
    loops: Table


@dataclass(frozen=True, kw_only=True)
class Course:
    """What the drawing of the trajectory marks, by rows of the result."""

    parts: list[tuple[int, list[int]]]
    """Chunk, and the rows that it is drawn for; parts meet in a row."""
    seams: list[tuple[int, bool, str]]
    """Row, whether it was used, and the chunks such as "3–4"."""
    loops: list[tuple[int, int, bool]]
    """Two rows, and whether it was used."""


def told(result: Result) -> Told | None:
    """Return what the page says of a sequence; None for an ordinary result."""
    sequence = result.summary.get("sequence")
    if not sequence:
        return None
    seams = [_seam_row(seam) for seam in sequence["seams"]]
    loops = [_loop_row(loop) for loop in sequence["loops"]]
    return Told(
        sentences=list(_sentences(sequence)),
        problems=_problems(sequence),
        pieces=_pieces(result.folder, sequence),
        seams=_table(SEAM_HEADER, seams, "the fewest inliers", [seam.get("inliers") for seam in sequence["seams"]]),
        loops=_table(LOOP_HEADER, loops, "the fewest matches", [loop.get("matches") for loop in sequence["loops"]]),
    )


def title(result: Result) -> str:
    """Return the name of the folder, with the piece where it holds one beside others."""
    folder, sequence = result.folder.resolve(), result.summary.get("sequence")
    piece = _piece_number(folder, sequence) if sequence else 0
    return folder.name if piece == 0 else f"{folder.parent.parent.name}, piece {piece + 1}"


def frames_of(result: Result) -> list[int] | None:
    """Return the frame of the sequence of each view; None where that is not known, as for an ordinary result."""
    sequence = result.summary.get("sequence")
    if not sequence:
        return None
    ranges = sequence["pieces"][_piece_number(result.folder, sequence)].get("ranges", ())
    if sum(last - first + 1 for first, last in ranges) != len(result.names):
        return None
    return [frame for first, last in ranges for frame in range(first, last + 1)]


def view_numbers(result: Result) -> list[str]:
    """Return what each view is called before its name: "1", "2", ..., or "frame 0", ... in a sequence."""
    frames = frames_of(result)
    return [f"frame {n}" for n in frames] if frames is not None else [str(v + 1) for v in range(len(result.names))]


def course(result: Result) -> Course | None:
    """Return what the drawing shows; None for an ordinary result, and where the frames of the views are not known."""
    frames = frames_of(result)
    if frames is None:
        return None
    sequence = result.summary["sequence"]
    row = {frame: number for number, frame in enumerate(frames)}
    own = _chunks(sequence, _piece_number(result.folder, sequence))
    chunk_of = {chunk["number"]: chunk for chunk in sequence["chunks"]}
    seams = []
    for seam in sequence["seams"]:
        pair = [chunk_of[number] for number in (seam["first"], seam["second"]) if number in chunk_of]
        is_shown = seam["kind"] == "neighbours" or not seam["used"]
        if is_shown and len(pair) == 2 and any(chunk in own for chunk in pair):
            place = row[min(frames, key=lambda frame: abs(frame - _middle(*pair)))]
            seams.append((place, bool(seam["used"]), f"{seam['first']}–{seam['second']}"))
    loops = [
        (row[loop["first"]], row[loop["second"]], bool(loop["used"]))
        for loop in sorted(sequence["loops"], key=lambda loop: not loop["used"])
        if loop["first"] in row and loop["second"] in row
    ]
    return Course(parts=_parts(own, frames), seams=seams, loops=loops[:MOST_LOOPS_DRAWN])


def _parts(chunks: Sequence[Mapping[str, Any]], frames: Sequence[int]) -> list[tuple[int, list[int]]]:
    """Cut the rows where the overlaps of successive chunks have their middle."""
    starts = [frames[0], *(_middle(a, b) for a, b in pairwise(chunks)), frames[-1]]
    parts = []
    for chunk, start, end in zip(chunks, starts[:-1], starts[1:], strict=True):
        parts.append((chunk["number"], [row for row, frame in enumerate(frames) if start <= frame <= end]))
    return [(number, rows) for number, rows in parts if rows]


def _middle(first: Mapping[str, Any], second: Mapping[str, Any]) -> int:
    """Return the frame in the middle of what two chunks share, or between them."""
    return (max(first["first"], second["first"]) + min(first["last"], second["last"])) // 2


def _chunks(sequence: Mapping[str, Any], piece: int) -> list[Mapping[str, Any]]:
    return sorted((c for c in sequence["chunks"] if c["piece"] == piece), key=lambda chunk: chunk["first"])


def _sentences(sequence: Mapping[str, Any]) -> list[str]:
    chunks, seams, loops, pieces = (sequence[key] for key in ("chunks", "seams", "loops", "pieces"))
    order = "in the order given" if sequence["order"] == "given" else "put in order by what they show"
    found = [
        f"{_count(sequence['frames'], 'frame')}, {order}, predicted in {_count(len(chunks), 'chunk')} of up to "
        f"{sequence['chunk']} frames; neighbours share {_count(sequence['overlap'], 'frame')}."
    ]
    refined = [chunk["refined"] for chunk in chunks if chunk.get("refined") is not None]
    if refined:
        found.append(f"{sum(refined)} of {_count(len(refined), 'chunk')} refined.")
    together = [piece["together"]["accepted"] for piece in pieces if piece.get("together")]
    if together:
        what = "All photos" if len(pieces) == 1 else f"{sum(together)} of {len(pieces)} pieces"
        found.append(
            f"{what} refined together, from where the seams put them."
            if any(together)
            else "No piece refined as a whole."
        )
    spare = sum(bool(chunk.get("spare")) for chunk in chunks)
    if spare:
        found.append(f"{_count(spare, 'chunk')} left out: surer ones have these frames.")
    found.append(_seam_sentence(sequence))
    used = sum(bool(loop["used"]) for loop in loops)
    refused = sum(seam["kind"] == "loop" and not seam["used"] for seam in seams)
    if loops:
        found.append(f"{used} of {_count(len(loops), 'loop')} (places seen twice) used.")
    else:
        found.append("No loops (places seen twice).")
    if refused:
        found.append(f"{_count(refused, 'seam')} of loops could not be used.")
    found.append("One piece." if len(pieces) == 1 else f"{len(pieces)} pieces.")
    return found


def _seam_sentence(sequence: Mapping[str, Any]) -> str:
    seams = [seam for seam in sequence["seams"] if seam["kind"] == "neighbours"]
    unused = [seam for seam in seams if not seam["used"]]
    if not seams:
        return "There is no seam between neighbours."
    if not unused:
        return f"{len(seams)} seams between neighbours, all used." if len(seams) > 1 else "1 seam, used."
    piece_of = {chunk["number"]: chunk["piece"] for chunk in sequence["chunks"]}
    bridged = sum(piece_of.get(seam["first"]) == piece_of.get(seam["second"]) for seam in unused)
    more = f"; {bridged} of them {'is' if bridged == 1 else 'are'} bridged by others" if bridged else ""
    return f"{len(unused)} of {_count(len(seams), 'seam')} between neighbours could not be used{more}."


def _problems(sequence: Mapping[str, Any]) -> list[str]:
    """Name chunks without a result, and seams that leave pieces apart."""
    piece_of = {chunk["number"]: chunk["piece"] for chunk in sequence["chunks"]}
    frames_of = {c["number"]: f"frames {c['first']} to {c['last']}" for c in sequence["chunks"]}
    found = [
        f"Chunk {chunk['number']} ({frames_of[chunk['number']]}) is missing{_because(chunk.get('reason'))}"
        for chunk in sequence["chunks"]
        if chunk["piece"] is None and not chunk.get("spare")
    ]
    seam_of = {(seam["first"], seam["second"]): seam for seam in sequence["seams"]}
    neighbours = pairwise(chunk["number"] for chunk in sequence["chunks"])
    for a, b in sorted({*neighbours, *(pair for pair, seam in seam_of.items() if not seam["used"])}):
        ends, seam = (piece_of.get(a), piece_of.get(b)), seam_of.get((a, b))
        if None not in ends and ends[0] != ends[1]:
            why = _because("they share no frames." if seam is None else seam.get("reason"))
            found.append(f"Chunks {a} and {b} ({frames_of[a]}, and {frames_of[b]}) could not be joined{why}")
    if len(found) > MOST_NAMED:
        found[MOST_NAMED:] = [f"So it is at {len(found) - MOST_NAMED} more places; see the seams below."]
    return found


def _because(reason: str | None) -> str:
    return f": {reason}" if reason else "."


def _piece_number(folder: Path, sequence: Mapping[str, Any]) -> int:
    """Which piece a folder holds: the names of the others are `pieces/2` and so on, beside the first."""
    here = folder.resolve()
    own = f"{here.parent.name}/{here.name}"
    numbers = [number for number, piece in enumerate(sequence["pieces"]) if piece["folder"] == own]
    return numbers[0] if numbers else 0


def _pieces(folder: Path, sequence: Mapping[str, Any]) -> list[Piece]:
    pieces = sequence["pieces"]
    if len(pieces) < 2:
        return []
    this = _piece_number(folder, sequence)
    top = folder.resolve()
    top = top if this == 0 else top.parent.parent
    found = []
    for number, piece in enumerate(pieces):
        page, is_this = top / piece["folder"] / REPORT_NAME, number == this
        # The first one's page is written last.
        is_there = number == 0 or page.is_file()
        link = Path(os.path.relpath(page, folder.resolve())).as_posix() if is_there and not is_this else None
        span = piece["last"] - piece["first"] + 1
        some = "" if piece["frames"] == span else f" ({piece['frames']} of them)"
        where = "" if is_this or link else f", in {piece['folder']}"
        name = f"piece {number + 1}, frames {piece['first']} to {piece['last']}{some}{where}"
        found.append(Piece(name=name, link=link, is_this=is_this))
    return found


def piece_folders(result: Result) -> list[Path]:
    """Return the folders of the other pieces that are there, for the result of the first."""
    sequence = result.summary.get("sequence")
    if not sequence or _piece_number(result.folder, sequence) != 0:
        return []
    folders = [result.folder / piece["folder"] for piece in sequence["pieces"][1:]]
    return [folder for folder in folders if folder.is_dir()]


def _table(header: tuple[str, ...], rows: list[Row], worst: str, goodness: list[float | None]) -> Table:
    order = list(range(len(rows)))
    if len(rows) > MOST_ROWS:
        order.sort(key=lambda number: (rows[number].is_used, goodness[number] or 0))
    return Table(
        header=header,
        rows=[rows[number] for number in order[:MOST_ROWS]],
        others=[rows[number] for number in sorted(order[MOST_ROWS:])],
        worst=worst,
    )


def _seam_row(seam: Mapping[str, Any]) -> Row:
    kind = "" if seam["kind"] == "neighbours" else f", {seam['kind']}"
    cells = (
        f"{seam['first']}–{seam['second']}{kind}",
        str(seam["frames"]),
        _text(seam.get("inliers"), "{:.0f}", 100),
        _text(seam.get("rms"), "{:.2f}", 100),
        _text(seam.get("scale"), "{:.3f}"),
        _text(seam.get("gap"), "{:.2f}", 100),
        _used(seam),
    )
    return Row(cells=cells, is_used=bool(seam["used"]))


def _loop_row(loop: Mapping[str, Any]) -> Row:
    similarity, matches = _text(loop.get("similarity"), "{:.3f}"), _text(loop.get("matches"), "{:,}")
    cells = (f"{loop['first']} and {loop['second']}", similarity, matches, _used(loop))
    return Row(cells=cells, is_used=bool(loop["used"]))


def _used(entry: Mapping[str, Any]) -> str:
    """Say why something was not used, and what is doubtful in something that was."""
    reason = entry.get("reason")
    return f"{'yes' if entry['used'] else 'no'}{f': {reason}' if reason else ''}"


def _text(value: float | None, form: str, factor: float | None = None) -> str:
    if value is None or not np.isfinite(value):
        return "–"
    return form.format(value if factor is None else factor * value)


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"
