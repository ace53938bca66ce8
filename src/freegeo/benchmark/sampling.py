"""Which frames of a scene enter an evaluation: the rules of the published runners, by name.

All return ascending indices into the frames in loader order, and depend on their arguments only. When the budget is
not smaller than the scene, every frame is used.
"""

import hashlib
import random

import numpy as np

from freegeo.errors import UserError

PAPER_BUDGETS = (4, 8, 16, 32, 64, 100)
PAPER_SEEDS = (43, 44, 45)
_SUBSET_SHARE = 0.1


def standard_frames(num_frames: int, budget: int, seed: int) -> list[int]:
    """The first `budget` entries of a seeded shuffle, sorted.

    The sets of one seed are nested: 4 views are part of the 8 views. Depth Anything 3 is evaluated on these, and so
    is VGGT at 8 views and more.

    Args:
        num_frames: frames of the scene, at least 0.
        budget: number of frames to choose; 0 or less chooses all.
        seed: any integer.

    Source: docs/benchmark.md, "Frame rules".
    """
    if budget <= 0 or num_frames <= budget:
        return list(range(num_frames))
    return _shuffled_start(num_frames, budget, random.Random(seed))


def every_second_frame(num_frames: int, budget: int, keep: int, seed: int) -> list[int]:
    """Every second frame of the standard sample, at most `keep`: the 4-view setting of VGGT (budget 8, keep 4).

    These are exactly the frames the student sees while adapting. A scene of at most `budget` but more than `keep`
    frames is thinned the same way, which can leave fewer than `keep`; a scene of at most `keep` frames is used whole.

    Source: docs/benchmark.md, "Frame rules".
    """
    if keep < 1:
        raise UserError(f"At least one frame must be kept, not {keep}.")
    frames = standard_frames(num_frames, budget, seed)
    return frames if keep >= len(frames) else frames[::2][:keep]


def multiview_frames(dataset: str, scene: str, num_frames: int, budget: int, seed: int) -> list[int]:
    """Frames of the multi-view script, which has its own generator per scene and budget; the sets are not nested.

    The indices count the frames sorted by image path, not in loader order.

    Source: docs/benchmark.md, "Frame rules", multi-view script.
    """
    if num_frames <= budget:
        return list(range(num_frames))
    digest = hashlib.sha256(f"{dataset}::{scene}::{seed}::{budget}".encode()).digest()
    return _shuffled_start(num_frames, budget, random.Random(int.from_bytes(digest[:8], "big")))


def window_frames(num_frames: int, budget: int, seed: int) -> list[int]:
    """A window of `budget` neighbours in an evenly thinned scene (a tenth of it); the seed picks the window.

    Source: docs/benchmark.md, "Frame rules", windows (an option of VGGT's evaluator that the paper does not use).
    """
    if budget <= 0 or num_frames <= budget:
        return list(range(num_frames))
    size = max(budget, int(num_frames * _SUBSET_SHARE))
    subset = [int(i * num_frames / size) for i in range(size)]
    windows = size // budget
    window = seed % max(1, 2 * windows)
    if window < windows:
        start = window * budget
    else:  # the second half of the seeds shifts the windows by half of their width
        start = (budget // 2 + (window - windows) * budget) % (size - budget + 1)
    return subset[start : start + budget]


def experiment_frames(num_frames: int, budget: int = 8, seed: int = 42) -> list[int]:
    """The 8 frames behind the "8 -> 4" comparison; its 4 views are positions 0, 2, 4, 6.

    NumPy's legacy generator draws them without replacement. Source: docs/benchmark.md, "Frame rules".
    """
    if num_frames <= budget:
        return list(range(num_frames))
    chosen = np.random.RandomState(seed).choice(num_frames, budget, replace=False)
    return sorted(int(index) for index in chosen)


def _shuffled_start(num_frames: int, budget: int, generator: random.Random) -> list[int]:
    order = list(range(num_frames))
    generator.shuffle(order)
    return sorted(order[:budget])
