"""Algorithm 1: it learns, equals a plain loop to the bit, repeats itself, stops before it does harm, and continues."""

import json
import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import nn

from freegeo.adaptation import adapt as adapting
from freegeo.adaptation.adapt import adapt, learning_rate
from freegeo.adaptation.adapted import loss_change, trouble
from freegeo.adaptation.adapter import Adapter, PackedDropout, is_adapted
from freegeo.adaptation.losses import adaptation_loss, draw_tokens, feature_distance
from freegeo.adaptation.memory import Plan
from freegeo.adaptation.recipe import evidence, named
from freegeo.adaptation.samples import SceneImages, released_augmentation
from freegeo.adaptation.state import UNFINISHED_FILE
from freegeo.adaptation.views import chunk_windows, schedule
from freegeo.errors import DivergedError, FreeGeoError, UserError
from freegeo.models.precision import Compute
from loss_tools import teacher_side
from tiny_models import (
    PATCH,
    noise,
    noise_scene,
    outputs,
    quick,
    same,
    tensors,
    tiny_da3,
    tiny_mapanything,
    tiny_pi3,
    tiny_vggt,
)

IMAGES = noise(4)
MODELS = {"da3": tiny_da3, "vggt": tiny_vggt}


@pytest.fixture(params=MODELS)
def build(request):
    return MODELS[request.param]


def run(model, scenes, recipe, **options):
    return adapt(model, scenes, recipe, **{"seed": 42, **options})


def wide_scene(views: int = 6) -> SceneImages:
    images = noise(views)[..., : 3 * PATCH, :]
    return SceneImages(name="wide", count=views, load=lambda frames: images[list(frames)])


def test_every_share_is_kept_also_where_the_steps_are_fewer():
    model = tiny_da3()
    result = run(model, [wide_scene()], quick(model, steps=2), keep_after=(0.25, 0.5, 0.75))
    assert sorted(result.earlier) == [0.25, 0.5, 0.75]
    first, second, last = (result.earlier[share] for share in (0.25, 0.5, 0.75))
    assert all(torch.equal(first[name], second[name]) for name in first)
    final = result.adapter.named_parameters()
    assert all(torch.equal(last[name], final[name]) for name in last)


# The algorithm --------------------------------------------------------------------------------------------------------


def plain_adaptation(model, scenes, recipe, seed=42):
    """Algorithm 1 without any measure that saves time: embedding and teacher anew in every visit."""
    generator = torch.Generator().manual_seed(seed)
    adapter = Adapter.attach(model, rank=recipe.rank, alpha=recipe.alpha, dropout=recipe.dropout, generator=generator)
    optimiser = torch.optim.AdamW(adapter.parameters(), lr=0.0, weight_decay=recipe.weight_decay, fused=True)
    steps = schedule([scene.count for scene in scenes], recipe, seed)

    def features(images):
        # One view at a time, as the engine embeds on a CPU.
        tokens = type(first := model.embed(images[None, :1])).join_views(
            [first, *(model.embed(images[None, i : i + 1]) for i in range(1, len(images)))]
        )
        return model.aggregate(tokens, layers=model.spec.loss_layers).levels

    for step, visits in enumerate(steps):
        optimiser.zero_grad()
        torch.manual_seed(seed * 1_000_003 + step)
        for visit in visits:
            kept = list(visit.view_set.kept)
            images = scenes[visit.view_set.scene].load(visit.view_set.frames)
            if recipe.augmentation == "released":
                images = released_augmentation(images, visit.view_set.seed)
            with torch.no_grad(), adapter.off():
                teacher = features(images)
            patch, special = teacher[max(teacher)]
            levels, held_out = teacher_side(teacher, kept, recipe.loss)
            draws = draw_tokens(
                recipe.loss,
                tokens_per_view=patch.shape[2] + (special.shape[2] if recipe.loss.cross_tokens == "all" else 0),
                student_views=len(kept),
                held_out=held_out.shape[1],
                generator=torch.Generator().manual_seed(seed * 1_000_003 + step),
            )
            model.train(recipe.dropout > 0)
            loss, _ = adaptation_loss(features(images[kept]), levels, held_out, draws, recipe.loss)
            (loss * (1 / len(visits))).backward()
            if recipe.hold:
                held = recipe.hold * feature_distance(features(images), teacher, recipe.loss)[0]
                (held * (1 / len(visits))).backward()
            model.eval()
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(step, len(steps), recipe)
        torch.nn.utils.clip_grad_norm_(adapter.parameters(), recipe.clip)
        optimiser.step()
    return [parameter.detach() for parameter in adapter.parameters()]


CASES = {
    "da3-scene": (tiny_da3, lambda model: quick(model, steps=5)),
    "vggt-scene": (tiny_vggt, lambda model: quick(model, steps=5)),
    "mapanything-scene": (tiny_mapanything, lambda model: quick(model, steps=3)),
    "da3-batch": (tiny_da3, lambda model: quick(model, epochs=2, batch=3)),
    "vggt-hold-batch": (tiny_vggt, lambda model: quick(model, epochs=2, batch=2, hold=0.5)),
    "da3-dropout-hold": (tiny_da3, lambda model: quick(model, steps=4, dropout=0.1, hold=1.0)),
    "da3-paper": (tiny_da3, lambda model: named("paper", model.spec, "eth3d").changed(sets_per_scene=3, rank=4)),
    "da3-released": (tiny_da3, lambda model: named("released-da3", model.spec, "eth3d").changed(epochs=1, rank=2)),
    "pi3-scene": (tiny_pi3, lambda model: quick(model, steps=5, hold=0.5)),
    "vggt-released": (
        tiny_vggt,
        lambda model: named("released-vggt", model.spec, "eth3d").changed(sets_per_scene=2, rank=2),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_the_run_equals_a_plain_loop_to_the_bit(case):
    build, recipe_of = CASES[case]
    recipe = recipe_of(build())
    scenes = [noise_scene(9), noise_scene(5, seed=1)]
    with torch.random.fork_rng(devices=[]):
        wanted = plain_adaptation(build(), scenes, recipe)
    assert same(tensors(run(build(), scenes, recipe)), wanted)


def test_a_batch_s_gradient_is_the_mean_of_its_view_sets_gradients():
    """In float64, where rounding does not decide: one step of a batch moves A and B by the mean of two single steps."""

    def gradients(recipe):
        model, found = tiny_da3().double(), []
        update = torch.optim.AdamW.step

        def record(self, *args, **options):
            found.append([p.grad.clone() for group in self.param_groups for p in group["params"]])
            return update(self, *args, **options)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(torch.optim.AdamW, "step", record)
            # No rate and no clipping: every step meets the same adapter and leaves its gradient as it is.
            images = noise(9).double()
            scene = SceneImages(name="double", count=9, load=lambda frames: images[list(frames)])
            run(model, [scene], recipe.changed(lr=1e-30, final_lr=1e-30, clip=1e9, weight_decay=0.0))
        return found

    recipe = quick(tiny_da3(), epochs=1, sets_per_scene=2, distinct_seeds=2)
    # With as many draws as there are tokens, the draws of two steps differ in their order only.
    recipe = replace(recipe, loss=replace(recipe.loss, num_reference=16, num_query=48))
    one, two = gradients(recipe.changed(batch=1))
    (both,) = gradients(recipe.changed(batch=2))
    for a, b, mean in zip(one, two, both, strict=True):
        assert torch.allclose((a + b) / 2, mean, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("plan", [Plan(place="disk"), Plan(checkpointing=True)], ids=["disk", "checkpointing"])
@pytest.mark.parametrize("hold", [0.0, 1.0])
def test_a_plan_changes_no_bit_and_leaves_no_file(build, plan, hold, tmp_path):
    def result(plan):
        recipe = quick(build(), steps=4, sets_per_scene=2, distinct_seeds=2, hold=hold)
        return run(build(), [noise_scene(9), wide_scene()], recipe, plan=plan, resume_in=tmp_path)

    plain, planned = result(Plan()), result(plan)
    assert plain.curve == planned.curve
    assert same(tensors(plain), tensors(planned))
    assert list(tmp_path.iterdir()) == []


def test_running_out_of_memory_is_met_once_with_checkpointing_and_disk(build, caplog, monkeypatch):
    recipe, whole, used = quick(build(), steps=3), run(build(), [noise_scene(9)], quick(build(), steps=3)), []
    losses = adapting.adaptation_loss

    def failing(*args, **options):
        used.append(args)
        if len(used) == 2:
            raise torch.OutOfMemoryError("the device is full")
        return losses(*args, **options)

    monkeypatch.setattr(adapting, "adaptation_loss", failing)
    result = run(build(), [noise_scene(9)], recipe)
    assert same(tensors(result), tensors(whole))
    # Two before the memory ran out, three steps, and two looks at what came out.
    assert len(used) == 2 + 3 + 2
    assert "once more with activation checkpointing" in caplog.text

    def always(*args, **options):
        raise torch.OutOfMemoryError("the device is full")

    monkeypatch.setattr(adapting, "adaptation_loss", always)
    model = build()
    with pytest.raises(FreeGeoError, match="ran out of memory even with"):
        run(model, [noise_scene(9)], recipe)
    monkeypatch.undo()
    run(model, [noise_scene(9)], quick(model, steps=1))


# What adaptation does -------------------------------------------------------------------------------------------------


def test_the_loss_falls(build):
    model = build()
    frozen = outputs(model, IMAGES)
    result = run(model, [noise_scene(9)], quick(model, steps=18, sets_per_scene=2, distinct_seeds=2))
    totals = [terms["total"] for terms in result.curve]
    assert len(totals) == 18
    # Every pair of steps sees both view sets.
    assert sum(totals[-4:]) < 0.8 * sum(totals[:4])
    assert result.loss_change() == {"first": totals[0], "last": totals[-1]}
    assert not same(outputs(model, IMAGES), frozen)
    with result.adapter.off():
        assert same(outputs(model, IMAGES), frozen)


def test_every_part_of_the_adapter_moves_and_the_frozen_weights_do_not(build):
    model = build()
    weights = {name: value.clone() for name, value in model.state_dict().items()}
    fresh = Adapter.attach(model, rank=4, alpha=4, dropout=0.0, generator=torch.Generator().manual_seed(42))
    before = {name: parameter.detach().clone() for name, parameter in fresh.named_parameters().items()}
    fresh.detach()
    result = run(model, [noise_scene(8)], quick(model))
    after = result.adapter.named_parameters()
    assert not [name for name, value in before.items() if torch.equal(value, after[name])]
    result.adapter.detach()
    assert all(torch.equal(value, weights[name]) for name, value in model.state_dict().items())


def test_the_same_seed_gives_the_same_tensors_and_another_seed_others(build):
    def result(seed):
        model = build()
        return run(model, [noise_scene(9)], quick(model, steps=2, dropout=0.1), seed=seed)

    one, two, other = result(7), result(7), result(8)
    assert same(tensors(one), tensors(two))
    assert one.curve == two.curve
    assert not same(tensors(one), tensors(other))


def test_the_global_generator_is_left_alone():
    model = tiny_da3()
    before = torch.get_rng_state()
    run(model, [noise_scene(8)], quick(model, steps=1, dropout=0.1))
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("precision", ["bf16", "fp16"])
def test_half_precision_learns_in_full_precision_parameters(precision):
    model = tiny_da3()
    recipe = quick(model, steps=6, sets_per_scene=1, distinct_seeds=1)
    result = run(model, [noise_scene(9)], recipe, compute=Compute(precision=precision))
    assert {tensor.dtype for tensor in tensors(result)} == {torch.float32}
    assert result.curve[-1]["total"] < result.curve[0]["total"]


@pytest.mark.parametrize("views", [3, 4, 5, 6, 7])
def test_few_views_are_enough(build, views):
    result = run(model := build(), [noise_scene(views)], quick(model, steps=2))
    assert all(terms["total"] > 0 for terms in result.curve)


def test_fewer_than_three_views_are_refused_and_leave_the_model_plain():
    model = tiny_da3()
    with pytest.raises(UserError, match="at least 3 photos, got 2"):
        run(model, [noise_scene(2)], quick(model))
    run(model, [noise_scene(3)], quick(model, steps=1))


@pytest.mark.parametrize(
    ("views", "changes", "words"),
    [
        (
            10,
            {"views": 12},
            "(10) than the 12 views of a view set (--views): the teacher sees all 10, the student views 0",
        ),
        (5, {}, "the teacher sees all 5, the student views 0, 2, 4 of them"),
        (4, {"keep": (0, 5)}, "the student views 0, 2 of them, as --keep 0,5 does not fit"),
        (4, {"repeat_views": True}, "some are repeated"),
        (8, {}, ""),
    ],
)
def test_what_is_done_instead_with_few_photos_is_said(views, changes, words, caplog):
    caplog.set_level("INFO", logger="freegeo")
    model = tiny_da3()
    run(model, [noise_scene(views)], quick(model, steps=1, **changes))
    assert words in caplog.text
    assert ("than the" in caplog.text) == bool(words)


@pytest.mark.parametrize("seed", [0, 2**40, 2**64 - 1])
def test_any_seed_of_64_bits_works(seed):
    model = tiny_da3()
    assert run(model, [noise_scene(9)], quick(model, steps=1, dropout=0.1), seed=seed).curve


def test_a_seed_beyond_64_bits_is_refused_before_anything_else():
    model = tiny_da3()
    with pytest.raises(UserError, match="--seed must be from 0"):
        run(model, [noise_scene(9)], quick(model), seed=2**64)
    run(model, [noise_scene(9)], quick(model, steps=1))


def test_a_default_precision_gives_way_to_the_recipe_s_on_a_gpu(monkeypatch):
    class PlannedError(Exception):
        """Ends the run where the precision is known, as there is no GPU."""

    def plan(*args, compute, **options):
        raise PlannedError(compute.precision)

    monkeypatch.setattr(adapting, "plan_adaptation", plan)
    model, cuda = tiny_da3(), torch.device("cuda")
    recipe = named("paper", model.spec, "eth3d")
    asked = Compute(device=cuda, precision="bf16")
    for compute, wanted in (
        (replace(asked, by_default=True), "fp16"),
        (asked, "bf16"),
        (Compute(by_default=True), "fp32"),
    ):
        with pytest.raises(PlannedError, match=wanted):
            run(model, [noise_scene(9)], recipe, compute=compute)


def test_epochs_and_steps_are_announced():
    model, steps, epochs = tiny_da3(), [], []
    run(
        model,
        [noise_scene(9)],
        quick(model, epochs=2, batch=2),
        on_step=lambda progress: steps.append((progress.step, progress.steps, progress.epoch)),
        on_epoch=lambda epoch, adapter: epochs.append((epoch, adapter.parameters()[0].detach().clone())),
    )
    assert steps == [(0, 4, 0), (1, 4, 0), (2, 4, 1), (3, 4, 1)]
    assert [epoch for epoch, _ in epochs] == [0, 1]
    assert not torch.equal(epochs[0][1], epochs[1][1])


def test_a_saved_run_describes_itself_and_leaves_no_state(tmp_path, monkeypatch):
    monkeypatch.setattr(adapting, "SAVE_EVERY_S", -1.0)
    model = tiny_da3()
    result = run(model, [noise_scene(8)], quick(model, steps=2), resume_in=tmp_path)
    assert (tmp_path / UNFINISHED_FILE).is_file()
    result.save(tmp_path)
    assert not (tmp_path / UNFINISHED_FILE).exists()
    about = json.loads((tmp_path / "freegeo.json").read_text())
    assert about["recipe"]["loss"]["temperature"] == model.spec.adaptation.temperature
    assert len(about["loss_curve"]) == 2
    assert (about["scenes"], about["seed"]) == (["noise-0"], 42)


@pytest.mark.parametrize("probability", [0.1, 0.5])
def test_packed_dropout_keeps_the_expectation_and_drops_the_same_in_the_backward_pass(probability):
    torch.manual_seed(0)
    dropout = PackedDropout(probability)
    x = torch.ones(513, 1001, requires_grad=True)
    found = dropout(x)
    found.sum().backward()
    assert torch.equal(found, x.grad)
    assert (found == 0).double().mean().item() == pytest.approx(probability, abs=3e-3)
    assert found.mean().item() == pytest.approx(1, abs=3e-3)
    # Rows and columns are dropped independently of each other.
    dropped = (found == 0).double()
    for axis in (0, 1):
        spread = dropped.mean(axis).std().item()
        assert spread == pytest.approx((probability * (1 - probability) / dropped.shape[axis]) ** 0.5, rel=0.15)
    neighbours = (dropped[:, 1:] * dropped[:, :-1]).mean().item()
    assert neighbours == pytest.approx(probability**2, abs=5e-3)
    dropout.eval()
    assert dropout(x) is x


# Numbers that are not finite ------------------------------------------------------------------------------------------


class Breaker:
    """Makes one element of a layer's output not finite in the student's n-th pass."""

    def __init__(self, layer: nn.Module, at: int, value: float):
        self.passes, self.at, self.value = 0, at, value
        layer.register_forward_hook(self)

    def __call__(self, _module, _inputs, output):
        if not torch.is_grad_enabled():
            return output
        self.passes += 1
        return (
            torch.where(torch.arange(output.shape[-1]) == 0, self.value, output) if self.passes == self.at else output
        )


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_loss_that_is_not_finite_stops_before_the_optimiser(build, value, monkeypatch):
    model, adapters, seen = build(), [], []
    attach = Adapter.attach
    monkeypatch.setattr(
        Adapter, "attach", lambda *args, **options: adapters.append(attach(*args, **options)) or adapters[0]
    )
    blocks = model.backbone["pretrained"].blocks if hasattr(model, "backbone") else model.aggregator.global_blocks
    Breaker(blocks[-1], at=3, value=value)
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}

    def remember(progress):
        seen.append([parameter.detach().clone() for parameter in adapters[0].parameters()])

    with pytest.raises(FreeGeoError, match=r"loss term intra is not finite at step 2\. Lower --lr") as error:
        run(model, [noise_scene(9)], quick(model), on_step=remember)
    assert not isinstance(error.value, UserError)
    assert len(seen) == 2
    assert same([parameter.detach() for parameter in adapters[0].parameters()], seen[-1])
    assert all(torch.equal(tensor, before[name]) for name, tensor in model.state_dict().items())


def test_a_gradient_that_is_not_finite_stops_the_run(monkeypatch):
    losses = adapting.adaptation_loss

    def broken(*args, **options):
        loss, terms = losses(*args, **options)
        # The value stays as it is; its gradient is infinite.
        return loss + (loss - loss.detach()).abs().sqrt(), terms

    monkeypatch.setattr(adapting, "adaptation_loss", broken)
    model = tiny_da3()
    with pytest.raises(FreeGeoError, match="gradient is not finite at step 0"):
        run(model, [noise_scene(9)], quick(model))


# Results that should not be used --------------------------------------------------------------------------------------


@pytest.mark.parametrize("lr", [0.3, 1.0, 100.0, 1e30])
def test_a_loss_that_blows_up_ends_the_run_in_a_sentence_and_leaves_the_model_plain(build, lr):
    model = build()
    frozen = outputs(model, IMAGES)
    with pytest.raises(
        DivergedError, match=r"^adaptation diverged: .* by step \d+|.* is not finite at step \d+"
    ) as error:
        run(model, [noise_scene(9)], quick(model, steps=40, lr=lr))
    assert str(error.value).endswith(f"Lower --lr (now {lr:g}).")
    assert same(outputs(model, IMAGES), frozen)
    Adapter.attach(model, rank=2, alpha=2, dropout=0.0, generator=torch.Generator())


@pytest.mark.parametrize(
    ("steps", "lr", "words"),
    [
        (1, 100.0, "worse at its own task"),  # the only update comes after the only loss of the curve
        (12, 0.1, "worse at its own task"),  # the loss falls again from its peak, to ten times that of the start
        (3, 1e-30, "gained nothing"),
        (12, 3e-3, None),
    ],
)
def test_an_adapter_that_is_no_better_than_none_says_so(build, steps, lr, words, tmp_path):
    model = build()
    result = run(model, [noise_scene(9)], quick(model, steps=steps, lr=lr))
    said = result.trouble
    assert (said is None) == (words is None)
    if words is not None:
        assert words in said and f"--lr (now {lr:g})" in said
        assert "not to be used" in repr(result)
    result.save(tmp_path)
    assert json.loads((tmp_path / "freegeo.json").read_text())["trouble"] == said


def test_the_look_at_what_came_out_compares_equal_view_sets_and_tokens(build):
    """With an adapter that changes nothing the two losses are equal to the bit, and equal to that of the last step."""
    model = build()
    recipe = quick(model, steps=5, batch=2, lr=1e-30, weight_decay=0.0)
    result = run(model, [noise_scene(9), noise_scene(5, seed=1)], recipe)
    assert result.gain["frozen"] == result.gain["adapted"]
    assert result.gain["adapted"] == pytest.approx(result.curve[-1]["total"], rel=1e-6)


def test_a_value_that_is_not_finite_is_found_wherever_it_is(build, tmp_path):
    model = build()
    result = run(model, [noise_scene(9)], quick(model, steps=2, lr=1e-3))
    for name, parameter in result.adapter.named_parameters().items():
        kept = parameter.detach().flatten()[-1].clone()
        with torch.no_grad():
            parameter.view(-1)[-1] = float("nan") if name == "camera_token" else float("inf")
        assert f"values that are not finite (1 tensors, first {name})" in result.trouble
        with torch.no_grad():
            parameter.view(-1)[-1] = kept
    assert "not finite" not in str(result.trouble)
    result.gain = {"frozen": 0.5, "adapted": float("inf")}
    result.save(tmp_path)
    # Also for readers of JSON that know no infinity.
    about = json.loads((tmp_path / "freegeo.json").read_text(), parse_constant=pytest.fail)
    assert about["gain"] == {"frozen": 0.5, "adapted": None}


@pytest.mark.parametrize(
    ("frozen", "adapted", "words"),
    [
        (0.5, 0.3, None),
        (0.5, 0.4994, None),  # three steps at a hundredth of the usual rate
        (0.5, 0.499999, "gained nothing"),
        (0.5, 0.500001, "gained nothing"),  # rounding
        (0.0, 0.0, "gained nothing"),  # copies of one photo
        (0.5, 0.51, "worse"),
        (0.0, 1e-9, "worse"),
        (0.5, 1.6e15, "worse"),
        (0.5, float("inf"), "is not finite"),
        (0.5, float("nan"), "is not finite"),
        (float("nan"), 0.5, "is not finite"),
    ],
)
def test_the_rule_for_what_may_be_used(frozen, adapted, words):
    said = trouble({"frozen": frozen, "adapted": adapted}, [], quick(tiny_da3()))
    assert said is None if words is None else words in said


# Stopping and going on ------------------------------------------------------------------------------------------------


class Killed(BaseException):
    """Stands for the end of the process."""


@pytest.mark.parametrize("at", [1, 3])
def test_an_interrupted_run_goes_on_to_the_same_end(build, at, tmp_path, monkeypatch):
    monkeypatch.setattr(adapting, "SAVE_EVERY_S", -1.0)
    scenes = [noise_scene(9), noise_scene(4, seed=1)]

    def result(on_step=lambda progress: None, **options):
        model = build()
        return run(model, scenes, quick(model, steps=5, dropout=0.1), on_step=on_step, **options)

    def interrupt(progress):
        if progress.step == at:
            raise Killed

    whole, resumed_steps = result(), []
    with pytest.raises(Killed):
        result(interrupt, resume_in=tmp_path)
    resumed = result(lambda progress: resumed_steps.append(progress.step), resume_in=tmp_path)
    assert resumed_steps == list(range(at, 5))
    assert resumed.curve == whole.curve
    assert same(tensors(resumed), tensors(whole))


class Stopper:
    """Sends a signal to this process in the student's n-th pass."""

    def __init__(self, layer: nn.Module, at: int, number: signal.Signals):
        self.passes, self.at, self.number = 0, at, number
        layer.register_forward_hook(self)

    def __call__(self, *_):
        if torch.is_grad_enabled():
            self.passes += 1
            if self.passes == self.at:
                signal.raise_signal(self.number)


@pytest.fixture(params=[signal.SIGINT, signal.SIGTERM], ids=["Ctrl-C", "SIGTERM"])
def stopping(request, monkeypatch):
    """A signal and the exception that it raises; for SIGTERM as programs do that exit in an orderly way."""
    if request.param == signal.SIGINT:
        return request.param, KeyboardInterrupt
    before = signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    request.addfinalizer(lambda: signal.signal(signal.SIGTERM, before))
    return request.param, SystemExit


def last_block(model):
    return (model.backbone["pretrained"].blocks if hasattr(model, "backbone") else model.aggregator.global_blocks)[-1]


@pytest.mark.parametrize("at", [2, 4])
def test_a_signal_during_a_step_saves_the_state_of_the_step_before(build, at, stopping, tmp_path, caplog):
    number, error = stopping
    caplog.set_level("INFO", logger="freegeo")
    scenes, model = [noise_scene(9), noise_scene(4, seed=1)], build()
    recipe = quick(model, steps=5, dropout=0.1)
    Stopper(last_block(model), at, number)
    with pytest.raises(error):
        run(model, scenes, recipe, resume_in=tmp_path)
    assert f"stopped after step {at - 1} of 5; the state is saved in {tmp_path}" in caplog.text
    steps = []
    resumed = run(build(), scenes, recipe, resume_in=tmp_path, on_step=lambda progress: steps.append(progress.step))
    whole = run(build(), scenes, recipe)
    assert steps == list(range(at - 1, 5))
    assert resumed.curve == whole.curve
    assert resumed.gain == whole.gain
    assert same(tensors(resumed), tensors(whole))


def test_a_signal_within_an_update_waits_until_that_is_whole(stopping, tmp_path, monkeypatch):
    number, error = stopping
    model, step, seen = tiny_da3(), torch.optim.AdamW.step, []
    recipe = quick(model, steps=5)

    def signalled(self, *args, **options):
        if len(seen) == 2:
            signal.raise_signal(number)
        seen.append(step(self, *args, **options))

    with monkeypatch.context() as patch:
        patch.setattr(torch.optim.AdamW, "step", signalled)
        with pytest.raises(error):
            run(model, [noise_scene(9)], recipe, resume_in=tmp_path)
    assert len(seen) == 3
    steps = []
    resumed = run(tiny_da3(), [noise_scene(9)], recipe, resume_in=tmp_path, on_step=lambda p: steps.append(p.step))
    assert steps == [3, 4]
    assert same(tensors(resumed), tensors(run(tiny_da3(), [noise_scene(9)], recipe)))
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_run_that_is_stopped_before_its_first_step_or_without_a_folder_saves_nothing(tmp_path):
    for at, folder in ((1, tmp_path), (3, None)):
        model = tiny_da3()
        Stopper(last_block(model), at, signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            run(model, [noise_scene(9)], quick(model), resume_in=folder)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("stage", ["on_step", "on_epoch"])
def test_an_epoch_that_ended_as_the_run_was_stopped_is_announced_when_it_goes_on(tmp_path, stage):
    """Else its adapter would never be kept, and the one of the epoch before would be taken for the last one."""

    def train(kept, **options):
        def keep(epoch, adapter):
            kept[epoch] = [one.detach().clone() for one in adapter.parameters()]

        recipe = quick(tiny_da3(), epochs=2, sets_per_scene=1, distinct_seeds=1, batch=1)
        run(tiny_da3(), [noise_scene(4)], recipe, **{"on_epoch": keep, **options})

    def stop(*arguments):
        raise KeyboardInterrupt

    whole, kept = {}, {}
    train(whole)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            train(kept, resume_in=tmp_path, **{stage: stop})
    train(kept, resume_in=tmp_path)
    assert kept.keys() == whole.keys() == {0, 1}
    assert all(same(kept[epoch], whole[epoch]) for epoch in whole)


def test_a_run_in_a_thread_takes_no_signals():
    """Handlers belong to the main thread."""
    model, found = tiny_da3(), []
    thread = threading.Thread(target=lambda: found.append(run(model, [noise_scene(9)], quick(model, steps=1))))
    thread.start()
    thread.join()
    assert len(found) == 1


def test_the_seconds_of_a_run_are_those_of_all_its_parts(tmp_path, monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(adapting.time, "monotonic", lambda: clock[0])

    def tick(progress):
        clock[0] += 10.0
        if stop and progress.step == 2:
            raise KeyboardInterrupt

    stop = True
    with pytest.raises(KeyboardInterrupt):
        run(model := tiny_da3(), [noise_scene(9)], quick(model, steps=4), resume_in=tmp_path, on_step=tick)
    stop = False
    result = run(model := tiny_da3(), [noise_scene(9)], quick(model, steps=4), resume_in=tmp_path, on_step=tick)
    assert result.seconds == 40.0


def test_a_recipe_that_draws_anew_goes_on_to_the_same_end(tmp_path, monkeypatch):
    monkeypatch.setattr(adapting, "SAVE_EVERY_S", -1.0)

    def result(on_step=lambda progress: None, **options):
        recipe = named("released-vggt", tiny_vggt().spec, "eth3d").changed(epochs=3, sets_per_scene=2, rank=2, batch=1)
        return run(tiny_vggt(), [noise_scene(9)], recipe, on_step=on_step, **options)

    def stop(progress):
        if progress.step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        result(stop, resume_in=tmp_path)
    assert same(tensors(result(resume_in=tmp_path)), tensors(result()))


PROGRAM = """
import sys, time, torch
sys.path[:0] = {path!r}
torch.set_num_threads(1)
from pathlib import Path
from freegeo.adaptation import adapt as adapting
from freegeo.adaptation.memory import Plan
from tiny_models import noise_scene, quick, tiny_da3
adapting.SAVE_EVERY_S = -1.0
model = tiny_da3()
def shown(progress):
    print(progress.step, flush=True)
    if progress.step == 5:
        time.sleep(60)
adapting.adapt(model, [noise_scene(9), noise_scene(5, seed=1)], quick(model, steps=8, batch=2, dropout=0.1), seed=42,
               plan=Plan(place="disk"), resume_in=Path({folder!r}), on_step=shown)
"""


@pytest.mark.slow
def test_a_killed_process_s_run_ends_with_the_same_tensors(tmp_path):
    def result(**options):
        model = tiny_da3()
        recipe = quick(model, steps=8, batch=2, dropout=0.1)
        return run(model, [noise_scene(9), noise_scene(5, seed=1)], recipe, **options)

    source = Path(adapting.__file__).parents[2]
    path = [str(source), str(Path(__file__).parent.parent)]
    program = PROGRAM.format(path=path, folder=str(tmp_path))
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.strip() == "5":
                os.kill(process.pid, signal.SIGKILL)
                break
    assert [path for path in tmp_path.iterdir() if path.is_dir()]
    steps = []
    resumed = result(plan=Plan(place="disk"), resume_in=tmp_path, on_step=lambda progress: steps.append(progress.step))
    whole = result()
    assert steps == [5, 6, 7]
    # What the killed process kept on disk is gone, too.
    assert not [path for path in tmp_path.iterdir() if path.is_dir()]
    assert resumed.curve == whole.curve
    assert same(tensors(resumed), tensors(whole))


@pytest.mark.parametrize("changed", ["seed", "recipe", "scenes", "windows", "compute"])
def test_the_state_of_another_run_is_refused(changed, tmp_path, monkeypatch):
    monkeypatch.setattr(adapting, "SAVE_EVERY_S", -1.0)
    model = tiny_da3()
    recipe = quick(model, steps=2)
    run(model, [noise_scene(9)], recipe, resume_in=tmp_path).adapter.detach()
    options = {"scenes": [noise_scene(9)], "recipe": recipe, "seed": 42, "compute": Compute()}
    options |= {
        "seed": {"seed": 1},
        "recipe": {"recipe": recipe.changed(lr=1.0)},
        "scenes": {"scenes": [noise_scene(8)]},
        "windows": {"scenes": [replace(noise_scene(9), windows=((0, 1, 2, 3), (4, 5, 6, 7, 8)))]},
        "compute": {"compute": Compute(precision="bf16")},
    }[changed]
    with pytest.raises(UserError, match="belongs to another run"):
        run(model, resume_in=tmp_path, **options)
    # The refusal leaves no adapter behind.
    Adapter.attach(model, rank=2, alpha=2, dropout=0.0, generator=torch.Generator())


def test_a_damaged_state_is_refused(tmp_path):
    (tmp_path / UNFINISHED_FILE).write_bytes(b"no tensors")
    model = tiny_da3()
    with pytest.raises(UserError, match="damaged state"):
        run(model, [noise_scene(9)], quick(model), resume_in=tmp_path)


@pytest.mark.parametrize(
    ("totals", "first", "last"), [([3.0], 3.0, 3.0), ([4.0, 2.0], 4.0, 2.0), ([4.0, 2.0] * 10, 3.0, 3.0)]
)
def test_loss_change_is_of_the_first_and_last_tenth(totals, first, last):
    assert loss_change([{"total": total} for total in totals]) == {"first": first, "last": last}


# Sequences ------------------------------------------------------------------------------------------------------------


def in_windows(count: int, *windows, load=None) -> SceneImages:
    scene = noise_scene(count)
    return replace(scene, windows=tuple(map(tuple, windows)), load=load or scene.load)


def test_a_sequence_is_learned_part_by_part_and_its_images_are_never_loaded_together(caplog):
    model, scene, asked = tiny_da3(), noise_scene(60), []

    def load(frames):
        asked.append(tuple(frames))
        return scene.load(frames)

    windows = chunk_windows([tuple(range(start, start + 12)) for start in range(0, 49, 8)])
    recipe = quick(model, steps=len(windows))
    with caplog.at_level("INFO"):
        result = run(model, [in_windows(60, *windows, load=load)], recipe)
    assert max(map(len, asked)) <= recipe.views
    assert all(any(set(frames) <= set(window) for window in windows) for frames in asked)
    assert {frame for frames in asked for frame in frames} > set(range(0, 50, 10)), "from the first to the last part"
    assert result.metadata()["windows"] == [len(windows)]
    assert "cannot visit" not in caplog.text
    result.adapter.detach()
    plain = run(model, [scene], recipe)
    assert plain.metadata()["windows"] == [None]
    assert not same(tensors(plain), tensors(result))


def test_what_the_parts_of_a_sequence_are_too_small_or_too_many_for_is_said(caplog):
    with caplog.at_level("INFO"):
        run(tiny_da3(), [in_windows(12, range(4), range(4, 8), range(8, 12))], quick(tiny_da3(), steps=2))
    assert "3 of 3 parts of the sequence have fewer photos (4) than the 8 views" in caplog.text
    assert "2 view sets cannot visit all 3 parts of the sequence" in caplog.text


def test_a_recipe_that_learns_cameras_refuses_a_sequence_in_chunks():
    model = tiny_da3()
    with pytest.raises(UserError, match=r"recipe 'evidence' learns from cameras .* a sequence in chunks has not"):
        run(model, [in_windows(12, range(4), range(4, 12))], evidence(model.spec))


# -- a term of the user's own


def test_a_term_of_one_s_own_is_added_to_the_loss_and_named(tmp_path):
    seen = []

    def far_from_teacher(student, teacher):
        layer = max(student.levels)
        assert student.levels.keys() == teacher.levels.keys()
        ours, theirs = student.levels[layer][0], teacher.levels[layer][0]
        assert ours.shape == theirs.shape and not theirs.requires_grad
        seen.append(ours.shape[1])
        return 3 * (ours - theirs).square().mean()

    curves, ends = [], []
    for own_loss in (None, far_from_teacher):
        model = tiny_da3()
        result = adapt(model, [noise_scene(8)], quick(model), seed=1, own_loss=own_loss)
        curves.append(result.curve)
        ends.append(tensors(result))
        result.save(tmp_path)
    assert set(seen) == {4}, "the views of the student"
    first, with_own = curves[0][0], curves[1][0]
    assert with_own["total"] == pytest.approx(first["total"] + with_own["own"], rel=1e-5)
    assert with_own["own"] > 0
    assert not same(*ends)
    assert json.loads((tmp_path / "freegeo.json").read_text())["own_loss"].endswith("far_from_teacher")


def test_a_term_of_one_s_own_gets_nothing_of_the_student_as_the_teacher_s():
    def term(student, teacher):
        assert student.extra and not teacher.extra
        return student.levels[max(student.levels)][0].square().mean()

    model = tiny_mapanything()
    adapt(model, [noise_scene(4)], quick(model, steps=1), seed=1, own_loss=term)


@pytest.mark.parametrize(
    ("term", "words"),
    [
        (lambda student, teacher: 0.5, "it returned float"),
        (lambda student, teacher: student.levels[max(student.levels)][0], r"it returned a tensor of \("),
        (lambda student, teacher: teacher.levels[max(teacher.levels)][0].mean(), "from which nothing is learned"),
    ],
)
def test_terms_that_are_no_loss_are_refused(term, words):
    model = tiny_da3()
    with pytest.raises(UserError, match=words):
        adapt(model, [noise_scene(4)], quick(model), seed=1, own_loss=term)
    assert not is_adapted(model)
