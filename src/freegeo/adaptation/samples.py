"""What a step needs of a view set, made once with the frozen model: the left column of Algorithm 1, computed ahead.

The teacher never changes, and neither does anything below the first cross-view layer. So images are embedded once, the
teacher runs once per view set, and every later visit of the set costs the student's pass only (docs/method.md, "Roles
and view sets").
"""

from __future__ import annotations

import random
import shutil
import tempfile
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional as F

from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.losses import (
    CameraTargets,
    KLForm,
    StepDraws,
    choose_form,
    draw_tokens,
    held_out_tokens,
    teacher_spread,
)
from freegeo.adaptation.recipe import LossConfig, Recipe
from freegeo.adaptation.views import ViewSet, Visit, Windows
from freegeo.errors import UserError
from freegeo.files import scratch_folder
from freegeo.models.api import ReconstructionModel, embed_in_chunks
from freegeo.models.images import read_some
from freegeo.models.precision import Compute
from freegeo.models.priors import usable_by_both
from freegeo.types import Features, ImageBatch, PhotoLike, Priors, ViewTokens

Place = Literal["device", "disk"]
"""Where samples are kept between visits: on the model's device, or in memory-mapped files."""
STEP_SEED_STRIDE = 1_000_003
"""Distance of the seeds of two runs; between them lie the seeds of a run's steps."""
SPREAD_HEADROOM = 2.0
"""Factor by which the student's spread of softmax inputs may exceed the teacher's, measured once per view set."""
SEEN_SHARE = 0.5
"""Share of a patch that must lie in the photo for its token to take part in the losses; the rest is padding."""
MIRRORED = 0.5
"""Probability that the released augmentation mirrors a view set: the first draw of its seed."""
AHEAD = 2
"""View sets whose images are decoded in the background before they are needed."""


@dataclass(frozen=True, kw_only=True)
class SceneImages:
    """The images of one scene; `load` returns the chosen ones as (S, 3, H, W) in [0, 1], all of one size.

    `load` is called once for the first image, to plan memory, then from a background thread, one call at a time.
    """

    name: str
    count: int
    load: Callable[[Sequence[int]], Tensor]
    inside: Tensor | None = None
    """(count, H, W) bool: false where an image is padding; None: no image has any."""
    targets: CameraTargets | None = None
    """Cameras of the images to learn from; needed by a recipe with the weight `cameras`."""
    priors: Priors | None = None
    """What teacher and student are told of the images: of each view set, what the model can take (`usable_by_both`)."""
    windows: Windows | None = None
    """Groups of images that show one part of a long sequence: each view set is drawn from one of them; None: from all
    images (`views.chunk_windows`)."""
    process_res: int | None = None
    """Longest side of the images that was asked for; None: the model's default, or a square of the recipe."""

    @classmethod
    def from_batch(cls, name: str, batch: ImageBatch) -> SceneImages:
        """Use images that are already at the model's size."""
        inside = batch.inside()
        return cls(
            name=name, count=len(batch), load=lambda frames: batch.select(frames).read().images,
            inside=None if inside.all() else inside, process_res=batch.process_res,
        )  # fmt: skip

    @classmethod
    def from_photos(
        cls,
        name: str,
        photos: Sequence[PhotoLike],
        model: ReconstructionModel,
        recipe: Recipe,
        process_res: int | None = None,
    ) -> SceneImages:
        """Decode photos on demand, preprocessed by upstream's rule or squashed as the recipe says.

        As upstream, the losses compare the padding that the preprocessing may add. `process_res` is the longest side of
        images that are not squashed; None: the model's default.

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
                return read_some(model, chosen, range(len(chosen)), "upstream", process_res).images
            return torch.cat([squashed(torch.from_numpy(photo.read()), recipe.squash) for photo in chosen])

        return cls(
            name=name, count=len(photos), load=load, process_res=None if recipe.squash is not None else process_res
        )


def squashed(pixels_HW3: Tensor, side: int) -> Tensor:
    """Resize a photo bilinearly to a square (1, 3, side, side) in [0, 1], whatever its aspect."""
    image = pixels_HW3.permute(2, 0, 1)[None].float() / 255
    return F.interpolate(image, size=(side, side), mode="bilinear", align_corners=False)


def released_augmentation(images: Tensor, seed: int) -> Tensor:
    """Mirror a whole view set and change the brightness of some views, as a fixed function of the set's seed.

    One draw decides the mirror (p = .5); then per view a draw decides (p = .5) and a second one gives the factor in
    [.8, 1.2]; results are clipped to [0, 1] (docs/method.md, "Augmentation and view draws").
    """
    generator = random.Random(seed)
    if generator.random() < MIRRORED:
        images = images.flip(-1)
    factors = [generator.uniform(0.8, 1.2) if generator.random() < 0.5 else 1.0 for _ in images]
    return (images * images.new_tensor(factors)[:, None, None, None]).clamp(0, 1)


def seen_patches(scene: SceneImages, view_set: ViewSet, grid_hw: tuple[int, int], recipe: Recipe) -> Tensor | None:
    """Mask (N, P) bool of the patches of a view set of which at least half shows a photo; None: there is no padding."""
    inside = None if scene.inside is None else scene.inside[list(view_set.frames)]
    if inside is None or inside.all():
        return None
    if recipe.augmentation == "released" and random.Random(view_set.seed).random() < MIRRORED:
        inside = inside.flip(-1)
    patch = (inside.shape[1] // grid_hw[0], inside.shape[2] // grid_hw[1])
    return (F.avg_pool2d(inside[:, None].float(), patch) >= SEEN_SHARE).flatten(1)


@dataclass(frozen=True, kw_only=True)
class Sample:
    """Everything a visit reads of its view set; tensors have a batch of 1 and no gradient."""

    tokens: ViewTokens
    """The embedded views: the student's, or all N where the recipe has a term of all views."""
    teacher: Features
    """The teacher's features of the same views at the loss layers."""
    held_out: Tensor
    """(1, L, C): the teacher's tokens of the held-out views at the last loss layer, one view after another."""
    kept: tuple[int, ...]
    """Positions of the student's views among `tokens`."""
    form: KLForm | None = None
    """How the all-pairs KL is computed; None: the loss measures it, which makes an accelerator wait."""
    patches: Tensor | None = None
    """(views of `tokens`, P) bool, on the CPU: patches that take part in the losses; None: all."""
    targets: CameraTargets | None = None
    """Cameras of the views of `tokens`; None where the recipe has no camera term."""
    priors: Priors | None = None
    """What is known of the views of `tokens`; None: nothing. They stay on the CPU."""

    def student(self) -> Sample:
        """Return the sample of the student's views alone."""
        return self if len(self.kept) == self.tokens.tokens.shape[1] else self.select(self.kept)

    def select(self, views: Sequence[int]) -> Sample:
        """Return the sample of some of its views, the student's among them."""
        return replace(
            self,
            tokens=self.tokens.select(views),
            teacher=self.teacher.select(views),
            kept=tuple(views.index(view) for view in self.kept),
            patches=None if self.patches is None else self.patches[list(views)],
            targets=None if self.targets is None else self.targets.select(views),
            priors=None if self.priors is None else self.priors.select(views),
        )

    def map(self, change: Callable[[Tensor], Tensor]) -> Sample:
        """Apply `change` to every tensor that is worth moving: tokens and features."""
        return replace(
            self, tokens=self.tokens.map(change), teacher=self.teacher.map(change), held_out=change(self.held_out)
        )

    def to(self, device: torch.device) -> Sample:
        """Return the sample on a device."""
        targets = None if self.targets is None else self.targets.to(device)
        return replace(self.map(lambda tensor: tensor.to(device)), targets=targets)


class Samples:
    """The samples of a run: each made at its view set's first visit and kept until its last."""

    def __init__(
        self,
        adapter: Adapter,
        scenes: Sequence[SceneImages],
        recipe: Recipe,
        steps: Sequence[Sequence[Visit]],
        *,
        compute: Compute,
        place: Place,
        folder: Path | None,
        seed: int,
    ):
        """`steps` are those still to come. `folder` (None: the system's temporary one) holds the files of `disk`."""
        self._adapter, self._recipe, self._compute, self._seed = adapter, recipe, compute, seed
        self._scenes = scenes
        view_sets = [visit.view_set for visits in steps for visit in visits]
        self._left = Counter(sample_key(view_set, recipe) for view_set in view_sets)
        self._kept: dict[SampleKey, Sample] = {}
        self._folder, self._files = None, 0
        if place == "disk":
            home = tempfile.mkdtemp(prefix="freegeo-samples-") if folder is None else scratch_folder(folder, "samples")
            self._folder = Path(home)
        self._tokens = self._embedded(distinct(view_sets, recipe))

    def take(self, visit: Visit) -> Sample:
        """Return the sample of a visit, on the device; visits come in the order of `steps`."""
        key = sample_key(visit.view_set, self._recipe)
        self._left[key] -= 1
        sample = self._kept.pop(key, None)
        if sample is None:
            sample = self._make(visit)
            if self._left[key] and self._folder is not None:
                sample = sample.map(self._in_file)
        if self._left[key]:
            self._kept[key] = sample
        return sample.to(self._compute.device)

    def close(self) -> None:
        """Stop decoding, drop everything and remove the files."""
        self._tokens.close()
        self._kept.clear()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    @torch.no_grad()
    def _make(self, visit: Visit) -> Sample:
        """Run the teacher on the views of a set."""
        view_set, config, model = visit.view_set, self._recipe.loss, self._adapter.model
        scene, tokens = self._scenes[view_set.scene], next(self._tokens)
        priors, targets = scene.priors, scene.targets if self._recipe.cameras else None
        if priors is not None:
            priors = usable_by_both(priors.select(view_set.frames), view_set.kept, model.spec)
        with self._adapter.off(), self._compute.autocast():
            features = loss_features(model, tokens, priors)
        patches = seen_patches(scene, view_set, tokens.grid_hw, self._recipe)
        whole = Sample(
            tokens=tokens,
            teacher=replace(features, extra={}),  # without what only the decoder reads
            held_out=held_out_tokens(features.levels[max(features.levels)], view_set.kept, config, patches=patches),
            kept=view_set.kept,
            patches=patches,
            targets=None if targets is None else targets.select(view_set.frames),
            priors=priors,
        )
        # The selection is a copy, also of all views: it keeps nothing of the network's alive.
        sample = whole.select(range(len(view_set.frames)) if self._recipe.sees_all else view_set.kept)
        measured = self._recipe.features and config.uses_distances and config.pairing == "all"
        if self._compute.device.type == "cpu" or not measured:
            return sample
        # Read once per view set instead of in every step, where an accelerator would have to wait for it.
        student = sample.student()
        draws, levels = step_draws(student, visit.step, config, seed=self._seed), student.teacher.levels
        spread = teacher_spread(levels[max(levels)], sample.held_out, draws, config)
        return replace(sample, form=choose_form(float(spread), headroom=SPREAD_HEADROOM))

    def _embedded(self, view_sets: Sequence[ViewSet]) -> Generator[ViewTokens]:
        """Yield the tokens (1, N, ...) of view sets in order; an image that several sets use is embedded once."""
        fresh, left = [], Counter[ViewKey]()
        for view_set in view_sets:
            keys = view_keys(view_set, self._recipe)
            fresh.append([position for position, key in enumerate(keys) if key not in left])
            left.update(keys)
        requests = [(s.scene, [s.frames[p] for p in positions]) for s, positions in zip(view_sets, fresh, strict=True)]
        device, layers = self._compute.device, self._adapter.model.spec.loss_layers
        waiting: dict[ViewKey, ViewTokens] = {}
        with closing(loaded_ahead(self._scenes, [request for request in requests if request[1]])) as images:
            for view_set, positions in zip(view_sets, fresh, strict=True):
                keys = view_keys(view_set, self._recipe)
                if positions:
                    pixels = next(images)
                    if self._recipe.augmentation == "released":
                        pixels = released_augmentation(pixels, view_set.seed)
                    with self._compute.autocast():
                        embedded = embed_in_chunks(self._adapter.model, pixels, device=device, layers=layers)
                    home = "cpu" if self._folder else device
                    waiting |= {keys[p]: embedded.select([n]).to(home) for n, p in enumerate(positions)}
                tokens = ViewTokens.join_views([waiting[key] for key in keys]).to(device)
                left.subtract(keys)
                waiting = {key: view for key, view in waiting.items() if left[key]}
                yield tokens

    def _in_file(self, tensor: Tensor) -> Tensor:
        """Write a tensor to a file of its own and return it memory-mapped: it is read when it is used."""
        from safetensors import safe_open
        from safetensors.torch import save_file

        assert self._folder is not None
        path = self._folder / f"{self._files}.safetensors"
        self._files += 1
        save_file({"": tensor.cpu().contiguous()}, path)
        with safe_open(path, framework="pt") as file:
            return file.get_tensor("")


ViewKey = tuple[int, ...]
SampleKey = tuple[tuple[ViewKey, ...], tuple[int, ...]]


def view_keys(view_set: ViewSet, recipe: Recipe) -> list[ViewKey]:
    """Return what each view's pixels depend on: scene and frame; if augmented, also the set and the position in it."""
    if recipe.augmentation == "none":
        return [(view_set.scene, frame) for frame in view_set.frames]
    return [(view_set.scene, frame, view_set.seed, position) for position, frame in enumerate(view_set.frames)]


def sample_key(view_set: ViewSet, recipe: Recipe) -> SampleKey:
    """Return what a sample depends on: view sets of equal key share it."""
    return tuple(view_keys(view_set, recipe)), view_set.kept


def distinct(view_sets: Iterable[ViewSet], recipe: Recipe) -> list[ViewSet]:
    """Return one view set of every key, in the order of first visits."""
    found: dict[SampleKey, ViewSet] = {}
    for view_set in view_sets:
        found.setdefault(sample_key(view_set, recipe), view_set)
    return list(found.values())


def loss_features(model: ReconstructionModel, tokens: ViewTokens, priors: Priors | None = None) -> Features:
    """Return what a loss compares: the features at the loss layers, the first view being the reference."""
    return model.aggregate(tokens, layers=model.spec.loss_layers, reference="first", priors=priors)


def step_seed(seed: int, step: int) -> int:
    """Return the seed of a step of a run, within the 64 bits that a generator takes."""
    return (seed * STEP_SEED_STRIDE + step) % 2**64


def step_draws(student: Sample, step: int, config: LossConfig, *, seed: int) -> StepDraws:
    """Draw the tokens of a step from a sample of the student's views; the random numbers depend on seed and step."""
    patch, special = student.teacher.levels[max(student.teacher.levels)]
    return draw_tokens(
        config,
        tokens_per_view=patch.shape[2] + (special.shape[2] if config.cross_tokens == "all" else 0),
        student_views=len(student.kept),
        held_out=student.held_out.shape[1],
        generator=torch.Generator().manual_seed(step_seed(seed, step)),
        patches=student.patches,
        device=patch.device,
    )


def loaded_ahead(scenes: Sequence[SceneImages], requests: Iterable[tuple[int, Sequence[int]]]) -> Generator[Tensor]:
    """Yield images (S, 3, H, W) for requests (scene, frames) in order; a background thread loads the next ones.

    Raises what loading raised. Closing the generator stops the thread.
    """
    waiting, running = deque(requests), deque[Future[Tensor]]()
    thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="freegeo-images")
    try:
        while waiting or running:
            while waiting and len(running) < AHEAD:
                scene, frames = waiting.popleft()
                running.append(thread.submit(scenes[scene].load, frames))
            yield running.popleft().result()
    finally:
        thread.shutdown(cancel_futures=True)
