"""Predict the memory of a run before it starts, and choose the fastest plan that fits.

The size of samples follows from their shapes, what a pass occupies from those of the model (`models.memory`). Bytes
throughout.
"""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path

import torch

from freegeo.adaptation.adapter import count_trainable
from freegeo.adaptation.losses.numerics import CPU_BLOCK_ELEMENTS, DEVICE_BLOCK_ELEMENTS
from freegeo.adaptation.recipe import SEED, Recipe
from freegeo.adaptation.samples import Place, SampleKey, SceneImages, distinct, sample_key, view_keys
from freegeo.adaptation.views import ViewSet, Visit, schedule
from freegeo.errors import UserError
from freegeo.host import gigabytes
from freegeo.models.api import ReconstructionModel
from freegeo.models.memory import WIDE, ImageSize, Parts, available, shape_of
from freegeo.models.precision import Compute

logger = logging.getLogger(__name__)

TRIPLET_ARRAYS, EDGE_ARRAYS = 13, 3
"""Float64 arrays that exist at the same time while the angle terms are computed: with one number per triplet, and with
one vector per reference and anchor."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """How a run uses memory; nothing here changes its result."""

    place: Place = "device"
    """Where samples are kept between visits."""
    checkpointing: bool = False
    """Whether the student's activations are computed again in the backward pass instead of kept."""
    parts: Parts = ()
    """What is on the device at the peak: name and bytes of each part."""
    kept_bytes: int = 0
    """Most bytes of samples kept at one time, wherever they are kept."""

    @property
    def peak_bytes(self) -> int:
        """Predicted peak of the device's memory (on the CPU: of the process, less interpreter and libraries)."""
        return sum(size for _, size in self.parts)

    def summary(self) -> str:
        """Return one line for the user: how much memory it takes, and what is done where that would be too much."""
        how = []
        if self.place == "disk":
            how.append(f"{gigabytes(self.kept_bytes)} of teacher features on disk")
        if self.checkpointing:
            how.append("activations computed twice")
        slower = f" (to fit: {' and '.join(how)}, which is slower)" if how else ""
        return f"adaptation needs about {gigabytes(self.peak_bytes)} of memory{slower}"


def plan_adaptation(
    model: ReconstructionModel,
    scenes: Sequence[SceneImages],
    recipe: Recipe,
    steps: Sequence[Sequence[Visit]],
    *,
    compute: Compute,
    budget: int | None = None,
    folder: Path | None = None,
) -> Plan:
    """Return the first plan that fits: samples on the device or on disk, then both again with checkpointing.

    The first image of every scene is loaded for its size. `budget` (bytes) None: what is free now; `folder` is where
    files of samples would be written. The model may be on the meta device. UserError when nothing fits.
    """
    budget = available(compute.device, model) if budget is None else budget
    job = Footprint(model, scenes, recipe, steps, compute)
    place = Path(tempfile.gettempdir()) if folder is None else folder.absolute()
    free_disk = shutil.disk_usage(next(parent for parent in (place, *place.parents) if parent.exists())).free
    for checkpointing, where in product((False, True), ("device", "disk")):
        plan = job.plan(where, checkpointing)
        if plan.peak_bytes <= budget and (plan.place != "disk" or plan.kept_bytes < free_disk):
            logger.info("%s; %s are free", plan.summary(), gigabytes(budget))
            logger.debug("at the peak: %s", ", ".join(f"{name} {gigabytes(size)}" for name, size in plan.parts))
            return plan
    raise _too_large(plan, model, budget)


def require_adaptation_fits(
    model: ReconstructionModel, views: int, image_hw: ImageSize, recipe: Recipe, *, compute: Compute
) -> None:
    """Raise UserError where adapting to `views` images of one scene does not fit into the memory that is free now.

    For the time before a run, when an earlier result is still there; `plan_adaptation` looks again, at the disk too.
    The model may be on the meta device.
    """
    budget = available(compute.device, model)
    job = Footprint.of_scene(model, views, image_hw, recipe, compute.preferring(recipe.precision))
    plan = job.plan("disk", checkpointing=True)
    if plan.peak_bytes > budget:
        raise _too_large(plan, model, budget)


def _too_large(plan: Plan, model: ReconstructionModel, budget: int) -> UserError:
    return UserError(
        f"adapting {model.spec.name} needs {gigabytes(plan.peak_bytes)} even with activation checkpointing (and "
        f"{gigabytes(plan.kept_bytes)} of disk), and {gigabytes(budget)} are free. Use smaller images "
        "(--process-res), fewer --views, --precision bf16 or a smaller model."
    )


class Footprint:
    """The numbers of a run that its memory depends on."""

    def __init__(
        self,
        model: ReconstructionModel,
        scenes: Sequence[SceneImages],
        recipe: Recipe,
        steps: Sequence[Sequence[Visit]],
        compute: Compute,
    ):
        part = model.adaptable()
        self.recipe, self.compute, self.shape = recipe, compute, shape_of(model)
        self.layers, self.trained = len(part.spec.loss_layers), count_trainable(model, recipe.rank)
        patch = part.spec.patch_size
        sizes = [scene.load((0,)).shape[-2:] for scene in scenes]
        self.tokens = [(h // patch) * (w // patch) + self.shape.special for h, w in sizes]
        self.visits = [visit.view_set for visits in steps for visit in visits]
        # The largest view set decides; sets differ in the number of views and in the size of their images.
        self.largest = max(self.visits, key=lambda view_set: len(view_set.frames) * self.tokens[view_set.scene])

    @classmethod
    def of_scene(
        cls, model: ReconstructionModel, views: int, image_hw: ImageSize, recipe: Recipe, compute: Compute
    ) -> Footprint:
        """Return those of a run that adapts to one scene of `views` images."""
        images = SceneImages(name="photos", count=views, load=lambda frames: torch.empty(len(frames), 3, *image_hw))
        return cls(model, [images], recipe, schedule([views], recipe, SEED), compute)

    def plan(self, place: Place, checkpointing: bool) -> Plan:
        """Predict what is on the device at the peak: in the teacher's pass, the student's or that of all views."""
        kept = self._kept_peak
        sample = self._sample(self.largest)
        teacher, learning = self._teacher(sample), self._learning(checkpointing)
        resident = [("weights", self.shape.parameters * WIDE), ("adapter and optimiser", 4 * WIDE * self.trained)]
        waiting = kept if place == "device" else sample
        if place == "device" or self.compute.device.type == "cpu":
            resident.append(("tokens of shared images", self._shared_tokens()))
        # `teacher` counts the sample that its pass makes, which is therefore not counted among those kept.
        if teacher - sample > sum(size for _, size in learning):
            parts = [*resident, ("teacher features", max(0, waiting - sample)), ("teacher's pass", teacher)]
        else:
            parts = [*resident, ("teacher features", waiting), *learning]
        return Plan(place=place, checkpointing=checkpointing, parts=tuple(parts), kept_bytes=kept)

    def _teacher(self, sample: int) -> int:
        tokens, shape = self._count(self.largest.frames), self.shape
        passing = tokens * shape.passing(self.compute, with_adapter=False) + shape.features(tokens, self.layers)
        return passing + shape.token_bytes(2 * tokens) + shape.half_copies(self.compute) + sample

    def _learning(self, checkpointing: bool) -> list[tuple[str, int]]:
        """Return the parts of the larger of the two passes with gradients: the student's, and that of all views."""
        kept = self._count(self.largest.kept)
        options = [self._pass(kept, self._losses(kept), checkpointing)]
        if self.recipe.sees_all:
            every = self._count(self.largest.frames)
            options.append(self._pass(every, WIDE * every * self.shape.channels, checkpointing))
            # The student's own tokens and targets are copies of a part of the sample.
            options[0].append(
                ("inputs of a step", self._sample(self.largest) * len(self.largest.kept) // len(self.largest.frames))
            )
        return max(options, key=lambda parts: sum(size for _, size in parts))

    def _pass(self, tokens: int, losses: int, checkpointing: bool) -> list[tuple[str, int]]:
        """Return what a pass over `tokens` tokens keeps for its backward pass, and the peak on top of that."""
        shape, compute = self.shape, self.compute
        saved = shape.saved_per_token(compute, rank=self.recipe.rank, dropout=self.recipe.dropout > 0)
        left = tokens * shape.blocks * (WIDE * shape.width if checkpointing else saved)
        left += shape.features(tokens, self.layers) + (0 if checkpointing else shape.half_copies(compute))
        backward = WIDE * self.layers * tokens * shape.channels + tokens * shape.passing(compute, with_adapter=True)
        backward += tokens * saved if checkpointing else 0
        inputs = shape.token_bytes(tokens)
        on_top = ("losses", losses) if losses >= backward else ("backward pass", backward)
        return [("student's pass", left + inputs), on_top]

    def _losses(self, tokens: int) -> int:
        """Bytes of the gradients of all features, four blocks of the intra sweep, and the arrays of the angle terms."""
        loss = self.recipe.loss
        per_view, others = self.tokens[self.largest.scene], len(self.largest.kept) - 1
        queries = min(loss.num_query, per_view) * (others if loss.queries == "per_view" else 1)
        edges = min(loss.num_reference, per_view) * loss.num_anchors
        triplets = edges * min(queries, others * per_view)
        level = WIDE * tokens * self.shape.channels
        on_cpu = self.compute.device.type == "cpu"
        block = WIDE * (CPU_BLOCK_ELEMENTS if on_cpu else DEVICE_BLOCK_ELEMENTS)
        angles = 2 * WIDE * (TRIPLET_ARRAYS * triplets + EDGE_ARRAYS * edges * self.shape.channels)
        return level * self.layers + 4 * min(level, block) + angles

    def _shared_tokens(self) -> int:
        """Tokens of the images that several view sets use, which wait for the last of them."""
        sets = distinct(self.visits, self.recipe)
        uses = Counter(key for view_set in sets for key in view_keys(view_set, self.recipe))
        return sum(self.shape.token_bytes(self.tokens[key[0]]) for key, count in uses.items() if count > 1)

    @cached_property
    def _kept_peak(self) -> int:
        """Most bytes of samples kept at one time: each is kept from its first visit to its last."""
        keys = [sample_key(view_set, self.recipe) for view_set in self.visits]
        last = {key: number for number, key in enumerate(keys)}
        kept: dict[SampleKey, int] = {}
        peak = 0
        for number, (key, view_set) in enumerate(zip(keys, self.visits, strict=True)):
            if number < last[key]:
                kept[key] = self._sample(view_set)
            else:
                kept.pop(key, None)
            peak = max(peak, sum(kept.values()))
        return peak

    def _sample(self, view_set: ViewSet) -> int:
        """Bytes of the sample of a view set (a model that adds its special tokens later has a few tokens less)."""
        per_view, held_out = self.tokens[view_set.scene], len(view_set.frames) - len(view_set.kept)
        read = len(view_set.frames if self.recipe.sees_all else view_set.kept)
        anchors = held_out * (per_view - (0 if self.recipe.loss.cross_tokens == "all" else self.shape.special))
        features = WIDE * self.shape.channels * (self.layers * read * per_view + anchors)
        return self.shape.token_bytes(read * per_view) + features

    def _count(self, views: Sequence[int]) -> int:
        return len(views) * self.tokens[self.largest.scene]
