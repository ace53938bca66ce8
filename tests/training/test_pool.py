import pytest
import torch

from freegeo.training.pool import ASPECTS, Pool, image_size, render_rooms


@pytest.fixture
def pool(tmp_path, small_shards):
    return Pool(tmp_path, rooms=8, frames=2, side=64, patch=8)


def test_sizes_are_whole_patches_of_every_aspect():
    assert [image_size(64, aspect, 8) for aspect in ASPECTS] == [(64, 64), (48, 64), (40, 64)]
    assert image_size(48, (3, 4), 8) == (40, 48)


def test_grows_to_its_size_and_no_further(pool):
    assert [pool.grow() for _ in range(5)] == [True, True, True, True, False]
    assert pool.complete
    assert [shard.images.shape[-2:] for shard in pool.shards[:3]] == [(64, 64), (48, 64), (40, 64)]


def test_a_shard_read_back_is_the_shard_rendered(pool, tmp_path):
    pool.grow()
    fresh = render_rooms([0, 1], "train", 2, (64, 64))
    again = Pool(tmp_path, rooms=8, frames=2, side=64, patch=8)
    assert again.grow(render_new=False)
    for name in ("images", "depth_z", "T_cam_world", "fov_vh"):
        assert torch.equal(getattr(again.shards[0], name), getattr(fresh, name))
    assert not again.grow(render_new=False)


def test_draws_depend_on_the_generator_alone_and_share_one_size(pool):
    while pool.grow():
        pass
    for seed in range(6):
        picks = pool.draw(5, torch.Generator().manual_seed(seed))
        again = pool.draw(5, torch.Generator().manual_seed(seed))
        assert [(id(rooms), room) for rooms, room in picks] == [(id(rooms), room) for rooms, room in again]
        assert len({rooms.images.shape[-2:] for rooms, _ in picks}) == 1
