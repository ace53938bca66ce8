"""Matches between rendered photos: right, repeatable, and absent without error where there is nothing to match."""

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
import pytest
import torch

from freegeo.data.photos import MemoryPhoto
from freegeo.data.procedural import photograph_room
from freegeo.evidence import matches as module
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.features import Features, RootSift
from freegeo.evidence.matches import (
    Matches,
    MatchSettings,
    Outcome,
    choose_pairs,
    find_matches,
    load_matches,
    stored_matches,
)
from freegeo.evidence.scores import epipolar, reprojection

FRAMES = 5


@cache
def room():
    return photograph_room(20_300_007, "tex", frames=FRAMES)


@cache
def found() -> Matches:
    return find_matches(room().photos)


def true_cameras() -> Candidate:
    scene = room()
    return Candidate(
        T_cam_world=scene.T_cam_world.double(),
        K=scene.K.double(),
        depth_z=scene.depth_z,
        scale_xy=torch.ones(FRAMES, 2, dtype=torch.float64),
        offset_xy=torch.zeros(FRAMES, 2, dtype=torch.float64),
    )


def larger(photo, factor: int) -> MemoryPhoto:
    return MemoryPhoto(photo.name, photo.read().repeat(factor, axis=0).repeat(factor, axis=1))


def named(name: str, pixels: np.ndarray) -> MemoryPhoto:
    return MemoryPhoto(name, np.ascontiguousarray(pixels))


def grey(name: str, level: int = 120) -> MemoryPhoto:
    return named(name, np.full((90, 120, 3), level, np.uint8))


def test_true_cameras_explain_the_matches():
    assert len(found().pairs) >= 3
    assert found().counts.min() >= MatchSettings().fewest
    assert epipolar(true_cameras(), found()).mean < 0.5
    assert reprojection(true_cameras(), found()).mean < 1.0
    assert found().reason() is None


def test_the_same_photos_give_the_same_matches():
    again = find_matches(room().photos)
    for name, value in found().arrays().items():
        np.testing.assert_array_equal(again.arrays()[name], value)


def test_places_are_in_pixels_of_the_photos_whatever_they_were_shrunk_to():
    doubled = [larger(photo, 2) for photo in room().photos]
    shrunk = find_matches(doubled, settings=MatchSettings(longest_side=256))
    np.testing.assert_array_equal(shrunk.match_hw, found().match_hw)
    np.testing.assert_array_equal(shrunk.ends, found().ends)
    # A pixel of the small photo covers 2 x 2 of the large one: its centre lies between them.
    np.testing.assert_allclose(shrunk.keypoints, 2 * found().keypoints + 0.5)
    np.testing.assert_allclose(shrunk.in_matching_pixels(), found().in_matching_pixels())


def test_a_place_is_one_keypoint_and_matched_once_in_a_pair():
    for view in range(FRAMES):
        low, high = found().view_start[view : view + 2]
        assert len(np.unique(found().keypoints[low:high], axis=0)) == high - low
    for pair, (i, j) in enumerate(found().pairs):
        ends = found().ends[found().pair_start[pair] : found().pair_start[pair + 1]]
        assert (found().view_of[ends] == (i, j)).all()
        for side in (0, 1):
            assert len(np.unique(ends[:, side])) == len(ends)
        first, second = found().of_pair(pair)
        assert len(first) == len(second) == found().counts[pair]


def test_photos_without_texture_are_no_evidence():
    nothing = find_matches([grey("a"), grey("b", 0), grey("c", 255)])
    assert (nothing.outcome == Outcome.FEW_KEYPOINTS).all()
    assert "texture" in str(nothing.reason())


def test_the_same_picture_twice_is_no_evidence():
    pixels = room().photos[0].read()
    copy = [named("a", pixels), named("b", pixels), larger(named("c", pixels), 2)]
    same = find_matches(copy)
    assert same.outcome.tolist() == [Outcome.NO_MOTION] * 3
    assert "same picture" in str(same.reason())


def discs(name: str, seed: int, factor: float = 1.0) -> MemoryPhoto:
    """Discs at random places: each looks the same in a mirror."""
    pixels = np.full((240, 320, 3), 40, np.uint8)
    generator = np.random.default_rng(seed)
    for _ in range(150):
        place = (int(generator.integers(320)), int(generator.integers(240)))
        colour = (generator.integers(60, 255, 3) * factor).astype(int).tolist()
        cv2.circle(pixels, place, int(generator.integers(4, 9)), colour, -1)
    return named(name, pixels)


@pytest.mark.parametrize("flip", [np.fliplr, np.flipud])
def test_a_mirrored_copy_is_no_evidence(flip):
    """Things that look the same in a mirror match, and satisfy a fundamental matrix."""
    photo = discs("a", 0)
    mirrored = find_matches([photo, named("b", flip(photo.read()))])
    assert mirrored.candidates[0] >= MatchSettings().fewest
    assert mirrored.outcome.tolist() == [Outcome.MIRRORED]
    assert "mirror" in str(mirrored.reason())


def test_photos_of_different_things_are_no_evidence():
    apart = find_matches([room().photos[0], discs("b", 1)])
    assert apart.outcome.tolist()[0] in (Outcome.FEW_MATCHES, Outcome.NOT_VERIFIED)
    assert apart.reason() is not None


def test_two_groups_of_photos_without_overlap_keep_their_own_pairs():
    noise = np.random.default_rng(0).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    wide = np.asarray(cv2.resize(noise, (480, 240), interpolation=cv2.INTER_CUBIC))
    other = [named("d", wide[:, :320]), named("e", wide[:, 60:380])]
    both = find_matches([*room().photos, *other])
    inside = {tuple(pair) for pair in both.pairs.tolist()}
    assert (FRAMES, FRAMES + 1) in inside
    assert all((i < FRAMES) == (j < FRAMES) for i, j in inside)


def test_a_turn_on_the_spot_is_flat():
    pixels = room().photos[0].read()
    height, width = pixels.shape[:2]
    K = np.array([[200.0, 0, width / 2], [0, 200, height / 2], [0, 0, 1]])
    angle = np.deg2rad(6)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    turned = cv2.warpPerspective(pixels, K @ turn @ np.linalg.inv(K), (width, height))
    on_the_spot = find_matches([named("a", pixels), named("b", turned)])
    assert on_the_spot.outcome.tolist() == [Outcome.VERIFIED]
    assert on_the_spot.flatness[0] > 0.9
    assert found().flatness.min() < 0.8


def test_an_error_inside_opencv_is_no_evidence(monkeypatch):
    def fail(*args):
        raise cv2.error("degenerate")

    monkeypatch.setattr(cv2, "findFundamentalMat", fail)
    failed = find_matches(room().photos[:2])
    assert failed.outcome.tolist() == [Outcome.NOT_VERIFIED]
    assert "contradict" in str(failed.reason())


def test_keypoints_lie_where_the_mask_is_on():
    masks = []
    for photo in room().photos:
        mask = np.zeros(photo.size_hw, np.uint8)
        mask[:, : photo.size_hw[1] // 2] = 255
        masks.append(mask)
    masked = find_matches(room().photos, masks=masks)
    assert 0 < len(masked.keypoints) < len(found().keypoints)
    assert masked.keypoints[:, 0].max() < room().photos[0].size_hw[1] / 2
    nothing = find_matches(room().photos, masks=[np.zeros(photo.size_hw) for photo in room().photos])
    assert (nothing.outcome == Outcome.FEW_KEYPOINTS).all()
    with pytest.raises(ValueError, match="mask"):
        find_matches(room().photos, masks=masks[:2])


def test_the_mask_leaves_room_for_the_strongest_keypoints_inside_it():
    image = room().photos[0].read()
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[:, 128:] = True
    inside = RootSift(most=40).extract(image, mask)
    assert len(inside.pixel) == 40
    assert (inside.pixel[:, 0] > 127).all()


def test_descriptors_have_unit_length_and_black_photos_none():
    features = RootSift().extract(room().photos[0].read())
    np.testing.assert_allclose(np.linalg.norm(features.descriptor, axis=1), 1, atol=1e-4)
    assert RootSift().extract(np.zeros((50, 60, 3), np.uint8)).descriptor.shape == (0, 128)


def test_keypoints_are_where_the_image_has_them():
    v, u = np.mgrid[0:100, 0:120]
    spot = 40 + 180 * np.exp(-((u - 50.25) ** 2 + (v - 40.5) ** 2) / 2 / 3**2)
    features = RootSift().extract(np.repeat(spot[..., None], 3, axis=2).astype(np.uint8))
    np.testing.assert_allclose(features.pixel, [[50.25, 40.5]] * len(features.pixel), atol=0.05)
    assert len(features.pixel) >= 1


def test_another_extractor_can_be_used():
    class Corners:
        name = "corners of a grid"

        def extract(self, image: np.ndarray, mask: np.ndarray | None = None) -> Features:
            return Features(pixel=np.zeros((0, 2), np.float32), descriptor=np.zeros((0, 8), np.float32))

    none = find_matches(room().photos[:2], extractor=Corners())
    assert none.outcome.tolist() == [Outcome.FEW_KEYPOINTS]
    assert none.fingerprint != find_matches(room().photos[:2]).fingerprint


def test_matches_are_stored_and_made_again_for_anything_else(tmp_path, monkeypatch):
    file = tmp_path / "matches.npz"
    first = stored_matches(file, room().photos)
    loaded = load_matches(file)
    assert loaded is not None
    for name, value in first.arrays().items():
        np.testing.assert_array_equal(loaded.arrays()[name], value)

    calls = []
    made = module._matched
    monkeypatch.setattr(module, "_matched", lambda job: calls.append(job) or made(job))
    stored_matches(file, room().photos)
    assert not calls
    changed = [*room().photos[:-1], named(room().photos[-1].name, room().photos[-1].read() // 2)]
    mask = [np.ones(photo.size_hw) for photo in room().photos]
    for options in (
        {"photos": changed},
        {"photos": room().photos, "settings": MatchSettings(seed=1)},
        {"photos": room().photos, "pairs": np.array([(0, 1)])},
        {"photos": room().photos, "masks": mask},
        {"photos": room().photos, "extractor": RootSift(most=300)},
        {"photos": room().photos[:-1]},
    ):
        calls.clear()
        stored_matches(file, **options)
        assert len(calls) == 1, options.keys()


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 broken", None])
def test_a_damaged_file_is_made_again(tmp_path, damage, caplog):
    file = tmp_path / "matches.npz"
    assert load_matches(file) is None
    first = stored_matches(file, room().photos[:2])
    file.write_bytes(file.read_bytes()[:-200] if damage is None else damage)
    again = stored_matches(file, room().photos[:2])
    assert "damaged" in caplog.text
    np.testing.assert_array_equal(again.ends, first.ends)
    assert load_matches(file) is not None


def places(matches: Matches, numbers: Sequence[int]) -> dict[tuple[int, int], np.ndarray]:
    """Places in the photos (M, 4) of the matches of each pair of photos, sorted; `numbers` are those of the photos."""
    sets = {}
    for number, (a, b) in enumerate(matches.pairs.tolist()):
        pair = numbers[a], numbers[b]
        ends = matches.of_pair(number) if pair[0] < pair[1] else matches.of_pair(number)[::-1]
        sets[min(pair), max(pair)] = np.unique(np.hstack(ends), axis=0)
    return sets


def test_overlapping_parts_together_have_the_matches_of_each():
    """Of a pair that both have, the first counts: verification draws at random, so that the second may differ."""
    photos, views = room().photos, ([0, 1, 2, 3], [4, 3, 2])
    parts = [find_matches([photos[view] for view in own]) for own in views]
    both = module.combined(parts, [photos[view].name for view in (4, 0, 2, 3)])
    first, second = (places(part, own) for part, own in zip(parts, views, strict=True))
    assert first.keys() & second.keys() == {(2, 3)}
    expected = {pair: ends for pair, ends in {**second, **first}.items() if 1 not in pair}
    found = places(both, (4, 0, 2, 3))
    assert found.keys() == expected.keys()
    for pair, ends in found.items():
        np.testing.assert_array_equal(ends, expected[pair])
    assert (
        len(np.unique(both.keypoints[both.view_start[2] : both.view_start[3]], axis=0)) == np.diff(both.view_start)[2]
    )
    np.testing.assert_array_equal(both.photo_hw, [photos[view].size_hw for view in (4, 0, 2, 3)])
    assert both.reason() is None and len(both.tried) >= len(both.pairs)


def test_up_to_sixteen_photos_are_compared_in_all_pairs():
    assert len(choose_pairs(16)) == 16 * 15 // 2
    assert choose_pairs(1).shape == choose_pairs(0).shape == (0, 2)
    with pytest.raises(ValueError, match="share"):
        choose_pairs(17)


def test_more_photos_are_compared_with_those_that_see_most_of_the_same():
    position = np.arange(32)
    share = np.exp(-np.abs(position[:, None] - position) / 5)
    pairs = choose_pairs(32, share)
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert len(np.unique(pairs, axis=0)) == len(pairs) <= 32 * 8
    assert np.abs(np.diff(pairs, axis=1)).max() <= 8
    assert all((pairs == view).any(axis=1).sum() >= 8 for view in range(32))


def test_the_photos_order_decides_only_the_numbering():
    """But for what verification draws at random, which matches of little doubt survive."""
    forth, back = found(), find_matches(room().photos[::-1])
    numbers = range(FRAMES)
    compared = [
        {frozenset((own[a], own[b])): count for (a, b), count in zip(one.tried.tolist(), one.candidates, strict=True)}
        for one, own in ((forth, numbers), (back, numbers[::-1]))
    ]
    assert compared[0] == compared[1]
    one, two = places(forth, numbers), places(back, numbers[::-1])
    assert one.keys() == two.keys()
    for pair, ends in one.items():
        own, other = ({tuple(row) for row in rows.tolist()} for rows in (ends, two[pair]))
        assert len(own & other) > 0.8 * len(own | other)


def test_one_photo_has_no_pairs_and_a_reason():
    alone = find_matches(room().photos[:1])
    assert len(alone) == 1 and len(alone.pairs) == 0
    assert alone.reason() is not None
