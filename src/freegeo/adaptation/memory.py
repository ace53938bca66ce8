"""Predict the memory of a run before it starts, and choose the fastest plan that fits.

The size of samples follows from their shapes. What a pass occupies is estimated from the shapes of the adapted linear
layers (docs/method.md, "Memory of a step"), also for a plug-in whose blocks differ from ours. Bytes throughout.
"""

from __future__ import annotations

import logging
import math
import shutil
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path

import torch
from torch import nn

from freegeo.adaptation.adapter import count_trainable
from freegeo.adaptation.losses.numerics import CPU_BLOCK_ELEMENTS, DEVICE_BLOCK_ELEMENTS
from freegeo.adaptation.recipe import SEED, Recipe
from freegeo.adaptation.samples import Place, SceneImages, distinct, sample_key, view_keys
from freegeo.adaptation.views import ViewSet, Visit, schedule
from freegeo.errors import UserError
from freegeo.host import gigabytes, host_available
from freegeo.models.api import ReconstructionModel, views_per_chunk
from freegeo.models.precision import Compute

logger = logging.getLogger(__name__)

ImageSize = tuple[int, int]
Parts = tuple[tuple[str, int], ...]
WIDE = 4
"""Bytes of a float32: the residual stream, norms, features, losses, trained parameters."""
TRIPLET_ARRAYS, EDGE_ARRAYS = 13, 3
"""Float64 arrays that exist at the same time while the angle terms are computed: with one number per triplet, and with
one vector per reference and anchor."""
DPT_LEVELS = 4
"""Levels that a DPT head reads."""


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
        return [("student's pass", left + inputs), max(("losses", losses), ("backward pass", backward), key=_size)]

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
        left = Counter(sample_key(view_set, self.recipe) for view_set in self.visits)
        kept: dict = {}
        size = peak = 0
        for view_set in self.visits:
            key = sample_key(view_set, self.recipe)
            left[key] -= 1
            if left[key] and key not in kept:
                kept[key] = self._sample(view_set)
                size += kept[key]
            elif not left[key]:
                size -= kept.pop(key, 0)
            peak = max(peak, size)
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


@dataclass(frozen=True, kw_only=True)
class Shape:
    """The sizes of a model that its memory depends on."""

    width: int
    blocks: int
    """Adapted blocks: attention and feed-forward."""
    hidden: int
    """Width between the two linears of the feed-forward layer."""
    gated: bool
    query_key_norm: bool
    """Whether queries and keys go through norms of their own."""
    parameters: int
    adapted_parameters: int
    """Parameters of the linears that an adapter sits on."""
    channels: int
    """Feature channels of the losses."""
    special: int
    feature_copies: int
    """Copies of the features that `aggregate` makes."""

    def saved_per_token(self, compute: Compute, *, rank: int, dropout: bool) -> int:
        """Bytes that one adapted block keeps per token from the forward to the backward pass."""
        e, d, h = narrow(compute), self.width, self.hidden
        heads = max(1, d // 64)
        norm_inputs = 2 * WIDE * d
        lora_inputs = e * (3 * d + h)
        attention = 6 * e * d
        feed_forward = 3 * e * h if self.gated else e * h
        statistics = WIDE * (4 + 5 * heads)
        # CUDA's autocast runs norms in float32 and keeps their inputs so; on the CPU they stay views of qkv.
        query_and_key = 2 * WIDE * d if self.query_key_norm and e < WIDE and compute.device.type == "cuda" else 0
        total = norm_inputs + lora_inputs + attention + query_and_key + feed_forward + statistics + 4 * rank * e
        # A dropout mask is one byte per element in CUDA's fused dropout and in ours on the CPU, elsewhere a float.
        return total + (3 * d + h) * ((WIDE if compute.device.type == "mps" else 1) if dropout else 0)

    def passing(self, compute: Compute, *, with_adapter: bool) -> int:
        """Peak bytes per token of the temporary tensors of one block."""
        e, d, h = narrow(compute), self.width, self.hidden
        inner = 4 * h if self.gated else 2 * h
        low_rank = WIDE * (2 * h if self.gated else h) if with_adapter and compute.precision != "fp32" else 0
        return 3 * WIDE * d + e * (d + inner) + low_rank

    def features(self, tokens: int, layers: int) -> int:
        """Bytes of the features of `layers` layers in `aggregate`: the joined halves, and copies of them."""
        return (1 + self.feature_copies) * WIDE * layers * tokens * self.channels

    def half_copies(self, compute: Compute) -> int:
        """Bytes of the half-precision copies of the adapted weights, which autocast makes for every pass."""
        return 0 if compute.precision == "fp32" else 2 * self.adapted_parameters

    def token_bytes(self, tokens: int) -> int:
        """Bytes of the tokens that `embed` passes to `aggregate`."""
        return WIDE * tokens * self.width


def shape_of(model: ReconstructionModel) -> Shape:
    """Read a model's shape off its adapter targets; the model may be on the meta device, and may carry an adapter.

    A model of single views has none; its shape is read off all its linears.
    """
    part = model.cross_view or model
    # The layers of an adapter that is on are linears, too.
    names = [name for name in part.adapter_targets() if ".lora_" not in name]
    linears = [_base(part.get_submodule(name)) for name in names]
    linears = linears or [module for module in part.modules() if isinstance(module, nn.Linear)]
    attention = [linear for linear in linears if linear.out_features == 3 * linear.in_features]
    # A third-party model may have no joint qkv layer; then the width is taken from its first layer.
    width = (attention or linears)[0].in_features
    contraction = [linear for linear in linears if linear.out_features == width and linear.in_features != width]
    expansion = [linear for linear in linears if linear.in_features == width and linear.out_features > width]
    hidden = contraction[0].in_features if contraction else width
    return Shape(
        width=width,
        blocks=max(1, len(attention)),
        hidden=hidden,
        gated=any(linear.out_features == 2 * hidden for linear in expansion),
        query_key_norm=any(
            name.endswith("q_norm") and not isinstance(module, nn.Identity) for name, module in part.named_modules()
        ),
        parameters=sum(p.numel() for name, p in model.named_parameters() if ".lora_" not in name),
        adapted_parameters=sum(linear.weight.numel() for linear in linears),
        channels=part.feature_channels or 2 * width,
        special=part.spec.special_tokens,
        feature_copies=part.feature_copies,
    )


def _base(module: nn.Module) -> nn.Linear:
    linear = getattr(module, "base_layer", module)
    assert isinstance(linear, nn.Linear)
    return linear


def narrow(compute: Compute) -> int:
    """Bytes of an element that matrix products read and write."""
    return WIDE if compute.precision == "fp32" else 2


def plan_reconstruction(
    model: ReconstructionModel, views: int, image_hw: ImageSize, *, compute: Compute, budget: int | None = None
) -> tuple[Parts, int]:
    """Return what is on the device while `views` images are reconstructed together, and how many views would fit.

    Images are embedded and dense maps decoded a few views at a time; tokens, features and results grow with the number
    of views. `budget` (bytes) None: what is free now, plus what the model already occupies. UserError when the views
    do not fit; it says how many would. The model may be on the meta device.
    """
    shape, spec = shape_of(model), model.spec
    resident = shape.parameters * WIDE
    budget = available(compute.device, model) if budget is None else budget
    pixels = math.prod(image_hw)
    per_view = (image_hw[0] // spec.patch_size) * (image_hw[1] // spec.patch_size) + shape.special
    maps = 2 * WIDE * pixels  # depth and confidence
    part = model.cross_view or model
    head_bytes = int(WIDE * pixels * (part.peak_channels or _dpt_channels(part)))
    passing, copies = shape.passing(compute, with_adapter=False), shape.half_copies(compute)

    def parts(count: int) -> Parts:
        tokens = count * per_view
        read = part.read_channels
        features = shape.features(tokens, DPT_LEVELS) if read is None else WIDE * tokens * read
        stages = {
            "aggregating": shape.token_bytes(2 * tokens) + copies + features + tokens * passing,
            "decoding": features + count * maps + min(count, 8) * head_bytes,
            "embedding": shape.token_bytes(tokens) + copies
            + min(count, views_per_chunk(compute.device)) * per_view * passing,
        }  # fmt: skip
        widest = max(stages.items(), key=_size)
        return ("weights", resident), ("images", 3 * WIDE * count * pixels), widest

    def total(count: int) -> int:
        return sum(size for _, size in parts(count))

    # From 8 views on everything grows by the same amount per view.
    slope = (total(128) - total(64)) / 64
    fitting = int(64 + (budget - total(64)) // slope) if budget > total(64) else 64
    fitting = next((count for count in range(fitting, 0, -1) if total(count) <= budget), 0)
    if total(views) > budget:
        advice = (
            f"use at most {fitting} views (--max-views {fitting}) or smaller images (--process-res)"
            if fitting
            else "use a smaller model or another device"
        )
        raise UserError(
            f"reconstructing {views} images of {image_hw[1]} x {image_hw[0]} pixels with {model.spec.name} needs about "
            f"{gigabytes(total(views))} and {gigabytes(budget)} are free: {advice}."
        )
    return parts(views), fitting


def _dpt_channels(model: ReconstructionModel) -> float:
    """Return how many numbers for each pixel of a view a DPT head holds at its widest moment.

    That is half of its channels and its last layers at image size, and three maps of all channels at 8 per patch.
    """
    head = getattr(getattr(model, "config", None), "head_features", 256)
    return head / 2 + 48 + 3 * head * (8 / model.spec.patch_size) ** 2


def available(device: torch.device, model: ReconstructionModel) -> int:
    """Bytes that a run may use on a device, those of a model that is already there included.

    8 % of a CUDA device and 20 % of main memory are left for what no plan counts.
    """
    if device.type == "cuda":
        # Blocks that PyTorch has reserved and does not use count as taken for the driver.
        reserved = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        free = int((torch.cuda.mem_get_info(device)[0] + reserved) * 0.92)
    else:
        free = int(host_available() * 0.8)
    weights = sum(p.nbytes for p in model.parameters() if p.device.type == device.type)
    return free + weights


def _size(part: tuple[str, int]) -> int:
    return part[1]
