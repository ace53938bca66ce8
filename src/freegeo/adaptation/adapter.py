"""LoRA on the cross-view layers together with the camera token: attach, switch off, scale, merge, detach, reattach.

peft owns the LoRA layers; the camera token is a parameter, not a module, so it is owned here and swapped into the model
while the adapter is on. The base weights are never touched before `merge`.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor, nn

from freegeo.errors import UserError

if TYPE_CHECKING:
    from peft import LoraConfig
    from peft.tuners.lora import LoraLayer

    from freegeo.models.api import ReconstructionModel

ADAPTER_NAME = "default"


def count_trainable(model: ReconstructionModel, rank: int) -> int:
    """Return how many parameters an adapter of a rank trains: r (in + out) per linear, and the camera token.

    The model may be on the meta device.
    """
    part = model.adaptable()
    linears = [cast(nn.Linear, part.get_submodule(name)) for name in part.adapter_targets()]
    lora = sum(rank * (linear.in_features + linear.out_features) for linear in linears)
    token = part.get_parameter(part.camera_token_name).numel() if part.camera_token_name else 0
    return lora + token


def is_adapted(model: nn.Module) -> bool:
    """Whether a model has an adapter that is on."""
    # Only peft's layers have this attribute; an isinstance check would import peft, which takes seconds.
    return any(not getattr(module, "disable_adapters", True) for module in model.modules())


class PackedDropout(nn.Module):
    """Dropout whose masks take 16 bits of randomness per element: four elements share one draw of the generator.

    One random number per element would take a tenth of a step on the CPU. The probability is rounded to 1/65536 and the
    scale uses the rounded one, so that the expectation is exact.
    """

    STEPS = 1 << 16

    def __init__(self, probability: float):
        super().__init__()
        self.dropped = round(probability * self.STEPS)

    def forward(self, x: Tensor) -> Tensor:
        """Drop elements while training."""
        if not self.training or not self.dropped:
            return x
        words = torch.empty((x.numel() + 3) // 4, dtype=torch.int64).random_(-(1 << 63), None)
        drawn = words.view(torch.int16)[: x.numel()].view(x.shape)
        keep = drawn >= self.dropped - self.STEPS // 2
        return (x * keep).mul_(self.STEPS / (self.STEPS - self.dropped))


class Adapter:
    """An adapter attached to a model: on by default, with strength 1.

    A fresh one changes nothing: LoRA's B matrices are zero and the camera token is a copy.
    """

    def __init__(
        self,
        model: ReconstructionModel,
        lora_config: LoraConfig,
        layers: dict[str, LoraLayer],
        process_res: int | None = None,
    ):
        self.model = model
        self.process_res = model.adapted_at = process_res
        self.lora_config = lora_config
        self.layers = layers
        token = model.camera_token_name
        self._base_token = None if token is None else model.get_parameter(token)
        self.camera_token = None if self._base_token is None else nn.Parameter(self._base_token.detach().clone())
        self._scaling = {name: layer.scaling[ADAPTER_NAME] for name, layer in layers.items()}
        self.strength = 1.0
        self._peft_config = model.peft_config
        self._token = self.camera_token
        self._install_token(self._token)

    def __repr__(self) -> str:
        """Return the model, the rank and the state."""
        off = "off" if self.attached else "merged" if self._merged else "detached"
        strength = "" if self.strength == 1 else f", strength {self.strength:g}"
        return f"Adapter({self.model.spec.name}, rank {self.lora_config.r}, {'on' if self.is_on else off}{strength})"

    @property
    def attached(self) -> bool:
        """Whether the adapter's layers are in its model, on or off."""
        name, layer = next(iter(self.layers.items()))
        return self.model.get_submodule(name) is layer

    @property
    def is_on(self) -> bool:
        """Whether the model computes with the adapter."""
        return self.attached and not next(iter(self.layers.values())).disable_adapters

    @property
    def _merged(self) -> bool:
        return next(iter(self.layers.values())).merged

    @classmethod
    def attach(
        cls,
        model: ReconstructionModel,
        *,
        rank: int,
        alpha: int,
        dropout: float,
        generator: torch.Generator,
        targets: Sequence[str] | None = None,
        process_res: int | None = None,
    ) -> Adapter:
        """Put a fresh adapter on a model (all of `adapter_targets` unless `targets` are given).

        A is drawn from U(+-1/sqrt(fan_in)) with `generator`. `process_res` is the longest side of the images that it is
        trained on, where that is known. UserError when the model already has an adapter or a
        target is not one of its linear layers.
        """
        from peft import LoraConfig, inject_adapter_in_model
        from peft.tuners.lora import LoraLayer

        part = model.adaptable()
        _require_none(part)
        wanted = sorted(part.adapter_targets() if targets is None else targets)
        modules = dict(part.named_modules())
        unmatched = [name for name in wanted if not isinstance(modules.get(name), nn.Linear)]
        if unmatched:
            raise UserError(
                f"{len(unmatched)} of {len(wanted)} adapter targets are no linear layers of {part.spec.name} "
                f"(first: {unmatched[0]}). The adapter belongs to another model."
            )
        config = LoraConfig(
            r=rank, lora_alpha=alpha, lora_dropout=dropout, target_modules=list(wanted), bias="none",
            exclude_modules=_same_endings(modules, wanted) or None,
        )  # fmt: skip
        # peft initialises the new layers from the global generator, whose state must not change.
        with torch.random.fork_rng(devices=[]):
            inject_adapter_in_model(config, part, adapter_name=ADAPTER_NAME)
        layers = {name: cast(LoraLayer, part.get_submodule(name)) for name in wanted}
        on_cpu = next(part.parameters()).device.type == "cpu"
        for layer in layers.values():
            _draw_start(layer, generator)
            if dropout and on_cpu:
                layer.lora_dropout[ADAPTER_NAME] = PackedDropout(dropout)
        config.target_modules = wanted
        return cls(part, config, layers, process_res)

    def named_parameters(self) -> dict[str, nn.Parameter]:
        """Return everything that is trained, by name: `<module>.lora_A.weight`, `.lora_B.weight`, `camera_token`."""
        named = {
            f"{name}.{matrix}.weight": weight
            for name, layer in self.layers.items()
            for matrix, weight in zip(("lora_A", "lora_B"), _matrices(layer), strict=True)
        }
        return named if self.camera_token is None else {**named, "camera_token": self.camera_token}

    def parameters(self) -> list[nn.Parameter]:
        """Return the trained parameters in a fixed order."""
        return list(self.named_parameters().values())

    @torch.no_grad()
    def load(self, tensors: dict[str, Tensor]) -> None:
        """Copy trained values in, by the names of `named_parameters`; a missing camera token keeps the model's own."""
        for name, parameter in self.named_parameters().items():
            if name in tensors:
                parameter.copy_(tensors[name])
            elif name != "camera_token":
                raise KeyError(name)
        self.set_strength(self.strength)

    @contextmanager
    def off(self) -> Generator[None]:
        """Run the frozen model inside the block (LoRA bypassed, original camera token), then restore the state."""
        with self._switched(False):
            yield

    @contextmanager
    def applied(self) -> Generator[None]:
        """Run the adapted model inside the block, even if the adapter is off or detached, then restore the state.

        UserError as in `reattach`.
        """
        if self.attached:
            with self._switched(True):
                yield
            return
        self.reattach()
        try:
            yield
        finally:
            self.detach()

    @contextmanager
    def _switched(self, on: bool) -> Generator[None]:
        before, flags = self.is_on, self._flags()
        if self.attached:
            self._switch(on)
        try:
            yield
        finally:
            if self.attached:
                self._switch(before, flags)

    def set_strength(self, strength: float) -> None:
        """Interpolate between the frozen model (0) and the adapted one (1), LoRA and camera token together."""
        self.strength = strength
        for name, layer in self.layers.items():
            layer.scaling[ADAPTER_NAME] = self._scaling[name] * strength
        self._token = self.camera_token
        if self.camera_token is not None and self._base_token is not None and strength != 1:
            mixed = self._base_token.detach().lerp(self.camera_token.detach().to(self._base_token), strength)
            self._token = nn.Parameter(mixed, requires_grad=False)
        if self.is_on:
            self._install_token(self._token)

    @torch.no_grad()
    def settle(self) -> None:
        """Make the present strength the adapter's own: its values change, its effect does not, its strength is 1."""
        for layer in self.layers.values():
            _matrices(layer)[1].mul_(self.strength)
        if self.camera_token is not None and self._token is not None:
            self.camera_token.copy_(self._token)
        self.set_strength(1.0)

    def merge(self) -> ReconstructionModel:
        """Add the adapter (at its strength) to the weights and return the plain model; it cannot be used again."""
        self.reattach()
        for layer in self.layers.values():
            layer.merge(safe_merge=True)
        self._remove_layers()
        if self._token is not None:
            self._install_token(nn.Parameter(self._token.detach().clone(), requires_grad=False))
        return self.model

    def detach(self) -> ReconstructionModel:
        """Take the adapter out, if it is attached, and return the model as it was."""
        if self.attached:
            self._remove_layers()
            self._install_token(self._base_token)
        return self.model

    def reattach(self) -> None:
        """Put the adapter back on its model after `detach` and switch it on; no effect while it is attached.

        UserError when another adapter is in place, or when this one was merged.
        """
        if self.attached:
            return
        if self._merged:
            raise UserError("this adapter was merged into its model, so it cannot be used again; load it once more.")
        _require_none(self.model)
        for name, layer in self.layers.items():
            for matrix in _matrices(layer):
                # The model may have been moved to another device since `detach`.
                matrix.data = matrix.data.to(cast(nn.Linear, layer.base_layer).weight.device)
            self._put(name, cast(nn.Module, layer))
        self.model.peft_config = self._peft_config
        self.model.adapted_at = self.process_res
        self._switch(True, self._flags())

    def _remove_layers(self) -> None:
        for name, layer in self.layers.items():
            self._put(name, layer.base_layer)
        # peft stores its configuration on the model; left there, it would cause a warning about a second adapter.
        del self.model.peft_config
        self.model.adapted_at = None

    def _put(self, name: str, module: nn.Module) -> None:
        owner, _, leaf = name.rpartition(".")
        setattr(self.model.get_submodule(owner), leaf, module)

    def _flags(self) -> list[bool]:
        return [parameter.requires_grad for parameter in self.parameters()]

    def _switch(self, on: bool, flags: Sequence[bool] = ()) -> None:
        """Turn an attached adapter on or off, then set `requires_grad` of its parameters to `flags`."""
        for layer in self.layers.values():
            layer.enable_adapters(on)
        # peft clears and sets requires_grad when it switches adapters.
        for parameter, flag in zip(self.parameters(), flags, strict=False):
            parameter.requires_grad_(flag)
        self._install_token(self._token if on else self._base_token)

    def _install_token(self, token: nn.Parameter | None) -> None:
        if token is None or self.model.camera_token_name is None:
            return
        owner, _, leaf = self.model.camera_token_name.rpartition(".")
        parameters = self.model.get_submodule(owner)._parameters
        # Moving the model moves only the token that is installed, so this one may be on another device.
        token.data = token.data.to(parameters[leaf])
        parameters[leaf] = token


def _require_none(model: nn.Module) -> None:
    """Raise UserError when a model already carries an adapter, on or off."""
    if any(hasattr(module, "disable_adapters") for module in model.modules()):
        raise UserError("the model already carries an adapter; detach it first.")


def _same_endings(modules: Iterable[str], wanted: Sequence[str]) -> list[str]:
    """Return the other modules that peft would take for targets: it matches by the end of a name."""
    endings = tuple(f".{name}" for name in wanted)
    return [name for name in modules if name.endswith(endings) and name not in set(wanted)]


def _matrices(layer: LoraLayer) -> tuple[nn.Parameter, nn.Parameter]:
    a, b = (cast(nn.Linear, matrix[ADAPTER_NAME]) for matrix in (layer.lora_A, layer.lora_B))
    return cast(nn.Parameter, a.weight), cast(nn.Parameter, b.weight)


@torch.no_grad()
def _draw_start(layer: LoraLayer, generator: torch.Generator) -> None:
    a, b = _matrices(layer)
    bound = 1 / math.sqrt(a.shape[1])
    a.copy_(torch.rand(a.shape, generator=generator) * 2 * bound - bound)
    b.zero_()
