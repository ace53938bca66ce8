"""The tables of an experiment: our means, the published numbers beside them, and tested differences."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from freegeo.benchmark.paper.experiments import ROOMS, Experiment, Line, datasets_of
from freegeo.benchmark.paper.published import FAMILIES, Cell, PaperTable, Printed, paper_table
from freegeo.benchmark.results import SMALLER_IS_BETTER, Row, choose, entries, mean, paired
from freegeo.benchmark.tasks import FrameRule
from freegeo.data.procedural.splits import PREFIX
from freegeo.metrics.bootstrap import Interval

EMPTY = ""
FEWEST_SCENES = 5
NAMES = {
    "auc03": "AUC@3", "auc05": "AUC@5", "auc15": "AUC@15", "auc30": "AUC@30", "fscore": "F1", "overall": "CD",
    "f1_rel5": "F1 (5 %)", "abs_rel": "abs-rel", "mse": "MSE", "cosine": "cosine", "seconds": "pass s",
    "peak_gb": "pass GB", "adapt_seconds": "adapt s", "adapt_steps": "steps", "adapt_peak_gb": "adapt GB",
    "trainable": "trainable",
}  # fmt: skip
DIGITS = {"overall": 4, "mse": 4, "cosine": 4, "seconds": 2, "peak_gb": 2, "adapt_seconds": 0, "adapt_steps": 0,
          "adapt_peak_gb": 2, "trainable": 0}  # fmt: skip
PAPER_NOTE = (
    "Paper: its own weights, data and view counts; the two blocks are comparable only where ours has its columns."
)


@dataclass(frozen=True, kw_only=True)
class Table:
    """Text cells under a header; the first column names the row."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Which rows of the tidy table belong to an experiment."""

    rows: Sequence[Row]
    rule: FrameRule

    def of(self, line: Line, dataset: str, metric: str) -> list[Row]:
        """The rows of one line of the table."""
        return choose(self.rows, dataset=dataset, rule=self.rule, views=line.views, variant=line.variant, metric=metric)


def experiment_tables(
    entry: Experiment, rows: Sequence[Row], *, rule: FrameRule = "da3", family: str | None = None
) -> list[Table]:
    """All tables of one experiment, made from the tidy table.

    Args:
        entry: the experiment.
        rows: the tidy table; rows of other experiments are ignored.
        rule: frame rule of the run, where the experiment has none of its own.
        family: `da3` or `vggt` when the model is of that published family, else None.
    """
    rule = entry.frame_rule(rule)
    picked = Selection(rows=choose(rows, rule=rule), rule=rule)
    known = {row.dataset for row in picked.rows}
    datasets = [name for name in datasets_of(entry, sorted(known, key=_place)) if name in known]
    if entry.layout == "changes":
        tables = [change_table(entry, picked, datasets)]
    elif entry.layout == "gain":
        tables = [gain_table(entry, picked, datasets)]
    else:
        tables = [means_table(entry, picked, datasets, family)]
    if entry.paper is not None:
        tables.append(published_table(entry, paper_table(entry.paper)))
    if entry.layout not in ("costs", "gain"):
        tables.append(difference_table(entry, picked, datasets))
    return [table for table in tables if table.rows]


def means_table(entry: Experiment, picked: Selection, datasets: Sequence[str], family: str | None) -> Table:
    """Mean over scenes and seeds of every line; where the paper has the number, `(paper p, difference d)` beside it."""
    columns = [(dataset, metric) for dataset in datasets for metric in metrics_of(entry, dataset)]
    rows = []
    for line in entry.lines:
        cells = [_mean_cell(entry, line, picked, dataset, metric, family) for dataset, metric in columns]
        if any(cells):
            rows.append((line.label, *cells))
    header = ("", *(f"{short_name(dataset)} {NAMES[metric]}" for dataset, metric in columns))
    notes = (*_notes(picked, datasets), *_gaps(entry, picked, columns))
    return Table(title=f"{entry.name}: {entry.title}", header=header, rows=tuple(rows), notes=notes)


def published_table(entry: Experiment, table: PaperTable) -> Table:
    """The paper's own table, as printed."""
    fields = [name for name in ("model", "views", "configuration", "strategy", "variant") if name in table.rows[0]]
    rows = []
    for row in table.rows:
        label = ", ".join(str(row[name]) for name in fields)
        if "adapted" in row:
            label = f"{label}, {'adapted' if row['adapted'] else 'frozen'}".removeprefix(", ")
        rows.append((label, *row["printed"]))
    notes = tuple(note for note in (table.notes, PAPER_NOTE) if note)
    header = ("", *(_column_name(column) for column in table.columns))
    return Table(title=f"{entry.name}: published ({table.label})", header=header, rows=tuple(rows), notes=notes)


def change_table(entry: Experiment, picked: Selection, datasets: Sequence[str]) -> Table:
    """Relative changes in percent over datasets: the mean of the changes, and the change of the means."""
    metrics = tuple(dict.fromkeys(metric for dataset in datasets for metric in metrics_of(entry, dataset)))
    rows = []
    for line, base in compared_lines(entry):
        pairs = {
            metric: [
                (old, new)
                for dataset in datasets
                if (old := mean(picked.of(base, dataset, metric))) is not None
                and (new := mean(picked.of(line, dataset, metric))) is not None
            ]
            for metric in metrics
        }
        if any(pairs.values()):
            for name, change in (("mean of changes", mean_of_changes), ("change of means", change_of_means)):
                cells = tuple(_signed(change(pairs[metric]), 2, " %") for metric in metrics)
                rows.append((f"{line.views} views, {name}", *cells))
    header = ("", *(NAMES[metric] for metric in metrics))
    notes = (
        "Mean of changes: the relative change of every dataset, then their mean. Change of means: the mean over "
        "datasets before and after, then its relative change. The paper does not say which one it prints.",
        *_notes(picked, datasets),
    )
    return Table(title=f"{entry.name}: {entry.title}", header=header, rows=tuple(rows), notes=notes)


def mean_of_changes(pairs: Sequence[tuple[float, float]]) -> float | None:
    """Mean over datasets of (new - old) / old, in percent; datasets with an old value of 0 have none."""
    changes = [100 * (new - old) / old for old, new in pairs if old]
    return float(np.mean(changes)) if changes else None


def change_of_means(pairs: Sequence[tuple[float, float]]) -> float | None:
    """Relative change of the mean over datasets, in percent."""
    old, new = (float(np.mean([pair[k] for pair in pairs])) if pairs else 0.0 for k in (0, 1))
    return 100 * (new - old) / old if old else None


def difference_table(entry: Experiment, picked: Selection, datasets: Sequence[str]) -> Table:
    """Paired differences with 95 % intervals; `better` or `worse` where the interval excludes zero."""
    rows = []
    for dataset in datasets:
        for line, base in compared_lines(entry):
            for metric in metrics_of(entry, dataset):
                before, after = picked.of(base, dataset, metric), picked.of(line, dataset, metric)
                interval = None if metric == "trainable" else paired(before, after)
                if interval is not None:
                    rows.append(_difference_row(dataset, line, base, metric, interval, before, after))
    header = ("comparison", "metric", "difference", "95 % interval", "verdict", "scenes", "pairs")
    notes = ("Intervals: bootstrap over scenes of the paired differences; seeds of a scene stay together.",)
    return Table(title=f"{entry.name}: differences", header=header, rows=tuple(rows), notes=notes)


def gain_table(entry: Experiment, picked: Selection, datasets: Sequence[str]) -> Table:
    """Frozen and adapted means, the gain with its interval, its share of the 8->4 gap, and the scene that lost most."""
    ceiling = next(line for line in entry.lines if line.variant == "8to4")
    rows = []
    for dataset in datasets:
        for line, base in compared_lines(entry):
            for metric in metrics_of(entry, dataset) if line is not ceiling else ():
                before, after = picked.of(base, dataset, metric), picked.of(line, dataset, metric)
                gain = paired(before, after)
                if gain is not None:
                    gap = paired(before, picked.of(ceiling, dataset, metric)) if line.views == ceiling.views else None
                    rows.append(_gain_row(dataset, line, metric, before, after, gain, gap))
    header = (
        "", "metric", "frozen", "adapted", "gain", "95 % interval", "verdict", "8->4 gap", "95 % interval", "share",
        "worst scene", "scenes",
    )  # fmt: skip
    notes = (
        "Gap: features of 8 views decoded for the same 4, minus 4 views alone; the teacher can give no more. Share: "
        "gain over gap, where the gap's interval leaves out zero on the good side. Worst scene: mean over its seeds.",
        *_notes(picked, datasets),
    )
    return Table(title=f"{entry.name}: {entry.title}", header=header, rows=tuple(rows), notes=notes)


def _gain_row(
    dataset: str, line: Line, metric: str, before: Sequence[Row], after: Sequence[Row], gain: Interval,
    gap: Interval | None,
) -> tuple[str, ...]:  # fmt: skip
    digits, sign = DIGITS.get(metric, 3), -1 if metric in SMALLER_IS_BETTER else 1
    old, new = entries(before), entries(after)
    changes: dict[str, list[float]] = {}
    for item in old.keys() & new.keys():
        changes.setdefault(item[1], []).append(new[item] - old[item])
    by_scene = {scene: float(np.mean(values)) for scene, values in changes.items()}
    worst = min(by_scene, key=lambda scene: sign * by_scene[scene])
    is_gap = gap is not None and gap.excludes_zero and sign * gap.mean > 0
    return (
        f"{short_name(dataset)}: {line.views} views",
        NAMES[metric],
        number(mean(before), metric),
        number(mean(after), metric),
        _signed(gain.mean, digits),
        _bounds(gain, digits),
        verdict(metric, gain, len(by_scene)),
        EMPTY if gap is None else _signed(gap.mean, digits),
        EMPTY if gap is None else _bounds(gap, digits),
        f"{gain.mean / gap.mean:.0%}" if is_gap else EMPTY,
        f"{worst} {_signed(by_scene[worst], digits)}",
        str(len(by_scene)),
    )


def compared_lines(entry: Experiment) -> list[tuple[Line, Line]]:
    """Every line that is compared, with the line it is compared with."""
    by_label = {line.label: line for line in entry.lines}
    return [(line, by_label[line.compare_with]) for line in entry.lines if line.compare_with is not None]


def verdict(metric: str, interval: Interval, scenes: int) -> str:
    """`better`, `worse`, or `open` where the interval includes zero; `too few scenes` below 5."""
    if scenes < FEWEST_SCENES:
        return "too few scenes"
    if not interval.excludes_zero:
        return "open"
    return "better" if (interval.mean < 0) == (metric in SMALLER_IS_BETTER) else "worse"


def metrics_of(entry: Experiment, dataset: str) -> tuple[str, ...]:
    """The metrics that are shown for a dataset."""
    return entry.room_metrics if dataset.startswith(PREFIX) else entry.metrics


def short_name(dataset: str) -> str:
    """A dataset's name in a header."""
    return dataset.removeprefix(PREFIX)


def number(value: float | None, metric: str) -> str:
    """A value as it is printed."""
    return EMPTY if value is None else f"{value:,.{DIGITS.get(metric, 3)}f}"


def signed(value: float, metric: str) -> str:
    """A difference as it is printed."""
    return _signed(value, DIGITS.get(metric, 3))


def as_text(table: Table) -> str:
    """Plain text with aligned columns."""
    cells = [table.header, *table.rows]
    widths = [max(len(row[k]) for row in cells) for k in range(len(table.header))]

    def laid_out(row: Sequence[str]) -> str:
        parts = [c.ljust(w) if k == 0 else c.rjust(w) for k, (c, w) in enumerate(zip(row, widths, strict=True))]
        return "  ".join(parts).rstrip()

    lines = [table.title, "", laid_out(table.header), "  ".join("-" * width for width in widths)]
    return "\n".join([*lines, *map(laid_out, table.rows), "", *table.notes]) + "\n"


def as_markdown(table: Table) -> str:
    """A Markdown table."""
    lines = [f"### {table.title}", "", _piped(table.header), "|---" + "|---:" * (len(table.header) - 1) + "|"]
    return "\n".join([*lines, *map(_piped, table.rows), "", *(f"{note}\n" for note in table.notes)])


def as_csv(table: Table) -> str:
    """Comma-separated values; the title and the notes are left out."""
    import csv
    import io

    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows([table.header, *table.rows])
    return buffer.getvalue()


def as_latex(table: Table) -> str:
    """A LaTeX tabular with booktabs rules."""
    lines = [
        f"% {table.title}",
        rf"\begin{{tabular}}{{l{'r' * (len(table.header) - 1)}}}",
        r"\toprule",
        _latex_row(table.header),
        r"\midrule",
        *map(_latex_row, table.rows),
        r"\bottomrule",
        r"\end{tabular}",
        *(f"% {note}" for note in table.notes),
    ]
    return "\n".join(lines) + "\n"


TABLE_WRITERS: Mapping[str, Callable[[Table], str]] = {
    "txt": as_text, "md": as_markdown, "csv": as_csv, "tex": as_latex,
}  # fmt: skip


def _mean_cell(entry: Experiment, line: Line, picked: Selection, dataset: str, metric: str, family: str | None) -> str:
    ours = mean(picked.of(line, dataset, metric))
    if ours is None:
        return EMPTY
    theirs = published(entry, line, dataset, metric, family)
    if theirs is None:
        return number(ours, metric)
    return f"{number(ours, metric)} (paper {number(theirs.value, metric)}, {signed(ours - theirs.value, metric)})"


def published(entry: Experiment, line: Line, dataset: str, metric: str, family: str | None) -> Printed | None:
    """The paper's number for a line, for a model of the published family; None where it has none."""
    if entry.paper is None or family not in FAMILIES or not line.paper:
        return None
    fields = {**line.paper}
    table = paper_table(entry.paper)
    if "model" in table.rows[0]:
        fields["model"] = family
    return table.printed(fields, Cell(dataset, metric, family))


def _difference_row(
    dataset: str, line: Line, base: Line, metric: str, interval: Interval, before: Sequence[Row], after: Sequence[Row]
) -> tuple[str, ...]:
    digits = DIGITS.get(metric, 3)
    shared = [item for item in entries(before) if item in entries(after)]
    scenes = len({item[:2] for item in shared})
    return (
        f"{short_name(dataset)}: {line.label} - {base.label}",
        NAMES[metric],
        _signed(interval.mean, digits),
        _bounds(interval, digits),
        verdict(metric, interval, scenes),
        str(scenes),
        str(len(shared)),
    )


def _notes(picked: Selection, datasets: Sequence[str]) -> tuple[str, ...]:
    counts = []
    for dataset in datasets:
        rows = choose(picked.rows, dataset=dataset)
        scenes, seeds = {row.scene for row in rows}, sorted({row.seed for row in rows})
        counts.append(f"{short_name(dataset)}: {len(scenes)} scenes, seeds {', '.join(map(str, seeds))}")
    models = ", ".join(sorted({row.model for row in picked.rows}))
    where = " Rooms: F1 at 0.15 m." if any(dataset in ROOMS for dataset in datasets) else ""
    return (f"Model {models}; frame rule {picked.rule}; {'; '.join(counts)}.{where}",)


def _gaps(entry: Experiment, picked: Selection, columns: Sequence[tuple[str, str]]) -> tuple[str, ...]:
    """Which means lack scenes that others have, so that they must not be compared."""
    missing = []
    for dataset in dict.fromkeys(dataset for dataset, _ in columns):
        counts = {
            (line.label, metric): len(picked.of(line, dataset, metric))
            for line in entry.lines_for(dataset)
            for metric in metrics_of(entry, dataset)
            if not metric.startswith("adapt_") and metric != "trainable"
        }
        most = max(counts.values(), default=0)
        missing += [
            f"{short_name(dataset)} {NAMES[metric]}, {label}: {count} of {most}"
            for (label, metric), count in counts.items()
            if 0 < count < most
        ]
    return (f"Entries without a value (see problems.json): {'; '.join(missing)}.",) if missing else ()


def _place(dataset: str) -> tuple[int, str]:
    return (ROOMS.index(dataset) if dataset in ROOMS else -1), dataset


def _column_name(column: str) -> str:
    first, _, metric = column.rpartition("/")
    percent = " %" if metric.endswith("_percent") else ""
    return f"{first} {NAMES[metric.removesuffix('_percent')]}{percent}".strip()


def _signed(value: float | None, digits: int, unit: str = "") -> str:
    return EMPTY if value is None else f"{value:+,.{digits}f}{unit}"


def _bounds(interval: Interval, digits: int) -> str:
    return f"[{_signed(interval.low, digits)}, {_signed(interval.high, digits)}]"


def _piped(row: Sequence[str]) -> str:
    return "| " + " | ".join(row) + " |"


def _latex_row(row: Sequence[str]) -> str:
    escaped = [cell.replace("%", r"\%").replace("_", r"\_").replace("&", r"\&").replace("->", r"$\to$") for cell in row]
    return " & ".join(escaped) + r" \\"
