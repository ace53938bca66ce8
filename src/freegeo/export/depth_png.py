"""``depth/``: one 16-bit PNG per photo at the model's resolution, and ``depth.json`` with the scale.

`depth_z = value * scale`; 0 means no depth, as in the padding around a photo. One scale serves all views: the largest
depth has the value 65535. The maps follow the user's masks, but none of the filters that thin point clouds: low
confidence, flying pixels, other views.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from freegeo import files
from freegeo.export.base import Export, Format
from freegeo.export.photos import check_names, new_names
from freegeo.export.reconstruction import Reconstruction

FOLDER = "depth"
LARGEST = 65535
MEANING = (
    "depth along the optical axis = value * scale; 0: no valid depth, or outside the masks. Filters of points "
    "(confidence, flying pixels, other views) are not applied."
)


def write_depth(reconstruction: Reconstruction, folder: Path, *, keep: np.ndarray | None = None) -> list[Path]:
    """Write the maps and the JSON file, and return their paths; pixels outside `keep` (S, H, W) or a photo get 0."""
    from PIL import Image, PngImagePlugin

    depth = reconstruction.depth_z
    valid = reconstruction.valid_pixels()
    if keep is not None:
        valid &= keep
    largest = max((depth[view][one].max() for view, one in enumerate(valid) if one.any()), default=None)
    scale = 1.0 if largest is None else float(largest) / LARGEST
    text = PngImagePlugin.PngInfo()
    text.add_text("depth_scale", repr(scale))
    maps = dict(zip(reconstruction.names, depth_names(reconstruction.names), strict=True))
    paths = [files.inside(folder, name) for name in maps.values()]
    for path, one, known in zip(paths, depth, valid, strict=True):
        # At least 1 for a valid depth, since 0 means no depth.
        values = np.where(known, np.clip(np.rint(np.where(known, one, 0) / scale), 1, LARGEST), 0).astype(np.uint16)
        with files.atomic_path(path) as part:
            Image.fromarray(values).save(part, pnginfo=text, compress_level=1)
    files.write_json(
        folder / "depth.json",
        {"scale": scale, "lengths": reconstruction.lengths, "meaning": MEANING, "maps": maps},
    )
    return [*paths, folder / "depth.json"]


def depth_names(names: Sequence[str]) -> list[str]:
    """File names of the maps: the photos' with the suffix .png, added to the old one where photos differ in it only."""
    return new_names(names, [".png"] * len(names))


def _write(export: Export) -> list[Path]:
    export.require_depth()
    return write_depth(export.reconstruction, export.folder / FOLDER, keep=export.masks)


FORMAT = Format(
    name="depth", path=FOLDER, about="16-bit depth images", write=_write, needs_cameras=False, check=check_names
)
