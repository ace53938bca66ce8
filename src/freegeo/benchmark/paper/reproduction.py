"""Our numbers beside the paper's, cell by cell, and whether they differ by more than seeds explain."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from freegeo.benchmark.paper.experiments import EXPERIMENTS, Experiment, Line
from freegeo.benchmark.paper.published import FAMILY_NAMES, Cell, Printed, paper_table
from freegeo.benchmark.paper.tables import (
    EMPTY,
    NAMES,
    Selection,
    Table,
    as_markdown,
    change_of_means,
    compared_lines,
    mean_of_changes,
    number,
    published,
    signed,
)
from freegeo.benchmark.results import SMALLER_IS_BETTER, Row, choose, mean
from freegeo.benchmark.tasks import FrameRule

PAPER_TABLES = tuple(entry.name for entry in EXPERIMENTS.values() if entry.paper is not None)
PAPER_DATASETS = ("eth3d", "7scenes", "scannetpp", "hiroom")
FACTOR = 2.0
"""A difference is marked beyond so many standard errors."""
SAMPLING_NOISE = {"fscore": 0.001}
RELATIVE_SAMPLING_NOISE = {"overall": 0.002}
"""What the seed of the surface sampling changes, in F1 and, as a share, in the Chamfer distance (docs/benchmark.md)."""
RULE = (
    "A difference is marked when it is larger than twice its standard error, plus the rounding of the printed number "
    "and the noise of sampling the surface (F1 0.001, CD 0.2 %). The standard error is s·√(1/n + 1/m): s is the "
    "standard deviation of our mean between seeds, n the number of our seeds, m that of the paper's. Three seeds give "
    "a rough s, so up to one in six numbers that do agree is marked by chance."
)
Verdict = Literal["within", "beyond", "open"]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """One of our numbers, and the paper's."""

    metric: str
    ours: float
    paper: Printed | None
    allowed: float | None
    """Largest difference that seeds explain; None: it is not known, and nothing is marked."""
    unit: str = ""
    digits: int | None = None
    """Decimals of a change, which has a sign; None: those of the metric."""

    @property
    def difference(self) -> float | None:
        """Ours minus the paper's; None where the paper has no number."""
        return None if self.paper is None else self.ours - self.paper.value

    @property
    def verdict(self) -> Verdict | None:
        """`beyond` seed noise, `within` it, `open` where it is not known; None where the paper has no number."""
        difference = self.difference
        if difference is None:
            return None
        if self.allowed is None:
            return "open"
        return "beyond" if abs(difference) > self.allowed else "within"

    @property
    def direction(self) -> str:
        """Whether a difference beyond noise is `better` or `worse` than the paper, for a metric that says so."""
        difference = self.difference
        if difference is None or self.metric == "trainable":
            return ""
        return "better" if (difference < 0) == (self.metric in SMALLER_IS_BETTER) else "worse"

    def text(self, value: float, sign: bool = False) -> str:
        """A value as it is printed, with the metric's digits."""
        if self.digits is not None:
            return f"{value:+.{self.digits}f}{self.unit}"
        return signed(value, self.metric) if sign else number(value, self.metric)

    def __str__(self) -> str:
        """Ours, and in brackets the paper's, the difference and the mark."""
        if self.paper is None or self.difference is None:
            return self.text(self.ours)
        mark = f", **beyond{': ' * bool(self.direction)}{self.direction}**" if self.verdict == "beyond" else ""
        difference = self.text(self.difference, sign=True)
        return f"{self.text(self.ours)} (paper {self.text(self.paper.value)}, {difference}{mark})"


@dataclass(frozen=True, kw_only=True)
class ComparedTable:
    """One table of the paper, ours beside it."""

    name: str
    title: str
    label: str
    """Of the published table in the paper's source."""
    groups: tuple[tuple[str, int], ...]
    """Names above the columns, with the number of columns; "" where there is none."""
    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[Comparison | None, ...]], ...]
    notes: tuple[str, ...]

    def counts(self) -> dict[Verdict, int]:
        """How many numbers of the table have each verdict."""
        verdicts = [cell.verdict for _, cells in self.rows for cell in cells if cell is not None]
        return {kind: verdicts.count(kind) for kind in ("within", "beyond", "open")}

    def as_table(self) -> Table:
        """The same as text cells."""
        names = [name for name, count in self.groups for _ in range(count)]
        header = tuple(f"{group} {name}".strip() for group, name in zip(names, self.columns, strict=True))
        rows = tuple(
            (label, *(EMPTY if cell is None else str(cell) for cell in cells)) for label, cells in self.rows
        )  # fmt: skip
        return Table(
            title=f"{self.name}: {self.title} ({self.label})", header=("", *header), rows=rows, notes=self.notes
        )


@dataclass(frozen=True, kw_only=True)
class Reproduction:
    """What a run of the paper's tables gave: content of `reproduction.html` and `reproduction.md`."""

    facts: tuple[tuple[str, str], ...]
    """What it was made with, as (name, value)."""
    doubts: tuple[str, ...]
    """Sentences on what makes the numbers incomparable, or doubtful."""
    tables: tuple[ComparedTable, ...]
    not_run: tuple[tuple[str, str, str], ...]
    """Tables that were left out: name, title, reason."""
    problems: tuple[str, ...]
    """What could not be computed, scene by scene."""
    datasets: tuple[str, ...]
    settings: tuple[tuple[str, tuple[str, ...]], ...]
    """Settings of the adaptation: name, and a value for each dataset."""
    rule: str = RULE
    """When a difference is marked."""

    @property
    def counts(self) -> dict[Verdict, int]:
        """How many numbers have each verdict."""
        return {kind: sum(table.counts()[kind] for table in self.tables) for kind in ("within", "beyond", "open")}

    @property
    def answer(self) -> str:
        """The result in one sentence."""
        counts = self.counts
        if not (judged := counts["within"] + counts["beyond"]):
            return f"{counts['open']} numbers stand beside the paper's; none can be judged, for the reasons given."
        rest = f"; {counts['open']} more could not be judged" if counts["open"] else ""
        return f"{counts['within']} of {judged} numbers agree with the paper's within seed noise{rest}."

    def as_markdown(self) -> str:
        """The page as Markdown."""
        lines = ["# The paper's tables, ours beside them", "", self.answer, ""]
        lines += [f"- **{sentence}**" for sentence in self.doubts] + [""] * bool(self.doubts)
        lines += [f"- {name}: {value}" for name, value in self.facts] + ["", f"How to read: {self.rule}", ""]
        for table in self.tables:
            lines += [as_markdown(table.as_table()), ""]
        if self.not_run:
            lines += ["### Not run", "", *(f"- {name} ({title}): {why}" for name, title, why in self.not_run), ""]
        if self.problems:
            lines += ["### What failed", "", *(f"- {problem}" for problem in self.problems), ""]
        header = ("setting", *self.datasets)
        settings = tuple((name, *values) for name, values in self.settings)
        return "\n".join([*lines, as_markdown(Table(title="Settings of the adaptation", header=header, rows=settings))])


def left_out(entry: Experiment, family: str, incomplete: Mapping[str, str], complete: Sequence[str]) -> str | None:
    """Return why a table of the paper cannot be run; None when it can.

    Args:
        entry: a table of the paper.
        family: of the model.
        incomplete: datasets that cannot be used, with the reason.
        complete: datasets that can.
    """
    table, dataset = paper_table(entry.paper or ""), entry.published_dataset
    has_numbers = any(
        published(entry, line, dataset or PAPER_DATASETS[0], metric, family)
        or table.printed({"views": line.views}, Cell(None, metric, family))
        for line in entry.lines
        for metric in entry.metrics
    )
    if not has_numbers:
        return f"the paper prints no numbers of {FAMILY_NAMES[family]} for it"
    if dataset is not None and dataset not in complete:
        return f"needs {dataset}: {incomplete.get(dataset, 'not among --datasets')}"
    return None


def compared_table(
    entry: Experiment, rows: Sequence[Row], scenes: Mapping[str, Sequence[str]], *, rule: FrameRule, family: str,
    judged: bool = True,
) -> ComparedTable:  # fmt: skip
    """Compare one table with the paper's.

    Args:
        entry: a table of the paper.
        rows: the tidy table of the run; rows of other tables are ignored.
        scenes: dataset -> its published scenes, of the datasets that ran.
        rule: frame rule of the run, where the table has none of its own.
        family: `da3` or `vggt`.
        judged: whether differences may be marked at all.
    """
    rule = entry.frame_rule(rule)
    picked = Selection(rows=choose(rows, rule=rule), rule=rule)
    datasets = [name for name in scenes if entry.published_dataset in (None, name)]
    wanted = {name: scenes[name] if judged else () for name in datasets}
    table = paper_table(entry.paper or "")
    if entry.layout == "changes":
        groups, columns = [("", len(entry.metrics))], [NAMES[metric] for metric in entry.metrics]
        body = _changes(entry, picked, datasets, family)
    else:
        groups = [(name, len(entry.metrics)) for name in datasets]
        columns = [NAMES[metric] for _ in datasets for metric in entry.metrics]
        body = [
            (line.label, [_compared(entry, line, picked, name, wanted[name], metric, family)
                          for name in datasets for metric in entry.metrics])
            for line in entry.lines
        ]  # fmt: skip
    return ComparedTable(
        name=entry.name, title=entry.title, label=table.label, groups=tuple(groups), columns=tuple(columns),
        rows=tuple((label, tuple(cells)) for label, cells in body if any(cells)),
        notes=tuple(_notes(entry, picked, wanted, judged, table.notes)),
    )  # fmt: skip


def standard_error(by_seed: Sequence[float], seeds_of_paper: int) -> float | None:
    """Standard error of the difference between our mean over seeds and the paper's; None with fewer than two seeds.

    The paper's seeds are taken to scatter as ours do.
    """
    if len(by_seed) < 2:
        return None
    return float(np.std(by_seed, ddof=1)) * math.sqrt(1 / len(by_seed) + 1 / seeds_of_paper)


def allowed_difference(metric: str, paper: Printed, error: float | None) -> float | None:
    """Largest difference to a printed number that seeds, its rounding and the surface sampling explain (`RULE`)."""
    if error is None:
        return None
    sampling = SAMPLING_NOISE.get(metric, 0.0) + RELATIVE_SAMPLING_NOISE.get(metric, 0.0) * abs(paper.value)
    return FACTOR * error + paper.half_digit + sampling


def _compared(
    entry: Experiment, line: Line, picked: Selection, dataset: str, scenes: Sequence[str], metric: str, family: str
) -> Comparison | None:
    rows = picked.of(line, dataset, metric)
    ours, paper = mean(rows), published(entry, line, dataset, metric, family)
    if ours is None:
        return None
    error = None
    if seeds := _complete_seeds(rows, scenes):
        means = [mean([row for row in rows if row.seed == seed]) for seed in seeds]
        error = standard_error([value for value in means if value is not None], entry.paper_seeds)
    allowed = None if paper is None else allowed_difference(metric, paper, error)
    return Comparison(metric=metric, ours=ours, paper=paper, allowed=allowed)


def _complete_seeds(rows: Sequence[Row], scenes: Sequence[str]) -> list[int]:
    """The seeds, when every one of them has a value of each of these scenes; otherwise none."""
    seeds = sorted({row.seed for row in rows})
    found = {(row.scene, row.seed) for row in rows if math.isfinite(row.value)}
    whole = bool(scenes) and found == {(scene, seed) for scene in scenes for seed in seeds}
    return seeds if whole else []


def _changes(
    entry: Experiment, picked: Selection, datasets: Sequence[str], family: str
) -> list[tuple[str, list[Comparison | None]]]:
    """Relative changes in percent, averaged in both ways; the paper's are never judged (see `_notes`)."""
    ways: tuple[tuple[str, Callable], ...] = (
        ("mean of changes", mean_of_changes), ("change of means", change_of_means),
    )  # fmt: skip
    table, body = paper_table(entry.paper or ""), []
    for line, base in compared_lines(entry):
        for way, change in ways:
            cells: list[Comparison | None] = []
            for metric in entry.metrics:
                pairs = [
                    (old, new)
                    for name in datasets
                    if (old := mean(picked.of(base, name, metric))) is not None
                    and (new := mean(picked.of(line, name, metric))) is not None
                ]
                ours = change(pairs)
                paper = table.printed({"views": line.views}, Cell(None, metric, family))
                cells.append(
                    None if ours is None
                    else Comparison(metric=metric, ours=ours, paper=paper, allowed=None, unit=" %", digits=2)
                )  # fmt: skip
            body.append((f"{line.views} views, {way}", cells))
    return body


def _notes(
    entry: Experiment, picked: Selection, wanted: Mapping[str, Sequence[str]], judged: bool, printed: str
) -> list[str]:
    """What a reader of the table has to know: seeds, gaps, why nothing is marked."""
    rows = [row for name in wanted for line in entry.lines for row in choose(picked.rows, dataset=name)
            if (row.variant, row.views) == (line.variant, line.views)]  # fmt: skip
    seeds = sorted({row.seed for row in rows})
    said = [f"Frame rule {picked.rule}; {'seed' if len(seeds) == 1 else 'seeds'} {', '.join(map(str, seeds))}."]
    if len(seeds) == 1:
        said.append("One seed ran, so what seeds change is not known, and nothing is marked.")
    if entry.layout == "changes":
        said.append(
            "Nothing is marked: the paper does not say how it averages over its four datasets, so both ways stand "
            "here, and what it prints follows from its own detailed tables in neither way."
        )
    elif judged:
        short = {
            f"{name} {line.label}"
            for name, scenes in wanted.items()
            for line in entry.lines
            for metric in entry.metrics
            if (own := picked.of(line, name, metric)) and not _complete_seeds(own, scenes)
        }
        if short:
            said.append(f"Scenes or seeds are missing, so nothing is marked: {'; '.join(sorted(short))}.")
    if entry.paper_seeds == 1:
        said.append("The paper's numbers come from one seed, so they scatter more than means over three.")
    return [*said, *([f"Paper: {printed}"] if printed else [])]
