"""The loss reproduces the recorded values, gradients and anchors of the released code and of the paper's equations."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
sys.path.append(str(TESTS))  # parity_losses.py is shared with the full parity run and lies beside this folder

from parity_losses import cases  # noqa: E402

RECORDED = dict(cases(TESTS / "fixtures" / "losses"))


def test_recorded_cases_are_found():
    assert len(RECORDED) == 16


@pytest.mark.parametrize("check", RECORDED.values(), ids=RECORDED.keys())
def test_recorded_case(check: Callable[[], float]):
    assert check() <= 1
