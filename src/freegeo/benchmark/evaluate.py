"""Scoring stored predictions against the ground truth of the published datasets.

One scene at a time: `score_scene_poses` and `score_scene_surface`; `SceneReference` holds the prepared ground truth,
which depends on no model, view count or frame seed and is worth keeping. `with_mean` gives the published score files.
"""

import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from freegeo.benchmark.frames import fusion_frames, require_prediction, require_truth
from freegeo.data.datasets.base import Protocol, SceneTruth
from freegeo.data.datasets.registry import protocol
from freegeo.data.scene import Scene
from freegeo.errors import FreeGeoError, UserError
from freegeo.files import write_npz
from freegeo.fusion.mesh import Mesh, empty_mesh_substitute, read_mesh, read_points, sample_surface
from freegeo.fusion.tsdf import TsdfVolume
from freegeo.geometry import se3
from freegeo.metrics.cloud import CloudScore, ReferenceCloud
from freegeo.metrics.pose import score_poses
from freegeo.types import Prediction

logger = logging.getLogger(__name__)

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
    protocol: Protocol

    def score(self, points: np.ndarray) -> CloudScore:
        """Score predicted points (n, 3), cut to the box of the ground truth where the dataset asks for it."""
        margin = self.protocol.crop_margin
        if margin is not None:
            low, high = self.box
            points = points[((points >= low - margin) & (points <= high + margin)).all(axis=-1)]
        return self.cloud.score(points, threshold=self.protocol.threshold)


@dataclass(frozen=True, kw_only=True)
class SurfaceScore:
    """Score of one fused surface."""

    cloud: CloudScore
    empty_mesh: bool
    """Whether the fusion gave no triangle, so that the protocol's random points were scored in its place."""
    vertices: int
    triangles: int


def load_reference(scene: Scene, *, seed: int = REFERENCE_SEED_OFFSET, cache: Path | None = None) -> SceneReference:
    """Read and prepare the ground truth of a scene.

    Args:
        scene: with ground truth.
        seed: of the points drawn from a ground-truth mesh; a stored cloud is used as it is.
        cache: folder where the prepared points of a mesh are kept for the next run. They belong to the mesh file as it
            is (name, size, date), to the seed and to the protocol.

    Raises:
        UserError: there is no ground truth, or its file is missing.
    """
    truth, _, _ = require_truth(scene)
    rules = protocol(truth.dataset)
    if rules.truth == "points":
        return _prepared(read_points(truth.surface), rules)
    kept = None if cache is None or not truth.surface.is_file() else cache / f"{_mesh_digest(truth, rules, seed)}.npz"
    if kept is not None and kept.is_file():
        with np.load(kept, allow_pickle=False) as content:
            cloud = ReferenceCloud.restored(content["points"], down_sample=rules.down_sample)
            return SceneReference(cloud=cloud, box=(content["low"], content["high"]), protocol=rules)
    reference = _prepared(sample_surface(read_mesh(truth.surface), rules.samples, seed=seed), rules)
    if kept is not None:
        write_npz(kept, {"points": reference.cloud.points, "low": reference.box[0], "high": reference.box[1]})
    return reference


def _prepared(points: np.ndarray, rules: Protocol) -> SceneReference:
    cloud = ReferenceCloud(points, down_sample=rules.down_sample)
    return SceneReference(cloud=cloud, box=(points.min(axis=0), points.max(axis=0)), protocol=rules)


def _mesh_digest(truth: SceneTruth, rules: Protocol, seed: int) -> str:
    facts = truth.surface.stat()
    what = (str(truth.surface.resolve()), facts.st_size, facts.st_mtime_ns, seed, rules.samples, rules.down_sample)
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

    Source: benchmark protocol, sections 6 to 8.
    """
    reference = reference or load_reference(scene, seed=seed + REFERENCE_SEED_OFFSET)
    mesh = fuse_scene(scene, prediction, posed=posed, device=device)
    samples = reference.protocol.samples
    if mesh.is_empty:
        logger.warning("The fusion of %s gave no surface; random points are scored, as published.", scene.name)
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
    rules = protocol(require_truth(scene)[0].dataset)
    volume = TsdfVolume(voxel=rules.voxel, truncation=rules.truncation, device=device)
    for frame in fusion_frames(scene, prediction, posed=posed):
        volume.integrate(frame.depth_z, frame.K, frame.T_cam_world, depth_limit=rules.depth_limit)
    return volume.extract_mesh()


def with_mean(scores: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Scores per scene plus their plain `mean` over the scenes, the layout of the published score files.

    Raises:
        UserError: there is no scene, or one is called `mean`.
    """
    if not scores or "mean" in scores:
        raise UserError('A mean needs at least one scene, and no scene may be called "mean".')
    keys = next(iter(scores.values()))
    mean = {key: float(np.mean([score[key] for score in scores.values()])) for key in keys}
    return {**{scene: dict(score) for scene, score in scores.items()}, "mean": mean}


def mean_over_seeds(runs: Sequence[Mapping[str, Mapping[str, float]]]) -> dict[str, float]:
    """Mean over all (scene, seed) entries of several runs without their `mean`; a missing scene has no entry."""
    entries = [score for run in runs for scene, score in run.items() if scene != "mean"]
    if not entries:
        raise UserError("There is no score to average.")
    return {key: float(np.mean([entry[key] for entry in entries])) for key in entries[0]}


def read_published_prediction(path: Path) -> Prediction:
    """Read a stored result in the published layout: `depth`, `extrinsics`, `intrinsics`, optionally `conf`.

    Depth may carry a last dimension of one; extrinsics may be (S, 3, 4) or (S, 4, 4).

    Raises:
        UserError: there is no such file. FreeGeoError: a key is missing or the file is damaged.

    Source: benchmark protocol, section 3.
    """
    if not Path(path).is_file():
        raise UserError(f"There is no stored prediction {path}.")
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {key: torch.from_numpy(stored[key]) for key in ("depth", "extrinsics", "intrinsics")}
            conf = torch.from_numpy(stored["conf"]) if "conf" in stored else None
    except (KeyError, ValueError, OSError, EOFError) as error:
        raise FreeGeoError(f"{path} is not a readable prediction ({error}).") from error
    return Prediction(
        depth_z=_without_last(arrays["depth"]),
        conf=conf,
        T_cam_world=se3.to_4x4(arrays["extrinsics"]),
        K=arrays["intrinsics"],
    )


def select_views(prediction: Prediction, views: Sequence[int]) -> Prediction:
    """The chosen views of an unbatched prediction, in the order given."""
    index = torch.as_tensor(list(views), dtype=torch.long)
    return prediction.map(lambda tensor: tensor[index.to(tensor.device)])


def _without_last(depth: Tensor) -> Tensor:
    return depth[..., 0] if depth.ndim == 4 and depth.shape[-1] == 1 else depth
