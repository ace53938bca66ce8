"""The adaptation loss: intra + angles + distances, on the features of teacher and student.

`equations` states the same loss as the paper does. A new term is computed here, from the tokens p, q and k, and has
its weight in `LossConfig`.
"""

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor

from freegeo.adaptation.losses.angles import angle_loss
from freegeo.adaptation.losses.divergence import KLForm, all_pairs_divergence, pair_spread, paired_divergence
from freegeo.adaptation.losses.intra import intra_loss
from freegeo.adaptation.losses.numerics import widened
from freegeo.adaptation.losses.sampling import (
    Level,
    StepDraws,
    TokenDraw,
    anchor_tokens,
    cross_tokens,
    intra_special,
    positions_of,
)
from freegeo.adaptation.recipe import LossConfig


def adaptation_loss(
    student_levels: Mapping[int, Level],
    teacher_levels: Mapping[int, Level],
    held_out: Tensor,
    draws: StepDraws,
    config: LossConfig,
    *,
    form: KLForm | None = None,
    patches: Tensor | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """The total loss of one step (scalar, float32 or wider) and its detached terms.

    Args:
        student_levels: per loss layer the patches (B, M, P, C) and special tokens (B, M, T, C) of the kept views. The
            intra loss is the mean over layers, the relational loss uses the highest layer number.
        teacher_levels: the same of the teacher, which saw all views; no gradient goes there.
        held_out: (B, L, C), what `held_out_tokens` returned for the highest layer: the tokens that anchors come from.
        draws: token positions, on the features' device.
        config: which version of the loss.
        form: see `all_pairs_divergence`; only `pairing` "all" uses it, and None costs a transfer to the host per term.
        patches: (M, P) bool, on the CPU: patches of the kept views that the intra loss compares; None: all.

    Terms: `total`; `intra` (weighted) and its unweighted parts `huber` and `cos` (mean of 1 - cosine); `cross`
    (weighted); unweighted `phi1`, `phi2`, `phi3` (angles at reference, anchor, query) and `phi` (weighted sum);
    unweighted `kl_pk`, `kl_pq`, `kl_kq`. Terms of weight 0 are absent. Source: docs/method.md, "Equations of the
    paper" and "Paper and released code".
    """
    total, terms = feature_distance(student_levels, teacher_levels, config, patches=patches)
    cross: list[Tensor] = []
    if config.uses_angles or config.uses_distances:
        layer = max(student_levels)
        student_draws, teacher_draws = (
            _gather_draws(cross_tokens(config, levels[layer]), draws, config)
            for levels in (student_levels, teacher_levels)
        )
        angle_anchors, distance_anchors = anchor_tokens(teacher_levels[layer], held_out, draws, config)
        if config.uses_angles:
            p_and_q = (_pooled(student_draws[0]), _pooled(teacher_draws[0]))
            phi, parts = angle_loss(
                *p_and_q,
                angle_anchors,
                weights=config.angle_weights,
                penalty=config.angle_penalty,
                huber_delta=config.angle_huber_delta,
            )
            cross.append(phi)
            terms |= {"phi1": parts[0], "phi2": parts[1], "phi3": parts[2], "phi": phi}
        distances = _distances(student_draws[1], teacher_draws[1], distance_anchors, config, form)
        for name, (weight, value) in distances.items():
            cross.append(weight * value)
            terms[name] = value
        terms["cross"] = torch.stack(cross).sum()
        total = total + terms["cross"]
    terms["total"] = total
    return total, {name: term.detach() for name, term in terms.items()}


def feature_distance(
    student_levels: Mapping[int, Level],
    teacher_levels: Mapping[int, Level],
    config: LossConfig,
    *,
    patches: Tensor | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """The intra loss of features against the teacher's of the same views, mean over layers, and its parts as above.

    `patches` (views, P) bool, on the CPU: those that show a photo and are compared; None: all.
    """
    per_layer = []
    for layer, (patch, special) in student_levels.items():
        teacher_patch, teacher_special = teacher_levels[layer]
        if patches is not None:
            chosen = positions_of(patches, patch.device)
            patch, teacher_patch = (t.flatten(1, 2).index_select(1, chosen)[:, None] for t in (patch, teacher_patch))
        pairs = [(patch, teacher_patch), (intra_special(config, special), intra_special(config, teacher_special))]
        per_layer.append(
            intra_loss(
                pairs,
                weight_huber=config.weight_huber,
                weight_cosine=config.weight_cosine,
                huber_delta=config.huber_delta,
            )
        )
    intra, huber, cosine = (torch.stack(parts).mean() for parts in zip(*per_layer, strict=True))
    return intra, {"intra": intra, "huber": huber, "cos": cosine}


Tokens = tuple[Tensor, Tensor]
"""References p (B, R, C) and queries q (B, G, Q, C) of one draw."""


def _gather_draws(tokens: Tensor, draws: StepDraws, config: LossConfig) -> tuple[Tokens, Tokens]:
    """The references and queries of the angle draw and of the distance draw.

    tokens: (B, M, T, C). Everything is taken by one indexing operation, whose backward pass fills one gradient.
    """
    batch, views, per_view, channels = tokens.shape
    chosen = [draws.angle] if draws.shared else [draws.angle, draws.distance]
    positions = torch.cat([part for draw in chosen for part in _flat_positions(draw, per_view, config)])
    gathered = widened(tokens.reshape(batch, views * per_view, channels).index_select(1, positions))
    sizes = [size for draw in chosen for size in (draw.reference.numel(), draw.query.numel())]
    parts = gathered.split(sizes, dim=1)
    per_draw = [
        (parts[2 * number], parts[2 * number + 1].unflatten(1, draw.query.shape)) for number, draw in enumerate(chosen)
    ]
    return per_draw[0], per_draw[-1]


def _flat_positions(draw: TokenDraw, per_view: int, config: LossConfig) -> tuple[Tensor, Tensor]:
    """Positions of references and queries in the concatenation of all the student's views."""
    query, first = draw.query.flatten(), config.reference_view * per_view
    # Query positions do not count the reference view, so those behind it are shifted by one view.
    return draw.reference + first, torch.where(query < first, query, query + per_view)


def _pooled(tokens: Tokens) -> Tokens:
    return tokens[0], tokens[1].flatten(1, 2)


def _distances(
    student: Tokens, teacher: Tokens, anchors: Tensor, config: LossConfig, form: KLForm | None
) -> dict[str, tuple[float, Tensor]]:
    """Weight and value of the distance terms that have a weight."""
    weights = {"kl_pk": config.weight_pk, "kl_pq": config.weight_pq, "kl_kq": config.weight_kq}
    anchors = widened(anchors)
    values = {}
    for name, weight in weights.items():
        if not weight:
            continue
        if name == "kl_pk" or config.pairing == "paired":
            value = _listed(name, student, teacher, anchors, config)
        else:
            value = _all_pairs(name, student, teacher, anchors, config, form)
        values[name] = (weight, value)
    return values


def _listed(name: str, student: Tokens, teacher: Tokens, anchors: Tensor, config: LossConfig) -> Tensor:
    """Each reference with its own anchors, or the i-th reference (or its anchors) with the i-th query of every row.

    With `pairing` "paired" references beyond the number of queries in a row take part in no term.
    """
    used = min(student[0].shape[1], student[1].shape[2]) if config.pairing == "paired" else None
    k, sign = anchors[:, :used], 1 if config.kq_order == "kq" else -1
    of = {
        "kl_pk": lambda p, q: p[:, :used, None] - k,
        "kl_pq": lambda p, q: p[:, None, :used] - q[:, :, :used],
        "kl_kq": lambda p, q: sign * (k[:, None] - q[:, :, :used, None]),
    }[name]
    found, wanted = of(*student), of(*teacher)
    if config.distance_mode == "huber":
        return F.smooth_l1_loss(found, wanted, beta=config.distance_beta)
    return _outer(paired_divergence(found, wanted, temperature=config.temperature), config).mean()


def _all_pairs(
    name: str, student: Tokens, teacher: Tokens, anchors: Tensor, config: LossConfig, form: KLForm | None
) -> Tensor:
    """Every reference (or every anchor of every reference) with every query."""
    student, teacher = _pooled(student), _pooled(teacher)
    if name == "kl_kq":
        # In the order "qk" q - k is taken as -k - (-q): both branches share the first tokens, which saves a product.
        turned = config.kq_order == "qk"
        k, q, teacher_q = (-t if turned else t for t in (anchors.flatten(1, 2), student[1], teacher[1]))
        student, teacher = (k, q), (k, teacher_q)
    kl = all_pairs_divergence(student, teacher, temperature=config.temperature, form=form)
    return _outer(kl, config).mean()


def _outer(kl: Tensor, config: LossConfig) -> Tensor:
    if config.outer == "none":
        return kl
    return F.smooth_l1_loss(kl, torch.zeros_like(kl), beta=config.outer_beta, reduction="none")


def teacher_spread(kept: Level, held_out: Tensor, draws: StepDraws, config: LossConfig) -> Tensor:
    """The largest spread of the teacher's softmax inputs over the pairs of `pairing` "all", a scalar tensor.

    kept: the teacher's features of the kept views at the cross layer; the rest as in `adaptation_loss`. Passed to
    `choose_form(spread, headroom=...)` once per view set, it saves the transfers to the host of every step.
    """
    p, q = _pooled(_gather_draws(cross_tokens(config, kept), draws, config)[1])
    anchors = widened(anchor_tokens(kept, held_out, draws, config)[1]).flatten(1, 2)
    return torch.stack([pair_spread(x, q, config.temperature) for x in (p, anchors)]).amax()
