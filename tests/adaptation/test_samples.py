"""What a step needs of a view set: made once, of the right views, decoded ahead of need, gone after its last use."""

import gc
import threading
import weakref

import pytest
import torch

from freegeo.adaptation import samples as sampling
from freegeo.adaptation.adapt import adapt
from freegeo.adaptation.adapter import Adapter, is_adapted
from freegeo.adaptation.recipe import named
from freegeo.adaptation.samples import Samples, SceneImages, loaded_ahead
from freegeo.adaptation.views import schedule
from freegeo.errors import FreeGeoError, UserError
from freegeo.models.api import embed_in_chunks
from freegeo.models.precision import Compute
from tiny_models import attach, noise, noise_scene, quick, tiny_da3, tiny_mapanything, tiny_vggt

CPU = torch.device("cpu")


def opened(model, scenes, recipe, place="device", folder=None):
    steps = schedule([scene.count for scene in scenes], recipe, seed=42)
    samples = Samples(attach(model), scenes, recipe, steps, compute=Compute(), place=place, folder=folder, seed=42)
    return samples, [visit for visits in steps for visit in visits]


def recorded_scene(calls, views=9):
    images = noise(views)

    def load(frames):
        calls.append((threading.current_thread().name, tuple(frames)))
        return images[list(frames)]

    return SceneImages(name="recorded", count=views, load=load)


@pytest.mark.parametrize("build", [tiny_da3, tiny_vggt, tiny_mapanything])
@pytest.mark.parametrize("hold", [0.0, 1.0])
@pytest.mark.parametrize("place", ["device", "disk"])
def test_a_sample_is_the_frozen_model_s_view_of_its_set(build, hold, place, tmp_path):
    model, scene = build(), noise_scene(9)
    samples, visits = opened(model, [scene], quick(model, epochs=2, hold=hold), place, tmp_path)
    with torch.no_grad():
        for visit in visits:
            sample, kept = samples.take(visit), list(visit.view_set.kept)
            tokens = embed_in_chunks(model, scene.load(visit.view_set.frames), device=CPU)
            levels = model.aggregate(tokens, layers=model.spec.loss_layers).levels
            student = sample.student()
            assert torch.equal(student.tokens.tokens, tokens.tokens[:, kept])
            for layer, (patch, special) in levels.items():
                assert torch.equal(student.teacher.levels[layer][0], patch[:, kept])
                assert torch.equal(student.teacher.levels[layer][1], special[:, kept])
            assert torch.equal(sample.held_out, levels[max(levels)][0][:, 1::2].flatten(1, 2))
            assert sample.tokens.tokens.shape[1] == (8 if hold else 4)
    samples.close()
    assert list(tmp_path.iterdir()) == []


def test_the_teacher_runs_once_per_distinct_view_set():
    def passes(build, count, recipe):
        model, seen = build(), []
        aggregate = model.aggregate

        def watched(tokens, **options):
            if tokens.tokens.shape[1] == min(count, recipe.views) and not is_adapted(model):
                seen.append(tokens)
            return aggregate(tokens, **options)

        model.aggregate = watched
        adapt(model, [noise_scene(count)], recipe, seed=42)
        return len(seen)

    assert passes(tiny_da3, 9, quick(tiny_da3(), epochs=3, sets_per_scene=3, distinct_seeds=3)) == 3
    assert passes(tiny_da3, 9, quick(tiny_da3(), epochs=3, sets_per_scene=3, distinct_seeds=3, hold=1.0)) == 3
    # Four sets of a scene with 5 frames are the same 5 frames four times, even within one step.
    assert passes(tiny_da3, 5, quick(tiny_da3(), epochs=2, sets_per_scene=4, distinct_seeds=4, batch=4)) == 1


@pytest.mark.slow
def test_a_sample_is_kept_from_its_first_visit_to_its_last():
    """Memory does not grow with epochs, and recipes that draw anew keep nothing."""

    def alive_after_each_visit(model, recipe):
        samples, visits = opened(model, [noise_scene(9)], recipe)
        seen, alive = [], []
        for visit in visits:
            seen.append(weakref.ref(samples.take(visit).held_out))
            gc.collect()
            alive.append(len({ref for ref in seen if ref() is not None}))
        samples.close()
        return alive

    redrawn = named("released-vggt", tiny_vggt().spec, "eth3d").changed(epochs=4, sets_per_scene=2, rank=2, batch=1)
    assert alive_after_each_visit(tiny_vggt(), redrawn) == [0] * 8
    assert alive_after_each_visit(tiny_da3(), quick(tiny_da3(), epochs=3, sets_per_scene=2, distinct_seeds=2)) == [
        1, 2, 2, 2, 1, 0,
    ]  # fmt: skip


def test_a_view_s_tokens_do_not_depend_on_the_views_beside_it():
    model, images = tiny_da3(), noise(9)
    layers = model.spec.loss_layers
    every = embed_in_chunks(model, images, device=CPU, layers=layers)
    for number in (0, 4, 8):
        alone = embed_in_chunks(model, images[number : number + 1], device=CPU, layers=layers)
        assert torch.equal(every.tokens[:, number], alone.tokens[:, 0])


@pytest.mark.parametrize("place", ["device", "disk"])
def test_images_are_loaded_and_embedded_once_in_the_background(place, tmp_path):
    calls, embedded, model = [], [], tiny_da3()
    embed = model.embed
    model.embed = lambda images, **options: embedded.append(images.shape[1]) or embed(images, **options)
    recipe = quick(model, epochs=3)
    samples, visits = opened(model, [recorded_scene(calls)], recipe, place, tmp_path)
    for visit in visits:
        samples.take(visit)
    samples.close()
    frames = [frame for _, part in calls for frame in part]
    used = {frame for visit in visits for frame in visit.view_set.frames}
    assert sorted(frames) == sorted(used)
    assert sum(embedded) == len(used) < 3 * 8
    assert all(name.startswith("freegeo-images") for name, _ in calls)


def test_augmented_images_are_embedded_for_every_set():
    calls, model = [], tiny_vggt()
    recipe = named("released-vggt", tiny_vggt().spec, "eth3d").changed(epochs=2, sets_per_scene=2, rank=2, batch=1)
    samples, visits = opened(model, [recorded_scene(calls)], recipe)
    for visit in visits:
        samples.take(visit)
    samples.close()
    assert [list(frames) for _, frames in calls] == [list(visit.view_set.frames) for visit in visits]


def test_loading_runs_ahead_keeps_the_order_and_hands_errors_on():
    calls, images = [], noise(9)
    started = threading.Event()

    def load(frames):
        calls.append(tuple(frames))
        if len(calls) == 2:
            started.set()
        if 8 in frames:
            raise FreeGeoError("frame 8 is damaged")
        return images[list(frames)]

    loaded = loaded_ahead([SceneImages(name="s", count=9, load=load)], [(0, (0, 1)), (0, (1, 2)), (0, (8,))])
    assert torch.equal(next(loaded), images[[0, 1]])
    assert started.wait(10)  # the second request is loaded although nobody has asked for it
    assert torch.equal(next(loaded), images[[1, 2]])
    with pytest.raises(FreeGeoError, match="frame 8"):
        next(loaded)
    assert calls == [(0, 1), (1, 2), (8,)]


def test_an_unreadable_image_stops_the_run_and_leaves_the_model_plain():
    def load(frames):
        if len(frames) > 1:
            raise UserError("photo 3 cannot be read")
        return noise(9)[list(frames)]

    model = tiny_da3()
    with pytest.raises(UserError, match="photo 3"):
        adapt(model, [SceneImages(name="broken", count=9, load=load)], quick(model), seed=42)
    assert not any(thread.name.startswith("freegeo-images") for thread in threading.enumerate())
    Adapter.attach(model, rank=2, alpha=2, dropout=0.0, generator=torch.Generator())


def test_a_folder_that_cannot_be_written_to_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written to"):
        opened(model := tiny_da3(), [noise_scene(9)], quick(model), "disk", tmp_path / "file")


def test_the_augmentation_is_a_function_of_the_seed():
    images = noise(8)
    assert torch.equal(sampling.released_augmentation(images, 41), sampling.released_augmentation(images, 41))
    assert not torch.equal(sampling.released_augmentation(images, 41), sampling.released_augmentation(images, 42))
