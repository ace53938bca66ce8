"""What the loss reads of the teacher."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from freegeo.adaptation.losses.sampling import StepDraws, TokenDraw, search_anchors
from freegeo.adaptation.recipe import LossConfig
from freegeo.errors import UserError

Level = tuple[Tensor, Tensor]
"""Features of one layer: patches (B, S, P, C) and special tokens (B, S, T, C), the camera token first."""


@dataclass(frozen=True, kw_only=True)
class AnchorFeatures:
    """Teacher features (B, R, K, C) of the anchors of one `StepDraws`; one object where the terms share a draw."""

    angle: Tensor
    distance: Tensor


@dataclass(frozen=True, kw_only=True)
class TeacherTargets:
    """The teacher's side of the loss for one view set and one draw; no tensor carries a gradient."""

    kept: Mapping[int, Level]
    """The teacher's features of the kept views, per loss layer."""
    anchors: AnchorFeatures


def intra_special(config: LossConfig, special: Tensor) -> Tensor:
    """The special tokens (..., T', C) that enter the intra loss: none, the camera token, or all."""
    return special[..., : {"patches": 0, "camera+patches": 1, "all": special.shape[-2]}[config.intra_tokens], :]


def cross_tokens(config: LossConfig, level: Level) -> Tensor:
    """The tokens (B, S, T + P, C) or (B, S, P, C) of a layer that triplets are drawn from."""
    patch, special = level
    return torch.cat([special, patch], dim=-2) if config.cross_tokens == "all" else patch


def held_out_tokens(level: Level, kept: Sequence[int], config: LossConfig) -> Tensor:
    """The tokens (B, L, C) that anchors are chosen from: those of the views that the student does not see.

    level: the teacher's features of the cross layer, all N views; kept: the student's views among them. UserError
    where the student sees every view.
    """
    tokens = cross_tokens(config, level)
    views = [view for view in range(tokens.shape[1]) if view not in set(kept)]
    if not views:
        raise UserError("The student keeps every view of the teacher; hold out at least one for the anchors.")
    return tokens[:, views].flatten(1, 2)


def anchor_positions(kept: Level, held_out: Tensor, draw: TokenDraw, config: LossConfig) -> Tensor:
    """Positions (B, R, K) of a draw's anchors among the held-out tokens (B, L, C), as drawn or found by similarity.

    kept: the teacher's features of the kept views at the cross layer.
    """
    if draw.anchor is not None:
        return draw.anchor.to(held_out.device).expand(len(held_out), -1, -1)
    reference = cross_tokens(config, kept)[:, config.reference_view, draw.reference.to(held_out.device)]
    return search_anchors(reference, held_out, num_anchors=config.num_anchors, selection=config.selection)


@torch.no_grad()
def teacher_targets(
    kept: Mapping[int, Level], held_out: Tensor, draws: StepDraws, config: LossConfig
) -> TeacherTargets:
    """Choose the anchors of a step's draws.

    kept: per loss layer the teacher's features of the kept views, the highest layer number being the cross layer;
    held_out: what `held_out_tokens` returned. UserError where there are fewer held-out tokens than anchors.
    """

    def chosen(draw: TokenDraw) -> Tensor:
        positions = anchor_positions(kept[max(kept)], held_out, draw, config)
        batch = torch.arange(len(held_out), device=held_out.device)[:, None, None]
        return held_out[batch, positions]

    angle = chosen(draws.angle)
    return TeacherTargets(
        kept=kept, anchors=AnchorFeatures(angle=angle, distance=angle if draws.shared else chosen(draws.distance))
    )
