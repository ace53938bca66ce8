"""The images of a run, decoded once, ahead of need, in the background."""

from __future__ import annotations

import random
from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from freegeo.adaptation.recipe import Recipe
from freegeo.errors import UserError
from freegeo.models.api import ReconstructionModel
from freegeo.types import ImageBatch, PhotoLike


@dataclass(frozen=True, kw_only=True)
class SceneImages:
    """The images of one scene; `load` returns the chosen ones as (S, 3, H, W) in [0, 1], all of one size.

    `load` is called from a background thread, one call at a time.
    """

    name: str
    count: int
    load: Callable[[Sequence[int]], Tensor]
    in_memory: bool = False
    """Whether `load` only looks images up, so that nothing is won by keeping what it returned."""

    @classmethod
    def from_batch(cls, name: str, batch: ImageBatch) -> SceneImages:
        """Use images that are already at the model's size."""
        return cls(name=name, count=len(batch), load=lambda frames: batch.images[list(frames)], in_memory=True)

    @classmethod
    def from_photos(
        cls, name: str, photos: Sequence[PhotoLike], model: ReconstructionModel, recipe: Recipe
    ) -> SceneImages:
        """Decode photos on demand, as the model reads them or squashed as the recipe asks.

        UserError when the recipe's square is no whole number of the model's patches.
        """
        if recipe.squash is not None and recipe.squash % model.spec.patch_size:
            raise UserError(
                f"recipe '{recipe.name}' squashes images to {recipe.squash} pixels; {model.spec.name} cannot read them "
                f"(patches of {model.spec.patch_size}). Choose another recipe."
            )

        def load(frames: Sequence[int]) -> Tensor:
            chosen = [photos[frame] for frame in frames]
            if recipe.squash is None:
                return model.preprocess(chosen).images
            return torch.cat([squashed(torch.from_numpy(photo.read()), recipe.squash) for photo in chosen])

        return cls(name=name, count=len(photos), load=load)


def squashed(pixels_HW3: Tensor, side: int) -> Tensor:
    """Resize a photo bilinearly to a square (1, 3, side, side) in [0, 1], whatever its aspect."""
    image = pixels_HW3.permute(2, 0, 1)[None].float() / 255
    return F.interpolate(image, size=(side, side), mode="bilinear", align_corners=False)


def released_augmentation(images: Tensor, seed: int, positions: Sequence[int] | None = None) -> Tensor:
    """Mirror a whole view set and change the brightness of some views, as a fixed function of the set's seed.

    Method's fact sheet, section 3.3: one draw decides the mirror (p = .5); then per view a draw decides (p = .5) and a
    second one gives the factor in [.8, 1.2]; results are clipped to [0, 1]. `positions`: where in the set the given
    images are; None: they are the whole set.
    """
    positions = range(len(images)) if positions is None else positions
    generator = random.Random(seed)
    if generator.random() < 0.5:
        images = images.flip(-1)
    drawn = range(max(positions) + 1)
    factors = [generator.uniform(0.8, 1.2) if generator.random() < 0.5 else 1.0 for _ in drawn]
    return (images * images.new_tensor([factors[p] for p in positions])[:, None, None, None]).clamp(0, 1)


Request = tuple[int, tuple[int, ...]]
"""Scene and frames."""


class ImageQueue:
    """Loads the images of known requests in their order, some requests ahead, in one background thread.

    A decoded frame stays in memory while a later request names it, so that every frame is decoded once.
    """

    def __init__(self, scenes: Sequence[SceneImages], requests: Sequence[Request], *, ahead: int):
        self.scenes = scenes
        self._ahead = ahead
        self._coming = deque(requests)
        self._uses = Counter((scene, frame) for scene, frames in requests for frame in frames)
        self._decoded: dict[tuple[int, int], Tensor] = {}
        self._running: deque[tuple[Request, Future[Tensor]]] = deque()
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="freegeo-images")

    def take(self, scene: int, frames: Sequence[int]) -> Tensor:
        """Return images (S, 3, H, W); waits only where decoding is not ahead. Raises what loading raised."""
        wanted = (scene, tuple(frames))
        if not self._running:
            self._start()
        if self._running and self._running[0][0] == wanted:
            image = self._running.popleft()[1]
        else:
            image = self._thread.submit(self._load, wanted)
        self._start()
        return image.result()

    def close(self) -> None:
        """Stop decoding."""
        self._thread.shutdown(cancel_futures=True)
        self._decoded.clear()

    def _start(self) -> None:
        while self._coming and len(self._running) < max(self._ahead, 1):
            request = self._coming.popleft()
            self._running.append((request, self._thread.submit(self._load, request)))

    def _load(self, request: Request) -> Tensor:
        number, frames = request
        scene = self.scenes[number]
        if scene.in_memory:
            return scene.load(frames)
        missing = [frame for frame in dict.fromkeys(frames) if (number, frame) not in self._decoded]
        found = dict(zip(missing, scene.load(missing), strict=True)) if missing else {}
        images = torch.stack([found[f] if f in found else self._decoded[number, f] for f in frames])
        self._uses.subtract((number, frame) for frame in frames)
        for frame in set(frames):
            if self._uses[number, frame] <= 0:
                self._decoded.pop((number, frame), None)
            elif frame in found:
                self._decoded[number, frame] = found[frame].clone()
        return images
