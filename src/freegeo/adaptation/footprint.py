"""What a model's passes occupy, from the shapes of its linear layers (method's fact sheet, section 6.4).

Counted are the arrays that the transformer block of `models.transformer` keeps for its backward pass with an adapter on
its linears; a plug-in with other blocks gets the same estimate from the linears it names. Bytes throughout.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import nn

from freegeo.adaptation.losses.numerics import CPU_BLOCK_ELEMENTS, DEVICE_BLOCK_ELEMENTS
from freegeo.models.api import ReconstructionModel
from freegeo.models.precision import Precision, encoder

WIDE = 4
"""Bytes of a float32: the residual stream, norms, features, losses, trained parameters."""
LORA = ".lora_"
"""Part of the names of trained parameters."""
TRIPLET_ARRAYS = 13
"""Arrays with one number per triplet that live together while the angle terms are computed."""


def narrow(precision: Precision) -> int:
    """Bytes of an element that matrix products read and write."""
    return WIDE if precision == "fp32" else 2


@dataclass(frozen=True, kw_only=True)
class Shape:
    """The numbers of a model that memory depends on."""

    width: int
    heads: int
    """Upper bound, from heads at least 64 wide; only statistics of attention depend on it."""
    blocks: int
    """Adapted blocks: attention and feed-forward."""
    hidden: int
    """Width between the two linears of the feed-forward layer."""
    gated: bool
    linear_parameters: int
    """Parameters of the encoder's linears, which may be stored in half precision."""
    adapted_parameters: int
    """Parameters of the linears that an adapter sits on."""
    other_parameters: int
    channels: int
    """Feature channels of the losses."""
    special: int


def shape_of(model: ReconstructionModel) -> Shape:
    """Read a model's shape off its adapter targets; the model may be on the meta device, and may carry an adapter."""
    part = model.adaptable()
    linears = [_base(part.get_submodule(name)) for name in part.adapter_targets()]
    attention = [linear for linear in linears if linear.out_features == 3 * linear.in_features]
    # A third-party model may have no joint qkv layer; its first layer then stands for its width.
    width = (attention or linears)[0].in_features
    contraction = [linear for linear in linears if linear.out_features == width and linear.in_features != width]
    expansion = [linear for linear in linears if linear.in_features == width and linear.out_features > width]
    hidden = contraction[0].in_features if contraction else width
    every = {id(p): p.numel() for name, p in model.named_parameters() if LORA not in name}
    casts = {
        id(parameter): parameter.numel()
        for module in encoder(part).modules()
        if isinstance(module, nn.Linear)
        for parameter in module.parameters(recurse=False)
        if id(parameter) in every
    }
    return Shape(
        width=width,
        heads=max(1, width // 64),
        blocks=max(1, len(attention)),
        hidden=hidden,
        gated=any(linear.out_features == 2 * hidden for linear in expansion),
        linear_parameters=sum(casts.values()),
        adapted_parameters=sum(linear.weight.numel() for linear in linears),
        other_parameters=sum(every.values()) - sum(casts.values()),
        # Both families put the outputs of two blocks beside each other.
        channels=2 * width,
        special=part.spec.special_tokens,
    )


def _base(module: nn.Module) -> nn.Linear:
    linear = getattr(module, "base_layer", module)
    assert isinstance(linear, nn.Linear)
    return linear


def weights(shape: Shape, *, half: bool) -> int:
    """All weights of the model, heads included."""
    return shape.linear_parameters * (2 if half else WIDE) + shape.other_parameters * WIDE


def trained(parameters: int) -> int:
    """Trained parameters with their gradients and AdamW's two moments."""
    return 4 * WIDE * parameters


def saved_per_token(shape: Shape, precision: Precision, *, rank: int, dropout: bool, device: torch.device) -> int:
    """Bytes that one adapted block keeps per token from the forward to the backward pass."""
    e, d, h = narrow(precision), shape.width, shape.hidden
    norm_inputs = 2 * WIDE * d
    lora_inputs = e * (3 * d + h)
    attention = 6 * e * d
    feed_forward = 3 * e * h if shape.gated else e * h
    statistics = WIDE * (4 + 5 * shape.heads)
    total = norm_inputs + lora_inputs + attention + feed_forward + statistics + 4 * rank * e
    if dropout:
        # A mask is one byte per element in CUDA's fused dropout and in ours on the CPU, elsewhere a number.
        total += (3 * d + h) * (WIDE if device.type == "mps" else 1)
    return total


def half_copies(shape: Shape, precision: Precision, *, stored_half: bool) -> int:
    """Half copies of the adapted weights, kept for the backward pass unless the weights are stored that way."""
    return 0 if precision == "fp32" or stored_half else 2 * shape.adapted_parameters


def passing(shape: Shape, precision: Precision, *, with_adapter: bool) -> int:
    """Bytes per token that live while one block is computed and are gone afterwards, at the widest place."""
    e, d, h = narrow(precision), shape.width, shape.hidden
    inner = 4 * h if shape.gated else 2 * h
    low_rank = WIDE * (2 * h if shape.gated else h) if with_adapter and precision != "fp32" else 0
    return 3 * WIDE * d + e * (d + inner) + low_rank


def features(shape: Shape, tokens: int, layers: int) -> int:
    """Feature tensors of some layers while `aggregate` makes them: the joined halves, and the normalised copy."""
    return 2 * WIDE * layers * tokens * shape.channels


def student(
    shape: Shape, precision: Precision, *, tokens: int, layers: int, rank: int, dropout: bool, recompute: bool,
    stored_half: bool, device: torch.device,
) -> tuple[int, int]:  # fmt: skip
    """What the student's pass over a micro-batch of `tokens` tokens leaves, and what its backward pass adds to that."""
    saved = saved_per_token(shape, precision, rank=rank, dropout=dropout, device=device)
    per_block = WIDE * shape.width if recompute else saved
    left = tokens * shape.blocks * per_block + features(shape, tokens, layers)
    if not recompute:
        left += half_copies(shape, precision, stored_half=stored_half)
    gradients = WIDE * layers * tokens * shape.channels
    again = tokens * saved if recompute else 0
    return left, gradients + again + tokens * passing(shape, precision, with_adapter=True)


def teacher(shape: Shape, precision: Precision, *, tokens: int, layers: int, stored_half: bool) -> int:
    """Peak of the teacher's pass over one view set, its features included."""
    copies = half_copies(shape, precision, stored_half=stored_half)
    return tokens * passing(shape, precision, with_adapter=False) + features(shape, tokens, layers) + copies


def losses(shape: Shape, *, tokens: int, layers: int, triplets: int, batch: int, device: torch.device) -> int:
    """Gradients of all features, four blocks of the intra sweep, and the arrays over triplets."""
    level = WIDE * tokens * shape.channels
    block = WIDE * (CPU_BLOCK_ELEMENTS if device.type == "cpu" else DEVICE_BLOCK_ELEMENTS)
    return level * layers + 4 * min(level, block) + TRIPLET_ARRAYS * WIDE * triplets * batch


def token_bytes(shape: Shape, tokens: int) -> int:
    """One or several views' embedded tokens."""
    return WIDE * tokens * shape.width


def target_bytes(shape: Shape, *, kept_tokens: int, layers: int, anchors: int) -> int:
    """Teacher targets of one view set: kept views at the loss layers, and anchors (tokens in all)."""
    return WIDE * shape.channels * (kept_tokens * layers + anchors)


def available(device: torch.device) -> int:
    """Bytes that a run may use on a device, with some room left for what no plan sees."""
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0] * 0.92)
    return int(host_available() * 0.8)


def host_available() -> int:
    """Bytes of main memory that are free or can be freed."""
    import os
    from pathlib import Path

    lines = Path("/proc/meminfo").read_text().splitlines() if Path("/proc/meminfo").is_file() else []
    for line in lines:
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return 8 << 30


def describe(parts: Sequence[tuple[str, int]]) -> str:
    """Return "12.3 GB: weights 2.3, ..." for parts in bytes."""
    total = sum(size for _, size in parts)
    listed = ", ".join(f"{name} {size / 1e9:.2f}" for name, size in parts if size)
    return f"{total / 1e9:.2f} GB ({listed})"
