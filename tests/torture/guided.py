"""Damage files by what the readers' code does with them: libFuzzer, through atheris, which is no dependency of freegeo.

`python -m torture.guided READER [SECONDS] [SEED]`, in the folder of the tests and an environment with atheris, prints
each new fault once, and counts at the end; it ends with code 1 where there was a fault. Half of the mutations are
libFuzzer's own, which keeps what reaches new lines of freegeo; the others are those of `torture.fuzz`.
"""

from __future__ import annotations

import os
import random
import resource
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["freegeo"]):
    from freegeo.errors import FreeGeoError
    from torture.fuzz import LIMIT_S, MORE_MEMORY, described, mutated, quiet, sentence_fault
    from torture.readers import READERS


def main() -> None:
    """Read files that libFuzzer makes of a sound one, until the time is over."""
    name, seconds, seed = (sys.argv[1:] + ["", "300", "0"][len(sys.argv) - 1 :])[:3]
    reader = next(reader for reader in READERS if reader.name == name)
    folder = Path(tempfile.mkdtemp())
    victim = reader.write(folder / "files")
    reader.read(victim)
    before = folder / f"before{victim.suffix}"
    (folder / "corpus").mkdir()
    (folder / "corpus" / "sound").write_bytes(victim.read_bytes())
    counts, faults = Counter(), Counter()

    def case(data: bytes) -> None:
        if time.monotonic() > end:
            print(f"{name}: {dict(counts)}, {faults.total()} faults of {len(faults)} kinds", flush=True)
            os._exit(bool(faults))
        victim.write_bytes(data)
        fault = None
        try:
            with warnings.catch_warnings(action="ignore"):
                reader.read(victim)
            counts["read"] += 1
        except FreeGeoError as error:
            counts["refused"] += 1
            fault = sentence_fault(error)
        except Exception as error:
            fault = described(error)
        if fault:
            if not faults[fault]:
                print(f"{name}: {fault}", flush=True)
            faults[fault] += 1

    def change(data: bytes, most: int, number: int) -> bytes:
        rng = random.Random(number)
        if rng.random() < 0.5:
            return atheris.Mutate(data, most)
        before.write_bytes(data)
        try:
            return mutated(before, rng)[:most]
        except Exception:  # what an earlier change left is no file of its kind any more
            return atheris.Mutate(data, most)

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + MORE_MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))
    end = time.monotonic() + float(seconds)
    options = [f"-seed={int(seed) + 1}", f"-timeout={LIMIT_S:.0f}", "-rss_limit_mb=0"]
    options += ["-verbosity=0", f"-max_len={4 * victim.stat().st_size + 4096}", str(folder / "corpus")]
    atheris.Setup([sys.argv[0], *options], case, custom_mutator=change)
    with quiet():
        atheris.Fuzz()


if __name__ == "__main__":
    main()
