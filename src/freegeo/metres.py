"""Metres for a reconstruction: from distances that the user measured, or from GPS positions (docs/scale.md)."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from freegeo.cameras.undistortion import UndistortedPhoto
from freegeo.data.image_files import UnreadableImageError, opened
from freegeo.errors import UserError
from freegeo.export.photos import own_file
from freegeo.export.pixels import HALF
from freegeo.export.reconstruction import METRIC_MODEL, Reconstruction, Scale
from freegeo.geometry.se3 import camera_centres
from freegeo.geometry.sim3 import umeyama

if TYPE_CHECKING:
    from freegeo.types import ImageBatch, PhotoLike

__all__ = [
    "Distances",
    "Gps",
    "Measured",
    "ScaleSource",
    "in_metres",
    "read_scale",
    "require_in_view",
    "scale_to_metres",
]

logger = logging.getLogger(__name__)

GPS = "gps"
FORM = '"IMG_1.jpg:812,410 IMG_2.jpg:655,398 = 1.25"'
_LINE = re.compile(r"\s*(.+?):([\d.]+),([\d.]+)\s+(.+?):([\d.]+),([\d.]+)\s*=\s*([\d.eE+-]+)\s*(?:m)?\s*")
CONTRADICTION = 0.02
"""Relative difference from which two statements about the length of a metre contradict each other."""
DISTANCES_APART = 0.05
"""Spread of the factors of several distances from which a warning says so."""
FEWEST_POSITIONS = 3
"""GPS positions that a scale takes."""
GPS_SPREAD = 0.25
"""Error of GPS positions, in the extent of the path, above which they give no scale."""
GPS_OUTLIER = 3.0
"""Positions with an error of more than so many medians are left out."""
SAME_PLACE_M = 1e-3
"""GPS positions that differ by less are one: EXIF data have them to about a centimetre."""
LINE = 0.02
"""Width of a path, as a share of its length, below which it is a line."""
_GPS_IFD, _LAT_REF, _LAT, _LON_REF, _LON, _ALT_REF, _ALT = 0x8825, 1, 2, 3, 4, 5, 6
_EARTH_M, _FLATTENING = 6378137.0, 1 / 298.257223563
_DAMAGED = (OSError, SyntaxError, ValueError, TypeError, LookupError, ArithmeticError, AttributeError)


@dataclass(frozen=True, kw_only=True)
class Measured:
    """The distance between two places that photos show."""

    photos: tuple[str, str]
    """Names of the photos, which may be one."""
    pixels: tuple[tuple[float, float], tuple[float, float]]
    """Column and row in each photo as an image viewer shows them: upright, the first pixel is 0, 0."""
    metres: float


@dataclass(frozen=True)
class Distances:
    """Distances that the user measured."""

    measured: tuple[Measured, ...]

    def among(self, names: Collection[str]) -> Distances:
        """Return the distances between places that photos of these names show."""
        return Distances(tuple(one for one in self.measured if set(one.photos) <= set(names)))


@dataclass(frozen=True)
class Gps:
    """Positions of photos, metres east, north and up of their mean."""

    views: tuple[int, ...]
    positions: tuple[tuple[float, float, float], ...]

    def select(self, views: Sequence[int]) -> Gps:
        """Return what is known of the chosen views, in the order given."""
        known = dict(zip(self.views, self.positions, strict=True))
        found = [(new, known[old]) for new, old in enumerate(views) if old in known]
        return Gps(views=tuple(new for new, _ in found), positions=tuple(place for _, place in found))


ScaleSource = Distances | Gps


def read_scale(text: str, photos: Sequence[PhotoLike]) -> ScaleSource:
    """Read what --scale says: `gps`, a measured distance, or a text file with one in each line.

    A distance is written as `IMG_1.jpg:812,410 IMG_2.jpg:655,398 = 1.25`: two places, each a photo with column and row
    as an image viewer shows them, and the metres between them. Lines of a file that begin with # are left out.

    Raises:
        UserError: neither of these, a photo or place that is not there, or too few photos with GPS positions.
    """
    if text.strip().lower() == GPS:
        return _gps_of(photos)
    file = Path(text).expanduser()
    lines = [text]
    if "=" not in text:
        if not file.is_file():
            raise UserError(f"--scale '{text}': neither gps, nor a distance such as {FORM}, nor a file of distances.")
        try:
            content = file.read_text(encoding="utf-8-sig")
        except (OSError, UnicodeDecodeError):
            raise UserError(f"{file}: is no text file of distances such as {FORM}.") from None
        lines = [line for line in content.splitlines() if line.strip() and not line.lstrip().startswith("#")]
        if not lines:
            raise UserError(f"{file}: holds no distance. Write one in each line, such as {FORM}.")
    sizes = {photo.name: photo.size_hw for photo in photos}
    return Distances(tuple(_measured(line, sizes) for line in lines))


def _measured(line: str, sizes: dict[str, tuple[int, int]]) -> Measured:
    found = _LINE.fullmatch(line)
    try:
        numbers = [float(found[k]) for k in (2, 3, 5, 6, 7)] if found else []
    except ValueError:
        numbers = []
    if found is None or not numbers or not (math.isfinite(numbers[4]) and numbers[4] > 0):
        raise UserError(f"--scale: '{line.strip()}' is no distance. Write it as {FORM}, in metres.")
    names, pixels = (found[1], found[4]), ((numbers[0], numbers[1]), (numbers[2], numbers[3]))
    for name, (u, v) in zip(names, pixels, strict=True):
        if name not in sizes:
            raise UserError(f"--scale: there is no photo {name} here. Names are such as {next(iter(sizes))}.")
        height, width = sizes[name]
        if u >= width or v >= height:
            raise UserError(f"--scale: {name}:{u:g},{v:g} is outside the photo, which has {width} x {height} pixels.")
    if names[0] == names[1] and pixels[0] == pixels[1]:
        raise UserError(f"--scale: '{line.strip()}' names one place twice.")
    return Measured(photos=names, pixels=pixels, metres=numbers[4])


def require_in_view(source: ScaleSource, batch: ImageBatch, photos: Sequence[PhotoLike]) -> None:
    """Raise UserError for a scale that no prediction of these photos can have; cheap, and done before any.

    A measured place must be in the model's image of its photo, which may be cut, and GPS positions must differ.
    """
    if isinstance(source, Gps):
        if np.ptp(np.array(source.positions), axis=0).max() < SAME_PLACE_M:
            raise UserError(
                f"--scale gps: the {len(source.views)} photos with a GPS position all have the same one, which tells "
                f"no scale. Give a measured distance, such as {FORM}."
            )
        return
    for measured in source.measured:
        for name, pixel in zip(measured.photos, measured.pixels, strict=True):
            view = batch.names.index(name)
            place = _in_image(pixel, photos[view], batch.scale_xy[view].numpy(), batch.offset_xy[view].numpy())
            if not _is_inside(place, batch.image_hw):
                raise UserError(
                    f"--scale: {name}:{pixel[0]:g},{pixel[1]:g} lies in the part of the photo that is cut off for the "
                    "model. Choose another place, or use --mixed pad."
                )


def in_metres(result: Reconstruction, source: ScaleSource, photos: Sequence[PhotoLike]) -> Reconstruction:
    """Bring a reconstruction to metres (`scale_to_metres`); it comes back as it is where it is sure of them already."""
    found = scale_to_metres(result, source, photos)
    return result if found is None else result.scaled(found.value, source=found.source, spread=found.spread)


def scale_to_metres(result: Reconstruction, source: ScaleSource, photos: Sequence[PhotoLike]) -> Scale | None:
    """Return what brings a reconstruction to metres; None where lengths are metres that are surer than the source.

    What is surer wins: distances, then known cameras in metres, then GPS.

    Raises:
        UserError: a place without depth, GPS positions that do not fit the cameras, or no cameras.
    """
    if isinstance(source, Gps):
        if result.scale is not None and result.scale.source != METRIC_MODEL:
            logger.info("lengths are metres from %s already: GPS positions are not used", result.scale.source)
            return None
        factor, spread = _factor_of_gps(result, source)
        logger.info("GPS positions of %d photos: scale %.4g, to %.1f %%", len(source.views), factor, 100 * spread)
        return Scale(value=factor, source="GPS positions of the photos", spread=spread)
    logs = np.log([one.metres / _length(result, one, photos) for one in source.measured])
    factor, spread = float(np.exp(np.median(logs))), float(logs.std(ddof=1)) if len(logs) > 1 else None
    if spread is not None and spread > DISTANCES_APART:
        logger.warning(
            "--scale: the %d distances give scales that differ by %.0f %%; check them, and what the pixels show.",
            len(logs), 100 * spread,
        )  # fmt: skip
    if result.scale is not None and abs(factor - 1) > CONTRADICTION:
        logger.warning(
            "the measured distances are %.3g times what the metres from %s say; the distances are believed, and depth "
            "and cameras are scaled.",
            factor, result.scale.source,
        )  # fmt: skip
    count = "a measured distance" if len(logs) == 1 else f"{len(logs)} measured distances"
    return Scale(value=factor, source=count, spread=spread)


def _length(result: Reconstruction, measured: Measured, photos: Sequence[PhotoLike]) -> float:
    """Distance between the two places in the reconstruction."""
    ends = [_point(result, name, pixel, photos) for name, pixel in zip(measured.photos, measured.pixels, strict=True)]
    length = float(np.linalg.norm(ends[0] - ends[1]))
    if not length > 0:
        raise UserError(f"--scale: the two places in {measured.photos[0]} and {measured.photos[1]} are one point.")
    return length


def _point(result: Reconstruction, name: str, pixel: tuple[float, float], photos: Sequence[PhotoLike]) -> np.ndarray:
    """World point (3,) that a photo shows at a pixel."""
    view = result.names.index(name)
    place = _in_image(pixel, photos[view], result.scale_xy[view], result.offset_xy[view])
    z = _depth_at(result.depth_z[view], result.valid_pixels()[view], place)
    if z is None:
        raise UserError(f"--scale: there is no depth at {name}:{pixel[0]:g},{pixel[1]:g}. Choose another place.")
    T, K = (values[view].astype(np.float64) for values in result.cameras())
    camera = z * np.linalg.solve(K, np.array([*place, 1.0]))
    return T[:3, :3].T @ (camera - T[:3, 3])


def _in_image(pixel: tuple[float, float], photo: PhotoLike, scale_xy: np.ndarray, offset_xy: np.ndarray) -> np.ndarray:
    """Where the pixel of a photo is in the model's image, in whose first pixel's middle is 0, 0."""
    place = np.array(pixel) + HALF  # counted from the corner
    if isinstance(photo, UndistortedPhoto):
        place = photo.from_original(place[None])[0]
    return place * scale_xy + offset_xy - HALF


def _is_inside(place: np.ndarray, image_hw: tuple[int, int]) -> bool:
    height, width = image_hw
    return bool(np.isfinite(place).all() and (place >= -HALF).all() and (place < (width - HALF, height - HALF)).all())


def _depth_at(depth_z: np.ndarray, valid: np.ndarray, place: np.ndarray) -> float | None:
    """Depth at a place: bilinear on one surface, that of the nearest pixel at an edge; None where there is none."""
    height, width = depth_z.shape
    if not _is_inside(place, depth_z.shape):
        return None
    nearest = np.floor(place + HALF).astype(int).clip(0, (width - 1, height - 1))
    if not valid[nearest[1], nearest[0]]:
        return None
    u, v = place.clip(0, (width - 1, height - 1))
    left, top = min(int(u), max(width - 2, 0)), min(int(v), max(height - 2, 0))
    corners = depth_z[top : top + 2, left : left + 2].astype(np.float64)
    good = corners.shape == (2, 2) and valid[top : top + 2, left : left + 2].all()
    if not good or corners.max() > 1.1 * corners.min():
        return float(depth_z[nearest[1], nearest[0]])
    across, down = u - left, v - top
    return float((corners[0] * (1 - down) + corners[1] * down) @ (1 - across, across))


def _factor_of_gps(result: Reconstruction, gps: Gps) -> tuple[float, float]:
    """Scale of a reconstruction by GPS positions, and its relative error."""
    centres = camera_centres(torch.from_numpy(result.cameras()[0]).double())[list(gps.views)]
    places = torch.tensor(gps.positions, dtype=torch.float64)
    sizes = torch.linalg.svdvals(centres - centres.mean(0))
    if not sizes[1] > LINE * sizes[0]:
        raise UserError("--scale gps: the cameras are on one line, to which GPS positions fit too easily.")
    fit = umeyama(centres, places)
    for _ in range(2):
        error = (fit.apply(centres) - places).norm(dim=-1)
        near = error <= GPS_OUTLIER * error.quantile(0.5)
        if near.all() or near.sum() < 3:
            break
        centres, places = centres[near], places[near]
        fit = umeyama(centres, places)
    error = (fit.apply(centres) - places).square().sum(-1).mean().sqrt()
    extent = (places - places.mean(0)).square().sum(-1).mean().sqrt()
    spread = float(error / extent)
    if not spread <= GPS_SPREAD:
        raise UserError(
            f"--scale gps: the GPS positions are {float(error):.3g} m from the cameras in the mean, on a path of "
            f"{float(extent):.3g} m: too little to tell the scale. Give a measured distance, such as {FORM}."
        )
    return float(fit.s), spread


def _gps_of(photos: Sequence[PhotoLike]) -> Gps:
    found = {view: place for view, photo in enumerate(photos) if (place := _gps_position(photo)) is not None}
    if len(found) < FEWEST_POSITIONS:
        raise UserError(
            f"--scale gps: {len(found)} of {len(photos)} photos have a GPS position in their EXIF data; at least "
            f"{FEWEST_POSITIONS} are needed. Give a measured distance, such as {FORM}."
        )
    if len(found) < len(photos):
        logger.info("%d of %d photos have a GPS position", len(found), len(photos))
    places = local_positions(np.array(list(found.values()))).tolist()
    return Gps(tuple(found), tuple((east, north, up) for east, north, up in places))


def local_positions(geographic: np.ndarray) -> np.ndarray:
    """Metres east, north and up (n, 3) of their mean, of latitudes and longitudes in degrees and heights (n, 3).

    Heights that are not finite count as the median of the others.
    """
    latitude, longitude, height = geographic.T
    known = np.isfinite(height)
    height = np.where(known, height, np.median(height[known]) if known.any() else 0.0)
    east = (longitude - longitude[0] + 180) % 360 - 180
    middle = np.radians(latitude.mean())
    square = _FLATTENING * (2 - _FLATTENING)
    bend = 1 - square * np.sin(middle) ** 2
    along_meridian, across = _EARTH_M * (1 - square) / bend**1.5, _EARTH_M / bend**0.5 * np.cos(middle)
    metres = np.stack((np.radians(east) * across, np.radians(latitude) * along_meridian, height), axis=1)
    return metres - metres.mean(0)


def _gps_position(photo: PhotoLike) -> tuple[float, float, float] | None:
    """Latitude and longitude in degrees, and height in metres (nan without), of a photo; None where there is none."""
    file = own_file(photo.photo if isinstance(photo, UndistortedPhoto) else photo)
    if file is None:
        return None
    try:
        with opened(file) as image:
            fields = image.getexif().get_ifd(_GPS_IFD)
        place = [_degrees(fields[value], fields[ref]) for value, ref in ((_LAT, _LAT_REF), (_LON, _LON_REF))]
        height = float(fields[_ALT]) if _ALT in fields else math.nan
        below = fields.get(_ALT_REF, b"\0") in (b"\x01", 1)
    except (UnreadableImageError, *_DAMAGED):
        return None
    if not (abs(place[0]) <= 90 and abs(place[1]) <= 180) or place == [0.0, 0.0]:
        return None
    return place[0], place[1], -height if below else height


def _degrees(values: Sequence[float], reference: str) -> float:
    degrees, minutes, seconds = (float(value) for value in values)
    return (degrees + minutes / 60 + seconds / 3600) * (-1 if reference in ("S", "W") else 1)
