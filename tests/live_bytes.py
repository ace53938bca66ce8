"""Bytes of the tensors that are alive, and their most at one time."""

import weakref

import torch
from torch.utils._python_dispatch import TorchDispatchMode


class LiveBytes(TorchDispatchMode):
    """Counts the bytes of all tensors made while it is on, from their making to their end."""

    def __init__(self, model):
        super().__init__()
        # Weights are there before; views of them are made all the time.
        self.sizes = {p.untyped_storage()._cdata: 0 for p in model.parameters()}
        self.live = self.peak = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        found = func(*args, **(kwargs or {}))
        for tensor in found if isinstance(found, tuple | list) else (found,):
            if isinstance(tensor, torch.Tensor):
                self._count(tensor.untyped_storage())
        return found

    def _count(self, storage) -> None:
        key = storage._cdata
        if key not in self.sizes:
            self.sizes[key] = storage.nbytes()
            self.live += storage.nbytes()
            self.peak = max(self.peak, self.live)
            weakref.finalize(storage, self._end, key)

    def _end(self, key: int) -> None:
        self.live -= self.sizes.pop(key)
