"""What a data folder lacks for the benchmark, and how to get it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from freegeo.benchmark.tasks import DAMAGED, reason_of
from freegeo.data.datasets import registry as datasets
from freegeo.data.procedural.splits import PREFIX
from freegeo.errors import UserError

HUB_DATASET = "depth-anything/DA3-BENCH"
ARCHIVE_GB = {"eth3d": 14.1, "7scenes": 3.3, "scannetpp": 10.1, "hiroom": 0.7}
"""Sizes of the archives on the hub."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """The state of one dataset in a data folder."""

    dataset: str
    scenes: int
    """Scenes that are complete."""
    wanted: int
    """Scenes of the published list; 0 when the list itself is missing."""
    problems: tuple[str, ...]
    """What is missing or damaged, scene by scene."""
    how_to_get: str

    @property
    def complete(self) -> bool:
        """Whether every scene can be predicted and scored."""
        return not self.problems


def check_data(data: Path, names: Sequence[str] = tuple(datasets.PUBLISHED)) -> list[Finding]:
    """Look at each dataset: scene folders, frames, ground truth. Images are not decoded.

    UserError for a dataset that does not exist.
    """
    return [check_dataset(Path(data), name) for name in names]


def check_dataset(data: Path, name: str) -> Finding:
    """Look at one dataset."""
    if name.startswith(PREFIX) and name in datasets.DATASETS:
        return Finding(dataset=name, scenes=0, wanted=0, problems=(), how_to_get="rendered when it is used")
    if name not in datasets.PUBLISHED:
        raise UserError(f"There is no dataset {name!r}; known are {', '.join(datasets.DATASETS)}.")
    how = download_command(data, name)
    if not (data / name).is_dir():
        return Finding(dataset=name, scenes=0, wanted=0, problems=(f"{data / name}: no such folder",), how_to_get=how)
    try:
        scenes = datasets.scene_names(data, name)
    except DAMAGED as error:
        return Finding(dataset=name, scenes=0, wanted=0, problems=(reason_of(error),), how_to_get=how)
    problems = {scene: _scene_problems(data, name, scene) for scene in scenes}
    return Finding(
        dataset=name,
        scenes=sum(not found for found in problems.values()),
        wanted=len(scenes),
        problems=tuple(f"{scene}: {problem}" for scene, found in problems.items() for problem in found),
        how_to_get=how,
    )


def download_command(data: Path, name: str) -> str:
    """Commands that fetch and unpack a published dataset."""
    return (
        f"hf download {HUB_DATASET} {name}.zip --repo-type dataset --local-dir {data} && "
        f"unzip -q {data / name}.zip -d {data}   # {ARCHIVE_GB[name]} GB"
    )


def _scene_problems(data: Path, dataset: str, scene: str) -> list[str]:
    try:
        loaded = datasets.load_scene(data, dataset, scene)
    except DAMAGED as error:
        return [reason_of(error)]
    truth = loaded.truth
    assert truth is not None
    problems = []
    if not truth.surface.is_file():
        problems.append(f"{truth.surface}: no such file (ground truth)")
    without = sum(path is None for path in truth.depth)
    # ETH3D carries depth only where a laser scan was rendered; elsewhere it is part of every frame.
    if without and dataset != "eth3d":
        problems.append(f"{without} of {len(loaded)} frames have no ground-truth depth, so they are fused unmasked")
    if len(loaded) < 3:
        problems.append(f"{len(loaded)} frames: fewer than 3 cannot be aligned")
    return problems
