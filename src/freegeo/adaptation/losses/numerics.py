"""How the losses compute: in float32 or float64, with exact matrix products, over blocks that fit in cache.

Features may arrive in half precision under autocast. Losses are differences of nearly equal numbers, for which half
precision and TF32 are too coarse, so every loss widens its inputs and switches both off for its products. The losses
are a small share of a step.
"""

from collections.abc import Generator, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from freegeo.models.precision import exact

# Elements per block of a temporary array. On a CPU 0.5 MB in float32: the arrays in play stay in the shared cache, and
# the cost of an operator call (a few microseconds) stays small. On an accelerator a block only has to bound the memory.
CPU_BLOCK_ELEMENTS = 1 << 17
DEVICE_BLOCK_ELEMENTS = 1 << 25


def block_elements(tensor: Tensor) -> int:
    """Number of elements that one temporary array of a blocked loop over `tensor` should have on its device."""
    return CPU_BLOCK_ELEMENTS if tensor.device.type == "cpu" else DEVICE_BLOCK_ELEMENTS


def blocks(length: int, size: int) -> Iterator[slice]:
    """Slices that cover `range(length)` in order, each at most `max(size, 1)` long."""
    step = max(size, 1)
    for start in range(0, length, step):
        yield slice(start, min(start + step, length))


def widened(tensor: Tensor) -> Tensor:
    """`tensor` in float32, or unchanged where it is float64 already: the type that its loss is given in."""
    return tensor if tensor.dtype == torch.float64 else tensor.float()


def doubled(tensor: Tensor) -> Tensor:
    """`tensor` in float64; from a device that has no such numbers (Apple GPUs) on the CPU."""
    return tensor.cpu().double() if tensor.device.type == "mps" else tensor.double()


def sent(tensor: Tensor, device: torch.device | str) -> Tensor:
    """`tensor` of the CPU on a device; CUDA takes it without waiting for the work that is queued there."""
    # CUDA has copied pageable memory when the call returns. Apple's GPUs may read it later, so they wait.
    return tensor.to(device, non_blocking=torch.device(device).type == "cuda")


@contextmanager
def exact_matmul(tensor: Tensor) -> Generator[None]:
    """Matrix products on the device of `tensor` in the full precision of their inputs: no autocast, no TF32.

    A KL value is a small difference of large logarithms, for which TF32 is too coarse.
    """
    with torch.autocast(device_type=tensor.device.type, enabled=False), exact(tensor.device):
        yield
