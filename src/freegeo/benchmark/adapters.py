"""The adapters of a benchmark run: trained once per dataset (or scene) and recipe, kept for every epoch.

```
OUT/adapters/<dataset>/<digest of everything that decides the adapter>/
        configuration.json   epoch-0/ epoch-1/ ...   finished.json (steps, seconds, parameters)
```

Variants with equal recipes share an adapter.
"""

from __future__ import annotations

import hashlib
import json
import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Required, TypedDict

import torch

from freegeo.adaptation.adapt import adapt
from freegeo.adaptation.adapted import Adapted
from freegeo.adaptation.adapter import Adapter, count_trainable
from freegeo.adaptation.adapter_files import load_adapter, save_adapter
from freegeo.adaptation.recipe import SMALLEST_SCENE, Recipe
from freegeo.adaptation.samples import SceneImages
from freegeo.adaptation.state import Progress, remove_state
from freegeo.adaptation.views import schedule
from freegeo.benchmark.tasks import DAMAGED, Problem, reason_of
from freegeo.data.datasets.registry import load_scene
from freegeo.errors import FreeGeoError, UserError
from freegeo.files import as_json, read_json, write_json
from freegeo.models.api import ReconstructionModel
from freegeo.models.precision import Compute

logger = logging.getLogger(__name__)

FOLDER, FINISHED, CONFIGURATION = "adapters", "finished.json", "configuration.json"


@dataclass(frozen=True, kw_only=True)
class AdapterJob:
    """One adapter: what it is trained on and how."""

    dataset: str
    scenes: tuple[str, ...]
    recipe: Recipe
    seed: int
    base: Mapping[str, Any]
    """Model, checkpoint, the precision of the adaptation, and the size of images where it is not the default."""

    def configuration(self) -> dict[str, Any]:
        """Everything that decides the adapter."""
        return as_json({
            "dataset": self.dataset, "scenes": self.scenes, "recipe": asdict(self.recipe), "seed": self.seed,
            **self.base,
        })  # fmt: skip

    def __str__(self) -> str:
        """Dataset and digest as text."""
        return f"the adapter for {self.dataset} ({self.digest})"

    @property
    def digest(self) -> str:
        """Hash of the configuration without the recipe's name, so that equal recipes share an adapter."""
        about = self.configuration()
        about["recipe"].pop("name")
        return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:12]

    def folder(self, out: Path) -> Path:
        """Folder of the adapter in the benchmark folder `out`."""
        return Path(out) / FOLDER / self.dataset / self.digest

    def is_finished(self, out: Path) -> bool:
        """Whether it has been trained to the end."""
        return (self.folder(out) / FINISHED).is_file()

    def steps(self, counts: Sequence[int]) -> int:
        """Number of optimiser steps on scenes with these numbers of frames."""
        return len(schedule([count for count in counts if count >= SMALLEST_SCENE], self.recipe, self.seed))


class Facts(TypedDict, total=False):
    """Content of `FINISHED`."""

    steps: Required[int]
    seconds: Required[float]
    peak_gb: Required[float]
    trainable: Required[int]
    trouble: str | None
    left_out: Required[list[Problem]]


def train(
    job: AdapterJob,
    model: ReconstructionModel,
    data: Path,
    out: Path,
    compute: Compute,
    on_step: Callable[[Progress], None] = lambda progress: None,
) -> list[Problem]:
    """Train an adapter, or continue, and keep it after every epoch; the model is left as it was.

    Returns the scenes that were left out because they could not be read or have fewer than 3 frames. FreeGeoError
    when none is left.
    """
    if job.is_finished(out):
        facts = read_json(job.folder(out) / FINISHED, Facts)
        _warn(job, facts.get("trouble"))
        return [Problem(**problem) for problem in facts["left_out"]]
    scenes, problems = _usable_scenes(job, model, data)
    folder = job.folder(out)
    write_json(folder / CONFIGURATION, job.configuration())

    def keep(epoch: int, adapter: Adapter) -> None:
        metadata = {"epoch": epoch, "scenes": [scene.name for scene in scenes], "configuration": job.configuration()}
        save_adapter(adapter, epoch_folder(job, out, epoch), metadata)

    reset_peak_memory(compute.device)
    result = adapt(
        model, scenes, job.recipe, seed=job.seed, compute=compute, resume_in=folder, on_step=on_step, on_epoch=keep
    )
    result.adapter.detach()
    remove_state(folder)
    _warn(job, result.trouble)
    facts = _facts(result, model, job.recipe, peak_memory_gb(compute.device))
    write_json(folder / FINISHED, {**facts, "left_out": [asdict(problem) for problem in problems]})
    return problems


def _warn(job: AdapterJob, trouble: str | None) -> None:
    """Say that an adapter should not be used; its predictions are made and scored all the same."""
    if trouble:
        logger.warning("%s: %s", job, trouble)


def use(job: AdapterJob, model: ReconstructionModel, out: Path, epoch: int | None) -> Adapter:
    """Attach a trained adapter to the model: that of `epoch`, or the last one for None.

    FreeGeoError when it has not been trained; UserError when there was no such epoch.
    """
    if not job.is_finished(out):
        raise FreeGeoError(f"the adapter for {job.dataset} was not trained; see the problem of its adaptation")
    epochs = trained_epochs(job, out)
    if epoch is not None and epoch not in epochs:
        raise UserError(f"--epoch {epoch}: the adapter of {job.dataset} has epochs 0 to {max(epochs)}.")
    return load_adapter(model, epoch_folder(job, out, max(epochs) if epoch is None else epoch))


def epoch_folder(job: AdapterJob, out: Path, epoch: int) -> Path:
    """Folder of the adapter after one epoch, counted from 0."""
    return job.folder(out) / f"epoch-{epoch}"


def trained_epochs(job: AdapterJob, out: Path) -> list[int]:
    """The epochs that were kept, ascending."""
    return sorted(int(path.name.removeprefix("epoch-")) for path in job.folder(out).glob("epoch-*"))


def reset_peak_memory(device: torch.device) -> None:
    """Reset the peak memory of a CUDA device; elsewhere nothing happens, as that of a process cannot be reset."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def peak_memory_gb(device: torch.device) -> float:
    """Peak memory in GB: of the device since `reset_peak_memory` on CUDA, else of the process since it started."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 1e9
    if sys.platform == "win32":
        return float("nan")
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


def _usable_scenes(job: AdapterJob, model: ReconstructionModel, data: Path) -> tuple[list[SceneImages], list[Problem]]:
    scenes, problems = [], []
    for name in job.scenes:
        try:
            scene = load_scene(data, job.dataset, name)
            if len(scene) < SMALLEST_SCENE:
                raise FreeGeoError(f"{len(scene)} frames are too few to adapt to; {SMALLEST_SCENE} are needed")
            scenes.append(SceneImages.from_photos(name, scene.photos, model, job.recipe, job.base.get("process_res")))
        except DAMAGED as error:
            problems.append(
                Problem(dataset=job.dataset, scene=name, stage="adapt", what="the scene", reason=reason_of(error))
            )
    if not scenes:
        raise FreeGeoError("no scene is left to adapt to: " + "; ".join(str(problem) for problem in problems))
    return scenes, problems


def _facts(result: Adapted, model: ReconstructionModel, recipe: Recipe, peak_gb: float) -> dict[str, Any]:
    change = result.loss_change()
    return {
        "steps": len(result.curve),
        "seconds": round(result.seconds, 2),
        "peak_gb": round(peak_gb, 3),
        "trainable": count_trainable(model, recipe.rank),
        "first_loss": change["first"],
        "last_loss": change["last"],
        "trouble": result.trouble,
    }
