"""The adaptation loop: the algorithm box of the paper, resumable at any step."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.bank import SceneImages, ViewBank
from freegeo.adaptation.losses import adaptation_loss, require_finite
from freegeo.adaptation.recipe import Recipe
from freegeo.adaptation.teacher import TeacherBank
from freegeo.adaptation.views import Visit, schedule
from freegeo.errors import UserError
from freegeo.models.api import ReconstructionModel
from freegeo.models.precision import Precision, autocast
from freegeo.storage import write_tensors

SAVE_EVERY_S = 30.0
STATE_FILE = "adapting.safetensors"


@dataclass(frozen=True, kw_only=True)
class Engine:
    """How a run is computed; nothing here changes the result beyond rounding."""

    device: torch.device = torch.device("cpu")
    precision: Precision = "fp32"
    share_prefix: bool = True
    """Embed every image once, instead of in every pass."""
    cache_teacher: bool = True
    """Compute the teacher once per view set, instead of in every step."""
    recompute_blocks: bool = False
    """Activation checkpointing: less memory, one more student forward."""


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
    """A trained adapter, still in place on its model, and how it came about."""

    adapter: Adapter
    recipe: Recipe
    seed: int
    curve: list[dict[str, float]] = field(default_factory=list)
    """Loss terms of every step."""
    seconds: float = 0.0

    def page(self, scenes: Sequence[str]) -> dict:
        """Return the content of freegeo.json."""
        return {
            "recipe": asdict(self.recipe),
            "seed": self.seed,
            "scenes": list(scenes),
            "loss_curve": self.curve,
            "seconds": round(self.seconds, 2),
        }


def learning_rate(step: int, steps: int, recipe: Recipe) -> float:
    """Return the rate of a step: linear warm-up from 1 %, then cosine to the final rate (fact sheet, section 3.4)."""
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
    seed: int = 42,
    engine: Engine | None = None,
    resume_in: Path | None = None,
    on_step: Callable[[Progress], None] = lambda progress: None,
    on_epoch: Callable[[int, Adapter], None] = lambda epoch, adapter: None,
) -> Adapted:
    """Train an adapter on the scenes' images; it stays in place on the model, on.

    `resume_in` is a folder for the state of an unfinished run: the same call continues it, and on the CPU ends with
    the same tensors. UserError for scenes that are too small; FreeGeoError when a loss is not finite, before the
    optimiser has seen it.
    """
    engine = engine or Engine()
    started = time.monotonic()
    steps = schedule([scene.count for scene in scenes], recipe, seed)
    part = model.adaptable().to(engine.device)
    adapter = Adapter.attach(
        part, rank=recipe.rank, alpha=recipe.alpha, dropout=recipe.dropout, generator=_generator(seed)
    )
    run = _Run(adapter, scenes, recipe, steps, seed, engine)
    result = Adapted(adapter=adapter, recipe=recipe, seed=seed)
    first = run.restore(resume_in, result)
    saved_at = time.monotonic()
    try:
        for step in range(first, len(steps)):
            terms = run.step(step)
            result.curve.append(terms)  # type: ignore[arg-type]
            on_step(Progress(step=step, steps=len(steps), epoch=steps[step][0].epoch, terms=terms))
            if step + 1 == len(steps) or steps[step + 1][0].epoch != steps[step][0].epoch:
                on_epoch(steps[step][0].epoch, adapter)
            if resume_in is not None and time.monotonic() - saved_at > SAVE_EVERY_S:
                run.save(resume_in, step + 1, result)
                saved_at = time.monotonic()
    except BaseException:
        adapter.detach()
        raise
    result.curve = _floats(result.curve)
    result.seconds += time.monotonic() - started
    return result


class _Run:
    """One adaptation: the parts that a step needs."""

    def __init__(
        self,
        adapter: Adapter,
        scenes: Sequence[SceneImages],
        recipe: Recipe,
        steps: list[list[Visit]],
        seed: int,
        engine: Engine,
    ):
        self.adapter, self.recipe, self.steps, self.seed, self.engine = adapter, recipe, steps, seed, engine
        self.arithmetic = partial(autocast, engine.device, engine.precision)
        self.bank = ViewBank(
            adapter.model, scenes, recipe, device=engine.device, arithmetic=self.arithmetic, share=engine.share_prefix
        )
        visits = [visit for visits in steps for visit in visits]
        self.teacher = TeacherBank(
            adapter, self.bank, recipe.loss, visits, seed=seed, arithmetic=self.arithmetic, keep=engine.cache_teacher
        )
        self.optimiser = torch.optim.AdamW(adapter.parameters(), lr=recipe.lr, weight_decay=recipe.weight_decay)
        self.scaler = torch.amp.GradScaler(engine.device.type, enabled=engine.precision == "fp16")
        self.epoch = 0

    def step(self, step: int) -> dict[str, Tensor]:
        """Compare the student with the teacher on the step's view sets and update the adapter; return the mean terms."""
        visits = self.steps[step]
        self._enter_epoch(visits[0].epoch)
        self._set_rate(step)
        self.optimiser.zero_grad(set_to_none=True)
        per_set = []
        with self._training(step):
            for visit in visits:
                targets, draws = self.teacher.targets(visit)
                student = self._student(visit)
                loss, terms = adaptation_loss(student, targets, draws, self.recipe.loss)
                self.scaler.scale(loss / len(visits)).backward()
                per_set.append(terms)
        terms = {name: torch.stack([one[name] for one in per_set]).mean() for name in per_set[0]}
        require_finite(terms, step=step)
        self.scaler.unscale_(self.optimiser)
        torch.nn.utils.clip_grad_norm_(self.adapter.parameters(), self.recipe.clip)
        self.scaler.step(self.optimiser)
        self.scaler.update()
        return terms

    def _student(self, visit: Visit) -> dict[int, tuple[Tensor, Tensor]]:
        tokens = self.bank.tokens(visit.view_set, visit.view_set.kept)
        model = self.adapter.model
        with self.arithmetic():
            return dict(model.aggregate(tokens, layers=model.spec.loss_layers, reference="first").levels)

    def _enter_epoch(self, epoch: int) -> None:
        if epoch != self.epoch and self.recipe.redraw:
            self.bank.forget()
            self.teacher.forget()
        self.epoch = epoch

    def _set_rate(self, step: int) -> None:
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate(step, len(self.steps), self.recipe)

    @contextmanager
    def _training(self, step: int) -> Iterator[None]:
        """Dropout on, seeded by the step so that a resumed run draws the same masks; checkpointing as asked."""
        model = self.adapter.model
        model.train(self.recipe.dropout > 0)
        model.set_recompute(self.engine.recompute_blocks)
        try:
            with torch.random.fork_rng(devices=_cuda_devices(self.engine.device)):
                torch.manual_seed(self.seed * 1_000_003 + step)
                yield
        finally:
            model.eval()
            model.set_recompute(False)

    def save(self, folder: Path, next_step: int, result: Adapted) -> None:
        """Write parameters, optimiser and loss curve so that `restore` goes on with `next_step`."""
        tensors = {}
        for name, parameter in self.adapter.named_parameters().items():
            tensors[name] = parameter
            for key, value in self.optimiser.state[parameter].items():
                tensors[f"{name}|{key}"] = value
        result.curve = _floats(result.curve)
        about = {
            "next_step": next_step,
            "curve": result.curve,
            "seconds": result.seconds,
            "scaler": self.scaler.state_dict(),
        }
        write_tensors(folder / STATE_FILE, tensors, {"run": json.dumps(about)})

    def restore(self, folder: Path | None, result: Adapted) -> int:
        """Take over a saved state, if there is one, and return the step to go on with."""
        path = None if folder is None else folder / STATE_FILE
        if path is None or not path.is_file():
            return 0
        from safetensors import safe_open

        with safe_open(path, framework="pt") as file:
            about = json.loads(file.metadata()["run"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        named = self.adapter.named_parameters()
        if not set(named) <= set(tensors):
            raise UserError(f"{path}: this state belongs to another run. Remove it, or choose another output folder.")
        self.adapter.load({name: tensors[name] for name in named})
        for name, parameter in named.items():
            state = {key.partition("|")[2]: value for key, value in tensors.items() if key.startswith(f"{name}|")}
            # AdamW keeps its step counter on the CPU.
            self.optimiser.state[parameter] = {
                key: value if key == "step" else value.to(parameter.device) for key, value in state.items()
            }
        self.scaler.load_state_dict(about["scaler"])
        result.curve, result.seconds = about["curve"], about["seconds"]
        return about["next_step"]


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _cuda_devices(device: torch.device) -> list[torch.device]:
    return [device] if device.type == "cuda" else []


def _floats(curve: list) -> list[dict[str, float]]:
    return [{name: float(value) for name, value in terms.items()} for terms in curve]
