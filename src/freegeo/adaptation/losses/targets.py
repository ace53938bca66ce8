"""What the loss reads of the teacher, and nothing else, so that keeping it for many view sets stays affordable."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

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
    """The teacher's side of the loss for one view set and one draw; no tensor carries a gradient.

    For another draw of the same view set: `dataclasses.replace(targets, anchors=anchor_features(...))`.
    """

    kept: Mapping[int, Level]
    """Per loss layer the kept views: patches (B, M, P, C), and those special tokens (B, M, T', C) that enter a loss."""
    anchors: AnchorFeatures

    def tensors(self) -> dict[str, Tensor]:
        """Contiguous tensors by name, for a file or a cache: none shares memory with the full teacher features."""
        found = {"anchors.angle": self.anchors.angle}
        if self.anchors.distance is not self.anchors.angle:
            found["anchors.distance"] = self.anchors.distance
        for layer, (patch, special) in self.kept.items():
            found[f"kept.{layer}.patch"] = patch
            found[f"kept.{layer}.special"] = special
        return {name: tensor.clone(memory_format=torch.contiguous_format) for name, tensor in found.items()}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> "TeacherTargets":
        """The inverse of `tensors`."""
        angle = tensors["anchors.angle"]
        layers = sorted(int(name.split(".")[1]) for name in tensors if name.endswith(".patch"))
        return cls(
            kept={layer: (tensors[f"kept.{layer}.patch"], tensors[f"kept.{layer}.special"]) for layer in layers},
            anchors=AnchorFeatures(angle=angle, distance=tensors.get("anchors.distance", angle)),
        )

    def to(self, device: torch.device | str, *, non_blocking: bool = False) -> "TeacherTargets":
        """The same targets on another device."""
        moved = {
            layer: (patch.to(device, non_blocking=non_blocking), special.to(device, non_blocking=non_blocking))
            for layer, (patch, special) in self.kept.items()
        }
        angle = self.anchors.angle.to(device, non_blocking=non_blocking)
        shared = self.anchors.distance is self.anchors.angle
        distance = angle if shared else self.anchors.distance.to(device, non_blocking=non_blocking)
        return TeacherTargets(kept=moved, anchors=AnchorFeatures(angle=angle, distance=distance))


def intra_special(config: LossConfig, special: Tensor) -> Tensor:
    """The special tokens (..., T', C) that enter the intra loss: none, the camera token, or all."""
    return special[..., : {"patches": 0, "camera+patches": 1, "all": special.shape[-2]}[config.intra_tokens], :]


def cross_tokens(config: LossConfig, level: Level) -> Tensor:
    """The tokens (B, S, T + P, C) or (B, S, P, C) of a layer that triplets are drawn from."""
    patch, special = level
    return torch.cat([special, patch], dim=-2) if config.cross_tokens == "all" else patch


def _needed_special(config: LossConfig, special: Tensor) -> Tensor:
    return special if config.cross_tokens == "all" else intra_special(config, special)


def _select_views(tensor: Tensor, views: Sequence[int]) -> Tensor:
    """`tensor[:, views]`, as a view of the same memory where the positions are evenly spaced and ascending."""
    steps = {later - earlier for earlier, later in pairwise(views)} or {1}
    if len(steps) == 1 and (step := steps.pop()) > 0:
        return tensor[:, views[0] : views[-1] + 1 : step]
    return tensor[:, list(views)]


def _gather(tokens: Tensor, positions: Tensor) -> Tensor:
    """Tokens (B, R, K, C) of the flat list (B, L, C) at positions (R, K) or (B, R, K)."""
    positions = positions.expand(len(tokens), -1, -1)
    batch = torch.arange(len(tokens), device=tokens.device)[:, None, None]
    return tokens[batch, positions]


def anchor_positions(teacher_level: Level, kept_indices: Sequence[int], draw: TokenDraw, config: LossConfig) -> Tensor:
    """Positions (B, R, K) of a draw's anchors in the concatenated held-out views, as drawn or found by similarity.

    teacher_level: the teacher's features of the cross layer, all N views; kept_indices: which of them the student sees.
    """
    tokens = cross_tokens(config, teacher_level)
    if draw.anchor is not None:
        return draw.anchor.to(tokens.device).expand(len(tokens), -1, -1)
    reference = tokens[:, kept_indices[config.reference_view], draw.reference.to(tokens.device)]
    return search_anchors(
        reference,
        _held_out(tokens, kept_indices),
        num_anchors=config.num_anchors,
        selection=config.selection,
    )


def _held_out(tokens: Tensor, kept_indices: Sequence[int]) -> Tensor:
    views = [view for view in range(tokens.shape[1]) if view not in set(kept_indices)]
    if not views:
        raise UserError("The student keeps every view of the teacher; hold out at least one for the anchors.")
    return _select_views(tokens, views).flatten(1, 2)


@torch.no_grad()
def anchor_features(
    teacher_level: Level, kept_indices: Sequence[int], draws: StepDraws, config: LossConfig
) -> AnchorFeatures:
    """Find and gather the anchors of one step's draws from the teacher's features of the cross layer (all N views)."""
    held_out = _held_out(cross_tokens(config, teacher_level), kept_indices)
    angle = _gather(held_out, anchor_positions(teacher_level, kept_indices, draws.angle, config))
    if draws.shared:
        return AnchorFeatures(angle=angle, distance=angle)
    positions = anchor_positions(teacher_level, kept_indices, draws.distance, config)
    return AnchorFeatures(angle=angle, distance=_gather(held_out, positions))


@torch.no_grad()
def teacher_targets(
    teacher_levels: Mapping[int, Level], kept_indices: Sequence[int], draws: StepDraws, config: LossConfig
) -> TeacherTargets:
    """Reduce the teacher's features to what the loss reads.

    teacher_levels: per loss layer the features of all N views; the highest layer number is the cross layer.
    kept_indices: the student's views, in its order. Evenly spaced kept views are taken without a copy, so the
    result keeps the teacher's features alive; `tensors()` gives compact copies.
    Raises `UserError` where no view is held out or the held-out views have fewer tokens than anchors are wanted.
    """
    kept = {
        layer: (
            _select_views(patch, kept_indices).detach(),
            _select_views(_needed_special(config, special), kept_indices).detach(),
        )
        for layer, (patch, special) in teacher_levels.items()
    }
    return TeacherTargets(
        kept=kept, anchors=anchor_features(teacher_levels[max(teacher_levels)], kept_indices, draws, config)
    )
