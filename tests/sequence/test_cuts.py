"""Two clips in one folder are cut apart, and nothing else is."""

import numpy as np
import pytest

from freegeo.data.photos import MemoryPhoto
from freegeo.data.procedural import photograph_room
from freegeo.sequence.cuts import Jumps, find_cuts

CLIP = 7
NONE = Jumps(cuts=[], doubtful=[])


@pytest.fixture(scope="module")
def clips() -> list[MemoryPhoto]:
    """Two rooms, one after the other."""
    rooms = [photograph_room(seed, "tex", frames=CLIP) for seed in (40_000_002, 40_000_003)]
    return [
        MemoryPhoto(f"{k}-{i}.png", photo.read()) for k, room in enumerate(rooms) for i, photo in enumerate(room.photos)
    ]


def vectors(*jumps: int, count: int = 2 * CLIP) -> np.ndarray:
    """Descriptors that turn evenly from frame to frame, and much further before the frames named."""
    steps = np.full(count, 0.1)
    steps[list(jumps)] = 1.2
    angle = steps.cumsum()
    return np.stack((np.cos(angle), np.sin(angle)), axis=1)


def test_a_jump_between_clips_is_a_cut(clips):
    assert find_cuts(vectors(CLIP), clips) == Jumps(cuts=[CLIP], doubtful=[])


def test_a_jump_within_a_clip_is_none(clips):
    assert find_cuts(vectors(3, CLIP, 10), clips) == Jumps(cuts=[CLIP], doubtful=[])


def test_without_a_jump_nothing_is_matched(clips):
    class Unread(MemoryPhoto):
        def read(self):
            raise AssertionError

    assert find_cuts(vectors(), [Unread(photo.name, photo.pixels) for photo in clips]) == NONE


def test_where_neighbours_do_not_match_either_it_is_no_cut_but_doubtful(clips):
    dark = [*clips[:CLIP], *(MemoryPhoto(photo.name, photo.pixels // 64) for photo in clips[CLIP:])]
    assert find_cuts(vectors(CLIP), dark) == Jumps(cuts=[], doubtful=[CLIP])


def test_a_photo_of_another_place_is_doubtful(clips):
    mixed = [*clips[:3], clips[CLIP], *clips[3:CLIP]]
    assert find_cuts(vectors(3, 4, count=CLIP + 1), mixed) == Jumps(cuts=[], doubtful=[3])


def test_a_last_photo_of_another_place_is_cut_off(clips):
    assert find_cuts(vectors(CLIP, count=CLIP + 1), clips[: CLIP + 1]) == Jumps(cuts=[CLIP], doubtful=[])


def test_a_camera_that_stands_still_does_not_make_jumps_of_its_steps(clips):
    class Unread(MemoryPhoto):
        def read(self):
            raise AssertionError

    still = vectors(count=CLIP)[[0, 1, 2, *[3] * 7, 4, 5, 6]]
    assert find_cuts(still, [Unread("", clips[0].pixels)] * len(still)) == NONE


@pytest.mark.parametrize("count", [0, 1, 3])
def test_few_photos_are_never_cut(clips, count):
    assert find_cuts(vectors(count=count), clips[:count]) == NONE
