"""Dropout for LoRA inputs on the CPU, where drawing one random number per element would take a tenth of a step."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from freegeo.adaptation.adapter import ADAPTER_NAME, Adapter

STEPS = 1 << 16


class _Masked(torch.autograd.Function):
    """Product with a mask of zeros and one factor; one byte per element is kept."""

    @staticmethod
    def forward(ctx, x: Tensor, keep: Tensor, factor: float) -> Tensor:
        ctx.save_for_backward(keep)
        ctx.factor = factor
        return (x * keep).mul_(factor)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None]:
        (keep,) = ctx.saved_tensors
        return (grad * keep).mul_(ctx.factor), None, None


class PackedDropout(nn.Module):
    """Dropout whose masks take 16 bits of randomness per element: four elements share one draw of the generator.

    The probability is rounded to 1/65536 and the scale uses the rounded one, so that the expectation is exact.
    """

    def __init__(self, probability: float):
        super().__init__()
        self.dropped = round(probability * STEPS)
        self.factor = STEPS / (STEPS - self.dropped)

    def forward(self, x: Tensor) -> Tensor:
        """Drop elements while training."""
        if not self.training or not self.dropped:
            return x
        words = torch.empty((x.numel() + 3) // 4, dtype=torch.int64).random_(-(1 << 63), None)
        drawn = words.view(torch.int16)[: x.numel()].view(x.shape)
        return _Masked.apply(x, drawn >= self.dropped - STEPS // 2, self.factor)


def pack_dropout(adapter: Adapter) -> None:
    """Replace the dropout of an adapter's layers, where it has any."""
    for layer in adapter.layers.values():
        dropout = layer.lora_dropout[ADAPTER_NAME]
        if isinstance(dropout, nn.Dropout):
            layer.lora_dropout[ADAPTER_NAME] = PackedDropout(dropout.p)
