"""Where the recorded numbers are, and how closeness to them is measured."""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from functools import partial
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


def recorded_cases(
    folder: Path,
    networks: Mapping[str, Callable[[Path, dict], float]],
    functions: Mapping[str, Callable[[Path], float]],
    gradients: Callable[[Path, bool], float] | None = None,
) -> Iterator[tuple[str, Callable[[], float]]]:
    """Name and check of every case of networks, of gradients (with and without recomputing) and of functions there is.

    Args:
        folder: of the recorded numbers of a family.
        networks: name of a model, and so of its folder -> check of one of the cases that its config.json lists.
        functions: name of a file in `functions/` -> check of it.
        gradients: check of a file of gradients in a model's folder.
    """
    for model, network in networks.items():
        place = folder / model
        config = place / "config.json"
        for case in json.loads(config.read_text())["cases"] if config.is_file() else ():
            if (place / case["file"]).is_file():
                yield f"{model}.{case['name']}", partial(network, place, case)
        for path in sorted(place.glob("grad-*.safetensors")) if gradients is not None else ():
            for recompute in (False, True):
                yield f"{model}.{path.stem}{'.recompute' if recompute else ''}", partial(gradients, path, recompute)
    for name, check in functions.items():
        path = folder / "functions" / name
        if path.is_file():
            yield f"functions.{path.stem}", partial(check, path)


def relative_error(actual, expected) -> float:
    """max|actual - expected| / max|expected|; infinite when shapes differ or NaNs are not in the same places."""
    actual, expected = (torch.as_tensor(values).detach().cpu().double() for values in (actual, expected))
    if actual.shape != expected.shape or not torch.equal(actual.isnan(), expected.isnan()):
        return float("inf")
    if not expected.numel():
        return 0.0
    difference = (actual - expected).nan_to_num(nan=0.0).abs().max()
    return float(difference / expected.nan_to_num(nan=0.0).abs().max().clamp(min=1e-300))
