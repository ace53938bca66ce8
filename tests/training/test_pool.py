import pytest
import torch

from freegeo.training.pool import ASPECTS, Pool, image_size, render_rooms


@pytest.fixture
def pool(tmp_path):
    return Pool(tmp_path, rooms=8, frames=2, side=64, patch=8, rooms_per_shard=2)


def test_sizes_are_whole_patches_of_every_aspect():
    assert [image_size(64, aspect, 8) for aspect in ASPECTS] == [(64, 64), (48, 64), (40, 64)]
    assert image_size(48, (3, 4), 8) == (40, 48)


def test_grows_to_its_size_and_no_further(pool):
    assert [pool.grow() for _ in range(5)] == [True, True, True, True, False]
    assert pool.complete
    assert [bank.images.shape[-2:] for bank in pool.banks] == [(64, 64), (48, 64), (40, 64)]
    assert pool.rooms == 8


def test_a_shard_read_back_is_the_shard_rendered(pool, tmp_path, monkeypatch):
    pool.grow()
    fresh = render_rooms([0, 1], "train", 2, (64, 64))
    again = Pool(tmp_path, rooms=8, frames=2, side=64, patch=8, rooms_per_shard=2)
    monkeypatch.delattr(Pool, "_render")
    assert again.grow()
    for name in ("images", "depth_z", "T_cam_world", "fov_vh"):
        assert torch.equal(getattr(again.banks[0], name)[:2], getattr(fresh, name))


def test_draws_depend_on_the_generator_alone(pool):
    while pool.grow():
        pass
    for seed in range(6):
        bank, picked = pool.draw(5, torch.Generator().manual_seed(seed))
        same_bank, again = pool.draw(5, torch.Generator().manual_seed(seed))
        assert bank is same_bank and torch.equal(picked, again)


def test_only_rooms_that_are_there_are_drawn(pool):
    for _ in range(4):
        pool.grow()
    drawn = [pool.draw(50, torch.Generator().manual_seed(seed)) for seed in range(20)]
    most = [max(int(picked.max()) for bank, picked in drawn if bank is own) for own in pool.banks]
    assert most == [3, 1, 1]  # the fourth shard has the first one's aspect
