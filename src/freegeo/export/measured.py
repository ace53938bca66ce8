"""``tracks.npz``: points that were measured in the photos, beside the refined reconstruction that they belong to.

The COLMAP export writes them instead of projected points. The keys are the fields of `freegeo.fusion.tracks.Tracks`;
pixels are those of the model's images, centres at whole numbers.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np

from freegeo import files
from freegeo.errors import FreeGeoError
from freegeo.export.base import TRACKS_NAME
from freegeo.fusion.tracks import Tracks

_KINDS: dict[str, files.Kind] = {
    "xyz": ("f", (-1, 3)), "colours": ("u", (-1, 3)), "point": ("i", (-1,)), "view": ("i", (-1,)),
    "pixel": ("f", (-1, 2)),
}  # fmt: skip


def save_tracks(folder: Path, tracks: Tracks) -> Path:
    """Write the file, and return its path."""
    files.write_npz(folder / TRACKS_NAME, asdict(tracks))
    return folder / TRACKS_NAME


def load_tracks(folder: Path, views: int) -> Tracks | None:
    """Read what `save_tracks` wrote beside a reconstruction of so many views; None when the folder has no such file.

    FreeGeoError when it is damaged, or belongs to another reconstruction.
    """
    file = folder / TRACKS_NAME
    if not file.is_file():
        return None
    tracks = Tracks(**files.read_npz(file, _KINDS, advice="Remove it and refine again."))
    if not _is_sound(tracks, views):
        raise FreeGeoError(f"{file}: damaged, or of another reconstruction. Remove it and refine again.")
    return tracks


def _is_sound(tracks: Tracks, views: int) -> bool:
    """Whether there is everything of each point and observation, and every number points to something that exists."""
    if len(tracks.colours) != len(tracks.xyz) or not len(tracks.point) == len(tracks.view) == len(tracks.pixel):
        return False
    in_order = (np.diff(tracks.point) >= 0).all() and np.isfinite(tracks.xyz).all() and np.isfinite(tracks.pixel).all()
    numbers = ((tracks.point, len(tracks)), (tracks.view, views))
    return bool(in_order and all((values >= 0).all() and (values < count).all() for values, count in numbers))
