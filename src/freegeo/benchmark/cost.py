"""Estimates of a run's duration, made before it starts."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from freegeo.adaptation.adapt import adapt
from freegeo.adaptation.recipe import Recipe
from freegeo.adaptation.samples import SceneImages
from freegeo.benchmark.paper.variants import variant
from freegeo.benchmark.predict import Predictor
from freegeo.benchmark.tasks import DAMAGED, SAMPLE, Task
from freegeo.data.datasets.base import DatasetConstants
from freegeo.data.datasets.registry import constants, load_scene
from freegeo.fusion.mesh import sample_surface
from freegeo.fusion.tsdf import TsdfVolume
from freegeo.geometry.camera import K_from_fov
from freegeo.metrics.cloud import ReferenceCloud

MEASURED_STEPS = 3
MEASURED_FRAMES = 2
WALL_DEPTH_M = (1.0, 4.0)


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a run will take, from one measured pass per number of views and one measured adaptation step."""

    passes: Mapping[int, int]
    """Views -> number of forward passes."""
    seconds_of_pass: Mapping[int, float]
    adapters: int
    steps: int
    """Optimiser steps of all adapters together."""
    seconds_of_step: float

    @property
    def seconds(self) -> float:
        """Predicted duration."""
        forward = sum(count * self.seconds_of_pass[views] for views, count in self.passes.items())
        return forward + self.steps * self.seconds_of_step

    def lines(self) -> list[str]:
        """The estimate as lines of text."""
        said = [
            f"{count} forward passes of {views} views, {self.seconds_of_pass[views]:.2f} s each"
            for views, count in sorted(self.passes.items())
        ]
        if self.adapters:
            said.append(f"{self.adapters} adapters, {self.steps} steps of {self.seconds_of_step:.2f} s in all")
        return [*said, f"about {self.seconds / 60:.1f} minutes for the predictions"]


def estimate(predictor: Predictor, tasks: Sequence[Task]) -> Cost:
    """Count the work of unfinished tasks and measure one pass of each size and one step, on images of noise."""
    predictor.forward(predictor.noise(2))  # warm-up: keeps loading and first allocations out of the measurement
    passes = Counter(SAMPLE if variant(task.variant).encode_all else task.views for task in tasks)
    seconds = {views: _seconds_of_pass(predictor, views) for views in passes}
    jobs = [job for job in predictor.adapter_jobs(tasks) if not job.is_finished(predictor.setup.out)]
    steps, seconds_of_step = 0, 0.0
    if jobs:
        steps = sum(job.steps([SAMPLE * 2] * len(job.scenes)) for job in jobs)
        recipe = jobs[0].recipe.changed(steps=MEASURED_STEPS)
        noise = predictor.noise(max(SAMPLE, recipe.views))
        scene = SceneImages(name="noise", count=len(noise), load=lambda frames: noise[list(frames)])
        seconds_of_step = _seconds_of_step(predictor, scene, recipe)
    return Cost(
        passes=passes, seconds_of_pass=seconds, adapters=len(jobs), steps=steps, seconds_of_step=seconds_of_step
    )


@dataclass(frozen=True, kw_only=True)
class ScoringCost:
    """What the second stage will take, from one small fusion per dataset."""

    dataset: str
    frames: int
    """Depth maps to be fused."""
    surfaces: int
    seconds_of_frame: float
    seconds_of_surface: float
    """Meshing, sampling, averaging and both nearest-neighbour searches."""

    @property
    def seconds(self) -> float:
        """Predicted duration."""
        return self.frames * self.seconds_of_frame + self.surfaces * self.seconds_of_surface

    def line(self) -> str:
        """The estimate as one line of text."""
        return (
            f"{self.dataset}: {self.surfaces} surfaces of {self.frames} frames to score, {self.seconds_of_frame:.2f} s "
            f"a frame and {self.seconds_of_surface:.1f} s a surface: about {self.seconds / 60:.1f} minutes"
        )


def estimate_scoring(data: Path, tasks: Sequence[Task], *, device: torch.device | str = "cpu") -> list[ScoringCost]:
    """Measure fusion and scoring of a slanted wall at each dataset's sizes; a real scene has more surface than that.

    A dataset whose first scene cannot be read is left out; the run itself reports the reason.
    """
    costs = []
    for dataset in dict.fromkeys(task.dataset for task in tasks):
        own = [task for task in tasks if task.dataset == dataset and variant(task.variant).measures == "prediction"]
        if not own:
            continue
        try:
            scene = load_scene(data, dataset, own[0].scene)
        except DAMAGED:
            continue
        fixed = constants(dataset)
        frame, surface = _seconds_of_fusion(fixed, fixed.fusion_hw or scene.photos[0].size_hw, device)
        costs.append(
            ScoringCost(
                dataset=dataset, frames=sum(task.views for task in own), surfaces=len(own), seconds_of_frame=frame,
                seconds_of_surface=surface,
            )
        )  # fmt: skip
    return costs


def _seconds_of_fusion(
    fixed: DatasetConstants, size_hw: tuple[int, int], device: torch.device | str
) -> tuple[float, float]:
    depth_z = torch.linspace(*WALL_DEPTH_M, size_hw[1]).expand(size_hw)
    K = K_from_fov(torch.tensor(0.8), torch.tensor(1.0), size_hw)
    volume = TsdfVolume(voxel=fixed.voxel, truncation=fixed.truncation, device=device)
    started = time.perf_counter()
    for _ in range(MEASURED_FRAMES):
        volume.integrate(depth_z, K, torch.eye(4), depth_limit=fixed.depth_limit)
    fused = time.perf_counter()
    points = sample_surface(volume.extract_mesh(), fixed.samples, seed=0)
    ReferenceCloud(points, down_sample=fixed.down_sample).score(points, threshold=fixed.threshold)
    return (fused - started) / MEASURED_FRAMES, time.perf_counter() - fused


def _seconds_of_pass(predictor: Predictor, views: int) -> float:
    images = predictor.noise(views)
    started = time.perf_counter()
    predictor.forward(images)
    return time.perf_counter() - started


def _seconds_of_step(predictor: Predictor, scene: SceneImages, recipe: Recipe) -> float:
    """Mean duration of the steps after the first, which also includes one-time work."""
    times: list[float] = []
    result = adapt(
        predictor.model, [scene], recipe, seed=predictor.setup.adapt_seed, compute=predictor.chosen,
        on_step=lambda _: times.append(time.perf_counter()),
    )  # fmt: skip
    result.adapter.detach()
    return (times[-1] - times[0]) / (len(times) - 1)
