"""Processes below another one, for tests that kill some of them (Linux only)."""

import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

needs_proc = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks for processes in /proc")


def descendants(pid: int) -> dict[int, str]:
    """The processes that a process started, and those that they started, with their command lines."""
    parents: dict[int, int] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                # The name of the program, in brackets, may hold anything.
                parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:
                continue
    found: dict[int, str] = {}
    waiting = [pid]
    while waiting:
        above = waiting.pop()
        for child in (child for child, parent in parents.items() if parent == above):
            waiting.append(child)
            try:
                line = Path(f"/proc/{child}/cmdline").read_bytes()
            except OSError:
                continue
            found[child] = line.replace(b"\0", b" ").decode(errors="replace").strip()
    return found


def kill_one(pid: int, words: str, ready: Callable[[], bool], *, seconds: float = 240) -> None:
    """Kill one of the processes below `pid` that have the words in their command line, as soon as it is `ready`."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if ready():
            chosen = next((child for child, command in descendants(pid).items() if words in command), None)
            if chosen is not None:
                os.kill(chosen, signal.SIGKILL)
                return
        time.sleep(0.02)
    raise AssertionError(f"no process with {words!r} was there to be killed")
