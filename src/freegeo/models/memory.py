"""The memory of a model: its shape, what a pass over its layers occupies, and what a reconstruction needs.

Read off the shapes of the layers that an adapter may sit on, so also for a plug-in whose blocks differ from ours
(docs/method.md, "Memory of a step"). `adaptation.memory` plans adaptation with it. Bytes throughout.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import nn

from freegeo.errors import UserError
from freegeo.host import gigabytes, host_available
from freegeo.models.api import ReconstructionModel, views_per_chunk
from freegeo.models.precision import Compute

ImageSize = tuple[int, int]
Parts = tuple[tuple[str, int], ...]
"""What is on a device at the same time: name and bytes of each part."""
WIDE = 4
"""Bytes of a float32: the residual stream, norms, features, losses, trained parameters."""
DPT_LEVELS = 4
"""Levels that a DPT head reads."""


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
        widest = max(stages.items(), key=lambda stage: stage[1])
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
