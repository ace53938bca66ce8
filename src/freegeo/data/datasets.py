"""The datasets of the benchmark by name, behind one set of functions: the published ones and generated rooms."""

from pathlib import Path
from types import ModuleType

import numpy as np

from freegeo.data import eth3d, hiroom, scannetpp, sevenscenes
from freegeo.data.procedural.splits import SPLITS, RoomSplit
from freegeo.data.protocol import Protocol, SceneTruth
from freegeo.data.scene import Scene
from freegeo.errors import UserError

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


def _module(dataset: str) -> ModuleType | RoomSplit:
    if dataset not in DATASETS:
        raise UserError(f"There is no dataset {dataset!r}; known are {', '.join(DATASETS)}.")
    return DATASETS[dataset]
