"""Draws, anchors and the assembled loss: what takes part and how gradients behave."""

from dataclasses import FrozenInstanceError, replace

import pytest
import torch

from freegeo.adaptation.losses import (
    adaptation_loss,
    choose_form,
    draw_tokens,
    teacher_spread,
)
from freegeo.adaptation.losses.sampling import anchor_tokens, search_anchors
from freegeo.adaptation.recipe import PAPER, RELEASED_DA3, RELEASED_VGGT
from freegeo.errors import UserError
from loss_tools import teacher_side

KEPT = [0, 2, 4, 6]
CONFIGS = {
    "paper": PAPER.loss,
    "released-da3": RELEASED_DA3.loss,
    "released-vggt": RELEASED_VGGT.loss,
}


def features(seed=0, dtype=torch.float32, special=3):
    """Teacher (8 views) and student (4 views) features of two layers: 20 patches, `special` special tokens."""
    generator = torch.Generator().manual_seed(seed)
    teacher, student = {}, {}
    for layer in (5, 11):
        parts = [4 * torch.randn(2, 8, tokens, 24, generator=generator) for tokens in (20, special)]
        teacher[layer] = tuple(part.to(dtype) for part in parts)
        student[layer] = tuple(
            (part[:, KEPT] + torch.randn(2, 4, *part.shape[2:], generator=generator)).to(dtype).requires_grad_()
            for part in parts
        )
    return student, teacher


def draws_for(config, seed=1, special=3):
    tokens = 20 + (special if config.cross_tokens == "all" else 0)
    generator = torch.Generator().manual_seed(seed)
    return draw_tokens(config, tokens_per_view=tokens, student_views=4, held_out=4 * tokens, generator=generator)


def loss_and_gradient(student, teacher, config, scale=1.0, **settings):
    draws = draws_for(config)
    loss, terms = adaptation_loss(student, *teacher_side(teacher, KEPT, config), draws, config, **settings)
    inputs = [part for level in student.values() for part in level]
    found = torch.autograd.grad(scale * loss, inputs, allow_unused=True)
    return terms, [torch.zeros_like(part) if grad is None else grad for part, grad in zip(inputs, found, strict=True)]


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS.keys())
def test_student_that_equals_the_teacher_has_no_loss(config):
    _, teacher = features()
    student = {layer: tuple(part[:, KEPT].clone() for part in level) for layer, level in teacher.items()}
    draws = draws_for(config)
    _, terms = adaptation_loss(student, *teacher_side(teacher, KEPT, config), draws, config)
    assert all(abs(term) < 1e-6 for term in terms.values())


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS.keys())
def test_terms_add_up_and_carry_no_graph(config):
    student, teacher = features()
    terms, _ = loss_and_gradient(student, teacher, config)
    assert not any(term.requires_grad for term in terms.values())
    assert all(term.dtype == torch.float32 and term.shape == () for term in terms.values())
    intra = config.weight_huber * terms["huber"] + config.weight_cosine * terms["cos"]
    phi = sum(weight * terms[f"phi{number}"] for number, weight in enumerate(config.angle_weights, 1))
    kl = config.weight_pk * terms["kl_pk"] + config.weight_pq * terms["kl_pq"]
    kl = kl + (config.weight_kq * terms["kl_kq"] if config.weight_kq else 0)
    torch.testing.assert_close(terms["intra"], intra)
    torch.testing.assert_close(terms["cross"], phi + kl)
    torch.testing.assert_close(terms["total"], intra + phi + kl)


def test_special_tokens_take_part_as_the_version_says():
    student, teacher = features()
    touched = {}
    for name, config in CONFIGS.items():
        _, grads = loss_and_gradient(student, teacher, config)
        touched[name] = grads[1].abs().amax((0, 1, 3)) > 0  # special tokens of the first layer
    assert touched["paper"].tolist() == [True, False, False]
    assert touched["released-da3"].tolist() == [False, False, False]
    assert touched["released-vggt"].tolist() == [True, True, True]


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS.keys())
def test_gradient_is_linear_in_the_scale_and_survives_a_second_pass(config):
    student, teacher = features(dtype=torch.float64)
    _, once = loss_and_gradient(student, teacher, config)
    _, scaled = loss_and_gradient(student, teacher, config, scale=65536.0)
    for small, large in zip(once, scaled, strict=True):
        torch.testing.assert_close(65536.0 * small, large)
    draws = draws_for(config)
    loss, _ = adaptation_loss(student, *teacher_side(teacher, KEPT, config), draws, config)
    loss.backward(retain_graph=True)
    loss.backward()
    for part, single in zip((part for level in student.values() for part in level), once, strict=True):
        if part.grad is not None:
            torch.testing.assert_close(part.grad, 2 * single)


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS.keys())
def test_half_features_and_autocast_compute_in_float32(config):
    student, teacher = features(dtype=torch.bfloat16)
    wide = [
        {layer: tuple(part.detach().float().requires_grad_() for part in level) for layer, level in levels.items()}
        for levels in (student, teacher)
    ]
    wanted, wide_grads = loss_and_gradient(*wide, config)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found, grads = loss_and_gradient(student, teacher, config)
    for name, value in wanted.items():
        assert found[name].dtype == torch.float32
        torch.testing.assert_close(found[name], value, rtol=1e-6, atol=1e-7)
    for half, full in zip(grads, wide_grads, strict=True):
        assert half.dtype == torch.bfloat16
        torch.testing.assert_close(half.float(), full, rtol=2e-2, atol=1e-5)


def test_a_given_form_equals_the_measured_one():
    config = CONFIGS["paper"]
    student, teacher = features()
    draws = draws_for(config)
    levels, held_out = teacher_side(teacher, KEPT, config)
    spread = teacher_spread(levels[11], held_out, draws, config)
    measured, _ = loss_and_gradient(student, teacher, config)
    given, _ = loss_and_gradient(student, teacher, config, form=choose_form(float(spread), headroom=1.25))
    assert all(measured[name] == given[name] for name in measured)


def test_weights_of_zero_leave_their_terms_out():
    student, teacher = features()
    config = replace(CONFIGS["paper"], angle_weights=(0.0, 0.0, 0.0), weight_pk=0.0, weight_pq=0.0, weight_kq=0.0)
    terms, _ = loss_and_gradient(student, teacher, config)
    assert terms.keys() == {"intra", "huber", "cos", "total"}


def test_draws_follow_the_generator_and_the_version():
    paper, released = (draws_for(CONFIGS[name], special=5) for name in ("paper", "released-vggt"))
    assert paper.shared and paper.angle.query.shape == (1, 60) and paper.angle.reference.shape == (20,)
    assert not released.shared and released.angle.query.shape == (3, 25)
    assert (released.angle.query[1] - released.angle.query[0] == 25).all()
    assert not torch.equal(released.angle.reference, released.distance.reference)
    again = draws_for(CONFIGS["released-vggt"], special=5)
    assert torch.equal(again.distance.query, released.distance.query)
    few = draws_for(replace(CONFIGS["paper"], num_reference=7, num_query=9))
    assert few.angle.reference.unique().numel() == 7 and few.angle.query.unique().numel() == 9


def test_random_anchors_are_part_of_the_draw():
    config = replace(CONFIGS["released-da3"], selection="random")
    student, teacher = features()
    draws = draws_for(config)
    assert draws.angle.anchor.shape == (20, 4) and int(draws.angle.anchor.max()) < 80
    levels, held_out = teacher_side(teacher, KEPT, config)
    assert torch.equal(held_out, teacher[11][0][:, 1::2].flatten(1, 2))
    assert torch.equal(anchor_tokens(levels[11], held_out, draws, config)[0], held_out[:, draws.angle.anchor])
    assert torch.isfinite(adaptation_loss(student, levels, held_out, draws, config)[0])


def test_mixed_anchors_are_the_most_and_the_least_similar():
    angles = torch.deg2rad(torch.tensor([10.0, 170.0, 90.0, 5.0, 150.0]))
    held_out = torch.stack([angles.cos(), angles.sin()], dim=-1)[None] * torch.tensor([1.0, 9, 3, 2, 5])[:, None]
    reference = torch.tensor([[[2.0, 0.0]]])
    assert search_anchors(reference, held_out, num_anchors=3, selection="mixed").tolist() == [[[3, 1, 4]]]
    assert search_anchors(reference, held_out, num_anchors=3, selection="topk").tolist() == [[[3, 0, 2]]]
    with pytest.raises(UserError, match="fewer than the 6 anchors"):
        search_anchors(reference, held_out, num_anchors=6, selection="mixed")


def test_anchors_do_not_depend_on_the_size_of_the_blocks(monkeypatch):
    _, teacher = features()
    reference, held_out = teacher[5][0][:, 0], teacher[5][0][:, 1::2].flatten(1, 2)
    whole = search_anchors(reference, held_out, num_anchors=4, selection="mixed")
    monkeypatch.setattr("freegeo.adaptation.losses.sampling.SIMILARITY_ELEMENTS", 500)
    assert torch.equal(search_anchors(reference, held_out, num_anchors=4, selection="mixed"), whole)


def test_anchors_are_those_of_the_draw():
    _, teacher = features()
    config = CONFIGS["released-da3"]
    draws = draws_for(config)
    held_out = teacher[11][0][:, 1::2].flatten(1, 2)
    levels, _ = teacher_side(teacher, KEPT, config)
    anchors = anchor_tokens(levels[11], held_out, draws, config)
    for draw, found in zip((draws.angle, draws.distance), anchors, strict=True):
        wanted = search_anchors(teacher[11][0][:, 0, draw.reference], held_out, num_anchors=4, selection="mixed")
        assert all(torch.equal(found[b], held_out[b][wanted[b]]) for b in range(2))


def test_what_cannot_work_is_refused():
    config = CONFIGS["paper"]
    with pytest.raises(UserError, match="temperature must be positive"):
        replace(config, temperature=0.0)
    with pytest.raises(UserError, match="needs pairing 'paired'"):
        replace(config, distance_mode="huber")
    with pytest.raises(UserError, match="selection is one of mixed, topk, random, not best"):
        replace(config, selection="best")
    with pytest.raises(UserError, match="3 numbers, one for each angle"):
        replace(config, angle_weights=(1.0, 1.0))
    for weights in ({"weight_kq": -1.0}, {"weight_huber": float("nan")}, {"angle_weights": (1.0, -1.0, 1.0)}):
        with pytest.raises(UserError, match="weights must be 0 or more"):
            replace(config, **weights)
    with pytest.raises(UserError, match="reference_view is 9"):
        draw_tokens(
            replace(config, reference_view=9),
            tokens_per_view=4,
            student_views=2,
            held_out=4,
            generator=torch.Generator(),
        )
    with pytest.raises(FrozenInstanceError):
        config.temperature = 2.0


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS.keys())
@pytest.mark.parametrize("form", ["float64", "direct"])
def test_blocks_do_not_change_the_loss(monkeypatch, config, form):
    student, teacher = features(dtype=torch.float64)
    whole, whole_grads = loss_and_gradient(student, teacher, config, form=form)
    monkeypatch.setattr("freegeo.adaptation.losses.numerics.CPU_BLOCK_ELEMENTS", 300)
    parts, part_grads = loss_and_gradient(student, teacher, config, form=form)
    for name, value in whole.items():
        torch.testing.assert_close(parts[name], value)
    torch.testing.assert_close(part_grads, whole_grads)
