"""Adapt, export and write the report again and again in one process, and see that nothing grows.

`python -m torture.soak [COUNT]`, in the folder of the tests, prints memory, open files and threads after each round.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import freegeo
from freegeo.report.page import write_report
from torture.commands import photos

WARM_UP = 20
"""Rounds that fill caches and the pools of the allocators, and count for nothing."""
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
    adapted = freegeo.adapt(model, given, steps=2, sets=2, guard="off")
    adapted.save(out / "adapter")
    result = freegeo.reconstruct(model, given)
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


def main() -> None:
    """Print a table and the slopes; exit code 1 when something grows."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 120
    if count < 2 * WARM_UP:
        sys.exit(f"at least {2 * WARM_UP} rounds are needed.")
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        looks = soak(Path(folder), count)
    print(f"{'round':>6}{'MB':>9}{'handles':>9}{'threads':>9}")
    for number, look in enumerate(looks, 1):
        if number % max(1, count // 20) == 0 or number == 1:
            print(f"{number:6}{look.megabytes:9.1f}{look.handles:9}{look.threads:9}")
    slopes = growth(looks)
    print(f"{count} rounds in {time.monotonic() - started:.0f} s; growth per round after {WARM_UP}: ", end="")
    print(", ".join(f"{value:+.4f} {name}" for name, value in slopes.items()))
    sys.exit(slopes["megabytes"] > MOST_MB or slopes["handles"] > 0.05 or slopes["threads"] > 0.05)


if __name__ == "__main__":
    main()
