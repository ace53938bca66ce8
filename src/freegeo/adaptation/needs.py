"""What each model needs: download and memory. The one source of `freegeo models` and of the table in the docs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from freegeo.adaptation.memory import Footprint
from freegeo.adaptation.recipe import scene
from freegeo.models import catalog
from freegeo.models.api import ReconstructionModel
from freegeo.models.memory import plan_reconstruction
from freegeo.models.precision import Compute
from freegeo.models.spec import ModelEntry

VIEWS = (8, 32, 100)
"""Numbers of photos whose reconstruction is planned."""
ADAPTED_VIEWS = 8
GPU = Compute(device=torch.device("cuda"), precision="bf16")
"""What memory is planned for; no GPU is needed for that."""


@dataclass(frozen=True, kw_only=True)
class ModelNeeds:
    """What a model needs, in bytes; memory as the planner predicts it for photos of 4:3 on a GPU in bf16."""

    entry: ModelEntry
    """Name, licence, description, and where the weights are."""
    parameters: int
    """Parameters in memory; parts of a checkpoint that are not built do not count."""
    download: int | None
    """Size of the download; None: the weights are in the package, or are given with --checkpoint."""
    image_hw: tuple[int, int]
    """Size of a photo of 4:3 after preprocessing."""
    reconstruct: Mapping[int, int]
    """Number of photos -> memory of reconstructing them together."""
    adapt: tuple[int, int] | None
    """Memory of adapting to 8 photos, as fast as possible and as small; None: the model cannot be adapted."""


def model_needs() -> list[ModelNeeds]:
    """Return what every model needs that can be loaded; one that is broken, such as a plug-in, is a warning."""
    return catalog.for_each(needs_of)


def needs_of(name: str) -> ModelNeeds:
    """Return what one model needs. Errors as `catalog.entry` and `catalog.build_empty`."""
    item, model = catalog.entry(name), catalog.build_empty(name)
    image_hw = photo_4_3(model)
    return ModelNeeds(
        entry=item,
        parameters=sum(parameter.numel() for parameter in model.parameters()),
        download=None if item.hub_id is None else item.download_bytes,
        image_hw=image_hw,
        reconstruct={views: _reconstruction_bytes(model, views, image_hw) for views in VIEWS},
        adapt=None if model.cross_view is None else _adaptation_bytes(model, image_hw),
    )


def photo_4_3(model: ReconstructionModel) -> tuple[int, int]:
    """Return the size (height, width) of a photo of 4:3 after preprocessing."""
    side, patch = model.spec.default_side, model.spec.patch_size
    return round(side * 3 / 4 / patch) * patch, side


def _reconstruction_bytes(model: ReconstructionModel, views: int, image_hw: tuple[int, int]) -> int:
    # A budget that no result exceeds; the planner takes long for one that is far larger.
    budget = 1000 * sum(parameter.numel() for parameter in model.parameters())
    parts, _ = plan_reconstruction(model, views, image_hw, compute=GPU, budget=budget)
    return sum(size for _, size in parts)


def _adaptation_bytes(model: ReconstructionModel, image_hw: tuple[int, int]) -> tuple[int, int]:
    job = Footprint.of_scene(model, ADAPTED_VIEWS, image_hw, scene(model.spec), GPU)
    return job.plan("device", checkpointing=False).peak_bytes, job.plan("disk", checkpointing=True).peak_bytes
