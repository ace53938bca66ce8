"""What every model here does with images: one size for all, the mapping back to the photos, patches, normalisation."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Literal, TypeVar, get_args

import numpy as np
import torch
from torch import Tensor

from freegeo.data.image_files import is_blank
from freegeo.errors import UserError
from freegeo.geometry.resample import resize_area, resize_cubic
from freegeo.models.spec import MIXED, Mixed, ModelSpec
from freegeo.types import ImageBatch, PhotoLike, ViewTokens

if TYPE_CHECKING:
    from freegeo.models.api import ReconstructionModel

logger = logging.getLogger(__name__)

Size = tuple[int, int]
"""Height and width."""
Plan = TypeVar("Plan")
_AT_A_TIME = 16
"""Photos that are held in memory while all of many are looked at."""

IMAGE_MEAN = (0.485, 0.456, 0.406)
IMAGE_STD = (0.229, 0.224, 0.225)
WHITE = 255
CUT_WORTH_A_WARNING = 0.1
"""Share of a photo's area that may be cut without a word."""
ONE_SHAPE = 0.02
"""Largest relative difference of aspects that counts as one shape."""
ENLARGED_WORTH_A_WARNING = 2.0
"""Factor up to which photos may be enlarged without a word."""
SIDE_FACTOR = 4
"""Largest factor between the default longest side of a model and one that is asked for."""


def read_photos(
    model: ReconstructionModel, photos: Sequence[PhotoLike], *, mixed: Mixed = MIXED, process_res: int | None = None
) -> ImageBatch:
    """Preprocess photos for a model, and warn where the model sees much less than they show.

    Args:
        model: whose rule it is.
        photos: the photos.
        mixed: how photos of different shapes get one size.
        process_res: longest side that is asked for; None: the model's default.

    Raises:
        UserError: an unknown rule `mixed`, a `process_res` that the model cannot read, or a photo that cannot be used.
    """
    process_res = chosen_side(model.spec, process_res)
    if mixed not in get_args(Mixed):
        raise UserError(f"mixed is one of {', '.join(get_args(Mixed))}, not {mixed!r}.")
    batch = _preprocessed(model, photos, mixed, process_res)
    _warn(batch, mixed, model.spec)
    return batch


def look_at_photos(
    model: ReconstructionModel, photos: Sequence[PhotoLike], *, mixed: Mixed = MIXED, process_res: int | None = None
) -> Frames:
    """Read each of many photos once, a few at a time, and warn as `read_photos`; their pixels are read again later.

    Arguments and errors as `read_photos`.
    """
    process_res = chosen_side(model.spec, process_res)
    if mixed not in get_args(Mixed):
        raise UserError(f"mixed is one of {', '.join(get_args(Mixed))}, not {mixed!r}.")
    contents, looks, blank = hashlib.sha256(), [], []
    for start in range(0, len(photos), _AT_A_TIME):
        batch = read_some(model, photos, range(start, min(start + _AT_A_TIME, len(photos))), mixed, process_res)
        contents.update(batch.digest().encode())
        pixels = (batch.images * 255).byte().permute(0, 2, 3, 1).numpy()
        blank += [
            start + row
            for row, image in enumerate(pixels)
            # Where a photo is padded, its image is not blank.
            if is_blank(image) or getattr(photos[start + row], "blank", False)
        ]
        looks.append(replace(batch, images=batch.images[:, :, :0, :0]))
        shape = batch.images.shape[1:]
    geometry = {name: torch.cat([getattr(b, name) for b in looks]) for name in ("photo_hw", "scale_xy", "offset_xy")}
    frames = Frames(
        images=torch.zeros(()).expand(len(photos), *shape), names=tuple(photo.name for photo in photos), **geometry,
        contents=contents.hexdigest(), photos=tuple(photos), chosen=tuple(range(len(photos))),
        blank=frozenset(blank), model=model, mixed=mixed, process_res=process_res,
    )  # fmt: skip
    _warn(frames, mixed, model.spec)
    return frames


def chosen_side(spec: ModelSpec, process_res: int | None) -> int | None:
    """Return the longest side that a model is asked for, None where it is its default.

    UserError for a side that the model cannot read.
    """
    if process_res is None or process_res == spec.default_side:
        return None
    if spec.sides is None:
        raise UserError(f"{spec.name} reads photos at {spec.default_side} pixels only. Leave --process-res out.")
    least, most = spec.default_side // SIDE_FACTOR, spec.default_side * SIDE_FACTOR
    if not least <= process_res <= most:
        raise UserError(
            f"--process-res {process_res}: {spec.name} reads photos with a longest side of {least} to {most} pixels, "
            f"rounded to patches of {spec.patch_size}; its default is {spec.default_side}."
        )
    return process_res


@dataclass(frozen=True, kw_only=True)
class Frames(ImageBatch):
    """Many photos at the model's size, which are read when they are needed; `images` has their shape and no pixels."""

    contents: str
    """Fingerprint of the pixels of all photos."""
    photos: tuple[PhotoLike, ...]
    """All photos that are read at one size."""
    chosen: tuple[int, ...]
    """Those of the batch, in its order."""
    blank: frozenset[int]
    """Those of all photos that are almost black, white or of one colour."""
    model: ReconstructionModel
    mixed: Mixed

    def shown(self) -> list[int]:
        """Return the views that show something."""
        return [view for view, photo in enumerate(self.chosen) if photo not in self.blank]

    def select(self, views: Sequence[int]) -> Frames:
        """Return the chosen views, in the order given, not read yet."""
        index = list(views)
        return replace(
            self, images=self.images[: len(index)], names=tuple(self.names[i] for i in index),
            photo_hw=self.photo_hw[index], scale_xy=self.scale_xy[index], offset_xy=self.offset_xy[index],
            chosen=tuple(self.chosen[i] for i in index),
        )  # fmt: skip

    def read(self) -> ImageBatch:
        """Read the pixels: each view as it would be beside all photos."""
        return read_some(self.model, self.photos, self.chosen, self.mixed, self.process_res)

    def digest(self) -> str:
        """Return a fingerprint of the pixels."""
        return hashlib.sha256(f"{self.contents} {self.chosen}".encode()).hexdigest()[:16]


@dataclass(frozen=True, kw_only=True)
class SizeOnly:
    """A photo that has a say in the size of the images beside it, and is not among them."""

    name: str
    size_hw: Size

    def read(self) -> np.ndarray:
        """Return white, for models of others that read every photo."""
        return np.full((*self.size_hw, 3), WHITE, np.uint8)


def read_some(
    model: ReconstructionModel,
    photos: Sequence[PhotoLike],
    chosen: Sequence[int],
    mixed: Mixed,
    process_res: int | None = None,
) -> ImageBatch:
    """Preprocess the chosen ones of photos to the size that all of them have together."""
    if len({photo.size_hw for photo in photos}) == 1:
        return _preprocessed(model, [photos[number] for number in chosen], mixed, process_res)
    # In the order of all photos, since the first one may decide.
    wanted = sorted(set(chosen))
    every = [
        photo if number in wanted else SizeOnly(name=photo.name, size_hw=photo.size_hw)
        for number, photo in enumerate(photos)
    ]
    batch = _preprocessed(model, every, mixed, process_res)
    is_whole = len(batch) == len(photos)
    return batch.select([number if is_whole else wanted.index(number) for number in chosen])


def _preprocessed(
    model: ReconstructionModel, photos: Sequence[PhotoLike], mixed: Mixed, process_res: int | None
) -> ImageBatch:
    # A plug-in that has one size only need not know of others.
    if process_res is None:
        return model.preprocess(photos, mixed=mixed)
    return replace(model.preprocess(photos, mixed=mixed, process_res=process_res), process_res=process_res)


def _warn(batch: ImageBatch, mixed: Mixed, spec: ModelSpec) -> None:
    if batch.process_res is not None and batch.process_res % spec.patch_size:
        logger.info(
            "--process-res %d is rounded to patches of %d: images are %d x %d.",
            batch.process_res, spec.patch_size, *batch.image_hw[::-1],
        )  # fmt: skip
    for sentence in (_side_sentence(batch, spec), _cut_sentence(batch, mixed), _enlarged_sentence(batch)):
        if sentence:
            logger.warning(sentence)


def _side_sentence(batch: ImageBatch, spec: ModelSpec) -> str | None:
    """Say that a size is far from what the model is used to."""
    if batch.process_res is None or spec.sides is None or spec.sides[0] <= batch.process_res <= spec.sides[1]:
        return None
    return (
        f"{spec.name} reads photos at {spec.default_side} pixels by default, and {batch.process_res} is far from that: "
        f"compare with a result of --process-res {spec.sides[0]} to {spec.sides[1]} before you trust this one."
    )


def _cut_sentence(batch: ImageBatch, mixed: Mixed) -> str | None:
    """Say which photos are cut, by how much, and, where one photo causes it, by which."""
    cut = 1 - batch.seen_share()
    count = int((cut > CUT_WORTH_A_WARNING).sum())
    if not count:
        return None
    worst, most = _described(batch, int(cut.argmax())), f"{100 * float(cut.max()):.0f} %"
    size = f"{batch.image_hw[1]} x {batch.image_hw[0]}"
    aspect = (batch.photo_hw[:, 1] / batch.photo_hw[:, 0]).log()
    oddness = (aspect - aspect.median()).abs()
    if oddness.max() < ONE_SHAPE:
        return f"the model reads the middle of the photos only, at {size}: {most} of each is cut."
    if mixed == "upstream":
        odd = _described(batch, int(oddness.argmax()))
        return f"{odd} makes all photos {size}: up to {most} of each is cut; take it out, or use --mixed crop or pad."
    instead = "" if mixed == "pad" else ", or use --mixed pad"
    if count == 1:
        return f"{worst} has another shape than the rest: {most} of it is cut; take it out{instead}."
    if 2 * count <= len(batch):
        return (
            f"{count} of {len(batch)} photos have another shape than the rest: up to {most} of each is cut, most of "
            f"{worst}; take them out{instead}."
        )
    return (
        f"the photos have different shapes and are all read at {size}: up to {most} of each is cut, most of {worst}; "
        f"sort them by shape{instead}."
    )


def _enlarged_sentence(batch: ImageBatch) -> str | None:
    """Say which photos are much smaller than what the model reads."""
    factor = batch.scale_xy.amax(-1)
    views = (factor > ENLARGED_WORTH_A_WARNING).nonzero()[:, 0].tolist()
    if not views:
        return None
    least = _described(batch, int(factor.argmax()))
    which = least if len(views) == 1 else f"{len(views)} of {len(batch)} photos (the smallest is {least})"
    return (
        f"{which} must be enlarged up to {float(factor.max()):.1f} times for the model, which adds no detail; use the "
        f"originals if these are previews{'' if batch.process_res is None else ', or a smaller --process-res'}."
    )


def _described(batch: ImageBatch, view: int) -> str:
    height, width = batch.photo_hw[view].tolist()
    return f"{batch.names[view]} ({width} x {height})"


def normalise(images: Tensor) -> Tensor:
    """Subtract ImageNet's mean and divide by its deviation; (..., 3, H, W) in [0, 1]."""
    mean, std = _statistics(images.dtype, images.device)
    return (images - mean) / std


@lru_cache(maxsize=8)
def _statistics(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return mean and deviation, (3, 1, 1) each; copying them to a GPU at every call would wait for it."""
    with torch.inference_mode(False):
        mean, std = (torch.tensor(values, dtype=dtype, device=device) for values in (IMAGE_MEAN, IMAGE_STD))
        return mean[:, None, None], std[:, None, None]


def patch_grid(images: Tensor, patch: int) -> Size:
    """Return rows and columns of patches of images (..., H, W); ValueError when a side is no multiple of the patch."""
    height, width = images.shape[-2:]
    if height % patch or width % patch:
        raise ValueError(f"image sides must be multiples of {patch}, got {height} x {width}")
    return height // patch, width // patch


def encoded(images: Tensor, patch: int, encoder: Callable[[Tensor, Size], Tensor]) -> ViewTokens:
    """Return the tokens that an encoder (V, 3, H, W), grid -> (V, N, C) makes of each of images (B, S, 3, H, W)."""
    grid_hw = patch_grid(images, patch)
    tokens = encoder(normalise(images).flatten(0, 1), grid_hw)
    return ViewTokens(
        tokens=tokens.unflatten(0, images.shape[:2]), image_hw=(images.shape[-2], images.shape[-1]), grid_hw=grid_hw
    )


def require_a_patch(photo: Size, patch: int) -> None:
    """Raise UserError for a photo that has fewer pixels on a side than one patch."""
    if min(photo) < patch:
        raise UserError(
            f"a photo of {photo[1]} x {photo[0]} pixels is too small or too narrow: the model reads patches of "
            f"{patch} x {patch} pixels. Use a larger photo or crop it to a less extreme aspect."
        )


def planned(photos: Sequence[PhotoLike], plan: Callable[[Size], Plan]) -> list[Plan]:
    """Return the plan of each photo, made from its size; the UserError of one that cannot be used names it."""
    found = []
    for photo in photos:
        try:
            found.append(plan(photo.size_hw))
        except UserError as error:
            raise UserError(f"{photo.name}: {error}") from None
    return found


def images_of_one_size(
    photos: Sequence[PhotoLike],
    sizes: Sequence[Size],
    resize: Callable[[Tensor, int], Tensor],
    *,
    mixed: Mixed,
    upstream: Literal["smallest", "largest"],
) -> ImageBatch:
    """Read photos, resize them, and cut or pad them, with the photo in the middle, to one size.

    Args:
        photos: what is read, but for those that are `SizeOnly`.
        sizes: what the model makes of each photo alone: whole patches.
        resize: resizes photo number i (H, W, 3) uint8 to `sizes[i]`.
        mixed: how one size comes about.
        upstream: what the authors' rule takes of the heights and of the widths.
    """
    smallest, largest = ((choose(h for h, _ in sizes), choose(w for _, w in sizes)) for choose in (min, max))
    targets = list(sizes)
    if mixed == "crop":
        common = common_size([photo.size_hw for photo in photos], [*sizes, smallest])
        targets = [
            own if own == common else _covering(photo.size_hw, common) for photo, own in zip(photos, sizes, strict=True)
        ]
    else:
        common = largest if mixed == "pad" or upstream == "largest" else smallest
    images, offsets = [], []
    shown = [number for number, photo in enumerate(photos) if not isinstance(photo, SizeOnly)]
    for number in shown:
        photo, own, target = photos[number], sizes[number], targets[number]
        pixels = torch.from_numpy(photo.read())
        pixels = resize(pixels, number) if target == own else _resized(pixels, target)
        top, left = (_offset(common[axis] - target[axis]) for axis in (0, 1))
        images.append(_placed(pixels, common, top, left).permute(2, 0, 1))
        offsets.append([float(left), float(top)])
    heights, widths = torch.tensor([targets[number] for number in shown]).unbind(-1)
    photo_hw = torch.tensor([photos[number].size_hw for number in shown])
    return ImageBatch(
        images=torch.stack(images).float() / 255,
        names=tuple(photos[number].name for number in shown),
        photo_hw=photo_hw,
        scale_xy=torch.stack((widths, heights), dim=-1).double() / photo_hw.flip(-1),
        offset_xy=torch.tensor(offsets, dtype=torch.float64),
    )


def common_size(photos: Sequence[Size], sizes: Sequence[Size]) -> Size:
    """Return the one of `sizes` to which photos are best cut, the first one of equals.

    Of a photo of another aspect so much is cut as the ratio of the aspects lacks to 1. The sum of the squares decides:
    it fits one odd photo to the others, and lets as many portraits as landscapes meet in a square.
    """

    def lost(size: Size) -> float:
        ratios = [photo[1] * size[0] / (photo[0] * size[1]) for photo in photos]
        return sum((1 - min(ratio, 1 / ratio)) ** 2 for ratio in ratios)

    return min(dict.fromkeys(sizes), key=lost)


def _covering(photo: Size, common: Size) -> Size:
    """Return the smallest size of a photo that covers the common size."""
    scale = max(side / own for side, own in zip(common, photo, strict=True))
    height, width = (max(side, round(own * scale)) for side, own in zip(common, photo, strict=True))
    return height, width


def _resized(pixels_HW3: Tensor, size: Size) -> Tensor:
    shrinks = all(new <= old for new, old in zip(size, pixels_HW3.shape[:2], strict=True))
    return resize_area(pixels_HW3, size) if shrinks else resize_cubic(pixels_HW3, size)


def _offset(room: int) -> int:
    """Return where a photo begins that has `room` around it; negative where it is larger than the image.

    The odd row or column of a border is at its end, and so is the one that is cut.
    """
    return room // 2 if room >= 0 else -(-room // 2)


def _placed(pixels_HW3: Tensor, size: Size, top: int, left: int) -> Tensor:
    """Put pixels on a white area, cutting what lies outside it."""
    cut = pixels_HW3[max(-top, 0) :, max(-left, 0) :][: size[0], : size[1]]
    top, left = max(top, 0), max(left, 0)
    area = cut.new_full((*size, 3), WHITE)
    area[top : top + cut.shape[0], left : left + cut.shape[1]] = cut
    return area
