"""The intra loss: every token of a kept view should equal the teacher's, `Huber(f' - f) + 1 - cos(f', f)`.

Per token everything follows from d = f - f', f . f', |f|^2 and |f'|^2, so loss and gradient come from one sweep over
blocks of tokens that stay in cache: with c = clamp(d, -delta, delta)

    Huber(d) = c (d - c/2)                   its derivative by f   c
    cos      = f . f' / (|f| |f'|)                                 f' / (|f| |f'|) - cos f / |f|^2

Only the gradient is kept for the backward pass, which scales it. The same by plain operations takes about 20 passes
over the features, hundreds of MB at full size, and keeps normalised copies of both branches.
Source: docs/method.md, "Intra loss in one sweep".
"""

from collections.abc import Iterable
from itertools import product

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from freegeo.adaptation.losses.numerics import block_elements, blocks, widened


class _IntraSums(torch.autograd.Function):
    """Sums over tokens of the weighted loss (differentiable) and of its two unweighted parts (not)."""

    @staticmethod
    def forward(
        ctx, student: Tensor, teacher: Tensor, weight_huber: float, weight_cosine: float, delta: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        batch, views, tokens, channels = student.shape
        compute_dtype = widened(student[:0]).dtype
        gradient = torch.empty_like(student, dtype=compute_dtype) if ctx.needs_input_grad[0] else None
        size = block_elements(student) // (batch * channels)
        hubers, cosines = [], []
        for view, part in product(blocks(views, size // tokens), blocks(tokens, size)):
            huber, cosine = _block(
                widened(student[:, view, part]),
                widened(teacher[:, view, part]),
                (weight_huber / channels, weight_cosine, delta),
                None if gradient is None else gradient[:, view, part],
            )
            hubers.append(huber)
            cosines.append(cosine)
        huber_sum = torch.stack(hubers).sum() / channels
        cosine_sum = torch.stack(cosines).sum()
        ctx.save_for_backward(gradient)
        ctx.student_dtype = student.dtype
        ctx.mark_non_differentiable(huber_sum, cosine_sum)
        ctx.set_materialize_grads(False)
        return weight_huber * huber_sum + weight_cosine * cosine_sum, huber_sum, cosine_sum

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_loss: Tensor | None, *_) -> tuple[Tensor | None, None, None, None, None]:
        (gradient,) = ctx.saved_tensors
        if gradient is None or grad_loss is None:
            return None, None, None, None, None
        # A new tensor: the saved one must survive a second backward pass through the same graph.
        return (gradient * grad_loss).to(ctx.student_dtype), None, None, None, None


def _reciprocal_norm(tokens: Tensor) -> Tensor:
    """1 / |f| per token (..., 1), and 0 for a zero vector: its cosine is 0 and it takes no gradient from it."""
    square = tokens.square().sum(dim=-1, keepdim=True)
    return torch.where(square == 0, 0, square.rsqrt())


def _block(
    student: Tensor, teacher: Tensor, weights: tuple[float, float, float], gradient: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Sums of Huber over elements and of `1 - cosine` over tokens of a block; writes d loss / d student if asked."""
    per_channel, weight_cosine, delta = weights
    difference = student - teacher
    clamped = difference.clamp(-delta, delta)
    huber = difference.sub_(clamped, alpha=0.5).mul_(clamped).sum()
    inverse_student = _reciprocal_norm(student)
    toward_teacher = inverse_student * _reciprocal_norm(teacher)
    cosine = (student * teacher).sum(dim=-1, keepdim=True) * toward_teacher
    if gradient is not None:
        torch.mul(clamped, per_channel, out=gradient)
        gradient.addcmul_(teacher, toward_teacher, value=-weight_cosine)
        gradient.addcmul_(student, cosine * inverse_student.square(), value=weight_cosine)
    return huber, (1 - cosine).sum()


def intra_loss(
    pairs: Iterable[tuple[Tensor, Tensor]], *, weight_huber: float, weight_cosine: float, huber_delta: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Mean over tokens of `weight_huber * Huber + weight_cosine * (1 - cosine)`, and the means of the two parts.

    pairs: (student, teacher) features of the same tokens, each (B, S, T, C); several pairs (patches and special tokens)
    are averaged as one set of tokens. The Huber penalty is x^2/2 up to `huber_delta`, then
    delta (|x| - delta/2), averaged over channels. Only the first result carries a gradient, and only to the student.
    Source: the paper's L_intra, see `equations`.
    """
    pairs = list(pairs)
    tokens = sum(student[..., 0].numel() for student, _ in pairs)
    sums = [
        _IntraSums.apply(student, teacher.detach(), weight_huber, weight_cosine, huber_delta)
        for student, teacher in pairs
        if student.numel()
    ]
    loss, huber, cosine = (torch.stack(parts).sum() / tokens for parts in zip(*sums, strict=True))
    return loss, huber, cosine
