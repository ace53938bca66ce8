"""Long reconstructions: what is read view by view, and in parts, equals what is computed at once, to the bit."""

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from exact_rooms import cloud_of, room
from freegeo.export.formats import filter_reconstruction
from freegeo.export.mesh import voxel_size
from freegeo.fusion import agreement, quantile
from freegeo.fusion.points import thin_pixels, thin_points
from freegeo.fusion.quantile import median
from freegeo.fusion.tracks import build_tracks


def values_of(count, dtype, seed):
    """Values of both signs, with ties, zeros and infinities, in parts of different shapes."""
    rng = np.random.default_rng(seed)
    values = (rng.standard_normal(count) * 10.0 ** rng.integers(-20, 20, count)).astype(dtype)
    values[rng.random(count) < 0.2] = rng.choice([0.0, -0.0, 1.5, np.inf])
    return [part.reshape(1, -1) for part in np.array_split(values, [count // 7, count // 2])]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("count", [10, 11, 100, 10_001])
def test_order_statistics_in_parts_are_those_of_numpy(monkeypatch, dtype, count):
    monkeypatch.setattr(quantile, "HELD", 9)
    for seed in range(3):
        parts = values_of(count, dtype, seed)
        whole = np.concatenate([part.ravel() for part in parts])
        finite = [part[np.isfinite(part)] for part in parts]
        assert median(lambda parts=parts: parts) == np.median(whole)
        for q in (0.0, 0.25, 0.4, 0.5, 0.98, 1.0):
            assert quantile.quantile(lambda p=parts: p, q, method="lower") == np.quantile(whole, q, method="lower")
            if sum(map(len, finite)) > 9:
                found = quantile.quantile(lambda p=finite: p, q)
                expected = np.quantile(np.concatenate(finite), q)
                assert (found, found.dtype) == (expected, expected.dtype)


@pytest.mark.parametrize("held", [2, 100])
def test_order_statistics_of_nothing_and_of_what_is_no_number(monkeypatch, held):
    monkeypatch.setattr(quantile, "HELD", held)
    unknown = [np.array([1.0, 2.0], np.float32), np.array([np.nan, 3.0], np.float32)]
    for parts in ([], [np.zeros(0, np.float32)], unknown):
        assert np.isnan(median(lambda parts=parts: parts))
        assert np.isnan(quantile.quantile(lambda parts=parts: parts, 0.5))
        assert np.isnan(quantile.quantile(lambda parts=parts: parts, 0.5, method="lower"))


def test_thinned_pixels_are_the_thinned_list_of_all():
    keep = np.random.default_rng(0).random((7, 9, 11)) > 0.6
    keep[[0, 3, 6]] = False
    for limit in (None, 1, 20, int(keep.sum()) - 1, int(keep.sum()), 1000):
        expected = thin_points(np.flatnonzero(keep), max_points=limit, seed=5)
        np.testing.assert_array_equal(thin_pixels(keep, max_points=limit, seed=5), expected)
    assert thin_pixels(np.zeros((2, 3, 4), bool), max_points=5, seed=0).shape == (0,)


def walk():
    """Views that disagree here and there, one of them with padding, and a confidence."""
    scene, rng = room(9, (54, 70), 7), np.random.default_rng(1)
    depth = (scene.depth_z * np.exp(0.04 * rng.standard_normal(scene.depth_z.shape))).astype(np.float32)
    depth[0, :3] = np.nan
    scale, offset = scene.scale_xy.copy(), scene.offset_xy.copy()
    scale[2, 0], offset[2, 0] = 0.6 * scale[2, 0], 7
    conf = rng.random(depth.shape, dtype=np.float32)
    return replace(scene, depth_z=depth, conf=conf, scale_xy=scale, offset_xy=offset)


def results(scene):
    keep, report = filter_reconstruction(scene)
    tracks = build_tracks(
        scene.depth_z, *scene.cameras(), scene.images, keep, tolerance=report.tolerance, max_points=200
    )
    cloud = cloud_of(scene, keep=keep, max_points=300)
    values = [np.array(voxel_size(scene, keep))]
    return repr(report), [keep, *asdict(tracks).values(), *asdict(cloud).values(), *values]


def test_small_portions_change_nothing(monkeypatch):
    scene = walk()
    report, arrays = results(scene)
    monkeypatch.setattr(quantile, "HELD", 100)
    monkeypatch.setattr(agreement, "PREPARED", 2)
    again, others = results(scene)
    assert "multi-view" in report and report == again
    for one, two in zip(arrays, others, strict=True):
        np.testing.assert_array_equal(one, two)


def test_votes_are_complete_when_they_are_given():
    scene = walk()
    depth, T, K = (torch.from_numpy(a) for a in (scene.depth_z, *scene.cameras()))
    usable = torch.from_numpy(scene.valid_pixels())
    surfaces = agreement.prepare(depth, T, K, usable, tolerance=0.05, inside=torch.from_numpy(scene.inside()))
    expected = np.zeros((3, *depth.shape), int)
    neighbours = torch.tensor([[(view + step) % 9 for step in (1, 4, 5)] for view in range(9)])
    for source, others in enumerate(neighbours.tolist()):
        for target in others:
            seen = agreement.look_up(surfaces, source, target)
            expected[0, source] += seen.agrees.numpy()
            expected[1, source] += seen.sees_through.numpy()
            expected[2, source] += seen.asked.numpy()
            expected[1, target].reshape(-1)[np.unique(seen.nearest[seen.sees_through])] += 1
    found = dict(agreement.vote(surfaces, neighbours))
    assert sorted(found) == list(range(9))
    for view, votes in found.items():
        np.testing.assert_array_equal(np.stack((votes.agree, votes.contradict, votes.asked)), expected[:, view])
    assert expected[1].max() > 1


def test_few_votes_are_open_at_a_time_whatever_the_order_of_the_views():
    count = 200
    place = np.random.default_rng(0).permutation(count)  # of each view along the walk
    view = np.argsort(place)
    steps = (-3, -2, -1, 1, 2, 3)
    others = [[int(view[(place[one] + step) % count]) for step in steps] for one in range(count)]  # a closed loop
    order = agreement._close_together(others)
    assert sorted(order) == list(range(count))
    turn = np.argsort(order)
    assert max(abs(turn[one] - turn[other]) for one, targets in enumerate(others) for other in targets) <= 20
