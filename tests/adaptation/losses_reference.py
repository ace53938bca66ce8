"""The relational and intra losses written down from the equations: explicit differences, one triplet axis each."""

import torch
from torch import Tensor

from freegeo.adaptation.losses import LossConfig


def huber(x: Tensor, delta: float) -> Tensor:
    return torch.where(x.abs() <= delta, x.square() / 2, delta * (x.abs() - delta / 2))


def cosine(a: Tensor, b: Tensor) -> Tensor:
    """Cosine over the last axis; a zero vector gives 0 and takes no gradient."""
    lengths = [torch.where((x == 0).all(-1), torch.inf, x.square().sum(-1)).sqrt() for x in (a, b)]
    return (a * b).sum(-1) / lengths[0] / lengths[1]


def angle_means(
    student: tuple[Tensor, Tensor], teacher: tuple[Tensor, Tensor], k: Tensor, delta: float | None
) -> Tensor:
    """Mean penalties (3,) of p (B, R, C), q (B, m, C), k (B, R, K, C) at p, k and q; delta None is L1."""
    found, wanted = (
        [cosine(q - p, k - p), cosine(p - k, q - k), cosine(p - q, k - q)]
        for p, q, k in ((p[:, :, None, None], q[:, None, None], k[:, :, :, None]) for p, q in (student, teacher))
    )
    penalties = [f - w for f, w in zip(found, wanted, strict=True)]
    return torch.stack([(d.abs() if delta is None else huber(d, delta)).mean() for d in penalties])


def divergence(student: Tensor, teacher: Tensor, temperature: float) -> Tensor:
    """KL(softmax(teacher / tau) || softmax(student / tau)) over the last axis."""
    found, wanted = (torch.log_softmax(d / temperature, dim=-1) for d in (student, teacher))
    return (wanted.exp() * (wanted - found)).sum(-1)


def intra(student: Tensor, teacher: Tensor, config: LossConfig) -> Tensor:
    """Weighted intra loss of tokens (..., C)."""
    difference = huber(student - teacher, config.huber_delta).mean()
    return config.weight_huber * difference + config.weight_cosine * (1 - cosine(student, teacher)).mean()


def paper_total(
    student: Tensor, teacher: Tensor, kept: list[int], draws, config: LossConfig, anchors: Tensor
) -> Tensor:
    """The paper's total for one layer of patch tokens; student (B, M, P, C), anchors (B, R, K, C)."""
    kept_teacher = teacher[:, kept]
    others = [view for view in range(len(kept)) if view != config.reference_view]
    pairs = []
    for tokens in (student, kept_teacher):
        p = tokens[:, config.reference_view, draws.angle.reference]
        pairs.append((p, tokens[:, others].flatten(1, 2)[:, draws.angle.query.flatten()]))
    (p, q), (tp, tq) = pairs
    phi = angle_means((p, q), (tp, tq), anchors, None).sum()
    k = anchors.flatten(1, 2)[:, :, None]
    kl_pk = divergence(p[:, :, None] - anchors, tp[:, :, None] - anchors, config.temperature).mean()
    kl_pq = divergence(p[:, :, None] - q[:, None], tp[:, :, None] - tq[:, None], config.temperature).mean()
    kl_kq = divergence(k - q[:, None], k - tq[:, None], config.temperature).mean()
    return intra(student, kept_teacher, config) + phi + kl_pk + kl_pq + kl_kq
