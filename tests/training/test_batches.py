import itertools
from dataclasses import replace

import pytest
import torch

from freegeo.geometry import se3
from freegeo.training.batches import augment, shrink, to_batch, windows
from freegeo.training.config import Phase, TrainConfig
from freegeo.training.objective import cell_targets, partners

PHASE = Phase(views=(4,), max_stride=3, reach=10, side=64)


def test_windows_are_evenly_spaced_inside_and_go_both_ways():
    generator = torch.Generator().manual_seed(0)
    seen = windows(200, 10, 4, PHASE, generator).tolist()
    for frames in seen:
        strides = {b - a for a, b in itertools.pairwise(frames)}
        assert len(strides) == 1
        assert min(frames) >= 0 and max(frames) <= 9
    assert {abs(frames[1] - frames[0]) for frames in seen} == {1, 2, 3}
    assert {frames[1] > frames[0] for frames in seen} == {True, False}
    assert {tuple(frames) for frames in windows(20, 8, 8, PHASE, generator).tolist()} == {
        tuple(range(8)), tuple(range(7, -1, -1))
    }  # fmt: skip


def test_any_view_may_come_first_and_the_others_stay_in_order():
    generator = torch.Generator().manual_seed(0)
    phase = replace(PHASE, any_reference=1.0)
    seen = windows(200, 4, 4, phase, generator).tolist()
    assert {frames[0] for frames in seen} == {0, 1, 2, 3}
    assert all(frames[1:] in (sorted(frames[1:]), sorted(frames[1:], reverse=True)) for frames in seen)
    assert all(sorted(frames) == [0, 1, 2, 3] for frames in seen)


@pytest.mark.parametrize(("views", "strides"), [(2, {1, 2, 3}), (4, {1, 2, 3}), (6, {1, 2}), (8, {1}), (16, {1})])
def test_windows_spread_within_their_reach_only(views, strides):
    generator = torch.Generator().manual_seed(0)
    seen = windows(100, 16, views, PHASE, generator).tolist()
    assert {abs(frames[1] - frames[0]) for frames in seen} == strides


def test_samples_live_in_the_first_camera_and_in_mean_depths(rooms):
    batch = to_batch(rooms)
    torch.testing.assert_close(batch.T_world_cam[:, 0], torch.eye(4).expand(2, 4, 4), atol=1e-5, rtol=0)
    torch.testing.assert_close(batch.depth_z.mean(dim=(1, 2, 3)), torch.ones(2))
    scale = rooms.depth_z.float().mean(dim=(1, 2, 3))
    metric = se3.inverse(rooms.T_cam_world)[..., :3, 3]
    baseline = (metric[:, 1:] - metric[:, :1]).norm(dim=-1) / scale[:, None]
    torch.testing.assert_close(batch.T_world_cam[:, 1:, :3, 3].norm(dim=-1), baseline, atol=1e-4, rtol=1e-4)


def patch_colours(batch, grid_hw):
    """Mean brightness of every patch, (B, S, P)."""
    grey = batch.images.mean(2)
    return torch.nn.functional.adaptive_avg_pool2d(grey, grid_hw).flatten(2)


@pytest.mark.parametrize("change", ["none", "augment", "shrink"])
def test_partner_patches_show_the_same_thing(rooms, change):
    batch = to_batch(rooms)
    batch = augment(batch, torch.Generator().manual_seed(3)) if change == "augment" else batch
    batch = shrink(batch, 0.75, 8) if change == "shrink" else batch
    grid = (batch.images.shape[-2] // 8, batch.images.shape[-1] // 8)
    target, visible = partners(batch, grid, torch.tensor([0, 1]), torch.tensor([1, 2]))
    assert visible.float().mean() > 0.3
    colours = patch_colours(batch, grid)
    here, there = colours[:, [0, 1]], colours[:, [1, 2]]
    other = there.roll(7, dims=-1).gather(-1, target)
    partner = there.gather(-1, target)
    right, wrong = ((x - here).abs()[visible].mean() for x in (partner, other))
    assert right < 0.6 * wrong


def test_a_mirrored_sample_is_still_one_world(rooms):
    batch = to_batch(rooms)
    tries = (augment(batch, torch.Generator().manual_seed(seed)) for seed in range(100))
    unchanged = (
        (changed, [torch.equal(a, b) for a, b in zip(batch.depth_z, changed.depth_z, strict=True)]) for changed in tries
    )
    changed, mirrored = next((changed, [not same for same in kept]) for changed, kept in unchanged if sum(kept) == 1)
    first = mirrored.index(True)
    before, after = cell_targets(batch, 8).point[first], cell_targets(changed, 8).point[first]
    # Cells sit half a pixel right of the middle of an even patch, so a mirrored cell is off by one pixel.
    flipped = before.flip(2) * torch.tensor([-1.0, 1.0, 1.0])
    assert (flipped - after).norm(dim=-1).median() < 0.05
    determinant = torch.linalg.det(changed.T_world_cam[..., :3, :3])
    torch.testing.assert_close(determinant, torch.ones_like(determinant))


def test_phases_grow_longer_and_larger():
    config = TrainConfig()
    phases = [config.phase(seen) for seen in (0, 700_000, 1_600_000, 3_700_000)]
    assert [max(phase.views) for phase in phases] == sorted(max(phase.views) for phase in phases)
    assert [phase.side for phase in phases] == [72, 72, 72, 96]


def test_rate_warms_up_stays_and_cools_down():
    config = TrainConfig(views=100_000, warmup_views=1000, cooldown=0.2)
    assert config.rate(0) == 0
    assert config.rate(500) == pytest.approx(0.5)
    assert config.rate(1000) == config.rate(80_000) == 1
    assert config.rate(90_000) == pytest.approx(0.25)
    assert config.rate(100_000) == 0


def test_the_schedule_follows_the_time_where_that_runs_out_first():
    config = TrainConfig(views=100_000, minutes=1.0)
    assert config.position(20_000, 6.0) == 20_000
    assert config.position(20_000, 30.0) == 50_000
    assert config.position(0, 60.0) == 100_000 and config.rate(config.position(0, 60.0)) == 0
    continued = replace(config, begin=(10, 40_000))
    assert continued.position(40_000, 30.0) == 70_000
    assert replace(config, minutes=0.0).position(20_000, 1e9) == 20_000
