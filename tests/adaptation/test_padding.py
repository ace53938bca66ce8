"""Patches that show padding instead of a photo take part in no loss term; without padding nothing changes."""

from dataclasses import replace

import pytest
import torch

from freegeo.adaptation.adapt import adapt
from freegeo.adaptation.losses import adaptation_loss, draw_tokens, held_out_tokens
from freegeo.adaptation.recipe import PAPER, RELEASED_DA3, RELEASED_VGGT, named
from freegeo.adaptation.samples import Samples, SceneImages, released_augmentation, step_draws
from freegeo.adaptation.views import schedule
from freegeo.errors import UserError
from freegeo.models.precision import Compute
from tiny_models import PATCH, attach, noise, quick, tensors, tiny_da3, tiny_vggt

KEPT, HELD_OUT = [0, 2, 4, 6], [1, 3, 5, 7]
CONFIGS = {
    "paper": PAPER.loss,
    "released-da3": RELEASED_DA3.loss,
    "released-vggt": RELEASED_VGGT.loss,
    "random anchors": replace(PAPER.loss, selection="random"),
    "middle reference": replace(PAPER.loss, reference_view=2),
}
EACH = pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS.keys())
PATCHES, SPECIAL = 24, 3


def features(seed=0):
    """Features of the teacher (8 views) and the student (the kept ones) of two layers."""
    generator = torch.Generator().manual_seed(seed)
    teacher = {n: tuple(torch.randn(1, 8, t, 16, generator=generator) for t in (PATCHES, SPECIAL)) for n in (1, 3)}
    student = {
        n: tuple((part[:, KEPT] + torch.randn(part[:, KEPT].shape, generator=generator)) for part in level)
        for n, level in teacher.items()
    }
    return student, teacher


def loss_of(student, teacher, config, patches):
    """The loss with the masks `patches` (8, P), as a step computes it, its terms, and the gradients by the patches."""
    special = SPECIAL if config.cross_tokens == "all" else 0
    held_out = held_out_tokens(teacher[3], KEPT, config, patches=patches)
    kept = None if patches is None else patches[KEPT]
    draws = draw_tokens(
        config, tokens_per_view=teacher[3][0].shape[2] + special, student_views=4, held_out=held_out.shape[1],
        generator=torch.Generator().manual_seed(1), patches=kept,
    )  # fmt: skip
    student = {n: tuple(part.clone().requires_grad_() for part in level) for n, level in student.items()}
    kept_levels = {n: tuple(part[:, KEPT] for part in level) for n, level in teacher.items()}
    loss, terms = adaptation_loss(student, kept_levels, held_out, draws, config, patches=kept)
    return terms, torch.autograd.grad(loss, [patch for patch, _ in student.values()])


@EACH
def test_masked_patches_might_as_well_not_exist(config):
    student, teacher = features()
    patches = torch.ones(8, PATCHES, dtype=torch.bool)
    patches[:, [0, 7, 8, 23]] = False
    without = [
        {n: (patch[:, :, patches[0]], special) for n, (patch, special) in levels.items()}
        for levels in (student, teacher)
    ]
    expected, _ = loss_of(*without, config, None)
    found, _ = loss_of(student, teacher, config, patches)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert found[name] == pytest.approx(float(value), rel=1e-5), name


@EACH
def test_nothing_of_a_masked_patch_reaches_loss_or_gradient(config):
    student, teacher = features()
    patches = torch.ones(8, PATCHES, dtype=torch.bool)
    patches[0, :6] = patches[2, 18:] = patches[3, :12] = patches[6, ::2] = False
    for n, (patch, _) in teacher.items():
        patch[:, ~patches] = torch.nan
        student[n][0][:, ~patches[KEPT]] = torch.nan
    terms, gradients = loss_of(student, teacher, config, patches)
    assert all(value.isfinite() for value in terms.values())
    for gradient in gradients:
        assert not gradient[:, ~patches[KEPT]].any()
        assert gradient[:, patches[KEPT]].isfinite().all()
    assert gradients[1][:, patches[KEPT]].any()


@EACH
def test_a_mask_without_padding_changes_only_the_order_of_a_sum(config):
    student, teacher = features()
    plain, plain_gradients = loss_of(student, teacher, config, None)
    masked, gradients = loss_of(student, teacher, config, torch.ones(8, PATCHES, dtype=torch.bool))
    for name in plain:
        # The intra loss sums in another order when it gathers the patches.
        assert masked[name] == pytest.approx(float(plain[name]), rel=1e-6), name
    assert all(torch.allclose(a, b, atol=1e-6) for a, b in zip(plain_gradients, gradients, strict=True))
    assert masked["cross"] == plain["cross"]


def test_views_without_a_patch_in_common_are_refused():
    patches = torch.zeros(4, PATCHES, dtype=torch.bool)
    patches[:2, :12] = patches[2:, 12:] = True
    with pytest.raises(UserError, match="no patch in common"):
        draw_tokens(
            RELEASED_DA3.loss, tokens_per_view=PATCHES, student_views=4, held_out=4 * PATCHES,
            generator=torch.Generator(), patches=patches,
        )  # fmt: skip


def padded_scene(views=9, side=4 * PATCH, odd=(1, 2, 6)) -> SceneImages:
    """A scene in which some views have white above and below, and white to the left that fills 5 of 8 columns."""
    images, inside = noise(views, side=side), torch.ones(views, side, side, dtype=torch.bool)
    for view in odd:
        inside[view, :PATCH] = inside[view, -PATCH:] = False
        inside[view, :, : PATCH + 5] = False
    images[~inside[:, None].expand_as(images)] = 1.0
    return SceneImages(name="padded", count=views, load=lambda frames: images[list(frames)], inside=inside)


@pytest.mark.parametrize("place", ["device", "disk"])
@pytest.mark.parametrize("hold", [0.0, 1.0])
def test_samples_know_which_patches_show_a_photo(place, hold, tmp_path):
    model, scene = tiny_da3(), padded_scene()
    recipe = quick(model, epochs=2, hold=hold)
    steps = schedule([scene.count], recipe, seed=42)
    samples = Samples(
        attach(model), [scene], recipe, steps, compute=Compute(), place=place, folder=tmp_path, seed=42
    )  # fmt: skip
    # A patch of which 3 of 8 columns show the photo is left out; one with more than half would take part.
    row = torch.tensor([[False, False, True, True]])
    middle = torch.cat([torch.zeros(1, 4, dtype=torch.bool), row, row, torch.zeros(1, 4, dtype=torch.bool)]).flatten()
    for visits in steps:
        for visit in visits:
            sample, frames = samples.take(visit), visit.view_set.frames
            read = range(len(frames)) if hold else visit.view_set.kept
            expected = torch.stack([middle if frames[p] in (1, 2, 6) else torch.ones_like(middle) for p in read])
            assert torch.equal(sample.patches, expected)
            held_out = [frame for p, frame in enumerate(frames) if p not in visit.view_set.kept]
            assert sample.held_out.shape[1] == sum(4 if frame in (1, 2, 6) else 16 for frame in held_out)
            student = sample.student()
            draws = step_draws(student, visit.step, recipe.loss, seed=42).angle
            assert student.patches[0][draws.reference].all()
            assert student.patches[1:].flatten()[draws.query].all()
    samples.close()


def test_the_mask_is_mirrored_with_the_images():
    model, scene = tiny_vggt(), padded_scene()
    recipe = named("released-vggt", model.spec, "eth3d").changed(
        epochs=1, sets_per_scene=6, distinct_seeds=6, rank=2, batch=1
    )
    steps = schedule([scene.count], recipe, seed=0)
    samples = Samples(attach(model), [scene], recipe, steps, compute=Compute(), place="device", folder=None, seed=0)
    mirrored = []
    for [visit] in steps:
        frames, kept = visit.view_set.frames, list(visit.view_set.kept)
        found = samples.take(visit).student().patches
        pixels = released_augmentation(scene.inside[list(frames)][:, None].float(), visit.view_set.seed)[kept, 0]
        shown = torch.nn.functional.avg_pool2d((pixels > 0).float()[:, None], PATCH).flatten(1) >= 0.5
        if shown.all():
            assert found is None or found.all()
        else:
            assert torch.equal(found, shown)
            mirrored.append(bool(found.unflatten(1, (4, 4))[..., 0].sum() > found.unflatten(1, (4, 4))[..., 3].sum()))
    samples.close()
    assert set(mirrored) == {True, False}, "sets of both kinds were met"


@pytest.mark.parametrize("build", [tiny_da3, tiny_vggt])
def test_adaptation_to_padded_views_ignores_the_padding(build):
    scene = padded_scene()
    masked = adapt(build(), [scene], quick(build(), hold=0.5), seed=42)
    unmasked = adapt(build(), [replace(scene, inside=None)], quick(build(), hold=0.5), seed=42)
    assert all(tensor.isfinite().all() for tensor in tensors(masked))
    assert masked.curve[0]["total"] != unmasked.curve[0]["total"]
    whole = replace(scene, inside=torch.ones_like(scene.inside))
    same = adapt(build(), [whole], quick(build(), hold=0.5), seed=42)
    assert all(torch.equal(a, b) for a, b in zip(tensors(same), tensors(unmasked), strict=True))
