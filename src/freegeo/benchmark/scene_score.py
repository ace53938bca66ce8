"""Scoring one prediction against the ground truth of its scene.

One scene at a time: `score_scene_poses` and `score_scene_surface`; `SceneReference` holds the prepared ground truth,
which depends on no model, view count or frame seed, so it can be reused.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from freegeo.benchmark.frames import fusion_frames, require_prediction, require_truth
from freegeo.data.datasets.base import DatasetConstants
from freegeo.data.datasets.registry import constants
from freegeo.data.scene import Scene, SceneTruth
from freegeo.files import read_npz, write_npz
from freegeo.fusion.mesh import Mesh, empty_mesh_substitute, read_mesh, read_points, sample_surface
from freegeo.fusion.tsdf import TsdfVolume
from freegeo.metrics.cloud import CloudScore, ReferenceCloud
from freegeo.metrics.pose import score_poses
from freegeo.types import Prediction

GROUND_TRUTH = "ground-truth"
"""Folder of prepared ground-truth points in a benchmark folder."""
REFERENCE_SEED_OFFSET = 1000
"""The ground-truth mesh is sampled with the seed of the prediction plus this."""


@dataclass(frozen=True, kw_only=True)
class SceneReference:
    """Ground truth of one scene, sampled, averaged and indexed once."""

    cloud: ReferenceCloud
    box: tuple[np.ndarray, np.ndarray]
    """Corners of the bounding box of the ground-truth points, before averaging."""
    constants: DatasetConstants

    def score(self, points: np.ndarray) -> CloudScore:
        """Score predicted points (n, 3), cut to the box of the ground truth where the dataset asks for it."""
        margin = self.constants.crop_margin
        if margin is not None:
            low, high = self.box
            points = points[((points >= low - margin) & (points <= high + margin)).all(axis=-1)]
        return self.cloud.score(points, threshold=self.constants.threshold)


@dataclass(frozen=True, kw_only=True)
class SurfaceScore:
    """Score of one fused surface."""

    cloud: CloudScore
    empty_mesh: bool
    """Whether the fusion gave no triangle, so that random points were scored in its place."""
    vertices: int
    triangles: int


def load_reference(scene: Scene, *, seed: int = REFERENCE_SEED_OFFSET, cache: Path | None = None) -> SceneReference:
    """Read and prepare the ground truth of a scene.

    Args:
        scene: with ground truth.
        seed: of the points drawn from a ground-truth mesh; a stored cloud is used as it is.
        cache: folder where the prepared points of a mesh are kept for the next run. They belong to the mesh file as it
            is (name, size, date), to the seed and to the constants of the dataset.

    Raises:
        UserError: there is no ground truth, or its file is missing.
    """
    truth, _, _ = require_truth(scene)
    fixed = constants(truth.dataset)
    if fixed.truth == "points":
        return _prepared(read_points(truth.surface), fixed)
    kept = None if cache is None or not truth.surface.is_file() else cache / f"{_mesh_digest(truth, fixed, seed)}.npz"
    if kept is not None and kept.is_file():
        content = read_npz(kept, {"points": ("f", (-1, 3)), "low": ("f", (3,)), "high": ("f", (3,))})
        cloud = ReferenceCloud.restored(content["points"], down_sample=fixed.down_sample)
        return SceneReference(cloud=cloud, box=(content["low"], content["high"]), constants=fixed)
    reference = _prepared(sample_surface(read_mesh(truth.surface), fixed.samples, seed=seed), fixed)
    if kept is not None:
        write_npz(kept, {"points": reference.cloud.points, "low": reference.box[0], "high": reference.box[1]})
    return reference


def _prepared(points: np.ndarray, fixed: DatasetConstants) -> SceneReference:
    cloud = ReferenceCloud(points, down_sample=fixed.down_sample)
    return SceneReference(cloud=cloud, box=(points.min(axis=0), points.max(axis=0)), constants=fixed)


def _mesh_digest(truth: SceneTruth, fixed: DatasetConstants, seed: int) -> str:
    facts = truth.surface.stat()
    what = (str(truth.surface.resolve()), facts.st_size, facts.st_mtime_ns, seed, fixed.samples, fixed.down_sample)
    return hashlib.sha256(repr(what).encode()).hexdigest()[:24]


def score_scene_poses(scene: Scene, prediction: Prediction) -> dict[str, float]:
    """`auc03` to `auc30` of one prediction against the ground-truth cameras of its frames."""
    _, known_T, _ = require_truth(scene)
    _, T, _ = require_prediction(scene, prediction)
    return score_poses(T, known_T)


def score_scene_surface(
    scene: Scene,
    prediction: Prediction,
    *,
    posed: bool = False,
    seed: int = 0,
    reference: SceneReference | None = None,
    device: torch.device | str = "cpu",
) -> SurfaceScore:
    """Fuse a prediction, sample the surface and score it: `recon_unposed`, or `recon_posed` with `posed`.

    Args:
        scene: the frames of the prediction, in its order.
        prediction: depth and cameras at the network's size; for `posed`, of a run that was given the cameras.
        posed: fuse with the ground-truth cameras.
        seed: of the sampled points; differences of F1 below 0.001 are within the noise between seeds.
        reference: prepared ground truth; read with `seed` + 1000 when it is not given.
        device: where the depth is fused.

    Raises:
        UserError, FreeGeoError: as in `fusion_frames` and `load_reference`.

    Source: docs/benchmark.md, "Fusion and scoring".
    """
    reference = reference or load_reference(scene, seed=seed + REFERENCE_SEED_OFFSET)
    mesh = fuse_scene(scene, prediction, posed=posed, device=device)
    samples = reference.constants.samples
    if mesh.is_empty:
        points = empty_mesh_substitute(samples)
    else:
        points = sample_surface(mesh, samples, seed=seed)
    return SurfaceScore(
        cloud=reference.score(points),
        empty_mesh=mesh.is_empty,
        vertices=len(mesh.vertices),
        triangles=len(mesh.triangles),
    )


def fuse_scene(
    scene: Scene, prediction: Prediction, *, posed: bool = False, device: torch.device | str = "cpu"
) -> Mesh:
    """The surface of a prediction in the frame of the ground truth, with the constants of the scene's dataset."""
    fixed = constants(require_truth(scene)[0].dataset)
    volume = TsdfVolume(voxel=fixed.voxel, truncation=fixed.truncation, device=device)
    for frame in fusion_frames(scene, prediction, posed=posed):
        volume.integrate(frame.depth_z, frame.K, frame.T_cam_world, depth_limit=fixed.depth_limit)
    return volume.extract_mesh()
