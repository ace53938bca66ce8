"""The teacher's targets: computed once per view set, holding only what the loss reads of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field

import torch
from torch import Tensor

from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.bank import ViewBank
from freegeo.adaptation.losses import (
    AnchorFeatures,
    LossConfig,
    StepDraws,
    TeacherTargets,
    anchor_features,
    draw_tokens,
    teacher_targets,
)
from freegeo.adaptation.views import ViewSet, Visit

Level = tuple[Tensor, Tensor]
DRAW_SEED_STRIDE = 1_000_003


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


@dataclass
class _Entry:
    """One view set's targets: kept views, and the anchors of every step that will ask for them."""

    kept: Mapping[int, Level]
    draws: dict[int, StepDraws] = field(default_factory=dict)
    anchors: dict[int, AnchorFeatures] = field(default_factory=dict)
    cross: Level | None = None
    """All N views at the cross layer, where that is smaller than the anchors of all steps."""


class TeacherBank:
    """Targets of all view sets of a run."""

    def __init__(
        self,
        adapter: Adapter,
        bank: ViewBank,
        config: LossConfig,
        visits: Sequence[Visit],
        *,
        seed: int,
        arithmetic: Callable[[], AbstractContextManager],
        keep: bool = True,
    ):
        self.adapter, self.bank, self.config = adapter, bank, config
        self.seed, self.arithmetic, self.keep = seed, arithmetic, keep
        self._entries: dict[ViewSet, _Entry] = {}
        self._steps: dict[ViewSet, list[int]] = {}
        for visit in visits:
            self._steps.setdefault(visit.view_set, []).append(visit.step)

    def targets(self, visit: Visit) -> tuple[TeacherTargets, StepDraws]:
        """Return what the loss compares the student with in this visit, and the tokens it draws."""
        entry = self._entries.get(visit.view_set)
        if entry is None:
            entry = self._compute(visit)
            if self.keep:
                self._entries[visit.view_set] = entry
        draws = entry.draws[visit.step]
        if entry.cross is None:
            return TeacherTargets(kept=entry.kept, anchors=entry.anchors[visit.step]), draws
        anchors = anchor_features(entry.cross, visit.view_set.kept, draws, self.config)
        return TeacherTargets(kept=entry.kept, anchors=anchors), draws

    def forget(self) -> None:
        """Drop everything, where a new epoch brings new pixels."""
        self._entries.clear()

    @torch.no_grad()
    def _compute(self, visit: Visit) -> _Entry:
        view_set, model = visit.view_set, self.adapter.model
        tokens = self.bank.tokens(view_set, range(len(view_set.frames)))
        with self.adapter.off(), self.arithmetic():
            levels = model.aggregate(tokens, layers=model.spec.loss_layers, reference="first").levels
        cross = levels[max(levels)]
        steps = self._steps[view_set] if self.keep else [visit.step]
        draws = {step: step_draws(self.config, cross, view_set, seed=self.seed, step=step) for step in steps}
        first = teacher_targets(levels, view_set.kept, draws[visit.step], self.config)
        # Compact copies, so that the full features of all views can go.
        kept = {layer: (patch.clone(), special.clone()) for layer, (patch, special) in first.kept.items()}
        per_step = first.anchors.angle.numel() * (1 if draws[visit.step].shared else 2)
        if per_step * len(steps) > sum(part.numel() for part in cross):
            return _Entry(kept=kept, draws=draws, cross=cross)
        anchors = {step: anchor_features(cross, view_set.kept, draws[step], self.config) for step in steps}
        return _Entry(kept=kept, draws=draws, anchors=anchors)
