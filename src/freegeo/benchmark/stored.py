"""The file a prediction is stored in: what scoring reads, and nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from freegeo.benchmark.tasks import PREDICTION_FILE, Task
from freegeo.errors import FreeGeoError, UserError
from freegeo.files import Kind, read_npz, write_npz
from freegeo.types import Prediction

ARRAYS: dict[str, Kind] = {"depth_z": ("f", (-1, -1, -1)), "T_cam_world": ("f", (-1, 4, 4)), "K": ("f", (-1, 3, 3))}
_AGAIN = "Remove its folder and predict again."


@dataclass(frozen=True, kw_only=True)
class Stored:
    """A prediction as it was stored."""

    frames: tuple[int, ...]
    """Frames of the scene, in loader order."""
    prediction: Prediction
    """depth_z (S, h, w), T_cam_world (S, 4, 4), K (S, 3, 3) at the network's size."""


def write_stored(task: Task, out: Path, prediction: Prediction, frames: Sequence[int]) -> None:
    """Store a prediction; UserError when the model does not predict depth, poses or intrinsics."""
    found = {name: getattr(prediction, name) for name in ARRAYS}
    missing = [name for name, value in found.items() if value is None]
    if missing:
        raise UserError(f"the model predicts no {' and no '.join(missing)}, which the benchmark scores; choose another")
    arrays = {name: value.numpy() for name, value in found.items()}
    write_npz(task.folder(out) / PREDICTION_FILE, {"frames": np.array(list(frames)), **arrays})


def read_stored(task: Task, out: Path) -> Stored:
    """Read a stored prediction; FreeGeoError when it is missing, damaged, or empty."""
    path = task.folder(out) / PREDICTION_FILE
    if not path.is_file():
        raise FreeGeoError(f"{path}: no stored prediction; predict again")
    arrays = read_npz(path, {**ARRAYS, "frames": ("iu", (-1,))}, advice=_AGAIN)
    frames = tuple(int(frame) for frame in arrays.pop("frames"))
    if not frames or min(frames) < 0 or any(len(value) != len(frames) for value in arrays.values()):
        raise FreeGeoError(f"{path}: an empty or incomplete prediction; remove its folder and predict again")
    return Stored(frames=frames, prediction=Prediction(**{k: torch.from_numpy(v) for k, v in arrays.items()}))
