"""The datasets of the benchmark by name, behind one set of functions: the published ones and generated rooms."""

from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from freegeo.data.datasets import eth3d, hiroom, scannetpp, sevenscenes
from freegeo.data.datasets.base import Protocol, SceneTruth
from freegeo.data.procedural.splits import SPLITS, RoomSplit
from freegeo.data.scene import Scene
from freegeo.errors import UserError
from freegeo.geometry.resample import resize_nearest

PUBLISHED: dict[str, ModuleType] = {
    "eth3d": eth3d,
    "7scenes": sevenscenes,
    "scannetpp": scannetpp,
    "hiroom": hiroom,
}
"""Key, which is also the folder in the unpacked archive, to module."""
DATASETS: dict[str, ModuleType | RoomSplit] = {**PUBLISHED, **SPLITS}
"""The same with every split of the generated rooms, such as `procedural-light`."""


def protocol(dataset: str) -> Protocol:
    """Constants of a dataset; UserError lists the names when this one is unknown."""
    return _module(dataset).PROTOCOL


def scene_names(bench: Path, dataset: str) -> list[str]:
    """Published scenes of a dataset in their order; `bench` is the folder of the unpacked archive."""
    return _module(dataset).scene_names(Path(bench) / dataset)


def load_scene(bench: Path, dataset: str, scene: str) -> Scene:
    """Read one scene of `<bench>/<dataset>`; errors as in the dataset's own module."""
    return _module(dataset).load_scene(Path(bench) / dataset, scene)


def valid_mask(truth: SceneTruth, index: int, size_hw: tuple[int, int]) -> np.ndarray | None:
    """Pixels of one frame that may be fused, (H, W) bool at fusion size; None when the dataset sets no mask here."""
    return _module(truth.dataset).valid_mask(truth, index, size_hw)


def true_depth(scene: Scene, size_hw: tuple[int, int]) -> Tensor | None:
    """Ground-truth depth of all frames at one size, nearest pixel: (S, h, w) float32 metres, 0 where nothing is known.

    What the dataset masks counts as unknown. None when no frame of the scene has a depth. For 7-Scenes the depth camera
    is not registered to the photos, so there errors near edges mean little.
    """
    if scene.depth_z is not None:
        return resize_nearest(scene.depth_z, size_hw)
    truth = scene.truth
    if truth is None or not any(truth.depth):
        return None
    frames = []
    for index, (path, photo) in enumerate(zip(truth.depth, scene.photos, strict=True)):
        if path is None:
            frames.append(torch.zeros(size_hw))
            continue
        depth = PUBLISHED[truth.dataset].read_depth(path, photo.size_hw)
        known = np.isfinite(depth) & valid_mask(truth, index, (depth.shape[0], depth.shape[1]))
        frames.append(resize_nearest(torch.from_numpy(np.where(known, depth, np.float32(0))), size_hw))
    return torch.stack(frames)


def _module(dataset: str) -> ModuleType | RoomSplit:
    if dataset not in DATASETS:
        raise UserError(f"There is no dataset {dataset!r}; known are {', '.join(DATASETS)}.")
    return DATASETS[dataset]
