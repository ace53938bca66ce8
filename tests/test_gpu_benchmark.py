"""The measurements for a CUDA device run on the CPU with tiny shapes: every line works before a device is at hand."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SCRIPT = ROOT / "benchmarks" / "gpu.py"
PARTS = ("steps", "job", "plain", "reconstruct", "precision", "fusion", "families", "compile")


def run(*arguments: object) -> subprocess.CompletedProcess:
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_every_part_runs_dry_and_a_second_call_repeats_nothing(tmp_path):
    done = run("--dry-run", "--out", tmp_path, *PARTS)
    assert done.returncode == 0, done.stdout + done.stderr
    for part in PARTS:
        record = json.loads((tmp_path / f"gpu-{part}.json").read_text())
        assert record["results"] and record["settings"]["dry_run"]
        assert not [name for name, found in record["results"].items() if "error" in found], record["results"]
    again = run("--dry-run", "--out", tmp_path, *PARTS)
    assert again.stdout.splitlines() == [f"{part}: already there" for part in PARTS]


def test_a_part_that_does_not_exist_is_refused(tmp_path):
    done = run("speed", "--out", tmp_path)
    assert done.returncode == 2
    assert "unknown part speed; choose among parity, commands, steps" in done.stderr
