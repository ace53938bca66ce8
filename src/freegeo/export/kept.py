"""``kept.npz``: which pixels of a reconstruction the filters kept, beside the reconstruction that it belongs to.

The log, the exported files, the report and the viewer all take it from here, so that they show the same points.

| name | shape | type | meaning |
|---|---|---|---|
| `keep` | (S, H, W) | bool | pixels that become points |
| `removed_by`, `removed` | (F,) | str, int64 | filters in the order they ran, and the pixels each removed |
| `tolerance` | () | float64 | relative depth tolerance of the multi-view filter; NaN when it did not run |
| `masks` | (S, H, W) | bool | pixels that the user wants; absent without masks |
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from freegeo import files
from freegeo.errors import DamagedError, FreeGeoError
from freegeo.export.base import KEPT_NAME
from freegeo.fusion.filtering import FilterReport

_MAPS = ("b", (-1, -1, -1))
_KINDS: dict[str, files.Kind] = {
    "keep": _MAPS, "removed_by": ("U", (-1,)), "removed": ("iu", (-1,)), "tolerance": ("f", ()), "masks": _MAPS,
}  # fmt: skip

Filtered = tuple[np.ndarray, FilterReport]


def save_kept(folder: Path, filtered: Filtered, masks: np.ndarray | None = None) -> Path:
    """Write the result of `freegeo.export.formats.filter_reconstruction` with these masks; returns the file's path."""
    keep, report = filtered
    arrays = {
        "keep": keep,
        "removed_by": np.array(list(report.removed), dtype=str),
        "removed": np.array(list(report.removed.values()), dtype=np.int64),
        "tolerance": np.float64(math.nan if report.tolerance is None else report.tolerance),
    }
    files.write_npz(folder / KEPT_NAME, arrays if masks is None else {**arrays, "masks": masks})
    return folder / KEPT_NAME


def load_kept(folder: Path, shape: tuple[int, ...]) -> Filtered | None:
    """Read what `save_kept` wrote for depth maps of a shape (S, H, W); None when the folder has no such file.

    FreeGeoError when the file is damaged or belongs to other maps.
    """
    file = folder / KEPT_NAME
    if not file.is_file():
        return None
    content = files.read_npz(file, _KINDS, optional=("masks",))
    keep, names, counts = content["keep"], content["removed_by"].tolist(), content["removed"].tolist()
    if len(names) != len(counts):
        raise DamagedError(file, "numbers of filters differ", files.AGAIN)
    if any(content[name].shape != shape for name in ("keep", "masks") if name in content):
        raise FreeGeoError(f"{file}: belongs to another reconstruction. {files.AGAIN}")
    tolerance = float(content["tolerance"])
    removed = dict(zip(names, counts, strict=True))
    return keep, FilterReport(pixels=keep.size, removed=removed, tolerance=None if math.isnan(tolerance) else tolerance)


def load_masks(folder: Path) -> np.ndarray | None:
    """Read the masks (S, H, W) bool that `save_kept` wrote beside what `load_kept` reads; None when there were none."""
    return files.read_npz(folder / KEPT_NAME, {"masks": _KINDS["masks"]}, optional=("masks",)).get("masks")
