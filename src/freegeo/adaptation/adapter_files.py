"""Adapters on disk: peft's own two files, the camera token, and a page that says what the adapter is.

ADAPTER/  adapter_config.json  adapter_model.safetensors    peft's format
          camera_token.safetensors                          where the model has a camera token
          freegeo.json         base model and its fingerprint, recipe, seed, scenes, loss curve
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.peft_files import lora_layers, read_peft, write_peft
from freegeo.adaptation.published import is_published, own_names, read_camera_token
from freegeo.errors import UserError
from freegeo.files import FORMAT, read_json, write_json, write_tensors
from freegeo.models.checkpoints import read_tensors, require_match

if TYPE_CHECKING:
    from freegeo.models.api import ReconstructionModel

TOKEN, PAGE = "camera_token.safetensors", "freegeo.json"


def save_adapter(adapter: Adapter, folder: Path, page: Mapping[str, Any]) -> list[Path]:
    """Write an adapter at strength 1; `page` is what freegeo.json adds to the base model's identity.

    Returns the files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = write_peft(adapter, folder)
    if adapter.camera_token is not None:
        write_tensors(folder / TOKEN, {"camera_token": adapter.camera_token.float()})
        files.append(folder / TOKEN)
    write_json(folder / PAGE, {"format": FORMAT, "base": _base(adapter.model), **page})
    return [*files, folder / PAGE]


def load_adapter(model: ReconstructionModel, folder: str | Path) -> Adapter:
    """Attach a saved adapter, on and at strength 1, for inference; the model stays as it was when this fails.

    Reads our own folders, plain peft folders and the authors' published layout. UserError when the folder is no
    adapter, or when it was made for another model (by layer names and shapes; a differing fingerprint of the same
    architecture is an error too).
    """
    folder, model = Path(folder), model.adaptable()
    config, tensors = read_peft(folder)
    _require_same_base(model, adapter_page(folder), folder)
    tensors = own_names(model, tensors) | _camera_token(model, folder)
    adapter = Adapter.attach(
        model,
        rank=config["r"],
        alpha=config["lora_alpha"],
        dropout=0.0,
        generator=torch.Generator(),
        targets=lora_layers(tensors),
    )
    ours = {name: tuple(value.shape) for name, value in adapter.named_parameters().items()}
    if "camera_token" not in tensors:
        ours.pop("camera_token", None)
    try:
        shapes = {name: tuple(value.shape) for name, value in tensors.items()}
        require_match(ours, shapes, f"{folder}: this adapter does not fit {model.spec.name}")
        adapter.load(tensors)
    except UserError:
        adapter.detach()
        raise
    for parameter in adapter.parameters():
        parameter.requires_grad_(False)
    return adapter


def adapter_page(folder: Path) -> dict[str, Any] | None:
    """Return freegeo.json of an adapter folder; None for an adapter that freegeo did not write."""
    return read_json(folder / PAGE) if (folder / PAGE).is_file() else None


def _camera_token(model: ReconstructionModel, folder: Path) -> dict[str, Tensor]:
    if (folder / TOKEN).is_file():
        return read_tensors(folder / TOKEN)
    # A plain peft adapter leaves the token alone; the authors' never does.
    if is_published(folder) and model.camera_token_name is not None:
        return {"camera_token": read_camera_token(folder)}
    return {}


def _base(model: ReconstructionModel) -> dict[str, str]:
    loaded = getattr(model, "loaded_from", None)
    return {
        "model": model.spec.name,
        "fingerprint": loaded.fingerprint if loaded else "",
        "licence": model.spec.weights_licence,
    }


def _require_same_base(model: ReconstructionModel, page: Mapping[str, Any] | None, folder: Path) -> None:
    if page is None:
        return
    if page["format"] > FORMAT:
        raise UserError(f"{folder}: written by a newer freegeo (format {page['format']}). Update freegeo.")
    base, mine = page["base"], _base(model)
    if base["model"] != mine["model"]:
        raise UserError(f"{folder}: the adapter was made for {base['model']}, not for {mine['model']}. Use that model.")
    if base["fingerprint"] and mine["fingerprint"] and base["fingerprint"] != mine["fingerprint"]:
        raise UserError(
            f"{folder}: the adapter was made for another checkpoint of {base['model']} ({base['fingerprint']}, this is "
            f"{mine['fingerprint']}). Use that checkpoint."
        )
