"""Where the recorded numbers are, and how closeness to them is measured."""

import os
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from freegeo.models.precision import exact

DEVICE = torch.device(os.environ.get("FREEGEO_DEVICE") or "cpu")
"""Where networks, losses and functions are checked; on a GPU in float32 throughout, no TF32."""
FULL_PRECISION = exact(DEVICE)
FULL_PRECISION.__enter__()
FIXTURES = Path(os.environ.get("FREEGEO_FIXTURES") or Path(__file__).parent / "fixtures")


def fixture_path(*parts: str) -> Path:
    return FIXTURES.joinpath(*parts)


def read_tensors(path: Path, device: torch.device = DEVICE) -> dict[str, Tensor]:
    """The recorded tensors of a file."""
    return load_file(path, device=str(device))


def relative_error(actual, expected) -> float:
    """max|actual - expected| / max|expected|; infinite when shapes differ or NaNs are not in the same places."""
    actual, expected = (torch.as_tensor(values).detach().cpu().double() for values in (actual, expected))
    if actual.shape != expected.shape or not torch.equal(actual.isnan(), expected.isnan()):
        return float("inf")
    if not expected.numel():
        return 0.0
    difference = (actual - expected).nan_to_num(nan=0.0).abs().max()
    return float(difference / expected.nan_to_num(nan=0.0).abs().max().clamp(min=1e-300))
