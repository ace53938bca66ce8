"""Kill commands at every change of a file, and at random moments; the same command then has to end as if never stopped.

`python -m torture.crash [COMMAND ...] [--kills N] [--every N] [--seed S]`, in the folder of the tests, prints a table.

Points: before each rename, removal and new folder, by the command or one of its workers, its work folder is copied:
this is what a process that is killed at that moment leaves behind. The command is then carried out on each copy.
Kills: the command is killed (SIGKILL, its whole process group) after a random time, and started again on what is left,
until so many kills, and as many completions as `COMPLETIONS`, have come together.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from torture.commands import COMMANDS, Ended, Place, laid_out

CHANGES = frozenset({"os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.truncate", "os.link", "os.symlink"})
"""Audit events of changes of files and folders; raised before the change."""
COMPLETIONS = 5


@dataclass
class Outcome:
    """What came of a command."""

    points: int = 0
    kills: int = 0
    completions: int = 0
    faults: list[str] = field(default_factory=list)


def on_change(place: Place, then: Callable[[str], None]) -> None:
    """Call a function before each change of a file in the work folder, in this process and those that it forks."""
    inside, busy = str(place.work), [False]

    def hook(event: str, arguments: tuple) -> None:
        if event not in CHANGES or busy[0]:
            return
        # A name beside an open folder, as in `rmtree`, is in the work folder: nothing else is removed.
        path = os.path.abspath(os.fsdecode(arguments[0]))  # noqa: PTH100
        if path.startswith(inside):
            busy[0] = True
            try:
                then(f"{event} {os.path.relpath(path, inside)}")
            finally:
                busy[0] = False

    sys.addaudithook(hook)


def points(place: Place, every: int, outcome: Outcome) -> None:
    """Carry out the command on what a kill at every so many changes of a file leaves behind."""
    copies = place.root / "copies"
    copies.mkdir()

    def copy(change: str) -> None:
        target = copies / f"{time.time_ns()}"
        shutil.copytree(place.work, target, symlinks=True)
        target.with_suffix(".txt").write_text(change)

    place.lay_out()
    place.run(lambda: on_change(place, copy))
    before = None
    for number, left in enumerate(sorted(path for path in copies.iterdir() if path.is_dir())):
        now = {path: path.stat().st_size for path in left.rglob("*")}
        now = {path.relative_to(left): size for path, size in now.items()}
        if number % every == 0 and now != before:
            place.lay_out(left)
            outcome.points += 1
            _judge(place, place.run(), left.with_suffix(".txt").read_text(), outcome)
        before = now
        shutil.rmtree(left)


def kills(place: Place, count: int, seed: int, outcome: Outcome, completions: int = COMPLETIONS) -> None:
    """Kill the command at random moments, and go on with what is left."""
    rng = random.Random(f"{seed} {place.name}")
    place.lay_out()
    longest = place.seconds
    while outcome.kills < count or outcome.completions < completions:
        process = place.start()
        # Later and later, so that a command which begins anew after each kill would be noticed as one that never ends.
        time.sleep(rng.uniform(0, longest))
        os.killpg(process, signal.SIGKILL) if _is_there(process) else None
        ended = place.ended(process)
        if ended.code == -signal.SIGKILL:
            outcome.kills += 1
            longest *= 1.03
        else:
            _judge(place, ended, f"{outcome.kills} kills", outcome)
            outcome.completions += 1
            longest = place.seconds
            place.lay_out()


def _is_there(process: int) -> bool:
    try:
        os.killpg(process, 0)
    except ProcessLookupError:
        return False
    return True


def _judge(place: Place, ended: Ended, when: str, outcome: Outcome) -> None:
    if ended.code != 0:
        last = (ended.said.strip().splitlines() or ["nothing said"])[-1]
        outcome.faults.append(f"after {when}: code {ended.code}, {last[:200]}")
    elif odd := place.difference():
        outcome.faults.append(f"after {when}: {odd}")


def crash(
    root: Path, name: str, *, count: int, every: int = 1, seed: int = 0, completions: int = COMPLETIONS
) -> Outcome:
    """Try one command below an empty folder, with `count` random kills and every so many points (0: none).

    Ctrl-C ends it; what came of it by then is returned, with a fault that says so.
    """
    outcome = Outcome()
    place = laid_out(root, name)
    try:
        if every:
            points(place, every, outcome)
        if count:
            kills(place, count, seed, outcome, completions)
    except KeyboardInterrupt:
        outcome.faults.append("stopped by Ctrl-C before the end")
    return outcome


def main() -> None:
    """Print a table of outcomes, then the faults."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commands", nargs="*", choices=[*COMMANDS, []], metavar="COMMAND", help=", ".join(COMMANDS))
    parser.add_argument("--kills", type=int, default=50, help="random kills per command")
    parser.add_argument("--every", type=int, default=1, help="take every so many points; 0: none")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print(f"{'command':16}{'points':>8}{'kills':>8}{'completions':>13}{'failures':>10}{'seconds':>9}", flush=True)
    bad = 0
    for name in options.commands or COMMANDS:
        started = time.monotonic()
        with tempfile.TemporaryDirectory() as root:
            o = crash(Path(root).resolve(), name, count=options.kills, every=options.every, seed=options.seed)
        row = f"{name:16}{o.points:8}{o.kills:8}{o.completions:13}{len(o.faults):10}"
        print(f"{row}{time.monotonic() - started:9.0f}", flush=True)
        for fault in o.faults:
            print(f"  {fault}", flush=True)
        bad += len(o.faults)
    sys.exit(bad > 0)


if __name__ == "__main__":
    main()
