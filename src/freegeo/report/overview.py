"""``index.html`` of `freegeo batch`: a table of its scenes, with links to their reports."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

from freegeo import files
from freegeo.report.answer import answer
from freegeo.report.rendering import fill

TEMPLATE = "overview.html.j2"


@dataclass(frozen=True, kw_only=True)
class SceneRow:
    """What became of a scene."""

    name: str
    outcome: str
    """As `outcome_of` says; or `failed`, `incomplete` (files or photos are missing), `unfinished`."""
    source: Sequence[str] = ()
    views: int | None = None
    seconds: float | None = None
    """Of computation, in all processes that worked on it."""
    warnings: int | None = None
    report: str | None = None
    """Page and log, relative to the folder of the batch."""
    log: str | None = None
    error: str | None = None
    """Why it failed, or is incomplete, in one sentence."""
    asked: str | None = None
    """Fingerprint of everything that the result depends on, and when it was finished."""


class Batch(TypedDict):
    """The record of a batch, as far as it is read again."""

    scenes: list[SceneRow]


def outcome_of(summary: Mapping[str, Any]) -> str:
    """Return in a few words what a result is, from the content of ``reconstruction.json``."""
    found = answer(summary)
    accepted = {} if found is None else {part.what: part.outcome for part in found.parts}
    words = "adapted" if summary.get("adapter") else "frozen"
    if words == "adapted" and accepted.get("Adaptation") == "unknown":
        words = "adapted (not judged)"
    return f"{words}, refined" if accepted.get("Refinement") == "yes" else words


def write_overview(folder: Path, file_name: str, rows: Sequence[SceneRow]) -> None:
    """Write the page of a batch into its folder."""
    page = fill(TEMPLATE, title=folder.resolve().name, rows=rows, counts=Counter(row.outcome for row in rows))
    with files.atomic_path(folder / file_name) as part:
        part.write_text(page, encoding="utf-8")
