from functools import cache

import numpy as np
import pytest
import torch

from freegeo.data.procedural import render, sample_rooms
from freegeo.errors import UserError
from freegeo.fusion.agreement import Votes, look_up, nearest_views, prepare, vote
from freegeo.fusion.filtering import confident_pixels, filter_pixels, flying_pixels
from freegeo.fusion.settings import FilterSettings

GOOD, FLYING, OUTLIER, PATCH, TOUCHED = range(5)


@cache
def rendered(seed, views=6, hw=(96, 128)):
    views = render(sample_rooms([seed], frames=views), *hw)
    return views.depth_z[0], views.T_cam_world[0], views.K[0]


def spoiled(depth_z, seed, *, patches):
    """Depth with blurred edges, wild single pixels and (optionally) wild discs; and the kind of each pixel."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator)

    padded = torch.nn.functional.pad(depth_z[:, None], (1, 1, 1, 1), mode="replicate")
    far = torch.nn.functional.max_pool2d(padded, 3, 1)[:, 0]
    near = -torch.nn.functional.max_pool2d(-padded, 3, 1)[:, 0]
    result, kind = depth_z.clone(), torch.zeros_like(depth_z, dtype=torch.int8)
    edge = (far / near > 1.15) & (uniform(depth_z.shape) < 0.7)
    blend = near + (0.3 + 0.4 * uniform(depth_z.shape)) * (far - near)
    result[edge] = blend[edge]
    kind[edge] = FLYING
    kind[edge & ((blend / depth_z - 1).abs() < 0.05)] = TOUCHED  # close enough to the truth to be neither
    wild = torch.exp((0.15 + uniform(depth_z.shape)) * torch.where(uniform(depth_z.shape) < 0.5, -1.0, 1.0))
    single = (uniform(depth_z.shape) < 0.04) & (kind == GOOD)
    result[single] = (depth_z * wild)[single]
    kind[single] = OUTLIER
    if patches:
        rows, columns = torch.meshgrid(*(torch.arange(side) for side in depth_z.shape[1:]), indexing="ij")
        for view in range(len(depth_z)):
            row, column, factor = uniform(3).tolist()
            middle = (row * depth_z.shape[1], column * depth_z.shape[2])
            disc = (rows - middle[0]) ** 2 + (columns - middle[1]) ** 2 <= 8**2
            result[view][disc] = depth_z[view][disc] * (0.6 + 0.2 * factor)
            kind[view][disc] = PATCH
    return result, kind


def filtered(depth_z, T_cam_world, K, **options):
    conf = torch.ones_like(depth_z)
    keep, report = filter_pixels(*(t.numpy() for t in (depth_z, conf, T_cam_world, K)), **options)
    return torch.from_numpy(keep), report


def votes_on(depth_z, T_cam_world, K, tolerance):
    """Votes on all views, (S, H, W), where all pixels are usable."""
    everywhere = torch.ones_like(depth_z, dtype=torch.bool)
    found = dict(vote(prepare(depth_z, T_cam_world, K, everywhere, tolerance=tolerance)))
    assert sorted(found) == list(range(len(depth_z)))
    names = ("agree", "contradict", "asked")
    return Votes(**{n: torch.stack([getattr(found[view], n) for view in sorted(found)]) for n in names})


def test_injected_flying_pixels_and_outliers_go_and_good_points_stay():
    lost = {GOOD: [], FLYING: [], OUTLIER: []}
    for seed in (0, 1, 7, 11):
        depth_z, T_cam_world, K = rendered(seed)
        wrong, kind = spoiled(depth_z, seed, patches=False)
        keep, _ = filtered(wrong, T_cam_world, K)
        for name, removed in lost.items():
            removed.append(~keep[kind == name])
    share = {name: float(torch.cat(removed).float().mean()) for name, removed in lost.items()}
    assert share[FLYING] >= 0.9
    assert share[OUTLIER] >= 0.95
    assert share[GOOD] <= 0.05


def test_exact_depth_is_left_alone():
    for seed in (0, 1, 7, 11):
        keep, report = filtered(*rendered(seed))
        assert float(keep.float().mean()) >= 0.98
        assert report.tolerance == pytest.approx(0.02, abs=0.005)


def test_whole_patches_in_front_of_a_surface_are_outvoted_where_others_look():
    depth_z, T_cam_world, K = rendered(7)
    wrong, kind = spoiled(depth_z, 1, patches=True)
    keep, _ = filtered(wrong, T_cam_world, K)
    alone, _ = filtered(wrong, T_cam_world, K, settings=FilterSettings(multi_view=False))
    looked_at = votes_on(depth_z, T_cam_world, K, 0.02).agree > 1
    patch = (kind == PATCH) & looked_at
    assert patch.sum() > 300
    assert float(keep[patch].float().mean()) < 0.1
    assert float(alone[patch].float().mean()) > 0.6, "the test is about votes: one view alone cannot tell"


def test_votes_count_views_that_agree_and_that_see_through():
    # A wall at z = 2 seen by three cameras side by side; the first believes that it is at z = 1 in one place.
    depth_z = torch.full((3, 20, 30), 2.0)
    depth_z[0, 8:12, 13:17] = 1.0
    K = torch.tensor([[40.0, 0, 14.5], [0, 40.0, 9.5], [0, 0, 1]]).repeat(3, 1, 1)
    T_cam_world = torch.eye(4).repeat(3, 1, 1)
    T_cam_world[:, 0, 3] = torch.tensor([0.0, -0.1, 0.1])
    votes = votes_on(depth_z, T_cam_world, K, 0.05)
    assert (votes.agree[0, 9:11, 14:16] == 0).all()
    assert (votes.contradict[0, 9:11, 14:16] >= 2).all()
    assert (votes.agree[0, 2:6, 10:20] == 2).all()
    assert (votes.contradict[0, 2:6, 10:20] == 0).all()
    assert (votes.asked[0, 2:6, 10:20] == 2).all()
    keep, _ = filtered(depth_z, T_cam_world, K, settings=FilterSettings(flying=False, tolerance=0.05))
    assert not keep[0, 8:12, 13:17].any()
    assert keep[1:].float().mean() > 0.99


def test_what_only_one_view_sees_stays():
    depth_z = torch.full((2, 12, 16), 2.0)
    K = torch.tensor([[20.0, 0, 7.5], [0, 20.0, 5.5], [0, 0, 1]]).repeat(2, 1, 1)
    T_cam_world = torch.eye(4).repeat(2, 1, 1)
    T_cam_world[1, 0, 3] = -50.0
    keep, report = filtered(depth_z, T_cam_world, K)
    assert keep.all()
    assert report.removed["multi-view"] == 0


def test_confirmation_can_be_demanded():
    depth_z, T_cam_world, K = rendered(7)
    agree = votes_on(depth_z, T_cam_world, K, 0.02).agree
    demanded, _ = filtered(
        depth_z, T_cam_world, K, settings=FilterSettings(flying=False, min_agreeing=2, min_asked=0, tolerance=0.02)
    )
    assert (agree[demanded] >= 2).all()
    assert float(demanded[agree >= 2].float().mean()) > 0.97
    assert 0.2 < demanded.float().mean() < 0.9


def test_a_slanted_plane_has_no_flying_pixels_but_a_step_between_two_walls_has():
    column = torch.arange(40.0)
    plane = (1 / (0.2 + 0.02 * column)).expand(1, 30, 40).clone()  # a wall receding at a steep angle
    K = torch.tensor([[[40.0, 0, 20], [0, 40.0, 15], [0, 0, 1]]])
    assert not flying_pixels(plane, K).any()
    step = torch.where(column < 20, 1.0, 3.0).expand(1, 30, 40).clone()
    assert not flying_pixels(step, K).any(), "the rims of both walls are real"
    step[:, :, 20] = 2.0
    assert flying_pixels(step, K)[:, :, 20].all()
    assert flying_pixels(step, K).sum() == 30


def test_invalid_depth_is_counted_once_and_never_kept():
    depth_z, T_cam_world, K = rendered(7, views=2, hw=(24, 32))
    depth_z = depth_z.clone()
    depth_z[0, :3] = torch.nan
    depth_z[1, 0, 0] = 0
    keep, report = filtered(depth_z, T_cam_world, K)
    assert report.removed["invalid depth"] == 3 * 32 + 1
    assert not keep[0, :3].any()
    assert report.kept == int(keep.sum())


def test_every_filter_reports_what_it_removed():
    depth_z, T_cam_world, K = (t.numpy() for t in rendered(7, views=3, hw=(24, 32)))
    conf = np.random.default_rng(0).permutation(depth_z.size).reshape(depth_z.shape).astype(np.float32)
    masks = np.ones(depth_z.shape, bool)
    masks[:, :, :4] = False
    sky = np.zeros(depth_z.shape, np.float32)
    sky[:, :6] = 0.9
    keep, report = filter_pixels(depth_z, conf, T_cam_world, K, sky=sky, masks=masks)
    assert list(report.removed) == ["invalid depth", "mask", "sky or ambiguous", "confidence", "flying", "multi-view"]
    assert report.removed["mask"] == 3 * 24 * 4
    assert report.removed["sky or ambiguous"] == 3 * 6 * 28
    assert report.removed["confidence"] == pytest.approx(0.4 * 3 * 18 * 28, abs=2)
    assert report.pixels - sum(report.removed.values()) == report.kept == keep.sum()
    assert not keep[:, :6].any()
    assert not keep[:, :, :4].any()
    assert "mask 12.5 %" in report.summary()
    off = FilterSettings(drop_share=0, flying=False, multi_view=False, sky_limit=2)
    everything, report = filter_pixels(depth_z, conf, T_cam_world, K, sky=sky, settings=off)
    assert everything.all()
    assert report.tolerance is None


def test_a_confidence_threshold_is_shared_by_the_views():
    conf = torch.stack((torch.full((4, 5), 1.0), torch.full((4, 5), 2.0)))
    keep = confident_pixels(conf, torch.ones_like(conf, dtype=torch.bool), drop_share=0.5)
    assert not keep[0].any() or keep[0].all()
    assert keep[1].all()
    ranked = torch.arange(40.0).view(2, 4, 5)
    assert confident_pixels(ranked, torch.ones_like(keep), drop_share=0.5).sum() in (20, 21)


def test_bad_settings_and_masks_are_refused():
    for settings in ({"drop_share": 1.0}, {"tolerance": 0.0}, {"min_agreeing": -1}, {"min_asked": -1}):
        with pytest.raises(UserError):
            FilterSettings(**settings)
    depth_z, T_cam_world, K = (t.numpy() for t in rendered(7, views=2, hw=(24, 32)))
    with pytest.raises(UserError, match="do not fit"):
        filter_pixels(depth_z, np.ones_like(depth_z), T_cam_world, K, masks=np.ones((2, 24, 31), bool))


def test_the_neighbours_are_the_similar_views():
    _, T_cam_world, _ = rendered(7)
    chosen = nearest_views(T_cam_world, 2)
    assert chosen.shape == (6, 2)
    assert all(view not in row for view, row in enumerate(chosen.tolist()))
    assert chosen[0, 0] == 1, "a trajectory's first view is most like its second"
    assert nearest_views(T_cam_world[:1]).shape == (1, 0)


def test_a_lookup_finds_the_pixel_and_the_depth():
    depth_z, T_cam_world, K = rendered(7)
    seen = look_up(prepare(depth_z, T_cam_world, K, torch.ones_like(depth_z).bool(), tolerance=0.02), 0, 1)
    assert 0.3 < seen.asked.float().mean() < 1
    assert seen.agrees[seen.asked].float().mean() > 0.8
    assert not (seen.agrees & seen.sees_through).any() or (seen.agrees & seen.sees_through).float().mean() < 1e-3
    assert float(seen.difference[seen.agrees].abs().median()) < 0.005
