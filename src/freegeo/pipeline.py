"""Photos -> adapter -> reconstruction folder: what `freegeo run` does, importable."""

from __future__ import annotations

import logging
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from freegeo import __version__
from freegeo.adaptation import recipe as recipes
from freegeo.adaptation.adapt import Adapted, Progress, loss_change
from freegeo.adaptation.adapt import adapt as train_adapter
from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.adapter_files import METADATA, load_adapter
from freegeo.adaptation.memory import plan_reconstruction
from freegeo.adaptation.recipe import SEED, SMALLEST_SCENE, Recipe
from freegeo.adaptation.samples import SceneImages
from freegeo.errors import UserError
from freegeo.export.formats import export, filter_reconstruction
from freegeo.export.pixels import masks_for_model
from freegeo.export.reconstruction import FILE_NAME as PREDICTION_NAME
from freegeo.export.reconstruction import Reconstruction
from freegeo.files import FORMAT, read_json, write_json
from freegeo.fusion.filtering import FilterReport, FilterSettings
from freegeo.models.api import embed_in_chunks
from freegeo.models.precision import Compute
from freegeo.report.page import write_report
from freegeo.run_folder import RunFolder
from freegeo.types import ImageBatch, PhotoLike

if TYPE_CHECKING:
    from freegeo.models.api import ReconstructionModel

logger = logging.getLogger(__name__)

SUMMARY_NAME = "reconstruction.json"
FROZEN_FOLDER, ADAPTER_FOLDER = "frozen", "adapter"
FORMATS = ("ply", "glb")
CPU = Compute()


@torch.no_grad()
def predict(
    model: ReconstructionModel, batch: ImageBatch, *, reference: str | None = None, compute: Compute = CPU
) -> Reconstruction:
    """Reconstruct prepared images; an adapter that is in place is used as it stands.

    `reference` None takes the model's own rule. UserError when the images do not fit into memory together.
    """
    plan_reconstruction(model, len(batch), batch.image_hw, compute=compute)
    model.to(compute.device).eval()
    with compute.autocast():
        tokens = embed_in_chunks(model, batch.images, device=compute.device)
        features = model.aggregate(tokens, reference=reference or model.spec.reference)
    return Reconstruction.from_prediction(model.decode(features), batch)


def reconstruct(
    model: ReconstructionModel, photos: Sequence[PhotoLike], *, adapter: Adapter | None = None, **options: Any
) -> Reconstruction:
    """Reconstruct photos: depth, confidence and cameras of every view.

    With an `adapter` (already in place on the model) the first view is the reference, as in adaptation. `options` are
    those of `predict`.
    """
    if adapter is not None:
        options.setdefault("reference", "first")
    return predict(model, model.preprocess(photos), **options)


def adapt(
    model: ReconstructionModel,
    photos: Sequence[PhotoLike],
    *,
    recipe: str | Recipe = "scene",
    seed: int = SEED,
    compute: Compute = CPU,
    **options: Any,
) -> Adapted:
    """Adapt a model to one scene's photos; the adapter stays in place (`result.adapter.detach()` takes it out).

    `options` are those of `freegeo.adaptation.adapt.adapt`. UserError for fewer than 3 photos.
    """
    require_enough_photos(photos)
    plan = recipes.named(recipe, model.spec) if isinstance(recipe, str) else recipe
    scene = SceneImages.from_batch("photos", model.preprocess(photos))
    return train_adapter(model, [scene], plan, seed=seed, compute=compute, **options)


def require_enough_photos(photos: Sequence[PhotoLike]) -> None:
    """Raise UserError when there are too few photos to hold one out."""
    if len(photos) < SMALLEST_SCENE:
        raise UserError(
            f"adaptation needs at least {SMALLEST_SCENE} photos, got {len(photos)}. Add photos, or reconstruct without "
            "adapting (--no-adapt, or `freegeo reconstruct`)."
        )


@dataclass(frozen=True, kw_only=True)
class Hooks:
    """How a caller follows a run."""

    stage: Callable[[str], None] = lambda name: None
    step: Callable[[Progress], None] = lambda progress: None


@dataclass
class Job:
    """Everything that turns photos into an output folder; each part that is already there is kept."""

    model: ReconstructionModel
    batch: ImageBatch
    folder: RunFolder
    recipe: Recipe | None
    """None: reconstruct with the frozen model, or with `adapter`."""
    scene: SceneImages | None = None
    """Images to adapt to, where the recipe reads them otherwise than `batch` has them."""
    adapter: Path | None = None
    """A saved adapter to reconstruct with, instead of training one."""
    seed: int = SEED
    compute: Compute = CPU
    reference: str | None = None
    """Reference-view rule of the frozen model; None: the model's own."""
    formats: Sequence[str] = FORMATS
    """Files to write besides the predictions, names of `freegeo.export.formats.WRITERS`."""
    filters: FilterSettings = field(default_factory=FilterSettings)
    masks: list[np.ndarray] | None = None
    """One (H, W) array per photo at its size, not zero where points are wanted."""
    hooks: Hooks = field(default_factory=Hooks)
    timings: dict[str, float] = field(default_factory=dict)
    command: str | None = None
    """The command line, for reconstruction.json."""
    after: Callable[[Job], None] = lambda job: None
    """Writes more before the folder counts as finished."""
    in_place: Adapter | None = None
    """The adapter that the final prediction was made with; it stays on the model."""

    def run(self) -> dict[str, Any]:
        """Write everything and return the content of reconstruction.json."""
        plan_reconstruction(self.model, len(self.batch), self.batch.image_hw, compute=self.compute)
        frozen = None
        if self.recipe is not None:
            frozen = self._predicted(self.folder / FROZEN_FOLDER, "frozen prediction", self.reference)
            self._adapted()
        elif self.adapter is not None:
            self.in_place = load_adapter(self.model, self.adapter)
        adapted = self.recipe is not None or self.adapter is not None
        name = "adapted prediction" if adapted else "prediction"
        final = self._predicted(self.folder.path, name, "first" if adapted else self.reference)
        report = self._export(final)
        summary = self._summary(final, frozen, report)
        write_json(self.folder / SUMMARY_NAME, summary)
        self.after(self)
        self.hooks.stage("report")
        write_report(self.folder.path)
        self.folder.finish()
        return summary

    def _predicted(self, folder: Path, stage: str, reference: str | None) -> Reconstruction:
        if (folder / PREDICTION_NAME).is_file():
            return Reconstruction.load(folder)
        with self._timed(stage):
            result = predict(self.model, self.batch, reference=reference, compute=self.compute)
            result.save(folder)
        return result

    def _adapted(self) -> None:
        """Train the adapter, or continue training it, or load the finished one."""
        folder = self.folder / ADAPTER_FOLDER
        if (folder / METADATA).is_file():
            self.in_place = load_adapter(self.model, folder)
            return
        assert self.recipe is not None
        scene = self.scene or SceneImages.from_batch("photos", self.batch)
        with self._timed("adaptation"):
            result = train_adapter(
                self.model, [scene], self.recipe, seed=self.seed, compute=self.compute,
                resume_in=folder, on_step=self.hooks.step,
            )  # fmt: skip
        self.in_place = result.adapter
        result.save(folder)

    def _export(self, final: Reconstruction) -> FilterReport | None:
        """Filter once and write all formats; None without cameras, which have no points."""
        if not final.has_cameras:
            return None
        with self._timed("points and files"):
            masks = None if self.masks is None else masks_for_model(final, self.masks)
            filtered = filter_reconstruction(final, masks=masks, settings=self.filters)
            export(final, self.folder.path, self.formats, filtered=filtered, seed=self.seed)
        return filtered[1]

    def _summary(
        self, final: Reconstruction, frozen: Reconstruction | None, report: FilterReport | None
    ) -> dict[str, Any]:
        loaded = getattr(self.model, "loaded_from", None)
        return {
            "format": FORMAT,
            "model": self.model.spec.name,
            "checkpoint": {"file": loaded.file, "fingerprint": loaded.fingerprint} if loaded else None,
            "licence_of_weights": self.model.spec.weights_licence,
            "images": list(final.names),
            "image_hw": list(final.image_hw),
            "adapter": ADAPTER_FOLDER if self.recipe else (str(self.adapter) if self.adapter else None),
            "frozen_prediction": f"{FROZEN_FOLDER}/{PREDICTION_NAME}" if frozen is not None else None,
            "loss": self._loss_change(),
            "filters": None if report is None else {"pixels": report.pixels, "removed": dict(report.removed)},
            "recipe": self.folder.settings.get("recipe"),
            "settings": dict(self.folder.settings),
            "command": self.command,
            "seconds": {name: round(value, 2) for name, value in self.timings.items()},
            "versions": versions(),
        }

    def _loss_change(self) -> dict[str, float] | None:
        """Return the mean total loss of the first and last tenth of the steps."""
        metadata = self.folder / ADAPTER_FOLDER / METADATA
        if self.recipe is None or not metadata.is_file():
            return None
        return loss_change(read_json(metadata)["loss_curve"])

    def _timed(self, stage: str):
        return _Timed(self, stage)


class _Timed:
    """Announces a stage and notes how long it took."""

    def __init__(self, job: Job, stage: str):
        self.job, self.stage = job, stage

    def __enter__(self) -> None:
        self.job.hooks.stage(self.stage)
        self.started = time.monotonic()

    def __exit__(self, *_) -> None:
        self.job.timings[self.stage] = time.monotonic() - self.started


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    return {"freegeo": __version__, "torch": torch.__version__, "python": platform.python_version()}


def settings_of(recipe: Recipe | None, **others: Any) -> Mapping[str, Any]:
    """Return the settings that an output folder is compared by."""
    from dataclasses import asdict

    return {**others, "recipe": None if recipe is None else asdict(recipe)}
