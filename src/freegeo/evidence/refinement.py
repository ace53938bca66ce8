"""Cameras refined by bundle adjustment of matches, accepted only when matches that had no part in it agree better.

What is refused, and what refinement gains, is described in docs/refinement.md. Lengths keep the prediction's scale: the
median depth of the tracks is that of the predicted depth maps.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from freegeo.evidence.bundle import (
    BundleSettings,
    Solution,
    Start,
    cluster,
    depth_of,
    measure,
    shared_cameras,
    solve,
)
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.matches import Matches
from freegeo.evidence.scores import depth_at, epipolar
from freegeo.evidence.tracks import MeasuredTracks, join_matches
from freegeo.export.reconstruction import Reconstruction
from freegeo.fusion.tracks import Tracks
from freegeo.geometry.se3 import inverse, relative, transform_points

__all__ = [
    "MeasuredDepth",
    "RefineSettings",
    "Refinement",
    "bring_depth",
    "depth_factors",
    "depth_misfit",
    "measured_depth",
    "parallax_px",
    "refine",
]

logger = logging.getLogger(__name__)

FLOOR_PX = 0.05
"""Added to errors before their logarithm is taken: below it, differences are noise."""
FOCAL_CHANGE = 2.0
"""Largest factor, up or down, between the predicted and the refined focal length."""
FOCAL_RANGE = (0.3, 10.0)
"""Smallest and largest focal length, in longer sides of the photo."""
DEPTH_SPREAD = 0.25
"""Largest disagreement between refined points and predicted depth, see `Solution.depth_spread`."""
FEWEST_DEPTHS = 5
"""A view with fewer tracks has no depth factor of its own."""
MOST_TURNS = 40_000
"""Pairs of views by which mirror images are told; of more, a seeded choice."""
FEWEST_AFFINE = 20
"""A view with fewer tracks has no affine correction of its own."""


@dataclass(frozen=True, kw_only=True)
class RefineSettings:
    """What is asked of a refinement."""

    bundle: BundleSettings = field(default_factory=BundleSettings)
    folds: int = 4
    """The pairs of views are held out in so many turns."""
    probability: float = 0.9
    """At least so often the held-out pairs must fit better, on average, when pairs are drawn anew."""
    draws: int = 200
    """How often pairs are drawn."""
    fewest_pairs: int = 6
    """Fewer pairs cannot judge."""
    coverage: float = 0.75
    """Share of the photos that must be refined."""
    parallax_px: float = 1.0
    """Matching pixels that matches must move, in the median, beyond what a turn of the camera explains."""
    good: float = 0.5
    """Share of the observations that must fit in the end."""
    proven: float = 0.5
    """More than this share of the held-out pairs must fit to `proven_px`. Where photos hang together in a chain, none
    of them can be held out without losing photos: such cameras are a guess, however well they fit."""
    proven_px: float = 0.5
    """Median epipolar error, in matching pixels, of a held-out pair that fits."""
    seed: int = 0
    """Of the folds and draws."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Refinement:
    """Refined cameras of S views, and whether they are better than the predicted ones.

    Everything but `accepted` and `reason` is None when no cameras were found at all. A refused refinement may have
    cameras: they are for study, not for use.
    """

    accepted: bool
    reason: str
    """One sentence: why it is accepted, or why not."""
    T_cam_world: np.ndarray | None = None
    """(S, 4, 4) float64, in the world frame and at the scale of the prediction."""
    K: np.ndarray | None = None
    """(S, 3, 3) float64, pixels of the model's images, centres at whole numbers."""
    photo_K: np.ndarray | None = None
    """(S, 3, 3) float64, pixels of the photos, centres at whole numbers."""
    refined: np.ndarray | None = None
    """(S,) bool; the other views follow the refined view that looks most like them."""
    focal_change: np.ndarray | None = None
    """(S,) refined focal length over the predicted one."""
    tracks: Tracks | None = None
    """Points that were measured in the photos, not re-projections of the prediction."""
    error_px: np.ndarray | None = None
    """(m,) matching pixels, of each observation of `tracks`."""
    share_good: float | None = None
    """Share of all observations that fit in the end; `tracks` holds only these."""
    depth_spread: float | None = None
    """How far predicted depth and tracks disagree beyond one factor (median absolute deviation of the logarithm)."""
    pairs: np.ndarray | None = None
    """(P, 2) pairs of views that judged."""
    before_px: np.ndarray | None = None
    """(P,) median epipolar error of each with the predicted cameras, matching pixels."""
    after_px: np.ndarray | None = None
    """(P,) the same with cameras from an adjustment in which the pair had no part."""
    probability: float | None = None
    """Share of bootstrap draws over pairs in which the held-out pairs fit better than before."""


def refine(reconstruction: Reconstruction, matches: Matches, settings: RefineSettings | None = None) -> Refinement:
    """Refine a prediction's cameras and focal lengths with matches of its photos.

    The cameras come from all pairs. They are judged by cross-validation: the pairs are split into folds, and each fold
    is judged with cameras that were adjusted, from the prediction, to the other folds only.

    Args:
        reconstruction: the prediction.
        matches: of the same photos, in the same order.
        settings: None: the defaults.

    Returns:
        The verdict; too little or misleading evidence is a verdict too, never an error.

    Raises:
        UserError: the prediction has no cameras, or pycolmap is not installed.
        ValueError: the matches belong to another number of photos.
    """
    settings = settings or RefineSettings()
    if len(reconstruction) != len(matches):
        raise ValueError(f"a reconstruction of {len(reconstruction)} views and matches of {len(matches)} photos")
    predicted = Candidate.of(reconstruction)
    start, camera = shared_cameras(reconstruction, settings.bundle.share_focal)
    tracks = join_matches(matches)
    trouble = matches.reason() or _before(start, matches, tracks, settings)
    if trouble:
        return Refinement(accepted=False, reason=trouble)
    found = solve(start, camera, matches, tracks, settings=settings.bundle)
    if found is None:
        return Refinement(accepted=False, reason="Bundle adjustment found no cameras that explain the matches.")
    solution, way = found
    result = _result(reconstruction, predicted, matches, solution)
    trouble = _after(predicted, matches, solution, result, settings)
    if trouble:
        return replace(result, reason=trouble)
    return _judged(result, predicted, start, camera, matches, way, settings)


def parallax_px(candidate: Candidate, matches: Matches) -> float:
    """By how much matches move beyond what a turn of the camera explains: matching pixels, median over pairs.

    Near the noise of the matches when all photos were taken from one place; then no depth and no translation can be
    measured. The best rotation of each pair is fitted to its matches, with the focal length that suits all of them best
    (within a quarter of the candidate's).
    """
    K = candidate.matching_K(*map(torch.from_numpy, (matches.photo_hw, matches.match_hw)))
    pixel = torch.from_numpy(matches.in_matching_pixels())
    view = torch.from_numpy(matches.view_of)
    pair = torch.from_numpy(matches.pair_of)
    focal = K[:, (0, 1), (0, 1)][view]
    centred = pixel - K[view, :2, 2]
    best = float("inf")
    for factor in np.geomspace(0.8, 1.25, 9):
        rays = torch.cat((centred / (focal * factor), torch.ones_like(centred[:, :1])), dim=-1)
        x, y = torch.nn.functional.normalize(rays, dim=-1)[torch.from_numpy(matches.ends)].unbind(1)
        products = torch.zeros(len(matches.pairs), 3, 3, dtype=torch.float64)
        products.index_add_(0, pair, y[:, :, None] * x[:, None])
        U, _, Vh = torch.linalg.svd(products)
        U[:, :, 2] *= torch.linalg.det(U @ Vh)[:, None]
        turned = ((U @ Vh)[pair] @ x[..., None])[..., 0]
        second = torch.from_numpy(matches.ends[:, 1])
        off = turned[:, :2] / turned[:, 2:] * focal[second] * factor - centred[second]
        moved = torch.linalg.vector_norm(off, dim=-1).numpy()
        medians = [np.median(part) for part in np.split(moved, matches.pair_start[1:-1])]
        best = min(best, float(np.median(medians)))
    return best


def bring_depth(
    reconstruction: Reconstruction, refinement: Refinement, *, affine: bool = False
) -> tuple[Reconstruction, tuple[str, ...]]:
    """Return the reconstruction with refined cameras and depth that fits them, and the names of views without tracks.

    Each view's depth is multiplied by one factor, the median of (depth of a track / predicted depth) over the tracks
    that it shows. A view with fewer than 5 tracks gets the median factor of the others. Cameras are not touched again.

    Args:
        reconstruction: the prediction that was refined.
        refinement: its accepted refinement.
        affine: fit 1/depth' = a / depth + b (least absolute deviations) in views with 20 tracks and more, where that
            keeps all depth positive.

    Raises:
        ValueError: the refinement was not accepted.
    """
    tracks, T_cam_world, K = _accepted(refinement)
    factors, own = depth_factors(reconstruction, refinement)
    depth_z = reconstruction.depth_z * factors[:, None, None].astype(np.float32)
    if affine:
        measured, predicted = _depths(reconstruction, tracks, T_cam_world)
        known = np.isfinite(measured) & np.isfinite(predicted)
        counts = np.bincount(tracks.view[known], minlength=len(reconstruction))
        for view in np.flatnonzero(counts >= FEWEST_AFFINE).tolist():
            rows = known & (tracks.view == view)
            depth_z[view] = _affine(
                reconstruction.depth_z[view], 1 / predicted[rows], 1 / measured[rows], depth_z[view]
            )
    without = tuple(reconstruction.names[view] for view in np.flatnonzero(~own))
    if without:
        logger.warning(
            "Too few matches for %d of %d photos (%s): they follow their neighbours and keep the median scale.",
            len(without), len(reconstruction), ", ".join(without),
        )  # fmt: skip
    moved = replace(reconstruction, depth_z=depth_z, T_cam_world=T_cam_world.astype(np.float32), K=K.astype(np.float32))
    return moved, without


def depth_factors(reconstruction: Reconstruction, refinement: Refinement) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much each view's depth is multiplied (S,), and whether it has tracks enough for that (S,) bool.

    As `bring_depth`, which also makes a reconstruction of it. ValueError for a refinement that was not accepted.
    """
    tracks, T_cam_world, _ = _accepted(refinement)
    return _view_factors(*_depths(reconstruction, tracks, T_cam_world), tracks.view, len(reconstruction))


def _accepted(refinement: Refinement) -> tuple[Tracks, np.ndarray, np.ndarray]:
    """Return tracks, extrinsics and intrinsics."""
    tracks, T_cam_world, K = refinement.tracks, refinement.T_cam_world, refinement.K
    if not refinement.accepted or tracks is None or T_cam_world is None or K is None:
        raise ValueError(f"a refinement that was not accepted is not used: {refinement.reason}")
    return tracks, T_cam_world, K


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredDepth:
    """Depth brought to points that matches measure with known cameras."""

    depth_z: np.ndarray
    """(S, H, W) float32."""
    factors: np.ndarray
    """(S,) by which each view's depth was multiplied."""
    own: np.ndarray
    """(S,) bool: views with enough points for a factor of their own; the others have the median one."""
    points: int
    """How many points were measured."""


def measured_depth(
    reconstruction: Reconstruction, matches: Matches, settings: BundleSettings | None = None
) -> MeasuredDepth | None:
    """Bring depth to what matches measure with a reconstruction's cameras, which are known and stay as they are.

    Each view's depth is multiplied as by `bring_depth`. None with fewer than 30 points, or none where depth is known.
    """
    settings = settings or BundleSettings()
    if not len(matches.pairs):
        return None
    candidate = Candidate.of(reconstruction)
    tracks, xyz = measure(candidate, matches, settings)
    if len(tracks) < settings.fewest_tracks:
        return None
    measured = transform_points(candidate.T_cam_world[tracks.view], torch.from_numpy(xyz)[tracks.point])[:, 2].numpy()
    factors, own = _view_factors(measured, depth_of(candidate, tracks).numpy(), tracks.view, len(reconstruction))
    if not own.any():
        return None
    depth_z = (reconstruction.depth_z * factors[:, None, None]).astype(np.float32)
    return MeasuredDepth(depth_z=depth_z, factors=factors, own=own, points=len(tracks))


def _view_factors(
    measured: np.ndarray, predicted: np.ndarray, view: np.ndarray, views: int
) -> tuple[np.ndarray, np.ndarray]:
    """Factor (S,) of each view, the median of measured / predicted depth (m,) of the observations of views `view` (m,).

    Views with few get the median of the others; the mask (S,) says which have one of their own.
    """
    known = np.isfinite(measured) & np.isfinite(predicted)
    own = np.bincount(view[known], minlength=views) >= FEWEST_DEPTHS
    factors = np.full(views, np.nan)
    for one in np.flatnonzero(own).tolist():
        rows = known & (view == one)
        factors[one] = np.median(measured[rows] / predicted[rows])
    factors[~own] = np.median(factors[own]) if own.any() else 1.0
    return factors, own


def depth_misfit(reconstruction: Reconstruction, refinement: Refinement) -> float:
    """How badly predicted depth fits the tracks of an accepted refinement, whatever the factor of each view.

    Mean over the views with 5 tracks and more of the median absolute deviation of log(depth of a track / predicted
    depth); nan without such a view.
    """
    tracks, T_cam_world = refinement.tracks, refinement.T_cam_world
    assert tracks is not None and T_cam_world is not None
    measured, predicted = _depths(reconstruction, tracks, T_cam_world)
    log = np.log(measured / predicted)
    found = []
    for view in range(len(reconstruction)):
        own = log[(tracks.view == view) & np.isfinite(log)]
        if len(own) >= FEWEST_DEPTHS:
            found.append(np.median(np.abs(own - np.median(own))))
    return float(np.mean(found)) if found else float("nan")


def _before(start: Candidate, matches: Matches, tracks: MeasuredTracks, settings: RefineSettings) -> str | None:
    """Return why the matches are too few to begin with."""
    bundle = settings.bundle
    if len(tracks) < bundle.fewest_tracks:
        return f"Only {len(tracks)} points could be followed between the photos; {bundle.fewest_tracks} are needed."
    together = int(cluster(tracks, len(matches), bundle.joined).sum())
    if together < settings.coverage * len(matches):
        return f"Only {together} of {len(matches)} photos hang together by matches."
    if len(matches.pairs) < settings.fewest_pairs:
        return f"Only {len(matches.pairs)} pairs of photos have matches; {settings.fewest_pairs} are needed to judge."
    parallax = parallax_px(start, matches)
    if parallax < settings.parallax_px:
        return (
            f"The photos were taken from one place: a turn of the camera explains the matches ({parallax:.1f} px), so "
            "that they say nothing about positions."
        )
    return None


def _after(
    predicted: Candidate, matches: Matches, solution: Solution, result: Refinement, settings: RefineSettings
) -> str | None:
    """Return what is wrong with a solution."""
    refined = int(solution.refined.sum())
    if refined < settings.coverage * len(matches):
        return f"Only {refined} of {len(matches)} photos fit together in the end."
    if len(solution.tracks) < settings.bundle.fewest_tracks:
        return f"Only {len(solution.tracks)} points fit in the end; {settings.bundle.fewest_tracks} are needed."
    if solution.good < settings.good:
        return f"Only {solution.good:.0%} of the matched pixels fit in the end."
    assert result.focal_change is not None and result.photo_K is not None
    change = float(result.focal_change[np.abs(np.log(result.focal_change)).argmax()])
    shape = result.photo_K[:, 0, 0] / matches.photo_hw.max(axis=1)
    if not (
        1 / FOCAL_CHANGE <= change <= FOCAL_CHANGE and FOCAL_RANGE[0] <= shape.min() <= shape.max() <= FOCAL_RANGE[1]
    ):
        return f"The focal length ran away, to {change:.2f} times the predicted one."
    if _mirrored(predicted.T_cam_world, solution.candidate.T_cam_world, solution.refined):
        return "The cameras turned to the mirror image of the prediction."
    if solution.depth_spread > DEPTH_SPREAD:
        return f"The points contradict the predicted depth, by {solution.depth_spread:.0%} in the median."
    return None


def _mirrored(before: Tensor, after: Tensor, refined: np.ndarray) -> bool:
    """Whether the relative rotations of the refined views turn the other way, taken together."""
    views = np.flatnonzero(refined)
    if len(views) ** 2 < MOST_TURNS:
        first, second = views[np.stack(np.triu_indices(len(views), 1))]
    else:
        first, second = views[np.random.default_rng(0).integers(len(views), size=(2, MOST_TURNS))]
    turns = []
    for T in (before, after):
        R = relative(T[first], T[second])[:, :3, :3]
        turns.append(torch.stack((R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]), dim=-1))
    return bool((turns[0] * turns[1]).sum() < 0)


def _result(reconstruction: Reconstruction, predicted: Candidate, matches: Matches, solution: Solution) -> Refinement:
    """Return the solution in the prediction's frame, not accepted yet."""
    adjusted, tracks = solution.candidate, solution.tracks
    # The first refined view stays where it was predicted.
    still = int(tracks.view.min())
    moved = inverse(adjusted.T_cam_world[still]) @ predicted.T_cam_world[still]
    T = adjusted.T_cam_world @ moved
    world = transform_points(inverse(moved), torch.from_numpy(solution.xyz))
    view = torch.from_numpy(tracks.view)
    pixel = predicted.in_model(view, torch.from_numpy(tracks.pixel)).numpy()
    first = np.searchsorted(tracks.point, np.arange(len(tracks)))
    height, width = reconstruction.image_hw
    column, row = np.clip(np.rint(pixel[first]), 0, (width - 1, height - 1)).astype(np.int64).T
    measured = Tracks(
        xyz=world.numpy(),
        colours=reconstruction.images[tracks.view[first], row, column],
        point=tracks.point,
        view=tracks.view,
        pixel=pixel,
    )
    photo_hw = torch.from_numpy(matches.photo_hw)
    focal = [candidate.K[:, (0, 1), (0, 1)].prod(-1).sqrt() for candidate in (predicted, adjusted)]
    return Refinement(
        accepted=False,
        reason="",
        T_cam_world=T.numpy(),
        K=adjusted.K.numpy(),
        photo_K=adjusted.matching_K(photo_hw, photo_hw).numpy(),
        refined=solution.refined,
        focal_change=(focal[1] / focal[0]).numpy(),
        tracks=measured,
        error_px=solution.error_px,
        share_good=solution.good,
        depth_spread=solution.depth_spread,
    )


def _judged(
    result: Refinement,
    predicted: Candidate,
    start: Candidate,
    camera: np.ndarray,
    matches: Matches,
    way: Start,
    settings: RefineSettings,
) -> Refinement:
    """Return the result with the verdict of held-out pairs."""
    rng = np.random.default_rng(settings.seed)
    order = rng.permutation(len(matches.pairs))
    before, after = epipolar(predicted, matches).values, np.full(len(matches.pairs), np.nan)
    for fold in range(settings.folds):
        out = order[fold :: settings.folds]
        used = np.setdiff1d(np.arange(len(matches.pairs)), out)
        found = solve(start, camera, matches, join_matches(matches, used), (way,), settings.bundle)
        # Pairs without which nothing can be solved speak neither for nor against.
        after[out] = before[out] if found is None else epipolar(found[0].candidate, matches).values[out]
    known = np.isfinite(before) & np.isfinite(after)
    gain = np.log(before[known] + FLOOR_PX) - np.log(after[known] + FLOOR_PX)
    count = int(known.sum())
    drawn = gain[rng.integers(count, size=(settings.draws, count))].mean(axis=1) if count else np.zeros(1)
    probability = float((drawn > 0).mean())
    result = replace(
        result, pairs=matches.pairs[known], before_px=before[known], after_px=after[known], probability=probability
    )
    if count < settings.fewest_pairs:
        return replace(result, reason=f"Only {count} held-out pairs could judge; {settings.fewest_pairs} are needed.")
    numbers = (
        f"median error {np.median(before[known]):.2f} px before, {np.median(after[known]):.2f} px after, "
        f"{count} pairs, probability {probability:.2f}"
    )
    if probability < settings.probability:
        return replace(result, reason=f"Matches that had no part in it do not clearly fit better ({numbers}).")
    fitting = int((after[known] < settings.proven_px).sum())
    if fitting <= settings.proven * count:
        return replace(
            result,
            reason=f"Only {fitting} of {count} pairs that had no part in it fit to {settings.proven_px:g} px: too few "
            "photos are seen from more than one other to prove their places.",
        )
    return replace(result, accepted=True, reason=f"Matches that had no part in it fit better ({numbers}).")


def _depths(reconstruction: Reconstruction, tracks: Tracks, T_cam_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth (m,) of the tracks in their views, and the predicted depth there."""
    T = torch.from_numpy(T_cam_world)[tracks.view]
    measured = transform_points(T, torch.from_numpy(tracks.xyz)[tracks.point])[:, 2]
    depth = torch.from_numpy(reconstruction.depth_z)
    predicted, _ = depth_at(depth, torch.from_numpy(tracks.view), torch.from_numpy(tracks.pixel))
    return measured.numpy(), predicted.numpy()


def _affine(depth_z: np.ndarray, predicted: np.ndarray, measured: np.ndarray, scaled: np.ndarray) -> np.ndarray:
    """Depth (H, W) after 1/z' = a / z + b, fitted to inverse depths (n,); `scaled` where that is no depth any more."""
    columns = np.stack((predicted, np.ones_like(predicted)), axis=1)
    weight, a, b = np.ones(len(predicted)), 1.0, 0.0
    for _ in range(20):
        root = np.sqrt(weight)
        a, b = np.linalg.lstsq(columns * root[:, None], measured * root, rcond=None)[0]
        weight = 1 / np.maximum(np.abs(columns @ (a, b) - measured), 1e-3 * np.median(measured))
    known = np.isfinite(depth_z) & (depth_z > 0)
    inverse_z = a / np.where(known, depth_z, 1) + b
    # A fit that sends surfaces behind the camera, or far beyond what was measured, has learned from too few depths.
    if a <= 0 or inverse_z[known].min() < 0.5 * (1 / scaled[known]).min():
        return scaled
    return np.where(known, 1 / inverse_z, depth_z).astype(np.float32)
