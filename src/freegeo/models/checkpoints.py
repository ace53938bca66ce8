"""Reading checkpoints: find the tensors, translate their names, and refuse anything that does not fit exactly."""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor, nn

from freegeo.errors import UserError
from freegeo.files import write_tensors
from freegeo.models.spec import KeyRules

Model = TypeVar("Model", bound=nn.Module)

_BLOCK_BYTES = 1 << 16
_BLOCKS = 64


def find_file(path: Path) -> Path:
    """Return the path of a weight file itself, or for a folder the one weight file in it."""
    if path.is_file():
        return path
    if not path.exists():
        raise UserError(f"{path}: no such checkpoint. Give a .safetensors or .pt file, or a folder that holds one.")
    for name in ("model.safetensors", "model.pt"):
        if (path / name).is_file():
            return path / name
    files = sorted(path.glob("*.safetensors")) or sorted(path.glob("*.pt"))
    if len(files) != 1:
        raise UserError(
            f"{path}: expected model.safetensors or model.pt, found {len(files)} weight files. Name the file itself."
        )
    return files[0]


def read_header(path: Path) -> dict[str, tuple[int, ...]]:
    """Return name -> shape of a safetensors file without loading it (and without importing torch's readers)."""
    try:
        with path.open("rb") as file:
            (length,) = struct.unpack("<Q", file.read(8))
            if length > min(path.stat().st_size, 100 << 20):
                raise UserError(_not_safetensors(path))
            header = json.loads(file.read(length))
    except (struct.error, UnicodeDecodeError, json.JSONDecodeError):
        raise UserError(_not_safetensors(path)) from None
    end = max((info["data_offsets"][1] for name, info in header.items() if name != "__metadata__"), default=0)
    if path.stat().st_size != 8 + length + end:
        raise UserError(
            f"{path}: the file is truncated ({path.stat().st_size} of {8 + length + end} bytes). Download it again."
        )
    return {name: tuple(info["shape"]) for name, info in header.items() if name != "__metadata__"}


def _not_safetensors(path: Path) -> str:
    return f"{path}: not a safetensors file (a renamed pickle?). Use the official .safetensors download."


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Load a .safetensors file, or a .pt file of plain tensors (nothing in it is executed)."""
    if path.suffix == ".safetensors":
        read_header(path)
        from safetensors.torch import load_file

        return load_file(path)
    if path.suffix not in (".pt", ".pth", ".bin"):
        raise UserError(f"{path}: unknown kind of checkpoint '{path.suffix}'. Use .safetensors or .pt.")
    return _read_pickle(path)


def _read_pickle(path: Path) -> dict[str, Tensor]:
    import pickle

    try:
        state = torch.load(path, map_location="cpu", mmap=True, weights_only=True)
    except pickle.UnpicklingError:
        raise UserError(
            f"{path}: the file holds more than plain tensors, and freegeo never runs code from a checkpoint. "
            "Use the official .safetensors download."
        ) from None
    except (RuntimeError, EOFError, ValueError) as error:
        raise UserError(f"{path}: not a readable checkpoint ({str(error).splitlines()[0]}).") from None
    state = state.get("model", state) if isinstance(state, dict) else state
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise UserError(f"{path}: not a plain state dict of tensors. Use the official .safetensors download.")
    return state


def load_weights(model: nn.Module, path: Path, rules: KeyRules, model_name: str) -> None:
    """Fill a model (built anywhere, also on `meta`) from a file; names and shapes must match exactly.

    Weights take the dtype the model was built with. UserError lists how many names are missing, unexpected or of
    another shape, and the first of each; or names the first tensor with a value that is not finite.
    """
    tensors = read_tensors(path)
    source = match_names(model, {name: tuple(t.shape) for name, t in tensors.items()}, path, rules, model_name)
    _require_finite({file_name: tensors[file_name] for file_name in source.values()}, path)
    wanted = model.state_dict()
    state = {name: tensors[file_name].to(wanted[name].dtype) for name, file_name in source.items()}
    model.load_state_dict(state, assign=True)
    for parameter in model.parameters():
        parameter.requires_grad_(False)


def save_weights(model: nn.Module, path: Path, rules: KeyRules, metadata: Mapping[str, str]) -> None:
    """Write a model's weights as safetensors under the names of its official checkpoint; `load_weights` reads them."""
    state = model.state_dict()
    write_tensors(path, {name: state[ours] for ours, name in rules.file_names(state).items()}, metadata)


def _require_finite(tensors: Mapping[str, Tensor], path: Path) -> None:
    # Minimum and maximum show any NaN or infinity, in one pass and without memory of the tensor's size.
    damaged = [name for name, value in tensors.items() if not torch.stack(value.aminmax()).isfinite().all()]
    if damaged:
        raise UserError(
            f"{path}: {len(damaged)} tensors hold values that are not finite (first: {damaged[0]}); the file is "
            "damaged or its training diverged. Download it again."
        )


def match_names(
    model: nn.Module, shapes: Mapping[str, tuple[int, ...]], path: Path, rules: KeyRules, model_name: str
) -> dict[str, str]:
    """Return our name -> file name for every tensor of a model; UserError unless names and shapes match exactly."""
    source = rules.translate(list(shapes))
    for alias, stored in rules.aliases.items():
        if stored in source:
            source.setdefault(alias, source[stored])
    require_match(
        {name: tuple(value.shape) for name, value in model.state_dict().items()},
        {name: shapes[file_name] for name, file_name in source.items()},
        f"{path}: this checkpoint does not fit {model_name}",
    )
    return source


def require_fit(model: nn.Module, path: Path, rules: KeyRules, model_name: str) -> None:
    """Raise UserError when a weight file does not fit a model; only the header of a safetensors file is read."""
    if path.suffix == ".safetensors":
        shapes = read_header(path)
    else:
        shapes = {name: tuple(tensor.shape) for name, tensor in read_tensors(path).items()}
    match_names(model, shapes, path, rules, model_name)


def require_match(wanted: Mapping[str, tuple[int, ...]], found: Mapping[str, tuple[int, ...]], what: str) -> None:
    """Raise UserError when two sets of named shapes differ, with counts and the first names."""
    missing = [name for name in wanted if name not in found]
    unexpected = [name for name in found if name not in wanted]
    reshaped = [name for name in wanted if name in found and wanted[name] != found[name]]
    if not (missing or unexpected or reshaped):
        return
    parts = [
        f"{len(names)} {kind} (first: {show(names[0])})"
        for kind, names, show in (
            ("missing", missing, str),
            ("unexpected", unexpected, str),
            ("of another shape", reshaped, lambda n: f"{n} is {found[n]}, expected {wanted[n]}"),
        )
        if names
    ]
    raise UserError(f"{what}: {', '.join(parts)}. Check --model and --checkpoint.")


def fingerprint(path: Path) -> str:
    """Identify a weight file by its size and 64 evenly spaced blocks (a full hash of 5 GB would cost seconds)."""
    size = path.stat().st_size
    digest = hashlib.sha256(str(size).encode())
    with path.open("rb") as file:
        for i in range(_BLOCKS):
            file.seek(max(0, size - _BLOCK_BYTES) * i // (_BLOCKS - 1))
            digest.update(file.read(_BLOCK_BYTES))
    return digest.hexdigest()[:16]


def build_on_meta(build: Callable[[], Model]) -> Model:
    """Build a model without memory, for counting or for loading by assignment."""
    with torch.device("meta"):
        return build()
