"""Tracks: points that several photos show, joined from verified matches, and their triangulation.

Unlike `freegeo.fusion.tracks`, whose observations are the prediction's own re-projections, these are measured in the
photos: a bundle adjustment can learn from them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from freegeo.evidence.candidate import Candidate
from freegeo.evidence.matches import Matches
from freegeo.geometry.camera import project
from freegeo.geometry.se3 import camera_centres, transform_points
from freegeo.metrics.pose import PairErrors, pair_errors

__all__ = ["MeasuredTracks", "Triangulated", "join_matches", "pose_change", "triangulate"]


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredTracks:
    """n points with m >= 2 n observations; observation i is one of point `point[i]`, sorted by point, then view."""

    count: int
    """n."""
    point: np.ndarray
    """(m,) int64."""
    view: np.ndarray
    """(m,) int64; a point has at most one observation in a view."""
    keypoint: np.ndarray
    """(m,) int64 row of `Matches.keypoints`."""
    pixel: np.ndarray
    """(m, 2) float64 photo pixels, centres at whole numbers."""

    def __len__(self) -> int:
        """Return the number of points."""
        return self.count


@dataclass(frozen=True, kw_only=True, eq=False)
class Triangulated:
    """Tracks as a candidate's cameras see them."""

    xyz: np.ndarray
    """(n, 3) float64 world coordinates; nan where a point has none (parallel rays, behind a camera)."""
    angle_deg: np.ndarray
    """(n,) largest angle between two of its rays."""
    error_px: np.ndarray
    """(m,) reprojection error of each observation, matching pixels; nan for points without coordinates."""
    reason: str | None
    """Why there is no point; None when there is one."""

    @property
    def median_px(self) -> float:
        """S6: median reprojection error before bundle adjustment; nan without a point."""
        known = self.error_px[~np.isnan(self.error_px)]
        return float(np.median(known)) if len(known) else float("nan")

    @property
    def share(self) -> float:
        """Share of the tracks that have coordinates; nan without a track."""
        return float(np.isfinite(self.xyz).all(axis=1).mean()) if len(self.xyz) else float("nan")


def join_matches(matches: Matches, pairs: np.ndarray | None = None) -> MeasuredTracks:
    """Join matches that share keypoints.

    A track with two different places in one photo is wrong somewhere, and nobody knows where: it is left out.

    Args:
        matches: verified matches.
        pairs: indices of the pairs to use; None: all. Leave some out to judge by them.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    used = np.isin(matches.pair_of, np.arange(len(matches.pairs)) if pairs is None else pairs)
    one, two = matches.ends[used].T
    count = len(matches.keypoints)
    graph = coo_matrix((np.ones(len(one), dtype=bool), (one, two)), shape=(count, count))
    _, label = connected_components(graph, directed=False) if count else (0, np.zeros(0, np.int64))
    keypoint = np.unique(np.concatenate((one, two)))
    view = matches.view_of[keypoint]
    group, size = np.unique(np.stack((label[keypoint], view), axis=1), axis=0, return_counts=True)
    wrong = np.unique(group[size > 1, 0])
    kept = ~np.isin(label[keypoint], wrong)
    keypoint, view = keypoint[kept], view[kept]
    names, point = np.unique(label[keypoint], return_inverse=True)
    order = np.lexsort((view, point))
    keypoint = keypoint[order]
    return MeasuredTracks(
        count=len(names),
        point=point[order].astype(np.int64),
        view=view[order],
        keypoint=keypoint,
        pixel=matches.keypoints[keypoint],
    )


def triangulate(candidate: Candidate, matches: Matches, tracks: MeasuredTracks) -> Triangulated:
    """S6, first half: triangulate tracks with a candidate's cameras.

    The point of a track is the one nearest to its rays (least squares of the distances), found again twice with each
    distance divided by that from the camera, which makes it nearly the least squared reprojection error. A point behind
    one of its cameras, or of rays that are parallel, has no coordinates.
    """
    if len(candidate) != len(matches):
        raise ValueError(f"a candidate of {len(candidate)} views and matches of {len(matches)} photos")
    point, view = torch.from_numpy(tracks.point), torch.from_numpy(tracks.view)
    K = candidate.matching_K(*map(torch.from_numpy, (matches.photo_hw, matches.match_hw)))[view]
    pixel = torch.from_numpy(matches.in_matching_pixels()[tracks.keypoint])
    T = candidate.T_cam_world[view]
    rays = (torch.linalg.inv(K) @ torch.cat((pixel, torch.ones_like(pixel[:, :1])), dim=-1)[..., None])[..., 0]
    rays = (T[:, :3, :3].mT @ rays[..., None])[..., 0]
    rays = rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)
    centres = camera_centres(candidate.T_cam_world)[view]
    xyz = _nearest(len(tracks), point, rays, centres, torch.ones(len(point), dtype=torch.float64))
    for _ in range(2):
        distance = torch.linalg.vector_norm(xyz[point] - centres, dim=-1)
        focal = K[:, (0, 1), (0, 1)].mean(-1)
        xyz = _nearest(len(tracks), point, rays, centres, (focal / distance).square().nan_to_num(0.0))
    in_camera = transform_points(T, xyz[point])
    in_front = torch.ones(len(tracks), dtype=torch.bool)
    in_front[point[~(in_camera[:, 2] > 0)]] = False
    xyz = torch.where(in_front[:, None], xyz, torch.nan)
    error = torch.linalg.vector_norm(project(in_camera, K) - pixel, dim=-1)
    none = "No track of matches has a point in front of its cameras."
    return Triangulated(
        xyz=xyz.numpy(),
        angle_deg=_angles(len(tracks), point, rays).numpy(),
        error_px=torch.where(in_front[point], error, torch.nan).numpy(),
        reason=matches.reason() or (None if in_front.any() else none),
    )


def pose_change(before: Tensor, after: Tensor) -> PairErrors:
    """S6, second half: by which angles bundle adjustment moves the relative poses of cameras (S, 4, 4)."""
    return pair_errors(before.detach().cpu().double(), after.detach().cpu().double())


def _nearest(count: int, point: Tensor, rays: Tensor, centres: Tensor, weight: Tensor) -> Tensor:
    """Points (n, 3) with the least weighted squared distance from their rays; nan where the rays are parallel."""
    across = torch.eye(3, dtype=torch.float64) - rays[:, :, None] * rays[:, None]
    across = across * weight[:, None, None]
    A = torch.zeros(count, 3, 3, dtype=torch.float64).index_add_(0, point, across)
    b = torch.zeros(count, 3, dtype=torch.float64).index_add_(0, point, (across @ centres[..., None])[..., 0])
    values = torch.linalg.eigvalsh(A)
    parallel = values[:, 0] <= 1e-10 * values[:, -1]
    A = torch.where(parallel[:, None, None], torch.eye(3, dtype=torch.float64), A)
    return torch.where(parallel[:, None], torch.nan, torch.linalg.solve(A, b))


def _angles(count: int, point: Tensor, rays: Tensor) -> Tensor:
    """Largest angle (n,) in degrees between two rays of a point."""
    cosine = torch.ones(count, dtype=torch.float64)
    length = torch.bincount(point, minlength=count)
    start = length.cumsum(0) - length
    longest = int(length.max()) if count else 0
    for a in range(longest):
        for b in range(a + 1, longest):
            has = torch.nonzero(length > b)[:, 0]
            inner = (rays[start[has] + a] * rays[start[has] + b]).sum(-1)
            cosine[has] = torch.minimum(cosine[has], inner)
    return torch.rad2deg(torch.arccos(cosine.clamp(-1, 1)))
