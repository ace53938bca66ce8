"""What a user knows about the cameras of photos."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

__all__ = ["KnownCamera", "KnownCameras", "Lens"]


@dataclass(frozen=True)
class Lens:
    """How a lens bends rays, as one of COLMAP's camera models says it."""

    model: str
    """Such as OPENCV; the parameters after focal lengths and principal point belong to it."""
    params: tuple[float, ...]
    """Distortion only, in COLMAP's order."""


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownCamera:
    """What is known of one photo's camera; every part may be missing."""

    T_cam_world: np.ndarray | None = None
    """(4, 4) float64, OpenCV axes, rotation exact to rounding."""
    K: np.ndarray | None = None
    """(3, 3) float64 in pixels of the upright photo, counted from its corner (the first pixel's centre is .5, .5)."""
    lens: Lens | None = None
    """Distortion; None: a pinhole, or not known."""
    size_hw: tuple[int, int] | None = None
    """Height and width of the image that `K` counts pixels of; with photos, those of the upright photo."""
    ids: tuple[int, int] | None = None
    """COLMAP's numbers of the image and of its camera, kept for writing a COLMAP model again."""


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownCameras:
    """Known cameras of photos, in the order of the photos."""

    names: tuple[str, ...]
    """Names of the photos."""
    cameras: tuple[KnownCamera, ...]
    source: str
    """File or folder that they come from."""
    metric: bool = False
    """Whether lengths are metres."""
    convention: str = "w2c-opencv"
    """How the matrices of `source` were read; a key of `freegeo.cameras.convention.READINGS`."""

    def __len__(self) -> int:
        """Return the number of photos."""
        return len(self.names)

    @property
    def has_pose(self) -> np.ndarray:
        """Mask (S,) bool of the photos whose pose is known."""
        return np.array([one.T_cam_world is not None for one in self.cameras])

    @property
    def has_K(self) -> np.ndarray:
        """Mask (S,) bool of the photos whose intrinsics are known."""
        return np.array([one.K is not None for one in self.cameras])

    def select(self, views: list[int]) -> Self:
        """Return the chosen photos, in the order given."""
        return replace(self, names=tuple(self.names[i] for i in views), cameras=tuple(self.cameras[i] for i in views))

    @property
    def poses(self) -> dict[int, np.ndarray]:
        """Return `T_cam_world` (4, 4) of the photos whose pose is known."""
        return {i: one.T_cam_world for i, one in enumerate(self.cameras) if one.T_cam_world is not None}

    def without_poses(self, views: Collection[int]) -> Self:
        """Return the same without the poses of some photos."""
        cameras = (replace(one, T_cam_world=None) if i in views else one for i, one in enumerate(self.cameras))
        return replace(self, cameras=tuple(cameras))
