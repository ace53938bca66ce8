"""Which frames form a view set, which of them the student keeps, and in which order the sets are visited."""

from __future__ import annotations

import logging
import random
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch

from freegeo.adaptation.recipe import SMALLEST_SCENE, Recipe
from freegeo.errors import UserError

logger = logging.getLogger(__name__)

EPOCH_SEED_STRIDE = 1_000_000
Windows = tuple[tuple[int, ...], ...]
"""Groups of frames of a long sequence, each ascending; a view set is drawn from one of them."""


@dataclass(frozen=True, kw_only=True)
class ViewSet:
    """The views of one training sample."""

    scene: int
    """Number of the scene in the run."""
    frames: tuple[int, ...]
    """Frames of the scene that the teacher sees, ascending; repeats only where a recipe pads small scenes."""
    kept: tuple[int, ...]
    """Positions in `frames` that the student sees."""
    seed: int


def chunk_windows(chunks: Sequence[Sequence[int]]) -> Windows:
    """Return the windows of a sequence in chunks: each chunk, and one across each seam of two chunks in a row.

    A window across a seam has the frames around the middle of what the two chunks share, as many as the larger of them
    has. Chunks in a row that share no frame have none.

    Args:
        chunks: frames of each chunk, ascending; chunks in the order of the sequence.

    Raises:
        UserError: no chunk has the 3 frames that adaptation needs.
    """
    seams = [_across(first, second) for first, second in pairwise(chunks) if set(first) & set(second)]
    windows = dict.fromkeys(tuple(frames) for frames in (*chunks, *seams) if len(frames) >= SMALLEST_SCENE)
    if not windows:
        raise UserError(
            f"adaptation needs chunks of at least {SMALLEST_SCENE} photos. Use larger ones (--chunk), or reconstruct "
            "without adapting (--no-adapt)."
        )
    return tuple(windows)


def _across(first: Sequence[int], second: Sequence[int]) -> tuple[int, ...]:
    both = sorted({*first, *second})
    shared = [place for place, frame in enumerate(both) if frame in first and frame in second]
    size = max(len(first), len(second))
    start = (shared[0] + shared[-1] + 1 - size) // 2
    start = min(max(start, 0), len(both) - size)
    return tuple(both[start : start + size])


def draw_frames(count: int, views: int, seed: int, *, repeat: bool, neighbours: bool = False) -> tuple[int, ...]:
    """Draw the frames of a view set from `count` frames (docs/method.md, "Augmentation and view draws"), ascending.

    With at most `views` frames all are used; `repeat` then fills up with random repeats. `neighbours` (ours) draws
    the first frame only and takes those that follow it.
    """
    generator = random.Random(seed)
    if count > views and neighbours:
        first = generator.randrange(count - views + 1)
        return tuple(range(first, first + views))
    if count > views:
        return tuple(sorted(generator.sample(range(count), views)))
    frames = list(range(count))
    if repeat:
        frames += [generator.choice(range(count)) for _ in range(views - count)]
    return tuple(sorted(frames))


def kept_positions(views: int, keep: tuple[int, ...] | None) -> tuple[int, ...]:
    """Return the student's positions among `views`: `keep` if it fits and leaves a view out, else every second."""
    fits = keep is not None and keep[-1] < views and len(keep) < views
    return keep if fits else tuple(range(0, views, 2))


def _substitution(frame_counts: Sequence[int], recipe: Recipe, parts: str) -> str | None:
    """Say what is done instead where scenes have fewer photos than a view set has views; None where all have enough.

    `parts` is what several of those that photos are drawn from are called.
    """
    small = [count for count in frame_counts if count < recipe.views]
    if not small:
        return None
    count = min(small)
    where = f"{len(small)} of {len(frame_counts)} {parts} have" if len(frame_counts) > 1 else "there are"
    said = f"{where} fewer photos ({count}) than the {recipe.views} views of a view set (--views): "
    if recipe.repeat_views:
        return said + "some are repeated"
    kept = kept_positions(count, recipe.keep)
    keep = "" if recipe.keep in (None, kept) else f", as --keep {','.join(map(str, recipe.keep))} does not fit"
    return said + f"the teacher sees all {count}, the student views {', '.join(map(str, kept))} of them{keep}"


def view_sets(
    frame_counts: Sequence[int], recipe: Recipe, epoch: int = 0, *, windows: Sequence[Windows | None] | None = None
) -> list[ViewSet]:
    """Draw all view sets of one epoch, scene by scene.

    Sets stay the same over the epochs unless the recipe redraws. Small scenes may give the same set several times.

    Args:
        frame_counts: frames of each scene.
        recipe: says how many sets there are of a scene. A scene with windows has as many of each window, and at least
            one.
        epoch: number of the epoch.
        windows: of each scene; None, for all or for one: all its frames are one window.

    Raises:
        UserError: a scene with fewer than 3 frames.
    """
    sets = []
    for scene, (count, parts) in enumerate(zip(frame_counts, windows or [None] * len(frame_counts), strict=True)):
        if count < SMALLEST_SCENE:
            raise UserError(
                f"adaptation needs at least {SMALLEST_SCENE} photos, got {count}. Add photos, or reconstruct without "
                "adapting (--no-adapt)."
            )
        parts = parts or (range(count),)
        for number in range(-(-recipe.sets_per_scene // len(parts)) * len(parts)):
            seed = recipe.first_seed + number % recipe.distinct_seeds
            seed += EPOCH_SEED_STRIDE * epoch if recipe.redraw else 0
            window = parts[number % len(parts)]
            drawn = draw_frames(
                len(window), recipe.views, seed, repeat=recipe.repeat_views, neighbours=recipe.neighbours
            )
            kept = kept_positions(len(drawn), recipe.keep)
            sets.append(ViewSet(scene=scene, frames=tuple(window[place] for place in drawn), kept=kept, seed=seed))
    return sets


@dataclass(frozen=True, kw_only=True)
class Visit:
    """One use of a view set in an optimiser step."""

    step: int
    epoch: int
    view_set: ViewSet


def schedule(
    frame_counts: Sequence[int], recipe: Recipe, seed: int, *, windows: Sequence[Windows | None] | None = None
) -> list[list[Visit]]:
    """Return the visits of every optimiser step: epochs in shuffled order, cut into batches.

    Arguments as for `view_sets`. A run with fewer visits than there are windows leaves some out, by the seed.
    """
    generator = torch.Generator().manual_seed(seed)
    steps: list[list[Visit]] = []
    epoch = 0
    while recipe.steps is None or len(steps) < recipe.steps:
        if recipe.epochs is not None and epoch == recipe.epochs:
            break
        sets = view_sets(frame_counts, recipe, epoch, windows=windows)
        order = torch.randperm(len(sets), generator=generator).tolist()
        batches = [order[i : i + recipe.batch] for i in range(0, len(order), recipe.batch)]
        if recipe.drop_last and len(batches[-1]) < recipe.batch and len(batches) > 1:
            batches.pop()
        for batch in batches:
            steps.append([Visit(step=len(steps), epoch=epoch, view_set=sets[i]) for i in batch])
        epoch += 1
    return steps[: recipe.steps]


def announced_schedule(
    frame_counts: Sequence[int], recipe: Recipe, seed: int, *, windows: Sequence[Windows | None]
) -> list[list[Visit]]:
    """Return `schedule`, and say what the photos make different from what was asked for."""
    sizes = [len(window) for parts in windows for window in parts or ()]
    if said := _substitution(sizes or frame_counts, recipe, "parts of the sequence" if sizes else "scenes"):
        logger.info(said)
    steps = schedule(frame_counts, recipe, seed, windows=windows)
    visits = sum(len(step) for step in steps)
    if visits < len(sizes):
        logger.info(
            "%d view sets cannot visit all %d parts of the sequence; which are left out depends on the seed. More "
            "--steps visit all.", visits, len(sizes),
        )  # fmt: skip
    return steps


def visited(steps: Sequence[Sequence[Visit]]) -> Sequence[Sequence[Visit]]:
    """Return the visits of a run's steps and then those of its last step again, for the look at what came out."""
    return [*steps, steps[-1]]
