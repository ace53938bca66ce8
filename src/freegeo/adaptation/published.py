"""Adapters in the layout of the method's authors (fact sheet, section 3.5), read and written.

    FOLDER/  <name>_lora_peft/   peft's two files; layers are named relative to the part that the authors adapt
             <name>_lora.pt      {"camera_token": tensor}, float32, beside the peft folder

Which part that is, the model says (`published_adapter_root`). `load_adapter` reads this layout by itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from freegeo.adaptation.peft_files import lora_layers, write_peft
from freegeo.errors import UserError
from freegeo.files import atomic_path
from freegeo.models.checkpoints import read_tensors

if TYPE_CHECKING:
    from freegeo.adaptation.adapter import Adapter
    from freegeo.models.api import ReconstructionModel

LORA_SUFFIX, TOKEN_SUFFIX = "_lora_peft", "_lora.pt"


def own_names(model: ReconstructionModel, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Name LoRA tensors by the layers of the whole model, where a file names them by those of the adapted part."""
    root = model.published_adapter_root
    modules = {name for name, _ in model.named_modules()}
    if not root or any(f"{root}.{layer}" not in modules for layer in lora_layers(tensors)):
        return dict(tensors)
    return {f"{root}.{name}": value for name, value in tensors.items()}


def is_published(folder: Path) -> bool:
    """Say whether a folder is the peft half of a published adapter, by its name."""
    return folder.absolute().name.endswith(LORA_SUFFIX)


def read_camera_token(folder: Path) -> Tensor:
    """Read the camera token that belongs to a published peft folder; nothing in the file is executed.

    UserError when the file is missing or holds something else.
    """
    folder = folder.absolute()
    path = folder.with_name(folder.name.removesuffix(LORA_SUFFIX) + TOKEN_SUFFIX)
    if not path.is_file():
        raise UserError(f"{path}: the camera token of {folder.name} is missing. Copy that file beside the folder.")
    tensors = read_tensors(path)
    if set(tensors) != {"camera_token"}:
        raise UserError(f"{path}: expected only camera_token, found {', '.join(sorted(tensors)) or 'nothing'}.")
    return tensors["camera_token"]


def export_published(adapter: Adapter, folder: Path, name: str = "latest") -> list[Path]:
    """Write an adapter in the authors' layout into `folder`, as `name`; returns the files."""
    files = write_peft(adapter, folder / (name + LORA_SUFFIX), root=adapter.model.published_adapter_root)
    if adapter.camera_token is None:
        return files
    token = folder / (name + TOKEN_SUFFIX)
    with atomic_path(token) as part:
        torch.save({"camera_token": adapter.camera_token.detach().float().cpu().clone()}, part)
    return [*files, token]
