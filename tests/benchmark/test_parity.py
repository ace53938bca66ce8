"""Recorded values of the published evaluation; the slow scores of full scenes run in `make parity`."""

from pathlib import Path

import pytest

from fixture_tools import fixture_path
from parity_benchmark import cases

QUICK_SCORES = ("eth3d/pipes/recon_unposed/score",)
FOLDER = Path(fixture_path("benchmark"))


def _is_quick(name: str) -> bool:
    return name in QUICK_SCORES or not (name.endswith("/score") or "/pipeline/" in name)


@pytest.mark.parametrize("check", [pytest.param(check, id=name) for name, check in cases(FOLDER) if _is_quick(name)])
def test_matches_the_recorded_values(check):
    assert check() <= 1
