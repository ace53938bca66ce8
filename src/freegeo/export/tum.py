"""``trajectory.txt``: the cameras as a TUM trajectory, camera to world with OpenCV axes.

A row a view: `timestamp tx ty tz qx qy qz qw`, in the order of the timestamps. The timestamp is the time of a video's
frame in seconds, where all views have different ones and the frames are at hand; otherwise the name of the photo, where
all names are different numbers, by which readers of such files find the photo; otherwise the number of the view.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from freegeo import files
from freegeo.export.base import Export, Format
from freegeo.export.reconstruction import Reconstruction

FILE_NAME = "trajectory.txt"


def write_tum(reconstruction: Reconstruction, path: Path, *, times: list[float] | None = None) -> Path:
    """Write the cameras.

    Args:
        reconstruction: with cameras.
        path: of the file.
        times: of the views, in seconds; None: their names where those are numbers, else the numbers of the views.
    """
    import torch

    from freegeo.geometry.rotation import matrix_to_quat_xyzw

    poses = np.linalg.inv(reconstruction.cameras()[0].astype(np.float64))
    quats = matrix_to_quat_xyzw(torch.from_numpy(poses[:, :3, :3].copy())).numpy()
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    if times is None:
        times = times_of_names(reconstruction.names)
    values = np.column_stack((times, poses[:, :3, 3], quats))[np.argsort(times, kind="stable")]
    about = f"# timestamp tx ty tz qx qy qz qw (camera to world, OpenCV axes); lengths are {reconstruction.lengths}\n"
    rows = [" ".join(repr(value) for value in row) + "\n" for row in values.tolist()]
    with files.atomic_path(path) as part:
        part.write_text(about + "".join(rows), encoding="utf-8")
    return path


def times_of_names(names: Sequence[str]) -> list[float]:
    """Return the photos' names, with or without ending, where all are different numbers, else 0, 1, 2, ..."""
    by_number = [float(k) for k in range(len(names))]
    try:
        times = [_number(Path(name)) for name in names]
    except ValueError:
        return by_number
    return times if len(set(times)) == len(times) and np.isfinite(times).all() else by_number


def _number(name: Path) -> float:
    try:
        return float(name.name)
    except ValueError:
        return float(name.stem)


def _times(export: Export) -> list[float] | None:
    """Times of the views in their video; None where they are not known, or not all different."""
    found = [getattr(photo, "time_s", None) for photo in export.photos or ()]
    times = [float(time) for time in found if time is not None]
    return times if len(set(times)) == len(export.reconstruction) else None


def _write(export: Export) -> list[Path]:
    return [write_tum(export.reconstruction, export.folder / FILE_NAME, times=_times(export))]


FORMAT = Format(name="tum", path=FILE_NAME, about="camera trajectory (TUM)", write=_write)
