"""Tables of docs/results/README.md from folders of `freegeo bench run gain features`.

    freegeo bench run gain features --datasets procedural-big ... -o FOLDER/big      (and so on)
    python benchmarks/gain.py FOLDER                   one table of all, then what follows from several folders
    python benchmarks/gain.py FOLDER --side-by-side    a column for each folder: its settings compared

A folder NAME-per-scene (an adapter for each room) is also compared with NAME (one for all), on the rooms of both.
"""

import argparse
from pathlib import Path

import numpy as np
from text_tables import in_order, interval, table

from freegeo.benchmark.paper.tables import NAMES, short_name
from freegeo.benchmark.results import LINES_FILE, Row, choose, entries, mean, paired, read_results

METRICS = ("auc15", "auc30", "fscore", "f1_rel5")
FEW = 4
"""Views for which those of all eight were decoded, too."""
PER_SCENE = "-per-scene"
UNSEEN_SEED = 44
"""The seed whose frames adaptation never saw together."""


def gain(rows: list[Row], views: int, metric: str, **wanted: object) -> tuple[list[Row], ...]:
    """Rows of the frozen and the adapted model, and of the frozen one that has seen eight views."""
    return tuple(
        choose(rows, views=views, metric=metric, variant=kind, **wanted) for kind in ("frozen", "adapted", "8to4")
    )


def shown(before: list[Row], after: list[Row]) -> str:
    """Mean difference with its interval over rooms; bold when all of it is above zero."""
    found = paired(before, after)
    if found is None:
        return ""
    text = f"{found.mean:+.3f} [{found.low:+.3f}, {found.high:+.3f}]"
    return f"**{text}**" if found.low > 0 else text


def lines_of(rows: list[Row]) -> list[list[str]]:
    """Rows of the table, of one folder."""
    lines = []
    for dataset in dict.fromkeys(row.dataset for row in rows):
        own = choose(rows, dataset=dataset)
        for views in sorted({row.views for row in own}):
            for metric in METRICS:
                frozen, adapted, ceiling = gain(own, views, metric)
                if not frozen or not adapted:
                    continue
                rooms = len({row.scene for row in adapted})
                label = f"{short_name(dataset)} ({rooms} rooms), {views} views, {NAMES[metric]}"
                change, gap = paired(frozen, adapted), paired(frozen, ceiling) if views == FEW else None
                share = f"{change.mean / gap.mean:.0%}" if change and gap and gap.low > 0 else ""
                values = [f"{mean(frozen):.3f}", f"{mean(adapted):.3f}", shown(frozen, adapted)]
                lines.append([label, *values, shown(frozen, ceiling) if gap else "", share])
    return lines


def report(folders: dict[str, list[Row]]) -> None:
    """Print the table of all folders, the seed that adaptation never saw, and adapters per room against one for all."""
    header = ("", "frozen", "adapted", "gain, 95 % interval", "8->4 minus 4, 95 % interval", "share of the gap")
    one_for_all = {name: rows for name, rows in folders.items() if not name.endswith(PER_SCENE)}
    per_scene = {name: rows for name, rows in folders.items() if name.endswith(PER_SCENE)}
    for title, group in (("one adapter per split", one_for_all), ("one adapter per room", per_scene)):
        if group:
            print(f"{title}\n\n{table(header, [line for rows in group.values() for line in lines_of(rows)])}\n")
    lines = []
    for name, rows in folders.items():
        found = [gain(rows, FEW, metric, seed=UNSEEN_SEED) for metric in METRICS]
        if any(adapted for _, adapted, _ in found) and len({row.seed for row in rows}) > 1:
            lines.append([name, *(shown(frozen, adapted) for frozen, adapted, _ in found)])
    if lines:
        print(f"gain at {FEW} views, seed {UNSEEN_SEED} alone\n")
        print(table(("", *(NAMES[metric] for metric in METRICS)), lines))
    lines = []
    for name, rows in per_scene.items():
        one = folders.get(name.removesuffix(PER_SCENE))
        if one:
            cells = []
            for metric in METRICS:
                (base, per_room, _), (old_base, for_all, _) = gain(rows, FEW, metric), gain(one, FEW, metric)
                same = all(np.isclose(value, entries(old_base)[item]) for item, value in entries(base).items())
                cells.append(shown(for_all, per_room) if same else "other frozen results")
            lines.append([name, *cells])
    if lines:
        print(f"\nadapter per room minus one adapter for all, {FEW} views\n")
        print(table(("", *(NAMES[metric] for metric in METRICS)), lines))
    lines = []
    for name, rows in folders.items():
        for dataset in dict.fromkeys(row.dataset for row in choose(rows, metric="mse")):
            found = choose(rows, dataset=dataset, metric="mse", views=FEW)
            values = [choose(found, variant=f"features-{kind}") for kind in ("frozen", "adapted")]
            if all(values):
                cells = [f"{mean(value):.3f}" for value in values]
                lines.append([f"{name}: {short_name(dataset)}", *cells, interval(changes(*values))])
    if lines:
        print("\ndistance (MSE) of features of 4 views to those of 8\n")
        print(table(("", "frozen", "adapted", "difference"), lines))


def changes(before: list[Row], after: list[Row]) -> np.ndarray:
    """Differences in the rooms and seeds of both."""
    old, new = entries(before), entries(after)
    return np.array([new[item] - old[item] for item in old if item in new])


def side_by_side(folders: dict[str, list[Row]]) -> None:
    """Print the change by adaptation in each folder."""
    first = next(iter(folders.values()))
    lines = []
    for dataset in dict.fromkeys(row.dataset for row in first):
        for views in sorted({row.views for row in first}):
            for metric in METRICS:
                found = [gain(rows, views, metric, dataset=dataset) for rows in folders.values()]
                cells = [shown(frozen, adapted) for frozen, adapted, _ in found]
                lines.append([f"{short_name(dataset)}, {views} views, {NAMES[metric]}", *cells])
    print(table(("", *folders), lines))


def main() -> None:
    """Read the folders and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--side-by-side", action="store_true")
    options = parser.parse_args()
    names = in_order(file.parent.name for file in options.folder.glob(f"*/{LINES_FILE}"))
    folders = {name: read_results(options.folder / name) for name in names}
    side_by_side(folders) if options.side_by_side else report(folders)


if __name__ == "__main__":
    main()
