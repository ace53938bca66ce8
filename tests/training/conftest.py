import pytest

from freegeo.training.config import TrainConfig
from freegeo.training.pool import render_rooms


@pytest.fixture(scope="session")
def small_config():
    return TrainConfig(
        views=40, views_per_step=4, rooms=6, rooms_per_shard=2, frames=4, warmup_views=8, depth_views=1, cooldown=0.25
    )


@pytest.fixture(scope="session")
def rooms():
    """Two rooms seen four times."""
    return render_rooms([5, 6], "train", 4, (48, 64))
