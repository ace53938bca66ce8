"""A small part of the tests that crash and disturb whole commands; `make torture` runs the long ones."""

import os
import subprocess
import sys

import pytest

from torture.faults import can_mount

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks, mounts and /proc")
QUICK = ("no space", "read-only", "handles", "SIGINT", "SIGTERM", "no locks")


def in_own_process(code: str) -> str:
    """Run code in a new process: what is loaded and forked here must not be mixed with other tests."""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=240,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OMP_NUM_THREADS": "1"}, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(("command", "every"), [("adapt", 4), ("batch", 8)])
def test_a_killed_command_ends_as_if_never_stopped(tmp_path, command, every):
    code = f"""
from pathlib import Path
from torture.crash import crash
o = crash(Path({str(tmp_path)!r}), {command!r}, count=5, every={every}, completions=1)
print(o.faults, o.points >= 2, o.kills >= 5, o.completions >= 1)
"""
    assert in_own_process(code).splitlines()[-1] == "[] True True True"


@pytest.mark.slow
def test_a_disturbed_command_ends_in_a_sentence_and_continues(tmp_path):
    kinds = (*QUICK, "small disk") if can_mount() else QUICK
    code = f"""
from pathlib import Path
from torture.faults import disturb
outcomes = disturb(Path({str(tmp_path)!r}), "export", {kinds!r}, 2)
print([fault for o in outcomes.values() for fault in o.faults], all(o.cases == 2 for o in outcomes.values()))
"""
    assert in_own_process(code).splitlines()[-1] == "[] True"


@pytest.mark.slow
def test_pycolmap_leaves_the_answer_to_sigterm_alone():
    """Else a run would die in a C++ stack trace instead of saving its state."""
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    code = """
import os, signal
from freegeo.evidence.bundle import pycolmap_module
signal.signal(signal.SIGTERM, lambda *_: print("asked to end"))
pycolmap_module()
os.kill(os.getpid(), signal.SIGTERM)
"""
    assert in_own_process(code) == "asked to end\n"
