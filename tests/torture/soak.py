"""Adapt, export and write the report again and again in one process, and see that nothing grows.

`python -m torture.soak [COUNT] [--figure FILE]`, in the folder of the tests, prints memory, open files and threads of
twenty rounds, and draws those of all.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import freegeo
from freegeo.report.page import write_report
from torture.commands import photos

WARM_UP = 20
"""Rounds that fill caches and the pools of the allocators, and count for nothing."""
SIDE = 48
"""Pixels on the longer side of the photos for the model."""
MOST_MB = 0.1
"""Megabytes that a round may add, by the slope of all rounds after those."""


@dataclass(frozen=True)
class Used:
    """What this process holds."""

    megabytes: float
    """Resident memory."""
    handles: int
    threads: int


def used() -> Used:
    """Look at this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    megabytes = pages * os.sysconf("SC_PAGE_SIZE") / 2**20
    return Used(megabytes, len(os.listdir("/proc/self/fd")), threading.active_count())  # noqa: PTH208


def round_of(folder: Path, given: list, model) -> None:
    """Adapt to photos, predict, save the adapter and the result, export it and write its report."""
    out = folder / "round"
    adapted = freegeo.adapt(model, given, steps=2, sets=2, guard="off", process_res=SIDE)
    adapted.save(out / "adapter")
    result = freegeo.reconstruct(model, given, process_res=SIDE)
    result.save(out)
    result.export(out, ["ply", "glb", "tum"])
    write_report(out)
    adapted.adapter.detach()
    shutil.rmtree(out)


def soak(folder: Path, count: int) -> list[Used]:
    """Carry out so many rounds below an empty folder; returns what the process held after each."""
    photos(folder / "photos")
    given = freegeo.load_photos(folder / "photos")
    model = freegeo.load_model("freegeo-tiny")
    looks = []
    for _ in range(count):
        round_of(folder, given, model)
        looks.append(used())
    return looks


def growth(looks: list[Used]) -> dict[str, float]:
    """Return the slopes after the warm-up, per round."""
    after = looks[WARM_UP:]
    values = {name: [getattr(look, name) for look in after] for name in ("megabytes", "handles", "threads")}
    return {name: float(np.polyfit(range(len(after)), series, 1)[0]) for name, series in values.items()}


def draw(looks: Mapping[int, Used], path: Path) -> None:
    """Draw memory, open files and threads after rounds, by their number."""
    import matplotlib.pyplot as plt

    rounds, most = list(looks), max(look.handles for look in looks.values())
    figure, axes = plt.subplots(figsize=(5, 3.2), layout="constrained")
    lines = axes.plot(rounds, [look.megabytes for look in looks.values()], label="memory")
    counts = axes.twinx()
    lines += counts.plot(rounds, [look.handles for look in looks.values()], color="tab:orange", label="open files")
    lines += counts.plot(rounds, [look.threads for look in looks.values()], color="tab:green", label="threads")
    axes.set(xlabel="round", ylabel="resident memory (MB)", xlim=(0, rounds[-1]))
    axes.set_ylim(0, 1.2 * max(look.megabytes for look in looks.values()))
    counts.set(ylabel="open files, threads", ylim=(0, 4 * most))
    axes.legend(handles=lines, loc="center right")
    figure.savefig(path, dpi=100)


def main() -> None:
    """Print a table and the slopes; exit code 1 when something grows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("count", nargs="?", type=int, default=120)
    parser.add_argument("--figure", type=Path)
    options = parser.parse_args()
    count = options.count
    if count < 2 * WARM_UP:
        sys.exit(f"at least {2 * WARM_UP} rounds are needed.")
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        looks = soak(Path(folder), count)
    print(f"{'round':>6}{'MB':>9}{'handles':>9}{'threads':>9}")
    for number, look in enumerate(looks, 1):
        if number % max(1, count // 20) == 0 or number == 1:
            print(f"{number:6}{look.megabytes:9.1f}{look.handles:9}{look.threads:9}")
    if options.figure:
        draw(dict(enumerate(looks, 1)), options.figure)
    slopes = growth(looks)
    print(f"{count} rounds in {time.monotonic() - started:.0f} s; growth per round after {WARM_UP}: ", end="")
    print(", ".join(f"{value:+.4f} {name}" for name, value in slopes.items()))
    sys.exit(slopes["megabytes"] > MOST_MB or slopes["handles"] > 0.05 or slopes["threads"] > 0.05)


if __name__ == "__main__":
    main()
