"""What a data folder lacks for the benchmark, and how to get it."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from freegeo.benchmark.tasks import DAMAGED, reason_of
from freegeo.data.datasets import registry as datasets
from freegeo.data.datasets.base import Dataset


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
    blocking: tuple[str, ...] = ()
    """Those of them without which a scene can be predicted and scored no more."""
    how_to_get: str

    @property
    def complete(self) -> bool:
        """Whether nothing is missing."""
        return not self.problems

    @property
    def usable(self) -> bool:
        """Whether every scene can be predicted and scored, as published, whatever else is missing."""
        return not self.blocking


def check_data(data: Path, names: Sequence[str] | None = None) -> list[Finding]:
    """Look at each dataset: scene folders, frames, ground truth. Images are not decoded.

    Args:
        data: folder of the unpacked datasets.
        names: datasets to look at; None: all that are not generated.

    Raises:
        UserError: there is no such dataset.
    """
    if names is None:
        names = [dataset.name for dataset in datasets.DATASETS.values() if not dataset.generated]
    return [check_dataset(Path(data), name) for name in names]


def check_dataset(data: Path, name: str) -> Finding:
    """Look at one dataset; UserError when there is none of this name."""
    dataset = datasets.get_dataset(name)
    if dataset.generated:
        return Finding(dataset=name, scenes=0, wanted=0, problems=(), how_to_get="rendered when it is used")
    how = how_to_get(data, dataset)
    if not (data / name).is_dir():
        return _nothing(name, f"{data / name}: no such folder", how)
    try:
        scenes = datasets.scene_names(data, name)
    except DAMAGED as error:
        return _nothing(name, reason_of(error), how)
    found = {scene: _scene_problems(data, dataset, scene) for scene in scenes}
    said = [
        (f"{scene}: {problem}", blocks) for scene, problems in found.items() for problem, blocks in problems.items()
    ]
    return Finding(
        dataset=name,
        scenes=sum(not problems for problems in found.values()),
        wanted=len(scenes),
        problems=tuple(problem for problem, _ in said),
        blocking=tuple(problem for problem, blocks in said if blocks),
        how_to_get=how,
    )


def _nothing(name: str, reason: str, how: str) -> Finding:
    return Finding(dataset=name, scenes=0, wanted=0, problems=(reason,), blocking=(reason,), how_to_get=how)


def how_to_get(data: Path, dataset: Dataset) -> str:
    """The command that fetches a dataset; for one that is not on the hub, the folder to put its scenes into."""
    if dataset.archive is None:
        return f"put its scenes into {data / dataset.name}"
    return f"freegeo bench download {dataset.name} --data {shlex.quote(str(data))}   # {dataset.archive.gb} GB"


def _scene_problems(data: Path, dataset: Dataset, scene: str) -> dict[str, bool]:
    """What a scene lacks, and whether it can be scored without."""
    try:
        loaded = datasets.load_scene(data, dataset.name, scene)
    except DAMAGED as error:
        return {reason_of(error): True}
    truth = loaded.truth
    if truth is None:
        return {"no ground truth, so it cannot be scored": True}
    problems = {}
    if not truth.surface.is_file():
        problems[f"{truth.surface}: no such file (ground truth)"] = True
    without = sum(path is None for path in truth.depth)
    if without and dataset.depth_of_every_frame and dataset.read_depth is not None:
        problems[f"{without} of {len(loaded)} frames have no ground-truth depth, so they are fused unmasked"] = False
    if len(loaded) < 3:
        problems[f"{len(loaded)} frames: fewer than 3 cannot be aligned"] = True
    return problems
