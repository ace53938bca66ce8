"""The device and precision a model runs in: float32, or autocast to a half type with float32 heads and norms."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch

from freegeo.errors import UserError

Precision = Literal["fp32", "bf16", "fp16"]
PRECISIONS: tuple[Precision, ...] = ("fp32", "bf16", "fp16")
CPU = torch.device("cpu")
_DTYPES = {"bf16": torch.bfloat16, "fp16": torch.float16}


@dataclass(frozen=True, kw_only=True)
class Compute:
    """Where a model runs and in which precision."""

    device: torch.device = CPU
    precision: Precision = "fp32"
    by_default: bool = field(default=False, compare=False)
    """Whether nobody asked for the precision, so that work with a published one may take that (`preferring`)."""

    @classmethod
    def choose(cls, device: str | None = None, precision: str | None = None) -> Compute:
        """Return the given device and precision, or the best available; UserError when one is not available."""
        chosen = choose_device(device)
        return cls(device=chosen, precision=choose_precision(precision, chosen), by_default=precision is None)

    def preferring(self, precision: Precision | None) -> Compute:
        """Return this with the precision of published work, on a CUDA device, where nobody asked for another.

        A device without bf16 takes fp16 instead, as the released evaluation does. None changes nothing.
        """
        if precision is None or not self.by_default or self.device.type != "cuda":
            return self
        if precision == "bf16" and not torch.cuda.is_bf16_supported():
            precision = "fp16"
        return replace(self, precision=choose_precision(precision, self.device))

    def autocast(self) -> AbstractContextManager:
        """Return the context that a model runs in; its heads and norms stay in float32 by themselves."""
        return autocast(self.device, self.precision)


def choose_device(name: str | None) -> torch.device:
    """Return the device of that name, or the best one available; UserError when it is not available."""
    if name is None:
        if torch.cuda.is_available():
            return torch.device("cuda")
        return torch.device("mps" if torch.backends.mps.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        raise UserError(f"unknown device '{name}'. Choose cpu, cuda, cuda:N or mps.") from None
    available = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    if not available.get(device.type, False):
        raise UserError(f"device '{name}' is not available here. Choose --device cpu.")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise UserError(f"device '{name}' does not exist: this machine has {torch.cuda.device_count()} CUDA devices.")
    return device


def choose_precision(name: str | None, device: torch.device) -> Precision:
    """Return the precision of that name; None: bf16 on a CUDA device that has it, else fp32."""
    if name is None:
        return "bf16" if device.type == "cuda" and torch.cuda.is_bf16_supported() else "fp32"
    for known in PRECISIONS:
        if name == known:
            return known
    raise UserError(f"unknown precision '{name}'. Choose {', '.join(PRECISIONS)}.")


def autocast(device: torch.device, precision: Precision) -> AbstractContextManager:
    """Return the context that a model runs in; its heads and norms stay in float32 by themselves."""
    return exact(device) if precision == "fp32" else torch.autocast(device.type, _DTYPES[precision])


@contextmanager
def exact(device: torch.device) -> Generator[None]:
    """Compute float32 products and convolutions on a CUDA device in full precision, not in TF32.

    cuDNN's convolutions take TF32 unless told otherwise. These are global settings; they are restored afterwards.
    """
    switches = _tf32_switches() if device.type == "cuda" else []
    before = [getattr(settings, name) for settings, name, _ in switches]
    for settings, name, full in switches:
        setattr(settings, name, full)
    try:
        yield
    finally:
        for (settings, name, _), value in zip(switches, before, strict=True):
            setattr(settings, name, value)


def _tf32_switches() -> list[tuple[Any, str, str | bool]]:
    """Return object, attribute and value in full precision of the settings that allow TF32, by PyTorch's version."""
    matmul, cudnn = torch.backends.cuda.matmul, torch.backends.cudnn
    if hasattr(cudnn, "conv"):
        return [(settings, "fp32_precision", "ieee") for settings in (matmul, cudnn.conv, cudnn.rnn)]
    return [(settings, "allow_tf32", False) for settings in (matmul, cudnn)]
