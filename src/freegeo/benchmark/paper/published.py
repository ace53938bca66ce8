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


@dataclass(frozen=True)
class Cell:
    """What a published number is about."""

    dataset: str | None
    metric: str
    family: str | None
    """Model family, where the table names it."""


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

    def value(self, fields: Mapping[str, Any], cell: Cell) -> float | None:
        """A published number as a fraction (or metres, or percent of change); None when the paper has none."""
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


def _number(printed: str, column: str) -> float:
    text = printed.strip().removesuffix("%")
    value = float(text.removesuffix("M")) * (1e6 if text.endswith("M") else 1)
    return value / 100 if column.endswith("_percent") else value
