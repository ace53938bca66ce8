"""Verified matches between photos, made once for a scene: pixels of two photos that show the same point.

They come from the photos alone, so that no model and no adaptation has a part in them. Every photo is shrunk to
`MatchSettings.longest_side` (small ones stay as they are), keypoints are matched where each is the other's best by a
clear margin, and what one fundamental matrix explains is kept (MAGSAC++, Barath et al. 2020). What the numbers mean is
described in docs/evidence.md, "Matches".

Places are stored in pixels of the upright photo, centres at whole numbers. Errors are measured in *matching pixels*,
those of the shrunk photo: `match_hw` says how large it was.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from freegeo import files
from freegeo.errors import DamagedError
from freegeo.evidence.features import Extractor, Features, RootSift

if TYPE_CHECKING:
    from freegeo.types import PhotoLike

__all__ = [
    "ALL_PAIRS_UP_TO",
    "FILE_NAME",
    "MatchSettings",
    "Matches",
    "Outcome",
    "choose_pairs",
    "combined",
    "find_matches",
    "load_matches",
    "magsac",
    "stored_matches",
]

logger = logging.getLogger(__name__)

FILE_NAME = "matches.npz"
ALL_PAIRS_UP_TO = 16
"""Photos up to which all pairs are compared."""
VERSION = 1
_KINDS: dict[str, files.Kind] = {
    "format": ("iu", ()), "names": ("U", (-1,)), "fingerprint": ("U", ()), "photo_hw": ("i", (-1, 2)),
    "match_hw": ("i", (-1, 2)), "keypoints": ("f", (-1, 2)), "view_start": ("i", (-1,)), "pairs": ("i", (-1, 2)),
    "pair_start": ("i", (-1,)), "ends": ("i", (-1, 2)), "flatness": ("f", (-1,)), "tried": ("i", (-1, 2)),
    "outcome": ("i", (-1,)), "candidates": ("i", (-1,)),
}  # fmt: skip
_LEAST_SENSE = 0.6
"""Below this share of neighbouring matches that turn the same way one photo is a mirror image of the other."""


class Outcome(IntEnum):
    """What became of a pair of photos that was tried."""

    VERIFIED = 0
    FEW_KEYPOINTS = 1
    """One of the photos has hardly any texture (one colour, very dark, masked away)."""
    FEW_MATCHES = 2
    """The photos do not show the same things, or look too different."""
    NOT_VERIFIED = 3
    """The matches contradict each other: no fundamental matrix explains enough of them."""
    NO_MOTION = 4
    """The photos are the same picture: every point is where it was."""
    MIRRORED = 5
    """One photo is a mirror image of the other; places that look the same in a mirror match, and mislead."""


@dataclass(frozen=True, kw_only=True)
class MatchSettings:
    """How photos are matched."""

    longest_side: int = 1024
    """Photos are shrunk to this many pixels; smaller ones stay as they are."""
    ratio: float = 0.85
    """Largest distance of a match as a share of the second best, in both directions."""
    threshold_px: float = 1.0
    """Largest distance from the epipolar line, matching pixels."""
    confidence: float = 0.999
    iterations: int = 5000
    """Most hypotheses for a pair."""
    fewest: int = 15
    """A pair with fewer verified matches counts as none."""
    least_motion_px: float = 1.0
    """A pair whose matches move less, in the median, is the same picture."""
    seed: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class Matches:
    """Verified matches of S photos; each joins a keypoint of a view to one of another view."""

    names: tuple[str, ...]
    photo_hw: np.ndarray
    """(S, 2) int64 height and width of the photos."""
    match_hw: np.ndarray
    """(S, 2) int64 height and width of the shrunk photos."""
    keypoints: np.ndarray
    """(N, 2) float64 photo pixels, column and row: all keypoints of view 0, then of view 1, ...; no place twice."""
    view_start: np.ndarray
    """(S + 1,) int64: the keypoints of view s are rows `view_start[s]` to `view_start[s + 1]`."""
    pairs: np.ndarray
    """(P, 2) int64 views with enough verified matches, the lower first."""
    pair_start: np.ndarray
    """(P + 1,) int64: the matches of pair p are rows `pair_start[p]` to `pair_start[p + 1]`."""
    ends: np.ndarray
    """(M, 2) int64 rows of `keypoints`: the match's ends in the first and in the second view."""
    flatness: np.ndarray
    """(P,) share of a pair's matches that a homography explains: near 1 for a turn on the spot or a flat scene, where
    matches say nothing certain about the direction of the translation."""
    tried: np.ndarray
    """(Q, 2) int64 pairs that were compared."""
    outcome: np.ndarray
    """(Q,) int64 `Outcome` of each."""
    candidates: np.ndarray
    """(Q,) int64 matches before verification."""
    fingerprint: str
    """Of the shrunk photos, masks, settings, extractor and pairs."""

    def __len__(self) -> int:
        """Return the number of photos."""
        return len(self.names)

    def __repr__(self) -> str:
        """Return the counts, not the arrays."""
        return f"Matches({len(self)} photos, {len(self.pairs)} of {len(self.tried)} pairs, {len(self.ends)} matches)"

    @property
    def counts(self) -> np.ndarray:
        """(P,) matches of each pair."""
        return np.diff(self.pair_start)

    @property
    def pair_of(self) -> np.ndarray:
        """(M,) the pair of each match."""
        return np.repeat(np.arange(len(self.pairs)), self.counts)

    @property
    def view_of(self) -> np.ndarray:
        """(N,) the view of each keypoint."""
        return np.repeat(np.arange(len(self)), np.diff(self.view_start))

    def of_pair(self, pair: int) -> tuple[np.ndarray, np.ndarray]:
        """Photo pixels (n, 2) of a pair's matches in its first and in its second view."""
        first, second = self.ends[self.pair_start[pair] : self.pair_start[pair + 1]].T
        return self.keypoints[first], self.keypoints[second]

    def only(self, pairs: np.ndarray) -> Matches:
        """Return the matches of some pairs (indices, ascending); photos and keypoints stay."""
        rows = [np.arange(self.pair_start[pair], self.pair_start[pair + 1]) for pair in pairs]
        return replace(
            self,
            pairs=self.pairs[pairs],
            pair_start=np.concatenate(([0], np.cumsum([len(row) for row in rows]))).astype(np.int64),
            ends=self.ends[np.concatenate([*rows, np.zeros(0, np.int64)]).astype(np.int64)],
            flatness=self.flatness[pairs],
        )

    def in_matching_pixels(self) -> np.ndarray:
        """Return the keypoints (N, 2) float64 in pixels of the shrunk photos, centres at whole numbers."""
        view = self.view_of
        return (self.keypoints + 0.5) * (self.match_hw / self.photo_hw)[view][:, ::-1] - 0.5

    def reason(self) -> str | None:
        """Return why there is nothing to judge by, in one sentence; None when a pair is verified."""
        if len(self.pairs):
            return None
        if not len(self.tried):
            return "There is no pair of photos to compare."
        counts = np.bincount(self.outcome, minlength=len(Outcome))
        most = Outcome(int(counts.argmax()))
        return f"None of the {len(self.tried)} pairs of photos gave enough matches; most often, {_REASONS[most]}."

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the content of the file."""
        return {**{f.name: np.asarray(getattr(self, f.name)) for f in fields(self)}, "format": np.array(VERSION)}

    def save(self, file: Path) -> None:
        """Write the file atomically."""
        files.write_npz(file, self.arrays())


_REASONS = {
    Outcome.VERIFIED: "they were verified",
    Outcome.FEW_KEYPOINTS: "a photo shows hardly any texture",
    Outcome.FEW_MATCHES: "the two photos have too little in common",
    Outcome.NOT_VERIFIED: "the matches contradict each other",
    Outcome.NO_MOTION: "the two photos are the same picture",
    Outcome.MIRRORED: "one photo is a mirror image of the other",
}


def choose_pairs(
    views: int, share: np.ndarray | None = None, *, all_up_to: int = ALL_PAIRS_UP_TO, partners: int = 8
) -> np.ndarray:
    """Return the pairs of views (Q, 2) int64 to compare, lower index first, sorted.

    Args:
        views: number of photos.
        share: (S, S) share of each view's pixels that the other view sees, from the frozen prediction
            (`freegeo.evidence.dense.co_visible`); needed with more than `all_up_to` views.
        all_up_to: so many views are compared in all pairs.
        partners: with more, each view is compared with so many that see the most of it.

    Raises:
        ValueError: more than `all_up_to` views without `share`.
    """
    if views <= all_up_to:
        return np.stack(np.triu_indices(views, 1), axis=1).astype(np.int64)
    if share is None:
        raise ValueError(f"{views} views need the shares of what they see in common to choose pairs from.")
    common = np.minimum(share, share.T).astype(np.float64)
    np.fill_diagonal(common, -np.inf)
    best = np.argsort(-common, axis=1, kind="stable")[:, :partners]
    first, second = np.repeat(np.arange(views), best.shape[1]), best.ravel()
    return np.unique(np.sort(np.stack((first, second), axis=1), axis=1), axis=0).astype(np.int64)


def find_matches(
    photos: Sequence[PhotoLike],
    pairs: np.ndarray | None = None,
    *,
    masks: Sequence[np.ndarray] | None = None,
    settings: MatchSettings | None = None,
    extractor: Extractor | None = None,
) -> Matches:
    """Match photos and verify the matches.

    Photos without texture, identical photos and pairs with nothing in common have no evidence (`Matches.outcome`);
    they are no error.

    Args:
        photos: read one after the other.
        pairs: (Q, 2) views to compare, from `choose_pairs`; None: all.
        masks: one (H, W) array for each photo at its size; keypoints only where it is not 0.
        settings: None: the defaults.
        extractor: None: root-SIFT.
    """
    return _matched(_prepare(photos, pairs, masks, settings, extractor))


def stored_matches(
    file: Path,
    photos: Sequence[PhotoLike],
    pairs: np.ndarray | None = None,
    *,
    masks: Sequence[np.ndarray] | None = None,
    settings: MatchSettings | None = None,
    extractor: Extractor | None = None,
) -> Matches:
    """Return the matches stored in `file` if they are those of these photos and settings, else make and store them."""
    job = _prepare(photos, pairs, masks, settings, extractor)
    found = load_matches(file)
    if found is not None and found.fingerprint == job.fingerprint:
        return found
    made = _matched(job)
    made.save(file)
    return made


def load_matches(file: Path) -> Matches | None:
    """Read stored matches; None when there are none, or the file is damaged or of another version."""
    if not file.is_file():
        return None
    try:
        if int(files.read_npz(file, {"format": _KINDS["format"]})["format"]) != VERSION:
            return None
        arrays = files.read_npz(file, _KINDS)
        names, fingerprint = tuple(arrays.pop("names").tolist()), str(arrays.pop("fingerprint"))
        del arrays["format"]
        found = Matches(names=names, fingerprint=fingerprint, **arrays)
        if not _is_sound(found):
            raise DamagedError(file, "its numbers do not fit each other", files.AGAIN)
    except DamagedError as error:
        logger.warning("%s: the stored matches are damaged (%s); the photos are matched again.", file, error.reason)
        return None
    return found


def combined(parts: Sequence[Matches], names: Sequence[str]) -> Matches:
    """Put matches of overlapping parts of a scene together: those of the photos `names`, in that order.

    A place of a photo is one keypoint, whatever parts have it, and of a pair that several parts have, the first counts.
    Every photo is in one of the parts.
    """
    number_of = {name: view for view, name in enumerate(names)}
    views = [np.array([number_of.get(name, -1) for name in part.names]) for part in parts]
    photo_hw, match_hw = np.zeros((2, len(names), 2), np.int64)
    for part, own in zip(parts, views, strict=True):
        photo_hw[own[own >= 0]], match_hw[own[own >= 0]] = part.photo_hw[own >= 0], part.match_hw[own >= 0]
    rows = [np.column_stack((own[part.view_of], part.keypoints)) for part, own in zip(parts, views, strict=True)]
    places, place_of = np.unique(np.concatenate(rows), axis=0, return_inverse=True)
    others = int(np.searchsorted(places[:, 0], 0))  # Keypoints of photos that are not wanted come first.
    place_of, places = place_of.reshape(-1) - others, places[others:]
    pairs: dict[tuple[int, int], tuple[np.ndarray, float]] = {}
    tried: dict[tuple[int, int], tuple[int, int]] = {}
    first = 0
    for part, own in zip(parts, views, strict=True):
        for pair, (a, b) in enumerate(own[part.pairs].tolist()):
            ends = place_of[first + part.ends[part.pair_start[pair] : part.pair_start[pair + 1]]]
            if min(a, b) >= 0:
                pairs.setdefault((min(a, b), max(a, b)), (ends if a < b else ends[:, ::-1], part.flatness[pair]))
        for (a, b), *facts in zip(own[part.tried].tolist(), part.outcome, part.candidates, strict=True):
            if min(a, b) >= 0:
                tried.setdefault((min(a, b), max(a, b)), (int(facts[0]), int(facts[1])))
        first += len(part.keypoints)
    ordered, compared = sorted(pairs), sorted(tried)
    return Matches(
        names=tuple(names), photo_hw=photo_hw, match_hw=match_hw, keypoints=places[:, 1:],
        view_start=np.searchsorted(places[:, 0], np.arange(len(names) + 1)),
        pairs=np.array(ordered, np.int64).reshape(-1, 2),
        pair_start=np.cumsum([0, *(len(pairs[pair][0]) for pair in ordered)]),
        ends=np.concatenate([np.zeros((0, 2), np.int64), *(pairs[pair][0] for pair in ordered)]),
        flatness=np.array([pairs[pair][1] for pair in ordered], float),
        tried=np.array(compared, np.int64).reshape(-1, 2),
        outcome=np.array([tried[pair][0] for pair in compared], np.int64),
        candidates=np.array([tried[pair][1] for pair in compared], np.int64),
        fingerprint=hashlib.sha256("".join(part.fingerprint for part in parts).encode()).hexdigest(),
    )  # fmt: skip


def _is_sound(found: Matches) -> bool:
    """Whether there is everything of each photo, pair and match, and every number points to something that exists."""
    views, pairs, tried = len(found), len(found.pairs), len(found.tried)
    counts = (
        (found.photo_hw, views), (found.match_hw, views), (found.view_start, views + 1), (found.pair_start, pairs + 1),
        (found.flatness, pairs), (found.outcome, tried), (found.candidates, tried),
    )  # fmt: skip
    if any(len(values) != count for values, count in counts):
        return False
    starts = ((found.view_start, len(found.keypoints)), (found.pair_start, len(found.ends)))
    ordered = all(s[0] == 0 and s[-1] == count and (np.diff(s) >= 0).all() for s, count in starts)
    places = ((found.pairs, views), (found.tried, views), (found.ends, len(found.keypoints)))
    inside = all((values >= 0).all() and (values < count).all() for values, count in places)
    known = np.isin(found.outcome, [int(outcome) for outcome in Outcome]).all()
    return bool(ordered and inside and known and np.isfinite(found.keypoints).all())


@dataclass(frozen=True, kw_only=True)
class _Job:
    names: tuple[str, ...]
    photo_hw: np.ndarray
    images: list[np.ndarray]
    masks: list[np.ndarray | None]
    pairs: np.ndarray
    settings: MatchSettings
    extractor: Extractor
    fingerprint: str = field(repr=False)


def _prepare(
    photos: Sequence[PhotoLike],
    pairs: np.ndarray | None,
    masks: Sequence[np.ndarray] | None,
    settings: MatchSettings | None,
    extractor: Extractor | None,
) -> _Job:
    settings, extractor = settings or MatchSettings(), extractor or RootSift()
    if masks is not None and len(masks) != len(photos):
        raise ValueError(f"{len(masks)} masks for {len(photos)} photos")
    pairs = choose_pairs(len(photos), all_up_to=len(photos)) if pairs is None else np.asarray(pairs, dtype=np.int64)
    digest = hashlib.sha256(json.dumps([VERSION, extractor.name, asdict(settings), pairs.tolist()]).encode())
    images, small_masks, sizes = [], [], []
    for view, photo in enumerate(photos):
        pixels = photo.read()
        image = _shrunk(pixels, settings.longest_side)
        mask = None if masks is None else _shrunk_mask(np.asarray(masks[view]), pixels.shape[:2], image.shape[:2])
        images.append(image)
        small_masks.append(mask)
        sizes.append(pixels.shape[:2])
        digest.update(json.dumps([photo.name, *pixels.shape, *image.shape, mask is not None]).encode())
        digest.update(image.tobytes())
        digest.update(b"" if mask is None else mask.tobytes())
    return _Job(
        names=tuple(photo.name for photo in photos),
        photo_hw=np.array(sizes, dtype=np.int64).reshape(-1, 2),
        images=images,
        masks=small_masks,
        pairs=pairs,
        settings=settings,
        extractor=extractor,
        fingerprint=digest.hexdigest()[:32],
    )


def _shrunk(pixels: np.ndarray, longest: int) -> np.ndarray:
    import cv2

    height, width = pixels.shape[:2]
    factor = longest / max(height, width)
    if factor >= 1:
        return np.ascontiguousarray(pixels)
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def _shrunk_mask(mask: np.ndarray, photo_hw: tuple[int, int], match_hw: tuple[int, int]) -> np.ndarray:
    if mask.shape != photo_hw:
        raise ValueError(f"a mask of the size {mask.shape} for a photo of {photo_hw}")
    row, column = (
        np.minimum(((np.arange(small) + 0.5) * large / small).astype(np.int64), large - 1)
        for small, large in zip(match_hw, photo_hw, strict=True)
    )
    return mask[row[:, None], column] != 0


@dataclass(frozen=True, kw_only=True)
class _View:
    """One photo's features, and the row of its unique keypoints that each of them is at."""

    features: Features
    place: np.ndarray
    unique: np.ndarray


def _matched(job: _Job) -> Matches:
    views = [_view(job.extractor.extract(image, mask)) for image, mask in zip(job.images, job.masks, strict=True)]
    view_start = np.concatenate(([0], np.cumsum([len(view.unique) for view in views]))).astype(np.int64)
    match_hw = np.array([image.shape[:2] for image in job.images], dtype=np.int64).reshape(-1, 2)
    outcome, candidates, pairs, ends, flatness = [], [], [], [], []
    for i, j in job.pairs.tolist():
        rows = _mutual(views[i], views[j], job.settings)
        what, kept, flat = _verified(views[i], views[j], rows, match_hw[[i, j]], job.settings)
        outcome.append(int(what))
        candidates.append(len(rows))
        if what is Outcome.VERIFIED:
            pairs.append((i, j))
            ends.append(kept + view_start[[i, j]])
            flatness.append(flat)
    scale = (job.photo_hw / match_hw)[:, ::-1]
    keypoints = [(view.unique + 0.5) * scale[s] - 0.5 for s, view in enumerate(views)]
    return Matches(
        names=job.names,
        photo_hw=job.photo_hw,
        match_hw=match_hw,
        keypoints=np.concatenate(keypoints) if keypoints else np.zeros((0, 2)),
        view_start=view_start,
        pairs=np.array(pairs, dtype=np.int64).reshape(-1, 2),
        pair_start=np.concatenate(([0], np.cumsum([len(e) for e in ends]))).astype(np.int64),
        ends=np.concatenate(ends) if ends else np.zeros((0, 2), np.int64),
        flatness=np.array(flatness, dtype=np.float64),
        tried=job.pairs,
        outcome=np.array(outcome, dtype=np.int64),
        candidates=np.array(candidates, dtype=np.int64),
        fingerprint=job.fingerprint,
    )


def _view(features: Features) -> _View:
    unique, place = np.unique(features.pixel.astype(np.float64), axis=0, return_inverse=True)
    return _View(features=features, place=place.reshape(-1), unique=unique.reshape(-1, 2))


def _mutual(first: _View, second: _View, settings: MatchSettings) -> np.ndarray:
    """Places (n, 2) of each view's unique keypoints that are each other's clear best, the clearest first."""
    import torch

    if min(len(first.place), len(second.place)) < 2:
        return np.zeros((0, 2), np.int64)
    alike = torch.from_numpy(first.features.descriptor) @ torch.from_numpy(second.features.descriptor).T
    forth, there = alike.max(dim=1)
    back = alike.max(dim=0).indices
    rows = torch.nonzero(back[there] == torch.arange(len(there)))[:, 0]
    columns, best = there[rows], forth[rows]
    each = torch.arange(len(rows))
    others_of_row, others_of_column = alike[rows], alike[:, columns]
    others_of_row[each, columns] = -1
    others_of_column[rows, each] = -1
    second_best = torch.maximum(others_of_row.max(dim=1).values, others_of_column.max(dim=0).values)
    # Descriptors have unit length: the squared distance is 2 - 2 times the inner product.
    share = (1 - best).clamp(min=0) / (1 - second_best).clamp(min=1e-9)
    clear = torch.nonzero(share < settings.ratio**2)[:, 0]
    order = clear[torch.argsort(share[clear], stable=True)]
    places = np.stack((first.place[rows[order].numpy()], second.place[columns[order].numpy()]), axis=1)
    # A place with two orientations may match twice: of each place only the clearest match stays.
    for side in (0, 1):
        places = places[np.sort(np.unique(places[:, side], return_index=True)[1])]
    return places


def _verified(
    first: _View, second: _View, rows: np.ndarray, match_hw: np.ndarray, settings: MatchSettings
) -> tuple[Outcome, np.ndarray, float]:
    """Return the outcome of a pair, its verified rows and its flatness."""
    nothing = np.zeros((0, 2), np.int64)
    if min(len(first.unique), len(second.unique)) < settings.fewest:
        return Outcome.FEW_KEYPOINTS, nothing, 0.0
    if len(rows) < settings.fewest:
        return Outcome.FEW_MATCHES, nothing, 0.0
    x, y = first.unique[rows[:, 0]], second.unique[rows[:, 1]]
    size = match_hw[:, ::-1].astype(np.float64)
    moved = np.linalg.norm((x + 0.5) / size[0] * size[1] - (y + 0.5), axis=1)
    if np.median(moved) < settings.least_motion_px:
        return Outcome.NO_MOTION, nothing, 0.0
    inlier = _explained(x, y, settings)
    if inlier.sum() < settings.fewest:
        return Outcome.NOT_VERIFIED, nothing, 0.0
    x, y = x[inlier], y[inlier]
    if _sense(x, y) < _LEAST_SENSE:
        return Outcome.MIRRORED, nothing, 0.0
    return Outcome.VERIFIED, rows[inlier], _flatness(x, y, settings)


def _sense(x: np.ndarray, y: np.ndarray) -> float:
    """Share of the triples of neighbouring matches (n, 2) that turn the same way in both photos.

    Near 1 for two views of a scene and near 0 where one photo is mirrored: things that look the same in a mirror match,
    and satisfy a fundamental matrix.
    """
    from scipy.spatial import KDTree

    near = KDTree(x).query(x, k=4)[1]
    triples = np.concatenate([near[:, (0, a, b)] for a, b in ((1, 2), (2, 3), (1, 3))])
    turns = []
    for pixel in (x, y):
        (a, b), (c, d) = ((pixel[triples[:, k]] - pixel[triples[:, 0]]).T for k in (1, 2))
        turns.append(a * d - b * c)
    return float((turns[0] * turns[1] > 0).mean())


def _explained(x: np.ndarray, y: np.ndarray, settings: MatchSettings) -> np.ndarray:
    """Which matches (n,) the best fundamental matrix explains; none where OpenCV finds none."""
    import cv2

    none = np.zeros(len(x), dtype=bool)
    try:
        matrix, mask = cv2.findFundamentalMat(x, y, magsac(settings, settings.threshold_px))
    except cv2.error:
        # OpenCV 5.0 raises on some degenerate sets of matches: such a pair is no evidence.
        return none
    return none if matrix is None or matrix.shape != (3, 3) or mask is None else mask.ravel() > 0


def _flatness(x: np.ndarray, y: np.ndarray, settings: MatchSettings) -> float:
    """Share of matches that one homography explains."""
    import cv2

    try:
        matrix, mask = cv2.findHomography(x, y, magsac(settings, 2 * settings.threshold_px))
    except cv2.error:
        return 0.0
    return 0.0 if matrix is None or mask is None else float((mask.ravel() > 0).mean())


def magsac(settings: MatchSettings, threshold: float):
    """Return the parameters of OpenCV for MAGSAC++ with a threshold in pixels."""
    import cv2

    chosen = cv2.UsacParams()
    chosen.threshold, chosen.confidence, chosen.maxIterations = threshold, settings.confidence, settings.iterations
    chosen.score, chosen.loMethod, chosen.final_polisher = cv2.SCORE_METHOD_MAGSAC, cv2.LOCAL_OPTIM_SIGMA, cv2.MAGSAC
    chosen.randomGeneratorState, chosen.isParallel = settings.seed, False
    return chosen
