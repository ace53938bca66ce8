"""First stage: run the model on the frames of every task and store its predictions with the full configuration."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from freegeo.adaptation import recipe as recipes
from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.recipe import Recipe
from freegeo.adaptation.state import Progress
from freegeo.benchmark.adapters import AdapterJob, peak_memory_gb, reset_peak_memory, train, use
from freegeo.benchmark.frames import require_truth
from freegeo.benchmark.paper.variants import Variant, variant
from freegeo.benchmark.stored import write_stored
from freegeo.benchmark.tasks import (
    MEASURED_FILE,
    SAMPLE,
    Problem,
    Task,
    choose_frames,
    finish,
    is_finished,
    reason_of,
    run_each,
    unique,
)
from freegeo.data.datasets.registry import get_dataset, load_scene, scene_names
from freegeo.data.scene import Scene
from freegeo.errors import UserError
from freegeo.files import write_json
from freegeo.geometry.camera import resize_K
from freegeo.models.api import ReconstructionModel, embed_in_chunks
from freegeo.models.catalog import load_model
from freegeo.models.images import chosen_side, read_some
from freegeo.models.memory import plan_reconstruction
from freegeo.models.precision import Compute, Precision
from freegeo.types import Features, ImageBatch, Prediction, Priors, ViewTokens

AdaptPer = Literal["dataset", "scene"]
DEFAULT_ROW = "procedural"
"""Row of adaptation settings for a dataset without published ones."""
EVALUATED_IN: Mapping[str | None, Precision] = {"da3": "bf16", "vggt": "fp32"}
"""Arithmetic of the released evaluation of a model family on a GPU; the adaptation's is the recipe's."""


@dataclass(frozen=True, kw_only=True)
class Setup:
    """What a run is made with; together with a task it decides a prediction."""

    data: Path
    """Folder of the unpacked datasets; generated rooms are written there when they are first used."""
    out: Path
    model: str
    checkpoint: Path | None = None
    device: str | None = None
    precision: Precision | None = None
    recipe: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the recipe that are replaced, as in `Recipe.changed`."""
    adapt_per: AdaptPer
    adapt_seed: int
    epoch: int | None = None
    """Which epoch's adapter predicts; None: the last."""
    given_cameras: bool = False
    """Give the model the true cameras; scored with them too (`recon_posed`)."""
    process_res: int | None = None
    """Longest side of the model's images; None: its default. Recipes that squash adapt at their own size."""
    scenes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Scenes of each dataset that a dataset-wise adapter is trained on."""
    overwrite: bool = False


class Predictor:
    """Carries out adaptations and predictions with one resident model."""

    def __init__(self, setup: Setup):
        self.setup = setup
        self.chosen = Compute.choose(setup.device, setup.precision)
        """As the run's options say; predictions are made with `compute`."""
        self._in_place: tuple[str, Adapter] | None = None
        self._load = lru_cache(maxsize=8)(partial(load_scene, setup.data))

    @cached_property
    def model(self) -> ReconstructionModel:
        """The model, loaded on first use."""
        model = load_model(self.setup.model, checkpoint=self.setup.checkpoint)
        return model.to(self.chosen.device).eval()

    @property
    def process_res(self) -> int | None:
        """Longest side of the images where it is not the model's default; UserError for one that it cannot read."""
        return chosen_side(self.model.spec, self.setup.process_res)

    @cached_property
    def compute(self) -> Compute:
        """Device and precision of predictions: by default the precision of the model family's released evaluation."""
        return self.chosen.preferring(EVALUATED_IN.get(self.model.spec.adaptation.published))

    def configuration(self, task: Task) -> dict[str, Any]:
        """Everything but the task itself that decides its prediction."""
        job = self.adapter_job(task)
        per = {"per": self.setup.adapt_per, "epoch": self.setup.epoch}
        return {**self._base(), "adaptation": None if job is None else {**per, **job.configuration()}}

    def adapter_job(self, task: Task) -> AdapterJob | None:
        """The adapter that a task needs; None for the frozen model."""
        kind = variant(task.variant)
        if not kind.adapted:
            return None
        scenes = (task.scene,) if self.setup.adapt_per == "scene" else self.setup.scenes.get(task.dataset, ())
        recipe = kind.recipe(self.recipe(task.dataset))
        base = {**self._base(), "precision": self.chosen.preferring(recipe.precision).precision}
        return AdapterJob(
            dataset=task.dataset, scenes=tuple(scenes), recipe=recipe, seed=self.setup.adapt_seed, base=base
        )

    def recipe(self, dataset: str) -> Recipe:
        """The recipe of a dataset with the changes of the run.

        A dataset without published settings takes those of generated rooms (docs/benchmark.md, "Adding a dataset").
        """
        row = get_dataset(dataset).recipe_row or DEFAULT_ROW
        name = self.setup.recipe
        recipe = recipes.named(name, self.model.spec, None if name in recipes.OWN else row)
        if recipe.cameras:
            raise UserError(
                f"the benchmark does not make the cameras that recipe '{name}' learns from. Choose another --recipe."
            )
        return recipe.changed(**self.setup.changes)

    def unfinished(self, tasks: Sequence[Task]) -> list[Task]:
        """The tasks that still have to be predicted; UserError when one was made with other settings."""
        return [
            task
            for task in unique(tasks)
            if not is_finished(task, self.setup.out, self.configuration(task), overwrite=self.setup.overwrite)
        ]

    def adapter_jobs(self, tasks: Sequence[Task]) -> list[AdapterJob]:
        """The adapters that these tasks need, each once."""
        jobs = [job for task in tasks if (job := self.adapter_job(task)) is not None]
        return list({job.folder(self.setup.out): job for job in jobs}.values())

    def adapt(self, job: AdapterJob, on_step: Callable[[Progress], None] = lambda progress: None) -> list[Problem]:
        """Train one adapter; returns the scenes that had to be left out."""
        self._take_off()
        return train(job, self.model, self.setup.data, self.setup.out, self.chosen, on_step)

    def predict(self, task: Task) -> None:
        """Carry out one task and store its outcome."""
        scene: Scene = self._load(task.dataset, task.scene)
        kind = variant(task.variant)
        job = self.adapter_job(task)
        self._put_on(job)
        reset_peak_memory(self.compute.device)
        facts: dict[str, Any] = {"adapter": None if job is None else job.digest}
        if kind.measures == "features":
            frames, values = self._feature_distance(scene, task)
            write_json(task.folder(self.setup.out) / MEASURED_FILE, values)
        else:
            started = time.perf_counter()
            frames, prediction = self._prediction(scene, task, kind)
            facts |= {"seconds": time.perf_counter() - started, "peak_gb": peak_memory_gb(self.compute.device)}
            write_stored(task, self.setup.out, prediction, frames)
        finish(task, self.setup.out, self.configuration(task), frames=frames, **facts)

    def noise(self, views: int) -> Tensor:
        """Images (views, 3, H, W) of noise at the model's size, 4:3."""
        spec = self.model.spec
        side = self.process_res or spec.default_side
        height, width = (max(1, round(side / spec.patch_size)) * spec.patch_size for side in (
            side * 3 / 4, side,
        ))  # fmt: skip
        return torch.rand(views, 3, height, width, generator=torch.Generator().manual_seed(0))

    @torch.no_grad()
    def forward(self, images: Tensor) -> Prediction:
        """One whole pass over images (S, 3, H, W), with the adapter that is attached, if any."""
        with self.compute.autocast():
            return self.model.decode(self._features(self._embedded(images)))

    def close(self) -> None:
        """Detach the adapter, if there is one."""
        self._take_off()

    @torch.no_grad()
    def _prediction(self, scene: Scene, task: Task, kind: Variant) -> tuple[list[int], Prediction]:
        if kind.encode_all:
            sample = choose_frames(task.rule, len(scene), SAMPLE, task.seed)
            kept = list(range(len(sample)))[::2][: task.views]
            features = self._features(*self._read(scene, sample)).select(kept)
            frames = [sample[position] for position in kept]
        else:
            frames = choose_frames(task.rule, len(scene), task.views, task.seed)
            features = self._features(*self._read(scene, frames))
        with self.compute.autocast():
            found = self.model.decode(features)
        return frames, found.map(lambda tensor: tensor[0].float().cpu())

    @torch.no_grad()
    def _feature_distance(self, scene: Scene, task: Task) -> tuple[list[int], dict[str, float]]:
        """Distance of the last layer's patch tokens to those of the frozen model that sees 8 views."""
        if self.setup.given_cameras:
            raise UserError("feature distances are those of photos alone; leave --given-cameras out.")
        sample = choose_frames(task.rule, len(scene), SAMPLE, task.seed)
        kept = list(range(len(sample)))[::2][: task.views]
        layer = self.model.spec.loss_layers[-1]
        tokens, _ = self._read(scene, sample)
        with self._in_place[1].off() if self._in_place else nullcontext():
            teacher = self._features(tokens).select(kept).levels[layer][0].float()
        student = self._features(tokens.select(kept)).levels[layer][0].float()
        cosine = F.cosine_similarity(student, teacher, dim=-1).mean()
        values = {"mse": float((student - teacher).square().mean()), "cosine": float(cosine)}
        return [sample[position] for position in kept], values

    def _read(self, scene: Scene, frames: Sequence[int]) -> tuple[ViewTokens, Priors | None]:
        """The embedded frames and, where the run gives the model the true cameras, these."""
        chosen = scene.select(frames)
        photos = list(chosen.photos)
        batch = read_some(self.model, photos, range(len(photos)), "upstream", self.process_res)
        tokens = self._embedded(batch.images)
        if not self.setup.given_cameras:
            return tokens, None
        return tokens, true_cameras(chosen, batch)

    def _embedded(self, images: Tensor) -> ViewTokens:
        """Embed images (S, 3, H, W); UserError when so many cannot be reconstructed in the memory that is free."""
        plan_reconstruction(self.model, len(images), (images.shape[-2], images.shape[-1]), compute=self.compute)
        with self.compute.autocast():
            return embed_in_chunks(self.model, images, device=self.compute.device)

    def _features(self, tokens: ViewTokens, priors: Priors | None = None) -> Features:
        with self.compute.autocast():
            return self.model.aggregate(tokens, reference="first", priors=priors)

    def _base(self) -> dict[str, Any]:
        loaded = self.model.loaded_from
        return {
            "model": self.setup.model,
            "checkpoint": loaded.fingerprint if loaded else None,
            "precision": self.compute.precision,
            **({"given_cameras": True} if self.setup.given_cameras else {}),
            **({} if self.process_res is None else {"process_res": self.process_res}),
        }

    def _put_on(self, job: AdapterJob | None) -> None:
        """Attach the adapter of a job in place of any other; None: leave the model without one."""
        wanted = None if job is None else str(job.folder(self.setup.out))
        if self._in_place is not None and self._in_place[0] == wanted:
            return
        self._take_off()
        if job is not None and wanted is not None:
            self._in_place = wanted, use(job, self.model, self.setup.out, self.setup.epoch)

    def _take_off(self) -> None:
        if self._in_place is not None:
            self._in_place[1].detach()
            self._in_place = None


def predict_all(
    predictor: Predictor,
    tasks: Sequence[Task],
    *,
    on_step: Callable[[AdapterJob, Progress], None] = lambda job, progress: None,
    on_task: Callable[[Task], None] = lambda task: None,
) -> list[Problem]:
    """Train the adapters that unfinished tasks need, then predict these tasks; returns what failed.

    UserError, before anything is computed, when a stored task was made with other settings.
    """
    waiting = predictor.unfinished(tasks)
    problems = run_each(
        predictor.adapter_jobs(waiting),
        lambda job: predictor.adapt(job, partial(on_step, job)),
        adaptation_problem,
    )
    # One adapter after the other, and within it scene by scene, so that both are loaded once.
    ordered = sorted(waiting, key=lambda task: (task.dataset, _adapter_of(predictor, task)))
    problems += run_each(ordered, predictor.predict, problem_of("predict"), on_task)
    predictor.close()
    return problems


def adaptation_problem(job: AdapterJob, error: BaseException) -> Problem:
    """The problem that reports a failed adaptation."""
    return Problem(
        dataset=job.dataset, scene=_joined(job.scenes), stage="adapt", what=job.digest, reason=reason_of(error)
    )


def problem_of(stage: Literal["predict", "evaluate"]) -> Callable[[Task, BaseException], Problem]:
    """A function that turns a failed task of a stage into the problem that reports it."""

    def explain(task: Task, error: BaseException) -> Problem:
        what = f"{task.views} views, seed {task.seed}, {task.variant}"
        return Problem(dataset=task.dataset, scene=task.scene, stage=stage, what=what, reason=reason_of(error))

    return explain


def true_cameras(scene: Scene, batch: ImageBatch) -> Priors:
    """True cameras of a scene, K in pixels of its `batch`; UserError without truth."""
    truth, T_cam_world, K = require_truth(scene)
    sizes = zip(K, truth.camera_hw, scene.photos, strict=True)
    photo_K = torch.stack([resize_K(one, camera_hw, photo.size_hw) for one, camera_hw, photo in sizes])
    return Priors(T_cam_world=T_cam_world[None], K=batch.model_K(photo_K)[None], metric=True)


def listed_scenes(data: Path, dataset: str, limit: int | None) -> tuple[str, ...]:
    """The scenes of a dataset, at most `limit` of them."""
    names = scene_names(data, dataset)
    return tuple(names if limit is None else names[:limit])


def _adapter_of(predictor: Predictor, task: Task) -> str:
    job = predictor.adapter_job(task)
    return "" if job is None else str(job.folder(predictor.setup.out))


def _joined(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 3 else f"{names[0]} and {len(names) - 1} more"
