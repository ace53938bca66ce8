"""Whether known cameras were read as they were meant: the matches between photos judge four readings.

A file's 4x4 matrix may map world to camera or camera to world, and its camera may have OpenCV axes (x right, y down,
z forward) or OpenGL axes (x right, y up, z backward). Only one of the four readings puts the matches on their epipolar
lines (docs/cameras.md, "The check").
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

import numpy as np

from freegeo.cameras.known import KnownCameras
from freegeo.data.photos import some_of
from freegeo.errors import UserError

if TYPE_CHECKING:
    from freegeo.evidence.candidate import Candidate
    from freegeo.evidence.matches import Matches
    from freegeo.evidence.scores import PairScores

__all__ = ["READINGS", "Convention", "check_convention", "pairs_to_check", "matrix_of", "pose_of"]

logger = logging.getLogger(__name__)

Outcome = Literal["accepted", "refused", "unchecked"]
READINGS = {
    "w2c-opencv": "world-to-camera with OpenCV axes",
    "c2w-opencv": "camera-to-world with OpenCV axes",
    "w2c-opengl": "world-to-camera with OpenGL axes",
    "c2w-opengl": "camera-to-world with OpenGL axes",
}
"""The readings of a pose matrix, and what they are called in sentences."""
LARGEST_PX = 2.0
"""Median epipolar error above which cameras do not fit, in matching pixels."""
CLEARLY = 3.0
"""The best reading must be so many times better than the second."""
FEWEST_MATCHES = 40
"""With fewer matches there is nothing to judge by."""
FLAT = 0.8
"""Share of a pair's matches on one homography from which it is a turn on the spot or a flat scene."""
SAME_TURN_DEG, SAME_WAY_DEG = 0.5, 2.0
"""Relative poses that differ by less, in rotation and in the direction of the way, are the same."""
OF_A_PHOTO, MOST_GOOD = 3, 0.3
"""A photo is judged by itself when so many of its pairs have an error; it fits when at least this share is small."""
SEARCHED_MATCHES = 40
"""Matches of each pair by which an unknown focal length is searched."""
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_FOCAL_RANGE = (0.4, 4.0)
"""Focal lengths that are tried where none is known, in longest sides of the photo."""


def pose_of(matrix: np.ndarray, reading: str) -> np.ndarray:
    """Return `T_cam_world` (..., 4, 4), OpenCV axes, of a rigid matrix (..., 4, 4) that is meant as `reading` says."""
    direction, axes = reading.split("-")
    T = _inverse(matrix) if direction == "c2w" else matrix
    # Inverted or not, the camera's axes are those of the rows now.
    return _FLIP @ T if axes == "opengl" else T


def matrix_of(T_cam_world: np.ndarray, reading: str) -> np.ndarray:
    """Return the matrix (..., 4, 4) that means `T_cam_world` under a reading: the inverse of `pose_of`."""
    direction, axes = reading.split("-")
    T = _FLIP @ T_cam_world if axes == "opengl" else T_cam_world
    return _inverse(T) if direction == "c2w" else T


def _inverse(T: np.ndarray) -> np.ndarray:
    R = np.swapaxes(T[..., :3, :3], -1, -2)
    result = np.zeros_like(T)
    result[..., :3, :3] = R
    result[..., :3, 3:] = -R @ T[..., :3, 3:]
    result[..., 3, 3] = 1.0
    return result


@dataclass(frozen=True, kw_only=True)
class Convention:
    """What the matches between photos say of known cameras."""

    reading: str
    """How the file was read."""
    errors: Mapping[str, float]
    """Median over the pairs of photos of the median epipolar error, in matching pixels, for each of `READINGS`; nan
    without evidence."""
    behind: Mapping[str, bool]
    """Whether a reading puts most matched points behind the cameras, so that its error does not count."""
    pairs: int
    """Pairs of photos that were used."""
    matches: int
    """Their matches."""
    outcome: Outcome
    sentence: str
    """The verdict as text."""

    def require(self) -> None:
        """Raise UserError when the cameras are refused, and warn when there was not enough to check them by."""
        if self.outcome == "refused":
            raise UserError(self.sentence)
        if self.outcome == "unchecked":
            logger.warning("%s", self.sentence)

    def numbers(self) -> str:
        """Return the error of every reading as text."""
        parts = []
        for reading, what in READINGS.items():
            error = self.errors[reading]
            text = "no error" if np.isnan(error) else f"{error:.3g} px"
            parts.append(f"{what} {text}{', behind the cameras' if self.behind[reading] else ''}")
        return "; ".join(parts)


def pairs_to_check(count: int) -> np.ndarray:
    """Return pairs of photos (Q, 2) int64 whose matches `check_convention` needs: all of 16, of more the neighbours."""
    from freegeo.evidence.matches import ALL_PAIRS_UP_TO, choose_pairs

    if count <= ALL_PAIRS_UP_TO:
        return choose_pairs(count)
    first = np.arange(count)
    pairs = [np.stack((first, (first + step) % count), axis=1) for step in (1, 2, 4)]
    return np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0).astype(np.int64)


def check_convention(known: KnownCameras, matches: Matches, *, K: np.ndarray | None = None) -> Convention:
    """Judge how known cameras were read by the matches between their photos.

    Accepted: the reading is the best of the four, its median epipolar error is below 2 px, and the second has three
    times as much or puts the points behind the cameras. With few matches, no baseline or a flat scene the readings
    cannot be told apart, and nothing is checked.

    Args:
        known: of the photos that were matched, without distortion (`freegeo.cameras.undistortion.undistorted`).
        matches: of the same photos in the same order, such as `find_matches(photos, pairs_to_check(len(photos)))`.
        K: (S, 3, 3) intrinsics for photos that have none, counted like `KnownCamera.K`, such as those of a prediction;
            None: one focal length is fitted under each reading.

    Raises:
        ValueError: another number of photos was matched, or a lens still has distortion.
    """
    if len(known) != len(matches):
        raise ValueError(f"cameras of {len(known)} photos and matches of {len(matches)}")
    if any(one.lens is not None for one in known.cameras):
        raise ValueError("the cameras have distortion: undistort the photos before they are matched")
    posed = known.has_pose
    usable = matches.only(np.flatnonzero(posed[matches.pairs].all(axis=1)))
    trial = _Trial.of(known, usable, K)
    results = {reading: trial.best(reading) for reading in READINGS}
    judged = results[known.convention].per_pair
    values = {
        "reading": known.convention,
        "errors": {reading: result.error for reading, result in results.items()},
        "behind": {reading: result.behind for reading, result in results.items()},
        "pairs": int((~np.isnan(judged)).sum()),
        "matches": len(usable.ends),
    }
    outcome, sentence = _verdict(known, usable, Convention(**values, outcome="unchecked", sentence=""), judged)
    return Convention(**values, outcome=outcome, sentence=sentence)


def _verdict(known: KnownCameras, matches: Matches, found: Convention, judged: np.ndarray) -> tuple[Outcome, str]:
    source, own = known.source, found.reading
    count = int(known.has_pose.sum())
    if count < 2:
        return "unchecked", f"{source}: {count} of {len(known)} photos have a pose, so that poses cannot be checked."
    if len(matches.ends) < FEWEST_MATCHES or not found.pairs:
        return "unchecked", (
            f"{source}: not enough matches between the photos to check the cameras ({len(matches.ends)} in "
            f"{found.pairs} pairs). Look at the result, or give photos that overlap more."
        )
    ranked = {reading: np.inf if found.behind[reading] else error for reading, error in found.errors.items()}
    best = min(ranked, key=ranked.__getitem__)
    if _same_cameras(known, matches.pairs, best, own):
        best = own
    rivals = [reading for reading in READINGS if not _same_cameras(known, matches.pairs, best, reading)]
    second = min(rivals or set(READINGS) - {best}, key=ranked.__getitem__)
    decided = ranked[best] * CLEARLY <= ranked[second]
    if ranked[best] >= LARGEST_PX:
        return "refused", (
            f"{source}: the cameras do not fit these photos under any reading ({found.numbers()}; at most "
            f"{LARGEST_PX:g} px). They are of other photos or in another order, have mixed units, mirrored axes or "
            "wrong intrinsics; correct them, or give --trust-cameras if they are right."
        )
    if not decided and float(np.median(matches.flatness)) >= FLAT:
        return "unchecked", (
            f"{source}: the photos hardly move, or show one plane, so that the cameras cannot be checked "
            f"({found.numbers()})."
        )
    if not decided:
        return "refused", (
            f"{source}: the matches do not tell two readings of the cameras apart ({found.numbers()}; the best must be "
            f"{CLEARLY:g} times better). Give --trust-cameras if they are right."
        )
    if best != own:
        return "refused", (
            f"{source}: the cameras do not fit as {READINGS[own]}, as this file was read; they fit as {READINGS[best]} "
            f"({found.numbers()}). Add --cameras-convention {best}."
        )
    if odd := _odd_photos(known, matches, judged):
        return "refused", (
            f"{source}: the cameras of {len(odd)} of {count} photos do not fit the others: {some_of(odd)}. Correct "
            "them or take them out of the file, or give --trust-cameras if they are right."
        )
    return "accepted", (
        f"{source}: the cameras fit as {READINGS[own]}: {found.errors[own]:.2g} px in {found.pairs} pairs of photos, "
        f"the next reading {found.errors[second]:.2g} px"
        + (" with the points behind the cameras." if found.behind[second] else ".")
    )


def _same_cameras(known: KnownCameras, pairs: np.ndarray, reading: str, another: str) -> bool:
    """Whether two readings have the same relative poses, but for a degree or two, so that the choice is no matter.

    Straight ahead without a turn, world-to-camera with OpenCV axes is camera-to-world with OpenGL axes, the world
    flipped.
    """
    poses = {view: one.T_cam_world for view, one in enumerate(known.cameras) if one.T_cam_world is not None}
    matrices = {view: matrix_of(T, known.convention) for view, T in poses.items()}
    turns, ways = [], []
    for i, j in pairs.tolist():
        one, two = (pose_of(matrices[j], r) @ _inverse(pose_of(matrices[i], r)) for r in (reading, another))
        cosine = (np.trace(one[:3, :3].T @ two[:3, :3]) - 1) / 2
        turns.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        lengths = np.linalg.norm(one[:3, 3]) * np.linalg.norm(two[:3, 3])
        cosine = one[:3, 3] @ two[:3, 3] / lengths if lengths > 0 else 1.0
        ways.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return max(turns) < SAME_TURN_DEG and max(ways) < SAME_WAY_DEG


def _odd_photos(known: KnownCameras, matches: Matches, errors: np.ndarray) -> list[str]:
    """Return names of the photos whose cameras do not fit the others', although most pairs of photos fit.

    A few pairs are wrongly verified, as the two sides of a symmetric thing are; therefore a photo is odd when most of
    its pairs have a large error, or when it belongs to a group that only such pairs join to the largest group.
    """
    judged = ~np.isnan(errors)
    pairs, good = matches.pairs[judged], errors[judged] < LARGEST_PX
    odd = set()
    for view in range(len(known)):
        own = good[(pairs == view).any(axis=1)]
        if len(own) >= OF_A_PHOTO and own.mean() < MOST_GOOD:
            odd.add(view)
    group = np.arange(len(known))
    for i, j in pairs[good]:
        group[group == group[j]] = group[i]
    largest = np.bincount(group).argmax()
    for number in np.unique(group[group != largest]):
        inside = group[pairs] == number
        if (inside[:, 0] != inside[:, 1]).sum() >= OF_A_PHOTO:
            odd |= set(np.flatnonzero(group == number).tolist())
    return [known.names[view] for view in sorted(odd)]


@dataclass(frozen=True, kw_only=True)
class _Fit:
    error: float
    per_pair: np.ndarray
    behind: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class _Trial:
    """Poses and intrinsics under trial against matches of the views that have a pose."""

    matrices: np.ndarray
    """(S, 4, 4) as in the file; identity where there is none."""
    K: np.ndarray
    """(S, 3, 3) counted from the corner; unknown focal lengths are 1."""
    free: np.ndarray
    """(S,) bool: the focal length is not known."""
    matches: Matches

    @classmethod
    def of(cls, known: KnownCameras, matches: Matches, K: np.ndarray | None) -> _Trial:
        poses = np.stack([np.eye(4) if one.T_cam_world is None else one.T_cam_world for one in known.cameras])
        intrinsics, free = [], []
        for view, one in enumerate(known.cameras):
            given = one.K if one.K is not None else None if K is None else np.asarray(K[view], np.float64)
            height, width = matches.photo_hw[view]
            intrinsics.append(np.array([[1, 0, width / 2], [0, 1, height / 2], [0, 0, 1]]) if given is None else given)
            free.append(given is None)
        return cls(
            matrices=matrix_of(poses, known.convention), K=np.stack(intrinsics), free=np.array(free), matches=matches
        )

    def best(self, reading: str) -> _Fit:
        """Try a reading, with the focal length that fits it best where some are unknown."""
        if not self.free.any() or not len(self.matches.pairs):
            return self._fit(reading, 1.0)
        few = replace(self, matches=_thinned(self.matches, SEARCHED_MATCHES))
        (low, high), focal = np.log(_FOCAL_RANGE), 1.0
        for _ in range(3):
            tried = np.linspace(low, high, 9)
            errors = [few._scores(reading, float(np.exp(value)))[0].median for value in tried]
            k = int(np.argmin(np.nan_to_num(errors, nan=np.inf)))
            focal, low, high = float(np.exp(tried[k])), tried[max(k - 1, 0)], tried[min(k + 1, len(tried) - 1)]
        return self._fit(reading, focal)

    def _fit(self, reading: str, focal: float) -> _Fit:
        scores, candidate = self._scores(reading, focal)
        behind = self._behind(candidate.T_cam_world.numpy(), candidate.K.numpy())
        return _Fit(error=scores.median, per_pair=scores.values, behind=behind)

    def _scores(self, reading: str, focal: float) -> tuple[PairScores, Candidate]:
        """Score a reading with a focal length, in longest sides, where it is unknown."""
        import torch

        from freegeo.evidence.candidate import Candidate
        from freegeo.evidence.scores import epipolar

        K = self.K.copy()
        K[self.free, [[0], [1]], [[0], [1]]] = focal * self.matches.photo_hw.max(axis=1)[self.free]
        K[:, :2, 2] -= 0.5  # pixel centres of matches are at whole numbers
        count = len(K)
        candidate = Candidate(
            T_cam_world=torch.from_numpy(pose_of(self.matrices, reading)),
            K=torch.from_numpy(K),
            depth_z=torch.zeros(count, 1, 1),
            scale_xy=torch.ones(count, 2, dtype=torch.float64),
            offset_xy=torch.zeros(count, 2, dtype=torch.float64),
        )
        return epipolar(candidate, self.matches), candidate

    def _behind(self, T: np.ndarray, K: np.ndarray) -> bool:
        """Whether most matched points of most pairs, met by the two rays, lie behind one of the cameras."""
        shares = []
        for pair, (i, j) in enumerate(self.matches.pairs):
            motion = T[j] @ _inverse(T[i])
            if np.linalg.norm(motion[:3, 3]) == 0:
                continue
            x, y = self.matches.of_pair(pair)
            first = _rays(x, K[i]) @ motion[:3, :3].T
            second = _rays(y, K[j])
            normal = np.cross(first, second)
            z_first = (np.cross(second, motion[:3, 3]) * normal).sum(1)
            z_second = (np.cross(first, motion[:3, 3]) * normal).sum(1)
            shares.append(float(((z_first > 0) & (z_second > 0)).mean()))
        return bool(shares) and float(np.median(shares)) < 0.5


def _thinned(matches: Matches, most: int) -> Matches:
    """Return at most so many matches of each pair, evenly spaced."""
    rows = [
        np.unique(np.linspace(low, high - 1, min(most, high - low)).astype(np.int64))
        for low, high in pairwise(matches.pair_start.tolist())
    ]
    start = np.concatenate(([0], np.cumsum([len(row) for row in rows]))).astype(np.int64)
    return replace(matches, ends=matches.ends[np.concatenate(rows)], pair_start=start)


def _rays(pixel: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Directions (n, 3) of pixels (n, 2)."""
    return np.concatenate((pixel, np.ones((len(pixel), 1))), axis=1) @ np.linalg.inv(K).T
