"""The description of a benchmark dataset, and helpers that its loader may use."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from freegeo.data.image_files import opened, stored_values
from freegeo.data.scene import Scene, SceneTruth
from freegeo.errors import FreeGeoError, UserError


@dataclass(frozen=True, kw_only=True)
class DatasetConstants:
    """What the evaluation fixes for one dataset; lengths in metres.

    Source of the published values: docs/benchmark.md, "Constants of the datasets".
    """

    voxel: float
    """Voxel edge of the fusion."""
    truncation: float
    """Distance at which the signed distance of the fusion is cut."""
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
class Archive:
    """The archive `<name>.zip` of a dataset in the benchmark's repository on the hub."""

    gb: float
    """Size as the benchmark's manual gives it, rounded."""
    terms: str
    """What the data may be used for, in short, and the page that says it in full."""


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """A dataset of the benchmark: its constants, and the functions that read its files.

    `root` is the dataset's own folder, `<data>/<name>`, in every function. One such value at the end of the dataset's
    file and one entry of `registry.DATASETS` make a dataset known to every command.
    """

    name: str
    """Name on the command line and of the folder."""
    constants: DatasetConstants
    scene_names: Callable[[Path], Sequence[str]]
    """(root): the scenes in the order of the evaluation. UserError when a list that belongs to the data is missing."""
    load_scene: Callable[[Path, str], Scene]
    """(root, name): photos, cameras and ground truth of a scene. UserError for a missing file, FreeGeoError for a
    damaged one."""
    read_depth: Callable[[Path, tuple[int, int]], np.ndarray] | None = None
    """(path, size of the photo): a depth file of `SceneTruth.depth`, (H, W) float32 metres, 0 or infinity where there
    is none. None: no depth files; a scene may carry its depth in memory."""
    valid_mask: Callable[[SceneTruth, int, tuple[int, int]], np.ndarray | None] | None = None
    """(truth, frame, fusion size): pixels of the frame that may be fused, (H, W) bool, or None without any restriction.
    None: no frame has such a mask."""
    depth_of_every_frame: bool = True
    """Whether a frame without a depth file is a gap in the data."""
    recipe_row: str | None = None
    """Row of the per-dataset settings of adaptation (`freegeo.adaptation.recipe`). None: none are published, and those
    of generated rooms are used."""
    archive: Archive | None = None
    """The dataset's archive on the hub; None: it is not on the hub."""
    generated: bool = False
    """Whether scenes are rendered when they are first used, so that nothing can be missing."""


def existing(path: Path) -> Path | None:
    """Return the path, or None when there is no such file."""
    return path if path.is_file() else None


def require_folder(path: Path, what: str) -> Path:
    """Return the path of an existing folder; UserError names what is missing."""
    if not path.is_dir():
        raise UserError(f"{path}: no such folder, {what}. Check the name and where the benchmark data was unpacked.")
    return path


def read_gray(path: Path) -> np.ndarray:
    """Read a one-channel 8-bit or 16-bit image as stored, (H, W) integers.

    `UnreadableImageError` when it is damaged or no image, FreeGeoError when it has more channels.
    """
    with opened(path) as image:
        values = stored_values(image, path)
    if values.ndim != 2:
        raise FreeGeoError(f"{path}: a one-channel image was expected, this one has shape {values.shape}.")
    return values.astype(np.int32)
