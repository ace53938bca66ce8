"""A run of adaptation and its state: what was asked for, what changes from step to step, and the file of both.

A run that was stopped goes on from the file of its state: trained parameters, the optimiser's moments, the adapter's
earlier states, and JSON-like facts.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, TypedDict

import torch
from msgspec import Meta
from torch import Tensor, nn

from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.memory import Plan
from freegeo.adaptation.recipe import Recipe
from freegeo.adaptation.samples import SceneImages
from freegeo.adaptation.views import Visit
from freegeo.errors import DamagedError, DivergedError, UserError
from freegeo.files import json_of, read_tensors, remove_file, write_tensors
from freegeo.models.api import ReconstructionModel
from freegeo.models.precision import Compute
from freegeo.types import Features

logger = logging.getLogger(__name__)

UNFINISHED_FILE = "adapting.safetensors"
BLOWN_UP = 1e4
"""A loss of so many times the first step's ends a run: no run was seen to come back from there, and steps get slow."""
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


@dataclass(frozen=True, kw_only=True)
class Run:
    """The arguments of `adapt`, with what follows from them: the visits of every step and the plan."""

    model: ReconstructionModel
    scenes: Sequence[SceneImages]
    recipe: Recipe
    steps: Sequence[Sequence[Visit]]
    seed: int
    compute: Compute
    plan: Plan
    folder: Path | None
    on_step: Callable[[Progress], None]
    on_epoch: Callable[[int, Adapter], None]
    keep_after: Mapping[float, int]
    """Shares of the steps after which the adapter's state is kept -> how many finished steps that are."""
    own_loss: OwnLoss | None

    @property
    def own_loss_name(self) -> str | None:
        """Name of the user's own term."""
        term = self.own_loss
        return None if term is None else getattr(term, "__qualname__", type(term).__qualname__)


class State:
    """What changes from step to step and can be saved and restored: adapter, optimiser, gradient scaler, loss curve."""

    def __init__(self, run: Run, adapter: Adapter, started: float):
        """`started` is the time of the clock (`time.monotonic`) when this part of the run began."""
        self.run, self.adapter, self.started = run, adapter, started
        self.parameters = adapter.parameters()
        self.optimiser = torch.optim.AdamW(self.parameters, lr=0.0, weight_decay=run.recipe.weight_decay, fused=True)
        self.scaler = torch.amp.GradScaler(run.compute.device.type, enabled=run.compute.precision == "fp16")
        self.curve: list[dict[str, float]] = []
        self.unread: list[tuple[int, dict[str, Tensor]]] = []
        self.earlier: dict[float, dict[str, Tensor]] = {}
        self.next_step, self.seconds_before = 0, 0.0
        if run.folder is not None:
            self._restore(run.folder)

    def update(self, terms: dict[str, Tensor], rate: float) -> None:
        """Clip the gradients and take an optimiser step.

        On the CPU a run that has diverged ends before the step. On an accelerator the check would wait for the device,
        so it is left to a later call of `read_terms`.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.scaler.unscale_(self.optimiser)
        norm = torch.nn.utils.clip_grad_norm_(self.parameters, self.run.recipe.clip)
        # When gradients overflow, the scaler skips the step and lowers its scale, so that is no failure.
        gradient = {} if self.scaler.is_enabled() else {"gradient": norm.detach()}
        self.unread.append((self.next_step, terms | gradient))
        if self.run.compute.device.type == "cpu":
            self.read_terms()
        self.scaler.step(self.optimiser)
        self.scaler.update()
        self.next_step += 1
        # In a very short run several shares are the same step.
        for share in [share for share, step in self.run.keep_after.items() if step == self.next_step]:
            named = self.adapter.named_parameters()
            self.earlier[share] = {name: value.detach().cpu().clone() for name, value in named.items()}

    def read_terms(self) -> None:
        """Move the loss terms that are still on the device to the curve; DivergedError when they show a lost run."""
        for step, terms in self.unread:
            values = {name: float(value) for name, value in terms.items()}
            for name, value in values.items():
                if not math.isfinite(value):
                    raise self._diverged(f"loss term {name} is not finite at step {step}")
            values.pop("gradient", None)
            self.curve.append(values)
            first, last = self.curve[0]["total"], values["total"]
            if last > BLOWN_UP * first:
                raise self._diverged(f"the loss has grown from {first:.3g} to {last:.3g} by step {step}")
        self.unread.clear()

    def _diverged(self, what: str) -> DivergedError:
        half = " or use --precision fp32" if self.run.compute.precision != "fp32" else ""
        return DivergedError(f"adaptation diverged: {what}. Lower --lr (now {self.run.recipe.lr:g}){half}.")

    def seconds(self) -> float:
        """Return how long the run has taken so far, with its earlier parts."""
        return self.seconds_before + time.monotonic() - self.started

    def save(self, *, stopped: bool = False) -> None:
        """Write the state after the last finished step, if there are a folder and such a step.

        `stopped` says that the run ends here, which the user is told.
        """
        folder = self.run.folder
        if folder is None or self.next_step == 0:
            return
        self.read_terms()
        about = {
            "identity": self._identity(), "next_step": self.next_step, "curve": self.curve,
            "seconds": self.seconds(), "scaler": self.scaler.state_dict(),
        }  # fmt: skip
        write_state(folder, self.adapter, self.optimiser, about, earlier=self.earlier)
        if stopped:
            steps = len(self.run.steps)
            logger.info("stopped after step %d of %d; the state is saved in %s", self.next_step, steps, folder)

    def _restore(self, folder: Path) -> None:
        """Load the saved state, if there is one."""
        about = read_state(folder, self.adapter, self.optimiser, self._identity())
        if about is not None:
            self.scaler.load_state_dict(about["scaler"])
            self.curve, self.earlier = about["curve"], about["earlier"]
            self.next_step, self.seconds_before = about["next_step"], about["seconds"]

    def _identity(self) -> str:
        """Return a fingerprint of model name, scenes, recipe, seed and precision; pixels and weights are left out.

        Targets and priors of a scene are in it, which depend on more than the photos, its windows, and the size of its
        images where that is not the model's default.
        """
        run = self.run
        scenes = [
            (
                scene.name,
                scene.count,
                *(part and part.digest() for part in (scene.targets, scene.priors)),
                *(() if scene.process_res is None else (scene.process_res,)),
                *(scene.windows or ()),
            )
            for scene in run.scenes
        ]
        about = {
            "model": run.model.spec.name, "scenes": scenes, "recipe": asdict(run.recipe), "seed": run.seed,
            "precision": run.compute.precision, "keep_after": sorted(run.keep_after),
        }  # fmt: skip
        if run.own_loss is not None:
            about["own_loss"] = run.own_loss_name
        return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]


class About(TypedDict):
    """The facts beside the tensors."""

    identity: str
    next_step: Annotated[int, Meta(ge=1)]
    curve: list[dict[str, float]]
    seconds: float
    scaler: dict[str, float]


def write_state(
    folder: Path,
    adapter: Adapter,
    optimiser: torch.optim.Optimizer,
    about: Mapping[str, Any],
    *,
    earlier: Mapping[float, Mapping[str, Tensor]],
) -> None:
    """Write the state into a folder, with states of the adapter after shares of the steps; replaced atomically.

    The tensors are `<parameter>`, `<parameter>|<moment of the optimiser>` and `earlier|<share>|<parameter>`.
    """
    tensors = {f"earlier|{share}|{name}": value for share, state in earlier.items() for name, value in state.items()}
    for name, parameter in adapter.named_parameters().items():
        tensors[name] = parameter
        for moment, value in optimiser.state[parameter].items():
            tensors[f"{name}|{moment}"] = value
    write_tensors(folder / UNFINISHED_FILE, tensors, {"run": json.dumps(about)})


def read_state(
    folder: Path, adapter: Adapter, optimiser: torch.optim.Optimizer, identity: str
) -> dict[str, Any] | None:
    """Load a saved state into the adapter and its optimiser and return the facts, among them the `earlier` states.

    None when there is no file.

    UserError for a damaged file, and for the state of another run: one whose facts have another `identity`.
    """
    path = folder / UNFINISHED_FILE
    if not path.is_file():
        return None
    try:
        tensors, metadata = read_tensors(path)
        about = json_of(metadata.get("run", "{}"), path, About)
    except DamagedError as error:
        raise _damaged(path, error.reason) from None
    if about["identity"] != identity:
        raise UserError(f"{path}: this state belongs to another run. Remove it, or choose another output folder.")
    named = adapter.named_parameters()
    try:
        values, earlier, moments = _sorted(tensors, named)
    except ValueError as error:
        raise _damaged(path, str(error)) from None
    adapter.load(values)
    for moment, group in moments.items():
        for name, value in group.items():
            # The fused optimiser needs its state, the step counter included, on the parameter's device.
            optimiser.state[named[name]][moment] = value.to(named[name].device)
    about["earlier"] = earlier
    return about


Group = dict[str, Tensor]
"""Tensors by names of the adapter's parameters."""


def _sorted(tensors: Group, named: Mapping[str, nn.Parameter]) -> tuple[Group, dict[float, Group], dict[str, Group]]:
    """Return the tensors of a state: the adapter's values, earlier ones by share, the optimiser's by moment.

    ValueError for one that is missing, unknown, of another shape, or not finite.
    """
    values: Group = {}
    earlier: dict[float, Group] = {}
    moments: dict[str, Group] = {}
    for key, value in tensors.items():
        first, *rest = key.split("|")
        if first == "earlier" and len(rest) == 2:
            group, name = earlier.setdefault(float(rest[0]), {}), rest[1]
        elif len(rest) == 1:
            group, name = moments.setdefault(rest[0], {}), first
        else:
            group, name = values, key
        count_of_steps = len(rest) == 1 and value.ndim == 0
        if name not in named or not (count_of_steps or value.shape == named[name].shape):
            raise ValueError(f"{key} is not expected, or of another shape")
        if not value.is_floating_point() or not value.isfinite().all():
            raise ValueError(f"{key} holds values that are not finite numbers")
        group[name] = value
    if not all(0 < share <= 1 for share in earlier):
        raise ValueError("a share of the steps is not from 0 to 1")
    # None has moments where the gradient scaler left out every step.
    with_moments = set().union(*moments.values())
    for wanted, groups in ((set(named), [values, *earlier.values()]), (with_moments, moments.values())):
        for group in groups:
            if absent := wanted - set(group):
                raise ValueError(f"{min(absent)} is missing")
    return values, earlier, moments


def _damaged(path: Path, reason: str) -> UserError:
    return UserError(f"{path}: damaged state of an unfinished run ({reason}). Remove it to start again.")


def remove_state(folder: Path) -> None:
    """Remove the state of a run that is finished."""
    remove_file(folder / UNFINISHED_FILE)
