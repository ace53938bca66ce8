"""The tidy table of a benchmark: one row per task and metric, as CSV and as JSON lines."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from freegeo.benchmark.tasks import FrameRule, Task
from freegeo.errors import UserError
from freegeo.files import atomic_path, json_of, read_text
from freegeo.metrics.bootstrap import Interval, paired_interval

CSV_FILE, LINES_FILE = "results.csv", "results.jsonl"
SMALLER_IS_BETTER = ("overall", "acc", "comp", "abs_rel", "mse", "seconds", "peak_gb", "trainable")
"""Metrics of which less is better; of all others more is."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One number."""

    model: str
    dataset: str
    scene: str
    rule: FrameRule
    views: int
    """Views of the task."""
    frames: int
    """Views that were used, fewer than `views` where the scene has fewer frames."""
    seed: int
    variant: str
    metric: str
    value: float

    @property
    def item(self) -> tuple[str, str, int]:
        """What is paired when two variants are compared: the same scene and sample seed."""
        return self.dataset, self.scene, self.seed


COLUMNS = tuple(field.name for field in fields(Row))
_AGAIN = "Evaluate again."


def rows_of(task: Task, model: str, frames: int, metrics: Mapping[str, float]) -> list[Row]:
    """The rows of one task."""
    about = asdict(task)
    return [Row(model=model, frames=frames, **about, metric=k, value=float(v)) for k, v in metrics.items()]


def write_results(out: Path, rows: Sequence[Row]) -> list[Path]:
    """Write both files; returns their paths."""
    paths = [Path(out) / CSV_FILE, Path(out) / LINES_FILE]
    with atomic_path(paths[0]) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)
    with atomic_path(paths[1]) as part:
        part.write_text("".join(json.dumps(asdict(row)) + "\n" for row in rows), encoding="utf-8")
    return paths


def read_results(out: Path) -> list[Row]:
    """Read what `write_results` wrote; UserError when there is nothing, FreeGeoError when the file is damaged."""
    path = Path(out) / LINES_FILE
    if not path.is_file():
        raise UserError(f"{out}: holds no results. Run `freegeo bench evaluate` first.")
    lines = read_text(path, advice=_AGAIN).splitlines()
    found = [json_of(line, path, Row, advice=_AGAIN) for line in lines]
    return [Row(**{name: row[name] for name in COLUMNS}) for row in found]


def choose(rows: Iterable[Row], **wanted: object) -> list[Row]:
    """The rows whose fields have these values."""
    return [row for row in rows if all(getattr(row, name) == value for name, value in wanted.items())]


def mean(rows: Sequence[Row]) -> float | None:
    """Plain mean over (scene, seed) entries; None when there is none."""
    return float(np.mean([row.value for row in rows])) if rows else None


def entries(rows: Iterable[Row]) -> dict[tuple[str, str, int], float]:
    """Value of every (dataset, scene, seed). UserError when rows of several tasks or metrics were mixed."""
    found: dict[tuple[str, str, int], float] = {}
    for row in rows:
        if row.item in found:
            raise UserError(f"{row.dataset} {row.scene}, seed {row.seed}: several values of one comparison.")
        found[row.item] = row.value
    return found


def paired(
    before: Iterable[Row],
    after: Iterable[Row],
    difference: Callable[[float, float], float] = lambda old, new: new - old,
) -> Interval | None:
    """Mean difference over the entries that both have, with an interval that resamples whole scenes.

    None when they share no entry with a finite difference.
    """
    old, new = entries(before), entries(after)
    items = [item for item in old if item in new]
    values = np.array([difference(old[item], new[item]) for item in items], dtype=np.float64)
    kept = np.isfinite(values)
    if not kept.any():
        return None
    return paired_interval(values[kept], [item[:2] for item, keep in zip(items, kept, strict=True) if keep])
