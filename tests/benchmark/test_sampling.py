from itertools import pairwise

import pytest

from freegeo.benchmark.sampling import (
    PAPER_SEEDS,
    every_second_frame,
    experiment_frames,
    multiview_frames,
    standard_frames,
    window_frames,
)
from freegeo.errors import UserError


@pytest.mark.parametrize("seed", PAPER_SEEDS)
def test_standard_sets_are_nested(seed):
    sets = [set(standard_frames(200, budget, seed)) for budget in (4, 8, 16, 32, 64, 100)]
    assert [len(s) for s in sets] == [4, 8, 16, 32, 64, 100]
    assert all(a < b for a, b in pairwise(sets))


@pytest.mark.parametrize("rule", [standard_frames, window_frames, lambda n, b, s: multiview_frames("d", "x", n, b, s)])
def test_small_scenes_are_used_whole(rule):
    assert rule(5, 8, 43) == [0, 1, 2, 3, 4]


def test_four_of_eight_are_the_frames_the_student_sees():
    assert every_second_frame(100, 8, 4, 43) == standard_frames(100, 8, 43)[::2]
    assert [len(every_second_frame(n, 8, 4, 0)) for n in (4, 5, 6, 7)] == [4, 3, 3, 4]
    with pytest.raises(UserError):
        every_second_frame(10, 8, 0, 0)


def test_experiment_frames_are_eight_distinct_ascending():
    frames = experiment_frames(60)
    assert frames == sorted(set(frames))
    assert len(frames) == 8
    assert experiment_frames(7) == list(range(7))
