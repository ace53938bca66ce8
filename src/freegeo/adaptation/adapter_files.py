"""Adapters on disk: peft's own two files, the camera token, and a page that says what the adapter is.

    ADAPTER/  adapter_config.json  adapter_model.safetensors    peft's format
              camera_token.safetensors
              freegeo.json         base model and its fingerprint, recipe, seed, scenes, loss curve
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from freegeo.adaptation.adapter import Adapter
from freegeo.errors import UserError
from freegeo.models.checkpoints import read_tensors, require_match
from freegeo.storage import FORMAT, atomic_path, read_json, write_json, write_tensors

if TYPE_CHECKING:
    from freegeo.models.api import ReconstructionModel

PEFT_PREFIX = "base_model.model."
CONFIG, WEIGHTS, TOKEN, PAGE = (
    "adapter_config.json",
    "adapter_model.safetensors",
    "camera_token.safetensors",
    "freegeo.json",
)


def save_adapter(adapter: Adapter, folder: Path, page: Mapping[str, Any]) -> list[Path]:
    """Write an adapter; `page` is what freegeo.json adds to the base model's identity. Returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    named = {name: value.float() for name, value in adapter.named_parameters().items()}
    token = named.pop("camera_token", None)
    write_tensors(folder / WEIGHTS, {PEFT_PREFIX + name: value for name, value in named.items()}, {"format": "pt"})
    _write_peft_config(adapter, folder / CONFIG)
    files = [folder / CONFIG, folder / WEIGHTS]
    if token is not None:
        write_tensors(folder / TOKEN, {"camera_token": token})
        files.append(folder / TOKEN)
    write_json(folder / PAGE, {"format": FORMAT, "base": _base(adapter.model), **page})
    return [*files, folder / PAGE]


def load_adapter(model: ReconstructionModel, folder: str | Path) -> Adapter:
    """Attach a saved adapter, on and at strength 1, for inference.

    UserError when the folder is no adapter, or when it was made for another model (by layer names and shapes; a
    differing fingerprint of the same architecture is an error too).
    """
    folder = Path(folder)
    config, page = _read_config(folder), adapter_page(folder)
    if page is not None:
        _require_same_base(model, page["base"], folder)
    tensors = {name.removeprefix(PEFT_PREFIX): value for name, value in read_tensors(folder / WEIGHTS).items()}
    if (folder / TOKEN).is_file():
        tensors |= read_tensors(folder / TOKEN)
    adapter = Adapter.attach(
        model,
        rank=config["r"],
        alpha=config["lora_alpha"],
        dropout=0.0,
        generator=torch.Generator(),
        targets=sorted({name.rsplit(".lora_", 1)[0] for name in tensors if ".lora_" in name}),
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
    """Return freegeo.json of an adapter folder; None for a plain peft adapter."""
    return read_json(folder / PAGE) if (folder / PAGE).is_file() else None


def _write_peft_config(adapter: Adapter, path: Path) -> None:
    values = adapter.lora_config.to_dict()
    values["target_modules"] = sorted(values["target_modules"])
    values["inference_mode"] = True
    values["base_model_name_or_path"] = adapter.model.spec.name
    with atomic_path(path) as part:
        part.write_text(json.dumps(values, indent=2, sort_keys=True, default=_plain) + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    if isinstance(value, set | frozenset):
        return sorted(value)
    return str(getattr(value, "value", value))


def _base(model: ReconstructionModel) -> dict[str, str]:
    loaded = getattr(model, "loaded_from", None)
    return {
        "model": model.spec.name,
        "fingerprint": loaded.fingerprint if loaded else "",
        "licence": model.spec.weights_licence,
    }


def _read_config(folder: Path) -> dict[str, Any]:
    if not (folder / CONFIG).is_file() or not (folder / WEIGHTS).is_file():
        raise UserError(f"{folder}: not an adapter folder ({CONFIG} and {WEIGHTS} are expected).")
    config = read_json(folder / CONFIG)
    if config.get("peft_type") != "LORA":
        raise UserError(f"{folder}: holds a {config.get('peft_type')} adapter; only LoRA is supported.")
    return config


def _require_same_base(model: ReconstructionModel, base: Mapping[str, str], folder: Path) -> None:
    mine = _base(model)
    if base["model"] != mine["model"]:
        raise UserError(f"{folder}: the adapter was made for {base['model']}, not for {mine['model']}. Use that model.")
    if base["fingerprint"] and mine["fingerprint"] and base["fingerprint"] != mine["fingerprint"]:
        raise UserError(
            f"{folder}: the adapter was made for another checkpoint of {base['model']} ({base['fingerprint']}, this is "
            f"{mine['fingerprint']}). Use that checkpoint."
        )
