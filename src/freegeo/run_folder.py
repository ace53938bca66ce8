"""Output folders of commands: locked while one writes, continued after a stop, never mixed.

A command's output folder goes through three states: absent, unfinished (its settings are stored, its files appear one
by one) and finished (the marker names when). Settings may be ordered in parts: when a part changes, the files that
depend on it or on a later part go, and the others stay.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Required, TypedDict

from freegeo.errors import UserError
from freegeo.files import (
    FORMAT,
    LEDGER_FILE,
    OWN_FILES,
    RUN_FILE,
    as_json,
    is_part,
    ledger,
    missing,
    read_json,
    remove_listed,
    remove_parts,
    require_writable,
    start_ledger,
    write_json,
    write_ledger,
)  # fmt: skip
from freegeo.lock import Lock, locked, lost

_SHOWN = 4


class _State(TypedDict, total=False):
    """Content of `RUN_FILE`."""

    format: Required[int]
    settings: Required[dict[str, Any]]
    finished: Required[str | None]
    notes: dict[str, Any] | None
    clearing: bool
    """Its files are being removed for a run with `overwrite`; a state that is written after that does not say so."""


@dataclass(frozen=True)
class Part:
    """A part of a command's settings, and the files that depend on it and on the parts before it."""

    name: str
    """Its name among the settings."""
    files: tuple[str, ...]
    """Names of files, and of folders with a slash at the end; the empty name stands for every file."""
    free: bool = False
    """Whether it may change without `overwrite`: what depends on it costs little to make again."""

    def owns(self, name: str) -> bool:
        """Whether a file of the folder depends on this part."""
        return any(name == own or ((own.endswith("/") or not own) and name.startswith(own)) for own in self.files)


@dataclass(frozen=True)
class RunFolder:
    """One command's output folder, locked while the command runs."""

    path: Path
    lock: Lock
    settings: Mapping[str, Any]
    finished_at: str | None
    notes: dict[str, Any] = field(default_factory=dict)
    """What processes of this run noted down, by the part of the settings that it depends on."""

    @property
    def finished(self) -> bool:
        """Whether an earlier run with the same settings completed."""
        return self.finished_at is not None

    def __truediv__(self, name: str) -> Path:
        """Return the path of a file in the folder."""
        return self.path / name

    def sub(self, name: str) -> SubFolder:
        """Return a folder in this one, such as that of a part of a result."""
        notes = {part: value[name] for part, value in self.notes.items() if value and name in value}
        return SubFolder(
            path=self.path / name, lock=self.lock, settings=self.settings, finished_at=self.finished_at, notes=notes,
            whole=self, name=name,
        )  # fmt: skip

    def note(self, part: str, value: Any) -> None:
        """Keep a JSON-like value for processes that continue this run, until the part of the settings changes."""
        self.notes[part] = value
        self._write(None)

    def finish(self) -> None:
        """Mark the result as complete; LostFolderError when a file of it is gone, or not in the ledger any more."""
        self.lock.require()
        gone = missing(self.lock)
        if gone:
            raise lost(self.path, f"{gone[0].name}, or the list of what was written ({LEDGER_FILE}), was removed")
        self._write(datetime.now(UTC).isoformat(timespec="seconds"))

    def _write(self, finished: str | None) -> None:
        self.lock.require()
        if not (self.path / RUN_FILE).is_file():
            raise lost(self.path, f"the state of the run ({RUN_FILE}) was removed")
        write_json(self.path / RUN_FILE, _state(self.settings, finished, self.notes))


@dataclass(frozen=True, kw_only=True)
class SubFolder(RunFolder):
    """A folder in a command's output folder, with notes of its own among those of the whole."""

    whole: RunFolder
    name: str
    """Path below the output folder."""

    def note(self, part: str, value: Any) -> None:
        """Keep a JSON-like value as `RunFolder.note` does."""
        self.notes[part] = value
        self.whole.note(part, {**(self.whole.notes.get(part) or {}), self.name: value})


@contextmanager
def run_folder(
    path: Path,
    settings: Mapping[str, Any],
    *,
    overwrite: bool = False,
    parts: Sequence[Part] = (),
    labels: Mapping[str, str] | None = None,
) -> Generator[RunFolder]:
    """Open an output folder for a command with JSON-like settings.

    Absent or empty: a run is started. Unfinished with the same settings: it continues. Finished with the same settings:
    `finished` is true and the caller must not write. When a free part of the settings differs, the files that depend on
    it are removed, and the run is unfinished. Other differences, or a folder that freegeo did not write: UserError.
    `overwrite` removes what depends on the first part that differs (everything, when none does or there are no parts),
    and never what freegeo did not write; a folder that freegeo did not write is still refused. When the block raises
    UserError before it wrote a file, the settings file and a new folder are removed again.

    Args:
        path: of the folder.
        settings: what the result depends on.
        overwrite: see above.
        parts: of the settings, each depending on those before it; settings in no part come before all.
        labels: what messages call a setting (`difference`).
    """
    settings = as_json(settings)
    check_folder(path, settings, overwrite=overwrite, parts=parts, labels=labels)
    with locked(path) as lock:
        # The state is read again under the lock: another process may have changed it since the check.
        check_folder(path, settings, overwrite=overwrite, parts=parts, labels=labels)
        folder = _open(lock, settings, overwrite, parts)
        try:
            yield folder
        except UserError:
            if lock.is_held() and not any((path / name).exists() for name in ledger(path)):
                (path / RUN_FILE).unlink(missing_ok=True)
                (path / LEDGER_FILE).unlink(missing_ok=True)
            raise


def _open(lock: Lock, settings: Mapping[str, Any], overwrite: bool, parts: Sequence[Part]) -> RunFolder:
    """Start or continue the run of a locked folder."""
    path = lock.folder
    before, notes = stored_state(path), {}
    if before is None:
        # Before the state, so that a process that is killed while it writes that leaves nothing that is not listed.
        start_ledger(path)
    remove_parts(path)
    if before is not None:
        same = before["settings"] == settings
        if same and not overwrite:
            return RunFolder(path, lock, settings, before["finished"], before.get("notes") or {})
        kept = kept_parts(before["settings"], settings, parts)
        _require_free(path, [part for part in parts if part not in kept])
        clear(path, keep=lambda name: any(part.owns(name) for part in kept))
        notes = {part.name: before["notes"][part.name] for part in kept if part.name in (before.get("notes") or {})}
    write_json(path / RUN_FILE, _state(settings, None, notes))
    return RunFolder(path, lock, settings, None, notes)


def _require_free(path: Path, parts: Sequence[Part]) -> None:
    """Refuse files of others in the places of a run's own, which it would take for what it had computed before."""
    own = {path.resolve() / name for name in ledger(path)}
    for name in (name for part in parts for name in part.files if name):
        there = (path / name).rglob("*") if name.endswith("/") else [path / name]
        strangers = sorted(f for f in there if f.is_file() and f.parent.resolve() / f.name not in own)
        if strangers:
            raise UserError(f"{strangers[0]}: freegeo did not write it, and it is in the way. Move or remove it.")


def kept_parts(before: Mapping[str, Any], settings: Mapping[str, Any], parts: Sequence[Part]) -> Sequence[Part]:
    """Return the parts whose files stay when a run with JSON-like settings replaces the one of before."""
    now = as_json(settings)
    return () if before == now else parts[: _unchanged(before, now, parts)]


def _unchanged(before: Mapping[str, Any], now: Mapping[str, Any], parts: Sequence[Part]) -> int:
    """Return how many parts are as before, up to the first that is not; 0 when settings in no part differ."""
    names = [part.name for part in parts]
    if any(before.get(name) != now.get(name) for name in (set(before) | set(now)) - set(names)):
        return 0
    return next((k for k, name in enumerate(names) if before.get(name) != now.get(name)), len(parts))


def check_folder(
    path: Path,
    settings: Mapping[str, Any],
    *,
    overwrite: bool,
    parts: Sequence[Part] = (),
    labels: Mapping[str, str] | None = None,
) -> None:
    """Raise UserError when `run_folder` would refuse; cheap, so that commands can check before they load anything."""
    settings = as_json(settings)
    if path.exists() and not path.is_dir():
        raise UserError(f"{path}: is a file. Choose a folder for the output.")
    before = stored_state(path)
    if before is None:
        if path.is_dir() and any(
            p.name not in OWN_FILES and not _is_left_over(p) and _holds_files(p) for p in path.iterdir()
        ):
            raise UserError(f"{path}: holds files that freegeo did not write. Choose an empty or a new folder.")
        require_writable(path)
        return
    if before["format"] > FORMAT:
        raise UserError(f"{path}: written by a newer freegeo (format {before['format']}). Update freegeo.")
    free = all(part.free for part in parts[_unchanged(before["settings"], settings, parts) :]) and bool(parts)
    if before["settings"] != settings and not free and not overwrite:
        state = "a finished result" if before["finished"] else "an unfinished run"
        raise UserError(
            f"{path}: holds {state} with other options ({difference(before['settings'], settings, labels)}). "
            "Add --overwrite to replace it, or choose another folder."
        )
    require_writable(path)


def _holds_files(path: Path) -> bool:
    """Whether a path is a file or a link, or a folder with such somewhere in it."""
    return path.is_symlink() or not path.is_dir() or any(map(_holds_files, path.iterdir()))


def _is_left_over(path: Path) -> bool:
    """Whether something was left half-written by a process that was killed, as the ledger of its folder says."""
    return is_part(path) and path.name in ledger(path.parent)


def stored_state(path: Path) -> dict[str, Any] | None:
    """Return format, settings and finishing time of the run in a folder; None when there is none."""
    file = path / RUN_FILE
    if not file.is_file():
        return None
    return read_json(file, _State, advice="Choose another output folder.")


def clear(path: Path, *, keep: Callable[[str], bool] = lambda name: False) -> None:
    """Remove what earlier runs wrote into a folder, without the names to `keep`, and nothing that others put there."""
    state = stored_state(path)
    if state is not None:
        # If the removal is interrupted, the remaining files must not count as a finished result.
        write_json(path / RUN_FILE, {**state, "finished": None, "clearing": True})
    names = ledger(path)
    kept = [name for name in names if keep(name) and not is_part(Path(name))]
    remove_listed(path, set(names) - set(kept))
    if kept:
        write_ledger(path, kept)
    else:
        (path / LEDGER_FILE).unlink(missing_ok=True)


def difference(before: Mapping[str, Any], now: Mapping[str, Any], labels: Mapping[str, str] | None = None) -> str:
    """Name the settings that differ, dotted where they are nested, with both values; empty when none does.

    At most four are named, for the rest their number is given. Both are as read from JSON (`freegeo.files.as_json`).
    `labels` maps the last name of a setting to what to say instead: an option such as `--seed`, followed by the values,
    or a phrase that stands alone.
    """
    parts = list(dict.fromkeys(_differences(before, now, labels or {})))
    more = len(parts) - _SHOWN
    return "; ".join(parts[:_SHOWN]) + (f"; and {more} more" if more > 0 else "")


def _state(settings: Mapping[str, Any], finished: str | None, notes: Mapping[str, Any]) -> dict[str, Any]:
    return {"format": FORMAT, "settings": settings, "finished": finished, "notes": notes}


def _differences(
    before: Mapping[str, Any], now: Mapping[str, Any], labels: Mapping[str, str], prefix: str = ""
) -> Iterator[str]:
    for name in sorted(set(before) | set(now)):
        old, new = before.get(name), now.get(name)
        label = labels.get(name, f"{prefix}{name}")
        if isinstance(old, dict) and isinstance(new, dict):
            yield from _differences(old, new, labels, f"{prefix}{name}.")
        elif old != new and name in labels and not label.startswith("--"):
            yield label
        elif old != new:
            yield f"{label}: {_short(old)} there, {_short(new)} now"


def _short(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, dict):
        return f"'{value['name']}'" if "name" in value else "given"
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."
