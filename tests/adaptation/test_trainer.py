"""The adaptation loop: it learns, repeats itself, shares work without changing a bit, and stops before it does harm."""

import json

import pytest
import torch
from torch import nn

from freegeo.adaptation import trainer
from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.recipe import released
from freegeo.adaptation.trainer import Engine, adapt
from freegeo.errors import FreeGeoError, UserError
from tiny_models import noise, noise_scene, outputs, quick, same, tiny_da3, tiny_vggt

IMAGES = noise(4)
MODELS = {"da3": tiny_da3, "vggt": tiny_vggt}


@pytest.fixture(params=MODELS)
def build(request):
    return MODELS[request.param]


def trained_tensors(result) -> list[torch.Tensor]:
    return [parameter.detach() for parameter in result.adapter.parameters()]


def test_the_loss_falls(build):
    model = build()
    frozen = outputs(model, IMAGES)
    result = adapt(model, [noise_scene(9)], quick(model, steps=18, sets_per_scene=2, distinct_seeds=2))
    totals = [terms["total"] for terms in result.curve]
    assert len(totals) == 18
    # Every pair of steps sees both view sets.
    assert sum(totals[-4:]) < 0.8 * sum(totals[:4])
    assert not same(outputs(model, IMAGES), frozen)
    with result.adapter.off():
        assert same(outputs(model, IMAGES), frozen)


def test_every_part_of_the_adapter_moves(build):
    model = build()
    fresh = Adapter.attach(model, rank=4, alpha=4, dropout=0.0, generator=torch.Generator().manual_seed(42))
    before = {name: parameter.detach().clone() for name, parameter in fresh.named_parameters().items()}
    fresh.detach()
    after = adapt(model, [noise_scene(8)], quick(model)).adapter.named_parameters()
    assert not [name for name, value in before.items() if torch.equal(value, after[name])]


def test_the_frozen_weights_do_not_move(build):
    model = build()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    adapt(model, [noise_scene(8)], quick(model)).adapter.detach()
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


def test_the_same_seed_gives_the_same_tensors_and_another_seed_others(build):
    def run(seed):
        model = build()
        return adapt(model, [noise_scene(9)], quick(model, steps=2, dropout=0.1), seed=seed)

    one, two, other = run(7), run(7), run(8)
    assert same(trained_tensors(one), trained_tensors(two))
    assert one.curve == two.curve
    assert not same(trained_tensors(one), trained_tensors(other))


def test_the_global_generator_is_left_alone():
    model = tiny_da3()
    before = torch.get_rng_state()
    adapt(model, [noise_scene(8)], quick(model, steps=1, dropout=0.1))
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize(
    "engine",
    [Engine(share_prefix=False), Engine(cache_teacher=False), Engine(recompute_blocks=True)],
    ids=["prefix-not-shared", "teacher-recomputed", "blocks-recomputed"],
)
def test_sharing_work_changes_no_bit(build, engine):
    def run(engine):
        model = build()
        recipe = quick(model, steps=4, sets_per_scene=1, distinct_seeds=1)
        return adapt(model, [noise_scene(9), noise_scene(5, seed=1)], recipe, engine=engine)

    shared, separate = run(Engine()), run(engine)
    assert shared.curve == separate.curve
    assert same(trained_tensors(shared), trained_tensors(separate))


def test_the_released_recipe_runs_with_its_augmentation_and_drawing_anew():
    runs = {}
    for share in (True, False):
        model = tiny_vggt()
        recipe = released("released-vggt", "eth3d").changed(steps=4, sets_per_scene=2, rank=2)
        runs[share] = adapt(model, [noise_scene(5)], recipe, engine=Engine(share_prefix=share))
    assert runs[True].curve == runs[False].curve
    assert "kl_kq" not in runs[True].curve[0]


@pytest.mark.parametrize("views", [3, 4, 5, 6, 7])
def test_few_views_are_enough(build, views):
    model = build()
    result = adapt(model, [noise_scene(views)], quick(model, steps=2))
    assert all(terms["total"] > 0 for terms in result.curve)


def test_fewer_than_three_views_are_refused_and_leave_the_model_plain():
    model = tiny_da3()
    with pytest.raises(UserError, match="at least 3 photos, got 2"):
        adapt(model, [noise_scene(2)], quick(model))
    adapt(model, [noise_scene(3)], quick(model, steps=1))


def test_epochs_and_steps_are_announced():
    model, steps, epochs = tiny_da3(), [], []
    adapt(
        model,
        [noise_scene(9)],
        quick(model, epochs=2, batch=2),
        on_step=lambda progress: steps.append((progress.step, progress.steps, progress.epoch)),
        on_epoch=lambda epoch, adapter: epochs.append((epoch, adapter.parameters()[0].detach().clone())),
    )
    assert steps == [(0, 4, 0), (1, 4, 0), (2, 4, 1), (3, 4, 1)]
    assert [epoch for epoch, _ in epochs] == [0, 1]
    assert not torch.equal(epochs[0][1], epochs[1][1])


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

    with pytest.raises(FreeGeoError, match="Loss term intra is not finite at step 2") as error:
        adapt(model, [noise_scene(9)], quick(model), on_step=remember)
    assert not isinstance(error.value, UserError)
    assert len(seen) == 2
    assert same([parameter.detach() for parameter in adapters[0].parameters()], seen[-1])
    assert all(torch.equal(tensor, before[name]) for name, tensor in model.state_dict().items())


class Killed(BaseException):
    """Stands for the end of the process."""


@pytest.mark.parametrize("at", [1, 3])
def test_an_interrupted_run_goes_on_to_the_same_end(build, at, tmp_path, monkeypatch):
    monkeypatch.setattr(trainer, "SAVE_EVERY_S", -1.0)
    scenes = [noise_scene(9), noise_scene(4, seed=1)]

    def run(on_step=lambda progress: None, **options):
        model = build()
        return adapt(model, scenes, quick(model, steps=5, dropout=0.1), on_step=on_step, **options)

    def interrupt(progress):
        if progress.step == at:
            raise Killed

    whole, resumed_steps = run(), []
    with pytest.raises(Killed):
        run(interrupt, resume_in=tmp_path)
    resumed = run(lambda progress: resumed_steps.append(progress.step), resume_in=tmp_path)
    assert resumed_steps == list(range(at, 5))
    assert resumed.curve == whole.curve
    assert same(trained_tensors(resumed), trained_tensors(whole))


def test_the_page_of_a_run_is_json():
    model = tiny_da3()
    page = adapt(model, [noise_scene(8)], quick(model, steps=2)).page(["noise"])
    again = json.loads(json.dumps(page))
    assert again["recipe"]["loss"]["temperature"] == model.spec.adaptation.temperature
    assert len(again["loss_curve"]) == 2
    assert (again["scenes"], again["seed"]) == (["noise"], 42)
