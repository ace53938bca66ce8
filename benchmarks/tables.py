"""Make every table of docs/ again that rests on the embedded model.

    python benchmarks/tables.py [PART...] [-o out/tables] [--minutes M]
    python benchmarks/tables.py --list

Parts come in order of importance, and each is a list of commands that run one after the other, in processes of their
own, with one thread. After each command the part's table is written to FOLDER.md in the output folder, in the form that
the pages have; its first line says how many of the commands it rests on. The same call goes on where a stopped one
was: a command that was finished is not repeated, and one that was not continues by itself where it can (its own
docstring says so). Parts of different folders may run at the same time.

A folder of results belongs to one weight file, whose SHA-256 is in FOLDER.json, and to the commands of this file: what
was made with other weights or by a command that has changed since is refused, never mixed in or removed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
WEIGHTS = ROOT / "src" / "freegeo" / "models" / "weights" / "freegeo-tiny.safetensors"
Command = tuple[str, ...]
"""Words of a command. The first may be `freegeo` or a script of this folder. {out} is the folder of the part, {data}
that of rendered rooms."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """Some tables of the documentation."""

    folder: str
    """Where its results lie, below the output folder, and the name of its table. Parts may share it."""
    pages: tuple[str, ...]
    """Files below docs/ that show the numbers, with the section if it is not all of the page."""
    minutes: float
    """Rough cost on one core."""
    steps: tuple[Command, ...]
    table: Command
    """Its standard output is the table; it works with the results of some of the steps, too."""


def words(*lines: str) -> tuple[Command, ...]:
    """Commands written as lines."""
    return tuple(tuple(line.split()) for line in lines)


def each(line: str, values: Iterable[object]) -> tuple[Command, ...]:
    """A command for each value, which takes the place of {}."""
    return words(*(line.replace("{}", str(value)) for value in values))


CARD = ("test-id", "light", "lowtex", "tex", "big", "sparse", "lens")
KNOWN = ("test-id", "big", "sparse")
TEST = ("test-id", "tex", "big", "sparse", "light")
STUDY = f"-o {{out}}/rooms --domains {' '.join(TEST)} --rooms 1 --start {{}} --seed 44"
"""One room of each domain is a command, so that what is there of a study that was stopped is even."""
RATE = "--hold 1 --lr 1e-3"
"""Of one adapter for 60 rooms; chosen on validation rooms (part `rate`)."""
PER_SCENE = "--recipe scene --adapt-per scene --hold 1"
RATES = {
    "1e-3-hold-1": "--hold 1 --lr 1e-3",
    "2e-3-hold-1": "--hold 1 --lr 2e-3",
    "4e-3-hold-1": "--hold 1 --lr 4e-3",
}


def gain(folder: str, domain: str, rooms: int, settings: str, tables: str = "gain") -> tuple[Command, ...]:
    """What adaptation gains in rooms of one domain: 4 and 8 views, then all 16."""
    run = f"freegeo bench run {tables} --data {{data}} -o {{out}}/{folder} --datasets procedural-{domain}"
    run = f"{run} --scenes {rooms} {settings}"
    return words(f"{run} --views 4,8 --seeds 43,44,45", f"{run} --views 16 --seeds 43")


GAIN = "results/README.md#does-adaptation-help-gain"
PARTS: dict[str, Part] = {
    "card": Part(
        folder="card",
        pages=("embedded-model.md#quality-on-rooms-never-seen-in-training", "results/README.md#where-the-gap-is"),
        minutes=30,
        steps=each("freegeo models score freegeo-tiny --domains {} -o {out}/{}.json", CARD),
        table=("cards.py", "{out}"),
    ),
    "cameras": Part(
        folder="cameras",
        pages=("embedded-model.md#known-cameras",),
        minutes=22,
        steps=words(
            "freegeo models score freegeo-tiny --cameras --domains test-id -o {out}/test-id.json",
            "freegeo models score freegeo-tiny --cameras --domains big -o {out}/big.json",
            "freegeo models score freegeo-tiny --cameras --domains sparse -o {out}/sparse.json",
        ),
        table=("cards.py", "{out}", "--cameras"),
    ),
    "known-cameras": Part(
        folder="known-cameras",
        pages=("scale.md#what-known-cameras-are-worth",),
        minutes=35,
        steps=(
            *each("known_cameras.py --domains {} --rooms 34 --steps 0 --out {out}/{}.json", KNOWN),
            *each("known_cameras.py --domains {} --rooms 3 --first 40 --views 8 --out {out}/adapted/{}.json", KNOWN),
        ),
        table=("known_cameras.py", "--report", "{out}"),
    ),
    "guard": Part(
        folder="guard",
        pages=("guard.md#what-it-is-worth-generated-rooms", "adapting.md#when-it-did-not-help"),
        minutes=70,
        steps=each(f"guard.py record {STUDY}", range(8)),
        table=("guard.py", "report", "{out}/rooms"),
    ),
    "gain": Part(
        folder="gain",
        pages=(GAIN, "results/gain/"),
        minutes=60,
        steps=tuple(step for domain in ("big", "sparse") for step in gain(domain, domain, 60, RATE, "gain features")),
        table=("gain.py", "{out}"),
    ),
    "gain-more": Part(
        folder="gain",
        pages=(GAIN, "results/gain/"),
        minutes=32,
        steps=tuple(step for domain in ("tex", "light") for step in gain(domain, domain, 40, RATE)),
        table=("gain.py", "{out}"),
    ),
    "gain-per-scene": Part(
        folder="gain",
        pages=("results/README.md#one-adapter-per-scene", "results/gain/"),
        minutes=42,
        steps=(
            *gain("sparse-per-scene", "sparse", 16, PER_SCENE),
            *gain("big-per-scene", "big", 12, PER_SCENE),
        ),
        table=("gain.py", "{out}"),
    ),
    "refine": Part(
        folder="refine",
        pages=("refinement.md#measured",),
        minutes=20,
        steps=(
            *each("refine.py rooms --domains {} --rooms 40 --out {out}/8/{}.json", TEST),
            *each("refine.py rooms --domains {} --rooms 16 --views 16 --out {out}/16/{}.json", TEST),
        ),
        table=("refine.py", "report", "{out}"),
    ),
    "evidence-recipe": Part(
        folder="evidence-recipe",
        pages=("guard.md#learning-from-the-matches",),
        minutes=45,
        steps=each(f"evidence_recipe.py record {STUDY}", range(3)),
        table=("evidence_recipe.py", "report", "{out}/rooms"),
    ),
    "sequences": Part(
        folder="sequences",
        pages=("sequences.md#measured", "figures/sequence-memory.png"),
        minutes=40,
        steps=words(
            "sequences.py chunks --seed 20000100 --out {out}/1-chunks.json --work {out}/work",
            "sequences.py exact --out {out}/2-exact.json --work {out}/work",
            "sequences.py walk --out {out}/3-walk.json --work {out}/work",
            "sequences.py walk --refine --out {out}/4-walk-refined.json --work {out}/work",
            "sequences.py memory --out {out}/5-memory.json --work {out}/work",
            "sequences.py video --out {out}/6-video.json --work {out}/work",
        ),
        table=("sequences.py", "report", "--out", "{out}"),
    ),
    "seams": Part(
        folder="seams",
        pages=("sequences.md#seams",),
        minutes=5,
        steps=words(
            "seams.py --rooms 3 --first 6 -o {out}/1-others.json",
            "seams.py --rooms 6 --first 0 -o {out}/2-limits-set-on.json",
        ),
        table=("seams.py", "--report", "{out}"),
    ),
    "order": Part(
        folder="order",
        pages=("sequences.md#order", "sequences.md#loops"),
        minutes=5,
        steps=words("sequence.py --out {out}/sequence.json"),
        table=("sequence.py", "--report", "--out", "{out}/sequence.json"),
    ),
    "windows": Part(
        folder="windows",
        pages=("sequences.md#adaptation",),
        minutes=24,
        steps=each("sequence_windows.py -o {out}/windows.jsonl --rooms 1 --start {}", range(2)),
        table=("sequence_windows.py", "-o", "{out}/windows.jsonl", "--rooms", "0"),
    ),
    "choices": Part(
        folder="choices",
        pages=("photos.md#the-size-that-the-model-sees", "embedded-model.md#model-card"),
        minutes=5,
        steps=words("choices.py --rooms 24 --out {out}/choices.json"),
        table=("choices.py", "--report", "--out", "{out}/choices.json"),
    ),
    "features": Part(
        folder="features",
        pages=("embedded-model.md#facts-for-adaptation",),
        minutes=2,
        steps=words("features.py --out {out}/features.json"),
        table=("features.py", "--report", "--out", "{out}/features.json"),
    ),
    "rays": Part(
        folder="rays",
        pages=("models/da3.md#cameras-from-rays",),
        minutes=5,
        steps=words("rays.py --out {out}/rays.json"),
        table=("rays.py", "--report", "--out", "{out}/rays.json"),
    ),
    "two-heads": Part(
        folder="two-heads",
        pages=("guard.md#what-it-does-not-do",),
        minutes=12,
        steps=each(
            "two_heads.py record -o {out}/rooms --domains test-id tex big sparse --rooms 1 --start {} --seed 44",
            range(2),
        ),
        table=("two_heads.py", "report", "{out}/rooms"),
    ),
    "quick": Part(
        folder="quick",
        pages=("results/README.md#every-experiment-once-small-quick", "results/quick/"),
        minutes=25,
        steps=words("freegeo bench run all --quick --data {data} -o {out}/bench"),
        table=("gain.py", "{out}"),
    ),
    "rate": Part(
        folder="rate",
        pages=("results/README.md#the-fifth-version-so-far",),
        minutes=21,
        steps=words(
            *(
                f"freegeo bench run gain --data {{data}} -o {{out}}/{name} {settings} --scenes 16 --views 4,8"
                " --seeds 43 --datasets procedural-val-big,procedural-val-sparse"
                for name, settings in RATES.items()
            )
        ),
        table=("gain.py", "{out}", "--side-by-side"),
    ),
}
"""In order of importance."""


def command_of(step: Command, out: Path, part: Part) -> list[str]:
    """What is executed for a step."""
    first, *rest = (word.replace("{out}", str(out / part.folder)).replace("{data}", str(out / "data")) for word in step)
    if first == "freegeo":
        return [sys.executable, "-m", "freegeo.cli.app", *rest]
    if first.endswith(".py"):
        return [sys.executable, str(ROOT / "benchmarks" / first), *rest]
    return [first, *rest]


def environment() -> dict[str, str]:
    """One thread, and the package of this tree."""
    paths = [str(ROOT / "src"), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(filter(None, paths))}


def hash_of(weights: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(weights.read_bytes()).hexdigest()


def note_of(folder: Path) -> Path:
    """Where the hash of the weights and the seconds of every finished step are."""
    return folder.with_name(f"{folder.name}.json")


def finished(folder: Path) -> dict[str, float]:
    """Seconds of every finished step of a folder, by its words."""
    note = note_of(folder)
    return json.loads(note.read_text(encoding="utf-8"))["seconds"] if note.is_file() else {}


def steps_of(folder: str, parts: Mapping[str, Part]) -> list[str]:
    """The words of all steps whose results lie in a folder."""
    return [" ".join(step) for part in parts.values() if part.folder == folder for step in part.steps]


def why_refused(folder: Path, weights: str, steps: Sequence[str]) -> str | None:
    """Why a folder's results must not be used with these weights and steps, or None."""
    note = note_of(folder)
    if note.is_file():
        other = json.loads(note.read_text(encoding="utf-8"))["weights"]
        if other != weights:
            return f"{folder}: made with other weights (SHA-256 {other[:12]}, the package has {weights[:12]})"
        if strange := sorted(set(finished(folder)) - set(steps)):
            return f"{folder}: made by a command that is none of its part any more: {strange[0]}"
    elif folder.is_dir() and any(folder.iterdir()):
        return f"{folder}: nothing says which weights it was made with"
    return None


def write(path: Path, text: str) -> None:
    """Write a file that appears whole."""
    half = path.with_name(f".{path.name}")
    half.write_text(text, encoding="utf-8")
    half.replace(path)


def keep(folder: Path, weights: str, seconds: Mapping[str, float]) -> None:
    """Note what is finished."""
    folder.mkdir(parents=True, exist_ok=True)
    write(note_of(folder), json.dumps({"weights": weights, "seconds": seconds}, indent=1) + "\n")


def listing(parts: Mapping[str, Part]) -> str:
    """The parts, what they cost, the file with their table, and the pages that it feeds."""
    width = max(map(len, parts))
    lines = [
        f"{name:{width}}  {part.minutes:4.0f} min  {part.folder}.md: {', '.join(part.pages)}"
        for name, part in parts.items()
    ]
    total = sum(part.minutes for part in parts.values())
    return "\n".join([*lines, f"{'all':{width}}  {total:4.0f} min on one core"])


def main(arguments: Sequence[str] | None = None, parts: Mapping[str, Part] = PARTS, weights: Path = WEIGHTS) -> int:
    """Run parts; returns the exit code: 1 when a command failed, 2 for results of other weights."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(parts)}; default: all")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/tables"))
    parser.add_argument("--minutes", type=float, default=float("inf"), help="no command begins after so long")
    parser.add_argument("--list", action="store_true", help="say what there is, where it is shown, what it costs")
    options = parser.parse_args(arguments)
    if unknown := set(options.parts) - set(parts):
        parser.error(f"unknown part {', '.join(sorted(unknown))}; choose among {', '.join(parts)}")
    chosen = {name: part for name, part in parts.items() if not options.parts or name in options.parts}
    if options.list:
        print(listing(chosen))
        return 0
    out, fingerprint = options.output.resolve(), hash_of(weights)
    folders = dict.fromkeys(part.folder for part in chosen.values())
    reasons = (why_refused(out / folder, fingerprint, steps_of(folder, parts)) for folder in folders)
    if refused := list(filter(None, reasons)):
        advice = "Remove folder and .json file, or choose another place with -o."
        print(*refused, advice, sep="\n", file=sys.stderr)
        return 2
    until, failed = time.monotonic() + 60 * options.minutes, []
    for name, part in chosen.items():
        for number, step in enumerate(part.steps, 1):
            key = " ".join(step)
            if key in finished(out / part.folder):
                continue
            label = f"{name}, {number} of {len(part.steps)}"
            if time.monotonic() >= until:
                print(f"{label}: no time left", flush=True)
                break
            keep(out / part.folder, fingerprint, finished(out / part.folder))
            started = time.monotonic()
            code = run(step, out, part)
            seconds = round(time.monotonic() - started, 1)
            if hash_of(weights) != fingerprint:
                print(f"{label}: {weights} changed meanwhile; remove {out / part.folder}", file=sys.stderr)
                return 2
            print(f"{label}: {f'failed with {code}' if code else 'done'} after {seconds:.0f} s", flush=True)
            if code:
                failed.append(name)
                break
            keep(out / part.folder, fingerprint, finished(out / part.folder) | {key: seconds})
            failed += [] if write_table(out, part, parts, fingerprint) else [name]
        else:
            if not (out / f"{part.folder}.md").is_file():
                failed += [] if write_table(out, part, parts, fingerprint) else [name]
            print(f"{name}: everything is finished, {out / part.folder}.md", flush=True)
    return 1 if failed else 0


def run(step: Command, out: Path, part: Part) -> int:
    """Carry out a step in the folder of its part; what it says comes through."""
    return subprocess.run(command_of(step, out, part), cwd=out / part.folder, env=environment(), check=False).returncode


def write_table(out: Path, part: Part, parts: Mapping[str, Part], weights: str) -> bool:
    """Write the table of what is finished; returns whether it could be made."""
    steps = steps_of(part.folder, parts)
    there = sum(step in finished(out / part.folder) for step in steps)
    made = subprocess.run(
        command_of(part.table, out, part), cwd=out / part.folder, env=environment(), stdout=subprocess.PIPE, text=True,
        check=False,
    )  # fmt: skip
    if made.returncode:
        print(f"{part.folder}: its table failed with {made.returncode}", file=sys.stderr)
        return False
    head = f"<!-- {part.folder}: {there} of {len(steps)} commands, weights {weights[:12]} -->"
    write(out / f"{part.folder}.md", f"{head}\n\n{made.stdout}")
    return True


if __name__ == "__main__":
    # A stopped call takes the command that it runs with it.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    sys.exit(main())
