"""How the engine works: what is kept and where, batches, decoding ahead, half precision."""

import threading
import time
from dataclasses import replace

import pytest
import torch

from freegeo.adaptation import trainer
from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.bank import accesses, embed_in_chunks
from freegeo.adaptation.cache import TensorCache
from freegeo.adaptation.dropout import PackedDropout
from freegeo.adaptation.images import ImageQueue, SceneImages
from freegeo.adaptation.recipe import paper, released
from freegeo.adaptation.teacher import TeacherBank
from freegeo.adaptation.trainer import Engine, adapt
from freegeo.errors import FreeGeoError, UserError
from freegeo.models.precision import autocast, cast_linears, encoder
from tiny_models import PATCH, noise, noise_scene, quick, same, tensors, tiny_da3, tiny_vggt

CPU = torch.device("cpu")


def distance(ours, theirs) -> float:
    """Norm of the difference over the norm."""
    squares = [((a - b).double().square().sum(), b.double().square().sum()) for a, b in zip(ours, theirs, strict=True)]
    return float((sum(s for s, _ in squares) / sum(s for _, s in squares)).sqrt())


def batch_recipe(model, **changes):
    return quick(model, epochs=3, batch=3, sets_per_scene=3, distinct_seeds=3, **changes)


# Where things are kept ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("build", [tiny_da3, tiny_vggt])
@pytest.mark.parametrize("place", ["host", "disk"])
def test_the_place_of_the_cache_changes_no_bit_and_leaves_no_file(build, place, tmp_path):
    def run(**options):
        model = build()
        recipe = quick(model, steps=4, sets_per_scene=2, distinct_seeds=2)
        return adapt(model, [noise_scene(9)], recipe, engine=Engine(cache_folder=tmp_path, **options))

    kept, elsewhere = run(), run(cache_place=place)
    assert kept.curve == elsewhere.curve
    assert same(tensors(kept), tensors(elsewhere))
    assert list(tmp_path.iterdir()) == []


def test_a_half_cache_rounds_by_half_precision_whether_or_not_it_keeps(tmp_path, monkeypatch):
    def run(**options):
        model = tiny_da3()
        recipe = quick(model, steps=4, sets_per_scene=2, distinct_seeds=2)
        return adapt(model, [noise_scene(9)], recipe, engine=Engine(**options))

    exact, half, on_disk = run(), run(half_cache=True), run(half_cache=True, cache_place="disk")
    assert half.curve == on_disk.curve
    totals = [(a["total"], b["total"]) for a, b in zip(exact.curve, half.curve, strict=True)]
    assert all(a != b for a, b in totals)
    assert all(abs(a - b) < 0.02 * a for a, b in totals)


def test_a_cache_gives_back_type_and_value_and_forgets(tmp_path):
    group = {"a": torch.randn(3, 4), "b": torch.tensor([1e6, 1.0]), "n": torch.arange(3)}
    for place in ("device", "host", "disk"):
        for half in (False, True):
            cache = TensorCache("test", place, CPU, folder=tmp_path, half=half)
            cache.put("key", group)
            found = cache.get("key")
            assert found.keys() == group.keys()
            assert {name: t.dtype for name, t in found.items()} == {name: t.dtype for name, t in group.items()}
            expected = cache.rounded(group)
            assert all(torch.equal(found[name], expected[name]) for name in group)
            # What float16 cannot hold stays as it is.
            assert torch.equal(found["b"], group["b"])
            assert torch.allclose(found["a"], group["a"], rtol=1e-3 if half else 0, atol=0)
            assert cache.nbytes() >= sum(t.nbytes for t in group.values()) / 2
            cache.drop("key")
            assert "key" not in cache
            assert cache.nbytes() == 0
            cache.close()
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_left_in_the_banks_after_the_last_step_and_little_in_between(monkeypatch):
    """Memory does not grow with epochs, and recipes that draw anew keep one epoch's sets at most."""
    sizes, banks = [], []
    original = trainer._Run.step

    def watched(self, step):
        found = original(self, step)
        banks.append(self)
        sizes.append(self.bank.nbytes() + self.teacher.nbytes())
        return found

    monkeypatch.setattr(trainer._Run, "step", watched)
    model = tiny_vggt()
    adapt(
        model, [noise_scene(9)], released("released-vggt", "eth3d").changed(epochs=4, sets_per_scene=2, rank=2, batch=1)
    )
    # Every set is visited once: nothing is worth keeping.
    assert max(sizes) == 0
    sizes.clear()
    model = tiny_da3()
    adapt(model, [noise_scene(9)], quick(model, epochs=3, sets_per_scene=2, distinct_seeds=2))
    assert sizes[-1] == 0
    assert max(sizes) > 0
    assert sizes[1] >= sizes[2] >= sizes[3] >= sizes[4]
    assert not banks[-1].bank._uses.total()


def test_the_teacher_runs_once_per_distinct_view_set(monkeypatch):
    calls = []
    original = TeacherBank._features
    monkeypatch.setattr(
        TeacherBank, "_features", lambda self, view_set: calls.append(view_set) or original(self, view_set)
    )
    model = tiny_da3()
    adapt(model, [noise_scene(9)], quick(model, epochs=3, sets_per_scene=3, distinct_seeds=3))
    assert len(calls) == 3
    calls.clear()
    # Ten sets of a scene with 5 frames are the same 5 frames ten times, even within one step.
    adapt(tiny_da3(), [noise_scene(5)], quick(model, epochs=2, sets_per_scene=4, distinct_seeds=4, batch=4))
    assert len(calls) == 1


def test_every_image_is_embedded_once(monkeypatch):
    embedded = []
    model = tiny_da3()
    original = model.embed
    monkeypatch.setattr(model, "embed", lambda images, **o: embedded.append(images.shape[1]) or original(images, **o))
    recipe = quick(model, epochs=3, sets_per_scene=3, distinct_seeds=3)
    adapt(model, [noise_scene(9)], recipe)
    frames = {frame for seed in range(40, 43) for frame in trainer_frames(9, recipe, seed)}
    assert sum(embedded) == len(frames)


def trainer_frames(count, recipe, seed):
    from freegeo.adaptation.views import draw_frames

    return draw_frames(count, recipe.views, seed, repeat=recipe.repeat_views)


def test_a_view_s_tokens_do_not_depend_on_the_views_beside_it():
    model, images = tiny_da3(), noise(9)
    layers = model.spec.loss_layers
    every = embed_in_chunks(model, images, device=CPU, layers=layers)
    for number in (0, 4, 8):
        alone = embed_in_chunks(model, images[number : number + 1], device=CPU, layers=layers)
        assert torch.equal(every.tokens[:, number], alone.tokens[:, 0])


# Batches --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("build", [tiny_da3, tiny_vggt])
@pytest.mark.parametrize("micro", [2, 3])
def test_micro_batches_give_the_same_losses_and_adapter(build, micro):
    def run(micro):
        model = build()
        return adapt(model, [noise_scene(9)], batch_recipe(model), engine=Engine(micro_batch=micro))

    one, many = run(1), run(micro)
    for a, b in zip(one.curve, many.curve, strict=True):
        assert all(abs(a[name] - b[name]) <= 1e-5 * max(abs(a[name]), 1e-3) for name in a)
    assert distance(tensors(many), tensors(one)) <= 1e-5


def test_scenes_of_different_sizes_share_a_step_and_equal_shapes_a_batch(monkeypatch):
    wide = noise(6, side=4 * PATCH)[..., : 3 * PATCH, :]
    scenes = [noise_scene(9), SceneImages(name="wide", count=6, load=lambda frames: wide[list(frames)])]
    sizes = []
    original = trainer._Run._compare
    monkeypatch.setattr(
        trainer._Run,
        "_compare",
        lambda self, tokens, c: sizes.append(tokens.tokens.shape[:3]) or original(self, tokens, c),
    )

    def run(micro):
        model = tiny_da3()
        return adapt(model, scenes, batch_recipe(model), engine=Engine(micro_batch=micro))

    one = run(1)
    sizes.clear()
    many = run(3)
    assert len({shape[2] for shape in sizes}) == 2
    assert max(shape[0] for shape in sizes) > 1
    assert sum(shape[0] for shape in sizes) == 6 * 3
    assert distance(tensors(many), tensors(one)) <= 1e-5


# Images ahead of need -------------------------------------------------------------------------------------------------


def counted_scene(calls, delay=0.0):
    images = noise(9)

    def load(frames):
        calls.append((threading.current_thread().name, tuple(frames)))
        time.sleep(delay)
        return images[list(frames)]

    return SceneImages(name="counted", count=9, load=load)


def test_images_are_decoded_once_and_in_the_background():
    calls = []
    model = tiny_da3()
    adapt(model, [counted_scene(calls)], quick(model, epochs=3, sets_per_scene=3, distinct_seeds=3))
    frames = [frame for _, part in calls for frame in part]
    assert len(frames) == len(set(frames))
    assert all(name.startswith("freegeo-images") for name, _ in calls)


def test_frames_needed_again_are_decoded_once_although_augmentation_differs():
    calls = []
    adapt(
        tiny_vggt(),
        [counted_scene(calls)],
        released("released-vggt", "eth3d").changed(epochs=3, sets_per_scene=2, rank=2, batch=2),
    )
    frames = [frame for _, part in calls for frame in part]
    assert len(frames) == len(set(frames))


def test_the_queue_loads_ahead_keeps_the_order_and_hands_errors_on():
    calls, images = [], noise(9)

    def load(frames):
        calls.append(tuple(frames))
        if 8 in frames:
            raise FreeGeoError("frame 8 is damaged")
        return images[list(frames)]

    queue = ImageQueue([SceneImages(name="s", count=9, load=load)], [(0, (0, 1)), (0, (1, 2)), (0, (8,))], ahead=2)
    assert torch.equal(queue.take(0, (0, 1)), images[[0, 1]])
    assert torch.equal(queue.take(0, (1, 2)), images[[1, 2]])
    # Not announced, but answered.
    assert torch.equal(queue.take(0, (5,)), images[[5]])
    with pytest.raises(FreeGeoError, match="frame 8"):
        queue.take(0, (8,))
    assert calls[:2] == [(0, 1), (2,)]
    queue.close()


def test_an_unreadable_image_stops_the_run_and_leaves_the_model_plain():
    def load(frames):
        raise UserError("photo 3 cannot be read")

    model = tiny_da3()
    with pytest.raises(UserError, match="photo 3"):
        adapt(model, [SceneImages(name="broken", count=9, load=load)], quick(model))
    assert not any(thread.name.startswith("freegeo-images") for thread in threading.enumerate())
    Adapter.attach(model, rank=2, alpha=2, dropout=0.0, generator=torch.Generator())


# Precision ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("build", [tiny_da3, tiny_vggt])
def test_half_weights_give_what_autocast_gives_and_spare_norms_and_heads(build):
    plain, cast = build(), build()
    cast_linears(cast, "bf16")
    halves = {name for name, p in cast.named_parameters() if p.dtype == torch.bfloat16}
    assert halves
    assert all(name.endswith((".weight", ".bias")) for name in halves)
    inside = {id(p) for p in encoder(cast).parameters()}
    assert all((id(p) in inside) or p.dtype == torch.float32 for p in cast.parameters())
    assert not [name for name in halves if "norm" in name or "token" in name or "gamma" in name]
    images = noise(4)[None]
    with torch.no_grad():
        found, wanted = ([], [])
        for model, levels in ((cast, found), (plain, wanted)):
            with autocast(CPU, "bf16"):
                features = model.aggregate(model.embed(images))
            levels += [t for pair in features.levels.values() for t in pair]
            levels.append(model.decode(features).depth_z)
    assert same(found, wanted)


@pytest.mark.parametrize("precision", ["bf16", "fp16"])
def test_half_precision_learns_and_half_weights_change_no_bit(precision):
    def run(half_weights):
        model = tiny_da3()
        engine = Engine(precision=precision, half_weights=half_weights)
        return adapt(model, [noise_scene(9)], quick(model, steps=6, sets_per_scene=1, distinct_seeds=1), engine=engine)

    stored, rounded = run(True), run(False)
    assert stored.curve == rounded.curve
    assert same(tensors(stored), tensors(rounded))
    assert {t.dtype for t in tensors(stored)} == {torch.float32}
    assert stored.curve[-1]["total"] < stored.curve[0]["total"]


# Dropout --------------------------------------------------------------------------------------------------------------


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


def test_the_device_leaves_an_update_out_before_the_host_has_looked(monkeypatch):
    """The path of accelerators: the update is gated, and the next step, or the end of the epoch, raises."""
    original = trainer._Watch.__init__
    monkeypatch.setattr(trainer._Watch, "__init__", lambda self, *, at_once: original(self, at_once=False))
    model, states = tiny_da3(), []
    losses = trainer.adaptation_loss

    def broken(*args, **options):
        loss, terms = losses(*args, **options)
        if len(states) == 1:
            return loss * torch.inf, {**terms, "kl_pq": torch.tensor(torch.inf)}
        return loss, terms

    monkeypatch.setattr(trainer, "adaptation_loss", broken)
    update = trainer._Run._update

    def watched(self, step, terms):
        before = [p.detach().clone() for p in self.adapter.parameters()]
        try:
            update(self, step, terms)
        finally:
            states.append((before, [p.detach().clone() for p in self.adapter.parameters()]))

    monkeypatch.setattr(trainer._Run, "_update", watched)
    with pytest.raises(FreeGeoError, match="Loss term kl_pq is not finite at step 1"):
        adapt(model, [noise_scene(9)], quick(model))
    assert len(states) == 3
    assert not same(*states[0])
    assert same(*states[1])
    # The third step raised before its own update.
    assert same(*states[2])


def test_both_ways_of_watching_give_the_same_adapter(monkeypatch):
    def run():
        model = tiny_da3()
        return adapt(model, [noise_scene(9)], quick(model, steps=5))

    at_once = run()
    original = trainer._Watch.__init__
    monkeypatch.setattr(trainer._Watch, "__init__", lambda self, *, at_once: original(self, at_once=False))
    assert same(tensors(run()), tensors(at_once))


def test_a_gradient_that_is_not_finite_stops_the_run(monkeypatch):
    losses = trainer.adaptation_loss

    def broken(*args, **options):
        loss, terms = losses(*args, **options)
        # The value stays as it is; its gradient is infinite.
        return loss + (loss - loss.detach()).abs().sqrt(), terms

    monkeypatch.setattr(trainer, "adaptation_loss", broken)
    model = tiny_da3()
    with pytest.raises(FreeGeoError, match="gradient is not finite at step 0"):
        adapt(model, [noise_scene(9)], quick(model))


def test_the_bank_lists_what_will_be_read():
    model = tiny_da3()
    recipe = replace(paper(model.spec, "eth3d"), sets_per_scene=1, distinct_seeds=1, epochs=2, batch=1)
    from freegeo.adaptation.views import schedule

    steps = schedule([9], recipe, 0)
    every = list(range(8))
    kept = [0, 2, 4, 6]
    assert [list(p) for _, p in accesses(steps, recipe, teacher_once=True)] == [every, kept, kept]
    assert [list(p) for _, p in accesses(steps, recipe, teacher_once=False)] == [every, kept, every, kept]
    assert [list(p) for _, p in accesses(steps[1:], recipe, teacher_once=True)] == [every, kept]
