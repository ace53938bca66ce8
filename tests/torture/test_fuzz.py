"""Damaged files of every kind: each is read, or refused in one sentence; `make torture` tries more of them."""

import pytest

from torture.fuzz import NAMES, fuzz

QUICK = (
    "matches.npz", "weights", "weights index", "adapter config", "adapter notes", "adapter state", "photo .jpg",
)  # fmt: skip
MADE_AGAIN = {"matches.npz", "bench scores"}
"""What is computed again where the file is damaged."""
SHARES = 4


def faults(outcomes) -> list[str]:
    return [f"{name}: {fault}" for name, outcome in outcomes.items() for fault in outcome.faults]


def test_damaged_files_are_read_or_refused_in_one_sentence(tmp_path):
    outcomes = fuzz(tmp_path, 10 * len(QUICK), 0, QUICK)
    assert faults(outcomes) == []
    assert sum(outcome.cases for outcome in outcomes.values()) == 10 * len(QUICK)
    # Mutations that nothing reads, or that all are refused at the first byte, would test nothing.
    assert all(outcomes[name].refused for name in QUICK if name not in MADE_AGAIN)


@pytest.mark.slow
@pytest.mark.parametrize("share", range(SHARES))
def test_every_kind(tmp_path, share):
    outcomes = fuzz(tmp_path, 10_000 // SHARES, 1, NAMES[share::SHARES])
    assert faults(outcomes) == []
    assert all(outcome.refused for name, outcome in outcomes.items() if name not in MADE_AGAIN)
