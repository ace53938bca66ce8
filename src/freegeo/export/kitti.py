"""``trajectory-kitti.txt``: the cameras as a KITTI trajectory, camera to world with OpenCV axes.

A row a view, in the order of the photos: the 12 numbers of `[R | t]` (3 x 4), row by row. The world is that of the
other files, so that the first row is not exactly the identity, as it is in KITTI's own files.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from freegeo import files
from freegeo.export.base import Export, Format
from freegeo.export.reconstruction import Reconstruction

FILE_NAME = "trajectory-kitti.txt"


def write_kitti(reconstruction: Reconstruction, path: Path) -> Path:
    """Write the cameras of a reconstruction that has them."""
    poses = np.linalg.inv(reconstruction.cameras()[0].astype(np.float64))
    rows = [" ".join(map(repr, pose[:3].ravel().tolist())) + "\n" for pose in poses]
    with files.atomic_path(path) as part:
        part.write_text("".join(rows), encoding="utf-8")
    return path


def _write(export: Export) -> list[Path]:
    return [write_kitti(export.reconstruction, export.folder / FILE_NAME)]


FORMAT = Format(name="kitti", path=FILE_NAME, about="camera trajectory (KITTI)", write=_write)
