"""View draws and augmentation are those of the release, seed by seed; small scenes do what the recipe says.

View sets of a sequence are drawn from its chunks and across their seams.
"""

from dataclasses import replace

import pytest
import torch

from freegeo.adaptation import recipe as recipes
from freegeo.adaptation.samples import released_augmentation
from freegeo.adaptation.views import chunk_windows, draw_frames, kept_positions, schedule, view_sets
from freegeo.errors import UserError
from tiny_models import quick, tiny_da3

MODEL = tiny_da3()

# Frames -> drawn views for seeds 40, 41, 42 and 1000040: docs/method.md, "Augmentation and view draws".
SEEDS = (40, 41, 42, 1_000_040)
DRAWS = {
    3: ("0 0 0 1 1 2 2 2", "0 0 0 1 1 1 1 2", "0 0 0 1 1 2 2 2", "0 0 1 1 2 2 2 2"),
    5: ("0 1 2 3 3 4 4 4", "0 1 1 2 2 3 3 4", "0 0 0 1 2 2 3 4", "0 0 1 2 2 3 4 4"),
    8: ("0 1 2 3 4 5 6 7",) * 4,
    11: ("0 1 2 4 6 7 8 9", "2 3 4 5 6 7 8 9", "0 1 4 5 6 8 9 10", "0 1 3 4 5 7 8 9"),
    38: ("2 8 13 15 18 24 29 33", "10 12 14 17 18 21 24 37", "1 6 7 8 14 15 17 21", "2 7 8 12 22 23 26 30"),
    1000: (
        "32 251 289 469 536 593 680 898", "170 236 340 390 394 591 923 935",
        "25 114 142 228 250 281 654 759", "36 377 596 670 869 908 910 990",
    ),
}  # fmt: skip
# Seed -> mirrored, brightness factor of each view: same section.
AUGMENTATION = {
    40: (True, "- .913 - - .939 - .811 -"),
    41: (True, ".866 - - - - 1.093 - -"),
    42: (False, ".910 1.095 - - .969 .887 - .880"),
    43: (True, "- .985 - - .999 .973 1.141 -"),
    44: (True, "- - .890 .847 .863 - - -"),
    45: (True, ".833 .829 .914 .924 - 1.050 1.118 -"),
    46: (False, "1.035 - 1.006 - - .828 1.130 -"),
    47: (True, ".981 1.005 .816 .809 .906 - 1.019 -"),
    48: (False, "1.085 1.175 1.105 1.186 - 1.060 1.005 -"),
    49: (True, ".844 - - .818 - 1.093 - -"),
}


@pytest.mark.parametrize("frames", DRAWS)
def test_view_draws_are_the_published_ones(frames):
    for seed, wanted in zip(SEEDS, DRAWS[frames], strict=True):
        assert draw_frames(frames, 8, seed, repeat=True) == tuple(int(n) for n in wanted.split())


def test_neighbours_are_frames_in_a_row_from_anywhere():
    drawn = {draw_frames(16, 8, seed, repeat=False, neighbours=True) for seed in range(60)}
    assert drawn == {tuple(range(first, first + 8)) for first in range(9)}
    assert draw_frames(5, 8, 40, repeat=False, neighbours=True) == (0, 1, 2, 3, 4)


@pytest.mark.parametrize("seed", AUGMENTATION)
def test_augmentation_is_the_published_one(seed):
    mirrored, factors = AUGMENTATION[seed]
    images = torch.linspace(0.3, 0.6, 5).expand(8, 3, 2, 5)
    changed = released_augmentation(images, seed)
    ratio = (changed.flip(-1) if mirrored else changed) / images
    wanted = torch.tensor([1.0 if f == "-" else float(f) for f in factors.split()])
    torch.testing.assert_close(ratio.mean((1, 2, 3)), wanted, atol=5.1e-4, rtol=0)
    assert (ratio.amax((1, 2, 3)) - ratio.amin((1, 2, 3)) < 1e-5).all()


def test_augmented_images_stay_in_range():
    assert released_augmentation(torch.ones(8, 3, 2, 2), 48).amax() == 1


@pytest.mark.parametrize("count", [3, 4, 5, 6, 7, 8])
def test_a_small_scene_is_used_whole_and_every_second_view_is_kept(count):
    for one in view_sets([count], quick(MODEL)):
        assert one.frames == tuple(range(count))
        assert one.kept == tuple(range(0, count, 2))
        assert 2 <= len(one.kept) < count


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_photos_are_refused(count):
    with pytest.raises(UserError, match=f"at least 3 photos, got {count}"):
        view_sets([5, count], quick(MODEL))


def test_any_number_of_views_and_any_kept_ones():
    recipe = quick(MODEL, views=16, keep=(0, 4, 8, 12))
    [one, *_] = view_sets([30], recipe)
    assert len(set(one.frames)) == 16
    assert list(one.frames) == sorted(one.frames)
    assert one.kept == (0, 4, 8, 12)
    assert view_sets([30], quick(MODEL, views=16))[0].kept == tuple(range(0, 16, 2))


def test_a_choice_of_kept_views_that_a_small_scene_cannot_have_falls_back():
    assert kept_positions(8, (0, 3)) == (0, 3)
    assert kept_positions(3, (0, 4)) == (0, 2)
    assert kept_positions(3, (0, 1, 2)) == (0, 2), "all views kept would leave none to learn from"


def test_sets_count_their_seeds_on_and_wrap_around():
    recipe = recipes.named("released-vggt", MODEL.spec, "eth3d")
    seeds = [one.seed for one in view_sets([20, 20], recipe)]
    assert seeds == [40, 41, 42, 43, 44] * 4
    assert [one.seed for one in view_sets([20, 20], recipe, epoch=2)] == [s + 2_000_000 for s in seeds]


def test_sets_stay_the_same_over_the_epochs_unless_redrawn():
    recipe = quick(MODEL, epochs=2)
    assert view_sets([20], recipe, epoch=1) == view_sets([20], recipe, epoch=0)


def test_every_set_is_visited_once_per_epoch_in_an_order_of_the_seed():
    recipe = quick(MODEL, epochs=2, batch=2)
    steps = schedule([9, 12], recipe, seed=1)
    sets = view_sets([9, 12], recipe)
    for epoch in (0, 1):
        visited = [visit.view_set for step in steps for visit in step if visit.epoch == epoch]
        assert sorted(visited, key=sets.index) == sets
    assert [visit.step for step in steps for visit in step] == [i for i, step in enumerate(steps) for _ in step]
    assert schedule([9, 12], recipe, seed=1) == steps
    assert schedule([9, 12], recipe, seed=2) != steps


def test_the_last_incomplete_batch_is_kept_or_dropped_as_the_recipe_says():
    kept = quick(MODEL, epochs=1, batch=2)
    assert [len(step) for step in schedule([9], kept, seed=0)] == [2, 1]
    dropping = recipes.named("released-da3", MODEL.spec, "eth3d")
    assert [len(step) for step in schedule([9], dropping, seed=0)] == [4, 4, 4]


def test_a_number_of_steps_goes_through_as_many_epochs_as_it_takes():
    steps = schedule([9], quick(MODEL, steps=7), seed=0)
    assert len(steps) == 7
    assert [step[0].epoch for step in steps] == [0, 0, 0, 1, 1, 1, 2]


# -- sequences


def chunks(count: int, size: int, overlap: int) -> list[tuple[int, ...]]:
    """Chunks of a sequence; the last may be shorter."""
    starts = range(0, count - overlap, size - overlap)
    return [tuple(range(start, min(start + size, count))) for start in starts]


@pytest.mark.parametrize(
    ("count", "size", "overlap"), [(64, 16, 8), (60, 24, 8), (50, 16, 3), (21, 16, 8), (40, 10, 1)]
)
def test_a_window_across_a_seam_has_frames_of_both_chunks_around_their_overlap(count, size, overlap):
    parts = chunks(count, size, overlap)
    windows = chunk_windows(parts)
    assert windows[: len(parts)] == tuple(parts)
    across = windows[len(parts) :]
    assert len(across) == len(parts) - 1
    for window, first, second in zip(across, parts, parts[1:], strict=False):
        assert len(window) == size
        assert set(first) & set(second) <= set(window) <= {*first, *second}
        assert set(window) - set(first) and set(window) - set(second)
        if len(second) == size:
            before, after = len(set(window) - set(second)), len(set(window) - set(first))
            assert abs(before - after) <= 1


def test_chunks_that_share_no_frame_have_no_window_across_and_small_ones_none_at_all():
    assert chunk_windows([(0, 1, 2, 3), (4, 5, 6, 7)]) == ((0, 1, 2, 3), (4, 5, 6, 7))
    assert chunk_windows([(0, 1, 2, 3), (4, 5)]) == ((0, 1, 2, 3),)
    assert chunk_windows([(0, 1, 2, 3)]) == ((0, 1, 2, 3),)
    # With all but one frame shared, what lies across is one of the two chunks.
    assert chunk_windows([(0, 1, 2, 3), (1, 2, 3, 4)]) == ((0, 1, 2, 3), (1, 2, 3, 4))
    with pytest.raises(UserError, match="chunks of at least 3 photos"):
        chunk_windows([(0, 1), (1, 2)])


@pytest.mark.parametrize("neighbours", [False, True])
@pytest.mark.parametrize("size", [6, 16])
def test_view_sets_stay_inside_windows_and_visit_all_of_them_evenly(neighbours, size):
    windows = chunk_windows(chunks(64, size, size // 2))
    recipe = replace(quick(MODEL, sets_per_scene=20, distinct_seeds=20), neighbours=neighbours)
    sets = view_sets([9, 64], recipe, windows=[None, windows])
    assert sets[:20] == view_sets([9], recipe)
    homes = [[window for window in windows if set(one.frames) <= set(window)] for one in sets[20:]]
    assert all(homes)
    assert len(homes) % len(windows) == 0 and len(homes) >= 20
    for number, (one, found) in enumerate(zip(sets[20:], homes, strict=True)):
        window = windows[number % len(windows)]
        assert window in found and len(one.frames) == min(8, len(window))
    if neighbours:
        assert all(one.frames == tuple(range(one.frames[0], one.frames[-1] + 1)) for one in sets[20:])


def test_an_epoch_visits_every_window_equally_often_in_an_order_of_the_seed():
    windows = tuple(tuple(range(10 * n, 10 * n + 10)) for n in range(7))
    recipe = quick(MODEL, epochs=1, sets_per_scene=10, distinct_seeds=10)
    steps = schedule([70], recipe, 1, windows=[windows])
    order = [visit.view_set.frames[0] // 10 for step in steps for visit in step]
    assert sorted(order) == sorted([*range(7)] * 2)
    again, other = (
        [visit.view_set.frames[0] // 10 for step in schedule([70], recipe, seed, windows=[windows]) for visit in step]
        for seed in (1, 2)
    )
    assert again == order != other


def test_one_window_of_all_frames_changes_nothing():
    recipe = quick(MODEL, epochs=2, batch=2)
    assert schedule([20], recipe, 3, windows=[(tuple(range(20)),)]) == schedule([20], recipe, 3)
    assert schedule([20, 9], recipe, 3, windows=[None, None]) == schedule([20, 9], recipe, 3)
