"""peft's own two adapter files, which every adapter on disk is built around.

FOLDER/  adapter_config.json         rank, alpha, target layers
         adapter_model.safetensors   base_model.model.<layer>.lora_{A|B}.weight, float32
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor

from freegeo.errors import UserError
from freegeo.files import atomic_path, read_json, write_tensors
from freegeo.models.checkpoints import read_tensors

if TYPE_CHECKING:
    from freegeo.adaptation.adapter import Adapter

PEFT_PREFIX = "base_model.model."
CONFIG, WEIGHTS = "adapter_config.json", "adapter_model.safetensors"
CHANGES_THE_FORMULA = (
    *("use_rslora", "use_dora", "rank_pattern", "alpha_pattern", "modules_to_save"),
    *("fan_in_fan_out", "layer_replication"),
)
"""Settings of peft under which an adapter is more than W + alpha / r * B A with one rank."""


def write_peft(adapter: Adapter, folder: Path, *, root: str = "") -> list[Path]:
    """Write the LoRA part of an adapter, its layers named relative to the module `root` of the model."""
    prefix = f"{root}." if root else ""
    named = {name: value for name, value in adapter.named_parameters().items() if name != "camera_token"}
    tensors = {PEFT_PREFIX + name.removeprefix(prefix): value.float() for name, value in named.items()}
    write_tensors(folder / WEIGHTS, tensors, {"format": "pt"})
    values = adapter.lora_config.to_dict()
    values["target_modules"] = sorted(name.removeprefix(prefix) for name in adapter.layers)
    values["inference_mode"] = True
    values["base_model_name_or_path"] = adapter.model.spec.name
    with atomic_path(folder / CONFIG) as part:
        part.write_text(json.dumps(values, indent=2, sort_keys=True, default=_plain) + "\n", encoding="utf-8")
    return [folder / CONFIG, folder / WEIGHTS]


def read_peft(folder: Path) -> tuple[Mapping[str, Any], dict[str, Tensor]]:
    """Return an adapter's configuration and its tensors `<layer>.lora_{A|B}.weight`.

    UserError when the folder holds no LoRA adapter, or one that computes something else than plain LoRA does.
    """
    if not (folder / CONFIG).is_file() or not (folder / WEIGHTS).is_file():
        raise UserError(
            f"{folder}: not an adapter folder ({CONFIG} and {WEIGHTS} are expected). "
            "Give the folder that `freegeo adapt` wrote."
        )
    config = read_json(folder / CONFIG)
    if config.get("peft_type") != "LORA" or not {"r", "lora_alpha"} <= set(config):
        raise UserError(f"{folder}: holds a {config.get('peft_type')} adapter; only LoRA is supported.")
    special = [name for name in CHANGES_THE_FORMULA if config.get(name)]
    if special:
        raise UserError(f"{folder}: the adapter uses {', '.join(special)}; only plain LoRA of one rank is supported.")
    tensors = {name.removeprefix(PEFT_PREFIX): value for name, value in read_tensors(folder / WEIGHTS).items()}
    if not lora_layers(tensors):
        raise UserError(f"{folder / WEIGHTS}: no LoRA matrices in it. Give the folder that `freegeo adapt` wrote.")
    return config, tensors


def lora_layers(tensors: Mapping[str, Tensor]) -> list[str]:
    """Return the layers that LoRA matrices belong to, sorted."""
    return sorted({name.rsplit(".lora_", 1)[0] for name in tensors if ".lora_" in name})


def _plain(value: Any) -> Any:
    if isinstance(value, set | frozenset):
        return sorted(value)
    return str(getattr(value, "value", value))
