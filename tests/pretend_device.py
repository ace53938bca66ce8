"""An accelerator that is not there: real values on the CPU, and the rules of a device for every operation on them.

`PretendDevice("cuda")` makes code run as it would on a GPU: `device="cuda"`, `.to("cuda")` and `tensor.device` mean the
pretended device. Values are computed on the CPU, so that code whose shapes depend on values (draws, filters, TSDF) runs
too, which it does not under PyTorch's FakeTensorMode. What a real device refuses or waits for is found:

- an operation that mixes devices, tensors of indices included, raises `MixedDevicesError`, as does `.numpy()`;
- what makes the host wait (a value or a data-dependent shape read from the device, a copy to the CPU, a blocking copy
  from it) is recorded in `waits`, with the function of the package;
- with `float64=False` (Apple's GPUs) an operation on float64 raises `NoFloat64Error`.

A tensor belongs to the device of its storage: views and what autograd keeps need no care.
"""

import sys
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from unittest import mock

import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef
from torch.nn.utils import clip_grad
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from freegeo.data.procedural import raytrace
from freegeo.models import images
from freegeo.models.dpt import uv_embedding
from freegeo.models.transformer import grid_rope

CPU = torch.device("cpu")
aten = torch.ops.aten
COPIES = {aten._to_copy.default, aten.copy_.default}
ONE_NUMBER_FROM_HOST = {
    # Operations beyond the pointwise ones into which a real device takes a number (0-dim tensor) of the CPU.
    aten.masked_fill_.Tensor, aten.masked_fill.Tensor, aten.index_put_.default, aten.index_put.default,
    aten.fill_.Tensor, aten.copy_.default,
}  # fmt: skip
COUNTED = {
    # Operations whose shapes or checks depend on values that are on the device, whatever their tags say.
    aten.nonzero.default, aten.masked_select.default, aten.repeat_interleave.Tensor, aten.bincount.default,
    aten._unique2.default, aten.unique_consecutive.default, aten.unique_dim.default,
}  # fmt: skip


class MixedDevicesError(RuntimeError):
    """An operation that a real device refuses because its tensors are on two devices."""


class NoFloat64Error(TypeError):
    """An operation on float64, which the device lacks."""


class PretendDevice:
    """A device by name, the waits for it, and whether it has float64; see the module."""

    def __init__(self, name: str = "cuda", *, float64: bool = True):
        self.device, self.float64 = torch.device(name, 0), float64
        self.waits: list[str] = []
        self._owned: dict[int, StorageWeakRef] = {}
        self.beside = False
        """Whether a function of tensors on the device is running: what it makes for itself is there, too."""

    @contextmanager
    def __call__(self) -> Generator["PretendDevice"]:
        """Pretend inside the block."""
        with ExitStack() as stack:
            forget_tables()
            stack.callback(forget_tables)
            for target, name, value in self._patches():
                stack.enter_context(mock.patch.object(target, name, value))
            stack.enter_context(_Dispatch(self))
            stack.enter_context(_Function(self))
            yield self

    def _patches(self):
        """What asks for the device's presence, or calls its driver, with an answer."""
        yield torch.cuda, "is_available", lambda: self.device.type == "cuda"
        yield torch.cuda, "is_bf16_supported", lambda *_: True
        yield torch.cuda, "device_count", lambda: 1
        yield torch.cuda, "get_rng_state", lambda device=None: torch.get_rng_state()
        yield torch.cuda, "set_rng_state", lambda state, device=None: None
        yield torch.cuda, "synchronize", lambda device=None: self.waited("all work")
        yield torch.cuda, "manual_seed_all", lambda seed: None
        # A build for CUDA would ask the driver, which is not there.
        yield torch.accelerator, "current_accelerator", lambda check_available=False: None
        yield torch.cuda, "mem_get_info", lambda device=None: (16 << 30, 16 << 30)
        yield torch.cuda, "memory_reserved", lambda device=None: 0
        yield torch.cuda, "memory_allocated", lambda device=None: 0
        for module in (clip_grad, sys.modules["torch.optim.optimizer"]):
            yield module, "_group_tensors_by_device_and_dtype", self._grouped(module)
        # The cached bank of the CPU serves all devices; a copy on a pretended one is not cached.
        bank = raytrace.texture_bank
        yield raytrace, "texture_bank", lambda name, device="cpu": bank(name).to(device)
        plain = torch.autocast.__init__

        def autocast(this, device_type, *args, **kwargs):
            plain(this, "cpu" if device_type == self.device.type else device_type, *args, **kwargs)

        yield torch.autocast, "__init__", autocast

    def _grouped(self, module):
        """PyTorch's grouping of parameters, which reads devices in C++, with the pretended devices as keys."""
        plain = module._group_tensors_by_device_and_dtype

        def grouped(lists, *args, **kwargs):
            groups = plain(lists, *args, **kwargs)
            return {(self.device_of(found[0][0][0]), dtype): found for (_, dtype), found in groups.items()}

        return grouped

    def owns(self, tensor: Tensor) -> bool:
        """Whether a tensor is on the device."""
        return tensor.untyped_storage()._cdata in self._owned

    def device_of(self, tensor: Tensor) -> torch.device:
        """Return the device that a tensor is on."""
        return self.device if self.owns(tensor) else CPU

    def is_it(self, device: object) -> bool:
        """Whether a device, or its name, is the pretended one."""
        return isinstance(device, str | torch.device) and torch.device(device).type == self.device.type

    def take(self, result: object) -> None:
        """Put every tensor of a result on the device."""
        for tensor in tree_leaves(result):
            if isinstance(tensor, Tensor):
                storage = tensor.untyped_storage()
                # The weak reference keeps the address from being used again.
                self._owned.setdefault(storage._cdata, StorageWeakRef(storage))

    def waited(self, what: str) -> None:
        """Note that the host waited for the device, and where in the package."""
        frame = sys._getframe()
        while frame is not None and "/freegeo/" not in frame.f_code.co_filename:
            frame = frame.f_back
        where = ""
        if frame is not None:
            function = frame.f_code.co_qualname.partition(".<locals>")[0]
            where = f" in {frame.f_code.co_filename.rpartition('/freegeo/')[2]}:{function}"
        self.waits.append(f"{what}{where}")


def forget_tables() -> None:
    """Empty the models' caches of tables, which are on a device."""
    for kept in (grid_rope, uv_embedding, images._statistics):
        kept.cache_clear()


class _Dispatch(TorchDispatchMode):
    """Checks every operation, those of the backward pass included."""

    def __init__(self, pretend: PretendDevice):
        super().__init__()
        self.pretend = pretend

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        pretend, kwargs = self.pretend, kwargs or {}
        tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        on_device = [tensor for tensor in tensors if pretend.owns(tensor)]
        if on_device:
            self._check(func, tensors, on_device)
        result = func(*args, **kwargs)
        if pretend.beside and not tensors:
            pretend.take(result)
        if on_device and func is not aten._local_scalar_dense.default:
            if func is aten.copy_.default and not pretend.owns(args[0]):
                return result
            fresh = [leaf for leaf in tree_leaves(result) if isinstance(leaf, Tensor)]
            pretend.take(fresh)
            if not pretend.float64 and any(leaf.dtype == torch.float64 for leaf in fresh):
                raise NoFloat64Error(f"{func} gives float64 on {pretend.device}")
        return result

    def _check(self, func, tensors: list[Tensor], on_device: list[Tensor]) -> None:
        pretend = self.pretend
        host = [tensor for tensor in tensors if not pretend.owns(tensor)]
        if func is aten.copy_.default and host:
            pretend.waited("copy to the host" if pretend.owns(tensors[1]) else "copy from the host")
            return
        number = torch.Tag.pointwise in func.tags or func in ONE_NUMBER_FROM_HOST
        if any(tensor.ndim or not number for tensor in host):
            shapes = ", ".join(f"{pretend.device_of(t).type} {tuple(t.shape)}" for t in tensors)
            raise MixedDevicesError(f"{func}: {shapes}")
        dynamic = {torch.Tag.data_dependent_output, torch.Tag.dynamic_output_shape} & set(func.tags)
        masks = func in (aten.index.Tensor, aten.index_put_.default, aten.index_put.default) and any(
            tensor.dtype in (torch.bool, torch.uint8) for tensor in tensors[1:]
        )
        # PyTorch turns `x[mask] = number` into a masked fill, which needs no positions.
        filled = func is aten.index_put_.default and len(tensors) == 3 and tensors[2].numel() == 1
        if func in COUNTED or (dynamic and func is not aten.index.Tensor) or (masks and not filled):
            pretend.waited(func.name().removeprefix("aten::").partition(".")[0])


class _Function(TorchFunctionMode):
    """Turns what Python code says about devices into what holds for the pretended one."""

    def __init__(self, pretend: PretendDevice):
        super().__init__()
        self.pretend = pretend

    def __torch_function__(self, func, types, args=(), kwargs=None):
        pretend, kwargs = self.pretend, dict(kwargs or {})
        if func == Tensor.device.__get__:
            return pretend.device_of(args[0])
        if func == Tensor.is_cuda.__get__:
            return pretend.device_of(args[0]).type == "cuda"
        if func == Tensor.is_cpu.__get__:
            return not pretend.owns(args[0])
        if func in (Tensor.numpy, Tensor.__array__) and pretend.owns(args[0]):
            raise MixedDevicesError("numpy() of a tensor on the device")
        if func is Tensor.tolist and pretend.owns(args[0]):
            pretend.waited("tolist")
        if func is Tensor.cpu:
            return self._moved(args[0], CPU, args[0].dtype, {})
        if func is Tensor.cuda:
            return self._moved(args[0], pretend.device, args[0].dtype, {})
        if func is Tensor.to:
            return self._to(*args, **kwargs)
        if func in (Tensor.__getitem__, Tensor.__setitem__) and pretend.owns(args[0]):
            args = (args[0], self._positions(args[1]), *args[2:])
        wanted = kwargs.get("device")
        if func in (torch.tensor, torch.as_tensor, Tensor.new_tensor) and (
            pretend.is_it(wanted) or (func is Tensor.new_tensor and wanted is None and pretend.owns(args[0]))
        ):
            value = args[-1]
            if isinstance(value, Tensor):
                return self._moved(value, pretend.device, kwargs.get("dtype") or value.dtype, {})
            pretend.waited("copy from the host")
        if pretend.is_it(wanted):
            kwargs["device"] = CPU
            result = func(*args, **kwargs)
            pretend.take(result)
            if not pretend.float64 and isinstance(result, Tensor) and result.dtype == torch.float64:
                raise NoFloat64Error(f"{func} makes float64 on {pretend.device}")
            return result
        if not any(isinstance(leaf, Tensor) and pretend.owns(leaf) for leaf in tree_leaves((args, kwargs))):
            return func(*args, **kwargs)
        before, pretend.beside = pretend.beside, wanted is None
        try:
            result = func(*args, **kwargs)
        finally:
            pretend.beside = before
        if func is Tensor.new_tensor:
            pretend.take(result)
        return result

    def _positions(self, index: object) -> object:
        """Return an index in which lists of positions are tensors on the device, as PyTorch makes them."""
        if isinstance(index, tuple):
            return tuple(map(self._positions, index))
        if not isinstance(index, list):
            return index
        self.pretend.waited("copy from the host")
        positions = torch.tensor(index)
        self.pretend.take(positions)
        return positions

    def _to(self, tensor: Tensor, *args, **kwargs) -> Tensor:
        if args and isinstance(args[0], Tensor):
            other = args[0]
            return self._moved(tensor, self.pretend.device_of(other), other.dtype, kwargs)
        copy = kwargs.pop("copy", False)
        device, dtype, non_blocking, _ = torch._C._nn._parse_to(*args, **kwargs)
        target = self.pretend.device_of(tensor) if device is None else device
        options = {"non_blocking": non_blocking, "copy": copy}
        return self._moved(tensor, target, dtype or tensor.dtype, options)

    def _moved(self, tensor: Tensor, device: torch.device, dtype: torch.dtype, options: dict) -> Tensor:
        pretend = self.pretend
        to_it, from_it = pretend.is_it(device), pretend.owns(tensor)
        if not pretend.float64 and to_it and dtype == torch.float64:
            raise NoFloat64Error(f"a float64 tensor on {pretend.device}")
        if to_it == from_it:
            return tensor.to(dtype, copy=options.get("copy", False))
        if from_it:
            pretend.waited("copy to the host")
        elif not options.get("non_blocking"):
            pretend.waited("copy from the host")
        return _Move.apply(tensor, dtype, pretend, to_it)


class _Move(torch.autograd.Function):
    """A copy to the device or from it; the gradient goes the other way."""

    @staticmethod
    def forward(ctx, tensor: Tensor, dtype: torch.dtype, pretend: PretendDevice, to_it: bool) -> Tensor:
        ctx.pretend, ctx.to_it, ctx.dtype = pretend, to_it, tensor.dtype
        return _copied(tensor, dtype, pretend, to_it)

    @staticmethod
    def backward(ctx, grad: Tensor):
        return _copied(grad, ctx.dtype, ctx.pretend, not ctx.to_it), None, None, None


def _copied(tensor: Tensor, dtype: torch.dtype, pretend: PretendDevice, to_it: bool) -> Tensor:
    # Below the modes: the copy takes part in no rule and belongs to the other device.
    with torch._C.DisableTorchFunction(), torch.utils._python_dispatch._disable_current_modes():
        copy = torch.empty_like(tensor, dtype=dtype).copy_(tensor)
    if to_it:
        pretend.take(copy)
    return copy
