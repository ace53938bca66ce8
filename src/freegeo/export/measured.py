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


def load_tracks(folder: Path) -> Tracks | None:
    """Read what `save_tracks` wrote; None when the folder has no such file. FreeGeoError when it is damaged."""
    file = folder / TRACKS_NAME
    if not file.is_file():
        return None
    try:
        with np.load(file, allow_pickle=False) as content:
            return Tracks(**{field.name: content[field.name] for field in fields(Tracks)})
    except (zipfile.BadZipFile, zlib.error, ValueError, KeyError, EOFError, OSError) as error:
        raise FreeGeoError(f"{file}: damaged file ({error}). Remove it and refine again.") from None
