"""How much memory a run needs, before it starts, and the cheapest way to make it fit."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch

from freegeo.adaptation import footprint
from freegeo.adaptation.adapter import count_trainable
from freegeo.adaptation.bank import accesses, set_key, view_key, views_per_chunk
from freegeo.adaptation.cache import Place
from freegeo.adaptation.engine import Engine
from freegeo.adaptation.recipe import Recipe
from freegeo.adaptation.views import ViewSet, schedule
from freegeo.errors import UserError
from freegeo.models.api import ReconstructionModel
from freegeo.models.precision import Precision

logger = logging.getLogger(__name__)

ImageSize = tuple[int, int]
BUSY_TOKENS = 8192
"""Student tokens that keep an accelerator busy; larger micro-batches would only cost memory."""
WIDEST_LEVELS = 4
"""Levels that the dense heads read."""


@dataclass(frozen=True, kw_only=True)
class AdaptationPlan:
    """How a run will be computed, and the memory that this takes, in bytes."""

    engine: Engine
    parts: tuple[tuple[str, int], ...]
    """What is resident on the device at its fullest moment; host and disk caches are not in it."""
    cache_bytes: int
    """Tokens and teacher targets, wherever they wait."""
    budget: int | None

    @property
    def peak_bytes(self) -> int:
        """Predicted peak of the device's memory (on the CPU: of the process, less interpreter and libraries)."""
        return sum(size for _, size in self.parts)

    def summary(self) -> str:
        """Return one line for the user."""
        engine = self.engine
        how = [f"micro-batches of {engine.micro_batch}"]
        if engine.recompute_blocks:
            how.append("activation checkpointing")
        if engine.half_weights:
            how.append(f"weights in {engine.precision}")
        where = {"device": "on the device", "host": "in host memory", "disk": "on disk"}[engine.cache_place]
        how.append(f"cache of {self.cache_bytes / 1e9:.2f} GB {where}")
        room = "" if self.budget is None else f" of {self.budget / 1e9:.1f} GB"
        return f"adaptation needs {footprint.describe(self.parts)}{room}; {', '.join(how)}"


@dataclass(frozen=True, kw_only=True)
class ReconstructionPlan:
    """The memory that reconstructing some views takes, in bytes."""

    parts: tuple[tuple[str, int], ...]
    max_views: int
    """The most views of this size that fit."""

    @property
    def peak_bytes(self) -> int:
        """Predicted peak of the device's memory."""
        return sum(size for _, size in self.parts)

    def summary(self) -> str:
        """Return one line for the user."""
        return f"reconstruction needs {footprint.describe(self.parts)}; up to {self.max_views} views would fit"


def plan_adaptation(
    model: ReconstructionModel,
    scenes: Sequence[tuple[int, ImageSize]],
    recipe: Recipe,
    *,
    seed: int,
    engine: Engine,
    budget: int | None = None,
) -> AdaptationPlan:
    """Predict the memory of a run exactly as `engine` asks for it.

    scenes: number of images and their (height, width) per scene; the model may be on the meta device. `budget` (bytes)
    is only noted.
    """
    job = _Job(model, scenes, recipe, seed)
    return AdaptationPlan(
        engine=engine, parts=tuple(job.parts(engine)), cache_bytes=sum(job.cache(engine)), budget=budget
    )


def choose_adaptation(
    model: ReconstructionModel,
    scenes: Sequence[tuple[int, ImageSize]],
    recipe: Recipe,
    *,
    seed: int,
    engine: Engine,
    budget: int | None = None,
    host_budget: int | None = None,
) -> AdaptationPlan:
    """Choose cache place, micro-batch and activation checkpointing so that a run fits, the fastest way first.

    `engine` gives device, precision and the two halves; budgets are bytes, None: what is free now. The plan is logged.
    UserError when nothing fits.
    """
    budget = footprint.available(engine.device) if budget is None else budget
    host_budget = footprint.host_available() // 2 if host_budget is None else host_budget
    job = _Job(model, scenes, recipe, seed)
    smallest = None
    for candidate in _candidates(engine):
        plan = AdaptationPlan(
            engine=candidate, parts=tuple(job.parts(candidate)), cache_bytes=sum(job.cache(candidate)), budget=budget
        )
        smallest = plan
        on_host = plan.cache_bytes if candidate.cache_place == "host" else 0
        if plan.peak_bytes <= budget and on_host <= host_budget:
            plan = _widened(job, plan, recipe, budget)
            logger.info("%s", plan.summary())
            return plan
    assert smallest is not None
    raise UserError(
        f"adapting {model.spec.name} needs {smallest.peak_bytes / 1e9:.1f} GB even with activation checkpointing, and "
        f"{budget / 1e9:.1f} GB are free. Use smaller images, fewer --views, --precision bf16 or a smaller model."
    )


def _candidates(engine: Engine) -> Iterator[Engine]:
    """Yield engines from the fastest to the smallest: moving the cache costs less than computing blocks again."""
    places: tuple[Place, ...] = ("device", "disk") if engine.device.type == "cpu" else ("device", "host", "disk")
    for recompute in (False, True):
        for place in places:
            yield replace(engine, cache_place=place, micro_batch=1, recompute_blocks=recompute)


def _widened(job: _Job, plan: AdaptationPlan, recipe: Recipe, budget: int) -> AdaptationPlan:
    """Raise the micro-batch while it fits and while an accelerator has room for it; the CPU gains nothing by it."""
    if plan.engine.device.type == "cpu" or recipe.dropout > 0:
        return plan
    while plan.engine.micro_batch < recipe.batch:
        wider = replace(plan.engine, micro_batch=plan.engine.micro_batch + 1)
        parts = tuple(job.parts(wider))
        if job.student_tokens(wider) > BUSY_TOKENS or sum(size for _, size in parts) > budget:
            break
        plan = replace(plan, engine=wider, parts=parts)
    return plan


class _Job:
    """What a run computes, as far as memory is concerned."""

    def __init__(self, model: ReconstructionModel, scenes: Sequence[tuple[int, ImageSize]], recipe: Recipe, seed: int):
        self.recipe, self.shape = recipe, footprint.shape_of(model)
        self.layers = len(model.adaptable().spec.loss_layers)
        self.trained = count_trainable(model, recipe.rank)
        patch = model.adaptable().spec.patch_size
        self.tokens = [(h // patch) * (w // patch) + self.shape.special for _, (h, w) in scenes]
        self.steps = schedule([count for count, _ in scenes], recipe, seed)
        self.sets = list(dict.fromkeys(visit.view_set for visits in self.steps for visit in visits))
        self.teacher_tokens = max(len(s.frames) * self.tokens[s.scene] for s in self.sets)

    def student_tokens(self, engine: Engine) -> int:
        """Tokens of the largest micro-batch."""
        return max(len(s.kept) * self.tokens[s.scene] for s in self.sets) * engine.micro_batch

    def parts(self, engine: Engine) -> Iterator[tuple[str, int]]:
        """Yield what is on the device when it is fullest: in the teacher's pass or in one with gradients."""
        shape, precision = self.shape, engine.precision
        yield "weights", footprint.weights(shape, half=engine.half_weights)
        yield "adapter and optimiser", footprint.trained(self.trained)
        prefix, targets = self.cache(engine) if engine.cache_place == "device" else (0, 0)
        targets_now = max(self._targets(s, visits=1) for s in self.sets)
        teacher = footprint.teacher(
            shape, precision, tokens=self.teacher_tokens, layers=self.layers, stored_half=engine.half_weights
        )
        teacher += footprint.token_bytes(shape, 2 * self.teacher_tokens) + targets_now
        learning = self._student(engine, 0 if targets and engine.micro_batch == 1 else targets_now)
        if self.recipe.hold:
            learning = max(learning, self._hold(engine), key=lambda parts: sum(size for _, size in parts))
        yield "tokens of images", prefix
        # While the teacher runs for the last time, the targets that it makes are still missing.
        if teacher - targets_now > sum(size for _, size in learning):
            yield "teacher targets", max(0, targets - targets_now)
            yield "teacher's pass", teacher
            return
        yield "teacher targets", targets
        yield from learning

    def _student(self, engine: Engine, targets: int) -> list[tuple[str, int]]:
        """Return what the student's pass over a micro-batch takes, with `targets` bytes for each of its view sets."""
        tokens = self.student_tokens(engine)
        passed, backward = self._gradients(engine, tokens)
        losses = footprint.losses(
            self.shape, tokens=tokens, layers=self.layers, triplets=self._triplets(), batch=engine.micro_batch,
            device=engine.device,
        )  # fmt: skip
        return [
            ("student's pass", passed),
            ("losses", losses) if losses > backward else ("backward pass", backward),
            ("inputs of a step", footprint.token_bytes(self.shape, tokens) + targets * engine.micro_batch),
        ]

    def _hold(self, engine: Engine) -> list[tuple[str, int]]:
        """Return what the pass over all views of a set takes; their frozen features are gone before it goes back."""
        tokens = self.teacher_tokens
        passed, backward = self._gradients(engine, tokens)
        frozen = footprint.features(self.shape, tokens, self.layers)
        return [
            ("pass over all views", passed),
            ("frozen features", frozen) if frozen > backward else ("backward pass", backward),
            ("inputs of a step", footprint.token_bytes(self.shape, tokens)),
        ]

    def _gradients(self, engine: Engine, tokens: int) -> tuple[int, int]:
        """Return what a pass with gradients leaves, and what its backward pass adds."""
        return footprint.student(
            self.shape, engine.precision, tokens=tokens, layers=self.layers, rank=self.recipe.rank,
            dropout=self.recipe.dropout > 0, recompute=engine.recompute_blocks, stored_half=engine.half_weights,
            device=engine.device,
        )  # fmt: skip

    def cache(self, engine: Engine) -> tuple[int, int]:
        """Bytes of the tokens and of the targets that are kept, each at its fullest moment."""
        scale = 2 if engine.half_cache else 1
        prefix = self._prefix_peak(engine) if engine.share_prefix else 0
        return prefix // scale, self._targets_peak() // scale if engine.cache_teacher else 0

    def _prefix_peak(self, engine: Engine) -> int:
        """Follow the bank through the run: a view stays from its first use to its last."""
        planned = list(accesses(self.steps, self.recipe, teacher_once=engine.cache_teacher))
        keys = [[view_key(s, p, self.recipe) for p in set(positions)] for s, positions in planned]
        left = Counter(key for part in keys for key in set(part))
        live: set = set()
        size = peak = 0
        for part in keys:
            for key in set(part):
                per_view = footprint.token_bytes(self.shape, self.tokens[key[0]])
                if key not in live and left[key] > 1:
                    live.add(key)
                    size += per_view
                left[key] -= 1
                if not left[key] and key in live:
                    peak = max(peak, size)
                    live.discard(key)
                    size -= per_view
            peak = max(peak, size)
        return peak

    def _targets_peak(self) -> int:
        """Follow the teacher through the run: targets stay from a view set's first visit to its last."""
        visits = [visit.view_set for visits in self.steps for visit in visits]
        left = Counter(set_key(view_set, self.recipe) for view_set in visits)
        total = dict(left)
        size = peak = 0
        for view_set in visits:
            key = set_key(view_set, self.recipe)
            bytes_ = self._targets(view_set, visits=total[key])
            size += bytes_ if left[key] == total[key] else 0
            peak = max(peak, size)
            left[key] -= 1
            size -= bytes_ if not left[key] else 0
        return peak

    def _targets(self, view_set: ViewSet, *, visits: int) -> int:
        loss, tokens = self.recipe.loss, self.tokens[view_set.scene]
        references = min(loss.num_reference, tokens)
        anchors = references * loss.num_anchors * (2 if loss.separate_draws else 1) * visits
        return footprint.target_bytes(
            self.shape, kept_tokens=len(view_set.kept) * tokens, layers=self.layers,
            anchors=min(anchors, len(view_set.frames) * tokens),
        )  # fmt: skip

    def _triplets(self) -> int:
        loss = self.recipe.loss
        sizes = []
        for view_set in self.sets:
            tokens, others = self.tokens[view_set.scene], len(view_set.kept) - 1
            queries = min(loss.num_query, tokens) * others if loss.queries == "per_view" else loss.num_query
            sizes.append(min(loss.num_reference, tokens) * loss.num_anchors * min(queries, others * tokens))
        return max(sizes)


def plan_reconstruction(
    model: ReconstructionModel,
    views: int,
    image_hw: ImageSize,
    *,
    device: torch.device,
    precision: Precision,
    half_weights: bool = False,
    budget: int | None = None,
) -> ReconstructionPlan:
    """Predict the memory of reconstructing `views` images of (height, width) together.

    Images are embedded and dense maps decoded a few views at a time; tokens, features and results grow with the number
    of views. `budget` (bytes) None: what is free now, and what the model occupies already. UserError when the views do
    not fit; it says how many would. The model may be on the meta device.
    """
    shape = footprint.shape_of(model)
    resident = footprint.weights(shape, half=half_weights)
    if budget is None:
        placed = next(iter(model.parameters())).device.type == device.type
        budget = footprint.available(device) + (resident if placed else 0)
    spec = model.adaptable().spec
    per_view = (image_hw[0] // spec.patch_size) * (image_hw[1] // spec.patch_size) + shape.special
    copies = footprint.half_copies(shape, precision, stored_half=half_weights)

    def parts(count: int) -> tuple[tuple[str, int], ...]:
        aggregating = footprint.token_bytes(shape, 2 * count * per_view) + copies
        aggregating += footprint.features(shape, count * per_view, WIDEST_LEVELS)
        aggregating += count * per_view * footprint.passing(shape, precision, with_adapter=False)
        kept = footprint.features(shape, count * per_view, WIDEST_LEVELS) + count * _map_bytes(image_hw)
        decoding = kept + min(count, 8) * _head_bytes(model, image_hw)
        embedding = footprint.token_bytes(shape, count * per_view) + copies
        embedding += (
            min(count, views_per_chunk(device)) * per_view * footprint.passing(shape, precision, with_adapter=False)
        )
        stages = {"aggregating": aggregating, "decoding": decoding, "embedding": embedding}
        widest = max(stages, key=lambda name: stages[name])
        return ("weights", resident), ("images", 3 * 4 * count * math.prod(image_hw)), (widest, stages[widest])

    # From 8 views on everything grows by the same amount per view.
    many, more = (sum(size for _, size in parts(n)) for n in (64, 128))
    slope = (more - many) / 64
    fitting = int(64 + (budget - many) // slope) if budget > many else _fitting(parts, budget)
    plan = ReconstructionPlan(parts=parts(views), max_views=max(0, fitting))
    if plan.peak_bytes > budget:
        raise UserError(
            f"reconstructing {views} images of {image_hw[1]} x {image_hw[0]} pixels with {model.spec.name} needs about "
            f"{plan.peak_bytes / 1e9:.1f} GB and {budget / 1e9:.1f} GB are free: {_advice(plan.max_views)}."
        )
    return plan


def _fitting(parts, budget: int) -> int:
    return max((n for n in range(1, 65) if sum(size for _, size in parts(n)) <= budget), default=0)


def _advice(max_views: int) -> str:
    if max_views < 1:
        return "use a smaller model or another device"
    return f"use at most {max_views} views (--max-views {max_views}) or smaller images"


def _map_bytes(image_hw: ImageSize) -> int:
    """Depth and confidence of a view."""
    return 2 * footprint.WIDE * math.prod(image_hw)


def _head_bytes(model: ReconstructionModel, image_hw: ImageSize) -> int:
    """Widest moment of the dense head per view: its last maps at image size, and the fused pyramid at 8 per patch."""
    width = getattr(getattr(model.adaptable(), "config", None), "head_features", 256)
    patch = model.adaptable().spec.patch_size
    fused = (8 / patch) ** 2 * 3 * width
    return int(footprint.WIDE * math.prod(image_hw) * (2 * width // 2 + 64 + fused))
