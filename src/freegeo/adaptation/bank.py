"""Every image of a run, embedded once: the frozen per-view part is shared by teacher, student and all epochs."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import torch
from torch import Tensor

from freegeo.adaptation.recipe import Recipe
from freegeo.adaptation.views import ViewSet
from freegeo.models.api import ReconstructionModel
from freegeo.types import ImageBatch, ViewTokens

VIEWS_PER_CHUNK = 8


@dataclass(frozen=True, kw_only=True)
class SceneImages:
    """The images of one scene; `load` returns the chosen ones as (S, 3, H, W) in [0, 1], all of one size."""

    name: str
    count: int
    load: Callable[[Sequence[int]], Tensor]

    @classmethod
    def from_batch(cls, name: str, batch: ImageBatch) -> SceneImages:
        """Use images that are already at the model's size."""
        return cls(name=name, count=len(batch), load=lambda frames: batch.images[list(frames)])


def released_augmentation(images: Tensor, seed: int) -> Tensor:
    """Mirror a whole view set and change the brightness of some views, as a fixed function of the set's seed.

    Method's fact sheet, section 3.3: one draw decides the mirror (p = .5); then per view a draw decides (p = .5) and a
    second one gives the factor in [.8, 1.2]; results are clipped to [0, 1].
    """
    generator = random.Random(seed)
    if generator.random() < 0.5:
        images = images.flip(-1)
    factors = [generator.uniform(0.8, 1.2) if generator.random() < 0.5 else 1.0 for _ in range(len(images))]
    return (images * images.new_tensor(factors)[:, None, None, None]).clamp(0, 1)


class ViewBank:
    """Tokens of the images that view sets use, computed on demand and kept while pixels stay the same."""

    def __init__(
        self,
        model: ReconstructionModel,
        scenes: Sequence[SceneImages],
        recipe: Recipe,
        *,
        device: torch.device,
        arithmetic: Callable[[], AbstractContextManager],
        share: bool = True,
    ):
        self.model, self.scenes, self.recipe = model, scenes, recipe
        self.device, self.arithmetic, self.share = device, arithmetic, share
        self._kept: dict[tuple[int, int, int | None], ViewTokens] = {}

    def tokens(self, view_set: ViewSet, positions: Sequence[int]) -> ViewTokens:
        """Return the tokens (1, S, N, C) of some positions of a view set."""
        if not self.share:
            return self._embed(self._images(view_set)[list(positions)])
        keys = [self._key(view_set, position) for position in range(len(view_set.frames))]
        missing = [p for p, key in enumerate(keys) if key not in self._kept and key not in keys[:p]]
        if missing:
            embedded = self._embed(self._images(view_set)[missing])
            for number, position in enumerate(missing):
                self._kept[keys[position]] = embedded.select([number])
        return ViewTokens.join_views([self._kept[keys[position]] for position in positions])

    def forget(self) -> None:
        """Drop everything, where a new epoch brings new pixels."""
        self._kept.clear()

    def _key(self, view_set: ViewSet, position: int) -> tuple[int, int, int | None]:
        augmented = self.recipe.augmentation != "none"
        # Augmentation depends on the set and on the position in it, not only on the frame.
        variant = view_set.seed * 1000 + position if augmented else None
        return view_set.scene, view_set.frames[position], variant

    def _images(self, view_set: ViewSet) -> Tensor:
        images = self.scenes[view_set.scene].load(view_set.frames)
        return released_augmentation(images, view_set.seed) if self.recipe.augmentation == "released" else images

    @torch.no_grad()
    def _embed(self, images: Tensor) -> ViewTokens:
        parts = []
        for start in range(0, len(images), VIEWS_PER_CHUNK):
            chunk = images[start : start + VIEWS_PER_CHUNK].to(self.device)
            with self.arithmetic():
                parts.append(self.model.embed(chunk[None], layers=self.model.spec.loss_layers))
        return ViewTokens.join_views(parts)
