"""Adaptation: the paper's Algorithm 1 as a loop that can be stopped and continued at any step.

Reading order: `adapt` (what a run is), `_train` (the loop), `_learn` (one view set), `_State` (what changes
from step to step; `state` writes it to disk).
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.adapter_files import save_adapter
from freegeo.adaptation.losses import adaptation_loss, feature_distance, require_finite
from freegeo.adaptation.memory import Plan, plan_adaptation
from freegeo.adaptation.recipe import Recipe
from freegeo.adaptation.samples import STEP_SEED_STRIDE, Sample, Samples, SceneImages, loss_features, step_draws
from freegeo.adaptation.state import read_state, remove_state, write_state
from freegeo.adaptation.views import Visit, schedule
from freegeo.errors import FreeGeoError
from freegeo.models.api import ReconstructionModel
from freegeo.models.precision import Compute

logger = logging.getLogger(__name__)

SAVE_EVERY_S = 30.0
CPU = Compute()


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Handed to the caller after every step."""

    step: int
    steps: int
    epoch: int
    terms: dict[str, Tensor]
    """Loss terms of the step, detached; reading one waits for the device."""


@dataclass
class Adapted:
    """A trained adapter, attached to its model, with the settings and the loss curve of its run."""

    adapter: Adapter
    recipe: Recipe
    seed: int
    scenes: tuple[str, ...]
    curve: list[dict[str, float]] = field(default_factory=list)
    """Loss terms of every step."""
    seconds: float = 0.0

    def __repr__(self) -> str:
        """Return the recipe, the number of steps, the loss at start and end, and the duration."""
        change = self.loss_change()
        return (
            f"Adapted({self.recipe.name} recipe, {len(self.curve)} steps, loss {change['first']:.4g} -> "
            f"{change['last']:.4g}, {self.seconds:.0f} s)"
        )

    def metadata(self) -> dict[str, Any]:
        """Return the entries of freegeo.json that describe the run."""
        return {
            "recipe": asdict(self.recipe),
            "seed": self.seed,
            "scenes": list(self.scenes),
            "loss_curve": self.curve,
            "seconds": round(self.seconds, 2),
        }

    def save(self, folder: Path | str) -> None:
        """Write the adapter, and remove the state of the run from the folder."""
        folder = Path(folder).expanduser()
        save_adapter(self.adapter, folder, self.metadata())
        remove_state(folder)

    def loss_change(self) -> dict[str, float]:
        """Return the mean total loss of the first and of the last tenth of the steps."""
        return loss_change(self.curve)


def loss_change(curve: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the mean total of the first and of the last tenth of a loss curve."""
    totals = [terms["total"] for terms in curve]
    tenth = max(1, len(totals) // 10)
    return {"first": sum(totals[:tenth]) / tenth, "last": sum(totals[-tenth:]) / tenth}


def learning_rate(step: int, steps: int, recipe: Recipe) -> float:
    """Return the rate of a step: linear warm-up from 1 %, then cosine (docs/method.md, "Schedule and optimiser")."""
    warm = int(recipe.warmup * steps)
    if step < warm:
        return recipe.lr * (0.01 + 0.99 * step / warm)
    turned = 0.5 * (1 + math.cos(math.pi * (step - warm) / (steps - warm)))
    return recipe.final_lr + (recipe.lr - recipe.final_lr) * turned


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
) -> Adapted:
    """Train an adapter on the scenes' images; afterwards it is attached to the model and on.

    Args:
        model: moved to the device of `compute`; left without an adapter when anything fails.
        scenes: at least 3 images each.
        recipe: everything that decides the result, with `seed`.
        seed: of the adapter's start, the order of view sets, token draws and dropout.
        compute: device and precision.
        plan: where samples are kept and whether activations are recomputed; None: the fastest plan that fits.
        resume_in: folder for the state of an unfinished run. The same call continues the run; on the CPU it ends with
            the same tensors as a run without a stop.
        on_step: called after every step.
        on_epoch: called after every epoch with its number and the adapter.

    Raises:
        UserError: scenes that are too small, a state of another run, or a run that does not fit into memory.
        FreeGeoError: a loss or gradient that is not finite, or memory that runs out even with the smallest plan.
    """
    steps = schedule([scene.count for scene in scenes], recipe, seed)
    plan = plan or plan_adaptation(model, scenes, recipe, steps, compute=compute, folder=resume_in)
    run = _Run(model.adaptable(), scenes, recipe, steps, seed, compute, resume_in, on_step, on_epoch)
    try:
        return _train(run, plan)
    except torch.OutOfMemoryError:
        if plan.checkpointing and plan.place == "disk":
            raise FreeGeoError(
                f"{compute.device} ran out of memory even with activation checkpointing and teacher features on disk. "
                "Use smaller images, fewer --views, --precision bf16 or a smaller model."
            ) from None
    # Outside the except block the exception no longer keeps the tensors of the failed run alive.
    logger.warning(
        "%s ran out of memory: once more with activation checkpointing and teacher features on disk", compute.device
    )
    smallest = Plan(checkpointing=True, place="disk")
    return adapt(
        model, scenes, recipe, seed=seed, compute=compute, plan=smallest, resume_in=resume_in, on_step=on_step,
        on_epoch=on_epoch,
    )  # fmt: skip


@dataclass(frozen=True)
class _Run:
    """The arguments of `adapt`, with the visits of every step."""

    model: ReconstructionModel
    scenes: Sequence[SceneImages]
    recipe: Recipe
    steps: Sequence[Sequence[Visit]]
    seed: int
    compute: Compute
    folder: Path | None
    on_step: Callable[[Progress], None]
    on_epoch: Callable[[int, Adapter], None]


def _train(run: _Run, plan: Plan) -> Adapted:
    """Algorithm 1: per step, compare the student with the frozen teacher on every view set and update the adapter."""
    started, recipe, steps = time.monotonic(), run.recipe, run.steps
    model = run.model.to(run.compute.device)
    adapter = Adapter.attach(
        model, rank=recipe.rank, alpha=recipe.alpha, dropout=recipe.dropout,
        generator=torch.Generator().manual_seed(run.seed),
    )  # fmt: skip
    result = Adapted(adapter=adapter, recipe=recipe, seed=run.seed, scenes=tuple(scene.name for scene in run.scenes))
    with ExitStack() as undo:
        undo.callback(adapter.detach)
        state = _State(run, result)
        samples = Samples(
            adapter, run.scenes, recipe, steps[state.next_step :], compute=run.compute, place=plan.place,
            folder=run.folder, seed=run.seed,
        )  # fmt: skip
        undo.callback(samples.close)
        saved_at = time.monotonic()
        for step in range(state.next_step, len(steps)):
            state.optimiser.zero_grad(set_to_none=True)
            with _training(run, plan, step):
                parts = [_learn(run, adapter, visit, samples.take(visit), state.scaler) for visit in steps[step]]
            terms = {name: torch.stack([part[name] for part in parts]).sum() for name in parts[0]}
            state.update(step, terms)
            epoch = steps[step][0].epoch
            run.on_step(Progress(step=step, steps=len(steps), epoch=epoch, terms=terms))
            if step + 1 == len(steps) or steps[step + 1][0].epoch != epoch:
                state.read_terms()
                run.on_epoch(epoch, adapter)
            if run.folder is not None and time.monotonic() - saved_at > SAVE_EVERY_S:
                state.save(step + 1, seconds=result.seconds + time.monotonic() - started)
                saved_at = time.monotonic()
        undo.pop_all()
        samples.close()
    result.seconds += time.monotonic() - started
    return result


def _learn(
    run: _Run, adapter: Adapter, visit: Visit, sample: Sample, scaler: torch.amp.GradScaler
) -> dict[str, Tensor]:
    """Add the gradients of one view set, and return its share of the step's loss terms."""
    recipe, share = run.recipe, 1 / len(run.steps[visit.step])
    draws = step_draws(sample, visit, recipe.loss, seed=run.seed)
    tokens, teacher = sample.student()
    with run.compute.autocast():
        student = loss_features(adapter.model, tokens)
    loss, terms = adaptation_loss(
        student.levels, teacher, sample.held_out, draws, recipe.loss, form=sample.form,
        patches=sample.student_patches(),
    )  # fmt: skip
    scaler.scale(loss * share).backward()
    if recipe.hold:
        # Not in the paper: penalises the distance of the adapted features from the frozen ones, over all views.
        del tokens, teacher, student, loss
        with run.compute.autocast():
            adapted = loss_features(adapter.model, sample.tokens)
        held = (
            recipe.hold
            * feature_distance(adapted.levels, sample.teacher.levels, recipe.loss, patches=sample.patches)[0]
        )
        scaler.scale(held * share).backward()
        terms = {**terms, "hold": held.detach(), "total": terms["total"] + held.detach()}
    return {name: term * share for name, term in terms.items()}


@contextmanager
def _training(run: _Run, plan: Plan, step: int) -> Generator[None]:
    """Dropout on, seeded by the step so that a continued run draws the same masks; checkpointing as planned."""
    model, device = run.model, run.compute.device
    model.train(run.recipe.dropout > 0)
    model.set_recompute(plan.checkpointing)
    try:
        with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
            torch.manual_seed(run.seed * STEP_SEED_STRIDE + step)
            yield
    finally:
        model.eval()
        model.set_recompute(False)


class _State:
    """What changes from step to step and can be saved and restored: adapter, optimiser, gradient scaler, loss curve."""

    def __init__(self, run: _Run, result: Adapted):
        self.run, self.result = run, result
        self.parameters = result.adapter.parameters()
        self.optimiser = torch.optim.AdamW(self.parameters, lr=0.0, weight_decay=run.recipe.weight_decay, fused=True)
        self.scaler = torch.amp.GradScaler(run.compute.device.type, enabled=run.compute.precision == "fp16")
        self.unread: list[tuple[int, dict[str, Tensor]]] = []
        self.next_step = self._restore()

    def update(self, step: int, terms: dict[str, Tensor]) -> None:
        """Clip the gradients and take an optimiser step.

        On the CPU a loss or gradient that is not finite raises FreeGeoError before the step. On an accelerator the
        check would wait for the device, so it is left to a later call of `read_terms`.
        """
        recipe = self.run.recipe
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate(step, len(self.run.steps), recipe)
        self.scaler.unscale_(self.optimiser)
        norm = torch.nn.utils.clip_grad_norm_(self.parameters, recipe.clip)
        # When gradients overflow, the scaler skips the step and lowers its scale, so that is no failure.
        self.unread.append((step, terms if self.scaler.is_enabled() else {**terms, "gradient": norm.detach()}))
        if self.run.compute.device.type == "cpu":
            self.read_terms()
        self.scaler.step(self.optimiser)
        self.scaler.update()

    def read_terms(self) -> None:
        """Move the loss terms that are still on the device to the curve; FreeGeoError when one is not finite."""
        for step, terms in self.unread:
            require_finite(terms, step=step)
            self.result.curve.append({name: float(value) for name, value in terms.items() if name != "gradient"})
        self.unread.clear()

    def save(self, next_step: int, *, seconds: float) -> None:
        """Write the state of a run that continues at `next_step`."""
        assert self.run.folder is not None
        self.read_terms()
        about = {
            "identity": self._identity(), "next_step": next_step, "curve": self.result.curve, "seconds": seconds,
            "scaler": self.scaler.state_dict(),
        }  # fmt: skip
        write_state(self.run.folder, self.result.adapter, self.optimiser, about)

    def _restore(self) -> int:
        """Load the saved state, if there is one, and return the step to continue at."""
        if self.run.folder is None:
            return 0
        about = read_state(self.run.folder, self.result.adapter, self.optimiser, self._identity())
        if about is None:
            return 0
        self.scaler.load_state_dict(about["scaler"])
        self.result.curve, self.result.seconds = about["curve"], about["seconds"]
        return about["next_step"]

    def _identity(self) -> str:
        """Return a fingerprint of model name, scenes, recipe and seed; pixels and weights are left out."""
        scenes = [(scene.name, scene.count) for scene in self.run.scenes]
        model, recipe = self.run.model.spec.name, asdict(self.run.recipe)
        about = {"model": model, "scenes": scenes, "recipe": recipe, "seed": self.run.seed}
        return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]
