"""Each fast term against the equations, and the custom gradients against finite differences."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from freegeo.adaptation.losses import (
    adaptation_loss,
    choose_form,
    draw_tokens,
    equations,
)
from freegeo.adaptation.losses.angles import angle_loss
from freegeo.adaptation.losses.divergence import all_pairs_divergence, pair_spread, paired_divergence
from freegeo.adaptation.losses.intra import intra_loss
from freegeo.adaptation.recipe import PAPER, RELEASED_VGGT
from loss_tools import teacher_side

FLOAT64 = torch.float64


def random_triplets(batch=2, references=5, anchors=3, queries=7, channels=6, seed=0, dtype=FLOAT64):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return 3 * torch.randn(*shape, generator=generator, dtype=dtype)

    p, q = normal(batch, references, channels), normal(batch, queries, channels)
    k = normal(batch, references, anchors, channels)
    return (p + 0.1 * normal(*p.shape), q + 0.1 * normal(*q.shape)), (p, q), k


def angle_means(
    student: tuple[Tensor, Tensor], teacher: tuple[Tensor, Tensor], k: Tensor, delta: float | None
) -> Tensor:
    """Mean penalties (3,) at p, k and q over all triplets; delta None is L1, as in the paper."""
    mine, others = (
        equations.phi(p[:, :, None, None], k[:, :, :, None], q[:, None, None]) for p, q in (student, teacher)
    )
    penalties = (mine - others).abs() if delta is None else equations.huber(mine - others, delta)
    return penalties.mean((0, 1, 2, 3))


def all_pairs_kl(student: tuple[Tensor, Tensor], teacher: tuple[Tensor, Tensor], temperature: float) -> Tensor:
    """KL (B, R, m) of every pair."""
    mine, others = (equations.log_pi(x[:, :, None], y[:, None], temperature) for x, y in (student, teacher))
    return equations.kl(others, mine)


def gradients(loss: Tensor, inputs: tuple[Tensor, ...]) -> list[Tensor]:
    return list(torch.autograd.grad(loss, inputs))


def assert_same_loss(found: Tensor, wanted: Tensor, inputs: tuple[Tensor, ...], tolerance: float):
    torch.testing.assert_close(found, wanted, rtol=tolerance, atol=tolerance)
    for mine, plain in zip(gradients(found, inputs), gradients(wanted, inputs), strict=True):
        assert (mine - plain).norm() <= tolerance * plain.norm() + 1e-14


@pytest.mark.parametrize("penalty", ["l1", "huber"])
@pytest.mark.parametrize("shape", [{}, {"anchors": 1, "queries": 1}, {"batch": 1, "references": 150, "queries": 300}])
def test_angles_equal_their_definition(penalty, shape):
    student, teacher, k = random_triplets(**shape)
    inputs = tuple(part.requires_grad_() for part in student)
    weights = (1.0, 0.5, 2.0)
    found, terms = angle_loss(inputs, teacher, k, weights=weights, penalty=penalty, huber_delta=0.1)
    means = angle_means(inputs, teacher, k, None if penalty == "l1" else 0.1)
    torch.testing.assert_close(terms, means.detach(), rtol=1e-10, atol=1e-12)
    assert_same_loss(found, (torch.tensor(weights, dtype=FLOAT64) * means).sum(), inputs, 1e-9)


def test_angle_of_a_known_triangle():
    # Student: right angle at p with equal legs (45 degrees elsewhere). Teacher: equilateral (60 degrees everywhere).
    p, k = torch.zeros(1, 1, 2), torch.tensor([[[[1.0, 0.0]]]])
    student, teacher = torch.tensor([[[0.0, 1.0]]]), torch.tensor([[[0.5, 0.75**0.5]]])
    loss, terms = angle_loss((p, student), (p, teacher), k, weights=(1.0, 1.0, 1.0), penalty="l1", huber_delta=1.0)
    torch.testing.assert_close(terms, torch.tensor([0.5, 0.5**0.5 - 0.5, 0.5**0.5 - 0.5]))
    torch.testing.assert_close(loss, terms.sum())


@pytest.mark.parametrize("dtype", [torch.float32, FLOAT64])
def test_zero_length_sides_give_cosine_zero_and_no_gradient(dtype):
    (p, q), (tp, tq), k = random_triplets(dtype=dtype, channels=40)
    offset = 20 * torch.ones(40, dtype=dtype)
    p, q, tp, tq, k = (tensor + offset for tensor in (p, q, tp, tq, k))
    tq[:, 2], q[:, 3], k[:, :, 1] = tp[:, 1], p[:, 2], tp  # teacher q = p, student q = p, anchor = teacher's p
    k[0, 0, 0] = q[0, 4]  # anchor = student q
    p[0, 1] = k[0, 1, 0]  # anchor = student p
    inputs = (p.requires_grad_(), q.requires_grad_())
    found, terms = angle_loss(inputs, (tp, tq), k, weights=(1.0, 1.0, 1.0), penalty="huber", huber_delta=1.0)
    wide = tuple(part.detach().double().requires_grad_() for part in inputs)
    means = angle_means(wide, (tp.double(), tq.double()), k.double(), 1.0)
    tolerance = 1e-5 if dtype == torch.float32 else 1e-9
    torch.testing.assert_close(terms.double(), means.detach(), rtol=tolerance, atol=tolerance)
    for mine, plain in zip(gradients(found, inputs), gradients(means.sum(), wide), strict=True):
        assert (mine.double() - plain).norm() <= tolerance * plain.norm()


def near_duplicates(distance, channels, seed=0):
    """Tokens (student, teacher, anchors) in float32, all of one position of the scene, `distance` of their norm apart.

    Their common part is large, as in the features of a vision transformer.
    """
    generator = torch.Generator().manual_seed(seed)
    scene = torch.randn(1, 6, channels, generator=generator) + 3 * torch.randn(channels, generator=generator)

    def near(tokens):
        return tokens + distance * tokens.norm() / tokens.numel() ** 0.5 * torch.randn(
            tokens.shape, generator=generator
        )

    return (near(scene), near(scene)), (scene, near(scene)), torch.stack([near(scene), near(scene)], dim=2)


def angles_and_definition(student, teacher, k, delta=1.0):
    """Terms and gradients of float32 tokens, and the same from the definition in float64."""
    inputs = tuple(part.requires_grad_() for part in student)
    found, terms = angle_loss(inputs, teacher, k, weights=(1.0, 1.0, 1.0), penalty="huber", huber_delta=delta)
    wide = tuple(part.detach().double().requires_grad_() for part in inputs)
    means = angle_means(wide, tuple(part.double() for part in teacher), k.double(), delta)
    return (terms.double(), gradients(found, inputs)), (means.detach(), gradients(means.sum(), wide))


@pytest.mark.parametrize("channels", [64, 3072])
@pytest.mark.parametrize("distance", [1e-1, 1e-2, 2e-3, 1e-3, 1e-4, 1e-5])
def test_angles_between_near_duplicate_views_are_exact_in_float32(distance, channels):
    # 2 eps / delta^2 (docs/method.md, "Angle terms by matrix products"), and the rounding of the result to float32.
    tolerance = 1e-6 + 8 * torch.finfo(FLOAT64).eps / distance**2
    found, wanted = angles_and_definition(*near_duplicates(distance, channels))
    torch.testing.assert_close(found[0], wanted[0], rtol=tolerance, atol=0)
    for mine, plain in zip(found[1], wanted[1], strict=True):
        assert mine.dtype == torch.float32
        assert (mine.double() - plain).norm() <= tolerance * plain.norm()


def test_a_single_short_side_among_long_ones_keeps_its_angles():
    student, teacher, k = random_triplets(batch=1, channels=64, dtype=torch.float32)
    for p, q in (student, teacher):
        q[:, 0] = p[:, 0] * (1 + 1e-4 * torch.linspace(-1, 1, 64))
    found, wanted = angles_and_definition(student, teacher, k)
    torch.testing.assert_close(found[0], wanted[0], rtol=1e-6, atol=0)


def test_a_difference_in_the_last_bits_of_float32_tokens_is_not_zero():
    p = 1 + torch.rand(1, 1, 512, generator=torch.Generator().manual_seed(0))
    bits = 16 * torch.where(torch.arange(512) % 3 == 0, 1, -1).int()
    q = (p.view(torch.int32) + bits).view(torch.float32)
    k, other = torch.randn(2, 1, 1, 512, generator=torch.Generator().manual_seed(1))
    found, wanted = angles_and_definition((p, q), (p.clone(), other), k[:, None])
    torch.testing.assert_close(found[0], wanted[0], rtol=1e-3, atol=0)
    without, _ = angles_and_definition((p.detach(), p.detach().clone()), (p.detach().clone(), other), k[:, None])
    assert (without[0] - wanted[0]).abs().max() > 1e-2


@pytest.mark.parametrize("channels", [64, 3072])
def test_equal_tokens_are_a_side_of_length_zero_however_large_their_common_part(channels):
    (p, _), (teacher_p, _), k = near_duplicates(1e-2, channels)
    common = 50 * torch.ones(channels)
    p, teacher_p, k = p + common, teacher_p + common, k + common
    # Repeated frames: the student's queries are its references, the teacher's are its anchors.
    found, wanted = angles_and_definition((p, p.clone()), (teacher_p, k[:, :, 0].clone()), k)
    torch.testing.assert_close(found[0], wanted[0], rtol=1e-5, atol=0)
    for mine, plain in zip(found[1], wanted[1], strict=True):
        assert (mine.double() - plain).norm() <= 1e-5 * plain.norm()


@pytest.mark.parametrize("form", ["float32", "float64", "direct", None])
@pytest.mark.parametrize("shared", ["nothing", "x", "y"])
def test_all_pairs_divergence_equals_its_definition(form, shared):
    (x, y), (tx, ty), _ = random_triplets()
    x, tx = (tx, tx) if shared == "x" else (x, tx)
    y, ty = (ty, ty) if shared == "y" else (y, ty)
    moving = [part.requires_grad_() for part, name in ((x, "x"), (y, "y")) if name != shared]
    weights = torch.rand(2, 5, 7, dtype=FLOAT64, generator=torch.Generator().manual_seed(1))
    found = all_pairs_divergence((x, y), (tx, ty), temperature=2.0, form=form)
    wanted = all_pairs_kl((x, y), (tx.detach(), ty.detach()), 2.0)
    torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-12)
    assert_same_loss((weights * found).sum(), (weights * wanted).sum(), tuple(moving), 1e-9)


@pytest.mark.parametrize(
    ("scale", "form", "tolerance"),
    # The definition in float32 subtracts logits of a thousand, whose last digit is 6e-5.
    [(0.2, "float32", 1e-5), (3.0, "float32", 2e-5), (25.0, "float64", 1e-5), (300.0, "direct", 2e-3)],
)
def test_divergence_of_outliers_is_finite_and_right(scale, form, tolerance):
    (x, y), (tx, ty), _ = random_triplets(batch=1, references=30, queries=40, channels=64, dtype=torch.float32)
    common = torch.zeros(64)
    common[::9] = 200.0  # outlier channels that all tokens share cost nothing: centring takes them out
    x, y, tx, ty = (scale * tensor + common for tensor in (x, y, tx, ty))
    spread = float(max(pair_spread(x, y, 1.0), pair_spread(tx, ty, 1.0)))
    assert choose_form(spread) == form
    inputs = (x.requires_grad_(), y.requires_grad_())
    found = all_pairs_divergence(inputs, (tx, ty), temperature=1.0, form=None)
    wide = tuple(part.detach().double().requires_grad_() for part in inputs)
    wanted = all_pairs_kl(wide, (tx.double(), ty.double()), 1.0)
    torch.testing.assert_close(found.double(), wanted, rtol=tolerance, atol=tolerance)
    for mine, plain in zip(gradients(found.mean(), inputs), gradients(wanted.mean(), wide), strict=True):
        assert (mine.double() - plain).norm() <= tolerance * plain.norm()


def test_the_form_leaves_headroom():
    assert choose_form(69.0) == "float32"
    assert choose_form(69.0, headroom=1.25) == "float64"
    assert choose_form(600.0, headroom=1.25) == "direct"


def test_a_form_too_narrow_for_the_features_is_not_silent():
    (x, y), teacher, _ = random_triplets(dtype=torch.float32)
    kl = all_pairs_divergence((300 * x, y), teacher, temperature=1.0, form="float32")
    assert not kl.isfinite().all()


def test_paired_divergence_equals_its_definition():
    d, target = torch.randn(2, 3, 4, 9, dtype=FLOAT64, generator=torch.Generator().manual_seed(0)).unbind(0)
    d.requires_grad_()
    found = paired_divergence(d, target, temperature=0.5)
    zero = torch.zeros_like(target)
    wanted = equations.kl(equations.log_pi(target, zero, 0.5), equations.log_pi(d, zero, 0.5))
    torch.testing.assert_close(found, wanted, rtol=1e-12, atol=1e-12)
    assert_same_loss(found.square().sum(), wanted.square().sum(), (d,), 1e-10)


def test_divergence_of_a_known_pair():
    # softmax of (0, log 3) is (1/4, 3/4); the student's is (1/2, 1/2).
    teacher = torch.tensor([[0.0, math.log(3)]])
    kl = paired_divergence(torch.zeros(1, 2), teacher, temperature=1.0)
    wanted = 0.25 * math.log(0.5) + 0.75 * math.log(1.5)
    torch.testing.assert_close(kl, torch.tensor([wanted]))


def test_gradients_pass_finite_differences():
    (p, q), teacher, k = random_triplets(batch=1, references=2, anchors=2, queries=3, channels=3)
    inputs = (p.requires_grad_(), q.requires_grad_())
    for penalty in ("l1", "huber"):
        settings = {"weights": (1.0, 0.5, 2.0), "penalty": penalty, "huber_delta": 0.05}
        assert torch.autograd.gradcheck(lambda p, q, s=settings: angle_loss((p, q), teacher, k, **s)[0], inputs)
    for form in ("float64", "direct"):
        settings = {"temperature": 2.0, "form": form}
        assert torch.autograd.gradcheck(lambda p, q, s=settings: all_pairs_divergence((p, q), teacher, **s), inputs)
    assert torch.autograd.gradcheck(lambda p: paired_divergence(p, teacher[0], temperature=2.0), inputs[:1])
    settings = {"weight_huber": 0.7, "weight_cosine": 2.0, "huber_delta": 0.3}
    pair = p[:, None].detach().clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda f: intra_loss([(f, teacher[0][:, None])], **settings)[0], (pair,))


def test_intra_equals_its_definition_over_strided_views_and_several_parts():
    generator = torch.Generator().manual_seed(0)
    teacher = torch.randn(2, 8, 300, 48, generator=generator, dtype=FLOAT64)
    student = (teacher[:, ::2] + torch.randn(2, 4, 300, 48, generator=generator, dtype=FLOAT64)).requires_grad_()
    settings = {"weight_huber": 1.0, "weight_cosine": 2.0, "huber_delta": 0.5}
    parts = [(student[:, :, :7], teacher[:, ::2, :7]), (student[:, :, 7:], teacher[:, ::2, 7:])]
    found, parts_huber, parts_cosine = intra_loss(parts, **settings)
    once = equations.l_intra(student, teacher[:, ::2], delta=0.5)
    wanted = once + (1 - equations.cosine(student, teacher[:, ::2])).mean()
    assert_same_loss(found, wanted, (student,), 1e-10)
    torch.testing.assert_close(found, parts_huber + 2 * parts_cosine)
    assert not parts_huber.requires_grad


def test_intra_of_zero_vectors_is_finite():
    student = torch.zeros(1, 1, 2, 4, requires_grad=True)
    teacher = torch.tensor([[[[0.0, 0, 0, 0], [2.0, 0, 0, 0]]]])
    loss, huber, cosine = intra_loss([(student, teacher)], weight_huber=1.0, weight_cosine=1.0, huber_delta=1.0)
    loss.backward()
    assert cosine == 1  # a zero vector is similar to nothing, not even to another one
    torch.testing.assert_close(huber, torch.tensor(1.5 / 4 / 2))
    torch.testing.assert_close(student.grad.flatten()[4:], torch.tensor([-1.0 / 4 / 2, 0, 0, 0]))


CASES = {
    "plain": {},
    "odd anchors": {"num_anchors": 3},
    "more references": {"num_reference": 11, "num_query": 4},
    "more queries": {"num_reference": 3, "num_query": 30},
    "all tokens": {"num_reference": 256, "num_query": 256},
    "another reference view": {"reference_view": 2},
}


@pytest.mark.parametrize("settings", CASES.values(), ids=CASES.keys())
@pytest.mark.parametrize("repeated", [False, True], ids=["distinct", "repeated frames"])
def test_paper_loss_equals_the_equations(settings, repeated):
    generator = torch.Generator().manual_seed(3)
    teacher = 5 * torch.randn(2, 8, 15, 16, generator=generator, dtype=FLOAT64)  # camera, 2 registers, 12 patches
    if repeated:
        teacher[:, 3], teacher[:, 6] = teacher[:, 2], teacher[:, 0]
    kept = [0, 2, 4, 6]
    student = teacher[:, kept] + torch.randn(2, 4, 15, 16, generator=generator, dtype=FLOAT64)
    student.requires_grad_()
    config = PAPER.changed(loss={"temperature": 2.0, "num_reference": 6, "num_query": 9, **settings}).loss
    draws = draw_tokens(config, tokens_per_view=12, student_views=4, held_out=48, generator=generator)
    levels = [{5: (tokens[:, :, 3:], tokens[:, :, :3])} for tokens in (student, teacher)]
    found, terms = adaptation_loss(levels[0], *teacher_side(levels[1], kept, config), draws, config)

    others = [view for view in range(4) if view != config.reference_view]
    (p, q), (teacher_p, teacher_q) = (
        (
            tokens[:, config.reference_view, 3:][:, draws.angle.reference],
            tokens[:, others, 3:].flatten(1, 2)[:, draws.angle.query.flatten()],
        )
        for tokens in (student, teacher[:, kept])
    )
    held_out = teacher[:, 1::2, 3:].flatten(1, 2)
    chosen = equations.nearest_and_farthest(teacher_p, held_out, count=config.num_anchors)
    anchors = held_out[torch.arange(2)[:, None, None], chosen]
    camera_and_patches = [0, *range(3, 15)]
    features = (student[:, :, camera_and_patches], teacher[:, kept][:, :, camera_and_patches])
    wanted = equations.l_geo(
        features, (p, q), (teacher_p, teacher_q), anchors, delta=config.huber_delta, temperature=2.0
    )
    assert_same_loss(found, wanted, (student,), 1e-9)
    assert terms["total"] == found


def test_outlier_channels_at_temperature_one_keep_every_version_finite():
    generator = torch.Generator().manual_seed(0)
    teacher = torch.randn(1, 8, 20, 32, generator=generator)
    teacher[..., ::7] += 50 * torch.randn(1, 8, 20, 5, generator=generator).sign()
    special = teacher[:, :, :5].clone()
    student = teacher[:, ::2] + 5 * torch.randn(1, 4, 20, 32, generator=generator)
    for config in (replace(PAPER.loss, temperature=1.0), RELEASED_VGGT.loss):
        tokens = 25 if config.cross_tokens == "all" else 20
        draws = draw_tokens(config, tokens_per_view=tokens, student_views=4, held_out=4 * tokens, generator=generator)
        inputs = (student.clone().requires_grad_(), special[:, ::2].clone().requires_grad_())
        side = teacher_side({0: (teacher, special)}, [0, 2, 4, 6], config)
        loss, terms = adaptation_loss({0: inputs}, *side, draws, config)
        loss.backward()
        assert all(term.isfinite() for term in terms.values())
        assert inputs[0].grad.isfinite().all() and inputs[1].grad.isfinite().all()
