"""The teacher's targets: computed once per view set, holding only what the loss reads of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field

import torch
from torch import Tensor

from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.bank import SetKey, ViewBank, set_key
from freegeo.adaptation.cache import TensorCache
from freegeo.adaptation.engine import Engine
from freegeo.adaptation.losses import (
    AnchorFeatures,
    KLForm,
    Level,
    LossConfig,
    StepDraws,
    TeacherTargets,
    anchor_features,
    choose_form,
    draw_tokens,
    teacher_spread,
    teacher_targets,
)
from freegeo.adaptation.recipe import Recipe
from freegeo.adaptation.views import ViewSet, Visit
from freegeo.models.api import ReconstructionModel
from freegeo.types import ViewTokens

DRAW_SEED_STRIDE = 1_000_003
SPREAD_HEADROOM = 2.0
"""How far the student's softmax inputs may spread beyond the teacher's, where they are measured once per view set."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """What the loss compares the student of a visit with."""

    targets: TeacherTargets
    draws: StepDraws
    precision: KLForm | None
    """How the all-pairs KL is computed; None: the loss measures it, which costs a host read."""
    views: int
    """Views that the teacher saw."""


def loss_features(model: ReconstructionModel, tokens: ViewTokens) -> Mapping[int, Level]:
    """Return what a loss compares: the features at the loss layers, the first view being the reference."""
    return model.aggregate(tokens, layers=model.spec.loss_layers, reference="first").levels


def step_draws(config: LossConfig, level: Level, view_set: ViewSet, *, seed: int, step: int) -> StepDraws:
    """Return the token draws of a step, a function of the run's seed and the step alone."""
    patch, special = level
    per_view = patch.shape[2] + (special.shape[2] if config.cross_tokens == "all" else 0)
    draws = draw_tokens(
        config,
        tokens_per_view=per_view,
        student_views=len(view_set.kept),
        held_out_views=len(view_set.frames) - len(view_set.kept),
        generator=torch.Generator().manual_seed(seed * DRAW_SEED_STRIDE + step),
    )
    return draws.to(patch.device)


def anchors_are_smaller(config: LossConfig, cross: Level, visits: int) -> bool:
    """Say whether the anchors of all visits take less room than all views at the cross layer."""
    patch, special = cross
    references = min(config.num_reference, patch.shape[2] + (special.shape[2] if config.cross_tokens == "all" else 0))
    per_visit = references * config.num_anchors * patch.shape[-1] * (2 if config.separate_draws else 1)
    return per_visit * visits <= patch.numel() + special.numel()


@dataclass
class _Entry:
    """What is known of one view set beside its tensors."""

    left: Counter[int]
    """Visits still to come, by step; a small scene may give one set several times in a step."""
    draws: dict[int, StepDraws] = field(default_factory=dict)
    anchors_kept: bool = True
    """Anchors are kept per step; otherwise all views at the cross layer."""


class TeacherBank:
    """Targets of all view sets of a run."""

    def __init__(
        self,
        adapter: Adapter,
        bank: ViewBank,
        recipe: Recipe,
        visits: Sequence[Visit],
        *,
        seed: int,
        engine: Engine,
        arithmetic: Callable[[], AbstractContextManager],
    ):
        self.adapter, self.bank, self.recipe = adapter, bank, recipe
        self.config, self.seed, self.engine, self.arithmetic = recipe.loss, seed, engine, arithmetic
        self._cache = TensorCache(
            "targets", engine.cache_place, engine.device, folder=engine.cache_folder, half=engine.half_cache
        )
        self._entries: dict[SetKey, _Entry] = {}
        self._precisions: dict[SetKey, KLForm | None] = {}
        self._steps: dict[SetKey, list[int]] = {}
        for visit in visits:
            self._steps.setdefault(set_key(visit.view_set, recipe), []).append(visit.step)

    def targets(self, visit: Visit) -> Comparison:
        """Return what the loss compares the student with in this visit, and the tokens it draws."""
        key = set_key(visit.view_set, self.recipe)
        if not self.engine.cache_teacher:
            return self._once(visit)
        if key not in self._entries:
            self._compute(key, visit)
        entry = self._entries[key]
        draws = entry.draws[visit.step]
        kept = _levels(self._cache.get((key, "kept")))
        if entry.anchors_kept:
            anchors = _anchors(self._cache.get((key, visit.step)))
        else:
            cross = self._cache.get((key, "cross"))
            anchors = anchor_features((cross["patch"], cross["special"]), visit.view_set.kept, draws, self.config)
        self._count_down(key, visit.step)
        return self._comparison(visit, TeacherTargets(kept=kept, anchors=anchors), draws)

    def close(self) -> None:
        """Drop everything."""
        self._cache.close()

    def nbytes(self) -> int:
        """Bytes of the targets that are kept."""
        return self._cache.nbytes()

    def _count_down(self, key: SetKey, step: int) -> None:
        left = self._entries[key].left
        left[step] -= 1
        if not left[step]:
            self._cache.drop((key, step))
        if not left.total():
            for part in ("kept", "cross"):
                self._cache.drop((key, part))
            del self._entries[key]

    @torch.no_grad()
    def _features(self, view_set: ViewSet) -> Mapping[int, Level]:
        tokens = self.bank.tokens(view_set, view_set.positions)
        with self.adapter.off(), self.arithmetic():
            return loss_features(self.adapter.model, tokens)

    def _once(self, visit: Visit) -> Comparison:
        levels = self._features(visit.view_set)
        draws = self._draws(levels, visit.view_set, visit.step)
        targets = teacher_targets(levels, visit.view_set.kept, draws, self.config)
        # Compact copies, so that the full features of all views can go.
        return self._comparison(visit, TeacherTargets.from_tensors(targets.tensors()), draws)

    def _compute(self, key: SetKey, visit: Visit) -> None:
        """Run the teacher and keep compact copies, so that the full features of all views can go."""
        levels, kept_positions = self._features(visit.view_set), visit.view_set.kept
        cross = levels[max(levels)]
        # A resumed run needs nothing for the steps that are done.
        left = Counter(step for step in self._steps[key] if step >= visit.step)
        steps = sorted(left)
        draws = {step: self._draws(levels, visit.view_set, step) for step in steps}
        entry = _Entry(left=left, draws=draws, anchors_kept=anchors_are_smaller(self.config, cross, len(steps)))
        first = teacher_targets(levels, kept_positions, draws[visit.step], self.config)
        named = first.tensors()
        self._cache.put((key, "kept"), {name: named[name] for name in named if name.startswith("kept.")})
        if not entry.anchors_kept:
            self._cache.put((key, "cross"), {"patch": cross[0], "special": cross[1]})
        for step in steps if entry.anchors_kept else ():
            found = anchor_features(cross, kept_positions, draws[step], self.config)
            shared = {} if found.distance is found.angle else {"distance": found.distance}
            self._cache.put((key, step), {"angle": found.angle, **shared})
        self._entries[key] = entry

    def _draws(self, levels: Mapping[int, Level], view_set: ViewSet, step: int) -> StepDraws:
        return step_draws(self.config, levels[max(levels)], view_set, seed=self.seed, step=step)

    def _comparison(self, visit: Visit, targets: TeacherTargets, draws: StepDraws) -> Comparison:
        key = set_key(visit.view_set, self.recipe)
        if key not in self._precisions:
            self._precisions[key] = self._precision(targets, draws)
        return Comparison(
            targets=targets, draws=draws, precision=self._precisions[key], views=len(visit.view_set.frames)
        )

    def _precision(self, targets: TeacherTargets, draws: StepDraws) -> KLForm | None:
        """On the CPU nothing waits for a host read, so every step measures; elsewhere the teacher's stands for all."""
        if self.engine.device.type == "cpu" or not self.config.uses_distances or self.config.pairing != "all":
            return None
        return choose_form(float(teacher_spread(targets, draws, self.config)), headroom=SPREAD_HEADROOM)


def _levels(tensors: Mapping[str, Tensor]) -> dict[int, Level]:
    layers = sorted({int(name.split(".")[1]) for name in tensors})
    return {layer: (tensors[f"kept.{layer}.patch"], tensors[f"kept.{layer}.special"]) for layer in layers}


def _anchors(tensors: Mapping[str, Tensor]) -> AnchorFeatures:
    return AnchorFeatures(angle=tensors["angle"], distance=tensors.get("distance", tensors["angle"]))


def stacked(comparisons: Sequence[Comparison]) -> Comparison:
    """Join the comparisons of view sets of equal shape, visited in one step, into one batch."""
    if len(comparisons) == 1:
        return comparisons[0]
    targets = [comparison.targets for comparison in comparisons]
    kept = {
        layer: (
            torch.cat([one.kept[layer][0] for one in targets]),
            torch.cat([one.kept[layer][1] for one in targets]),
        )
        for layer in targets[0].kept
    }
    angle = torch.cat([one.anchors.angle for one in targets])
    shared = targets[0].anchors.distance is targets[0].anchors.angle
    distance = angle if shared else torch.cat([one.anchors.distance for one in targets])
    return Comparison(
        targets=TeacherTargets(kept=kept, anchors=AnchorFeatures(angle=angle, distance=distance)),
        draws=comparisons[0].draws,
        precision=_safest([comparison.precision for comparison in comparisons]),
        views=comparisons[0].views,
    )


def _safest(precisions: Sequence[KLForm | None]) -> KLForm | None:
    for precision in ("direct", "float64", "float32"):
        if precision in precisions:
            return precision
    return None
