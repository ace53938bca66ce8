"""Small generated rooms and a model of random weights, so that a benchmark run takes seconds."""

from pathlib import Path

import pytest

from bench_tools import DATASET, ROOMS, small_room
from freegeo.benchmark import predict
from freegeo.benchmark.predict import Predictor, Setup
from freegeo.data.procedural import splits
from tiny_models import tiny_da3


@pytest.fixture
def small_rooms(monkeypatch):
    """Rooms are rendered small."""
    monkeypatch.setattr(splits, "photograph_room", lambda seed, domain, frames: small_room(seed, domain, frames))


@pytest.fixture
def tiny_model(monkeypatch, one_thread):
    """Every model name loads the same small model of random weights."""
    monkeypatch.setattr(predict, "load_model", lambda name, checkpoint=None: tiny_da3())


@pytest.fixture
def setup(tmp_path: Path, small_rooms, tiny_model) -> Setup:
    """A run on two rooms with two steps of adaptation."""
    return Setup(
        data=tmp_path / "data", out=tmp_path / "out", model="tiny-da3", device="cpu", recipe="paper",
        changes={"steps": 2, "batch": 1}, adapt_per="dataset", adapt_seed=42, scenes={DATASET: ROOMS},
    )  # fmt: skip


@pytest.fixture
def predictor(setup) -> Predictor:
    return Predictor(setup)
