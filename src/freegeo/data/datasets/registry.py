"""The datasets of the benchmark by name: the published ones and every split of the generated rooms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from freegeo.data.datasets.base import Dataset, DatasetConstants
from freegeo.data.datasets.eth3d import ETH3D
from freegeo.data.datasets.hiroom import HIROOM
from freegeo.data.datasets.scannetpp import SCANNETPP
from freegeo.data.datasets.sevenscenes import SEVEN_SCENES
from freegeo.data.procedural.splits import SPLITS
from freegeo.data.scene import Scene, SceneTruth
from freegeo.errors import UserError
from freegeo.geometry.resample import resize_nearest

DATASETS: dict[str, Dataset] = {
    dataset.name: dataset
    for dataset in (
        ETH3D,
        SEVEN_SCENES,
        SCANNETPP,
        HIROOM,
        *SPLITS,
    )
}


def get_dataset(name: str) -> Dataset:
    """Return a dataset by name; UserError lists the names when this one is unknown."""
    if name not in DATASETS:
        raise UserError(f"There is no dataset {name!r}; known are {', '.join(DATASETS)}.")
    return DATASETS[name]


def constants(dataset: str) -> DatasetConstants:
    """Return what the evaluation fixes for a dataset."""
    return get_dataset(dataset).constants


def scene_names(data: Path, dataset: str) -> list[str]:
    """Return the scenes of a dataset in their order; `data` is the folder that holds `<dataset>/`."""
    return list(get_dataset(dataset).scene_names(Path(data) / dataset))


def load_scene(data: Path, dataset: str, scene: str) -> Scene:
    """Read one scene of `<data>/<dataset>`; errors as in the dataset's own loader."""
    return get_dataset(dataset).load_scene(Path(data) / dataset, scene)


def valid_mask(truth: SceneTruth, index: int, size_hw: tuple[int, int]) -> np.ndarray | None:
    """Return the pixels of one frame that may be fused, (H, W) bool at fusion size; None without any restriction."""
    mask = get_dataset(truth.dataset).valid_mask
    return None if mask is None else mask(truth, index, size_hw)


def true_depth(scene: Scene, size_hw: tuple[int, int]) -> Tensor | None:
    """Ground-truth depth of all frames at one size, nearest pixel: (S, h, w) float32 metres, 0 where nothing is known.

    Pixels that the dataset masks count as unknown. None when no frame of the scene has a depth. The depth camera of
    7-Scenes is not registered to the photos, so its errors near edges mean little.
    """
    if scene.depth_z is not None:
        return resize_nearest(scene.depth_z, size_hw)
    truth = scene.truth
    read_depth = None if truth is None else get_dataset(truth.dataset).read_depth
    if truth is None or read_depth is None or not any(truth.depth):
        return None
    frames = []
    for index, (path, photo) in enumerate(zip(truth.depth, scene.photos, strict=True)):
        if path is None:
            frames.append(torch.zeros(size_hw))
            continue
        depth = read_depth(path, photo.size_hw)
        known = np.isfinite(depth)
        mask = valid_mask(truth, index, (depth.shape[0], depth.shape[1]))
        if mask is not None:
            known &= mask
        frames.append(resize_nearest(torch.from_numpy(np.where(known, depth, np.float32(0))), size_hw))
    return torch.stack(frames)
