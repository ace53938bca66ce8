"""Choice of the reference view, whose frame the others are predicted in (docs/models/da3.md, "Reference view")."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from freegeo.errors import UserError
from freegeo.models.spec import NO_REFERENCE

SMALLEST_SELECTION = 3
"""With fewer views than this the first one is the reference, whatever the rule."""


def _similarity(unit_BSD: Tensor) -> Tensor:
    return unit_BSD @ unit_BSD.transpose(1, 2) - torch.eye(unit_BSD.shape[1], device=unit_BSD.device)


def _min_max(metric_BS: Tensor) -> Tensor:
    low, high = metric_BS.amin(1, keepdim=True), metric_BS.amax(1, keepdim=True)
    return (metric_BS - low) / (high - low + 1e-8)


def saddle_balanced(token_BSD: Tensor) -> Tensor:
    """Return, for every scene, the view whose similarity, norm and spread lie closest to the middle of their ranges."""
    norm_BS = token_BSD.norm(dim=-1)
    unit_BSD = token_BSD / norm_BS[..., None]
    similarity_BS = _similarity(unit_BSD).sum(-1) / (token_BSD.shape[1] - 1)
    metrics = (similarity_BS, norm_BS, unit_BSD.var(dim=-1))
    by_similarity, by_norm, by_spread = ((_min_max(m) - 0.5).abs() for m in metrics)
    return (by_similarity + by_norm + by_spread).argmin(1)


def saddle_sim_range(token_BSD: Tensor) -> Tensor:
    """Return, for every scene, the view with the widest range of similarities; the most similar pair may tie."""
    similarity_BSS = _similarity(token_BSD / token_BSD.norm(dim=-1, keepdim=True))
    return (similarity_BSS.amax(-1) - similarity_BSS.amin(-1)).argmax(1)


def first(token_BSD: Tensor) -> Tensor:
    """Return view 0 for every scene, (B,) int64."""
    return torch.zeros(len(token_BSD), dtype=torch.long, device=token_BSD.device)


def middle(token_BSD: Tensor) -> Tensor:
    """Return view S // 2 for every scene, (B,) int64."""
    return torch.full_like(first(token_BSD), token_BSD.shape[1] // 2)


RULES: dict[str, Callable[[Tensor], Tensor]] = {
    "first": first,
    "middle": middle,
    "saddle_balanced": saddle_balanced,
    "saddle_sim_range": saddle_sim_range,
}


def require_rule(rule: str) -> None:
    """Raise UserError when there is no such rule."""
    if rule not in RULES:
        raise UserError(f"unknown reference-view rule '{rule}': choose one of {', '.join(RULES)}.")


def require_no_choice(rule: str, model: str) -> None:
    """Raise UserError when a rule asks a model without reference view, or with the first one, for another view."""
    if rule not in ("first", NO_REFERENCE):
        raise UserError(f"{model} treats all views alike, so there is no reference view to choose. Leave '{rule}' out.")


def view_order(token_BSD: Tensor, rule: str) -> Tensor | None:
    """Return the views (B, S) with the chosen one first and the others in input order; None for the input order."""
    require_rule(rule)
    views = token_BSD.shape[1]
    if rule == "first" or views < SMALLEST_SELECTION:
        return None
    # Views are alike to the third digit, which a half type would round away.
    with torch.autocast(token_BSD.device.type, enabled=False):
        chosen_B1 = RULES[rule](token_BSD.float())[:, None]
    # A stable sort by "is not the chosen one" keeps the others in input order.
    return (torch.arange(views, device=token_BSD.device) != chosen_B1).to(torch.uint8).argsort(dim=1, stable=True)


def take_views(x: Tensor, order_BS: Tensor) -> Tensor:
    """Put the views of x (B, S, ...) in the given order, for each batch entry."""
    return x[torch.arange(len(x), device=x.device)[:, None], order_BS]
