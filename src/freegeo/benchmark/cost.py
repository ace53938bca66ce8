"""What a run will cost, said before it starts."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from freegeo.adaptation.images import SceneImages
from freegeo.adaptation.recipe import Recipe
from freegeo.adaptation.trainer import adapt
from freegeo.benchmark.predict import Predictor
from freegeo.benchmark.tasks import SAMPLE, Task
from freegeo.benchmark.variants import variant

MEASURED_STEPS = 3


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
        """Say it to a person."""
        said = [
            f"{count} forward passes of {views} views, {self.seconds_of_pass[views]:.2f} s each"
            for views, count in sorted(self.passes.items())
        ]
        if self.adapters:
            said.append(f"{self.adapters} adapters, {self.steps} steps of {self.seconds_of_step:.2f} s in all")
        return [*said, f"about {self.seconds / 60:.1f} minutes for the predictions"]


def estimate(predictor: Predictor, tasks: Sequence[Task]) -> Cost:
    """Count the work of unfinished tasks and measure one pass of each size and one step, on images of noise."""
    predictor.forward(predictor.noise(2))  # what is loaded and allocated once shall not count
    passes = Counter(SAMPLE if variant(task.variant).encode_all else task.views for task in tasks)
    seconds = {views: _seconds_of_pass(predictor, views) for views in passes}
    jobs = [job for job in predictor.adapter_jobs(tasks) if not job.is_finished(predictor.setup.out)]
    steps, seconds_of_step = 0, 0.0
    if jobs:
        steps = sum(job.steps([SAMPLE * 2] * len(job.scenes)) for job in jobs)
        noise = predictor.noise(SAMPLE)
        scene = SceneImages(name="noise", count=SAMPLE, load=lambda frames: noise[list(frames)], in_memory=True)
        seconds_of_step = _seconds_of_step(predictor, scene, jobs[0].recipe.changed(steps=MEASURED_STEPS))
    return Cost(
        passes=passes, seconds_of_pass=seconds, adapters=len(jobs), steps=steps, seconds_of_step=seconds_of_step
    )


def _seconds_of_pass(predictor: Predictor, views: int) -> float:
    images = predictor.noise(views)
    started = time.perf_counter()
    predictor.forward(images)
    return time.perf_counter() - started


def _seconds_of_step(predictor: Predictor, scene: SceneImages, recipe: Recipe) -> float:
    """Mean duration of the steps after the first, which also pays for what is done once."""
    times: list[float] = []
    result = adapt(
        predictor.model, [scene], recipe, engine=predictor.engine, on_step=lambda _: times.append(time.perf_counter())
    )
    result.adapter.detach()
    return (times[-1] - times[0]) / (len(times) - 1)
