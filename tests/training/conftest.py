import pytest

from freegeo.training.config import TrainConfig
from freegeo.training.pool import render_rooms


@pytest.fixture(scope="session")
def small_config():
    """A run of ten steps on the CPU that repeats itself to the bit and ends at the first number that is not finite."""
    return TrainConfig(
        minutes=0.0, views=40, side=64, views_per_step=4, rooms=6, rooms_per_shard=2, rooms_at_start=0,
        render_share=0.0, frames=4, warmup_views=8, cooldown=0.25, depth_views=1, broken_steps=0,
    )  # fmt: skip


@pytest.fixture(scope="session")
def rooms():
    """Two rooms seen four times."""
    return render_rooms([5, 6], "train", 4, (48, 64))
