"""The angle terms: triangles of reference p, query q and anchor k keep the teacher's interior angles.

All R * K * m triplets are evaluated through two matrix products per branch, p . q and u . q with the edges u = k - p,
since the squared sides of a triangle give its angles:

    a = |q - p|^2 = |p|^2 + |q|^2 - 2 p . q        b = |k - p|^2 = |u|^2
    n = (q - p) . (k - p) = u . q - u . p          c = |q - k|^2 = a + b - 2 n
    cosines   n / sqrt(a b)  at p        (b - n) / sqrt(b c)  at k        (a - n) / sqrt(a c)  at q

a and c are differences of large squared norms, so that short sides, of which near-duplicate views have many, lose their
digits: cosines at a side of 1e-3 of the norm are off by 1/4 in float32, by 4e-10 in float64. Everything is therefore
computed in float64, to which the tokens are widened without rounding (`doubled`). Two measures more cost nothing: the
edge u is formed by subtraction, since an anchor is often close to its reference, and all tokens are centred on a common
vector, which changes no side but makes the norms small.

What is left of a side between equal tokens (repeated frames) is rounding and must not be taken for a direction: up to
`ZERO_EPS` it counts as zero, has cosine 0 at both of its ends and no gradient. The source below derives the bounds.

Loss and gradient come from one sweep over blocks of references that stay in cache; two arrays of R * K * m live during
the sweep and none after it. Gradients go first to a, b and n (`_by_squares`), then, by further products, to p and q
(`_by_tokens`).
Source: docs/method.md, "Angle terms by matrix products".
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from freegeo.adaptation.losses.numerics import block_elements, blocks, doubled, exact_matmul, widened

ZERO_EPS = 64
"""A squared side counts as zero up to so many eps of the squared norms that it is a difference of."""


@dataclass(frozen=True)
class _Branch:
    """Squared sides and edge products of one branch, from tokens centred on a common vector."""

    p: Tensor  # (B, R, C)
    q: Tensor  # (B, m, C)
    u: Tensor  # (B, R, K, C): edges k - p, formed by subtraction and so exact for an anchor close to its reference
    u_square: Tensor  # (B, R, K)
    pq_square: Tensor  # (B, R, m): |q - p|^2, 0 where that is rounding
    zero_below: Tensor  # (B, R, m): the largest |q - k|^2 that is rounding
    u_dot_p: Tensor  # (B, R, K, 1)
    u_dot_q: Tensor  # (B, R, K, m): overwritten by the sweep


@dataclass(frozen=True)
class _Triangles:
    """Cosines (B, r, K, m) at p, k and q of a block of triplets, with the reciprocal side lengths they came from."""

    at_p: Tensor
    at_k: Tensor
    at_q: Tensor
    inverse_pq: Tensor  # (B, r, 1, m)
    inverse_pk: Tensor  # (B, r, K, 1)
    inverse_qk: Tensor  # (B, r, K, m)


def _inverse_root(square: Tensor) -> Tensor:
    """1 / sqrt, and 0 for 0."""
    return torch.where(square == 0, 0, square.rsqrt())


def _branch(p: Tensor, q: Tensor, k: Tensor, centre: Tensor) -> _Branch:
    """The two matrix products, and which sides have length zero (see above)."""
    u = torch.empty_like(k)
    u_square = k.new_empty(k.shape[:-1])
    for part in blocks(k.shape[1], block_elements(k) // k[:, 0].numel()):
        torch.sub(k[:, part], p[:, part, None], out=u[:, part])
        u_square[:, part] = u[:, part].square().sum(-1)
    p, q = p - centre, q - centre
    q_columns = q.mT
    rounding = ZERO_EPS * torch.finfo(p.dtype).eps
    p_and_q = p.square().sum(-1)[:, :, None] + q.square().sum(-1)[:, None]
    pq_square = torch.baddbmm(p_and_q, p, q_columns, alpha=-2)
    pq_square = torch.where(pq_square <= rounding * p_and_q, 0, pq_square)
    n = u.flatten(1, 2) @ q_columns
    zero_below = (p_and_q + u_square.amax(-1, keepdim=True)).mul_(rounding)
    return _Branch(p, q, u, u_square, pq_square, zero_below, u @ p[..., None], n.unflatten(1, u.shape[1:3]))


def _triangles(branch: _Branch, part: slice) -> _Triangles:
    """Triangles of the references in `part`; overwrites these rows of `branch.u_dot_q`.

    A zero-length side gives cosine 0 and no gradient: its reciprocal length is 0.
    """
    pq_square, zero_below = branch.pq_square[:, part, None], branch.zero_below[:, part, None]
    pk_square = branch.u_square[:, part, :, None]
    pk, inverse_pk, inverse_pq = pk_square.sqrt(), _inverse_root(pk_square), _inverse_root(pq_square)
    n = branch.u_dot_q[:, part].sub_(branch.u_dot_p[:, part])  # (q - p) . (k - p)
    # |q-k|^2 = |q-p|^2 + |k-p|^2 - 2n; replacing what is not above zero_below by infinity makes its reciprocal 0.
    qk_square = torch.sub(pq_square - zero_below, n, alpha=2).add_(pk_square)
    inverse_qk = torch.threshold_(qk_square, 0, torch.inf).add_(zero_below).rsqrt_()
    along_pk = n.mul_(inverse_pk)
    at_k = torch.sub(pk, along_pk).mul_(inverse_qk)
    at_p = along_pk.mul_(inverse_pq)
    at_q = torch.addcmul(pq_square.sqrt(), at_p, pk, value=-1).mul_(inverse_qk)
    return _Triangles(at_p, at_k, at_q, inverse_pq, inverse_pk, inverse_qk)


def _slope(difference: Tensor, scale: float, delta: float | None) -> Tensor:
    """Derivative of `scale * penalty(difference)`; `delta` None means L1. Overwrites the difference."""
    if delta is None:
        return torch.sign(difference, out=difference).mul_(scale)
    return difference.clamp_(-delta, delta).mul_(scale)


def _penalty_sum(difference: Tensor, delta: float | None) -> Tensor:
    """Sum over triplets of |d| (`delta` None) or of the Huber penalty."""
    if delta is None:
        return difference.abs().sum()
    clamped = difference.clamp(-delta, delta)
    return torch.sub(difference, clamped, alpha=0.5).mul_(clamped).sum()


def _by_squares(sides: _Triangles, slopes: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of a block by a (B, r, m), b (B, r, K) and n (B, r, K, m), as named above.

    The last result takes the place of the first slope; the other slopes are overwritten.
    """
    slope_p, slope_k, slope_q = slopes
    inverse_pk, inverse_pq = sides.inverse_pk[..., 0], sides.inverse_pq[:, :, 0]
    weighted_p, weighted_k, weighted_q = slope_p * sides.at_p, slope_k * sides.at_k, slope_q * sides.at_q
    minus_2_by_c = (weighted_k + weighted_q).mul_(sides.inverse_qk).mul_(sides.inverse_qk)
    slope_k.mul_(sides.inverse_qk)
    slope_q.mul_(sides.inverse_qk)

    by_b = slope_k.sum(-1).mul_(inverse_pk)
    by_b.addcmul_(weighted_k.add_(weighted_p).sum(-1), inverse_pk.square(), value=-0.5)
    by_b.sub_(minus_2_by_c.sum(-1), alpha=0.5)
    by_a = slope_q.sum(2).mul_(inverse_pq)
    by_a.addcmul_(weighted_q.add_(weighted_p).sum(2), inverse_pq.square(), value=-0.5)
    by_a.sub_(minus_2_by_c.sum(2), alpha=0.5)
    by_n = slope_p.mul_(sides.inverse_pq).sub_(slope_k).mul_(sides.inverse_pk)
    return by_a, by_b, by_n.sub_(slope_q.mul_(sides.inverse_pq)).add_(minus_2_by_c)


def _by_tokens(branch: _Branch, by_a: Tensor, by_b: Tensor, by_n: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients by p (B, R, C) and q (B, m, C) from those by the squares of `_by_squares`, over all references."""
    along_pq = by_n.sum(2).add_(by_a, alpha=2)
    along_u = by_n.sum(-1).add_(by_b, alpha=2)
    grad_p = torch.baddbmm(along_pq.sum(-1, keepdim=True) * branch.p, along_pq, branch.q, alpha=-1)
    grad_p.sub_((along_u[:, :, None] @ branch.u)[:, :, 0])
    grad_q = torch.baddbmm(by_a.sum(1)[..., None] * branch.q, by_a.mT, branch.p, beta=2, alpha=-2)
    return grad_p, grad_q.baddbmm_(by_n.flatten(1, 2).mT, branch.u.flatten(1, 2))


def _sweep(
    student: _Branch, teacher: _Branch, weights: tuple[float, float, float], delta: float | None, with_gradient: bool
) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor] | None]:
    """Means of the three penalties (3,) and, if asked, the gradient of their weighted sum as `_by_squares` gives it."""
    batch, references, anchors, queries = student.u_dot_q.shape
    terms = []
    by_a, by_b, by_n = torch.empty_like(student.pq_square), torch.empty_like(student.u_square), teacher.u_dot_q
    for part in blocks(references, block_elements(student.p) // (batch * anchors * queries)):
        sides, teacher_sides = _triangles(student, part), _triangles(teacher, part)
        differences = (
            teacher_sides.at_p.neg_().add_(sides.at_p),
            teacher_sides.at_k.neg_().add_(sides.at_k),
            teacher_sides.at_q.neg_().add_(sides.at_q),
        )
        terms.append(torch.stack([_penalty_sum(difference, delta) for difference in differences]))
        if with_gradient:
            slope_p, slope_k, slope_q = (
                _slope(difference, weight / student.u_dot_q.numel(), delta)
                for difference, weight in zip(differences, weights, strict=True)
            )
            # The first slope, and so the gradient by n, lives in the teacher's `u_dot_q`.
            by_a[:, part], by_b[:, part], _ = _by_squares(sides, (slope_p, slope_k, slope_q))
    return torch.stack(terms).sum(0) / student.u_dot_q.numel(), (by_a, by_b, by_n) if with_gradient else None


class _AngleTerms(torch.autograd.Function):
    """Weighted sum of the three mean penalties (differentiable in p and q) and the unweighted means (3,)."""

    @staticmethod
    def forward(
        ctx,
        p: Tensor,
        q: Tensor,
        teacher_p: Tensor,
        teacher_q: Tensor,
        k: Tensor,
        weights: tuple[float, float, float],
        delta: float | None,
    ) -> tuple[Tensor, Tensor]:
        ctx.dtypes = p.dtype, q.dtype
        device, dtype = p.device, widened(p[:0]).dtype
        p, q, teacher_p, teacher_q, k = map(doubled, (p, q, teacher_p, teacher_q, k))
        centre = torch.cat([teacher_p, teacher_q, k.flatten(1, 2)], dim=1).mean(1, keepdim=True)
        with exact_matmul(p):
            student, teacher = _branch(p, q, k, centre), _branch(teacher_p, teacher_q, k, centre)
            terms, by_squares = _sweep(student, teacher, weights, delta, any(ctx.needs_input_grad[:2]))
            gradients = _by_tokens(student, *by_squares) if by_squares else ()
        # Converted at once: what waits for the backward pass is as small as the tokens.
        ctx.save_for_backward(*(grad.to(device, dtype) for grad in gradients))
        loss = torch.stack([weight * term for weight, term in zip(weights, terms, strict=True)]).sum().to(device, dtype)
        terms = terms.to(device, dtype)
        ctx.mark_non_differentiable(terms)
        ctx.set_materialize_grads(False)
        return loss, terms

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_loss: Tensor | None, *_) -> tuple[Tensor | None, ...]:
        if grad_loss is None:
            return (None,) * 7
        scaled = [(grad * grad_loss).to(dtype) for grad, dtype in zip(ctx.saved_tensors, ctx.dtypes, strict=True)]
        return (*scaled, None, None, None, None, None)


def angle_loss(
    student: tuple[Tensor, Tensor],
    teacher: tuple[Tensor, Tensor],
    anchors: Tensor,
    *,
    weights: tuple[float, float, float],
    penalty: Literal["l1", "huber"],
    huber_delta: float,
) -> tuple[Tensor, Tensor]:
    """Weighted angle loss over all triplets, and its three unweighted means (3,): angle at p, at k and at q.

    student, teacher: (p (B, R, C), q (B, m, C)) of that branch; anchors: k (B, R, K, C), teacher tokens used by
    both. Each mean is that of |cos - cos'| (`l1`) or of its Huber penalty with `huber_delta`. Only the first
    result carries a gradient, and only to the student. Source: the paper's Phi, see `equations`; for `huber`
    docs/method.md, "Paper and released code".
    """
    delta = None if penalty == "l1" else huber_delta
    constants = (tensor.detach() for tensor in (*teacher, anchors))
    return _AngleTerms.apply(*student, *constants, weights, delta)
