"""The machine: the main memory it leaves this process, answers to its signals, and numbers of bytes as text."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

PROC, CGROUPS = Path("/proc"), Path("/sys/fs/cgroup")
PARENT_VARIABLE = "FREEGEO_END_WITH_PARENT"
"""Environment variable of a process whose standard input closes when the process that started it is gone."""
GRACE_S = 20.0
"""Seconds that a process has to save its state when it is asked to end, before it is ended."""
_UNLIMITED = 1 << 60
"""Limits of a control group from here on mean that there is none."""


def size_text(count: float) -> str:
    """Return the size of a file in bytes as text: 512 B, 3.4 kB, 20.0 MB, 1.5 GB."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} GB"


def gigabytes(count: float) -> str:
    """Return bytes of memory, of a disk or of a download as text: in GB from .05 GB on, else as `size_text`."""
    return f"{count / 1e9:.1f} GB" if count >= 5e7 else size_text(count)


def host_available() -> int:
    """Bytes of main memory that are free or can be freed, within the limits of containers and batch systems."""
    return max(0, min([_of_machine(), *_of_groups()]))


def exhausted_memory(error: BaseException) -> Literal["device", "machine"] | None:
    """Say whose memory an error of PyTorch or Python found exhausted; None for other errors."""
    text = str(error)
    of_torch = type(error).__name__ in ("OutOfMemoryError", "AcceleratorError") and "out of memory" in text
    # The libraries of CUDA (cuBLAS, cuDNN) and the allocator of main memory raise a plain RuntimeError.
    if of_torch or "MPS backend out of memory" in text or "_STATUS_ALLOC_FAILED" in text:
        return "device"
    if isinstance(error, MemoryError) or "can't allocate memory" in text or "not enough memory" in text:
        return "machine"
    return None


def _of_machine() -> int:
    for line in _text(PROC / "meminfo").splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return 8 << 30


def _of_groups() -> list[int]:
    """Bytes that each control group of this process, and each one around it, leaves; empty where none has a limit."""
    left = []
    for line in _text(PROC / "self" / "cgroup").splitlines():
        _, controllers, name = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        root = CGROUPS / "memory" if controllers else CGROUPS
        group = root / name.strip("/")
        # In a container the names are those outside of it; what is mounted there is the container's own group.
        around = (group, *group.parents) if group.is_dir() else (root,)
        left += [free for place in around if place.is_relative_to(root) and (free := _left(place)) is not None]
    return left


def _left(group: Path) -> int | None:
    """Bytes below the limit of a control group, pages of files that can be dropped counted as free."""
    for limit_file, used_file, cached in (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    ):
        limit, used = _text(group / limit_file).strip(), _text(group / used_file).strip()
        if limit.isdigit() and used.isdigit() and int(limit) < _UNLIMITED:
            facts = dict(line.split(" ", 1) for line in _text(group / "memory.stat").splitlines() if " " in line)
            return int(limit) - int(used) + int(facts.get(cached, 0))
    return None


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


def bound_to_this_process() -> dict[str, Any]:
    """Return arguments of `subprocess.Popen` for a freegeo command that ends when this process is gone.

    Its standard input is a pipe that nothing is written to and that this process holds open: the system closes it
    however this process ends, and `end_with_parent` in the command notices.
    """
    return {"stdin": subprocess.PIPE, "env": {**os.environ, PARENT_VARIABLE: "1"}}


def end_with_parent() -> None:
    """Ask this process to end, as SIGTERM does, when the one that started it with `bound_to_this_process` is gone.

    It is ended after `GRACE_S` seconds if it does not do so itself. Nothing happens in a process started otherwise.
    """
    if os.environ.pop(PARENT_VARIABLE, None) is not None:
        threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    # Not through sys.stdin, whose lock would stop the interpreter at its end.
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE_S)
    os._exit(128 + signal.SIGTERM)


@contextmanager
def signals_held() -> Generator[None]:
    """Let Ctrl-C (and SIGTERM, where the program handles it) wait until the block has ended.

    What is inside, such as a step of an optimiser, is done wholly or not at all.
    """
    if threading.current_thread() is not threading.main_thread():  # Signals reach the main thread only.
        yield
        return
    waiting: list[Any] = []
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    handlers = {number: handler for number, handler in handlers.items() if callable(handler)}
    for number in handlers:
        signal.signal(number, lambda *arguments: waiting.append(arguments))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number, frame in waiting:
            handlers[number](number, frame)


@contextmanager
def sigterm_kept() -> Generator[None]:
    """Keep this process's answer to SIGTERM while a library is imported that puts a handler of its own there."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        if before is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before)
