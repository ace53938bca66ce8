"""A scene: photos of one place, with cameras and ground truth where they are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from torch import Tensor

from freegeo.errors import UserError
from freegeo.types import PhotoLike


@dataclass(frozen=True, kw_only=True)
class SceneTruth:
    """Ground-truth files of a scene; tuples have one entry per frame, None where a frame has no such file."""

    dataset: str
    """Name of the dataset whose constants and readers apply."""
    surface: Path
    """Mesh or point cloud."""
    depth: tuple[Path | None, ...]
    mask: tuple[Path | None, ...]
    camera_hw: tuple[tuple[int, int], ...]
    """Size the intrinsics refer to."""

    def select(self, views: Sequence[int]) -> Self:
        """Return the same scene with the chosen frames, in the order given."""
        return replace(
            self,
            depth=tuple(self.depth[i] for i in views),
            mask=tuple(self.mask[i] for i in views),
            camera_hw=tuple(self.camera_hw[i] for i in views),
        )


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Views of one place, in loader order; photos are decoded only when they are read."""

    name: str
    photos: tuple[PhotoLike, ...]
    T_cam_world: Tensor | None = None
    """(S, 4, 4) float32, metres."""
    K: Tensor | None = None
    """(S, 3, 3) float32, pixels of the photos."""
    depth_z: Tensor | None = None
    """(S, H, W) float32 metres, for scenes whose ground-truth depth is in memory."""
    truth: SceneTruth | None = None
    """Ground-truth files of a benchmark scene."""

    def __post_init__(self):
        for name in ("T_cam_world", "K", "depth_z"):
            value = getattr(self, name)
            if value is not None and len(value) != len(self.photos):
                raise UserError(f"Scene {self.name}: {len(self.photos)} photos, but {name} is of {len(value)} views.")

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.photos)

    def select(self, views: Sequence[int]) -> Self:
        """Return the scene with the chosen views, in the order given."""
        index = list(views)
        tensors = {name: getattr(self, name) for name in ("T_cam_world", "K", "depth_z")}
        return replace(
            self,
            photos=tuple(self.photos[i] for i in index),
            truth=self.truth.select(index) if self.truth else None,
            **{name: value[index] for name, value in tensors.items() if value is not None},
        )
