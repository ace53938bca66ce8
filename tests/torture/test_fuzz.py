"""A small part of the fuzzer in every run of the suite; `make torture` runs the long one."""

import pytest

from torture.fuzz import fuzz

QUICK = (
    "matches.npz", "weights", "weights index", "adapter config", "adapter notes", "adapter state", "photo .jpg",
)  # fmt: skip


def faults(outcomes) -> list[str]:
    return [f"{name}: {fault}" for name, outcome in outcomes.items() for fault in outcome.faults]


def test_damaged_files_are_read_or_refused_in_one_sentence(tmp_path):
    outcomes = fuzz(tmp_path, 10 * len(QUICK), 0, QUICK)
    assert faults(outcomes) == []
    assert sum(outcome.cases for outcome in outcomes.values()) == 10 * len(QUICK)
    # Mutations that nothing reads, or that all are refused at the first byte, would test nothing.
    assert all(outcomes[name].refused for name in QUICK if name != "matches.npz")


@pytest.mark.slow
def test_every_reader(tmp_path):
    assert faults(fuzz(tmp_path, 1_000, 1)) == []
