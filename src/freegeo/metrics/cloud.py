"""Cloud score of the published evaluation: accuracy, completeness, their mean, precision, recall and F1.

Clouds are NumPy arrays (n, 3) in metres, float64 inside. Voxel averages come out in Morton (Z-curve) order: neighbours
in space are neighbours in memory, which halves the time of the KD-tree searches and leaves every distance unchanged.
"""

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from torch import Tensor

from freegeo.errors import UserError
from freegeo.geometry import se3
from freegeo.geometry.depth import depth_to_world, valid_depth
from freegeo.geometry.rotation import mean_rotation

_MORTON_BITS = 21
_RELATIVE_THRESHOLD = 0.05


@dataclass(frozen=True)
class CloudScore:
    """Distances in metres, shares in [0, 1]; the field names are those of the published score files."""

    acc: float
    """Accuracy: mean distance from predicted points to the ground truth."""
    comp: float
    """Completeness: mean distance from ground-truth points to the prediction."""
    overall: float
    """(acc + comp) / 2, the Chamfer distance of the paper."""
    precision: float
    """Share of predicted points closer to the ground truth than the threshold."""
    recall: float
    """Share of ground-truth points closer to the prediction than the threshold."""
    fscore: float
    """Harmonic mean of precision and recall, 0 when both are 0."""

    def as_dict(self) -> dict[str, float]:
        """The six numbers by name."""
        return asdict(self)


EMPTY_SCORE = CloudScore(float("inf"), float("inf"), float("inf"), 0.0, 0.0, 0.0)


class ReferenceCloud:
    """A ground-truth cloud made ready for scoring: averaged, sorted, with its search tree built on first use.

    It depends on nothing but the scene, so one object serves all models, view counts and seeds.
    """

    def __init__(self, points: np.ndarray, *, down_sample: float | None = None):
        """Take points (n, 3) metres; `down_sample` is the voxel edge in metres, None or 0 keeps all points."""
        self.down_sample = down_sample
        self.points = _prepared(points, down_sample)

    @classmethod
    def restored(cls, points: np.ndarray, *, down_sample: float | None) -> Self:
        """Make the cloud of `points` that another one has prepared already."""
        cloud = cls(np.empty((0, 3)))
        cloud.down_sample, cloud.points = down_sample, points
        return cloud

    @cached_property
    def tree(self) -> Any:
        """The `scipy.spatial.KDTree` over the points."""
        return _tree(self.points)

    def score(self, predicted: np.ndarray, *, threshold: float) -> CloudScore:
        """Score predicted points (n, 3), averaged over the same voxel edge, against this cloud.

        Args:
            predicted: (n, 3) metres, in the frame of the ground truth.
            threshold: metres; a point counts when its distance is strictly below.

        An empty cloud on either side gives infinite distances and zero shares.
        Source: docs/benchmark.md, "Fusion and scoring".
        """
        points = _prepared(predicted, self.down_sample)
        if len(points) == 0 or len(self.points) == 0:
            return EMPTY_SCORE
        to_reference = _query(self.tree, points)
        to_predicted = _query(_tree(points), self.points)
        return _from_distances(to_reference, to_predicted, threshold)


def score_clouds(
    predicted: np.ndarray, reference: np.ndarray, *, threshold: float, down_sample: float | None = None
) -> CloudScore:
    """Score one cloud against another; see `ReferenceCloud.score`.

    Args:
        predicted: (n, 3) metres.
        reference: (m, 3) metres, the ground truth.
        threshold: metres.
        down_sample: voxel edge in metres for averaging both clouds first, each with its own origin; None or 0: none.

    Raises:
        UserError: a cloud is not (n, 3) or holds coordinates that are not finite.
    """
    return ReferenceCloud(reference, down_sample=down_sample).score(predicted, threshold=threshold)


def voxel_average(points: np.ndarray, voxel: float) -> np.ndarray:
    """Mean of the points in each occupied cell of a cubic grid, in Morton order of the cells.

    The origin of the grid is the component-wise minimum of the cloud minus half a voxel.

    Args:
        points: (n, 3) metres.
        voxel: edge in metres, positive.

    Returns:
        (m, 3) float64 with m <= n.

    Source: docs/benchmark.md, "Fusion and scoring".
    """
    if not voxel > 0:
        raise UserError(f"The voxel edge must be positive, not {voxel}.")
    points = _checked(points)
    if len(points) == 0:
        return points
    cells = np.floor((points - (points.min(axis=0) - 0.5 * voxel)) / voxel).astype(np.int64)
    order = np.argsort(_morton_codes(cells))
    if cells.max() >= 1 << _MORTON_BITS:  # codes of so wide a grid are not unique: sort by the cells themselves
        order = np.lexsort(cells.T)
    cells, points = cells[order], points[order]
    is_first = np.concatenate([[True], (cells[1:] != cells[:-1]).any(axis=1)])
    starts = np.flatnonzero(is_first)
    counts = np.diff(np.append(starts, len(points)))
    return np.add.reduceat(points, starts, axis=0) / counts[:, None]


def morton_order(points: np.ndarray) -> np.ndarray:
    """Indices (n,) that sort points (n, 3) along a Z-curve over their bounding box."""
    points = _checked(points)
    if len(points) == 0:
        return np.empty(0, dtype=np.int64)
    low = points.min(axis=0)
    step = max(float((points.max(axis=0) - low).max()), np.finfo(np.float64).tiny) / ((1 << _MORTON_BITS) - 1)
    return np.argsort(_morton_codes(((points - low) / step).astype(np.int64)))


def nearest_distances(query: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Distance (n,) from each query point (n, 3) to its nearest reference point (m, 3), m > 0, in query order."""
    query, reference = _checked(query), _checked(reference)
    if len(reference) == 0:
        raise UserError("There is no reference point to measure distances to.")
    order = morton_order(query)
    distances = np.empty(len(query))
    distances[order] = _query(_tree(reference[morton_order(reference)]), query[order])
    return distances


def f1_rel5(
    depth_pred: Tensor,
    K_pred: Tensor,
    T_cam_world_pred: Tensor,
    depth_gt: Tensor,
    K_gt: Tensor,
    T_cam_world_gt: Tensor,
    *,
    views: tuple[int, ...] | None = None,
    posed: bool = False,
) -> CloudScore:
    """Score of a small reconstruction with a threshold of 5 % of the mean ground-truth depth.

    The prediction is moved onto the ground truth by the mean relative rotation of its cameras, the median ratio of the
    depths and the mean camera centre; the ground truth is the points of all its views, seen by the prediction or not.

    Args:
        depth_pred: (S, h, w), K_pred (S, 3, 3), T_cam_world_pred (S, 4, 4): the prediction, any similarity frame.
        K_pred: see `depth_pred`.
        T_cam_world_pred: see `depth_pred`.
        depth_gt: (V, h, w) metres with V >= S; `K_gt` (V, 3, 3) and `T_cam_world_gt` (V, 4, 4) belong to it.
        K_gt: see `depth_gt`.
        T_cam_world_gt: see `depth_gt`.
        views: the ground-truth view of each predicted one; by default the first S.
        posed: the prediction has the cameras of the ground truth, so it is not moved.

    Raises:
        UserError: the shapes do not fit, or a prediction has no pixel with a valid depth on both sides.

    Source: ours (docs/benchmark.md, "Generated rooms").
    """
    chosen = list(range(depth_pred.shape[0])) if views is None else list(views)
    if len(chosen) != depth_pred.shape[0] or depth_pred.shape[1:] != depth_gt.shape[1:]:
        raise UserError(
            f"Predicted depth {tuple(depth_pred.shape)} does not fit {len(chosen)} views of the ground truth "
            f"{tuple(depth_gt.shape)}."
        )
    T_gt = T_cam_world_gt.double()
    predicted = _world_points(depth_pred, K_pred, T_cam_world_pred)
    if not posed:
        R, s, t = _coarse_similarity(
            depth_pred.double(), T_cam_world_pred.double(), depth_gt[chosen].double(), T_gt[chosen]
        )
        predicted = s * predicted @ R.mT + t
    seen = depth_gt[valid_depth(depth_gt)].double()
    return score_clouds(
        predicted.cpu().numpy(),
        _world_points(depth_gt, K_gt, T_cam_world_gt).cpu().numpy(),
        threshold=_RELATIVE_THRESHOLD * float(seen.mean()),
    )


def _coarse_similarity(
    depth_pred: Tensor, T_pred: Tensor, depth_gt: Tensor, T_gt: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Rotation, scale and translation with `p_gt = s R p_pred + t` from mean rotation, median depth and mean centre."""
    both = valid_depth(depth_pred) & valid_depth(depth_gt)
    if not both.any():
        raise UserError("The prediction has no pixel with a valid depth in both prediction and ground truth.")
    s = (depth_gt[both] / depth_pred[both]).median()
    R = mean_rotation(T_gt[:, :3, :3].mT @ T_pred[:, :3, :3])
    centre_pred, centre_gt = (se3.camera_centres(T).mean(dim=0) for T in (T_pred, T_gt))
    return R, s, centre_gt - s * R @ centre_pred


def _world_points(depth_z: Tensor, K: Tensor, T_cam_world: Tensor) -> Tensor:
    """Points (n, 3) float64 of all pixels with a finite positive depth."""
    return depth_to_world(depth_z.double(), K.double(), T_cam_world.double())[valid_depth(depth_z)]


def _prepared(points: np.ndarray, down_sample: float | None) -> np.ndarray:
    if down_sample:
        return voxel_average(points, down_sample)
    points = _checked(points)
    return points[morton_order(points)]


def _checked(points: np.ndarray) -> np.ndarray:
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise UserError(f"A cloud must have shape (n, 3), not {points.shape}.")
    if not np.isfinite(points).all():
        raise UserError("A cloud holds coordinates that are not finite; drop those points before scoring.")
    return points


def _morton_codes(cells: np.ndarray) -> np.ndarray:
    """Interleave the low 21 bits of each column of (n, 3) non-negative integers into (n,) codes."""
    code = np.zeros(len(cells), dtype=np.uint64)
    for axis in range(3):
        x = cells[:, axis].astype(np.uint64) & np.uint64((1 << _MORTON_BITS) - 1)
        for shift, mask in (
            (32, 0x1F00000000FFFF),
            (16, 0x1F0000FF0000FF),
            (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ):
            x = (x | (x << np.uint64(shift))) & np.uint64(mask)
        code |= x << np.uint64(axis)
    return code


def _tree(points: np.ndarray) -> Any:
    from scipy.spatial import KDTree

    # With compact nodes SciPy finds points far from the cloud up to 20 times slower.
    return KDTree(points, leafsize=32, balanced_tree=False, compact_nodes=False)


def _query(tree: Any, points: np.ndarray) -> np.ndarray:
    return tree.query(points, workers=-1)[0]


def _from_distances(to_reference: np.ndarray, to_predicted: np.ndarray, threshold: float) -> CloudScore:
    acc, comp = float(to_reference.mean()), float(to_predicted.mean())
    precision, recall = float((to_reference < threshold).mean()), float((to_predicted < threshold).mean())
    fscore = 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0
    return CloudScore(acc, comp, (acc + comp) / 2, precision, recall, fscore)
