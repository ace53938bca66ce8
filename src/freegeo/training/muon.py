"""Muon for the matrices of the blocks: momentum, orthogonalised by Newton-Schulz, scaled to AdamW's step size."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

import torch
from torch import Tensor

_COEFFICIENTS = (
    (8.28721201814563, -23.595886519098837, 17.300387312530933),
    (4.107059111542203, -2.9478499167379106, 0.5448431082926601),
    (3.9486908534822946, -2.908902115962949, 0.5518191394370137),
    (3.3184196573706015, -2.488488024314874, 0.51004894012372),
)
"""The first odd quintics of Polar Express; together they send singular values of (0.004, 1) near one."""
_HEADROOM = 1.02
_RMS = 0.2
"""Root mean square of an AdamW step at the same learning rate, which the update is scaled to."""


def orthogonalise(matrices_KMN: Tensor) -> Tensor:
    """Return nearly semi-orthogonal matrices: the same singular vectors, singular values between 0.4 and 1.6."""
    transposed = matrices_KMN.shape[-2] > matrices_KMN.shape[-1]
    x = matrices_KMN.mT if transposed else matrices_KMN
    x = x / (_HEADROOM * x.norm(dim=(-2, -1), keepdim=True) + 1e-7)
    for a, b, c in _COEFFICIENTS:
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.mT if transposed else x


class Muon(torch.optim.Optimizer):
    """Momentum SGD whose step is orthogonalised per matrix; `qkv` is three matrices, not one."""

    def __init__(self, parameters: Iterable[Tensor], lr: float, momentum: float = 0.95, weight_decay: float = 0.01):
        super().__init__(parameters, {"lr": lr, "momentum": momentum, "weight_decay": weight_decay})
        for group in self.param_groups:
            for parameter in group["params"]:
                self.state[parameter]["momentum"] = torch.zeros_like(parameter)

    @torch.no_grad()
    def step(self, closure=None) -> None:  # ty: ignore[incompatible-method-override]
        """Update all parameters; matrices of one shape are orthogonalised together."""
        for group in self.param_groups:
            parameters = [parameter for parameter in group["params"] if parameter.grad is not None]
            if not parameters:
                continue
            gradients = [parameter.grad for parameter in parameters]
            momenta = [self.state[parameter]["momentum"] for parameter in parameters]
            torch._foreach_lerp_(momenta, gradients, 1 - group["momentum"])
            updates = torch._foreach_lerp(gradients, momenta, group["momentum"])
            torch._foreach_mul_(parameters, 1 - group["lr"] * group["weight_decay"])
            by_shape: dict[tuple[int, ...], list[tuple[Tensor, Tensor]]] = defaultdict(list)
            for parameter, update in zip(parameters, updates, strict=True):
                for target, piece in zip(_square_pieces(parameter), _square_pieces(update), strict=True):
                    by_shape[tuple(piece.shape)].append((target, piece))
            for shape, pairs in by_shape.items():
                steps = orthogonalise(torch.stack([piece for _, piece in pairs]))
                factor = -group["lr"] * _RMS * max(shape) ** 0.5
                torch._foreach_add_([target for target, _ in pairs], list(steps), alpha=factor)


def _square_pieces(matrix: Tensor) -> list[Tensor]:
    rows, columns = matrix.shape
    return list(matrix.split(columns)) if rows == 3 * columns else [matrix]
