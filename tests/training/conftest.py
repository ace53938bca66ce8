import pytest

from freegeo.training import pool
from freegeo.training.config import TrainConfig
from freegeo.training.pool import render_rooms

ROOMS = 2


@pytest.fixture
def small_shards(monkeypatch):
    """Two rooms a shard instead of 96."""
    monkeypatch.setattr(pool, "ROOMS_PER_SHARD", ROOMS)


@pytest.fixture(scope="session")
def small_config():
    return TrainConfig(views=40, views_per_step=4, rooms=6, frames=4, warmup_views=8, depth_views=1, cooldown=0.25)


@pytest.fixture(scope="session")
def rooms():
    """Two rooms seen four times."""
    return render_rooms([5, 6], "train", 4, (48, 64))
