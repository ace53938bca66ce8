"""Depth maps as files: ``depth/`` (16-bit PNG), ``depth-color/`` (pictures), ``depth-npy/`` and ``depth-exr/``.

One file per photo, upright, at the model's resolution or at the photo's (`freegeo.export.upsampling`), and
``depth.json``, which says what the values mean. 0 means no depth, as in the padding around a photo; pictures are grey
there. The maps follow the user's masks, but none of the filters that thin point clouds: low confidence, flying pixels,
other views.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from freegeo import files
from freegeo.errors import FreeGeoError, UserError
from freegeo.export.base import DepthSize, Export, Format
from freegeo.export.colours import DEPTH_MAP, colour_table, log_colours, log_range
from freegeo.export.photos import check_names, new_names, pixels_of
from freegeo.export.reconstruction import Reconstruction

logger = logging.getLogger(__name__)

LARGEST = 65535
SIDECAR = "depth.json"
"""File beside the maps that says what their values mean."""
CHANNEL = "Y"
"""Channel of the EXR files: luminance, which OpenCV and Blender read as one grey image."""
_LIMITS = "Filters of points (confidence, flying pixels, other views) are not applied."
_NOTHING = "no valid depth, or outside the masks."
_VALUES = f"depth along the optical axis; 0: {_NOTHING} {_LIMITS}"
_SIZES: dict[DepthSize, str] = {
    "model": "that of the model's images",
    "photo": "that of the photos, interpolated from the model's along the edges of the photo",
}
_STOPS = 9
_LEGEND = """<svg xmlns="http://www.w3.org/2000/svg" width="640" height="72" font-family="sans-serif" font-size="13">
<rect width="640" height="72" fill="white"/>
<defs><linearGradient id="depth">{stops}</linearGradient></defs>
<rect x="20" y="24" width="600" height="20" fill="url(#depth)"/>
<text x="20" y="16">depth; lengths are {lengths}; grey: no depth</text>
{ticks}
</svg>
"""


def depth_maps(export: Export) -> Iterator[np.ndarray]:
    """Yield the depth of each view, (h, w) float32 at the size of the export, 0 where there is none.

    FreeGeoError where no view has any.
    """
    for view, known in enumerate(export.depth_pixels()):
        if export.depth_size == "photo":
            yield photo_depth(export, view, known)
        else:
            yield np.where(known, export.reconstruction.depth_z[view], np.float32(0))


def photo_depth(export: Export, view: int, known: np.ndarray) -> np.ndarray:
    """Return the depth (h, w) float32 of a view at its photo's size, from the pixels `known` (H, W) of its map.

    The photos must be at hand; FreeGeoError when this one can no longer be read.
    """
    from freegeo.export.upsampling import upsampled_depth

    assert export.photos is not None
    r = export.reconstruction
    photo = pixels_of(export.photos[view])
    return upsampled_depth(r.depth_z[view], known, r.images[view], photo, r.scale_xy[view], r.offset_xy[view])


def size_of(folder: Path) -> DepthSize | None:
    """Return the size of the depth files in a folder, as they say themselves; None where that cannot be read."""
    try:
        said = files.read_json(folder / SIDECAR)["size"]
    except (OSError, FreeGeoError, TypeError, KeyError):
        return None
    return next((size for size in _SIZES if _SIZES[size] == said), None)


def depth_names(names: Sequence[str], suffix: str = ".png") -> list[str]:
    """File names of the maps: the photos' with the suffix, added to the old one where photos differ in it only."""
    return new_names(names, [suffix] * len(names))


def _write_maps(
    export: Export,
    folder: str,
    suffix: str,
    about: dict[str, Any],
    write: Callable[[np.ndarray, Path], None],
    more: Mapping[str, str] | None = None,
) -> list[Path]:
    """Write a map of each view, depth.json, and `more` (file name -> text); returns the files.

    They replace earlier ones together: maps are never beside a depth.json that holds the scale of others.
    """
    place, r, size = export.folder / folder, export.reconstruction, _SIZES[export.depth_size]
    maps = dict(zip(r.names, depth_names(r.names, suffix), strict=True))
    said = json.dumps({**about, "lengths": r.lengths, "size": size, "maps": maps}, indent=2, ensure_ascii=False)
    texts = {SIDECAR: f"{said}\n", **(more or {})}
    names = [*maps.values(), *texts]
    with files.atomic_files(place, names) as paths:
        for path, depth in zip(paths, depth_maps(export), strict=False):
            write(depth, path)
        for path, text in zip(paths[len(maps) :], texts.values(), strict=True):
            path.write_text(text, encoding="utf-8")
    if export.depth_size == "photo":
        logger.info("%s: the size of the maps is %s.", place, size)
    return [place / name for name in names]


def _write_png(export: Export) -> list[Path]:
    from PIL import Image, PngImagePlugin

    scale = max(float(depth.max()) for depth in _model_maps(export)) / LARGEST
    text = PngImagePlugin.PngInfo()
    text.add_text("depth_scale", repr(scale))

    def write(depth: np.ndarray, path: Path) -> None:
        # At least 1 for a valid depth, since 0 means no depth.
        values = np.where(depth > 0, np.clip(np.rint(depth / scale), 1, LARGEST), 0).astype(np.uint16)
        Image.fromarray(values).save(path, pnginfo=text, compress_level=1)

    meaning = f"depth along the optical axis = value * scale; 0: {_NOTHING} {_LIMITS}"
    return _write_maps(export, PNG.path, ".png", {"scale": scale, "meaning": meaning}, write)


def _model_maps(export: Export) -> Iterator[np.ndarray]:
    """Yield the maps at the model's size, whose values those at the photos' size lie between."""
    from dataclasses import replace

    return depth_maps(replace(export, depth_size="model"))


def _write_pictures(export: Export) -> list[Path]:
    from PIL import Image

    near, far = log_range(lambda: _model_maps(export))

    def write(depth: np.ndarray, path: Path) -> None:
        Image.fromarray(log_colours(depth, (near, far), DEPTH_MAP)).save(path, compress_level=1)

    about = {
        "nearest": near, "farthest": far, "colours": f"{DEPTH_MAP} of matplotlib, logarithmic from nearest to farthest",
        "meaning": f"picture of the depth along the optical axis, one range for all photos; grey: {_NOTHING} {_LIMITS}",
    }  # fmt: skip
    more = {"legend.svg": _legend(near, far, export.reconstruction)}
    return _write_maps(export, PICTURES.path, ".png", about, write, more)


def _legend(near: float, far: float, r: Reconstruction) -> str:
    table = colour_table(DEPTH_MAP)
    stops, ticks = [], []
    for share in np.linspace(0, 1, _STOPS):
        red, green, blue = table[round(255 * share)].tolist()
        stops.append(f'<stop offset="{share:.3f}" stop-color="rgb({red},{green},{blue})"/>')
    for share in np.linspace(0, 1, _STOPS)[::2]:
        anchor = {0.0: "start", 1.0: "end"}.get(share, "middle")
        value = near * (far / near) ** share
        ticks.append(f'<text x="{20 + 600 * share:.0f}" y="62" text-anchor="{anchor}">{value:.3g}</text>')
    return _LEGEND.format(stops="".join(stops), ticks="\n".join(ticks), lengths=escape(r.lengths))


def _write_npy(export: Export) -> list[Path]:
    return _write_maps(export, NPY.path, ".npy", {"meaning": _VALUES}, _save_npy)


def _save_npy(depth: np.ndarray, path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, depth)


def _write_exr(export: Export) -> list[Path]:
    return _write_maps(export, EXR.path, ".exr", {"channel": CHANNEL, "meaning": _VALUES}, _exr_writer())


def _exr_writer() -> Callable[[np.ndarray, Path], None]:
    try:
        import OpenEXR  # ty: ignore[import-not-found]
    except ImportError as error:
        raise FreeGeoError(f"OpenEXR cannot be loaded ({error}). Run: pip install 'freegeo[exr]'.") from None

    def write(depth: np.ndarray, path: Path) -> None:
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {CHANNEL: depth}).write(str(path))

    return write


def _check_exr(names: Sequence[str]) -> None:
    check_names(names)
    if find_spec("OpenEXR") is None:
        raise UserError("The EXR export needs an extra: pip install 'freegeo[exr]'.")


_depth_format = partial(Format, needs_cameras=False, holds_depth=True)
PNG = _depth_format(name="depth", path="depth", about="16-bit depth images", write=_write_png, check=check_names)
PICTURES = _depth_format(
    name="depth-color", path="depth-color", about="coloured depth images", write=_write_pictures, check=check_names
)
NPY = _depth_format(
    name="depth-npy", path="depth-npy", about="depth as NumPy arrays", write=_write_npy, check=check_names
)
EXR = _depth_format(
    name="depth-exr", path="depth-exr", about="depth as OpenEXR images", write=_write_exr, check=_check_exr
)
