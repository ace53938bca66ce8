"""``tracks.npz``: points that were measured in the photos, beside the refined reconstruction that they belong to.

The COLMAP export writes them instead of projected points. The keys are the fields of `freegeo.fusion.tracks.Tracks`;
pixels are those of the model's images, centres at whole numbers.
"""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np

from freegeo import files
from freegeo.errors import FreeGeoError
from freegeo.export.base import TRACKS_NAME
from freegeo.fusion.tracks import Tracks


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
    try:
        with np.load(file, allow_pickle=False) as content:
            tracks = Tracks(**{field.name: content[field.name] for field in fields(Tracks)})
    except (zipfile.BadZipFile, zlib.error, ValueError, KeyError, EOFError, OSError) as error:
        raise FreeGeoError(f"{file}: damaged file ({error}). Remove it and refine again.") from None
    if not _is_sound(tracks, views):
        raise FreeGeoError(f"{file}: damaged, or of another reconstruction. Remove it and refine again.")
    return tracks


def _is_sound(tracks: Tracks, views: int) -> bool:
    """Whether shapes and types are those of tracks, and every number points to something that exists."""
    points, observations = tracks.xyz.shape[:1], tracks.point.shape
    expected = {
        "xyz": ((*points, 3), "f"), "colours": ((*points, 3), "u"), "point": (observations, "i"),
        "view": (observations, "i"), "pixel": ((*observations, 2), "f"),
    }  # fmt: skip
    found = {name: (getattr(tracks, name).shape, getattr(tracks, name).dtype.kind) for name in expected}
    if found != expected or len(observations) != 1 or len(points) != 1:
        return False
    in_order = (np.diff(tracks.point) >= 0).all() and np.isfinite(tracks.xyz).all() and np.isfinite(tracks.pixel).all()
    numbers = ((tracks.point, points[0]), (tracks.view, views))
    return bool(in_order and all((values >= 0).all() and (values < count).all() for values, count in numbers))
