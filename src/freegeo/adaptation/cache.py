"""Tensors that wait for their next use: on the device, in the host's memory, or in memory-mapped files."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from freegeo.errors import UserError

Place = Literal["device", "host", "disk"]
LARGEST_HALF = torch.finfo(torch.float16).max


class TensorCache:
    """Groups of named tensors by key; what is read back is on the device and of the type that was put in."""

    def __init__(
        self, name: str, place: Place, device: torch.device, *, folder: Path | None = None, half: bool = False
    ):
        """`folder` belongs to one run at a time: what a killed run left there under the same `name` is removed."""
        self.place, self.device, self.half = place, device, half
        self._groups: dict[Hashable, dict[str, Tensor] | Path] = {}
        self._dtypes: dict[Hashable, dict[str, torch.dtype]] = {}
        self._files = 0
        self._folder: Path | None = None
        if place == "disk":
            self._folder = _empty_folder(name, folder)

    def __contains__(self, key: Hashable) -> bool:
        return key in self._groups

    def put(self, key: Hashable, tensors: Mapping[str, Tensor]) -> None:
        """Keep a group under a key; the tensors are not copied when they can stay as they are."""
        self._dtypes[key] = {name: tensor.dtype for name, tensor in tensors.items()}
        self._groups[key] = self._stored({name: self._narrow(tensor) for name, tensor in tensors.items()})

    def get(self, key: Hashable) -> dict[str, Tensor]:
        """Return a group on the device; host memory is copied without waiting for the copy."""
        group, dtypes = self._groups[key], self._dtypes[key]
        if isinstance(group, Path):
            group = _mapped(group)
        return {
            name: tensor.to(self.device, non_blocking=True).to(dtypes[name], copy=False)
            for name, tensor in group.items()
        }

    def drop(self, key: Hashable) -> None:
        """Forget a group, if it is there."""
        group = self._groups.pop(key, None)
        self._dtypes.pop(key, None)
        if isinstance(group, Path):
            group.unlink(missing_ok=True)

    def close(self) -> None:
        """Forget everything and remove the files."""
        self._groups.clear()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def rounded(self, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return what `get` would after `put`, so that a group gives the same result kept or not."""
        return {name: self._narrow(tensor).to(tensor.dtype) for name, tensor in tensors.items()}

    def nbytes(self) -> int:
        """Bytes kept."""
        return sum(
            group.stat().st_size if isinstance(group, Path) else sum(tensor.nbytes for tensor in group.values())
            for group in self._groups.values()
        )

    def _narrow(self, tensor: Tensor) -> Tensor:
        if not self.half or tensor.dtype != torch.float32:
            return tensor
        # Beyond float16's range a value would turn infinite; such a tensor stays as it is.
        return tensor.half() if not tensor.numel() or float(tensor.abs().amax()) <= LARGEST_HALF else tensor

    def _stored(self, tensors: dict[str, Tensor]) -> dict[str, Tensor] | Path:
        if self._folder is not None:
            from safetensors.torch import save_file

            path = self._folder / f"{self._files}.safetensors"
            self._files += 1
            save_file({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}, path)
            return path
        if self.place == "host" and self.device.type == "cuda":
            return {name: tensor.cpu().pin_memory() for name, tensor in tensors.items()}
        return {name: tensor.cpu() if self.place == "host" else tensor for name, tensor in tensors.items()}


def _empty_folder(name: str, parent: Path | None) -> Path:
    if parent is None:
        return Path(tempfile.mkdtemp(prefix=f"freegeo-{name}-"))
    folder = parent / f"freegeo-{name}-cache"
    try:
        if folder.exists():
            shutil.rmtree(folder)
        folder.mkdir(parents=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be written to ({error.strerror}). Choose another cache folder.") from None
    return folder


def _mapped(path: Path) -> dict[str, Tensor]:
    from safetensors import safe_open

    with safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
