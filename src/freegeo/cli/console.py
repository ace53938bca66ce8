"""What the commands say: messages, tables, and a summary of what was written."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import shlex
import sys
import textwrap
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TextIO

from freegeo.host import size_text
from freegeo.progress import Remembering

STANDARD_OUTPUT = "standard output"
_typed: list[str] = []
_memory = Remembering()


def configure_logging(verbose: bool) -> None:
    """Send the library's messages to stderr: notes by default, everything with -v; warnings as one line each."""
    logger = logging.getLogger("freegeo")
    logger.handlers.clear()
    handler = logging.StreamHandler()
    handler.setFormatter(_Formatter())
    logger.addHandler(handler)
    logger.addHandler(_memory)
    _memory.sentences.clear()
    logger.setLevel(logging.DEBUG if verbose else logging.INFO)
    logger.propagate = False
    warnings.showwarning = _show_warning  # ty: ignore[invalid-assignment]
    if not verbose:
        # Pillow warns of odd metadata in files that it can read nevertheless.
        warnings.filterwarnings("ignore", category=UserWarning, module="PIL")


class _Formatter(logging.Formatter):
    """Messages as they are; warnings say that they are warnings."""

    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        return f"warning: {text}" if record.levelno >= logging.WARNING else text


def warned() -> list[str]:
    """Return the warnings of this command so far: the list itself, which later warnings are added to.

    Any module warns of a doubtful result with `logging.getLogger(__name__).warning`, in one sentence; the log, the
    summary (`reconstruction.json`) and the report show it.
    """
    return _memory.sentences


def _show_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, file=None, line: str | None = None
) -> None:
    """Replace Python's own function, which also prints a line of source code."""
    note(f"warning: {message}")


def remember_command(arguments: Sequence[str]) -> None:
    """Keep the command line, for files that say how they were made."""
    _typed[:] = ["freegeo", *arguments]


def command_line() -> str:
    """Return the command line as it could be typed."""
    return shlex.join(_typed)


def prepare_streams() -> None:
    """Make stdout and stderr take any text: letters that their encoding lacks are escaped, and a closed one is mute."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115 (for the whole process)
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def finish_streams() -> None:
    """Write out what stdout and stderr hold back; what cannot be written is dropped, without a traceback at the end."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):
            _write("", stream)


def say(text: str = "") -> None:
    """Print a line of a command's result."""
    _write(f"{text}\n", sys.stdout)


def note(text: str) -> None:
    """Print a line about the progress of a command to stderr."""
    _write(f"{text}\n", sys.stderr)


def _write(text: str, stream: TextIO) -> None:
    """Write and flush; a reader that went away (`| head`) does not stop the work of the command."""
    try:
        stream.write(text)
        stream.flush()
    except OSError as error:
        # Nothing is tried again when the process ends.
        with contextlib.suppress(OSError), Path(os.devnull).open("w") as nowhere:
            os.dup2(nowhere.fileno(), stream.fileno())
        if error.errno not in (errno.EPIPE, errno.EINVAL):  # the second on Windows
            raise OSError(error.errno, error.strerror, STANDARD_OUTPUT) from None


def fail(sentence: str, code: int) -> int:
    """Print why a command stopped and return its exit code, also where nothing can be printed."""
    with contextlib.suppress(OSError):
        note(f"freegeo: {sentence}")
    return code


def table(header: Sequence[str], rows: Iterable[Sequence[str]], *, prose: int = 0) -> str:
    """Lay out a plain table: first column to the left, the others to the right.

    `prose` > 0: the last column is text, to the left and wrapped, so that lines have at most `prose` characters.
    """
    cells = [list(header), *(list(row) for row in rows)]
    if prose:
        room = prose - sum(max(len(row[k]) for row in cells) + 2 for k in range(len(header) - 1))
        cells = [line for row in cells for line in _wrapped(row, room)]
    widths = [max(len(row[k]) for row in cells) for k in range(len(header))]
    left = {0, len(header) - 1} if prose else {0}
    lines = [
        "  ".join(c.ljust(w) if k in left else c.rjust(w) for k, (c, w) in enumerate(zip(row, widths, strict=True)))
        for row in [*cells[:1], ["-" * w for w in widths], *cells[1:]]
    ]
    return "\n".join(line.rstrip() for line in lines)


def _wrapped(row: list[str], room: int) -> list[list[str]]:
    """Spread a row over as many lines as its last cell needs."""
    parts = textwrap.wrap(row[-1], room) or [""]
    blank = [""] * (len(row) - 1)
    return [[*(row[:-1] if k == 0 else blank), part] for k, part in enumerate(parts)]


def written(folder: Path, files: Mapping[str, str]) -> None:
    """List the files of a result that exist, each with its purpose."""
    rows = []
    for name, about in files.items():
        path = folder / name
        if path.exists():
            rows.append((str(path), size(path), about))
    say(f"\nWritten to {folder}:")
    width = max((len(row[0]) for row in rows), default=0)
    for path, amount, about in rows:
        say(f"  {path.ljust(width)}  {amount:>9}  {about}")


def size(path: Path) -> str:
    """Return the size of a file or folder as text."""
    total = sum(p.stat().st_size for p in path.rglob("*") if p.is_file()) if path.is_dir() else path.stat().st_size
    return size_text(total)
