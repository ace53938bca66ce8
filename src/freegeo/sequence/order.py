"""What a frame looks like in one vector, and the order in which unordered photos become a sequence.

docs/sequences.md, "Order", has the measurements behind the choices made here.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from freegeo.models.api import ReconstructionModel, views_per_chunk
from freegeo.models.precision import Compute

__all__ = ["SAME_PICTURE", "descriptors", "in_order", "new_pictures", "similarity_order"]

FREQUENCIES = 512
"""Random frequencies; a descriptor has a sine and a cosine of each."""
SHARPNESS = (2.0, 10.0)
"""Range of the kernels' inverse widths. How far tokens of different things are apart depends on the model, so that
kernels of several widths are mixed."""
LEAST_ORDER = 0.5
"""Share of the similarity order's gain over a random order that a given order must have to be kept."""
SAME_PICTURE = 1e-5
"""Two frames whose similarity is nearer to 1 than this are one picture (a frozen camera, black frames)."""
_PARTNERS = 32
"""So many frames that are most like a frame may become its neighbours at first."""
_SMALLEST_GAIN = 1e-5
"""Differences of similarity below this are rounding."""


@torch.no_grad()
def descriptors(model: ReconstructionModel, images_in_parts: Iterable[Tensor], compute: Compute) -> np.ndarray:
    """Describe every frame by one vector (N, 1024) float32 of unit length; the product of two is their similarity.

    Frames are described by the distribution of their patch tokens, as `embed` computes them: the product of two
    descriptors approximates the mean of Gaussian kernels over all pairs of tokens (random features, Rahimi and Recht
    2007). A frame's descriptor depends on that frame alone. Memory does not grow with the number of frames, but for
    the result.

    Args:
        model: its `embed` is used, which no adapter changes.
        images_in_parts: tensors (S, 3, H, W) in [0, 1], one after the other; sizes may differ between parts.
        compute: where the model runs and in which precision.
    """
    # The part with cross-view layers: a nested model would otherwise compute metric depth as well.
    embedder = model.cross_view or model
    layers = model.spec.loss_layers[-1:]
    found = []
    for part in images_in_parts:
        for images in part.split(views_per_chunk(compute.device)):
            with compute.autocast():
                tokens = embedder.embed(images.to(compute.device)[None], layers=layers)
            patches = tokens.tokens[0, :, -tokens.grid_hw[0] * tokens.grid_hw[1] :]
            found.append(_described(patches.float()).cpu().numpy())
    return np.concatenate(found) if found else np.zeros((0, 2 * FREQUENCIES), np.float32)


def new_pictures(descriptors: np.ndarray) -> np.ndarray:
    """Return which frames (N,) show another picture than the frame before."""
    repeated = (descriptors[:-1] * descriptors[1:]).sum(axis=1) > 1 - SAME_PICTURE
    return np.concatenate((np.ones(min(1, len(descriptors)), dtype=bool), ~repeated))


def similarity_order(descriptors: np.ndarray) -> list[int]:
    """Return the frames in an order in which neighbours are alike; it starts at the end with the lower number.

    The path takes the most similar pairs first, as long as no frame has more than two neighbours, joins what is left,
    and is then improved by turning parts of it around (2-opt) until no turn helps. The same descriptors give the same
    order. Memory and time grow with the square of the number of frames.
    """
    if len(descriptors) < 3:
        return list(range(len(descriptors)))
    similarity = _similarity(descriptors)
    path = _turned(_greedy_path(similarity), similarity)
    return (path if path[0] < path[-1] else path[::-1]).tolist()


def in_order(descriptors: np.ndarray) -> bool:
    """Say whether the frames already are a sequence: neighbours are about as alike as in the similarity order.

    The measure is where the mean similarity of neighbours lies between a random order's (0) and that of the similarity
    order (1). Frames that all look the same, or fewer than four, are in order.
    """
    if len(descriptors) < 4:
        return True
    similarity = _similarity(descriptors)
    count = len(similarity)
    given, best = (
        float(similarity[order[:-1], order[1:]].mean())
        for order in (np.arange(count), np.array(similarity_order(descriptors)))
    )
    by_chance = float((similarity.sum() - similarity.trace()) / (count * (count - 1)))
    return given - by_chance >= LEAST_ORDER * (best - by_chance) - _SMALLEST_GAIN


def _described(patches_SPC: Tensor) -> Tensor:
    """Return the mean of random features over a frame's tokens, of unit length."""
    channels = patches_SPC.shape[-1]
    generator = torch.Generator().manual_seed(0)
    low, high = np.log(SHARPNESS)
    sharpness = torch.linspace(low, high, FREQUENCIES).exp()
    # Normalised tokens have the squared length `channels`, so that a kernel depends on the angle between tokens alone.
    frequencies = torch.randn(channels, FREQUENCIES, generator=generator) * sharpness / channels**0.5
    phases = torch.nn.functional.layer_norm(patches_SPC, (channels,)) @ frequencies.to(patches_SPC.device)
    return torch.nn.functional.normalize(torch.cat((phases.cos(), phases.sin()), dim=-1).mean(1), dim=-1)


def _similarity(descriptors: np.ndarray) -> np.ndarray:
    return descriptors @ descriptors.T


def _greedy_path(similarity: np.ndarray) -> np.ndarray:
    """Join the most similar frames first to paths, then the paths' ends, to one path through all frames (N,)."""
    count = len(similarity)
    others = similarity.copy()
    np.fill_diagonal(others, -np.inf)
    partners = min(_PARTNERS, count - 1)
    near = np.argpartition(-others, partners - 1, axis=1)[:, :partners]
    paths = {frame: [frame] for frame in range(count)}
    path_of = list(range(count))

    def join(pairs: np.ndarray) -> None:
        first, second = pairs
        for i, j in pairs[:, np.argsort(-others[first, second], kind="stable")].T.tolist():
            one, two = paths[path_of[i]], paths[path_of[j]]
            if one is two or i not in (one[0], one[-1]) or j not in (two[0], two[-1]):
                continue
            joined = (one if one[-1] == i else one[::-1]) + (two if two[0] == j else two[::-1])
            del paths[path_of[i]], paths[path_of[j]]
            paths[i] = joined
            for frame in joined:
                path_of[frame] = i

    join(np.unique(np.sort(np.stack((np.repeat(np.arange(count), partners), near.ravel())), axis=0), axis=1))
    while len(paths) > 1:
        ends = np.array(sorted({end for path in paths.values() for end in (path[0], path[-1])}))
        join(ends[np.stack(np.triu_indices(len(ends), 1))])
    return np.array(next(iter(paths.values())))


def _turned(path: np.ndarray, similarity: np.ndarray) -> np.ndarray:
    """Turn parts of the path around as long as that makes neighbours more alike, the largest gain first."""
    # An extra frame that is as much like all others stands before and behind the path, so that its ends are free.
    count = len(path)
    padded = np.zeros((count + 1, count + 1), np.float32)
    padded[:count, :count] = similarity
    path = np.concatenate(([count], path, [count]))
    while True:
        before, after = path[:-1], path[1:]
        kept = padded[before, after]
        # Row i, column j: the part from i + 1 to j is turned around.
        gain = padded[before[:, None], before] + padded[after[:, None], after] - kept[:, None] - kept
        gain = np.triu(gain, 2)
        i, j = np.unravel_index(np.argmax(gain), gain.shape)
        if gain[i, j] <= _SMALLEST_GAIN:
            return path[1:-1]
        path[i + 1 : j + 1] = path[i + 1 : j + 1][::-1]
