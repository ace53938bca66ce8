"""The published numbers: transcribed tables of the Free Geometry paper (arXiv 2604.14048) in `paper_tables.json`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from freegeo.errors import UserError

FILE = "paper_tables.json"
FAMILIES = ("da3", "vggt")
FAMILY_NAMES = {"da3": "Depth Anything 3", "vggt": "VGGT"}
PAPER_MODELS = {"da3": "da3-giant", "vggt": "vggt-1b"}
"""Which model of each family the paper reports."""


@dataclass(frozen=True)
class Cell:
    """What a published number is about."""

    dataset: str | None
    metric: str
    family: str | None
    """Model family, where the table names it."""


@dataclass(frozen=True)
class Printed:
    """A number as the paper prints it."""

    value: float
    """A fraction, metres, or percent of change."""
    half_digit: float
    """Half a unit of its last printed digit: what rounding may have changed."""


@dataclass(frozen=True, kw_only=True)
class PaperTable:
    """One published table."""

    title: str
    label: str
    """Label in the paper's LaTeX source."""
    columns: tuple[str, ...]
    rows: tuple[Mapping[str, Any], ...]
    """Fields that name the row, and `printed` with the text of every column."""
    dataset: str | None
    family: str | None
    notes: str

    def row(self, fields: Mapping[str, Any], family: str | None) -> Mapping[str, Any] | None:
        """The row with these fields, of this model family where rows name one."""
        for row in self.rows:
            if all(row.get(name) == value for name, value in fields.items()) and row.get("model") in (None, family):
                return row
        return None

    def printed(self, fields: Mapping[str, Any], cell: Cell) -> Printed | None:
        """A published number; None when the paper has none."""
        row = self.row(fields, cell.family)
        if row is None or not fields:
            return None
        for number, column in enumerate(self.columns):
            if self._cell(column, row) == cell:
                return _number(row["printed"][number], column)
        return None

    def _cell(self, column: str, row: Mapping[str, Any]) -> Cell:
        first, _, rest = column.rpartition("/")
        metric = rest.removesuffix("_percent")
        if first in FAMILIES:
            return Cell(self.dataset, metric, first)
        family = row.get("model") or self.family or "da3"
        return Cell(first or self.dataset, metric, family)


@cache
def paper_table(key: str) -> PaperTable:
    """A published table by key; UserError lists the keys."""
    tables = json.loads((files("freegeo.benchmark.paper") / FILE).read_text(encoding="utf-8"))
    if key not in tables:
        raise UserError(f"The paper has no table {key!r}; known are {', '.join(tables)}.")
    entry = tables[key]
    return PaperTable(
        title=entry["title"],
        label=entry["label"],
        columns=tuple(entry["columns"]),
        rows=tuple(entry["rows"]),
        dataset=entry.get("dataset"),
        family=entry.get("model"),
        notes=entry.get("notes", ""),
    )


def _number(printed: str, column: str) -> Printed:
    text = printed.strip().removesuffix("%")
    scale = (1e6 if text.endswith("M") else 1) / (100 if column.endswith("_percent") else 1)
    text = text.removesuffix("M")
    return Printed(float(text) * scale, 0.5 * 10.0 ** -len(text.partition(".")[2]) * scale)
