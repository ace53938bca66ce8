"""The losses of the paper (arXiv 2604.14048), one function per equation, written as in the paper.

A triplet is a reference token p and a query token q of two kept views and an anchor k of a held-out view, each of C
channels. The teacher has seen all N views, the student only the kept ones; p', q' and f' (here `teacher_p` ...) are
the teacher's tokens, p, q and f the student's, and anchors, of views that the student does not see, are always the
teacher's. The main text states the intra loss (1) and the cross loss (2); the supplement defines what they consist of:

    pi(a, b)     = softmax((a - b) / tau)                                                        over channels
    Phi(a, b, c) = cosines of the triangle's interior angles at a, b and c
    L_intra      = mean over tokens of    Huber(f' - f) + 1 - cos(f', f)
    L_cross      = mean over triplets of  KL(pi(p', k) || pi(p, k)) + KL(pi(p', q') || pi(p, q))
                                          + KL(pi(k, q') || pi(k, q)) + ||Phi(p', k, q') - Phi(p, k, q)||_1
    L_geo        = L_intra + L_cross

Training computes the same numbers without forming the triplets: `intra`, `angles` and `divergence` hold the fast forms,
`assemble` joins them, and the tests compare both. What the equations leave open (tau, delta, which layers, vectors of
length zero) is settled in docs/method.md, "Open points and how we decide them".
"""

import torch
from torch import Tensor


def huber(x: Tensor, delta: float) -> Tensor:
    """x^2 / 2 up to `delta`, then delta (|x| - delta / 2), element by element."""
    return torch.where(x.abs() <= delta, x.square() / 2, delta * (x.abs() - delta / 2))


def cosine(a: Tensor, b: Tensor) -> Tensor:
    """cos(a, b) over the last axis; a vector of length zero gives 0 and takes no gradient."""
    # An infinite length makes the value and its gradient 0; one division per length, as their product would give nan.
    length_a, length_b = (torch.where((x == 0).all(-1), torch.inf, x.square().sum(-1)).sqrt() for x in (a, b))
    return (a * b).sum(-1) / length_a / length_b


def log_pi(a: Tensor, b: Tensor, temperature: float) -> Tensor:
    """The logarithm of pi(a, b), which KL needs also where pi itself would underflow to 0."""
    return torch.log_softmax((a - b) / temperature, dim=-1)


def kl(log_teacher: Tensor, log_student: Tensor) -> Tensor:
    """KL(teacher || student) over the last axis, from the logarithms of both distributions."""
    return (log_teacher.exp() * (log_teacher - log_student)).sum(-1)


def phi(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Phi(a, b, c): the cosines of the interior angles at a, b and c, stacked in a last axis of 3."""
    return torch.stack([cosine(b - a, c - a), cosine(a - b, c - b), cosine(a - c, b - c)], dim=-1)


def l_intra(student: Tensor, teacher: Tensor, *, delta: float) -> Tensor:
    """L_intra of tokens f, f' (..., C); the Huber penalty of a vector is its mean over channels."""
    return (huber(teacher - student, delta).mean(-1) + 1 - cosine(teacher, student)).mean()


def l_cross(
    student: tuple[Tensor, Tensor], teacher: tuple[Tensor, Tensor], anchors: Tensor, *, temperature: float
) -> Tensor:
    """L_cross over all R * K * Q triplets.

    Args:
        student: p (B, R, C) and q (B, Q, C).
        teacher: p' and q' of the same shapes.
        anchors: k (B, R, K, C), K for each reference.
        temperature: tau.
    """
    # One axis for each part of a triplet: (B, R, K, Q, C). Terms that do not depend on a part keep 1 there.
    (p, q), (teacher_p, teacher_q) = ((p[:, :, None, None], q[:, None, None]) for p, q in (student, teacher))
    k = anchors[:, :, :, None]
    kl_pk = kl(log_pi(teacher_p, k, temperature), log_pi(p, k, temperature))
    kl_pq = kl(log_pi(teacher_p, teacher_q, temperature), log_pi(p, q, temperature))
    kl_kq = kl(log_pi(k, teacher_q, temperature), log_pi(k, q, temperature))
    angles = (phi(teacher_p, k, teacher_q) - phi(p, k, q)).abs().sum(-1)
    return (kl_pk + kl_pq + kl_kq + angles).mean()


def l_geo(
    features: tuple[Tensor, Tensor],
    student: tuple[Tensor, Tensor],
    teacher: tuple[Tensor, Tensor],
    anchors: Tensor,
    *,
    delta: float,
    temperature: float,
) -> Tensor:
    """L_geo, what adaptation minimises: `features` are the tokens f and f' of the kept views, the rest as above."""
    return l_intra(*features, delta=delta) + l_cross(student, teacher, anchors, temperature=temperature)


def nearest_and_farthest(reference: Tensor, held_out: Tensor, *, count: int) -> Tensor:
    """Positions (B, R, K) of the anchors: of K = `count`, K // 2 most similar tokens, then the least similar ones.

    reference: the teacher's p' (B, R, C); held_out: the teacher's patches of all held-out views (B, L, C). Similarity
    is the cosine.
    """
    order = cosine(reference[:, :, None], held_out[:, None]).argsort(dim=-1, descending=True)
    most = count // 2
    return torch.cat([order[..., :most], order[..., most - count :].flip(-1)], dim=-1)
