"""Disturb commands: full and read-only disks, files that vanish, signals, clocks, locks; each ends in one sentence.

`python -m torture.faults [COMMAND ...] [--kinds KIND ...] [--points N]`, in the folder of the tests, prints a table.

A fault begins at one of N moments, spread evenly over all changes of files that the command makes. What has to come of
it: exit code 0, or one sentence and another exit code; no traceback; no file under its final name whose content an
undisturbed run never gives it. Then the fault is over, and the same command has to end as if never disturbed.
"""

from __future__ import annotations

import argparse
import errno
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from freegeo.adaptation.state import UNFINISHED_FILE
from freegeo.files import LEDGER_FILE, RUN_FILE, is_part
from torture.commands import COMMANDS, Ended, Place, laid_out, tree
from torture.crash import CHANGES

ENDS = (0, 1, 2, 3, 130, 143)
"""Exit codes of a disturbed command: done, failed, refused, partly done, and after the two signals."""


@dataclass
class Outcome:
    """What came of a kind of fault."""

    cases: int = 0
    done: int = 0
    """Cases that the fault did not hinder."""
    faults: list[str] = field(default_factory=list)


@dataclass
class Watched:
    """What a command does when nothing disturbs it."""

    changes: int
    """Number of changes of files, files opened for writing included."""
    seen: dict[str, set[str]]
    """All contents that each file has at some time, as `tree` returns them."""


def on_write(place: Place, then: Callable[[], None]) -> None:
    """Call a function before each change of a file or folder in the work folder, and before one is opened to write."""
    inside, busy = str(place.work), [False]

    def hook(event: str, arguments: tuple) -> None:
        if busy[0] or (event not in CHANGES and event != "open"):
            return
        if event == "open" and (isinstance(arguments[0], int) or not arguments[2] & (os.O_WRONLY | os.O_RDWR)):
            return
        if os.path.abspath(os.fsdecode(arguments[0])).startswith(inside):  # noqa: PTH100
            busy[0] = True
            try:
                then()
            finally:
                busy[0] = False

    sys.addaudithook(hook)


def watched(place: Place) -> Watched:
    """Look at an undisturbed run."""
    notes = place.root / "notes"
    notes.mkdir()

    def note() -> None:
        content = "\n".join(f"{digest} {name}" for name, digest in tree(place.work).items())
        (notes / f"{time.time_ns()}").write_text(content)

    place.lay_out()
    place.run(lambda: on_write(place, note))
    seen: dict[str, set[str]] = {name: {digest} for name, digest in place.files.items()}
    for file in notes.iterdir():
        for line in file.read_text().splitlines():
            digest, _, name = line.partition(" ")
            seen.setdefault(name, set()).add(digest)
    return Watched(len(list(notes.iterdir())), seen)


def at(place: Place, number: int, then: Callable[[], object], *, stays: bool = False) -> Callable[[], None]:
    """Return what does something at the k-th change after it was called, and, where that `stays`, at all later ones."""
    count = [0]

    def look() -> None:
        count[0] += 1
        if count[0] == number or (stays and count[0] > number):
            then()

    return lambda: on_write(place, look)


def refuse(number: int) -> None:
    """Fail as the system does."""
    raise OSError(number, os.strerror(number))


def scarce_handles(share: float) -> None:
    """Leave this process no handles beyond those that it has, or a few."""
    # Looking takes one.
    used, most = len(os.listdir("/proc/self/fd")) - 1, resource.getrlimit(resource.RLIMIT_NOFILE)[1]  # noqa: PTH208
    resource.setrlimit(resource.RLIMIT_NOFILE, (used + round(12 * share), most))


def clock_goes_back() -> None:
    """Let each look at the clock show an hour earlier than the last."""
    plain, looks = time.time, [0]

    def earlier() -> float:
        looks[0] += 1
        return plain() - 3600 * looks[0]

    time.time = earlier


def no_locks(number: int) -> None:
    """Make locking fail, as on some network file systems."""
    import fcntl

    fcntl.flock = lambda *arguments: refuse(number)


def _disturb(place: Place, kind: str, number: int, changes: int) -> Callable[[], None]:
    """Return what the process of the command does before it, for the fault to come at a change."""
    match kind:
        case "no space" | "read-only" | "no permission":
            code = {"no space": errno.ENOSPC, "read-only": errno.EROFS, "no permission": errno.EACCES}[kind]
            return at(place, number, partial(refuse, code), stays=True)
        case "handles":
            return partial(scarce_handles, number / changes)
        case "output gone" | "input gone":
            # What the command itself puts there, such as generated rooms in `data`, is none of its inputs.
            given = [name for name in ("photos", "scenes", "data") if (place.root / "inputs" / name).exists()]
            names = [_output(place).name] if kind == "output gone" else given
            return at(place, number, lambda: [shutil.rmtree(place.work / name, ignore_errors=True) for name in names])
        case "SIGINT" | "SIGTERM":
            return at(place, number, lambda: os.kill(os.getpid(), signal.Signals[kind]))
        case "clock":
            return clock_goes_back
        case "no locks":
            return partial(no_locks, errno.ENOLCK if number == 1 else errno.EOPNOTSUPP)
    raise ValueError(kind)


KINDS = (
    "no space", "small disk", "read-only", "no permission", "handles", "output gone", "input gone", "SIGINT", "SIGTERM",
    "two at once", "clock", "old inputs", "no locks",
)  # fmt: skip
TWICE = {"clock", "old inputs", "no locks"}
"""Kinds that two cases cover."""


def try_kind(place: Place, kind: str, known: Watched, points: int, outcome: Outcome) -> None:
    """Try a kind of fault at so many moments."""
    count = min(2 if kind in TWICE else points, known.changes)
    for case in range(count):
        number = 1 + case * (known.changes - 1) // max(1, count - 1)
        when = f"{kind}, change {number} of {known.changes}"
        place.lay_out()
        outcome.cases += 1
        if kind == "two at once":
            _two_at_once(place, place.seconds * case / count, when, outcome)
            continue
        if kind == "small disk":
            _on_small_disk(place, (case + 1) / (count + 1), when, known, outcome)
            continue
        if kind == "old inputs":
            _change_times(place.work, (0, 2**31)[case])
            disturb = lambda: None  # noqa: E731
        else:
            disturb = _disturb(place, kind, case + 1 if kind in TWICE else number, known.changes)
        _look_at(place, place.run(disturb), when, known, outcome)
        _again(place, when, outcome)


def _look_at(place: Place, ended: Ended, when: str, known: Watched, outcome: Outcome) -> None:
    """Judge the end of a disturbed command, and what it left."""
    lines = ended.said.strip().splitlines()
    last = lines[-1] if lines else ""
    if ended.code == 0:
        outcome.done += 1
    elif ended.code not in ENDS or "Traceback" in ended.said or not last.startswith("freegeo: ") or ".part" in last:
        outcome.faults.append(f"{when}: code {ended.code}, {last[:200]}")
    # Their times, warnings and lists depend on what happened.
    names = {RUN_FILE, LEDGER_FILE, UNFINISHED_FILE, "reconstruction.json", "report.html", "index.html", "batch.json"}
    if "could not be computed" in ended.said:
        names |= {"results.csv", "results.jsonl"}
    for name, digest in tree(place.work).items():
        path = Path(name)
        # Without its photos an export is another one, and says so.
        whole = "input gone" not in when and not any(map(is_part, (path, *path.parents))) and path.name not in names
        if whole and name in known.seen and digest not in known.seen[name]:
            outcome.faults.append(f"{when}: {name} is half-written")


def _again(place: Place, when: str, outcome: Outcome) -> None:
    """Carry out the same command without the fault; what was taken away of the inputs is put back."""
    if "output gone" in when and (ledger := place.root / "inputs" / _output(place).name / LEDGER_FILE).exists():
        shutil.copytree(ledger.parent, _output(place), dirs_exist_ok=True)
    for path in (place.root / "inputs").rglob("*"):
        there = place.work / path.relative_to(place.root / "inputs")
        if not there.exists():
            there.mkdir() if path.is_dir() else shutil.copy2(path, there)
    ended = place.run()
    if ended.code != 0:
        last = (ended.said.strip().splitlines() or ["nothing said"])[-1]
        outcome.faults.append(f"{when}: the same command again: code {ended.code}, {last[:200]}")
    elif odd := place.difference():
        outcome.faults.append(f"{when}: the same command again: {odd}")


def _two_at_once(place: Place, delay: float, when: str, outcome: Outcome) -> None:
    """Start the same command twice; one writes, the other one is refused, or finds the work done."""
    first = place.start()
    time.sleep(delay)
    second = place.run(said="said by the second")
    codes = [place.ended(first).code, second.code]
    fine = codes.count(0) >= 1 and all(code in (0, 1, 2) for code in codes) and "Traceback" not in second.said
    if not fine:
        outcome.faults.append(f"{when}: codes {codes}, {second.said.strip()[-200:]}")
    elif odd := place.difference():
        outcome.faults.append(f"{when}: {odd}")
    outcome.done += codes == [0, 0]


def _change_times(folder: Path, seconds: int) -> None:
    for path in folder.rglob("*"):
        os.utime(path, (seconds, seconds))


def _output(place: Place) -> Path:
    return place.work / ("result" if place.name.endswith("-inside") else "out")


def _on_small_disk(place: Place, share: float, when: str, known: Watched, outcome: Outcome) -> None:
    """Carry out the command where its output, but not all of it, finds room; then enlarge the disk."""
    output = _output(place)
    start = tree(output) if output.exists() else {}
    needed = sum(_pages(place.whole / output.name / name) for name in known_names(place)) or 1
    used = sum(_pages(output / name) for name in start if not name.endswith("/"))
    with disk(output, 8192 + used + round((needed - used) * share)) as enlarge:
        ended = place.run()
        _look_at(place, ended, when, known, outcome)
        enlarge()
        _again(place, when, outcome)


def known_names(place: Place) -> list[str]:
    """Return the names of the output's files after an undisturbed run."""
    below = f"{_output(place).name}/"
    return [name.removeprefix(below) for name in place.files if name.startswith(below) and not name.endswith("/")]


def _pages(path: Path) -> int:
    return -(-path.stat().st_size // 4096) * 4096 if path.is_file() else 0


@contextmanager
def disk(folder: Path, size: int) -> Iterator[Callable[[], None]]:
    """Mount a disk of so many bytes over a folder, with what is in the folder; gives what enlarges it."""
    before = folder.with_name("before")
    if folder.exists():
        shutil.copytree(folder, before)
    folder.mkdir(exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], check=True, capture_output=True)
    try:
        if before.exists():
            shutil.copytree(before, folder, dirs_exist_ok=True)
            shutil.rmtree(before)
        yield lambda: subprocess.run(["mount", "-o", "remount,size=256m", folder], check=True) and None
    finally:
        subprocess.run(["umount", folder], check=True)


def can_mount() -> bool:
    """Whether this process may mount a disk."""
    with tempfile.TemporaryDirectory() as place:
        try:
            with disk(Path(place), 65536):
                return True
        except (OSError, subprocess.CalledProcessError):
            return False


def disturb(root: Path, name: str, kinds: tuple[str, ...], points: int) -> dict[str, Outcome]:
    """Try kinds of faults on a command, below an empty folder."""
    place = laid_out(root, name)
    known = watched(place)
    outcomes = {}
    for kind in kinds:
        outcomes[kind] = Outcome()
        try_kind(place, kind, known, points, outcomes[kind])
    return outcomes


def main() -> None:
    """Print a table of outcomes, with the faults below each command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commands", nargs="*", choices=[*COMMANDS, []], metavar="COMMAND", help=", ".join(COMMANDS))
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--points", type=int, default=10, help="moments per kind")
    options = parser.parse_args()
    kinds = tuple(options.kinds)
    if "small disk" in kinds and not can_mount():
        print("small disk: left out, mounting is not allowed here (run as root).")
        kinds = tuple(kind for kind in kinds if kind != "small disk")
    print(f"{'command':16}{'kind':16}{'cases':>8}{'unhindered':>12}{'failures':>10}", flush=True)
    bad = 0
    for name in options.commands or COMMANDS:
        with tempfile.TemporaryDirectory() as root:
            for kind, o in disturb(Path(root).resolve(), name, kinds, options.points).items():
                print(f"{name:16}{kind:16}{o.cases:8}{o.done:12}{len(o.faults):10}", flush=True)
                for fault in o.faults:
                    print(f"  {fault}", flush=True)
                bad += len(o.faults)
    sys.exit(bad > 0)


if __name__ == "__main__":
    main()
