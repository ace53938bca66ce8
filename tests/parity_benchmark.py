"""The benchmark code against recorded values of the published evaluation.

`cases(folder)` walks a folder laid out like `tests/fixtures/benchmark` (whatever part of it is there) and yields a name
and a function per case; the function returns the worst error divided by its tolerance, so a value up to 1 is a pass.
Tolerances are those of the recording's own description.
"""

import json
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path

import numpy as np
import torch

from fixture_tools import DEVICE
from freegeo.benchmark import sampling
from freegeo.benchmark.frames import fusion_frames
from freegeo.benchmark.scene_score import (
    fuse_scene,
    load_reference,
    score_scene_poses,
    score_scene_surface,
)
from freegeo.data.colmap_files import read_cameras, read_images
from freegeo.data.datasets import registry as datasets
from freegeo.data.datasets.scannetpp import undistorted
from freegeo.fusion.mesh import Mesh, empty_mesh_substitute, sample_surface
from freegeo.fusion.tsdf import TsdfVolume
from freegeo.geometry.se3 import to_4x4
from freegeo.metrics.cloud import score_clouds, voxel_average
from freegeo.metrics.pose import pair_errors, pose_auc
from freegeo.types import Prediction

Case = tuple[str, Callable[[], float]]
FAILED = float("inf")
SURFACE_TOLERANCE = {  # absolute, relative
    "fscore": (0.003, 0.0),
    "recall": (0.003, 0.0),
    "precision": (0.005, 0.0),
    "acc": (0.0, 0.03),
    "comp": (0.0, 0.015),
    "overall": (0.0, 0.015),
}


def cases(folder: Path) -> Iterator[Case]:
    """Every recorded case below the folder."""
    folder = Path(folder)
    for part in (_pose, _histograms, _recon, _voxels, _sampling, _tsdf, _mesh_sampling, _datasets):
        yield from part(folder)


def _read(path: Path):
    if not path.is_file():
        return []
    return json.loads(path.read_text(encoding="utf-8"))


def _number(value) -> float:
    return float(value)  # "inf", "-inf" and "nan" are written as strings


def _difference(value: float, expected) -> float:
    expected = _number(expected)
    return 0.0 if value == expected or (np.isnan(value) and np.isnan(expected)) else abs(value - expected)


# --- pose ------------------------------------------------------------------------------------------------------------


def _pose(folder: Path) -> Iterator[Case]:
    arrays = _arrays(folder / "pose" / "pose_cases.npz")
    for case in _read(folder / "pose" / "pose_cases.json"):
        yield f"pose/{case['name']}", partial(_pose_error, case, arrays)


def _pose_error(case: dict, arrays) -> float:
    """Compare a case; errors by their cosines, since that is what is rounded: an angle near zero is the root of that.

    Recorded errors are float32 numbers. Three products of matrices round each entry by at most 4 units each, in the
    prediction and in the truth, and the cosine is twice the square of what they are part of: 48 units.
    """
    name = case["name"]
    errors = pair_errors(torch.from_numpy(arrays[f"{name}/pred"]), torch.from_numpy(arrays[f"{name}/gt"]))
    auc = pose_auc(errors.worst_deg)
    worst = max(_difference(auc[key], value) for key, value in case["expected"].items()) / 1e-6
    if not case["strict"]:
        return worst
    for mine, key in ((errors.rotation_deg, "rot_err_deg"), (errors.translation_deg, "trans_err_deg")):
        recorded = arrays[f"{name}/{key}"].astype(np.float64)
        usable = np.isfinite(recorded) & (recorded < 1e6)
        ratio = np.abs(np.cos(np.deg2rad(mine.double().numpy())) - np.cos(np.deg2rad(recorded))) / (48 * 2**-24)
        worst = max(worst, ratio[usable].max(initial=0.0))
    return float(worst)


def _histograms(folder: Path) -> Iterator[Case]:
    for number, case in enumerate(_read(folder / "pose" / "auc_histogram.json")):
        yield f"auc_histogram/{number}", partial(_histogram_error, case)


def _histogram_error(case: dict) -> float:
    worst = torch.maximum(torch.tensor(case["rot"]).double(), torch.tensor(case["trans"]).double())
    thresholds = {int(key.split("@")[1]): value for key, value in case["expected"].items()}
    auc = pose_auc(worst, tuple(thresholds))
    return max(_difference(auc[f"auc{t:02d}"], value) for t, value in thresholds.items()) / 1e-6


# --- clouds ----------------------------------------------------------------------------------------------------------


def _recon(folder: Path) -> Iterator[Case]:
    arrays = _arrays(folder / "recon" / "recon_cases.npz")
    for case in _read(folder / "recon" / "recon_cases.json"):
        yield f"recon/{case['name']}", partial(_recon_error, case, arrays)


def _recon_error(case: dict, arrays) -> float:
    score = score_clouds(
        arrays[f"{case['name']}/pred"],
        arrays[f"{case['name']}/gt"],
        threshold=case["threshold"],
        down_sample=case["down_sample"],
    ).as_dict()
    return max(_difference(score[key], value) for key, value in case["expected"].items()) / 1e-9


def _voxels(folder: Path) -> Iterator[Case]:
    arrays = _arrays(folder / "recon" / "voxel_downsample.npz")
    for case in _read(folder / "recon" / "voxel_downsample.json"):
        yield f"voxel_downsample/{case['name']}", partial(_voxel_error, case, arrays)


def _voxel_error(case: dict, arrays) -> float:
    mine = voxel_average(arrays[f"{case['name']}/points"], case["voxel"])
    mine = mine[np.lexsort(np.round(mine, 9).T)]
    recorded = arrays[f"{case['name']}/downsampled_sorted"]
    return FAILED if mine.shape != recorded.shape else float(np.abs(mine - recorded).max() / 1e-9)


# --- frame sampling --------------------------------------------------------------------------------------------------


def _sampling(folder: Path) -> Iterator[Case]:
    recorded = _read(folder / "sampling" / "sampling_cases.json") or {}
    rules = {"da3": _standard, "vggt": _vggt, "multiview": _multiview}
    for kind, entries in recorded.items():
        yield f"sampling/{kind}", partial(_sampling_error, rules[kind], entries)


def _sampling_error(rule: Callable[[dict], list[int]], entries: list[dict]) -> float:
    wrong = [entry for entry in entries if rule(entry) != entry["indices"]]
    return FAILED if wrong else 0.0


def _standard(case: dict) -> list[int]:
    return sampling.standard_frames(case["num_frames"], case["max_frames"], case["seed"])


def _vggt(case: dict) -> list[int]:
    if case["subset_sampling"]:
        return sampling.window_frames(case["num_frames"], case["max_frames"], case["seed"])
    if case["eval_frames"] is None:
        return _standard(case)
    return sampling.every_second_frame(case["num_frames"], case["max_frames"], case["eval_frames"], case["seed"])


def _multiview(case: dict) -> list[int]:
    return sampling.multiview_frames(
        case["dataset"], case["scene"], case["num_frames"], case["view_count"], case["seed"]
    )


# --- fusion ----------------------------------------------------------------------------------------------------------


def _tsdf(folder: Path) -> Iterator[Case]:
    arrays = _arrays(folder / "fusion" / "tsdf_cases.npz")
    for case in _read(folder / "fusion" / "tsdf_cases.json"):
        if arrays is not None and f"{case['name']}/depths" in arrays:
            yield f"tsdf/{case['name']}", partial(_tsdf_error, case, arrays)


def _tsdf_error(case: dict, arrays) -> float:
    from scipy.spatial import cKDTree

    name = case["name"]
    volume = TsdfVolume(voxel=case["voxel_length"], truncation=case["sdf_trunc"], device=DEVICE)
    frames = zip(*(arrays[f"{name}/{key}"] for key in ("depths", "intrinsics", "extrinsics")), strict=True)
    for depth, K, T in frames:
        volume.integrate(*(torch.from_numpy(a).to(DEVICE) for a in (depth, K, T)), depth_limit=case["max_depth"])
    mesh = volume.extract_mesh()
    worst = _mesh_error(mesh, case, count_tolerance=5e-4)
    recorded = arrays[f"{name}/vertices_sorted"].astype(np.float64)
    for here, there in ((recorded, mesh.vertices), (mesh.vertices, recorded)):
        distance = cKDTree(there).query(here)[0] / case["voxel_length"]
        worst = max(worst, (distance > 0.002).mean() / 0.01, (distance > 0.01).mean() / 0.001)
    return float(worst)


def _mesh_error(mesh: Mesh, recorded: dict, *, count_tolerance: float) -> float:
    vertices = abs(len(mesh.vertices) / recorded["n_vertices"] - 1) / count_tolerance
    triangles = abs(len(mesh.triangles) / recorded["n_triangles"] - 1) / count_tolerance
    return max(vertices, triangles, abs(mesh.area / recorded["surface_area"] - 1) / 1e-4)


def _mesh_sampling(folder: Path) -> Iterator[Case]:
    arrays = _arrays(folder / "fusion" / "mesh_sampling.npz")
    for case in _read(folder / "fusion" / "mesh_sampling.json"):
        yield f"mesh_sampling/{case['name']}", partial(_mesh_sampling_error, case, arrays)


def _mesh_sampling_error(case: dict, arrays) -> float:
    name, count = case["name"], case["num_points"]
    if case["seed"] is None:
        points = empty_mesh_substitute(count)
    else:
        mesh = Mesh(vertices=arrays[f"{name}/vertices"], triangles=arrays[f"{name}/triangles"])
        points = sample_surface(mesh, count, seed=case["seed"])
    return 0.0 if np.array_equal(points, arrays[f"{name}/points"]) else FAILED


# --- miniature datasets ----------------------------------------------------------------------------------------------


def _datasets(folder: Path) -> Iterator[Case]:
    for path in sorted((folder / "expected").glob("*.json")):
        recorded = _read(path)
        dataset = recorded["dataset"]
        yield f"{dataset}/parameters", partial(_parameter_error, dataset, recorded["parameters"])
        for scene, entry in recorded["scenes"].items():
            if (folder / "datasets" / dataset / entry["loader"]["image_files"][0]).is_file():
                yield from _scene_cases(folder, dataset, scene, entry)
        here = [scene for scene in recorded["scenes"] if _prediction_path(folder, dataset, scene).is_file()]
        if len(here) == len(recorded["scenes"]):
            for views, seeds in recorded["pipeline"]["runs"].items():
                for seed, run in seeds.items():
                    yield f"{dataset}/pipeline/{views}/{seed}", partial(_run_error, folder, dataset, views, seed, run)


def _scene_cases(folder: Path, dataset: str, scene: str, recorded: dict) -> Iterator[Case]:
    name = f"{dataset}/{scene.replace('/', '-')}"
    yield f"{name}/loader", partial(_loader_error, folder, dataset, scene, recorded["loader"])
    if dataset == "scannetpp":
        yield f"{name}/cameras", partial(_camera_error, folder, scene, recorded["loader"])
    yield f"{name}/gt_mask", partial(_gt_mask_error, folder, dataset, scene, recorded["gt_mask"])
    full = recorded["full_sequence"]
    if not _prediction_path(folder, dataset, scene).is_file():
        return
    yield f"{name}/pose", partial(_full_pose_error, folder, dataset, scene, full["pose"])
    for mode in ("recon_unposed", "recon_posed"):
        yield f"{name}/{mode}/fusion", partial(_fusion_error, folder, dataset, scene, mode, full[mode])
        yield f"{name}/{mode}/score", partial(_surface_error, folder, dataset, scene, mode, full[mode])


@cache
def _arrays(path: Path):
    if not path.is_file():
        return None
    with np.load(path, allow_pickle=False) as stored:
        return dict(stored)


def _prediction_path(folder: Path, dataset: str, scene: str) -> Path:
    return folder / "predictions" / dataset / f"{scene.replace('/', '-')}.npz"


@cache
def _scene(folder: Path, dataset: str, scene: str):
    return datasets.load_scene(folder / "datasets", dataset, scene)


@cache
def _loaded(folder: Path, dataset: str, scene: str):
    prediction = read_published_prediction(_prediction_path(folder, dataset, scene))
    return _scene(folder, dataset, scene), prediction


@cache
def _reference(folder: Path, dataset: str, scene: str):
    return load_reference(_scene(folder, dataset, scene))


def read_published_prediction(path: Path) -> Prediction:
    """Read a result of the released evaluation; depth may carry a last dimension of one, extrinsics be (S, 3, 4)."""
    with np.load(path, allow_pickle=False) as stored:
        arrays = {key: torch.from_numpy(stored[key]) for key in ("depth", "extrinsics", "intrinsics")}
    depth = arrays["depth"]
    return Prediction(
        depth_z=depth[..., 0] if depth.ndim == 4 else depth,
        T_cam_world=to_4x4(arrays["extrinsics"]),
        K=arrays["intrinsics"],
    )


def select_views(prediction: Prediction, views: list[int]) -> Prediction:
    """The chosen views of an unbatched prediction, in the order given."""
    return prediction.map(lambda tensor: tensor[views])


def _with_mean(scores: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """Scores per scene plus their plain mean, the layout of the released score files."""
    keys = next(iter(scores.values()))
    return {**scores, "mean": {key: float(np.mean([score[key] for score in scores.values()])) for key in keys}}


def _parameter_error(dataset: str, recorded: dict) -> float:
    fixed = datasets.constants(dataset)
    mine = {
        "voxel_length": fixed.voxel,
        "sdf_trunc": fixed.truncation,
        "max_depth": fixed.depth_limit,
        "sampling_number": fixed.samples,
        "eval_threshold": fixed.threshold,
        "down_sample": fixed.down_sample,
    }
    return 0.0 if all(mine[key] == recorded[key] for key in mine) else FAILED


def _loader_error(folder: Path, dataset: str, scene: str, recorded: dict) -> float:
    loaded = _scene(folder, dataset, scene)
    root = folder / "datasets" / dataset
    truth = loaded.truth
    assert truth is not None
    files = [photo.path.relative_to(root).as_posix() for photo in loaded.photos]
    if files != recorded["image_files"] or truth.surface.relative_to(root).as_posix() != recorded["ground_truth"]:
        return FAILED
    for key, paths in (("gt_depth_files", truth.depth), ("aliasing_mask_files", truth.mask)):
        # A recorded path may name a file that does not exist; here that is None.
        expected = [root / path if path else None for path in recorded.get(key, [])]
        if expected and [path if path and path.is_file() else None for path in expected] != list(paths):
            return FAILED
    intrinsics_tolerance = 1e-4 if dataset == "scannetpp" else 1e-6
    return max(
        _relative_error(loaded.T_cam_world, recorded["extrinsics"]) / 1e-6,
        _relative_error(loaded.K, recorded["intrinsics"]) / intrinsics_tolerance,
    )


def _relative_error(mine, recorded) -> float:
    recorded = np.asarray(recorded, np.float64)
    return float((np.abs(np.asarray(mine, np.float64) - recorded) / np.maximum(np.abs(recorded), 1.0)).max())


def _camera_error(folder: Path, scene: str, recorded: dict) -> float:
    model = folder / "datasets" / "scannetpp" / scene / "merge_dslr_iphone" / "colmap" / "sparse_render_rgb"
    cameras, images = read_cameras(model), {image.name: image for image in read_images(model)}
    worst = 0.0
    for number, path in enumerate(recorded["image_files"]):
        camera = cameras[images[path.split("/images/")[1]].camera]
        mine = undistorted(camera)
        if list(mine.roi) != recorded["roi"][number] or list(camera.size_hw) != recorded["cam_hw"][number]:
            return FAILED
        worst = max(worst, _relative_error(mine.distortion, recorded["dist"][number]) / 1e-6)
        worst = max(worst, _relative_error(mine.K_raw, recorded["raw_intrinsics"][number]) / 1e-6)
    return worst


def _gt_mask_error(folder: Path, dataset: str, scene: str, recorded: list) -> float:
    loaded = _scene(folder, dataset, scene)
    for index, expected in enumerate(recorded):
        size_hw = datasets.constants(dataset).fusion_hw or loaded.photos[index].size_hw
        mask = datasets.valid_mask(loaded.truth, index, size_hw)
        mine = None if mask is None else {"shape": list(mask.shape), "valid": int(mask.sum())}
        if mine != expected:
            return FAILED
    return 0.0


def _full_pose_error(folder: Path, dataset: str, scene: str, recorded: dict) -> float:
    auc = score_scene_poses(*_loaded(folder, dataset, scene))
    return max(_difference(auc[key], value) for key, value in recorded.items()) / 1e-6


def _fusion_error(folder: Path, dataset: str, scene: str, mode: str, recorded: dict) -> float:
    loaded, prediction = _loaded(folder, dataset, scene)
    posed = mode == "recon_posed"
    expected = recorded["fusion_input"]
    count_tolerance = 1e-3 if dataset == "scannetpp" else 1e-12
    worst = 0.0
    for index, frame in enumerate(fusion_frames(loaded, prediction, posed=posed)):
        if list(frame.depth_z.shape) != expected["image_hw"]:
            return FAILED
        positive = frame.depth_z[frame.depth_z > 0].double()
        count, total = expected["positive_depth_pixels"][index], expected["positive_depth_sum"][index]
        holes = int(frame.depth_z.isnan().sum())
        worst = max(
            worst,
            abs(len(positive) / count - 1) / count_tolerance,
            abs(float(positive.sum()) / total - 1) / 1e-5,
            abs(holes - expected["nan_pixels"][index]) / max(1.0, holes) / count_tolerance,
            _relative_error(frame.K, expected["intrinsics"][index]) / (1e-4 if dataset == "scannetpp" else 1e-6),
        )
    mesh = fuse_scene(loaded, prediction, posed=posed)
    return max(worst, _mesh_error(mesh, recorded["mesh"], count_tolerance=1e-3))


def _surface_error(folder: Path, dataset: str, scene: str, mode: str, recorded: dict) -> float:
    loaded, prediction = _loaded(folder, dataset, scene)
    reference = _reference(folder, dataset, scene)
    score = score_scene_surface(loaded, prediction, posed=mode == "recon_posed", reference=reference)
    return _surface_ratio(score.cloud.as_dict(), recorded["metrics_mean"])


def _surface_ratio(score: dict, recorded: dict) -> float:
    ratios = []
    for key, (absolute, relative) in SURFACE_TOLERANCE.items():
        ratios.append(_difference(score[key], recorded[key]) / (absolute + relative * abs(_number(recorded[key]))))
    return max(ratios)


def _run_error(folder: Path, dataset: str, views: str, seed: str, run: dict) -> float:
    poses, surfaces = {}, {}
    for scene, indices in run["indices"].items():
        loaded, prediction = _loaded(folder, dataset, scene)
        chosen = sampling.standard_frames(len(loaded.photos), int(views), int(seed))
        if chosen != indices:
            return FAILED
        loaded, prediction = loaded.select(chosen), select_views(prediction, chosen)
        poses[scene] = score_scene_poses(loaded, prediction)
        reference = _reference(folder, dataset, scene)
        surfaces[scene] = score_scene_surface(loaded, prediction, reference=reference).cloud.as_dict()
    worst = 0.0
    for scene, score in _with_mean(poses).items():
        worst = max(worst, *(_difference(score[key], value) / 1e-6 for key, value in run["pose"][scene].items()))
    for scene, score in _with_mean(surfaces).items():
        worst = max(worst, _surface_ratio(score, run["recon_unposed"][scene]))
    return worst
