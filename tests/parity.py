"""`make parity`: check a folder of recorded numbers, one line per case, non-zero exit when any failed.

The folder (FREEGEO_FIXTURES, default tests/fixtures) may hold any of the subfolders that a checker exists for.
"""

import importlib
import sys
import traceback
from pathlib import Path

from fixture_tools import FIXTURES

SUBFOLDERS = ("da3", "vggt", "pi3", "mapanything", "losses", "benchmark")


def run(root: Path) -> int:
    """Check every subfolder present; return the number of failed cases, and 1 when there was nothing to check."""
    failed = total = 0
    for name in SUBFOLDERS:
        if not (root / name).is_dir():
            continue
        for case, check in importlib.import_module(f"parity_{name}").cases(root / name):
            error = measured(check)
            total += 1
            failed += not error <= 1
            print(f"{name}.{case}: error {error:.3g} of the tolerance {'ok' if error <= 1 else 'FAILED'}", flush=True)
    print(f"{total - failed} passed, {failed} failed in {root}")
    return failed if total else 1


def measured(check) -> float:
    """Return the error of a case; a crash is an infinite one, with its traceback on stderr."""
    try:
        return float(check())
    except Exception:  # any crash is a failed case, and the others must still run
        traceback.print_exc()
        return float("inf")


if __name__ == "__main__":
    sys.exit(1 if run(FIXTURES) else 0)
