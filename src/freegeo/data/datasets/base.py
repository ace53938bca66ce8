"""What the published evaluation fixes per dataset, and the ground-truth files of a scene."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Self

import numpy as np

from freegeo.errors import FreeGeoError, UserError


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """Constants of one dataset; lengths in metres. Source: benchmark protocol, section 1.1."""

    dataset: str
    voxel: float
    """Voxel edge of the fusion."""
    truncation: float
    depth_limit: float
    """Depths from here on are not fused."""
    down_sample: float
    """Voxel edge of the averaging before scoring."""
    threshold: float
    """Distance below which a point counts for precision and recall."""
    truth: Literal["mesh", "points"]
    """A mesh is sampled before scoring, a cloud is used as stored."""
    samples: int = 1_000_000
    """Points drawn from a mesh."""
    crop_margin: float | None = None
    """Predicted points farther than this outside the box of the ground truth are dropped; None keeps all."""
    fusion_hw: tuple[int, int] | None = None
    """Image size of the fusion; None is the size of the photo."""
    posed_centre_shift: float = 0.0
    """Added to the principal point of known cameras before they are scaled to the fusion size."""


@dataclass(frozen=True, kw_only=True)
class SceneTruth:
    """Where the ground truth of a scene lies; tuples have one entry per frame, None where a frame has no such file."""

    dataset: str
    surface: Path
    """Mesh or point cloud."""
    depth: tuple[Path | None, ...]
    mask: tuple[Path | None, ...]
    camera_hw: tuple[tuple[int, int], ...]
    """Size the intrinsics refer to."""

    def select(self, views: Sequence[int]) -> Self:
        """The same scene with the chosen frames, in the order given."""
        return replace(
            self,
            depth=tuple(self.depth[i] for i in views),
            mask=tuple(self.mask[i] for i in views),
            camera_hw=tuple(self.camera_hw[i] for i in views),
        )


def existing(path: Path) -> Path | None:
    """The path, or None when there is no such file."""
    return path if path.is_file() else None


def require_folder(path: Path, what: str) -> Path:
    """The path of an existing folder; UserError names what is missing."""
    if not path.is_dir():
        raise UserError(f"{path}: no such folder, {what}. Check the name and where the benchmark data was unpacked.")
    return path


def read_gray(path: Path) -> np.ndarray:
    """Read a one-channel 8-bit or 16-bit image as stored, (H, W) integers; FreeGeoError when it has more channels."""
    from PIL import Image

    with Image.open(path) as image:
        values = np.array(image)
    if values.ndim != 2:
        raise FreeGeoError(f"{path}: a one-channel image was expected, this one has shape {values.shape}.")
    return values.astype(np.int32)
