"""Which tokens take part: those of the intra loss, random references and queries, anchors by similarity.

Draws are separate from the loss: they can be made in advance from the seed of a run or replaced by recorded indices.
One draw is shared by the samples of a batch (docs/method.md, "Token draws").
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from freegeo.adaptation.losses.numerics import blocks, exact_matmul, sent, widened
from freegeo.adaptation.recipe import LossConfig, Selection
from freegeo.errors import UserError

Level = tuple[Tensor, Tensor]
"""Features of one layer: patches (B, S, P, C) and special tokens (B, S, T, C), the camera token first."""
SIMILARITY_ELEMENTS = 1 << 24  # one block of the similarity matrix: 64 MB in float32


def intra_special(config: LossConfig, special: Tensor) -> Tensor:
    """The special tokens (..., T', C) that enter the intra loss: none, the camera token, or all."""
    return special[..., : {"patches": 0, "camera+patches": 1, "all": special.shape[-2]}[config.intra_tokens], :]


def cross_tokens(config: LossConfig, level: Level) -> Tensor:
    """The tokens (B, S, T + P, C) or (B, S, P, C) of a layer that triplets are drawn from."""
    patch, special = level
    return torch.cat([special, patch], dim=-2) if config.cross_tokens == "all" else patch


def held_out_tokens(level: Level, kept: Sequence[int], config: LossConfig, *, patches: Tensor | None = None) -> Tensor:
    """The tokens (B, L, C) that anchors are chosen from: those of the views that the student does not see.

    level: the teacher's features of the cross layer, all N views; kept: the student's views among them; patches (N, P)
    bool: those that show a photo, None: all.
    """
    tokens = cross_tokens(config, level)
    views = [view for view in range(tokens.shape[1]) if view not in set(kept)]
    held_out = tokens[:, views].flatten(1, 2)
    if patches is None:
        return held_out
    return held_out.index_select(1, positions_of(_cross_mask(patches[views], tokens.shape[2]), held_out.device))


def positions_of(mask: Tensor, device: torch.device) -> Tensor:
    """Flat positions (n,) of the true values of a mask on the CPU."""
    return sent(mask.flatten().nonzero()[:, 0], device)


def _cross_mask(patches: Tensor, tokens_per_view: int) -> Tensor:
    """Extend a mask of patches (S, P) to the tokens (S, T) of `cross_tokens`: special tokens always take part."""
    return F.pad(patches, (tokens_per_view - patches.shape[1], 0), value=True)


@dataclass(frozen=True, kw_only=True)
class TokenDraw:
    """Token positions of one draw; T is the number of tokens per view that the draw chose from."""

    reference: Tensor
    """(R,) int64: positions 0..T-1 in the reference view."""
    query: Tensor
    """(G, Q) int64: positions in the concatenation of the student's other views (ascending, T tokens each). G is 1
    for pooled queries; else one row per view. Paired terms join reference i with column i of every row."""
    anchor: Tensor | None = None
    """(R, K) or (B, R, K) int64: positions in the concatenation of the held-out views (ascending, T tokens each).
    None: the anchors are found by similarity."""


@dataclass(frozen=True, kw_only=True)
class StepDraws:
    """The draws of one training step; both fields are the same object where the terms share one draw."""

    angle: TokenDraw
    distance: TokenDraw

    @property
    def shared(self) -> bool:
        """Whether the angle terms and the distance terms use one draw."""
        return self.angle is self.distance


def draw_tokens(
    config: LossConfig,
    *,
    tokens_per_view: int,
    student_views: int,
    held_out: int,
    generator: torch.Generator,
    patches: Tensor | None = None,
    device: torch.device | str = "cpu",
) -> StepDraws:
    """Draw the references and queries of one step on the CPU, and send them to `device`.

    tokens_per_view: tokens that `config.cross_tokens` lets take part (patches, or special tokens and patches).
    Where there are fewer tokens than asked for, all are drawn. held_out: number of tokens of `held_out_tokens`.
    `patches` (M, P) bool, on the CPU, are those of the student's views that show a photo; only these are drawn. None:
    all. The generator is read in this order: references, queries and, for random selection, anchors of the angle draw;
    then the same for a separate distance draw. Raises `UserError` where the views cannot form a triplet.
    """
    if not 0 <= config.reference_view < student_views:
        raise UserError(
            f"Loss setting reference_view is {config.reference_view}, but the student sees {student_views} views; "
            "choose a view that it sees."
        )
    if patches is None:
        seen = torch.ones(student_views, tokens_per_view, dtype=torch.bool)
    else:
        seen = _cross_mask(patches, tokens_per_view)
    angle = distance = _draw(config, seen, held_out, generator, device)
    if config.separate_draws:
        distance = _draw(config, seen, held_out, generator, device)
    return StepDraws(angle=angle, distance=distance)


def _draw(
    config: LossConfig, seen: Tensor, held_out: int, generator: torch.Generator, device: torch.device | str
) -> TokenDraw:
    """Draw among the tokens (M, T) that are seen, and from `held_out` tokens of the other views."""
    others = torch.cat([seen[: config.reference_view], seen[config.reference_view + 1 :]])
    reference = _some(seen[config.reference_view], config.num_reference, generator)
    if config.queries == "pooled":
        query = _some(others.flatten(), config.num_query, generator)[None]
    else:
        # The same positions in every view, so only what all of them show.
        query = _some(others.all(0), config.num_query, generator) + seen.shape[1] * torch.arange(len(others))[:, None]
    if not (reference.numel() and query.numel() and held_out):
        raise UserError("The photos of a view set show no patch in common: all is padding. Adapt with --mixed crop.")
    anchor = None
    if config.selection == "random":
        anchor = sent(torch.randint(held_out, (len(reference), config.num_anchors), generator=generator), device)
    return TokenDraw(reference=sent(reference, device), query=sent(query, device), anchor=anchor)


def _some(seen: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draw up to `count` different positions of the true values of a mask (n,)."""
    positions = seen.nonzero()[:, 0]
    return positions[torch.randperm(len(positions), generator=generator)[:count]]


@torch.no_grad()
def search_anchors(reference: Tensor, held_out: Tensor, *, num_anchors: int, selection: Selection) -> Tensor:
    """Positions (B, R, K) of the anchors among the held-out tokens, by cosine similarity of teacher features.

    reference: (B, R, C); held_out: (B, L, C), the held-out views one after another. `topk`: the K most similar,
    best first; `mixed`: the K//2 most similar, best first, then the K - K//2 least similar, worst first
    (docs/method.md, "Anchors"); the anchors of `random` belong to the draw. `UserError` where there are fewer than K
    tokens.
    """
    if held_out.shape[1] < num_anchors:
        raise UserError(
            f"The held-out views have {held_out.shape[1]} tokens, fewer than the {num_anchors} anchors per reference; "
            "lower num_anchors or use larger images."
        )
    most = num_anchors // 2 if selection == "mixed" else num_anchors
    directions = F.normalize(widened(held_out), dim=-1).mT
    reference = F.normalize(widened(reference), dim=-1)
    chosen = []
    with exact_matmul(reference):
        for part in blocks(reference.shape[1], SIMILARITY_ELEMENTS // (len(held_out) * held_out.shape[1])):
            similarity = reference[:, part] @ directions
            nearest = similarity.topk(most, dim=-1).indices
            farthest = similarity.topk(num_anchors - most, dim=-1, largest=False).indices
            chosen.append(torch.cat([nearest, farthest], dim=-1))
    return torch.cat(chosen, dim=1)


def anchor_positions(kept: Level, held_out: Tensor, draw: TokenDraw, config: LossConfig) -> Tensor:
    """Positions (B, R, K) of a draw's anchors among the held-out tokens (B, L, C), as drawn or found by similarity.

    kept: the teacher's features of the kept views at the cross layer. UserError where there are fewer held-out tokens
    than anchors.
    """
    if draw.anchor is not None:
        return draw.anchor.expand(len(held_out), -1, -1)
    reference = cross_tokens(config, kept)[:, config.reference_view, draw.reference]
    return search_anchors(reference, held_out, num_anchors=config.num_anchors, selection=config.selection)


@torch.no_grad()
def anchor_tokens(kept: Level, held_out: Tensor, draws: StepDraws, config: LossConfig) -> tuple[Tensor, Tensor]:
    """The anchors (B, R, K, C) of the angle draw and of the distance draw; one tensor where the terms share a draw."""
    batch = torch.arange(len(held_out), device=held_out.device)[:, None, None]
    angle = held_out[batch, anchor_positions(kept, held_out, draws.angle, config)]
    if draws.shared:
        return angle, angle
    return angle, held_out[batch, anchor_positions(kept, held_out, draws.distance, config)]
