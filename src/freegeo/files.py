"""The one way into an output folder: atomic writes of files and folders, and the ledger of what was written there.

A ledger in an output folder lists what freegeo wrote there, so that replacing a result never touches a file that
somebody put beside it. NumPy is loaded by the functions that need it only.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import secrets
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import TYPE_CHECKING, Any, NamedTuple

from freegeo.errors import DamagedError, FreeGeoError, UserError
from freegeo.host import gigabytes, host_available
from freegeo.lock import LOCK_FILE, Lock, hold_shared, note_removed, note_written, require_lock, require_no_link

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

FORMAT = 1
"""Version of the files that freegeo writes."""
RUN_FILE = ".freegeo-run.json"
LEDGER_FILE = ".freegeo-files"
OWN_FILES = frozenset({RUN_FILE, LOCK_FILE, LEDGER_FILE})
NAME_MAX = 255
"""Longest name of a file in bytes, on every common file system."""
_SHOWN = 80
"""Most characters of an odd name that a message shows."""
_LOCAL_HEADER, _ZIP64_FIELD = 30, 20
"""Bytes of the header before a member of a zip file, without its name and extra fields, and of the field for sizes."""
_PADDING_KIND, _ALIGNMENT = 0xD935, 64
_BLOCK = 1 << 20
_MOST_DIGITS = 300
"""Of whole numbers in JSON; every number of so many can become a float."""
_MOST_PACKED = 1100
"""No more bytes than this come out of one byte of a zip file."""
_NPZ_ERRORS = (
    zipfile.BadZipFile, zlib.error, struct.error, ValueError, RuntimeError, EOFError, LookupError, TypeError,
    SyntaxError, TokenError, OverflowError, MemoryError, AttributeError,
)  # fmt: skip
"""What NumPy and zipfile raise for damaged files."""
AGAIN = "Remove it and run again."
Kind = tuple[str, tuple[int, ...]]
"""Of an array: the letters of the types that it may have (`numpy.dtype.kind`), and its shape, -1 for any length."""
_PART = re.compile(r"\..+\.[0-9a-f]{8}\.part(\..*)?")


@contextmanager
def atomic_path(path: Path) -> Generator[Path]:
    """Give a temporary path beside `path` to write to; it takes the final name only when the block succeeds.

    The temporary name keeps the suffix, since writers choose the format by it. UserError when the folder cannot be
    written to, or when `path` leads out of the output folder; LostFolderError when that folder was locked and is gone;
    an OSError while writing, such as a full disk, names the final path.
    """
    with _door(path, path.parent) as part:
        yield part
        _flush(part)
        require_lock(path)
        _enter_in_ledger([path])
        part.replace(path)
        note_written(path)


@contextmanager
def atomic_folder(path: Path) -> Generator[Path]:
    """Give a temporary folder beside `path` to write files into; when the block succeeds they replace those of before.

    What freegeo wrote below `path` earlier is removed first, and so is whatever has the name of a new file; other files
    stay. Old and new files are never there together: a stop in between leaves some missing. Errors as `atomic_path`.
    """
    with _door(path, path) as part:
        part.mkdir()
        yield part
        new = sorted(file.relative_to(part) for file in part.rglob("*") if file.is_file())
        for name in new:
            _flush(part / name)
        _require_not_foreign([path / name for name in new])
        remove_written(path)
        for name in new:
            remove_file(path / name)
        _enter_in_ledger([path / name for name in new])
        for name in new:
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            (part / name).replace(path / name)
            note_written(path / name)


@contextmanager
def atomic_files(folder: Path, names: Sequence[str]) -> Generator[list[Path]]:
    """Give a temporary path for each name of a file below a folder; they become its files together (`atomic_folder`).

    UserError for a name that cannot be a file below a folder; other errors as `atomic_path`.
    """
    final = [inside(folder, name) for name in names]
    with atomic_folder(folder) as part:
        paths = [part / path.relative_to(folder) for path in final]
        for path in paths:
            path.parent.mkdir(parents=True, exist_ok=True)
        yield paths


@contextmanager
def _door(path: Path, folder: Path) -> Generator[Path]:
    """Give the temporary path for what will be `path`, and remove it afterwards; `folder` is where files are put."""
    _require_own(path, folder)
    _require_not_foreign([path])
    # Short, so that it fits wherever the final name does.
    part = path.with_name(f".{path.stem[:40]}.{secrets.token_hex(4)}.part{path.suffix[:20]}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # A process that is killed cannot remove its part; `remove_parts` finds it by this entry.
        _enter_in_ledger([part])
        yield part
    except PermissionError:
        raise UserError(f"{path.parent}: the folder cannot be written to. Choose another output folder.") from None
    except OSError as error:
        require_lock(path)
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        _remove(part)


def scratch_folder(parent: Path, name: str) -> Path:
    """Make an empty folder for what a command needs while it runs; the next run removes what a killed one left in it.

    Errors as `atomic_path`.
    """
    folder = parent / f".{name}.{0:08x}.part"
    _require_own(folder, parent)
    try:
        parent.mkdir(parents=True, exist_ok=True)
        _enter_in_ledger([folder])
        _remove(folder)
        folder.mkdir()
    except OSError as error:
        raise UserError(f"{parent}: cannot be written to ({error.strerror}). Choose another output folder.") from None
    return folder


def _require_own(path: Path, folder: Path) -> None:
    """Refuse a path whose `folder` is not below the output folder, or whose output folder is gone."""
    require_lock(path)
    owner = _owner(path)
    if owner is not None and path.name not in OWN_FILES and not _is_below(folder, owner):
        raise UserError(f"{path}: leads out of the output folder {owner}. Remove the symbolic link, or the '..'.")


def _require_not_foreign(paths: Sequence[Path]) -> None:
    """Refuse to replace files of an output folder that its ledger does not list: somebody put them there."""
    there = [path for path in paths if path.is_file() and path.name not in OWN_FILES]
    owner = _owner(there[0]) if there else None
    if owner is not None:
        text = (owner / LEDGER_FILE).read_bytes() if (owner / LEDGER_FILE).is_file() else b""
        for path in there:
            if b"\n" + os.fsencode(_entry(path, owner)) + b"\n" not in b"\n" + text:
                raise UserError(
                    f"{path}: is there, and freegeo did not write it, so it is not replaced. Choose another folder, or "
                    "move it away."
                )


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def remove_file(path: Path) -> None:
    """Remove a file that freegeo wrote, if it is there; LostFolderError when its folder was locked and is gone."""
    require_lock(path)
    path.unlink(missing_ok=True)
    note_removed(path)


def make_way(path: Path, *, is_own: bool = False) -> None:
    """Remove a file that freegeo wrote before another process begins to write it, line by line, under its final name.

    `is_own`: the file is known to be freegeo's; earlier versions did not enter such files in the ledger.

    UserError when somebody else put a file or a link there; other errors as `remove_file`.
    """
    _require_own(path, path.parent)
    if path.is_symlink() and not path.exists():
        raise UserError(f"{path}: is a symbolic link, and freegeo did not make it. Remove it.")
    if not is_own:
        _require_not_foreign([path])
    _enter_in_ledger([path])
    remove_file(path)


def _flush(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())
    # Some writers create files that only the owner can read; results get the permissions of the user's umask.
    mask = os.umask(0)
    os.umask(mask)
    path.chmod(0o666 & ~mask)


def require_room(folder: Path) -> None:
    """Raise OSError when the disk of a folder is full, as is asked after a library that does not say so has written."""
    probe = folder / "room"
    with probe.open("wb") as file:
        file.write(bytes(_BLOCK))
        file.flush()
        os.fsync(file.fileno())
    probe.unlink()


def inside(folder: Path, name: str) -> Path:
    """Return the path of a file below a folder; UserError for a name that leads out of it, or that no file can have.

    Every name that comes from outside, such as a photo's, goes through here before it becomes a path.
    """
    path = Path(name)
    if re.search(r"[\x00\r\n\ud800-\udfff]", name) or _leads_out(path) or not _fits(path.parent):
        raise UserError(f"{_short(name)!r} cannot be the name of a file below {folder}. Rename the photo.")
    return folder / path


def _leads_out(path: Path) -> bool:
    return not path.name or path.is_absolute() or bool(path.drive) or ".." in path.parts


def _fits(path: Path) -> bool:
    return all(len(os.fsencode(part)) <= NAME_MAX for part in path.parts)


def _short(name: str) -> str:
    return name if len(name) <= _SHOWN else f"{name[:_SHOWN]}..."


def fitted(name: str) -> str:
    """Return a file name that fits into `NAME_MAX` bytes: the name, or its beginning and a fingerprint of the whole."""
    path = Path(name)
    stem = path.stem
    if len(os.fsencode(path.name)) <= NAME_MAX:
        return name
    ending = f"-{hashlib.sha256(os.fsencode(name)).hexdigest()[:8]}{path.suffix}"
    while len(os.fsencode(stem + ending)) > NAME_MAX:
        stem = stem[:-1]
    return path.with_name(stem + ending).as_posix()


def require_writable(folder: Path) -> None:
    """Raise UserError when files cannot be made in a folder, or the folder itself cannot: a check before long work."""
    existing = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        raise UserError(f"{folder}: the output folder cannot be written to. Choose another one.")


def keep_ledger(folder: Path) -> None:
    """Make a folder that notes down what is written below it; a part of an output folder does so already."""
    if _owner(folder / LEDGER_FILE) is None:
        start_ledger(folder)


def start_ledger(folder: Path) -> None:
    """Make a folder note down what is written below it, also inside another output folder."""
    require_no_link(folder / LEDGER_FILE)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / LEDGER_FILE).touch()
    except OSError as error:
        raise UserError(f"{folder}: the folder cannot be written to ({error.strerror}). Choose another.") from None


def ledger(folder: Path) -> list[str]:
    """Names of the files that freegeo wrote below an output folder, each once; the files need not exist any more."""
    file = folder / LEDGER_FILE
    text = file.read_text(encoding="utf-8", errors="surrogateescape") if file.is_file() else ""
    names = dict.fromkeys(line for line in text.split("\n") if line and "\0" not in line)
    return [name for name in names if not _leads_out(path := Path(name)) and _fits(path)]


def write_ledger(folder: Path, names: Iterable[str]) -> None:
    """Replace the list of the files that freegeo wrote below an output folder."""
    with atomic_path(folder / LEDGER_FILE) as part:
        part.write_text("".join(f"{name}\n" for name in names), encoding="utf-8", errors="surrogateescape")


def remove_written(place: Path, *, keep: Iterable[Path] = ()) -> None:
    """Remove what freegeo wrote at `place`, a file or folder in an output folder, except the files in `keep`.

    Files of others stay; folders that become empty are removed.
    """
    owner = _owner(place)
    if owner is not None:
        kept = {_entry(path, owner) for path in keep}
        below = _entry(place, owner)
        names = ledger(owner)
        gone = [name for name in names if (name == below or name.startswith(f"{below}/")) and name not in kept]
        if gone:
            remove_listed(owner, gone)
            write_ledger(owner, [name for name in names if name not in gone])


def remove_listed(owner: Path, names: Iterable[str]) -> None:
    """Remove files of an output folder by their names in its ledger, and the folders that become empty."""
    require_lock(owner / LEDGER_FILE)
    # A folder that has become a link to another place is not followed.
    paths = [path for name in names if _is_below((path := owner / name).parent, owner)]
    for path in paths:
        if path.is_symlink() or path.is_file() or (path.is_dir() and is_part(path)):
            _remove(path)
            note_removed(path)
    inner = {folder for path in paths for folder in path.parents if owner in folder.parents}
    for folder in sorted(inner, key=lambda f: len(f.parts), reverse=True):
        if folder.is_dir() and not folder.is_symlink() and not any(folder.iterdir()):
            folder.rmdir()


def remove_parts(owner: Path) -> None:
    """Remove the half-written files and folders of a process that was killed."""
    remove_listed(owner, [name for name in ledger(owner) if is_part(Path(name))])


@contextmanager
def shared_folder(folder: Path) -> Generator[None]:
    """Write into a folder without a ledger to which other processes write too, each its own files.

    What killed processes left half-written there is removed first, when no other process is in such a block.
    """
    with hold_shared(folder, when_alone=lambda: [_remove(path) for path in folder.iterdir() if is_part(path)]):
        yield


def is_part(path: Path) -> bool:
    """Whether a path has the name of something half-written."""
    return _PART.fullmatch(path.name) is not None


def missing(lock: Lock) -> list[Path]:
    """Return the files that the lock's holder wrote and that are gone, or are in no ledger any more."""
    owners = {file: _owner(file) for file in lock.written if file.name not in OWN_FILES}
    folders = {owner for owner in owners.values() if owner is not None}
    noted = {owner: {owner.resolve() / name for name in ledger(owner)} for owner in folders}
    return sorted(file for file, owner in owners.items() if not file.exists() or file not in noted.get(owner, ()))


def _owner(path: Path) -> Path | None:
    """Return the output folder that a path is in: the nearest one that holds the state of a run or a ledger."""
    parents = path.absolute().parents
    return next((f for f in parents if (f / RUN_FILE).is_file() or (f / LEDGER_FILE).is_file()), None)


def _is_below(folder: Path, owner: Path) -> bool:
    return folder.resolve().is_relative_to(owner.resolve())


def _entry(path: Path, owner: Path) -> str:
    return (path.parent.resolve() / path.name).relative_to(owner.resolve()).as_posix()


def _enter_in_ledger(paths: Iterable[Path]) -> None:
    """Add files, all in one folder tree, to the ledger of the output folder that they are in, if they are in one."""
    for path in paths:
        owner = _owner(path)
        if owner is not None and path.name not in OWN_FILES:
            require_no_link(owner / LEDGER_FILE)
            with (owner / LEDGER_FILE).open("a", encoding="utf-8", errors="surrogateescape") as file:
                file.write(_entry(path, owner) + "\n")


def as_json(value: Any) -> Any:
    """Return a value as it would be read back from a JSON file: tuples become lists, keys text."""
    return json.loads(json.dumps(value))


def write_json(path: Path, value: Any) -> None:
    """Write indented JSON atomically."""
    with atomic_path(path) as part:
        part.write_text(json.dumps(value, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def read_json(path: Path, schema: Any = Any, *, advice: str = AGAIN) -> Any:
    """Read JSON, and check it against a type such as a TypedDict; fields that the type does not name are kept.

    DamagedError, which ends with `advice`, when the file is no JSON or not of that type.
    """
    return json_of(read_text(path, advice=advice), path, schema, advice=advice)


def read_text(path: Path, *, advice: str = AGAIN) -> str:
    """Read a file of text; DamagedError when it is none."""
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise DamagedError(path, error, advice) from None


def json_of(text: str, path: Path, schema: Any = Any, *, advice: str = AGAIN) -> Any:
    """Return the value of a JSON text that was read from `path`; errors as `read_json`."""
    import msgspec

    try:
        value = json_value(text)
        msgspec.convert(value, schema)
    except (ValueError, RecursionError) as error:
        raise DamagedError(path, error, advice) from None
    return value


def json_value(text: str) -> Any:
    """Return the value of a JSON text.

    Raises:
        ValueError: it is none, or has a whole number that is larger than any float.
        RecursionError: it is nested too deeply.
    """
    return json.loads(text, parse_int=_whole_number)


def _whole_number(digits: str) -> int:
    if len(digits) > _MOST_DIGITS:
        raise ValueError(f"a number of {len(digits)} digits")
    return int(digits)


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write compressed NumPy arrays atomically."""
    import numpy as np

    with atomic_path(path) as part:
        np.savez_compressed(part, **arrays)


@dataclass(frozen=True, kw_only=True)
class Rows:
    """An array that is written in parts; FreeGeoError when these are not what was announced."""

    shape: tuple[int, ...]
    dtype: np.dtype
    parts: Iterable[np.ndarray]
    """Arrays (n, ...) that follow each other along the first axis; each may be forgotten when it is written."""

    def __iter__(self) -> Iterator[np.ndarray]:
        """Yield the parts as they are written."""
        import numpy as np

        count = 0
        for part in self.parts:
            count += len(part)
            if part.shape[1:] != self.shape[1:] or count > self.shape[0]:
                raise FreeGeoError(f"rows of the shape {part.shape} do not fit an array of {self.shape}.")
            yield np.ascontiguousarray(part, self.dtype)
        if count != self.shape[0]:
            raise FreeGeoError(f"{count} rows do not fill an array of the shape {self.shape}.")


def write_npz_rows(path: Path, arrays: Iterable[tuple[str, np.ndarray | Rows]]) -> None:
    """Write named NumPy arrays atomically and uncompressed, one part of `Rows` at a time; `read_npz` maps them."""
    import numpy as np

    with atomic_path(path) as part, part.open("wb") as file, zipfile.ZipFile(file, "w") as archive:
        for name, value in arrays:
            rows = value if isinstance(value, Rows) else Rows(shape=value.shape, dtype=value.dtype, parts=[value])
            entry = zipfile.ZipInfo(f"{name}.npy")
            entry.extra = _padding(file.tell(), entry)
            header = {"descr": np.lib.format.dtype_to_descr(np.dtype(rows.dtype)), "fortran_order": False}
            with archive.open(entry, "w", force_zip64=True) as stream:
                np.lib.format.write_array_header_1_0(stream, {**header, "shape": rows.shape})
                if rows.shape:
                    for block in rows:
                        stream.write(block.data if block.size else b"")
                else:
                    stream.write(np.asarray(value).tobytes())


def _padding(start: int, entry: zipfile.ZipInfo) -> bytes:
    """Extra field after which a member that starts at `start` has its content at a multiple of 64, as NumPy aligns it.

    Its kind is the one that Android's zipalign uses for the same purpose.
    """
    before = start + _LOCAL_HEADER + len(entry.filename.encode()) + _ZIP64_FIELD + 4
    return struct.pack("<HH", _PADDING_KIND, -before % _ALIGNMENT) + bytes(-before % _ALIGNMENT)


def read_npz(
    path: Path, kinds: Mapping[str, Kind] | None = None, *, optional: Collection[str] = (), advice: str = AGAIN
) -> dict[str, np.ndarray]:
    """Read the arrays of an .npz file, and map those that are stored in it uncompressed.

    Mapped ones (`np.memmap`) are read when they are used and can be larger than memory; writing into them changes
    neither the file nor what others read. All content is compared with its checksum here. Nothing is allocated before
    the headers have been checked: against `kinds`, the file, and the free memory.

    Args:
        path: of the file.
        kinds: the arrays to read, of which all but `optional` must be there; None: all in the file.
        optional: names in `kinds`.
        advice: what the user has to do when the file is damaged.

    Raises:
        DamagedError: the file is damaged, or not of these kinds.
        FreeGeoError: the file cannot be read, or its content is larger than the free memory.
    """
    arrays: dict[str, np.ndarray] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            entries = {e.filename.removesuffix(".npy"): e for e in archive.infolist() if e.filename.endswith(".npy")}
            entries = {name: entry for name, entry in entries.items() if kinds is None or name in kinds}
            missing = [name for name in kinds or () if name not in entries and name not in optional]
            if missing:
                raise ValueError(f"{', '.join(missing)} missing")
            headers = {
                name: _checked_header(archive, entry, None if kinds is None else kinds[name])
                for name, entry in entries.items()
            }
            _require_room(path, [header.size for header in headers.values() if not header.mappable])
            for name, entry in entries.items():
                arrays[name] = _content(path, archive, entry, headers[name])
    except OSError as error:
        raise FreeGeoError(f"{path}: cannot be read ({error.strerror or error}).") from None
    except _NPZ_ERRORS as error:
        raise DamagedError(path, error, advice) from None
    return arrays


class _Header(NamedTuple):
    """What a member of an .npz file says about its array."""

    start: int
    """Bytes before the numbers."""
    shape: tuple[int, ...]
    columns_first: bool
    dtype: np.dtype
    mappable: bool

    @property
    def size(self) -> int:
        """Bytes of the numbers."""
        return math.prod(self.shape) * self.dtype.itemsize


def _checked_header(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, kind: Kind | None) -> _Header:
    """Read the header of an array; ValueError when it does not fit the file or the kind."""
    import numpy as np

    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    with archive.open(entry) as stream:
        version = np.lib.format.read_magic(stream)
        if version not in read_header:
            raise ValueError(f"{entry.filename} is of version {version}")
        shape, columns_first, dtype = read_header[version](stream)
        start = stream.tell()
    # Without alignment computing on the array would be slow, or impossible; a single number cannot be mapped.
    stored = entry.compress_type == zipfile.ZIP_STORED
    header = _Header(start, shape, columns_first, dtype, stored and bool(shape) and min(shape) > 0)
    if dtype.hasobject:
        raise ValueError(f"{entry.filename} holds objects, which are not read")
    if min(shape, default=0) < 0 or start + header.size != entry.file_size:
        raise ValueError(f"{entry.filename} does not have the size that its header says")
    if entry.file_size > _MOST_PACKED * (entry.compress_size + 1):
        raise ValueError(f"{entry.filename} cannot be packed into {entry.compress_size} bytes")
    if kind is not None and not _is_of_kind(header, kind):
        raise ValueError(f"{entry.filename.removesuffix('.npy')} is {dtype} of the shape {shape}")
    return header


def _is_of_kind(header: _Header, kind: Kind) -> bool:
    types, wanted = kind
    fits = zip(header.shape, wanted, strict=False)
    return header.dtype.kind in types and len(header.shape) == len(wanted) and all(w in (-1, n) for n, w in fits)


def _require_room(path: Path, sizes: Iterable[int]) -> None:
    needed, free = sum(sizes), host_available()
    if needed > free:
        raise FreeGeoError(
            f"{path}: unpacks to {gigabytes(needed)}, and {gigabytes(free)} of memory are free. Close other "
            "programs, or use another machine; if the file is not that of a large result, remove it."
        )


def _content(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo, header: _Header) -> np.ndarray:
    """Return a member as an array in the file, where that is possible, else in memory."""
    import numpy as np

    if header.mappable:
        with archive.open(entry) as stream:
            # The checksum is compared at the end.
            while stream.read(_BLOCK):
                pass
        with path.open("rb") as file:
            file.seek(entry.header_offset)
            name, extra = struct.unpack("<HH", file.read(_LOCAL_HEADER)[-4:])
        start = entry.header_offset + _LOCAL_HEADER + name + extra + header.start
        if start % header.dtype.alignment == 0:
            order = "F" if header.columns_first else "C"
            return np.memmap(path, header.dtype, mode="c", offset=start, shape=header.shape, order=order)
    with archive.open(entry) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)


@contextmanager
def damaged_tensors(translate: Callable[[Exception], Exception]) -> Generator[None]:
    """Raise what `translate` returns in place of what the reader of safetensors raises for a damaged file."""
    from safetensors import SafetensorError

    try:
        yield
    except (SafetensorError, ValueError, LookupError, TypeError, AttributeError, OverflowError, RuntimeError) as error:
        raise translate(error) from None


def read_tensors(path: Path, *, advice: str = AGAIN) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read what `write_tensors` wrote: tensors and metadata; DamagedError when it is damaged."""
    from safetensors import safe_open

    with damaged_tensors(lambda error: DamagedError(path, error, advice)), safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118


def write_tensors(path: Path, tensors: Mapping[str, Any], metadata: Mapping[str, str] | None = None) -> None:
    """Write tensors as safetensors atomically; OSError when the disk is full, as every other writer."""
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    with atomic_path(path) as part:
        contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
        # The library has temporary names of its own beside its file; a process that is killed must not leave one.
        scratch = scratch_folder(path.parent, part.stem)
        try:
            save_file(contiguous, scratch / path.name, metadata=dict(metadata or {}))
            (scratch / path.name).replace(part)
        except SafetensorError as error:
            number = re.search(r"os error (\d+)", str(error))
            if number is None:
                raise
            raise OSError(int(number[1]), os.strerror(int(number[1])), str(path)) from None
        finally:
            _remove(scratch)
