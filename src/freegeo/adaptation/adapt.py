"""Adaptation: the paper's Algorithm 1 as a loop that can be stopped and continued at any step.

Reading order: `adapt` (what a run is), `_train` and `_steps` (the loop), `_learn` (one view set), `_State` (what
changes from step to step; `state` writes it to disk), `trouble` (whether what came out may be used).
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
from freegeo.adaptation.losses import CameraTargets, adaptation_loss, camera_loss, feature_distance
from freegeo.adaptation.memory import Plan, plan_adaptation
from freegeo.adaptation.recipe import Recipe, require_seed
from freegeo.adaptation.samples import Sample, Samples, SceneImages, loss_features, step_draws, step_seed
from freegeo.adaptation.state import read_state, remove_state, undisturbed, write_state
from freegeo.adaptation.views import Visit, schedule, substitution
from freegeo.errors import DivergedError, FreeGeoError, UserError
from freegeo.models.api import ReconstructionModel
from freegeo.models.precision import Compute
from freegeo.types import Features

logger = logging.getLogger(__name__)

SAVE_EVERY_S = 30.0
SAME_LOSS = 1e-4
"""Relative difference up to which two losses of the same view sets and tokens are taken for equal: rounding makes 1e-6
in float32, more in half precision, and a run of three steps at a hundredth of the usual rate changes 1e-3."""
BLOWN_UP = 1e4
"""A loss of so many times the first step's ends a run: no run was seen to come back from there, and steps get slow."""
CPU = Compute()
OwnLoss = Callable[[Features, Features], Tensor]
"""A term of the user's own: features of student and teacher for the views that the student sees -> one number."""


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
    """A trained adapter, attached to its model, with the settings and the loss curve of its run.

    `trouble` says whether it may be used.
    """

    adapter: Adapter
    recipe: Recipe
    seed: int
    scenes: tuple[str, ...]
    curve: list[dict[str, float]] = field(default_factory=list)
    """Loss terms of every step."""
    gain: dict[str, float] = field(default_factory=dict)
    """Total loss of the last step's view sets: `frozen` without the adapter, `adapted` with it, equal tokens drawn."""
    earlier: dict[float, dict[str, Tensor]] = field(default_factory=dict)
    """The adapter after the shares of the steps that `adapt` was told to keep, as `Adapter.load` takes it."""
    verdict: Mapping[str, Any] | None = None
    """What the matches between the photos say (`freegeo.evidence.guard.Verdict.as_dict`); None: nobody asked."""
    harm: str | None = None
    """What is so wrong with the predictions that the adapter is not to be used, in one sentence; see `trouble`."""
    seconds: float = 0.0
    """Duration, with that of the earlier parts of a run that was continued."""
    precision: str = "fp32"
    with_cameras: bool = False
    """Whether the model was told known cameras."""
    own_loss: str | None = None
    """Name of the user's own term of the loss."""
    windows: tuple[int | None, ...] = ()
    """Of each scene, how many windows its view sets were drawn from; None: from all its images."""

    def __repr__(self) -> str:
        """Return the recipe, the number of steps, the loss at start and end, the duration, and whether to beware."""
        change = self.loss_change()
        return (
            f"Adapted({self.recipe.name} recipe, {len(self.curve)} steps, loss {change['first']:.4g} -> "
            f"{change['last']:.4g}, {self.seconds:.0f} s{', not to be used: see trouble' if self.trouble else ''})"
        )

    @property
    def trouble(self) -> str | None:
        """Why the adapter should not be used, in one sentence, and what to do; None where it may be (see `trouble`)."""
        broken = [name for name, value in self.adapter.named_parameters().items() if not bool(value.isfinite().all())]
        return trouble(self.gain, broken, self.recipe) or self.harm

    def metadata(self) -> dict[str, Any]:
        """Return the entries of freegeo.json that describe the run."""
        return {
            "recipe": asdict(self.recipe),
            "seed": self.seed,
            "scenes": list(self.scenes),
            "precision": self.precision,
            "with_cameras": self.with_cameras,
            "process_res": self.adapter.process_res,
            "own_loss": self.own_loss,
            "windows": list(self.windows),
            "loss_curve": self.curve,
            # JSON has no infinity.
            "gain": {name: value if math.isfinite(value) else None for name, value in self.gain.items()},
            "trouble": self.trouble,
            "verdict": self.verdict,
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


def trouble(gain: Mapping[str, float], broken: Sequence[str], recipe: Recipe) -> str | None:
    """Say in one sentence why a finished adapter should not be used, and what to do; None where it may be.

    The rule compares like with like: the same view sets and tokens, without the adapter and with it, after the last
    update. The loss curve cannot decide. Its start and end are of different view sets, whose losses differ by more than
    a short run gains, so that good runs seem to rise; a run that blows up at once has its worst losses at the start, so
    that it seems to fall; and it lacks the last update, which in a run of one step is all there is.

    Args:
        gain: `Adapted.gain`.
        broken: the adapter's tensors with values that are not finite.
        recipe: of the run.
    """
    lower = f"Lower --lr (now {recipe.lr:g}), take fewer --steps or another --recipe."
    if broken:
        return f"the adapter has values that are not finite ({len(broken)} tensors, first {broken[0]}). {lower}"
    if not all(map(math.isfinite, gain.values())):
        return f"with the adapter the loss is not finite. {lower}"
    losses = (
        f"the loss of the last view sets is {gain['adapted']:.4g} with the adapter and {gain['frozen']:.4g} without"
    )
    if gain["adapted"] > gain["frozen"] * (1 + SAME_LOSS):
        return f"adaptation made the model worse at its own task: {losses}. {lower}"
    if gain["adapted"] >= gain["frozen"] * (1 - SAME_LOSS):
        return f"adaptation gained nothing: {losses}. Raise --lr (now {recipe.lr:g}) or take more --steps."
    return None


def visited(steps: Sequence[Sequence[Visit]]) -> Sequence[Sequence[Visit]]:
    """Return the visits of a run's steps and then those of its last step again, for the look at what came out."""
    return [*steps, steps[-1]]


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
    if any(scene.windows for scene in scenes):
        require_learns_in_windows(recipe)
    require_targets(scenes, recipe)
    if any(scene.priors is not None for scene in scenes):
        require_unchanged_images(recipe)
    compute = compute.preferring(recipe.precision)
    steps = scheduled(scenes, recipe, seed)
    if plan is None and (caution := model.adaptable().spec.adaptation.caution):
        logger.warning("%s", caution)
    plan = plan or plan_adaptation(model, scenes, recipe, visited(steps), compute=compute, folder=resume_in)
    wanted = {share: max(1, round(share * len(steps))) for share in keep_after}
    run = _Run(model.adaptable(), scenes, recipe, steps, seed, compute, resume_in, on_step, on_epoch, wanted, own_loss)
    try:
        return _train(run, plan)
    except torch.OutOfMemoryError:
        if plan.checkpointing and plan.place == "disk":
            raise FreeGeoError(
                f"{compute.device} ran out of memory even with activation checkpointing and teacher features on disk. "
                "Use smaller images (--process-res), fewer --views, --precision bf16 or a smaller model."
            ) from None
    # Outside the except block the exception no longer keeps the tensors of the failed run alive.
    logger.warning(
        "%s ran out of memory: once more with activation checkpointing and teacher features on disk", compute.device
    )
    smallest = Plan(checkpointing=True, place="disk")
    return adapt(
        model, scenes, recipe, seed=seed, compute=compute, plan=smallest, resume_in=resume_in, on_step=on_step,
        on_epoch=on_epoch, keep_after=keep_after, own_loss=own_loss,
    )  # fmt: skip


def scheduled(scenes: Sequence[SceneImages], recipe: Recipe, seed: int) -> list[list[Visit]]:
    """Return the visits of every step of a run, and say what the photos make different from what was asked for."""
    counts, windows = [scene.count for scene in scenes], [scene.windows for scene in scenes]
    sizes = [len(window) for one in windows for window in one or ()]
    if said := substitution(sizes, recipe, "parts of the sequence") if sizes else substitution(counts, recipe):
        logger.info(said)
    steps = schedule(counts, recipe, seed, windows=windows)
    visits = sum(len(step) for step in steps)
    if visits < len(sizes):
        logger.info(
            "%d view sets cannot visit all %d parts of the sequence; which are left out depends on the seed. More "
            "--steps visit all.", visits, len(sizes),
        )  # fmt: skip
    return steps


def require_targets(scenes: Sequence[SceneImages], recipe: Recipe) -> None:
    """Raise UserError when the recipe learns from cameras and a scene has none."""
    without = [scene.name for scene in scenes if scene.targets is None]
    if recipe.cameras and without:
        raise UserError(
            f"recipe '{recipe.name}' learns from cameras that matches between photos prove, and {without[0]} has none. "
            "It works with `freegeo run`, `freegeo adapt` and freegeo.adapt; choose another --recipe here."
        )


def require_unchanged_images(recipe: Recipe) -> None:
    """Raise UserError for a recipe that mirrors or squashes images, which known cameras do not follow."""
    if recipe.squash is not None or recipe.augmentation != "none":
        raise UserError(
            f"recipe '{recipe.name}' mirrors or squashes the images, and known cameras are of the photos as they are. "
            "Choose another --recipe, such as scene, or leave the cameras out."
        )


def require_learns_in_windows(recipe: Recipe) -> None:
    """Raise UserError for a recipe that cannot learn from a sequence whose photos are in chunks."""
    if recipe.cameras:
        raise UserError(
            f"recipe '{recipe.name}' learns from cameras that bundle adjustment finds for all photos together, which a "
            "sequence in chunks has not. Choose another --recipe, such as scene."
        )


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
    keep_after: Mapping[float, int]
    """Shares of the steps after which the adapter's state is kept -> how many finished steps that are."""
    own_loss: OwnLoss | None


def _name(own_loss: OwnLoss | None) -> str | None:
    return None if own_loss is None else getattr(own_loss, "__qualname__", type(own_loss).__qualname__)


def _process_res(run: _Run) -> int | None:
    """Return the longest side of the images of a run; None for squares of the recipe's own, whatever is predicted."""
    if run.recipe.squash is not None:
        return None
    return run.scenes[0].process_res or run.model.spec.default_side


def _train(run: _Run, plan: Plan) -> Adapted:
    """Attach an adapter, train it or go on training it, and look at what came out."""
    started, recipe, steps = time.monotonic(), run.recipe, run.steps
    model = run.model.to(run.compute.device)
    adapter = Adapter.attach(
        model, rank=recipe.rank, alpha=recipe.alpha, dropout=recipe.dropout,
        generator=torch.Generator().manual_seed(run.seed), process_res=_process_res(run),
    )  # fmt: skip
    result = Adapted(
        adapter=adapter, recipe=recipe, seed=run.seed, scenes=tuple(scene.name for scene in run.scenes),
        precision=run.compute.precision, with_cameras=any(scene.priors is not None for scene in run.scenes),
        own_loss=_name(run.own_loss),
        windows=tuple(None if scene.windows is None else len(scene.windows) for scene in run.scenes),
    )  # fmt: skip
    with ExitStack() as undo:
        undo.callback(adapter.detach)
        state = _State(run, result, started)
        samples = Samples(
            adapter, run.scenes, recipe, visited(steps)[state.next_step :], compute=run.compute, place=plan.place,
            folder=run.folder, seed=run.seed,
        )  # fmt: skip
        undo.callback(samples.close)
        try:
            _steps(run, plan, samples, state)
            result.gain = _gain(run, adapter, samples)
        except (KeyboardInterrupt, SystemExit):
            state.save_stopped()
            raise
        undo.pop_all()
        samples.close()
    result.seconds = state.seconds()
    return result


def _steps(run: _Run, plan: Plan, samples: Samples, state: _State) -> None:
    """Algorithm 1: per step, compare the student with the frozen teacher on every view set and update the adapter."""
    steps, adapter = run.steps, state.result.adapter
    saved_at = time.monotonic()
    if state.next_step > 0:
        # A run can be stopped after a step and before its epoch was announced.
        _end_epoch(run, state, state.next_step - 1)
    for step in range(state.next_step, len(steps)):
        state.optimiser.zero_grad(set_to_none=True)
        with _training(run, plan, step):
            parts = [_learn(run, adapter, visit, samples.take(visit), state.scaler) for visit in steps[step]]
        terms = {name: torch.stack([part[name] for part in parts]).sum() for name in parts[0]}
        with undisturbed():
            state.update(terms)
        run.on_step(Progress(step=step, steps=len(steps), epoch=steps[step][0].epoch, terms=terms))
        _end_epoch(run, state, step)
        if run.folder is not None and time.monotonic() - saved_at > SAVE_EVERY_S:
            state.save()
            saved_at = time.monotonic()


def _end_epoch(run: _Run, state: _State, step: int) -> None:
    """Announce an epoch whose last step was this one; nothing happens for other steps."""
    steps, epoch = run.steps, run.steps[step][0].epoch
    if step + 1 == len(steps) or steps[step + 1][0].epoch != epoch:
        state.read_terms()
        run.on_epoch(epoch, state.result.adapter)


def _learn(
    run: _Run, adapter: Adapter, visit: Visit, sample: Sample, scaler: torch.amp.GradScaler
) -> dict[str, Tensor]:
    """Add the gradients of one view set, and return its share of the step's loss terms."""
    share = 1 / len(run.steps[visit.step])
    total, terms = torch.zeros((), device=run.compute.device), {}
    for loss, parts in _losses(run, adapter, visit, sample):
        scaler.scale(loss * share).backward()
        total = total + loss.detach()
        terms |= parts
    return {name: term * share for name, term in {**terms, "total": total}.items()}


def _losses(run: _Run, adapter: Adapter, visit: Visit, sample: Sample) -> Generator[tuple[Tensor, dict[str, Tensor]]]:
    """Yield the loss of each forward pass that the recipe needs, with its detached terms; `total` is their sum."""
    yield _student_loss(run, adapter, visit, sample)
    if run.recipe.sees_all:
        yield _all_views_loss(run, adapter, sample)


def _student_loss(run: _Run, adapter: Adapter, visit: Visit, sample: Sample) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the losses of the student's views: features against the teacher's, cameras against the targets."""
    recipe, sample = run.recipe, sample.student()
    with run.compute.autocast():
        student = loss_features(adapter.model, sample.tokens, sample.priors)
    losses, terms = [], {}
    if recipe.features:
        draws = step_draws(sample, visit.step, recipe.loss, seed=run.seed)
        loss, terms = adaptation_loss(
            student.levels, sample.teacher.levels, sample.held_out, draws, recipe.loss, form=sample.form,
            patches=sample.patches,
        )  # fmt: skip
        losses.append(recipe.features * loss)
    if recipe.cameras:
        losses.append(recipe.cameras * _camera_loss(adapter.model, student, sample.targets))
        terms["cameras"] = losses[-1].detach()
    if run.own_loss is not None:
        losses.append(_checked(run.own_loss(student, sample.teacher)))
        terms["own"] = losses[-1].detach()
    return torch.stack(losses).sum(), terms


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


def _all_views_loss(run: _Run, adapter: Adapter, sample: Sample) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the losses of all N views (not in the paper): features held where they were, cameras as above."""
    recipe = run.recipe
    with run.compute.autocast():
        adapted = loss_features(adapter.model, sample.tokens, sample.priors)
    terms = {}
    if recipe.hold:
        distance, _ = feature_distance(adapted.levels, sample.teacher.levels, recipe.loss, patches=sample.patches)
        terms["hold"] = recipe.hold * distance
    if recipe.cameras:
        terms["cameras_all"] = recipe.cameras * _camera_loss(adapter.model, adapted, sample.targets)
    return torch.stack(list(terms.values())).sum(), {name: term.detach() for name, term in terms.items()}


def _camera_loss(model: ReconstructionModel, features: Features, targets: CameraTargets | None) -> Tensor:
    """Return the distance of the cameras that the frozen head reads off the features from the targets."""
    assert targets is not None
    found = model.decode(features, want=("cameras",))
    assert found.T_cam_world is not None
    assert found.K is not None
    return camera_loss(found.T_cam_world[0], found.K[0], targets)


@torch.no_grad()
def _gain(run: _Run, adapter: Adapter, samples: Samples) -> dict[str, float]:
    """Return the total loss of the last step's view sets without and with the adapter as it is now, equal tokens drawn.

    The loss of a step is that before its update, and of other view sets than the first step's.
    """
    frozen = adapted = 0.0
    for visit in run.steps[-1]:
        sample = samples.take(visit)
        with adapter.off():
            frozen += float(_student_loss(run, adapter, visit, sample)[0])
            if run.recipe.cameras:  # else there is `hold` only, which is 0 for the frozen model
                frozen += float(_all_views_loss(run, adapter, sample)[0])
        adapted += sum(float(loss) for loss, _ in _losses(run, adapter, visit, sample))
    count = len(run.steps[-1])
    return {"frozen": frozen / count, "adapted": adapted / count}


@contextmanager
def _training(run: _Run, plan: Plan, step: int) -> Generator[None]:
    """Dropout on, seeded by the step so that a continued run draws the same masks; checkpointing as planned."""
    model, device = run.model, run.compute.device
    model.train(run.recipe.dropout > 0)
    model.set_recompute(plan.checkpointing)
    try:
        with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
            torch.manual_seed(step_seed(run.seed, step))
            yield
    finally:
        model.eval()
        model.set_recompute(False)


class _State:
    """What changes from step to step and can be saved and restored: adapter, optimiser, gradient scaler, loss curve."""

    def __init__(self, run: _Run, result: Adapted, started: float):
        self.run, self.result, self.started = run, result, started
        self.parameters = result.adapter.parameters()
        self.optimiser = torch.optim.AdamW(self.parameters, lr=0.0, weight_decay=run.recipe.weight_decay, fused=True)
        self.scaler = torch.amp.GradScaler(run.compute.device.type, enabled=run.compute.precision == "fp16")
        self.unread: list[tuple[int, dict[str, Tensor]]] = []
        self.next_step = self._restore()

    def update(self, terms: dict[str, Tensor]) -> None:
        """Clip the gradients and take an optimiser step.

        On the CPU a run that has diverged ends before the step. On an accelerator the check would wait for the device,
        so it is left to a later call of `read_terms`.
        """
        step, recipe = self.next_step, self.run.recipe
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
        self.next_step += 1
        # In a very short run several shares are the same step.
        for share in [share for share, step in self.run.keep_after.items() if step == self.next_step]:
            named = self.result.adapter.named_parameters()
            self.result.earlier[share] = {name: value.detach().cpu().clone() for name, value in named.items()}

    def read_terms(self) -> None:
        """Move the loss terms that are still on the device to the curve; DivergedError when they show a lost run."""
        curve = self.result.curve
        for step, terms in self.unread:
            values = {name: float(value) for name, value in terms.items()}
            for name, value in values.items():
                if not math.isfinite(value):
                    raise self._diverged(f"loss term {name} is not finite at step {step}")
            values.pop("gradient", None)
            curve.append(values)
            first, last = curve[0]["total"], curve[-1]["total"]
            if last > BLOWN_UP * first:
                raise self._diverged(f"the loss has grown from {first:.3g} to {last:.3g} by step {step}")
        self.unread.clear()

    def _diverged(self, what: str) -> DivergedError:
        half = " or use --precision fp32" if self.run.compute.precision != "fp32" else ""
        return DivergedError(f"adaptation diverged: {what}. Lower --lr (now {self.run.recipe.lr:g}){half}.")

    def seconds(self) -> float:
        """Return how long the run has taken so far, with its earlier parts."""
        return self.result.seconds + time.monotonic() - self.started

    def save(self) -> None:
        """Write the state after the last finished step."""
        assert self.run.folder is not None
        self.read_terms()
        about = {
            "identity": self._identity(), "next_step": self.next_step, "curve": self.result.curve,
            "seconds": self.seconds(), "scaler": self.scaler.state_dict(),
        }  # fmt: skip
        write_state(self.run.folder, self.result.adapter, self.optimiser, about, earlier=self.result.earlier)

    def save_stopped(self) -> None:
        """Write the state of a run that is being stopped, if it has a folder and a step to its name, and say so."""
        if self.run.folder is None or self.next_step == 0:
            return
        self.save()
        logger.info(
            "stopped after step %d of %d; the state is saved in %s", self.next_step, len(self.run.steps),
            self.run.folder,
        )  # fmt: skip

    def _restore(self) -> int:
        """Load the saved state, if there is one, and return the step to continue at."""
        if self.run.folder is None:
            return 0
        about = read_state(self.run.folder, self.result.adapter, self.optimiser, self._identity())
        if about is None:
            return 0
        self.scaler.load_state_dict(about["scaler"])
        self.result.curve, self.result.seconds = about["curve"], about["seconds"]
        self.result.earlier = about["earlier"]
        return about["next_step"]

    def _identity(self) -> str:
        """Return a fingerprint of model name, scenes, recipe, seed and precision; pixels and weights are left out.

        Targets and priors of a scene are in it, which depend on more than the photos, its windows, and the size of its
        images where that is not the model's default.
        """
        scenes = [
            (
                scene.name,
                scene.count,
                *(part and part.digest() for part in (scene.targets, scene.priors)),
                *(() if scene.process_res is None else (scene.process_res,)),
                *(scene.windows or ()),
            )
            for scene in self.run.scenes
        ]
        model, recipe = self.run.model.spec.name, asdict(self.run.recipe)
        about = {"model": model, "scenes": scenes, "recipe": recipe, "seed": self.run.seed}
        about["precision"] = self.run.compute.precision
        about["keep_after"] = sorted(self.run.keep_after)
        if self.run.own_loss is not None:
            about["own_loss"] = _name(self.run.own_loss)
        return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]
