"""Adaptation: the paper's Algorithm 1 as a loop that can be stopped and continued at any step.

Reading order: `adapt` (a whole run), `_steps` (the loop), `_learn` (one view set), `_student_loss` (what the student
learns from it). What changes from step to step is in `state`, and what comes out in `adapted`.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from freegeo.adaptation.adapted import Adapted
from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.losses import CameraTargets, adaptation_loss, camera_loss, feature_distance
from freegeo.adaptation.memory import Plan, plan_adaptation
from freegeo.adaptation.recipe import Recipe, require_seed, require_unchanged_images
from freegeo.adaptation.samples import Sample, Samples, SceneImages, loss_features, step_draws, step_seed
from freegeo.adaptation.state import OwnLoss, Progress, Run, State
from freegeo.adaptation.views import Visit, announced_schedule, visited
from freegeo.errors import FreeGeoError, UserError
from freegeo.host import signals_held
from freegeo.models.api import ReconstructionModel
from freegeo.models.precision import Compute
from freegeo.types import Features

logger = logging.getLogger(__name__)

SAVE_EVERY_S = 30.0
CPU = Compute()


def adapt(
    model: ReconstructionModel,
    scenes: Sequence[SceneImages],
    recipe: Recipe,
    *,
    seed: int,
    compute: Compute = CPU,
    plan: Plan | None = None,
    resume_in: Path | None = None,
    on_step: Callable[[Progress], None] = lambda progress: None,
    on_epoch: Callable[[int, Adapter], None] = lambda epoch, adapter: None,
    keep_after: Sequence[float] = (),
    own_loss: OwnLoss | None = None,
) -> Adapted:
    """Train an adapter on the scenes' images; afterwards it is attached to the model and on.

    Args:
        model: moved to the device of `compute`; left without an adapter when anything fails.
        scenes: at least 3 images each.
        recipe: everything that decides the result, with `seed`.
        seed: of the adapter's start, the order of view sets, token draws and dropout.
        compute: device and precision; a default precision gives way to the recipe's.
        plan: where samples are kept and whether activations are recomputed; None: the fastest plan that fits.
        resume_in: folder for the state of an unfinished run, written every 30 s and on Ctrl-C. The same call continues
            the run; on the CPU it ends with the same tensors as a run without a stop.
        on_step: called after every step.
        on_epoch: called after every epoch with its number and the adapter; once more where a run goes on at the end of
            an epoch.
        keep_after: shares of the steps, between 0 and 1, after which the adapter's state is kept (`Adapted.earlier`).
        own_loss: a term that is added to the loss of the student's views.

    Raises:
        UserError: scenes that are too small, a state of another run, a run that does not fit into memory, or a term of
            the user's own that is not one number.
        DivergedError: a loss or gradient that is not finite, or a loss that has grown beyond recovery.
        FreeGeoError: memory that runs out even with the smallest plan.
    """
    require_seed(seed)
    _require_possible(scenes, recipe)
    compute = compute.preferring(recipe.precision)
    windows = [scene.windows for scene in scenes]
    steps = announced_schedule([scene.count for scene in scenes], recipe, seed, windows=windows)
    if plan is None:
        if caution := model.adaptable().spec.adaptation.caution:
            logger.warning("%s", caution)
        plan = plan_adaptation(model, scenes, recipe, visited(steps), compute=compute, folder=resume_in)
    run = Run(
        model=model.adaptable(), scenes=scenes, recipe=recipe, steps=steps, seed=seed, compute=compute, plan=plan,
        folder=resume_in, on_step=on_step, on_epoch=on_epoch, own_loss=own_loss,
        keep_after={share: max(1, round(share * len(steps))) for share in keep_after},
    )  # fmt: skip
    while True:
        try:
            return _train(run)
        except torch.OutOfMemoryError:
            if run.plan.checkpointing and run.plan.place == "disk":
                raise FreeGeoError(
                    f"{compute.device} ran out of memory even with activation checkpointing and teacher features on "
                    "disk. Use smaller images (--process-res), fewer --views, --precision bf16 or a smaller model."
                ) from None
        # Outside the except block the exception no longer keeps the tensors of the failed run alive.
        logger.warning(
            "%s ran out of memory: once more with activation checkpointing and teacher features on disk", compute.device
        )
        run = replace(run, plan=Plan(checkpointing=True, place="disk"))


def _require_possible(scenes: Sequence[SceneImages], recipe: Recipe) -> None:
    """Raise UserError where the recipe cannot learn from these scenes."""
    if recipe.cameras and any(scene.windows for scene in scenes):
        raise UserError(
            f"recipe '{recipe.name}' learns from cameras that bundle adjustment finds for all photos together, which a "
            "sequence in chunks has not. Choose another --recipe, such as scene."
        )
    without = [scene.name for scene in scenes if scene.targets is None]
    if recipe.cameras and without:
        raise UserError(
            f"recipe '{recipe.name}' learns from cameras that matches between photos prove, and {without[0]} has none. "
            "It works with `freegeo run`, `freegeo adapt` and freegeo.adapt; choose another --recipe here."
        )
    if any(scene.priors is not None for scene in scenes):
        require_unchanged_images(recipe)


def _train(run: Run) -> Adapted:
    """Attach an adapter, train it or go on training it, and look at what came out."""
    started, recipe, scenes = time.monotonic(), run.recipe, run.scenes
    # Squares of the recipe's own say nothing about the size of what is predicted.
    process_res = None if recipe.squash is not None else scenes[0].process_res or run.model.spec.default_side
    adapter = Adapter.attach(
        run.model.to(run.compute.device), rank=recipe.rank, alpha=recipe.alpha, dropout=recipe.dropout,
        generator=torch.Generator().manual_seed(run.seed), process_res=process_res,
    )  # fmt: skip
    try:
        state = State(run, adapter, started)
        samples = Samples(
            adapter, scenes, recipe, visited(run.steps)[state.next_step :], compute=run.compute, place=run.plan.place,
            folder=run.folder, seed=run.seed,
        )  # fmt: skip
        with closing(samples):
            try:
                _steps(run, state, samples)
                gain = _gain(run, adapter, samples)
            except (KeyboardInterrupt, SystemExit):
                state.save(stopped=True)
                raise
    except BaseException:
        adapter.detach()
        raise
    return Adapted(
        adapter=adapter, recipe=recipe, seed=run.seed, scenes=tuple(scene.name for scene in scenes), curve=state.curve,
        gain=gain, earlier=state.earlier, seconds=state.seconds(), precision=run.compute.precision,
        with_cameras=any(scene.priors is not None for scene in scenes), own_loss=run.own_loss_name,
        windows=tuple(None if scene.windows is None else len(scene.windows) for scene in scenes),
    )  # fmt: skip


def _steps(run: Run, state: State, samples: Samples) -> None:
    """Algorithm 1: per step, compare the student with the frozen teacher on every view set and update the adapter."""
    steps, saved_at = run.steps, time.monotonic()
    if state.next_step > 0:
        # A run can be stopped after a step and before its epoch was announced.
        _end_epoch(run, state, state.next_step - 1)
    for step in range(state.next_step, len(steps)):
        state.optimiser.zero_grad(set_to_none=True)
        with _training(run, step):
            parts = [_learn(run, state, visit, samples.take(visit)) for visit in steps[step]]
        terms = {name: torch.stack([part[name] for part in parts]).sum() for name in parts[0]}
        with signals_held():
            state.update(terms, learning_rate(step, len(steps), run.recipe))
        run.on_step(Progress(step=step, steps=len(steps), epoch=steps[step][0].epoch, terms=terms))
        _end_epoch(run, state, step)
        if time.monotonic() - saved_at > SAVE_EVERY_S:
            state.save()
            saved_at = time.monotonic()


def _learn(run: Run, state: State, visit: Visit, sample: Sample) -> dict[str, Tensor]:
    """Add the gradients of one view set, and return its share of the step's loss terms."""
    share = 1 / len(run.steps[visit.step])
    total, terms = torch.zeros((), device=run.compute.device), {}
    for forward in _passes(run.recipe):
        loss, parts = forward(run, visit, sample)
        state.scaler.scale(loss * share).backward()
        total = total + loss.detach()
        terms |= parts
    return {name: term * share for name, term in {**terms, "total": total}.items()}


Pass = Callable[[Run, Visit, Sample], tuple[Tensor, dict[str, Tensor]]]
"""A forward pass of the student: its loss, and the detached terms of that."""


def _passes(recipe: Recipe) -> list[Pass]:
    """Return the forward passes that a recipe needs; the total loss is the sum of theirs."""
    return [_student_loss, _all_views_loss] if recipe.sees_all else [_student_loss]


def _student_loss(run: Run, visit: Visit, sample: Sample) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the losses of the student's views: features against the teacher's, cameras against the targets."""
    recipe, sample = run.recipe, sample.student()
    losses, terms = [], {}
    with run.compute.autocast():
        student = loss_features(run.model, sample.tokens, sample.priors)
    if recipe.features:
        draws = step_draws(sample, visit.step, recipe.loss, seed=run.seed)
        loss, terms = adaptation_loss(
            student.levels, sample.teacher.levels, sample.held_out, draws, recipe.loss, form=sample.form,
            patches=sample.patches,
        )  # fmt: skip
        losses.append(recipe.features * loss)
    if recipe.cameras:
        losses.append(recipe.cameras * _camera_loss(run.model, student, sample.targets))
        terms["cameras"] = losses[-1].detach()
    if run.own_loss is not None:
        losses.append(_checked(run.own_loss(student, sample.teacher)))
        terms["own"] = losses[-1].detach()
    return torch.stack(losses).sum(), terms


def _all_views_loss(run: Run, visit: Visit, sample: Sample) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the losses of all N views (not in the paper): features held where they were, cameras as above."""
    recipe, terms = run.recipe, {}
    with run.compute.autocast():
        adapted = loss_features(run.model, sample.tokens, sample.priors)
    if recipe.hold:
        distance, _ = feature_distance(adapted.levels, sample.teacher.levels, recipe.loss, patches=sample.patches)
        terms["hold"] = recipe.hold * distance
    if recipe.cameras:
        terms["cameras_all"] = recipe.cameras * _camera_loss(run.model, adapted, sample.targets)
    return torch.stack(list(terms.values())).sum(), {name: term.detach() for name, term in terms.items()}


def _camera_loss(model: ReconstructionModel, features: Features, targets: CameraTargets | None) -> Tensor:
    """Return the distance of the cameras that the frozen head reads off the features from the targets."""
    found = model.decode(features, want=("cameras",))
    assert targets is not None and found.T_cam_world is not None and found.K is not None
    return camera_loss(found.T_cam_world[0], found.K[0], targets)


def _checked(term: object) -> Tensor:
    """Return what a term of the user's own gave, as a number; UserError when it is none that can be learned from."""
    if not isinstance(term, Tensor) or term.numel() != 1:
        what = f"a tensor of {tuple(term.shape)}" if isinstance(term, Tensor) else type(term).__name__
        raise UserError(f"own_loss must return a tensor with one number, the term's value; it returned {what}.")
    if torch.is_grad_enabled() and not term.requires_grad:
        raise UserError(
            "own_loss returned a number that does not depend on the student's features, from which nothing is learned."
        )
    return term.reshape(()).float()


def learning_rate(step: int, steps: int, recipe: Recipe) -> float:
    """Return the rate of a step: linear warm-up from 1 %, then cosine (docs/method.md, "Schedule and optimiser")."""
    warm = int(recipe.warmup * steps)
    if step < warm:
        return recipe.lr * (0.01 + 0.99 * step / warm)
    turned = 0.5 * (1 + math.cos(math.pi * (step - warm) / (steps - warm)))
    return recipe.final_lr + (recipe.lr - recipe.final_lr) * turned


@contextmanager
def _training(run: Run, step: int) -> Generator[None]:
    """Dropout on, seeded by the step so that a continued run draws the same masks; checkpointing as planned."""
    model, device = run.model, run.compute.device
    model.train(run.recipe.dropout > 0)
    model.set_recompute(run.plan.checkpointing)
    try:
        with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
            torch.manual_seed(step_seed(run.seed, step))
            yield
    finally:
        model.eval()
        model.set_recompute(False)


def _end_epoch(run: Run, state: State, step: int) -> None:
    """Announce an epoch whose last step was this one; nothing happens for other steps."""
    steps, epoch = run.steps, run.steps[step][0].epoch
    if step + 1 == len(steps) or steps[step + 1][0].epoch != epoch:
        state.read_terms()
        run.on_epoch(epoch, state.adapter)


@torch.no_grad()
def _gain(run: Run, adapter: Adapter, samples: Samples) -> dict[str, float]:
    """Return the total loss of the last step's view sets without and with the adapter as it is now, equal tokens drawn.

    The loss of a step is that before its update, and of other view sets than the first step's.
    """
    frozen = adapted = 0.0
    for visit in run.steps[-1]:
        sample = samples.take(visit)
        with adapter.off():
            # Without cameras the pass of all views gives `hold` only, which is 0 for the frozen model.
            for forward in _passes(run.recipe) if run.recipe.cameras else [_student_loss]:
                frozen += float(forward(run, visit, sample)[0])
        adapted += sum(float(forward(run, visit, sample)[0]) for forward in _passes(run.recipe))
    count = len(run.steps[-1])
    return {"frozen": frozen / count, "adapted": adapted / count}
