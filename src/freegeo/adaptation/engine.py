"""How a run is computed: device, arithmetic, and what is kept where. Nothing here belongs to the method."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from freegeo.adaptation.cache import Place
from freegeo.models.precision import Precision

CPU = torch.device("cpu")


@dataclass(frozen=True, kw_only=True)
class Engine:
    """How a run is computed; only `precision` and the two halves change the result beyond rounding.

    Micro-batches draw other dropout masks than single view sets do, so with dropout they change it too.
    """

    device: torch.device = CPU
    precision: Precision = "fp32"
    share_prefix: bool = True
    """Embed every image once, instead of in every pass."""
    cache_teacher: bool = True
    """Compute the teacher once per view set, instead of in every step."""
    cache_place: Place = "device"
    """Where embedded images and teacher targets wait."""
    cache_folder: Path | None = None
    """Folder of the files of place `disk`; None: the system's temporary folder."""
    half_cache: bool = False
    """Keep both in float16: half the memory, features rounded by up to 5e-4."""
    half_weights: bool = False
    """Store the encoder's linear weights in the run's half precision, for good; autocast rounds them so anyway."""
    micro_batch: int = 1
    """View sets that go through the student together."""
    recompute_blocks: bool = False
    """Activation checkpointing: less memory, one more student forward."""
    images_ahead: int = 2
    """View sets whose images are decoded in the background before they are needed."""
