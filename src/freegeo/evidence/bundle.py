"""Bundle adjustment of tracks: from a prediction's cameras to those that the photos' matches ask for (extra `colmap`).

The tracks are triangulated with the predicted cameras; then focal lengths, camera poses and points are moved until the
points project onto the pixels where the photos show them (pycolmap, Cauchy loss). Whether the result may be trusted is
not decided here but in `freegeo.evidence.refinement`.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from freegeo.errors import UserError
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.matches import Matches
from freegeo.evidence.scores import depth_at
from freegeo.evidence.tracks import MeasuredTracks, join_matches, triangulate
from freegeo.export.reconstruction import Reconstruction
from freegeo.geometry.camera import project
from freegeo.geometry.rotation import rotation_angle
from freegeo.geometry.se3 import inverse, relative, transform_points
from freegeo.host import sigterm_kept

__all__ = [
    "BundleSettings",
    "Solution",
    "Start",
    "cluster",
    "depth_of",
    "measure",
    "points_of",
    "shared_cameras",
    "solve",
]

Start = Literal["rays", "depth"]
"""Where the points of the first adjustment come from: rays of the predicted cameras, or the predicted depth."""
LOST_PX = 100.0
"""An observation that is farther off, or behind the camera, costs as much as this."""
DEPTH_WEIGHT = 3.0
"""Of two solutions, weight of the disagreement with the predicted depth against the cost of the observations."""


@dataclass(frozen=True, kw_only=True)
class BundleSettings:
    """How cameras are adjusted; pixels are matching pixels."""

    share_focal: bool = True
    """Photos of one size have one focal length; off: each photo has its own."""
    widest: float = 0.125
    """First gate, in longer sides of the photo: observations farther from the projection of their track are left out.
    The gate shrinks to a quarter from one adjustment to the next."""
    narrowest_px: float = 2.0
    """Last gate."""
    loss_px: float = 1.0
    """Scale of the Cauchy loss; an eighth of the gate where that is more."""
    iterations: int = 30
    """Most steps of one adjustment."""
    least_angle_deg: float = 1.5
    """Tracks whose rays differ by less say nothing about depth and are left out."""
    joined: int = 8
    """Two photos hang together when so many tracks show in both."""
    fewest_observations: int = 10
    """A photo with fewer good observations is not refined by itself."""
    largest_factor: float = 1.5
    """A photo whose tracks are farther or nearer than predicted by more, compared with the others, is not refined."""
    fewest_tracks: int = 30
    """Fewer tracks are not adjusted."""
    per_photo: int = 300
    """So many tracks of each photo are adjusted, those that the most photos show."""

    def gates_px(self, match_hw: np.ndarray) -> list[float]:
        """Gates in matching pixels for photos of the sizes `match_hw` (S, 2), one for each adjustment."""
        gates = [self.widest * float(match_hw.max())]
        while gates[-1] > 4 * self.narrowest_px:
            gates.append(gates[-1] / 4)
        return [*gates[: -1 if gates[-1] <= self.narrowest_px else None], self.narrowest_px]


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """What an adjustment ended with."""

    candidate: Candidate
    """All S cameras, in a frame of their own, at the scale where the median depth of the tracks is the predicted one;
    those that are not refined follow the nearest one that is. Its depth maps are the prediction's."""
    refined: np.ndarray
    """(S,) bool, views with enough good observations that hang together."""
    tracks: MeasuredTracks
    """Tracks with good observations only."""
    xyz: np.ndarray
    """(n, 3) float64 world coordinates of the tracks."""
    error_px: np.ndarray
    """(m,) matching pixels, of each observation."""
    cost: float
    """Mean of log(1 + error^2) over all observations that there were, also the left out ones."""
    good: float
    """Share of all observations that are good: within the last gate, in tracks of sufficient angle."""
    depth_spread: float
    """Median absolute deviation of log(predicted depth / depth of the track): 0 when they agree up to one factor."""


def pycolmap_module() -> ModuleType:
    """Return pycolmap; UserError when it is not installed."""
    try:
        with sigterm_kept():
            import pycolmap
    except ImportError:
        raise UserError("Bundle adjustment needs an extra: pip install 'freegeo[colmap]'.") from None
    return pycolmap


def shared_cameras(reconstruction: Reconstruction, share_focal: bool = True) -> tuple[Candidate, np.ndarray]:
    """Return a prediction with the intrinsics that an adjustment starts from, and the camera (S,) of each view.

    Pixels of the photos are square, and the focal length is the median of the predicted ones of a camera. Principal
    points stay where they are predicted. Networks do not predict them: their (W/2, H/2) means the middle of the image,
    which this package writes as half a pixel less (docs/conventions.md).

    Args:
        reconstruction: the prediction.
        share_focal: photos of one size are of one camera; else each view has its own.
    """
    candidate = Candidate.of(reconstruction)
    height, width = reconstruction.image_hw
    if share_focal:
        camera = np.unique(reconstruction.photo_hw, axis=0, return_inverse=True)[1].reshape(-1)
    else:
        camera = np.arange(len(candidate))
    focal = candidate.K[:, (0, 1), (0, 1)] / candidate.scale_xy
    K = candidate.K.clone()
    for number in np.unique(camera):
        own = torch.from_numpy(camera == number)
        K[own, (0,), (1,)] = 0
        both = focal[own].flatten().quantile(0.5) * candidate.scale_xy[own]
        K[own, (0,), (0,)], K[own, (1,), (1,)] = both.unbind(-1)
    middle = torch.tensor([width / 2, height / 2], dtype=torch.float64)
    of_network = ((K[:, :2, 2] - middle).abs() < 1e-3).all(-1)
    K[of_network, :2, 2] -= 0.5
    return replace(candidate, K=K), camera


def cluster(tracks: MeasuredTracks, views: int, fewest: int) -> np.ndarray:
    """Return which views (S,) bool form the largest set that hangs together by `fewest` common tracks."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    seen = coo_array((np.ones(len(tracks.view)), (tracks.point, tracks.view)), shape=(len(tracks), views))
    common = (seen.T @ seen).toarray()
    np.fill_diagonal(common, 0)
    label = connected_components(common >= fewest, directed=False)[1]
    return label == np.bincount(label).argmax()


def solve(
    candidate: Candidate,
    camera: np.ndarray,
    matches: Matches,
    tracks: MeasuredTracks,
    starts: tuple[Start, ...] = ("depth", "rays"),
    settings: BundleSettings | None = None,
) -> tuple[Solution, Start] | None:
    """Adjust the views that hang together, from each start, and return the better solution and its start.

    Better is: a lower cost of the observations, and points where the prediction's depth is, up to one scale. Where the
    matches alone leave something open, such as the length of a step between two photos that share no track with others,
    the predicted depth decides.

    Returns:
        None when there are too few tracks, or no start led anywhere.

    Raises:
        UserError: pycolmap is not installed.
    """
    settings = settings or BundleSettings()
    if not len(tracks):
        return None
    together = cluster(tracks, len(matches), settings.joined)
    tracks = _selected(tracks, together[tracks.view])[0]
    found = [(_adjusted(candidate, camera, matches, tracks, start, settings), start) for start in starts]
    known = [(solution, start) for solution, start in found if solution is not None]
    return min(known, key=lambda one: one[0].cost + DEPTH_WEIGHT * one[0].depth_spread, default=None)


def measure(
    candidate: Candidate, matches: Matches, settings: BundleSettings | None = None
) -> tuple[MeasuredTracks, np.ndarray]:
    """Return the tracks that fit a candidate's cameras as they are, and their points (n, 3): nothing is adjusted."""
    settings = settings or BundleSettings()
    tracks = join_matches(matches)
    xyz, error, wide = _triangulated(candidate, matches, tracks, settings)
    chosen, alive = _selected(tracks, (error <= settings.narrowest_px) & wide[tracks.point])
    return chosen, xyz[alive]


def points_of(candidate: Candidate, matches: Matches, tracks: MeasuredTracks, views: np.ndarray) -> np.ndarray:
    """Return points (n, 3) of tracks as some views (S,) bool measure them; nan for those that they do not fix."""
    settings = BundleSettings()
    own, alive = _selected(tracks, views[tracks.view])
    xyz, error, wide = _triangulated(candidate, matches, own, settings)
    wrong = np.bincount(own.point, weights=error > settings.narrowest_px, minlength=len(own)) > 0
    found = np.full((len(tracks), 3), np.nan)
    found[alive] = np.where((wide & ~wrong)[:, None], xyz, np.nan)
    return found


def depth_of(candidate: Candidate, tracks: MeasuredTracks) -> Tensor:
    """Predicted depth (m,) of the observations; nan where there is none."""
    view = torch.from_numpy(tracks.view)
    return depth_at(candidate.depth_z.detach().cpu(), view, candidate.in_model(view, torch.from_numpy(tracks.pixel)))[0]


def _adjusted(
    candidate: Candidate,
    camera: np.ndarray,
    matches: Matches,
    tracks: MeasuredTracks,
    start: Start,
    settings: BundleSettings,
) -> Solution | None:
    if len(tracks) < settings.fewest_tracks:
        return None
    few, now = _longest(tracks, settings.per_photo), candidate
    unit = float(depth_of(candidate, few).nanmedian())
    for step, gate in enumerate(settings.gates_px(matches.match_hw)):
        if step == 0 and start == "depth":
            xyz = _lifted(now, few)
            error, wide = _errors(now, matches, few, xyz), np.ones(len(few), dtype=bool)
        else:
            xyz, error, wide = _triangulated(now, matches, few, settings)
        chosen, alive = _selected(few, (error <= gate) & wide[few.point])
        if len(chosen) < settings.fewest_tracks:
            return None
        loss = max(settings.loss_px, gate / 8)
        moved = _bundle(now, camera, matches, chosen, xyz[alive], loss, settings.iterations)
        if moved is None:
            return None
        seen = np.bincount(chosen.view, minlength=len(matches)) > 0
        now = replace(moved, T_cam_world=_following(now.T_cam_world, moved.T_cam_world, seen, unit))
    xyz, error, wide = _triangulated(now, matches, tracks, settings)
    good = (error <= settings.narrowest_px) & wide[tracks.point]
    last, alive = _selected(tracks, good)
    if not len(last):
        return None
    xyz = xyz[alive]
    views = len(matches)
    enough = np.bincount(last.view, minlength=views) >= settings.fewest_observations
    enough &= _sized(candidate, now, last, xyz, settings.largest_factor)
    last, still = _selected(last, (enough & cluster(last, views, settings.joined))[last.view])
    refined = np.bincount(last.view, minlength=views) > 0
    if not refined.any():
        return None
    xyz = xyz[still]
    ratio = _depth_ratios(candidate, now, last, xyz)
    factor, spread = 1.0, 0.0
    if np.isfinite(ratio).any():
        middle = np.nanmedian(ratio)
        factor, spread = float(np.exp(middle)), float(np.nanmedian(np.abs(ratio - middle)))
    T, xyz = now.T_cam_world.clone(), xyz * factor
    T[:, :3, 3] *= factor
    now = replace(now, T_cam_world=_following(candidate.T_cam_world, T, refined, unit))
    return Solution(
        candidate=now,
        refined=refined,
        tracks=last,
        xyz=xyz,
        error_px=_errors(now, matches, last, xyz),
        cost=float(np.log1p(np.minimum(error, LOST_PX) ** 2).mean()),
        good=float(good.mean()),
        depth_spread=spread,
    )


def _bundle(
    candidate: Candidate,
    camera: np.ndarray,
    matches: Matches,
    tracks: MeasuredTracks,
    xyz: np.ndarray,
    loss_px: float,
    iterations: int,
) -> Candidate | None:
    """Return adjusted cameras; that of the view with the most observations keeps its pose. None if the solver fails.

    COLMAP is given pixels counted from the principal point, so that views of one camera may differ in it, and square
    pixels: what it finds is one factor on the focal length of each camera.
    """
    pycolmap = pycolmap_module()
    T = candidate.T_cam_world.numpy()
    U, _, Vh = np.linalg.svd(T[:, :3, :3])
    rigid = np.concatenate((U @ Vh, T[:, :3, 3:]), axis=2)
    K = candidate.matching_K(*map(torch.from_numpy, (matches.photo_hw, matches.match_hw))).numpy()
    focal = np.diagonal(K[:, :2, :2], axis1=1, axis2=2)
    mean = np.array([focal[camera == number].mean() for number in camera])
    pixel = matches.in_matching_pixels()[tracks.keypoint]
    pixel = (pixel - K[tracks.view, :2, 2]) / focal[tracks.view] * mean[tracks.view, None]
    views, numbers = np.unique(tracks.view).tolist(), (camera + 1).tolist()
    model, position = pycolmap.Reconstruction(), np.zeros(len(tracks.view), np.int64)
    for view in views:
        if not model.exists_camera(numbers[view]):
            height, width = matches.match_hw[view].tolist()
            model.add_camera_with_trivial_rig(
                pycolmap.Camera(
                    model="SIMPLE_PINHOLE", width=width, height=height, params=[mean[view], 0, 0],
                    camera_id=numbers[view],
                )
            )  # fmt: skip
        rows = np.flatnonzero(tracks.view == view)
        position[rows] = np.arange(len(rows))
        image = pycolmap.Image(name=str(view), keypoints=pixel[rows], camera_id=numbers[view], image_id=view + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rigid[view]))
    images, rows, low = (tracks.view + 1).tolist(), position.tolist(), 0
    for place, high in zip(xyz, np.cumsum(np.bincount(tracks.point)).tolist(), strict=True):
        track = pycolmap.Track()
        for i in range(low, high):
            track.add_element(images[i], rows[i])
        model.add_point3D(place, track)
        low = high
    config = pycolmap.BundleAdjustmentConfig()
    for view in views:
        config.add_image(view + 1)
    still = int(np.bincount(tracks.view).argmax())
    config.set_constant_rig_from_world_pose(model.image(still + 1).frame_id)
    adjuster = pycolmap.create_default_bundle_adjuster(_options(pycolmap, loss_px, iterations), config, model)
    with _quiet(pycolmap):
        summary = adjuster.solve()
    T_new, K_new = candidate.T_cam_world.clone(), candidate.K.clone()
    for view in views:
        T_new[view, :3] = torch.from_numpy(model.image(view + 1).cam_from_world().matrix())
    for number in np.unique(camera[views]):
        own = camera == number
        factor = model.camera(int(number) + 1).focal_length / mean[own][0]
        K_new[torch.from_numpy(own), :2, :2] *= factor
    finite = bool(T_new.isfinite().all()) and bool(K_new.isfinite().all())
    usable = summary.is_solution_usable() and finite and bool((K_new[:, 0, 0] > 0).all())
    return replace(candidate, T_cam_world=T_new, K=K_new) if usable else None


@contextmanager
def _quiet(pycolmap: ModuleType) -> Generator[None]:
    """Keep the solver's notes off the terminal: the scale is free, so that it meets singular systems and steps back."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


def _options(pycolmap: ModuleType, loss_px: float, iterations: int):
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = True
    options.refine_principal_point = False
    options.refine_extra_params = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_px
    options.ceres.solver_options.max_num_iterations = iterations
    # As good as no tolerance, in two thirds of the time.
    options.ceres.solver_options.function_tolerance = 1e-6
    options.ceres.solver_options.num_threads = 1  # the same result every time
    return options


def _triangulated(
    candidate: Candidate, matches: Matches, tracks: MeasuredTracks, settings: BundleSettings
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (n, 3), errors (m,) of observations, inf without a point, and whether (n,) the rays differ enough."""
    seen = triangulate(candidate, matches, tracks)
    error = np.nan_to_num(seen.error_px, nan=np.inf, posinf=np.inf)
    return seen.xyz, error, seen.angle_deg >= settings.least_angle_deg


def _errors(candidate: Candidate, matches: Matches, tracks: MeasuredTracks, xyz: np.ndarray) -> np.ndarray:
    """Reprojection errors (m,) in matching pixels; inf behind the camera or without coordinates."""
    view = torch.from_numpy(tracks.view)
    K = candidate.matching_K(*map(torch.from_numpy, (matches.photo_hw, matches.match_hw)))[view]
    there = transform_points(candidate.T_cam_world[view], torch.from_numpy(xyz)[tracks.point])
    pixel = torch.from_numpy(matches.in_matching_pixels()[tracks.keypoint])
    error = torch.linalg.vector_norm(project(there, K) - pixel, dim=-1)
    return torch.where(there[:, 2] > 0, error, torch.inf).nan_to_num(nan=torch.inf).numpy()


def _lifted(candidate: Candidate, tracks: MeasuredTracks) -> np.ndarray:
    """World points (n, 3): the mean of where the predicted depths put a track's observations; nan without depth."""
    z, view = depth_of(candidate, tracks), torch.from_numpy(tracks.view)
    pixel = candidate.in_model(view, torch.from_numpy(tracks.pixel))
    rays = torch.linalg.inv(candidate.K)[view] @ torch.cat((pixel, torch.ones_like(pixel[:, :1])), dim=-1)[..., None]
    world = transform_points(inverse(candidate.T_cam_world)[view], rays[..., 0] * z[:, None])
    known = ~z.isnan()
    point = torch.from_numpy(tracks.point)[known]
    sums = torch.zeros(len(tracks), 3, dtype=torch.float64).index_add_(0, point, world[known])
    return (sums / torch.bincount(point, minlength=len(tracks))[:, None]).numpy()


def _depth_ratios(predicted: Candidate, now: Candidate, tracks: MeasuredTracks, xyz: np.ndarray) -> np.ndarray:
    """Logarithm (m,) of predicted depth / depth of the track for each observation; nan where none is predicted."""
    there = transform_points(now.T_cam_world[tracks.view], torch.from_numpy(xyz)[tracks.point])[:, 2]
    return torch.log(depth_of(predicted, tracks) / there).numpy()


def _sized(predicted: Candidate, now: Candidate, tracks: MeasuredTracks, xyz: np.ndarray, largest: float) -> np.ndarray:
    """Which views (S,) bool see the tracks at the predicted depth, up to one factor for all and `largest` beyond it.

    Where a part of the photos hangs on the rest by few tracks, it may end at a scale of its own.
    """
    ratio = _depth_ratios(predicted, now, tracks, xyz)
    sized = np.ones(len(now), dtype=bool)
    known = np.isfinite(ratio)
    if known.any():
        middle = np.median(ratio[known])
        for view in np.unique(tracks.view[known]).tolist():
            sized[view] = abs(np.median(ratio[known & (tracks.view == view)]) - middle) <= np.log(largest)
    return sized


def _following(predicted: Tensor, T_cam_world: Tensor, refined: np.ndarray, unit: float) -> Tensor:
    """Views that are not refined keep their predicted pose relative to the refined view that looks most alike.

    That is the one with the smallest turn, in radians, and way, in depths of the scene (`unit`).
    """
    T_cam_world = T_cam_world.clone()
    inside = np.flatnonzero(refined)
    R, centre = predicted[:, :3, :3], inverse(predicted)[:, :3, 3]
    for view in np.flatnonzero(~refined).tolist():
        turn = rotation_angle(R[view].expand(len(inside), 3, 3), R[inside])
        way = torch.linalg.vector_norm(centre[inside] - centre[view], dim=-1) / unit
        near = int(inside[int((turn + way.nan_to_num()).argmin())])
        T_cam_world[view] = relative(predicted[near], predicted[view]) @ T_cam_world[near]
    return T_cam_world


def _selected(tracks: MeasuredTracks, keep: np.ndarray) -> tuple[MeasuredTracks, np.ndarray]:
    """Tracks of the observations `keep` (m,), and which points (n,) bool still have two of them."""
    alive = np.bincount(tracks.point[keep], minlength=len(tracks)) >= 2
    keep = keep & alive[tracks.point]
    number = np.cumsum(alive) - 1
    chosen = MeasuredTracks(
        count=int(alive.sum()),
        point=number[tracks.point[keep]],
        view=tracks.view[keep],
        keypoint=tracks.keypoint[keep],
        pixel=tracks.pixel[keep],
    )
    return chosen, alive


def _longest(tracks: MeasuredTracks, per_view: int) -> MeasuredTracks:
    """The tracks that are among the `per_view` longest of one of their views, the first ones of those that tie."""
    length = np.bincount(tracks.point, minlength=len(tracks))[tracks.point]
    order = np.lexsort((-length, tracks.view))
    start = np.searchsorted(tracks.view[order], tracks.view[order])
    chosen = np.zeros(len(tracks), dtype=bool)
    chosen[tracks.point[order[np.arange(len(order)) - start < per_view]]] = True
    return _selected(tracks, chosen[tracks.point])[0]
