"""Pictures of matches: the pairs of photos that a result's cameras explain best and worst, with epipolar lines.

A point of the first photo lies on a line of the second one, by the cameras; its match should lie on that line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from freegeo.evidence.candidate import Candidate
from freegeo.evidence.matches import FILE_NAME, Matches, load_matches
from freegeo.evidence.scores import epipolar
from freegeo.export.reconstruction import Reconstruction
from freegeo.geometry.se3 import relative
from freegeo.report.figures import data_uri
from freegeo.types import PhotoLike

DRAWN = 12
"""Matches of a pair that are drawn."""
WIDTH = 560
"""Widest picture of a photo."""


Point = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Mark:
    """One end of a match in a picture; places are in pixels of the picture, counted from its corner."""

    colour: str
    """The same at both ends."""
    point: Point
    line: tuple[Point, Point] | None
    """Ends of the epipolar line of the other end; None in the first photo, and where the line misses the picture."""


@dataclass(frozen=True, kw_only=True)
class Side:
    """One photo of a pair."""

    name: str
    uri: str
    width: int
    height: int
    marks: list[Mark]


@dataclass(frozen=True, kw_only=True)
class PairPicture:
    """Two photos and some of their matches."""

    what: str
    """`best` or `worst`."""
    sides: tuple[Side, Side]
    count: int
    """Matches of the pair."""
    of: int
    """Pairs of the result that have matches."""
    median_px: float
    """Its epipolar error (S1), matching pixels."""
    distances_px: list[float]
    """Of the drawn matches from their lines in the second photo, matching pixels."""


def pair_pictures(folder: Path, result: Reconstruction, photos: Sequence[PhotoLike] | None) -> list[PairPicture]:
    """Draw the pairs with the smallest and the largest error; empty without cameras or stored matches.

    Args:
        folder: holds `matches.npz`.
        result: whose cameras are drawn.
        photos: of the result; None: the images that the model read are shown.
    """
    matches = load_matches(folder / FILE_NAME)
    if matches is None or not result.has_cameras or matches.names != result.names:
        return []
    candidate = Candidate.of(result)
    scores = epipolar(candidate, matches)
    known = np.flatnonzero(np.isfinite(scores.values))
    order = known[np.argsort(scores.values[known], kind="stable")]
    chosen = {"best": order[:1], "worst": order[1:][-1:]}
    found = [
        _picture(what, int(pair), len(known), float(scores.values[pair]), candidate, matches, result, photos)
        for what, pairs in chosen.items()
        for pair in pairs
    ]
    # Cameras in one place have no epipolar lines.
    return [picture for picture in found if np.isfinite(picture.distances_px).all()]


def _picture(
    what: str,
    pair: int,
    of: int,
    median_px: float,
    candidate: Candidate,
    matches: Matches,
    result: Reconstruction,
    photos: Sequence[PhotoLike] | None,
) -> PairPicture:
    views = matches.pairs[pair]
    x, y = matches.of_pair(pair)
    rows = spread(x, DRAWN)
    photo_hw, match_hw = torch.from_numpy(matches.photo_hw), torch.from_numpy(matches.match_hw)
    K = candidate.matching_K(photo_hw, match_hw)[views].numpy()
    size = (match_hw.double() / photo_hw).flip(-1)[views].numpy()
    ends = [(pixel[rows] + 0.5) * size[k] - 0.5 for k, pixel in enumerate((x, y))]
    lines = _lines(relative(*candidate.T_cam_world[views]).numpy(), K, ends[0])
    with np.errstate(invalid="ignore"):
        distances = np.abs((lines * _homogeneous(ends[1])).sum(1)) / np.linalg.norm(lines[:, :2], axis=1)
    colours = [f"hsl({360 * k // len(rows)} 95% 62%)" for k in range(len(rows))]
    sides = []
    for k, view in enumerate(views.tolist()):
        image, scale, offset = _shown(view, result, photos)
        height, width = image.shape[:2]
        # From matching pixels, centres at whole numbers, to the picture's, counted from the corner.
        factor = scale / size[k]
        shift = factor / 2 + offset
        clipped = [_clipped(line, factor, shift, (width, height)) for line in lines] if k else [None] * len(rows)
        marks = [
            Mark(colour=colour, point=(float(u), float(v)), line=line)
            for colour, (u, v), line in zip(colours, ends[k] * factor + shift, clipped, strict=True)
        ]
        name, uri = result.names[view], data_uri(image, WIDTH)
        sides.append(Side(name=name, uri=uri, width=width, height=height, marks=marks))
    return PairPicture(
        what=what, sides=(sides[0], sides[1]), count=len(x), of=of, median_px=median_px,
        distances_px=[float(value) for value in distances],
    )  # fmt: skip


def spread(pixel: np.ndarray, count: int) -> np.ndarray:
    """Return rows of places (n, 2) that lie far apart, at most `count`; the first is nearest to the middle."""
    chosen = [int(np.linalg.norm(pixel - np.median(pixel, axis=0), axis=1).argmin())]
    away = np.full(len(pixel), np.inf)
    while len(chosen) < min(count, len(pixel)):
        away = np.minimum(away, np.linalg.norm(pixel - pixel[chosen[-1]], axis=1))
        chosen.append(int(away.argmax()))
    return np.array(chosen)


def _shown(
    view: int, result: Reconstruction, photos: Sequence[PhotoLike] | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A view's picture, and scale and offset (2,) from photo pixels to its pixels, both counted from the corner."""
    if photos is None:
        return result.images[view], result.scale_xy[view], result.offset_xy[view]
    from PIL import Image

    picture = Image.fromarray(photos[view].read())
    full = picture.size
    picture.thumbnail((WIDTH, WIDTH), Image.Resampling.BOX)
    return np.asarray(picture), np.array(picture.size) / full, np.zeros(2)


def _lines(T: np.ndarray, K: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Lines (n, 3) in the second photo for pixels (n, 2) of the first; `T` (4, 4) leads from first to second camera."""
    t, R = T[:3, 3], T[:3, :3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    return _homogeneous(x) @ (np.linalg.inv(K[1]).T @ cross @ R @ np.linalg.inv(K[0])).T


def _homogeneous(pixel: np.ndarray) -> np.ndarray:
    return np.concatenate((pixel, np.ones_like(pixel[:, :1])), axis=1)


def _clipped(
    line: np.ndarray, factor: np.ndarray, shift: np.ndarray, size: tuple[int, int]
) -> tuple[Point, Point] | None:
    """Ends of a line inside a picture, after a move of its pixels by factor and shift; None where it misses it."""
    a, b = (line[:2] / factor).tolist()
    c = float(line[2] - (line[:2] * shift / factor).sum())
    width, height = size
    ends = [(0.0, -c / b), (float(width), -(a * width + c) / b)] if b else []
    ends += [(-c / a, 0.0), (-(b * height + c) / a, float(height))] if a else []
    inside = [(u, v) for u, v in ends if -1e-6 <= u <= width + 1e-6 and -1e-6 <= v <= height + 1e-6]
    return (min(inside), max(inside)) if len(inside) >= 2 else None
