"""The adaptation loop: the algorithm box of the paper, resumable at any step."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.bank import ViewBank, accesses
from freegeo.adaptation.dropout import pack_dropout
from freegeo.adaptation.engine import Engine
from freegeo.adaptation.images import SceneImages
from freegeo.adaptation.losses import adaptation_loss, feature_distance, require_finite
from freegeo.adaptation.recipe import PAPER_SEED, Recipe
from freegeo.adaptation.state import read_state, run_identity, write_state
from freegeo.adaptation.teacher import Comparison, TeacherBank, loss_features, stacked
from freegeo.adaptation.views import Visit, schedule
from freegeo.models.api import ReconstructionModel
from freegeo.models.precision import autocast, cast_linears
from freegeo.types import ViewTokens

SAVE_EVERY_S = 30.0
STATE_FILE = "adapting.safetensors"
GRADIENT = "gradient"


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
    seed: int = PAPER_SEED,
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
    result = Adapted(adapter=adapter, recipe=recipe, seed=seed)
    with ExitStack() as stack:
        stack.callback(adapter.detach)
        run = _Run(result, scenes, steps, engine, resume_in)
        stack.callback(run.close)
        saved_at = time.monotonic()
        for step in range(run.first, len(steps)):
            terms = run.step(step)
            on_step(Progress(step=step, steps=len(steps), epoch=steps[step][0].epoch, terms=terms))
            if step + 1 == len(steps) or steps[step + 1][0].epoch != steps[step][0].epoch:
                run.watch.check()
                on_epoch(steps[step][0].epoch, adapter)
            if resume_in is not None and time.monotonic() - saved_at > SAVE_EVERY_S:
                run.save(step + 1, elapsed=time.monotonic() - started)
                saved_at = time.monotonic()
        stack.pop_all()
        run.close()
    result.curve = _floats(run.curve)
    result.seconds += time.monotonic() - started
    return result


class _Watch:
    """Stops a run whose loss or gradient is not finite, before the optimiser changes anything.

    Usually the numbers are read at once. On CUDA the device itself leaves the update out, and the host reads the
    verdict of a step after it has queued the next one, so that the device never waits for it.
    """

    def __init__(self, *, at_once: bool):
        self.at_once = at_once
        self._pending: tuple[int, dict[str, Tensor], Tensor, torch.cuda.Event | None] | None = None

    def see(self, step: int, terms: dict[str, Tensor]) -> None:
        """Look at the scalars of a step; raises FreeGeoError that names the first one that is not finite."""
        if self.at_once:
            require_finite(terms, step=step)
            return
        finite = torch.stack([term.isfinite().all() for term in terms.values()])
        on_cuda = finite.device.type == "cuda"
        verdict = torch.empty(finite.shape, dtype=torch.bool, pin_memory=on_cuda).copy_(finite, non_blocking=True)
        event = torch.cuda.Event() if on_cuda else None
        if event is not None:
            event.record()
        self.check()
        self._pending = step, terms, verdict, event

    def check(self) -> None:
        """Read what is still unread."""
        if self._pending is None:
            return
        step, terms, verdict, event = self._pending
        self._pending = None
        if event is not None:
            event.synchronize()
        if not verdict.all():
            require_finite(terms, step=step)


class _Run:
    """One adaptation: the parts that a step needs."""

    def __init__(
        self,
        result: Adapted,
        scenes: Sequence[SceneImages],
        steps: list[list[Visit]],
        engine: Engine,
        folder: Path | None,
    ):
        self.result, self.steps, self.engine, self.folder = result, steps, engine, folder
        self.adapter, self.recipe, self.seed = result.adapter, result.recipe, result.seed
        self.arithmetic = partial(autocast, engine.device, engine.precision)
        if engine.device.type == "cpu":
            pack_dropout(self.adapter)
        if engine.half_weights:
            cast_linears(self.adapter.model, engine.precision)
        parameters = self.adapter.parameters()
        self.optimiser = torch.optim.AdamW(parameters, lr=0.0, weight_decay=self.recipe.weight_decay, fused=True)
        self.scaler = torch.amp.GradScaler(engine.device.type, enabled=engine.precision == "fp16")
        self.watch = _Watch(at_once=engine.device.type != "cuda")
        self.curve: list[Mapping[str, float | Tensor]] = []
        self.identity = run_identity(self.adapter.model.spec.name, scenes, self.recipe, self.seed)
        self.first = self._restore()
        ahead = steps[self.first :]
        self.bank = ViewBank(
            self.adapter.model,
            scenes,
            self.recipe,
            planned=list(accesses(ahead, self.recipe, teacher_once=engine.cache_teacher)),
            engine=engine,
            arithmetic=self.arithmetic,
        )
        visits = [visit for visits in ahead for visit in visits]
        self.teacher = TeacherBank(
            self.adapter, self.bank, self.recipe, visits, seed=self.seed, engine=engine, arithmetic=self.arithmetic
        )

    def step(self, step: int) -> dict[str, Tensor]:
        """Compare the student with the teacher on the step's view sets, update the adapter, return the mean terms."""
        visits = self.steps[step]
        self.optimiser.zero_grad(set_to_none=True)
        parts = []
        with self._training(step):
            for tokens, comparison in self._batches(visits):
                share = len(tokens.tokens) / len(visits)
                parts.append(self._backward(*self._compare(tokens, comparison), share))
                # What the next view set needs shall not meet what this one needed.
                del tokens, comparison
            for visit in visits if self.recipe.hold else ():
                parts.append(self._backward(*self._hold(visit), 1 / len(visits)))
        names = dict.fromkeys(name for part in parts for name in part)
        terms = {name: torch.stack([part[name] for part in parts if name in part]).sum() for name in names}
        self._update(step, terms)
        self.curve.append(terms)
        return terms

    def _batches(self, visits: Sequence[Visit]) -> Iterator[tuple[ViewTokens, Comparison]]:
        """Yield student tokens and targets; successive view sets of equal shape share a batch up to the micro-batch."""
        waiting: list[tuple[ViewTokens, Comparison]] = []
        for visit in visits:
            waiting.append(self._inputs(visit))
            if _shape(waiting[-1]) != _shape(waiting[0]):
                odd = waiting.pop()
                yield _joined(waiting)
                waiting = [odd]
            if len(waiting) == self.engine.micro_batch:
                yield _joined(waiting)
                waiting = []
        if waiting:
            yield _joined(waiting)

    def _inputs(self, visit: Visit) -> tuple[ViewTokens, Comparison]:
        comparison = self.teacher.targets(visit)
        return self.bank.tokens(visit.view_set, visit.view_set.kept), comparison

    def _compare(self, tokens: ViewTokens, comparison: Comparison) -> tuple[Tensor, dict[str, Tensor]]:
        with self.arithmetic():
            levels = loss_features(self.adapter.model, tokens)
        return adaptation_loss(
            levels, comparison.targets, comparison.draws, self.recipe.loss, form=comparison.precision
        )

    def _hold(self, visit: Visit) -> tuple[Tensor, dict[str, Tensor]]:
        """Compare the adapted features of all views with the frozen ones: what needs no correction shall stay."""
        tokens = self.bank.tokens(visit.view_set, visit.view_set.positions)
        with self.arithmetic():
            with torch.no_grad(), self.adapter.off():
                frozen = loss_features(self.adapter.model, tokens)
            adapted = loss_features(self.adapter.model, tokens)
        loss = self.recipe.hold * feature_distance(adapted, frozen, self.recipe.loss)[0]
        return loss, {"hold": loss.detach(), "total": loss.detach()}

    def _backward(self, loss: Tensor, terms: dict[str, Tensor], share: float) -> dict[str, Tensor]:
        """Add a loss's share of the step to the gradients, and return the share of its terms."""
        # A loss that is not finite shall leave no finite gradient behind.
        factor = torch.where(loss.detach().isfinite(), share, torch.nan)
        self.scaler.scale(loss * factor).backward()
        return {name: term * share for name, term in terms.items()}

    def _update(self, step: int, terms: dict[str, Tensor]) -> None:
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate(step, len(self.steps), self.recipe)
        self.scaler.unscale_(self.optimiser)
        norm = torch.nn.utils.clip_grad_norm_(self.adapter.parameters(), self.recipe.clip)
        if self.scaler.is_enabled():
            # The scaler meets gradients that overflow by leaving the step out and scaling less; that is no failure.
            self.watch.see(step, terms)
        else:
            self.watch.see(step, {**terms, GRADIENT: norm.detach()})
            if not self.watch.at_once:
                # The fused optimiser reads this attribute, as it does for gradient scalers.
                vars(self.optimiser)["found_inf"] = (~norm.isfinite()).float()
        self.scaler.step(self.optimiser)
        self.scaler.update()

    @contextmanager
    def _training(self, step: int) -> Generator[None]:
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

    def save(self, next_step: int, *, elapsed: float) -> None:
        """Write a state that goes on with `next_step`."""
        assert self.folder is not None
        self.watch.check()
        self.curve = list(_floats(self.curve))
        about = {
            "identity": self.identity,
            "next_step": next_step,
            "curve": self.curve,
            "seconds": self.result.seconds + elapsed,
            "scaler": self.scaler.state_dict(),
        }
        write_state(self.folder / STATE_FILE, self.adapter, self.optimiser, about)

    def close(self) -> None:
        """Drop tokens, targets and the background thread."""
        self.bank.close()
        self.teacher.close()

    def _restore(self) -> int:
        """Take over a saved state, if there is one, and return the step to go on with."""
        if self.folder is None:
            return 0
        about = read_state(self.folder / STATE_FILE, self.adapter, self.optimiser, self.identity)
        if about is None:
            return 0
        self.scaler.load_state_dict(about["scaler"])
        self.curve, self.result.seconds = about["curve"], about["seconds"]
        return about["next_step"]


def _shape(part: tuple[ViewTokens, Comparison]) -> tuple:
    tokens, comparison = part
    # Draws depend on the numbers of views and tokens only, so sets of equal shape share those of the step.
    return tokens.tokens.shape, tokens.image_hw, comparison.targets.anchors.angle.shape, comparison.views


def _joined(parts: Sequence[tuple[ViewTokens, Comparison]]) -> tuple[ViewTokens, Comparison]:
    if len(parts) == 1:
        return parts[0]
    return ViewTokens.stack([tokens for tokens, _ in parts]), stacked([comparison for _, comparison in parts])


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _cuda_devices(device: torch.device) -> list[torch.device]:
    return [device] if device.type == "cuda" else []


def _floats(curve: Sequence[Mapping[str, float | Tensor]]) -> list[dict[str, float]]:
    return [{name: float(value) for name, value in terms.items()} for terms in curve]
