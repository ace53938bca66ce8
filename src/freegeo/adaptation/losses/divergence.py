"""The distance terms: KL between teacher and student distributions `softmax((a - b)/tau)` over channels.

All pairs (x, y) of two token sets, here already divided by tau, would take R * m softmaxes over C channels. Since
exp(x - y) = exp(x) exp(-y), matrix products of the tokens' exponentials E = exp(x) and F = exp(-y) do the same work.
A prime marks the teacher's tokens, * multiplies element by element, and g is the weight of each pair in the loss:

    Z      = E F^T                                                    the partition functions of all pairs, (R, m)
    pi_c   = E_c F_c / Z,   log pi_c = x_c - y_c - log Z              one pair, channel c
    KL     = sum over c of pi'_c (log pi'_c - log pi_c)
           = [ (E' * (x' - x)) F'^T + E' (F' * (y - y'))^T ] / Z' - log Z' + log Z
    dKL/dx = sum over y of g (pi - pi') = E * ((g / Z) F) - E' * ((g / Z') F'),   and dKL/dy likewise

In place of E the code holds E / max E, likewise F, and adds the logarithms of the maxima to log Z: nothing overflows.
What can go wrong is underflow: Z is lost where no channel is large in both factors. With centred tokens (`_centred`)
it is at least C exp(-S) for the spread S that `pair_spread` measures, so S decides between float32, float64 and the
definition. Half precision is never used: KL is a small difference of large logarithms.
Source: docs/method.md, "Divergence by matrix products" and "Range and precision".

Chosen pairs (`pairing` "paired") are too few for that and are evaluated from the definition, as `equations` has it.
"""

from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from freegeo.adaptation.losses.numerics import block_elements, blocks, doubled, exact_matmul, widened

KLForm = Literal["float32", "float64", "direct"]
"""How all-pairs KL is evaluated: matrix products in float32 or in float64, or the definition pair by pair."""

# Z >= C exp(-spread). float32 holds exp(-87) in full precision and float64 exp(-708): the largest terms of every Z stay
# clear of that, and what underflows beside them is less than e^-17 of Z.
FLOAT32_SPREAD, FLOAT64_SPREAD = 70.0, 650.0


def choose_form(spread: float, *, headroom: float = 1.0) -> KLForm:
    """The cheapest safe evaluation for softmax inputs of this `spread` (see `pair_spread`).

    headroom: factor by which the spread may grow before the choice is unsafe; above 1 where the teacher's spread is
    measured once and also used for a student that drifts from it.
    """
    if spread * headroom <= FLOAT32_SPREAD:
        return "float32"
    return "float64" if spread * headroom <= FLOAT64_SPREAD else "direct"


def _centred(x: Tensor, y: Tensor, common: Tensor, temperature: float) -> tuple[Tensor, Tensor]:
    """x/tau and y/tau less a common vector and less each token's channel mean.

    Neither changes a softmax of x - y: the common vector cancels in the difference, and a softmax ignores a constant
    over channels. The common vector takes out the outlier channels that all tokens of a ViT share, which is what keeps
    the exponentials in range.
    """
    x, y = (x - common).div_(temperature), (y - common).div_(temperature)
    return x.sub_(x.mean(-1, keepdim=True)), y.sub_(y.mean(-1, keepdim=True))


def _mean_token(x: Tensor, y: Tensor) -> Tensor:
    return torch.cat([x, y], dim=1).mean(1, keepdim=True)


@torch.no_grad()
def pair_spread(x: Tensor, y: Tensor, temperature: float) -> Tensor:
    """The spread S of the pairs x (B, R, C), y (B, m, C), a scalar tensor: the largest x plus the largest -y.

    Centred tokens have a mean of 0 over channels, so exp(x - y) has one of at least 1 and its sum is at least C; with
    the largest values divided out of both factors, Z is at least C exp(-S).
    """
    x, y = widened(x), widened(y)
    x, y = _centred(x, y, _mean_token(x, y), temperature)
    return (x.amax((1, 2)) - y.amin((1, 2))).amax()


class _ProductPairs(torch.autograd.Function):
    """KL of all pairs by matrix products. Inputs are centred; gradients are those of softmax inputs x and y."""

    @staticmethod
    def forward(ctx, x: Tensor, y: Tensor, teacher_x: Tensor, teacher_y: Tensor, same_x: bool) -> Tensor:
        x_top, y_top = x.amax(-1, keepdim=True), (-y).amax(-1, keepdim=True)
        teacher_x_top, teacher_y_top = teacher_x.amax(-1, keepdim=True), (-teacher_y).amax(-1, keepdim=True)
        e, f = (x - x_top).exp_(), (-y - y_top).exp_()
        teacher_e = e if same_x else (teacher_x - teacher_x_top).exp_()
        teacher_f = (-teacher_y - teacher_y_top).exp_()
        with exact_matmul(x):
            z, teacher_z = e @ f.mT, teacher_e @ teacher_f.mT
            # Mean over the teacher's distribution of (x' - y') - (x - y), times Z'. Where x' = x, one product is saved.
            cross = teacher_e @ (teacher_f * (y - teacher_y)).mT
            if not same_x:
                cross.baddbmm_(teacher_e * (teacher_x - x), teacher_f.mT)
        kl = cross.div_(teacher_z).add_(z.log()).sub_(teacher_z.log())
        kl.add_(x_top - teacher_x_top).add_((y_top - teacher_y_top).mT)
        ctx.save_for_backward(e, f, teacher_e, teacher_f, z, teacher_z)
        return kl

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None, None, None]:
        e, f, teacher_e, teacher_f, z, teacher_z = ctx.saved_tensors
        by_z, by_teacher_z = grad / z, grad / teacher_z
        grad_x = grad_y = None
        with exact_matmul(e):
            if ctx.needs_input_grad[0]:
                grad_x = (by_z @ f).mul_(e).sub_((by_teacher_z @ teacher_f).mul_(teacher_e))
            if ctx.needs_input_grad[1]:
                grad_y = (by_teacher_z.mT @ teacher_e).mul_(teacher_f).sub_((by_z.mT @ e).mul_(f))
        return grad_x, grad_y, None, None, None


class _DirectPairs(torch.autograd.Function):
    """KL of all pairs from the definition, block by block; the backward pass forms the distributions again."""

    @staticmethod
    def forward(ctx, x: Tensor, y: Tensor, teacher_x: Tensor, teacher_y: Tensor) -> Tensor:
        ctx.save_for_backward(x, y, teacher_x, teacher_y)
        parts = []
        for part in _pair_blocks(x, y):
            student = _log_softmax(x[:, part], y)
            teacher = _log_softmax(teacher_x[:, part], teacher_y)
            parts.append((teacher.exp() * (teacher - student)).sum(-1))
        return torch.cat(parts, dim=1)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, Tensor, None, None]:
        x, y, teacher_x, teacher_y = ctx.saved_tensors
        grad_x, grad_y = torch.zeros_like(x), torch.zeros_like(y)
        for part in _pair_blocks(x, y):
            surplus = _log_softmax(x[:, part], y).exp_()
            surplus.sub_(_log_softmax(teacher_x[:, part], teacher_y).exp_()).mul_(grad[:, part, :, None])
            grad_x[:, part] = surplus.sum(2)
            grad_y.sub_(surplus.sum(1))
        return grad_x, grad_y, None, None


def _pair_blocks(x: Tensor, y: Tensor):
    return blocks(x.shape[1], block_elements(x) // y.numel())


def _log_softmax(x: Tensor, y: Tensor) -> Tensor:
    return F.log_softmax(x[:, :, None] - y[:, None], dim=-1)


def all_pairs_divergence(
    student: tuple[Tensor, Tensor],
    teacher: tuple[Tensor, Tensor],
    *,
    temperature: float,
    form: KLForm | None,
) -> Tensor:
    """KL(softmax((x' - y')/tau) || softmax((x - y)/tau)) for every pair, (B, R, m), in float32 or wider.

    student: (x (B, R, C), y (B, m, C)); teacher: (x', y') of the same shapes. Passing one tensor object as x and x'
    saves its products; the gradient goes to the student's tensors. form None measures the spread of the softmax inputs,
    which reads one number back to the host; a given `float32` or `float64` is not checked and yields non-finite values
    where the spread is too large for it.
    """
    same_x = student[0] is teacher[0]
    x, y = map(widened, student)
    teacher_x, teacher_y = (widened(tensor).detach() for tensor in teacher)
    device, wide = x.device, x.dtype
    with torch.no_grad():
        if form is None:
            spreads = [pair_spread(x, y, temperature), pair_spread(teacher_x, teacher_y, temperature)]
            form = choose_form(float(torch.stack(spreads).amax()))
        teacher_common = _mean_token(teacher_x, teacher_y)
        # One vector for both branches where they share x, so that its exponentials are shared too.
        common = teacher_common if same_x else _mean_token(x, y)
    if form == "float64":
        x, y, teacher_x, teacher_y, common, teacher_common = (
            doubled(tensor) for tensor in (x, y, teacher_x, teacher_y, common, teacher_common)
        )
    x, y = _centred(x, y, common, temperature)
    teacher_x, teacher_y = _centred(teacher_x, teacher_y, teacher_common, temperature)
    if form == "direct":
        return _DirectPairs.apply(x, y, teacher_x, teacher_y)
    return _ProductPairs.apply(x, y, teacher_x, teacher_y, same_x).to(device, wide)


class _PairedKL(torch.autograd.Function):
    """KL per difference vector; one exponential per element and branch, and only the gradient is kept."""

    @staticmethod
    def forward(ctx, student: Tensor, teacher: Tensor, temperature: float) -> Tensor:
        rows, channels = student.shape
        kl = torch.empty(rows, dtype=widened(student[:0]).dtype, device=student.device)
        gradient = torch.empty_like(student, dtype=kl.dtype) if ctx.needs_input_grad[0] else None
        for part in blocks(rows, block_elements(student) // channels):
            log_pi, pi = _log_and_softmax(student[part], temperature)
            log_teacher_pi, teacher_pi = _log_and_softmax(teacher[part], temperature)
            kl[part] = log_teacher_pi.sub_(log_pi).mul_(teacher_pi).sum(-1)
            if gradient is not None:
                torch.sub(pi, teacher_pi, out=gradient[part]).div_(temperature)
        ctx.save_for_backward(gradient)
        ctx.student_dtype = student.dtype
        return kl

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, None, None]:
        (gradient,) = ctx.saved_tensors
        return (gradient * grad[:, None]).to(ctx.student_dtype), None, None


def _log_and_softmax(difference: Tensor, temperature: float) -> tuple[Tensor, Tensor]:
    logits = widened(difference) / temperature
    logits.sub_(logits.amax(-1, keepdim=True))
    exponentials = logits.exp()
    partition = exponentials.sum(-1, keepdim=True)
    return logits.sub_(partition.log()), exponentials.div_(partition)


def paired_divergence(student: Tensor, teacher: Tensor, *, temperature: float) -> Tensor:
    """KL(softmax(d'/tau) || softmax(d/tau)) of difference vectors d, d' (..., C): (...), in float32 or wider."""
    rows = student.flatten(0, -2), teacher.detach().flatten(0, -2)
    return _PairedKL.apply(*rows, temperature).view(student.shape[:-1])
