"""Damage every kind of file that freegeo reads, and report what is neither a result nor a sentence.

`python -m torture.fuzz [CASES] [SEED] [READER ...]`, in the folder of the tests, uses two processes and prints a table;
`test_fuzz.py` runs a part of it. Each case is one reader and one mutation, decided by seed, reader and number alone.
"""

from __future__ import annotations

import copy
import faulthandler
import json
import logging
import multiprocessing
import os
import random
import resource
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from freegeo.errors import FreeGeoError
from torture.readers import READERS, Reader

LIMIT_S = 20.0
"""Longest that a case may take."""
MORE_MEMORY = 1 << 30
"""Bytes of address space beyond those of the start that a case may take."""
ODD = (
    None, True, 0, -1, 1, 2**31, 2**63, 10**400, 1.5, float("nan"), float("inf"), "", "x", "..", "/etc/passwd", "\0",
    [], {}, [[]], [None], {"a": 1}, "1" * 5000, ["x"] * 3, -1e308, "1e999",
)  # fmt: skip
TEXTS = ("[" * 100_000, '{"a":' * 50_000, "9" * 5_000, "", "\ufeff{}", "null", "[]", "\ud800")
"""Texts that parsers of JSON stumble over, in the place of a whole file."""
SIDES = (0, 1, 2, 13, 255, 16_383, 60_000, 65_535, 2**31 - 1, 2**32 - 1)
DTYPES = ("?", "i1", "u1", "<i8", "<f2", "<f4", ">f8", "<c8", "<U3", "S2", "O", "<M8[s]", "V3", "<u8")
HUGE = ((1 << 33,), (1 << 62, 8), (-1,), (1 << 20, 1 << 14))
SHAPES = ((), (0,), (1,), (3,), (2, 0), (1, 1), (2, 3), (1, 4, 4), (3, 3, 3), (2, 2, 2, 2), (0, 0, 0))


NAMES = tuple(reader.name for reader in READERS)


class TooSlow(BaseException):
    """A case that takes too long; nothing that is tested may catch it."""


@dataclass
class Outcome:
    """What came of all cases of a reader."""

    cases: int = 0
    read: int = 0
    refused: int = 0
    seconds: float = 0.0
    """Of a processor."""
    faults: Counter = field(default_factory=Counter)
    """What went wrong, and how often."""


def flipped(data: bytes, rng: random.Random) -> bytes:
    """Change, remove, double or cut bytes."""
    content = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        place = rng.randrange(len(content)) if content else 0
        length = rng.choice((1, 1, 4, 16, 256))
        match rng.randrange(6):
            case 0:
                content[place : place + length] = rng.randbytes(length)
            case 1:
                del content[place : place + length]
            case 2:
                content[place:place] = content[place : place + length]
            case 3:
                content[place : place + length] = bytes(length)
            case 4:
                content[place : place + length] = b"\xff" * length
            case 5:
                if content:
                    content[place] ^= 1 << rng.randrange(8)
    return bytes(content[: rng.randrange(len(content) + 1)] if rng.random() < 0.15 else content)


def changed_json(data: bytes, rng: random.Random) -> bytes:
    """Replace, remove, add or double a value somewhere in a JSON text, or write a number of 5,000 digits there."""
    if rng.random() < 0.03:
        return rng.choice(TEXTS).encode("utf-8", "surrogatepass")
    text = json.dumps(changed_value(json.loads(data), rng))
    return (text.replace("1", "9" * 5_000, 1) if rng.random() < 0.03 else text).encode()


def changed_value(value: Any, rng: random.Random) -> Any:
    """Return a copy with one thing in it replaced, removed, added or doubled."""
    value = copy.deepcopy(value)
    places = list(_places(value))
    if not places or rng.random() < 0.05:
        return rng.choice(ODD)
    holder, key = rng.choice(places)
    match rng.randrange(5):
        case 0:
            del holder[key]
        case 1 if isinstance(holder, dict):
            holder[rng.choice(("x", "format", str(key) + "2"))] = rng.choice(ODD)
        case 1:
            holder.insert(key, copy.deepcopy(holder[key]))
        case _:
            holder[key] = copy.deepcopy(rng.choice(ODD))
    return value


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, part in list(items):
        yield value, key
        yield from _places(part)


def changed_lines(data: bytes, rng: random.Random) -> bytes:
    """Change one line of a file of JSON lines."""
    lines = data.splitlines()
    place = rng.randrange(len(lines))
    lines[place] = changed_json(lines[place], rng)
    return b"\n".join(lines) + b"\n"


def changed_words(data: bytes, rng: random.Random) -> bytes:
    """Change one word of a text, which may be followed by bytes."""
    words = data.split(b" ")
    place = rng.randrange(len(words))
    words[place] = str(rng.choice((*ODD[:15], "1e400", "--", "\n", "#", "nan", "é", "[" * 5_000))).encode()
    return b" ".join(words)


def changed_png(data: bytes, rng: random.Random) -> bytes:
    """Change size, depth or kind of a PNG, or bytes of one of its chunks; checksums fit."""
    place, chunks = 8, []
    while place < len(data):
        (length,) = struct.unpack_from(">I", data, place)
        chunks.append((data[place + 4 : place + 8], data[place + 8 : place + 8 + length]))
        place += 12 + length
    chosen = 0 if rng.random() < 0.4 else rng.randrange(len(chunks))
    kind, body = chunks[chosen]
    if chosen == 0:
        width, height, *rest = struct.unpack(">IIBBBBB", body)
        match rng.randrange(3):
            case 0:
                width, height = rng.choice((width, *SIDES)), rng.choice((height, *SIDES))
            case 1:
                rest[0], rest[1] = rng.choice((1, 2, 4, 8, 16, 3)), rng.choice((0, 2, 3, 4, 6, 1))
            case _:
                rest[rng.randrange(5)] = rng.randrange(256)
        body = struct.pack(">IIBBBBB", width, height, *rest)
    elif kind == b"IDAT" and rng.random() < 0.5:
        try:
            body = zlib.compress(flipped(zlib.decompress(body), rng))
        except zlib.error:
            body = flipped(body, rng)
    else:
        body = flipped(body, rng)
    chunks[chosen] = (kind, body)
    if rng.random() < 0.1:
        chunks.insert(rng.randrange(len(chunks)), rng.choice(chunks))
    return data[:8] + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks
    )


def changed_npy(data: bytes, rng: random.Random) -> bytes:
    """Replace an array by one of another type, shape or content, or its header alone."""
    if rng.random() < 0.3:
        return _header(rng.choice(DTYPES), rng.choice(HUGE))
    return _array(rng, data)


def changed_archive(data: bytes, rng: random.Random) -> bytes:
    """Change bytes of a file in an archive; checksums fit."""
    members = _members(data)
    name = rng.choice(list(members))
    members[name] = flipped(members[name], rng)
    return _archive(members, rng)


def changed_npz(data: bytes, rng: random.Random) -> bytes:
    """Replace arrays by others of another type, shape or content, or only their headers; checksums fit."""
    arrays = _members(data)
    names = list(arrays)
    for _ in range(rng.choice((1, 1, 2))):
        name = rng.choice(names)
        match rng.randrange(8):
            case 0:
                arrays.pop(name, None)
            case 1:
                arrays["extra.npy"] = arrays.get(name, b"")
            case 2:
                arrays[name] = flipped(arrays.get(name, b"x"), rng)
            case 3:
                arrays[name] = _header(rng.choice(DTYPES), rng.choice(HUGE))
            case 4:
                arrays[name] = rng.choice((b"", b"\x93NUMPY", b"\x93NUMPY\x09\0" + bytes(99)))
            case _:
                arrays[name] = _array(rng, arrays.get(name))
    return _archive(arrays, rng)


def _members(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _archive(arrays: dict[str, bytes], rng: random.Random) -> bytes:
    out = BytesIO()
    with zipfile.ZipFile(out, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, content in arrays.items():
            archive.writestr(name, content)
    return out.getvalue()


def _header(dtype: str, shape: tuple[int, ...]) -> bytes:
    text = (
        f"{{'descr': '{'|' + dtype if dtype[0] in '?SVO' else dtype}', 'fortran_order': False, 'shape': {shape}, }}\n"
    )
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(text)) + text.encode()


def _array(rng: random.Random, before: bytes | None) -> bytes:
    """Return the file of an array: that of before with other numbers, type or shape, or a new one."""
    out, array = BytesIO(), None
    if before and rng.random() < 0.7:
        try:
            array = np.load(BytesIO(before), allow_pickle=False)
        except Exception:  # what an earlier change made of it
            array = None
    if array is not None and array.dtype.kind in "fiub":
        match rng.randrange(5):
            case 0:
                array = np.full_like(array, rng.choice((0, 1, 100)))
            case 1:
                array = array.astype(float) * rng.choice((np.nan, np.inf, -1.0, 1e30, 0.0))
            case 2:
                array = array.astype(rng.choice(("f8", "i8", "U4", "c16", "f2", "?")))
            case 3:
                array = array[: len(array) // 2] if array.ndim else array[None]
            case _:
                array = array.reshape(-1)
    else:
        dtype = rng.choice(DTYPES)
        array = np.zeros(rng.choice(SHAPES), dtype if dtype != "O" else object)
    np.lib.format.write_array(out, array)
    return out.getvalue()


def changed_safetensors(data: bytes, rng: random.Random) -> bytes:
    """Change the header: its length, types, shapes, places, names and notes; or numbers to NaN."""
    (length,) = struct.unpack("<Q", data[:8])
    header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    if rng.random() < 0.1:
        return struct.pack("<Q", rng.choice((0, 1, 2**63, 2**32, len(data)))) + data[8:]
    if rng.random() < 0.1:
        return data[: 8 + length] + bytes([0xFF]) * len(body)
    names = [name for name in header if name != "__metadata__"]
    name = rng.choice(names)
    match rng.randrange(6):
        case 0:
            header[name]["dtype"] = rng.choice(
                ("F8_E4M3", "F8_E5M2", "I64", "BOOL", "F16", "U8", "F4", "C64", "X", "F64")
            )
        case 1:
            header[name]["shape"] = rng.choice(([0], [-1], [2**63], [], [1, 1], [2**40, 2**40], "x", None))
        case 2:
            header[name]["data_offsets"] = rng.choice(([0, 0], [5, 1], [0, 2**63], [-1, 4], "x", [0], None))
        case 3:
            header[rng.choice(("stranger", "", "a\0", "é", name + ".x"))] = header.pop(name)
        case 4:
            return _retyped(header, name, body, rng)
        case _:
            header = changed_value(header, rng)
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + body


def _retyped(header: dict[str, Any], name: str, body: bytes, rng: random.Random) -> bytes:
    """Give a tensor another type of the same width, or another shape of the same size: the file stays consistent."""
    widths = {"F32": ("I32", "U32"), "I64": ("F64", "U64"), "F16": ("BF16", "I16"), "BF16": ("F16", "U16")}
    entry = header[name]
    if rng.random() < 0.5:
        entry["dtype"] = rng.choice(widths.get(entry["dtype"], (entry["dtype"],)))
    else:
        entry["shape"] = [int(np.prod(entry["shape"]))]
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + body


CHANGES: dict[str, Callable[[bytes, random.Random], bytes]] = {
    ".json": changed_json, ".jsonl": changed_lines, ".npz": changed_npz, ".safetensors": changed_safetensors,
    ".txt": changed_words, ".toml": changed_words, ".ply": changed_words, ".png": changed_png, ".npy": changed_npy,
    ".pt": changed_archive,
}  # fmt: skip


def mutated(path: Path, rng: random.Random) -> bytes:
    """Return the content of a file, damaged."""
    data = path.read_bytes()
    change = CHANGES.get(path.suffix)
    if change is None or rng.random() < 0.3:
        return flipped(data, rng)
    return change(data, rng)


def described(error: BaseException) -> str:
    """Name an error, and the place in freegeo where it was raised or passed through."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "/freegeo/" in f.filename]
    where = f"{frames[-1].filename.rpartition('/freegeo/')[2]}:{frames[-1].lineno}" if frames else "?"
    return f"{type(error).__name__} at {where}: {' '.join(str(error).split())[:70]}"


def sentence_fault(error: FreeGeoError) -> str | None:
    """Say what is wrong with the sentence of an error; None when nothing is."""
    text = str(error)
    if ".part" in text or "\n" in text.strip() or not text.strip() or len(text) > 1500:
        return f"odd sentence: {text[:70]!r}"
    return None


@contextmanager
def limits() -> Iterator[None]:
    """Refuse memory far beyond that of the start, and interrupt what takes too long."""

    def late(*_: object) -> None:
        raise TooSlow(f"longer than {LIMIT_S} s")

    before, handler = resource.getrlimit(resource.RLIMIT_AS), signal.signal(signal.SIGALRM, late)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MORE_MEMORY, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
        signal.signal(signal.SIGALRM, handler)


def case(reader: Reader, original: Path, victim: Path, rng: random.Random, outcome: Outcome) -> None:
    """Damage one file and read it."""
    with warnings.catch_warnings(action="ignore"):
        victim.write_bytes(mutated(original, rng))
    outcome.cases += 1
    signal.setitimer(signal.ITIMER_REAL, LIMIT_S)
    # What hangs in compiled code is not interrupted by a signal: it ends the process, and says where.
    faulthandler.dump_traceback_later(2 * LIMIT_S, exit=True)
    try:
        with warnings.catch_warnings(action="ignore"):
            reader.read(victim)
        outcome.read += 1
    except FreeGeoError as error:
        outcome.refused += 1
        fault = sentence_fault(error)
        if fault:
            outcome.faults[fault] += 1
    except (Exception, TooSlow) as error:
        outcome.faults[described(error)] += 1
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        faulthandler.cancel_dump_traceback_later()


@contextmanager
def quiet() -> Iterator[None]:
    """Print no warnings, and do not wait for the disk: what is written survives no power cut here, and need not."""
    flush, os.fsync = os.fsync, lambda descriptor: None
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(logging.NOTSET)
        os.fsync = flush


def fuzz_reader(folder: Path, name: str, cases: int, seed: int) -> Outcome:
    """Run cases of one reader in a new folder, in which nothing may appear but in the places that it is given."""
    reader = next(reader for reader in READERS if reader.name == name)
    here, outcome = Path.cwd(), Outcome()
    (folder / "empty").mkdir(parents=True)
    os.chdir(folder / "empty")
    try:
        with quiet():
            victim = reader.write(folder / "files")
            reader.read(victim)
            original = folder / f"original{victim.suffix}"
            original.write_bytes(victim.read_bytes())
            started = time.process_time()
            with limits():
                for number in range(cases):
                    case(reader, original, victim, random.Random(f"{seed} {name} {number}"), outcome)
            outcome.seconds = time.process_time() - started
    finally:
        os.chdir(here)
    known = {folder / "empty", folder / "files", folder / "exported", original}
    for path in [*sorted(set(folder.iterdir()) - known), *(folder / "empty").iterdir()]:
        outcome.faults[f"wrote {path.relative_to(folder)}"] += 1
    return outcome


def fuzz(folder: Path, cases: int, seed: int, names: Sequence[str] = NAMES, processes: int = 1) -> dict[str, Outcome]:
    """Run so many cases, spread evenly over readers, with files below a folder; returns outcomes by reader."""
    share = -(-cases // len(names))
    work = [(folder / f"{place}", name, share, seed) for place, name in enumerate(names)]
    if processes == 1:
        return {item[1]: fuzz_reader(*item) for item in work}
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        return dict(zip(names, pool.map(fuzz_reader, *zip(*work, strict=True)), strict=True))


def main() -> None:
    """Print a table of outcomes, then the faults."""
    cases, seed = (int(value) for value in (sys.argv[1:3] + ["20000", "0"][len(sys.argv[1:3]) :]))
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        outcomes = fuzz(Path(folder), cases, seed, sys.argv[3:] or NAMES, processes=2)
    print(f"{'reader':24}{'cases':>8}{'read':>8}{'refused':>9}{'faults':>8}{'ms a case':>11}")
    for name, o in outcomes.items():
        cost = 1000 * o.seconds / o.cases
        print(f"{name:24}{o.cases:8}{o.read:8}{o.refused:9}{sum(o.faults.values()):8}{cost:11.1f}")
    total = sum(o.cases for o in outcomes.values())
    faults = sum(sum(o.faults.values()) for o in outcomes.values())
    print(f"{total} cases in {time.monotonic() - started:.0f} s, {faults} faults")
    for name, o in outcomes.items():
        for fault, count in o.faults.most_common():
            print(f"  {name}: {count} x {fault}")
    sys.exit(faults > 0)


if __name__ == "__main__":
    main()
