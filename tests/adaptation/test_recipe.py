"""The named settings are the published ones, and settings that make no sense are refused in one sentence."""

import dataclasses
from typing import get_args

import pytest
import torch

from freegeo.adaptation import recipe as recipes
from freegeo.adaptation.adapt import learning_rate
from freegeo.adaptation.views import schedule, view_sets
from freegeo.errors import UserError
from freegeo.models.catalog import build_empty
from freegeo.models.spec import AdaptationDefaults, ModelSpec
from tiny_models import tiny_da3

SPEC = tiny_da3().spec
GIANT = ModelSpec(
    name="da3-giant", patch_size=14, default_side=504, loss_layers=(19, 27, 33, 39), reference="saddle_balanced",
    special_tokens=1, weights_licence="none",
    adaptation=AdaptationDefaults(temperature=10.0, scene_lr=3e-5, published="da3"),
)  # fmt: skip

# Sets per scene, distinct seeds, epochs, lr, final lr: the paper's supplement; docs/method.md, "Released recipes".
PUBLISHED = {
    ("paper", "eth3d"): (10, 10, 3, 1e-4, 1e-7),
    ("paper", "7scenes"): (20, 20, 3, 5e-5, 1e-8),
    ("paper", "scannetpp"): (10, 10, 3, 1e-5, 1e-8),
    ("paper", "hiroom"): (5, 5, 5, 1e-4, 1e-7),
    ("released-da3", "eth3d"): (5, 5, 3, 1e-4, 1e-7),
    ("released-da3", "7scenes"): (10, 10, 3, 5e-5, 1e-8),
    ("released-da3", "scannetpp"): (10, 10, 3, 1e-5, 1e-8),
    ("released-da3", "hiroom"): (5, 5, 5, 1e-4, 1e-7),
    ("released-vggt", "eth3d"): (10, 5, 3, 1e-5, 1e-8),
    ("released-vggt", "7scenes"): (10, 10, 3, 1e-5, 1e-8),
    ("released-vggt", "scannetpp"): (10, 10, 3, 3e-5, 1e-8),
    ("released-vggt", "hiroom"): (5, 5, 3, 1e-4, 1e-8),
}
# Optimiser steps of the released runs on the benchmark's scene counts: docs/method.md, "Released recipes".
STEPS = {
    ("released-da3", "eth3d", 11): 39,
    ("released-da3", "7scenes", 7): 51,
    ("released-da3", "scannetpp", 20): 150,
    ("released-vggt", "eth3d", 11): 165,
    ("released-vggt", "7scenes", 7): 105,
    ("released-vggt", "scannetpp", 20): 300,
}


@pytest.mark.parametrize(("name", "dataset"), PUBLISHED)
def test_dataset_settings_are_the_published_ones(name, dataset):
    found = recipes.named(name, GIANT, dataset)
    row = (found.sets_per_scene, found.distinct_seeds, found.epochs, found.lr, found.final_lr)
    assert row == PUBLISHED[name, dataset]
    assert (found.first_seed, found.warmup, found.weight_decay, found.clip) == (40, 0.15, 1e-5, 1.0)
    assert (found.rank, found.alpha, found.views, found.steps) == (32, 32, 8, None)


@pytest.mark.parametrize(("name", "dataset", "scenes"), STEPS)
def test_released_runs_have_the_published_number_of_steps(name, dataset, scenes):
    found = recipes.named(name, GIANT, dataset)
    assert len(schedule([20] * scenes, found, seed=42)) == STEPS[name, dataset, scenes]


def test_the_papers_settings_are_those_of_a_published_model():
    assert recipes.named("paper", GIANT, "eth3d") == recipes.PAPER
    loss = recipes.PAPER.loss
    assert (loss.num_reference, loss.num_query, loss.num_anchors) == (256, 256, 4)
    assert (recipes.PAPER.views, recipes.PAPER.rank, recipes.PAPER.alpha) == (8, 32, 32)


def test_only_our_own_recipe_holds_the_answer_from_all_photos():
    assert recipes.scene(SPEC).hold == 1
    assert {recipes.named(name, GIANT, dataset).hold for name, dataset in PUBLISHED} == {0}


@pytest.mark.parametrize("views", range(3, 11))
def test_every_recipe_keeps_every_second_view(views):
    """Eight views keep (0, 2, 4, 6), as in the paper; scenes of fewer views and `--views` keep to the same rule."""
    for name in get_args(recipes.RecipeName):
        dataset = None if name in recipes.OWN else "eth3d"
        recipe = recipes.named(name, GIANT, dataset).changed(views=max(views, 8), repeat_views=False)
        first = view_sets([views], recipe)[0]
        assert (first.frames, first.kept) == (tuple(range(views)), tuple(range(0, views, 2)))


def test_recipes_differ_where_the_paper_and_the_release_do():
    paper, da3, vggt = (recipes.named(n, GIANT, "eth3d") for n in ("paper", "released-da3", "released-vggt"))
    assert [r.batch for r in (paper, da3, vggt)] == [4, 4, 2]
    assert [r.dropout for r in (paper, da3, vggt)] == [0.0, 0.1, 0.1]
    assert [r.augmentation for r in (paper, da3, vggt)] == ["none", "released", "released"]
    assert [r.drop_last for r in (paper, da3, vggt)] == [False, True, True]
    assert [r.redraw for r in (paper, da3, vggt)] == [False, False, True]
    assert [r.squash for r in (paper, da3, vggt)] == [None, 518, None]
    assert [r.repeat_views for r in (paper, da3, vggt)] == [False, True, True]


def test_scene_recipe_takes_what_depends_on_the_features_from_the_model():
    found = recipes.named("scene", SPEC)
    assert (found.steps, found.epochs, found.batch, found.sets_per_scene) == (100, None, 1, 10)
    assert (found.lr, found.final_lr) == (SPEC.adaptation.scene_lr, SPEC.adaptation.scene_lr / 1000)
    assert (found.rank, found.loss.temperature) == (SPEC.adaptation.rank, SPEC.adaptation.temperature)
    giant = recipes.named("scene", GIANT)
    assert (giant.lr, giant.rank, giant.loss.temperature) == (3e-5, 32, 10.0)


def test_a_model_without_published_settings_keeps_its_own_rank_in_a_dataset_recipe():
    assert recipes.named("paper", SPEC, "eth3d").rank == SPEC.adaptation.rank


@pytest.mark.parametrize("name", ["da3-giant", "vggt-1b"])
def test_models_bring_the_published_temperature(name):
    loss = recipes.named("paper", build_empty(name).spec, "eth3d").loss
    assert loss.temperature == {"da3-giant": 10.0, "vggt-1b": 1.0}[name]


@pytest.mark.parametrize("steps", [5, 6, 7, 39, 51, 100, 150, 165, 300])
def test_learning_rate_is_that_of_the_library_schedulers(steps):
    found = recipes.named("paper", GIANT, "eth3d")
    warm = int(found.warmup * steps)
    optimiser = torch.optim.AdamW([torch.nn.Parameter(torch.zeros(1))], lr=found.lr)
    schedulers = torch.optim.lr_scheduler
    cosine = schedulers.CosineAnnealingLR(optimiser, T_max=steps - warm, eta_min=found.final_lr)
    library = cosine
    if warm:
        linear = schedulers.LinearLR(optimiser, start_factor=0.01, end_factor=1.0, total_iters=warm)
        library = schedulers.SequentialLR(optimiser, [linear, cosine], milestones=[warm])
    for step in range(steps):
        wanted = optimiser.param_groups[0]["lr"]
        assert learning_rate(step, steps, found) == pytest.approx(wanted, rel=1e-12, abs=0)
        optimiser.step()
        library.step()
    assert learning_rate(steps - 1, steps, found) > found.final_lr


def test_changed_replaces_what_is_given_and_leaves_the_rest():
    scene = recipes.scene(SPEC)
    assert scene.changed(lr=None, rank=None) == scene
    assert scene.changed(epochs=2).steps is None
    assert recipes.named("paper", GIANT, "eth3d").changed(steps=7).epochs is None
    wider = scene.changed(rank=16)
    assert (wider.rank, wider.alpha) == (16, 16)
    assert scene.changed(rank=16, alpha=8).alpha == 8
    assert dataclasses.replace(scene.changed(lr=1.0), lr=scene.lr) == scene


def test_changed_reaches_the_loss_and_leaves_its_other_settings():
    scene = recipes.scene(SPEC)
    found = scene.changed(loss={"weight_kq": 0.0, "selection": "topk"}, lr=None)
    assert (found.loss.weight_kq, found.loss.selection) == (0.0, "topk")
    assert found.changed(loss={"weight_kq": scene.loss.weight_kq, "selection": scene.loss.selection}) == scene
    assert scene.changed(loss=None) == scene.changed(loss={}) == scene


def test_loss_settings_that_a_recipe_does_not_read_are_said(caplog):
    plan = recipes.evidence(build_empty("da3-base").spec)
    assert plan.changed(loss={"weight_huber": 0.5}).loss.weight_huber == 0.5
    assert not caplog.records
    plan.changed(loss={"weight_huber": 0.5, "weight_kq": 1.0})
    assert caplog.messages == [
        "--loss weight_kq: recipe 'evidence' compares no features of student and teacher, so this changes nothing."
    ]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"views": 2}, "--views must be at least 3"),
        ({"keep": (0,)}, "at least 2"),
        ({"keep": (0, 8)}, "within 0..7"),
        ({"keep": (2, 0)}, "ascend"),
        ({"keep": (0, 0, 2)}, "ascend"),
        ({"keep": tuple(range(8))}, "fewer than all 8"),
        ({"keep": ()}, "at least 2"),
        ({"keep": (-1, 2)}, "within 0..7"),
        ({"keep": (0, 2.0)}, "ascending positions"),
        ({"keep": (1, 3)}, "must begin with 0: view 0 is the reference"),
        ({"keep": (0, 2, 9), "views": 9}, "within 0..8"),
        ({"views": 8.0}, "--views must be a whole number"),
        ({"lr": 0.0}, "--lr must be positive"),
        ({"lr": -1e-3}, "--lr must be positive"),
        ({"lr": float("nan")}, "--lr must be positive and finite, got nan"),
        ({"lr": float("inf")}, "--lr must be positive and finite"),
        ({"final_lr": 1.0}, "final_lr must be from 0 to the peak rate"),
        ({"final_lr": float("nan")}, "final_lr must be from 0"),
        ({"rank": -1}, "--rank must be positive"),
        ({"rank": 4.5}, "--rank must be a whole number"),
        ({"rank": True}, "--rank must be a whole number"),
        ({"sets_per_scene": 0}, "--sets must be positive"),
        ({"batch": 0}, "batch must be positive"),
        ({"dropout": 1.0}, "dropout must be from 0 to below 1"),
        ({"warmup": float("nan")}, "warmup must be from 0"),
        ({"weight_decay": float("inf")}, "weight_decay must be from 0"),
        ({"clip": 0.0}, "clip must be positive"),
        ({"steps": 2.5}, "--steps must be a whole number"),
        ({"epochs": -1}, "at least 1"),
        ({"steps": 0}, "at least 1"),
        ({"steps": 5, "epochs": 2}, "either --steps or --epochs"),
        ({"loss": {"weight_kk": 0.0}}, "no loss setting 'weight_kk'; known are intra_tokens"),
        ({"loss": {"selection": "best"}}, "selection is one of mixed, topk, random"),
        ({"loss": {"weight_kq": float("inf")}}, "0 or more and finite"),
        ({"loss": {"temperature": float("inf")}}, "temperature must be positive and finite"),
        ({"loss": {"num_query": 2.5}}, "num_query must be a whole number"),
    ],
)
def test_impossible_settings_are_refused(changes, words):
    with pytest.raises(UserError, match=words):
        recipes.scene(SPEC).changed(**changes)


def test_unknown_recipes_and_missing_datasets_are_refused():
    with pytest.raises(UserError, match="Known are scene, evidence, paper, released-da3 and released-vggt"):
        recipes.named("best", SPEC)
    for name in ("paper", "released-da3", "released-vggt"):
        with pytest.raises(UserError, match="choose --dataset from eth3d, 7scenes, scannetpp, hiroom"):
            recipes.named(name, GIANT)
        with pytest.raises(UserError, match="settings per dataset"):
            recipes.named(name, GIANT, "kitti")


@pytest.mark.parametrize("seed", [-1, 2**64, 1.5])
def test_seeds_beyond_64_bits_are_refused(seed):
    with pytest.raises(UserError, match="--seed must be"):
        recipes.require_seed(seed)


def test_a_dataset_that_would_change_nothing_is_refused():
    with pytest.raises(UserError, match="'scene' has no settings per dataset, so --dataset eth3d would change nothing"):
        recipes.named("scene", GIANT, "eth3d")


def test_a_recipe_of_the_other_family_is_said(caplog):
    recipes.named("released-da3", GIANT, "eth3d")
    recipes.named("released-vggt", SPEC, "eth3d")
    assert "another model family" not in caplog.text
    recipes.named("released-vggt", GIANT, "eth3d")
    assert "another model family than that of da3-giant; its own are 'released-da3'" in caplog.text


@pytest.mark.parametrize("lr", [1e-9, 1e-4, 1.0])
def test_the_rate_never_rises_after_the_warm_up(lr):
    """A rate below the recipe's final rate takes that down with it."""
    found = recipes.named("paper", GIANT, "eth3d").changed(lr=lr)
    rates = [learning_rate(step, 40, found) for step in range(6, 40)]
    assert rates == sorted(rates, reverse=True)
    assert rates[0] == lr
    assert found.changed(lr=1e-4, final_lr=1e-6).final_lr == 1e-6


def test_recipes_carry_the_precision_of_what_they_reproduce():
    names = ("scene", "paper", "released-da3", "released-vggt")
    found = [recipes.named(name, GIANT, None if name == "scene" else "eth3d").precision for name in names]
    assert found == [None, "fp16", "fp16", "fp16"]
