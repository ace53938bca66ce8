"""Loops are found where a walk comes back, and refused where a place only looks alike."""

import json
from dataclasses import asdict, replace
from functools import cache

import numpy as np
import pytest
import torch

from evidence_tools import turned
from freegeo.data.photos import MemoryPhoto
from freegeo.data.procedural import RoomBatch, render, sample_rooms
from freegeo.evidence import matches as evidence_matches
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.matches import find_matches, stored_matches
from freegeo.sequence.loops import Loop, agrees, loop_candidates, loop_frames, verified

PHOTO_HW = (144, 192)
HERE, AGAIN = range(9, 15), range(31, 37)
"""Frames of the room's walk: the second time round the camera sees what it saw the first time."""
ENDS = (2, 8)
"""Of the twelve photos of both."""


@pytest.fixture(autouse=True)
def always_one_thread(one_thread):
    """Every test of this file computes with one thread."""


def places(*positions: float) -> np.ndarray:
    """Descriptors of frames on a line: the farther apart, the less alike."""
    along = np.array(positions, dtype=np.float64)
    bumps = np.exp(-((along[:, None] - np.arange(-5, 60, 0.5)) ** 2) / 8)
    return (bumps / np.linalg.norm(bumps, axis=1, keepdims=True)).astype(np.float32)


def there_and_back(count: int = 20) -> np.ndarray:
    """A walk to the end and back on the same way, a little beside it."""
    return places(*range(count), *(np.arange(count)[::-1] - 0.4))


@cache
def room() -> RoomBatch:
    return sample_rooms([30_000_020], domain="val-id", frames=AGAIN.stop)


@cache
def look_alike() -> RoomBatch:
    """The same walls, textures and light with other things in the room."""
    own, other = room(), sample_rooms([30_000_027], domain="val-id", frames=AGAIN.stop)
    return replace(
        own,
        **{
            name: torch.cat((getattr(own, name)[:, :1], getattr(other, name)[:, 1:]), dim=1)
            for name in ("center", "yaw", "size")
        },
    )


@cache
def views(of: str, frames: range):
    batch = {"room": room, "look-alike": look_alike, "other": other_room}[of]()
    return render(replace(batch, T_cam_room=batch.T_cam_room[:, frames.start : frames.stop]), *PHOTO_HW)


@cache
def other_room() -> RoomBatch:
    return sample_rooms([30_000_028], domain="val-id", frames=AGAIN.stop)


def photos(*parts: tuple[str, range]) -> list[MemoryPhoto]:
    images = torch.cat([views(of, frames).images[0] for of, frames in parts])
    pixels = (images.permute(0, 2, 3, 1) * 255).round().byte().numpy()
    return [MemoryPhoto(f"{k:02d}.png", image) for k, image in enumerate(pixels)]


def checked(*parts: tuple[str, range]):
    """The candidate `ENDS` of twelve photos, whose neighbours are as alike as the ends."""
    [loop] = verified([(*ENDS, 0.9)], photos(*parts), places(*range(6), *range(6)))
    return loop


@cache
def true_loop():
    """A true loop, and the matches of its photos."""
    loop = checked(("room", HERE), ("room", AGAIN))
    taken = photos(("room", HERE), ("room", AGAIN))
    return loop, find_matches([taken[frame] for frame in loop.frames])


def cameras(frames: list[int], degrees: float = 0.0) -> Candidate:
    """The true cameras of some of the twelve frames; those of the second end turned together."""
    T = torch.cat([views("room", part).T_cam_world[0] for part in (HERE, AGAIN)]).double()
    turn = torch.cat(
        (torch.eye(4)[None].repeat(6, 1, 1).double(), turned(torch.eye(4)[None].double(), degrees).repeat(6, 1, 1))
    )
    K = views("room", HERE).K[0, :1].double().repeat(len(frames), 1, 1)
    ones = torch.ones(len(frames), 2, dtype=torch.float64)
    return Candidate(
        T_cam_world=(turn @ T)[frames], K=K, depth_z=torch.ones(len(frames), 2, 2), scale_xy=ones, offset_xy=0 * ones
    )


def test_the_way_back_is_found():
    found = loop_candidates(there_and_back(), apart=8)
    assert found
    assert all(abs(first - (39 - second)) <= 1 for first, second, _ in found)
    assert min(second - first for first, second, _ in found) >= 8
    assert [value for *_, value in found] == sorted((value for *_, value in found), reverse=True)


def test_candidates_of_one_place_are_thinned_out():
    found = np.array([pair[:2] for pair in loop_candidates(there_and_back(), apart=8)])
    apart = np.abs(found[:, None] - found).max(-1)
    assert apart[np.triu_indices(len(found), 1)].min() > 4


def test_a_straight_walk_has_no_candidates():
    assert loop_candidates(places(*range(40)), apart=8) == []


@pytest.mark.parametrize(("step", "found"), [(1, False), (2, True)])
def test_ends_are_as_alike_as_neighbours(step, found):
    """The same likeness is too little where the camera moves slowly, and enough where it moves fast."""
    there, back = places(*range(0, 40, step)), places(*range(39, -1, -step))
    unlike = np.sqrt(np.array([[0.8, 0.2]] * len(back), dtype=np.float32))
    walk = np.concatenate((np.pad(there, ((0, 0), (0, 1))), np.append(back * unlike[:, :1], unlike[:, 1:], axis=1)))
    assert bool(loop_candidates(walk, apart=10)) is found


def test_the_number_of_candidates_is_bounded():
    rounds = places(*np.tile(np.arange(12), 30))[:, :] + np.random.default_rng(0).normal(0, 1e-3, (360, 130))
    rounds = (rounds / np.linalg.norm(rounds, axis=1, keepdims=True)).astype(np.float32)
    assert len(loop_candidates(rounds, apart=10)) <= 36
    assert len(loop_candidates(rounds, apart=10, most=3)) == 3


@pytest.mark.parametrize("count", [0, 1, 2, 6, 7, 30])
def test_pictures_that_are_all_the_same_are_no_candidates(count):
    assert loop_candidates(np.tile(places(3), (count, 1)), apart=6) == []


def test_black_frames_are_no_candidates():
    """Neither within their run nor between two runs of them; what is alike on both sides of a run may be one."""
    walk, black = places(*range(40)), np.tile(places(-4), (8, 1))
    found = loop_candidates(np.concatenate((walk[:15], black, walk[15:30], black, walk[30:])), apart=8)
    assert {(first, second) for first, second, _ in found} == {(14, 23), (37, 46)}


def test_frames_that_are_repeated_do_not_hide_a_loop():
    assert loop_candidates(there_and_back().repeat(2, axis=0), apart=8)


def test_ends_must_have_room_for_their_neighbours():
    with pytest.raises(ValueError, match="at least 6"):
        loop_candidates(there_and_back(), apart=5)


def test_a_place_seen_again_is_a_loop():
    loop, matches = true_loop()
    assert loop.reason is None
    assert (loop.first, loop.second) == ENDS
    five = [tuple(pair) in {(1, 3), (1, 4), (1, 5), (0, 4), (2, 4)} for pair in matches.pairs.tolist()]
    assert loop.matches == matches.counts[five].sum() > 200
    assert loop.frames == (1, 2, 3, 7, 8, 9)


def test_the_same_walls_around_other_things_are_refused():
    loop = checked(("room", range(6)), ("look-alike", range(6)))
    assert loop.matches > 100
    assert "a part of them looks the same" in loop.reason


def test_a_loop_can_be_noted_in_a_text_file():
    loop = true_loop()[0]
    assert Loop(**json.loads(json.dumps(asdict(replace(loop, frames=list(loop.frames)))))).frames == [1, 2, 3, 7, 8, 9]


def test_another_room_is_refused():
    loop = checked(("room", HERE), ("other", HERE))
    assert "do not show one place" in loop.reason


def test_photos_without_texture_are_refused():
    black = [MemoryPhoto(f"{k}.png", np.zeros((40, 60, 3), np.uint8)) for k in range(12)]
    [loop] = verified([(*ENDS, 1.0)], black, places(*range(6), *range(6)))
    assert loop.reason
    assert loop.matches == 0


def test_a_place_next_to_one_seen_again_is_refused():
    """Frame 8 is of another room; the one before it, of the first room, does match."""
    loop = checked(("room", HERE), ("room", AGAIN[:2]), ("other", HERE[:4]))
    assert "do not show one place" in loop.reason


@pytest.mark.parametrize(("first", "second", "around"), [
    (0, 8, (0, 1, 2, 7, 8, 9)), (1, 11, (0, 1, 2, 9, 10, 11)), (0, 11, (0, 1, 2, 9, 10, 11)),
])  # fmt: skip
def test_ends_are_among_the_photos_that_are_matched(first, second, around):
    grey = [MemoryPhoto("grey.png", np.full((40, 60, 3), 90, np.uint8))] * 12
    [loop] = verified([(first, second, 0.99)], grey, places(*range(6), *range(6)))
    assert loop.frames == around


def test_no_candidates_are_no_loops():
    assert verified([], [], np.zeros((0, 4), np.float32)) == []


def test_neighbours_are_taken_farther_apart_where_frames_hardly_change():
    slow = places(*np.arange(0, 12, 0.25), *np.arange(0, 12, 0.25))
    likeness = float(slow[10] @ slow[15])
    pixels = MemoryPhoto("grey.png", np.full((40, 60, 3), 90, np.uint8))
    [loop] = verified([(20, 68, likeness)], [pixels] * len(slow), slow)
    assert loop.frames == (15, 20, 25, 63, 68, 73)


def test_true_cameras_agree_with_the_matches():
    frames = list(range(12))
    agreed = agrees(cameras(frames), frames, *true_loop())
    assert agreed.reason is None
    assert agreed.error_px < 0.5


def test_cameras_that_join_the_ends_wrongly_do_not_agree():
    frames = list(range(12))
    agreed = agrees(cameras(frames, degrees=10.0), frames, *true_loop())
    assert agreed.own_px < 0.5
    assert agreed.error_px > 5
    assert "joint prediction" in agreed.reason


def test_only_frames_of_the_chunk_take_part():
    frames = [1, 2, 8, 9]
    assert agrees(cameras(frames), frames, *true_loop()).error_px < 0.5
    assert "part of the prediction" in agrees(cameras([0, 1, 2]), [0, 1, 2], *true_loop()).reason


@pytest.mark.parametrize(("first", "second", "count", "size"), [
    (30, 80, 100, 24), (0, 99, 100, 24), (3, 97, 100, 7), (40, 52, 100, 24), (40, 41, 100, 10), (0, 9, 10, 24),
    (2, 9, 12, 11), (0, 1, 2, 2), (10, 30, 100, 2), (95, 99, 100, 24),
])  # fmt: skip
def test_loop_frames_lie_around_both_ends(first, second, count, size):
    frames = loop_frames(first, second, count, size)
    assert len(frames) == min(size, count)
    assert list(frames) == sorted(set(frames))
    assert set(frames) <= set(range(count))
    assert {first, second} <= set(frames)


def test_half_of_a_loop_chunk_is_at_each_end():
    assert loop_frames(30, 80, 100, 8) == (28, 29, 30, 31, 78, 79, 80, 81)
    assert loop_frames(0, 99, 100, 6) == (0, 1, 2, 97, 98, 99)


def test_a_loop_is_the_same_by_matches_that_were_kept(tmp_path, monkeypatch):
    taken, seen = photos(("room", HERE), ("room", AGAIN)), places(*range(6), *range(6))

    def kept(frames):
        return stored_matches(tmp_path / "loop.npz", [taken[frame] for frame in frames])

    expected, first = [true_loop()[0]], verified([(*ENDS, 0.9)], taken, seen, match=kept)
    monkeypatch.setattr(evidence_matches, "_matched", lambda job: pytest.fail("matched again"))
    assert verified([(*ENDS, 0.9)], taken, seen, match=kept) == first == expected
