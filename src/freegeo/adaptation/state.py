"""The state of an unfinished run on disk, so that the same call goes on where it stopped."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.images import SceneImages
from freegeo.adaptation.recipe import Recipe
from freegeo.errors import UserError
from freegeo.files import write_tensors


def run_identity(model: str, scenes: Sequence[SceneImages], recipe: Recipe, seed: int) -> str:
    """Return a fingerprint of everything but the pixels and weights that decides what a run computes."""
    about = {
        "model": model,
        "scenes": [(scene.name, scene.count) for scene in scenes],
        "recipe": asdict(recipe),
        "seed": seed,
    }
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]


def write_state(path: Path, adapter: Adapter, optimiser: torch.optim.Optimizer, about: Mapping[str, Any]) -> None:
    """Write trained parameters, optimiser moments and JSON-like facts; the file appears whole or not at all."""
    tensors = {}
    for name, parameter in adapter.named_parameters().items():
        tensors[name] = parameter
        for key, value in optimiser.state[parameter].items():
            tensors[f"{name}|{key}"] = value
    write_tensors(path, tensors, {"run": json.dumps(about)})


def read_state(path: Path, adapter: Adapter, optimiser: torch.optim.Optimizer, identity: str) -> dict[str, Any] | None:
    """Put a saved state into the adapter and its optimiser and return the facts; None when there is no file.

    UserError for the state of another run (`about["identity"]`), or a damaged file.
    """
    if not path.is_file():
        return None
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads((file.metadata() or {}).get("run", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise UserError(f"{path}: damaged state of an unfinished run ({error}). Remove it to start again.") from None
    if about.get("identity") != identity:
        raise UserError(f"{path}: this state belongs to another run. Remove it, or choose another output folder.")
    named = adapter.named_parameters()
    adapter.load({name: tensors[name] for name in named})
    for name, parameter in named.items():
        # The optimiser computes on the parameter's device, its step counter included.
        optimiser.state[parameter] = {
            key.partition("|")[2]: value.to(parameter.device)
            for key, value in tensors.items()
            if key.startswith(f"{name}|")
        }
    return about
