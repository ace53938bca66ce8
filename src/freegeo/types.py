"""The values that packages hand to each other: image batches, view tokens, features, predictions.

Letters: B batch, S views, H W pixels, P patches, N tokens, T special tokens, C channels.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Literal, Protocol, Self

import numpy as np
import torch
from torch import Tensor


class PhotoLike(Protocol):
    """The interface of a photo for models and scenes; `freegeo.data.photos.Photo` implements it."""

    @property
    def name(self) -> str:
        """Short name, unique within the scene."""
        ...

    @property
    def size_hw(self) -> tuple[int, int]:
        """Height and width of the upright photo."""
        ...

    def read(self) -> np.ndarray:
        """Decode to upright RGB (H, W, 3) uint8."""
        ...


@dataclass(frozen=True, kw_only=True)
class ImageBatch:
    """Photos at the size a model reads them, with the mapping to the photos' own pixels.

    A photo pixel `u` appears in the model image at `u * scale + offset` (per axis, x first); principal points
    move by the same rule (docs/conventions.md, "From model pixels to the photo").
    """

    images: Tensor
    """(S, 3, H, W), RGB in [0, 1]."""
    names: tuple[str, ...]
    photo_hw: Tensor
    """(S, 2) int64: height and width of each photo after EXIF rotation."""
    scale_xy: Tensor
    """(S, 2) float64."""
    offset_xy: Tensor
    """(S, 2) float64: negative where the photo is cropped, positive where it is padded."""
    process_res: int | None = None
    """Longest side that was asked for; None: the model's default."""

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.names)

    @property
    def image_hw(self) -> tuple[int, int]:
        """Height and width of the images."""
        return self.images.shape[-2], self.images.shape[-1]

    def inside(self) -> Tensor:
        """Mask (S, H, W) bool of the pixels that show the photo; the others are padding."""
        return inside_photo(self.photo_hw, self.scale_xy, self.offset_xy, self.image_hw)

    def seen_share(self) -> Tensor:
        """Share (S,) float64 of each photo's area that its image shows; below 1 where the photo is cropped."""
        photo_xy, image_xy = self.photo_hw.flip(-1), self.photo_hw.new_tensor(self.image_hw[::-1])
        first = (-self.offset_xy / self.scale_xy).clamp(min=0)
        end = torch.minimum((image_xy - self.offset_xy) / self.scale_xy, photo_xy.double())
        return ((end - first).clamp(min=0) / photo_xy).prod(-1)

    def select(self, views: Sequence[int]) -> Self:
        """Return the chosen views, in the order given."""
        index = torch.as_tensor(list(views), dtype=torch.long)
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        tensors = {name: value[index] for name, value in values.items() if isinstance(value, Tensor)}
        return replace(self, names=tuple(self.names[i] for i in views), **tensors)

    def read(self) -> ImageBatch:
        """Return the batch with its pixels; `freegeo.models.images.Frames` reads them here."""
        return self

    def digest(self) -> str:
        """Return a fingerprint of the pixels, which tells photos of the same names apart."""
        return hashlib.sha256(self.images.contiguous().numpy().tobytes()).hexdigest()[:16]

    def model_K(self, K: Tensor) -> Tensor:
        """Turn intrinsics (S, 3, 3) of the original photos into those of the model's images.

        `freegeo.geometry.camera.photo_K` is the inverse.
        """
        rows = K[:, :2] * self.scale_xy.to(K)[:, :, None]
        rows[:, :, 2] += self.offset_xy.to(K)
        return torch.cat([rows, K[:, 2:]], dim=1)


def inside_photo(photo_hw: Tensor, scale_xy: Tensor, offset_xy: Tensor, image_hw: tuple[int, int]) -> Tensor:
    """Mask (S, H, W) bool of the pixels of model images whose centre lies in the photo; arguments as `ImageBatch`."""
    within = []
    for axis, side in enumerate((image_hw[1], image_hw[0])):
        place = (torch.arange(side) + 0.5 - offset_xy[:, axis, None]) / scale_xy[:, axis, None]
        within.append((place >= 0) & (place < photo_hw[:, 1 - axis, None]))
    return within[1][:, :, None] & within[0][:, None, :]


@dataclass(frozen=True, kw_only=True)
class ViewTokens:
    """The output of `embed`, computed for each view by itself: the input of the first cross-view layer.

    `tokens` is the residual stream; `extra` holds what later steps need of earlier layers, each (B, S, ...):
    the class token that reference selection compares (`selection`) and the outputs of layers below the first
    cross-view one (`layer.<i>`).
    """

    tokens: Tensor
    """(B, S, N, C)."""
    image_hw: tuple[int, int]
    grid_hw: tuple[int, int]
    extra: Mapping[str, Tensor] = field(default_factory=dict)

    def select(self, views: Sequence[int]) -> Self:
        """Return the chosen views, in the order given."""
        return self.map(lambda tensor: _views(tensor, views))

    @classmethod
    def join_views(cls, parts: Sequence[ViewTokens]) -> ViewTokens:
        """Concatenate the views of several parts; all parts have the same image size."""
        first = parts[0]
        if any(p.image_hw != first.image_hw for p in parts):
            raise ValueError(f"view tokens of different image sizes cannot be joined: {[p.image_hw for p in parts]}")
        extra = {name: torch.cat([p.extra[name] for p in parts], dim=1) for name in first.extra}
        return replace(first, tokens=torch.cat([p.tokens for p in parts], dim=1), extra=extra)

    def to(self, *args, **kwargs) -> Self:
        """Move or cast all tensors, with the arguments of `Tensor.to`."""
        return self.map(lambda tensor: tensor.to(*args, **kwargs))

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """Apply `change` to every tensor."""
        extra = {name: change(value) for name, value in self.extra.items()}
        return replace(self, tokens=change(self.tokens), extra=extra)


@dataclass(frozen=True, kw_only=True)
class Features:
    """What the decoder reads: per layer the patch tokens and the special tokens of every view, in input order."""

    levels: Mapping[int, tuple[Tensor, Tensor]]
    """layer -> (patch (B, S, P, C), special (B, S, T, C)); special[..., 0, :] is the camera token. A model without one
    returns no special tokens (T = 0) at the layers that losses compare, and names its levels by any integers."""
    image_hw: tuple[int, int]
    grid_hw: tuple[int, int]
    extra: Mapping[str, Tensor] = field(default_factory=dict)
    """What the decoder needs besides, each (B, S, ...)."""

    def select(self, views: Sequence[int]) -> Self:
        """Return the chosen views, in the order given ("8->4" is `select([0, 2, 4, 6])`)."""
        return self.map(lambda tensor: _views(tensor, views))

    def to(self, *args, **kwargs) -> Self:
        """Move or cast all tensors, with the arguments of `Tensor.to`."""
        return self.map(lambda tensor: tensor.to(*args, **kwargs))

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """Apply `change` to every tensor."""
        levels = {k: (change(patch), change(special)) for k, (patch, special) in self.levels.items()}
        return replace(self, levels=levels, extra={k: change(value) for k, value in self.extra.items()})


def _views(tensor: Tensor, views: Sequence[int]) -> Tensor:
    """Return chosen views of a tensor (B, S, ...); without positions on the device, for which an accelerator waits."""
    return torch.stack([tensor[:, view] for view in views], dim=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Priors:
    """What is known of a view set before a model sees it; every part may be missing, for all views or for some.

    Tensors are on the CPU, in the world frame and unit of their source: each model normalises them itself. What a model
    can take is in its `ModelSpec.takes`.
    """

    T_cam_world: Tensor | None = None
    """(B, S, 4, 4); None: no pose is known."""
    K: Tensor | None = None
    """(B, S, 3, 3), pixels of the model's images; None: no intrinsics are known."""
    depth_z: Tensor | None = None
    """(B, S, H, W) at the model's size, 0 where it is not known; None: no depth is known."""
    has_pose: Tensor | None = None
    """(S,) bool: views whose pose is known; None: all, where there are poses."""
    has_K: Tensor | None = None
    """(S,) bool: views whose intrinsics are known; None: all, where there are any."""
    metric: bool = False
    """Whether lengths are metres."""

    def views_with(self, what: Literal["pose", "K"]) -> Tensor:
        """Mask (B, S) bool of the views of which poses or intrinsics are known."""
        batch = next(t.shape[:2] for t in (self.T_cam_world, self.K, self.depth_z) if t is not None)
        value, known = (self.T_cam_world, self.has_pose) if what == "pose" else (self.K, self.has_K)
        if value is None:
            return torch.zeros(batch, dtype=torch.bool)
        return torch.ones(batch, dtype=torch.bool) if known is None else known.expand(batch)

    @property
    def whole_cameras(self) -> bool:
        """Whether poses and intrinsics of all views are known."""
        return _all_known(self.T_cam_world, self.has_pose) and _all_known(self.K, self.has_K)

    def select(self, views: Sequence[int]) -> Self:
        """Return the chosen views, in the order given."""
        index = list(views)
        masks = {name: getattr(self, name) for name in ("has_pose", "has_K")}
        tensors = {name: getattr(self, name) for name in ("T_cam_world", "K", "depth_z")}
        return replace(
            self,
            **{name: mask[index] for name, mask in masks.items() if mask is not None},
            **{name: value[:, index] for name, value in tensors.items() if value is not None},
        )

    def digest(self) -> str:
        """Return a fingerprint of all values."""
        found = hashlib.sha256(repr(self.metric).encode())
        for name in ("T_cam_world", "K", "depth_z", "has_pose", "has_K"):
            value = getattr(self, name)
            found.update(name.encode() if value is None else name.encode() + value.contiguous().numpy().tobytes())
        return found.hexdigest()[:16]


def _all_known(values: Tensor | None, known: Tensor | None) -> bool:
    return values is not None and (known is None or bool(known.all()))


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """A network's output at the network's resolution; what a model does not predict, or was not asked for, is None."""

    depth_z: Tensor | None = None
    """(..., S, H, W), up to scale unless there is a `scale`."""
    conf: Tensor | None = None
    """(..., S, H, W), in (1, inf), higher is better, not calibrated."""
    T_cam_world: Tensor | None = None
    """(..., S, 4, 4)."""
    K: Tensor | None = None
    """(..., S, 3, 3), pixels of the H x W map."""
    sky: Tensor | None = None
    """(..., S, H, W)."""
    rays: Tensor | None = None
    """(..., S, h, w, 7): direction, origin, confidence."""
    points: Tensor | None = None
    """(..., S, H, W, 4): world point and its confidence."""
    scale: Tensor | None = None
    """(..., 2): factor that turned all lengths into metres, applied already, and the relative spread of the factors of
    single views (nan for one view); None: lengths are up to scale."""

    def map(self, change) -> Self:
        """Apply `change` to every tensor that is there."""
        present = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{k: change(v) for k, v in present.items() if v is not None})
