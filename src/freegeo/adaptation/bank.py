"""Every image of a run, embedded once: the frozen per-view part is shared by teacher, student and all epochs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager

import torch
from torch import Tensor

from freegeo.adaptation.cache import TensorCache
from freegeo.adaptation.engine import Engine
from freegeo.adaptation.images import ImageQueue, SceneImages, released_augmentation
from freegeo.adaptation.recipe import Recipe
from freegeo.adaptation.views import ViewSet, Visit
from freegeo.models.api import ReconstructionModel
from freegeo.types import ViewTokens

ViewKey = tuple[int, int, int | None]
"""Scene, frame, and what augmentation made of it."""
SetKey = tuple[int, tuple[int, ...], tuple[int, ...], int | None]
Access = tuple[ViewSet, tuple[int, ...]]
"""A view set and the positions of it that somebody reads."""


def set_key(view_set: ViewSet, recipe: Recipe) -> SetKey:
    """Return what a view set's pixels depend on: sets of equal key have equal teacher targets."""
    variant = view_set.seed if recipe.augmentation != "none" else None
    return view_set.scene, view_set.frames, view_set.kept, variant


def view_key(view_set: ViewSet, position: int, recipe: Recipe) -> ViewKey:
    """Return what one view's pixels depend on; augmentation depends on the set and on the position in it."""
    variant = view_set.seed * 1000 + position if recipe.augmentation != "none" else None
    return view_set.scene, view_set.frames[position], variant


def accesses(steps: Iterable[Sequence[Visit]], recipe: Recipe, *, teacher_once: bool) -> Iterator[Access]:
    """List what is read, in order: by the teacher (once per view set, or in every visit), the student, and hold."""
    known: set[SetKey] = set()
    for visits in steps:
        for visit in visits:
            key = set_key(visit.view_set, recipe)
            if not teacher_once or key not in known:
                yield visit.view_set, visit.view_set.positions
            known.add(key)
            yield visit.view_set, visit.view_set.kept
        for visit in visits if recipe.hold else ():
            yield visit.view_set, visit.view_set.positions


@torch.no_grad()
def embed_in_chunks(
    model: ReconstructionModel, images: Tensor, *, device: torch.device, layers: Sequence[int] | None = None
) -> ViewTokens:
    """Embed images (S, 3, H, W) a few at a time, so that memory does not grow with S except for the result.

    On the CPU one at a time: then a view's tokens do not depend, in the last bit, on the views beside it.
    """
    chunk = views_per_chunk(device)
    parts = [model.embed(part.to(device)[None], layers=layers) for part in images.split(chunk)]
    return ViewTokens.join_views(parts)


def views_per_chunk(device: torch.device) -> int:
    """Return how many views are embedded together."""
    return 1 if device.type == "cpu" else 8


class ViewBank:
    """Tokens of the images that view sets use, computed on demand and kept until their last use."""

    def __init__(
        self,
        model: ReconstructionModel,
        scenes: Sequence[SceneImages],
        recipe: Recipe,
        *,
        planned: Sequence[Access],
        engine: Engine,
        arithmetic: Callable[[], AbstractContextManager],
    ):
        self.model, self.recipe, self.engine, self.arithmetic = model, recipe, engine, arithmetic
        self._cache = TensorCache(
            "tokens", engine.cache_place, engine.device, folder=engine.cache_folder, half=engine.half_cache
        )
        self._sizes: dict[int, tuple[tuple[int, int], tuple[int, int]]] = {}
        self._uses = Counter(key for view_set, positions in planned for key in set(self._keys(view_set, positions)))
        self._images = ImageQueue(scenes, list(self._requests(planned)), ahead=engine.images_ahead)

    def tokens(self, view_set: ViewSet, positions: Sequence[int]) -> ViewTokens:
        """Return the tokens (1, S, N, C) of some positions of a view set."""
        if not self.engine.share_prefix:
            return self._embed(view_set, positions)
        keys = self._keys(view_set, positions)
        fresh = {key: position for key, position in zip(keys, positions, strict=True) if key not in self._cache}
        found: dict[ViewKey, ViewTokens] = {}
        if fresh:
            embedded = self._embed(view_set, sorted(fresh.values()))
            for number, position in enumerate(sorted(fresh.values())):
                key = view_key(view_set, position, self.recipe)
                found[key] = self._settled(key, embedded.select([number]))
        result = ViewTokens.join_views([found[key] if key in found else self._kept(key) for key in keys])
        self._count_down(keys)
        return result

    def close(self) -> None:
        """Stop the background thread and drop everything."""
        self._images.close()
        self._cache.close()

    def nbytes(self) -> int:
        """Bytes of the tokens that are kept."""
        return self._cache.nbytes()

    def _keys(self, view_set: ViewSet, positions: Iterable[int]) -> list[ViewKey]:
        return [view_key(view_set, position, self.recipe) for position in positions]

    def _requests(self, planned: Sequence[Access]) -> Iterator[tuple[int, tuple[int, ...]]]:
        """List the images to load: those of every access, or, where tokens are kept, those not seen before."""
        known: set[ViewKey] = set()
        for view_set, positions in planned:
            if self.engine.share_prefix:
                fresh = {view_key(view_set, p, self.recipe): p for p in positions}
                positions = sorted(p for key, p in fresh.items() if key not in known)
                known |= fresh.keys()
            if positions:
                yield view_set.scene, tuple(view_set.frames[p] for p in positions)

    def _embed(self, view_set: ViewSet, positions: Sequence[int]) -> ViewTokens:
        images = self._images.take(view_set.scene, [view_set.frames[p] for p in positions])
        if self.recipe.augmentation == "released":
            images = released_augmentation(images, view_set.seed, positions)
        with self.arithmetic():
            return embed_in_chunks(self.model, images, device=self.engine.device, layers=self.model.spec.loss_layers)

    def _settled(self, key: ViewKey, view: ViewTokens) -> ViewTokens:
        """Keep a view that will be read again, and return it as it will be read then."""
        self._sizes[key[0]] = view.image_hw, view.grid_hw
        tensors = {"tokens": view.tokens, **view.extra}
        if self._uses[key] > 1:
            self._cache.put(key, tensors)
        return self._view(key, self._cache.rounded(tensors))

    def _kept(self, key: ViewKey) -> ViewTokens:
        return self._view(key, self._cache.get(key))

    def _view(self, key: ViewKey, tensors: dict[str, Tensor]) -> ViewTokens:
        image_hw, grid_hw = self._sizes[key[0]]
        return ViewTokens(tokens=tensors.pop("tokens"), extra=tensors, image_hw=image_hw, grid_hw=grid_hw)

    def _count_down(self, keys: Iterable[ViewKey]) -> None:
        for key in set(keys):
            self._uses[key] -= 1
            if self._uses[key] <= 0:
                self._cache.drop(key)
