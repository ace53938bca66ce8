"""Second stage: score stored predictions, without the model.

Metrics: `auc03` to `auc30`; of the fused surface `acc`, `comp`, `overall`, `precision`, `recall`, `fscore`; where the
depth of frames is known `abs_rel`, `delta1`, for generated rooms also `f1_rel5`; `mse` and `cosine` of features;
`seconds` and `peak_gb` of the pass, and of an adapter `adapt_seconds`, `adapt_steps`, `adapt_peak_gb`, `trainable`.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

import torch

from freegeo.benchmark.adapters import FINISHED, FOLDER, Facts
from freegeo.benchmark.frames import require_prediction
from freegeo.benchmark.paper.variants import variant
from freegeo.benchmark.predict import problem_of
from freegeo.benchmark.results import Row, rows_of, write_results
from freegeo.benchmark.scene_score import (
    GROUND_TRUTH,
    SceneReference,
    load_reference,
    score_scene_poses,
    score_scene_surface,
)
from freegeo.benchmark.stored import Stored, read_stored
from freegeo.benchmark.tasks import (
    MEASURED_FILE,
    SCORES_FILE,
    Problem,
    Task,
    by_scene,
    reason_of,
    run_each,
    stored_tasks,
)
from freegeo.data.datasets.registry import load_scene, true_depth
from freegeo.data.scene import Scene
from freegeo.errors import DamagedError, FreeGeoError, UserError
from freegeo.files import read_json, remove_file, write_json
from freegeo.metrics.cloud import f1_rel5
from freegeo.metrics.depth import score_depth
from freegeo.metrics.scene import at_size
from freegeo.run_folder import difference

logger = logging.getLogger(__name__)

EMPTY_SURFACE = "the fusion gave no surface: precision, recall and F1 are 0, distances do not exist"
_SAME_IN_ALL = ("model", "checkpoint", "precision", "given_cameras")
_SAME_IN_VARIANT = ("per", "epoch", "recipe", "seed", "scenes")


class _Scores(TypedDict):
    """Content of `SCORES_FILE`."""

    metrics: dict[str, float]
    failed: dict[str, str]


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """The outcome of scoring a folder: rows of the tidy table, problems, and the files written."""

    rows: list[Row]
    problems: list[Problem]
    files: list[Path]


def evaluate_all(
    data: Path,
    out: Path,
    *,
    wanted: Sequence[Task] | None = None,
    device: str | torch.device = "cpu",
    on_task: Callable[[Task], None] = lambda task: None,
) -> Evaluation:
    """Score the stored predictions of a folder (of `wanted` tasks, or all) and write the tidy table of all of them.

    Existing scores are kept. A wanted task without a prediction is reported as a problem.

    Raises:
        UserError: nothing is stored, or the predictions were made with different settings; the settings are named.
    """
    stored = dict(stored_tasks(out))
    if not stored:
        raise UserError(f"{out}: holds no predictions. Run `freegeo bench predict` first.")
    require_same_settings(stored)
    asked = list(stored) if wanted is None else [task for task in wanted if task in stored]
    problems: list[Problem] = []
    for (dataset, name), tasks in by_scene(asked).items():
        ground = _Ground(data, dataset, name, out / GROUND_TRUTH)
        problems += run_each(
            tasks,
            lambda task, ground=ground: _scored(task, stored[task], ground, out, device),
            problem_of("evaluate"),
            on_task,
        )
    missing = [] if wanted is None else [task for task in dict.fromkeys(wanted) if task not in stored]
    problems += [problem_of("evaluate")(task, FreeGeoError("no stored prediction")) for task in missing]
    rows = [row for task, record in stored.items() for row in _rows(task, record, out)]
    return Evaluation(rows=rows, problems=problems, files=write_results(out, rows))


def require_same_settings(stored: Mapping[Task, Mapping[str, Any]]) -> None:
    """Refuse to put predictions of different settings into one table; UserError names settings and folders."""
    first: tuple[Task, Mapping[str, Any]] | None = None
    of_variant: dict[tuple[str, ...], tuple[Task, Mapping[str, Any]]] = {}
    for task, record in stored.items():
        configuration = record["configuration"]
        common = {name: configuration.get(name) for name in _SAME_IN_ALL}
        first = first or (task, common)
        _require_equal(first, (task, common))
        adaptation = configuration.get("adaptation")
        if adaptation is not None:
            # A scene-wise adapter is trained on its own scene only, so the scenes differ.
            names = [name for name in _SAME_IN_VARIANT if name != "scenes" or adaptation["per"] == "dataset"]
            chosen = {f"adaptation.{name}": adaptation[name] for name in names}
            known = of_variant.setdefault((task.dataset, task.variant), (task, chosen))
            _require_equal(known, (task, chosen))


def _require_equal(one: tuple[Task, Mapping[str, Any]], other: tuple[Task, Mapping[str, Any]]) -> None:
    unequal = difference(one[1], other[1])
    if unequal:
        raise UserError(
            f"predictions of different settings cannot share a table: {unequal} ({one[0]}; {other[0]}). "
            "Predict one of them again with --overwrite, or use another output folder."
        )


class _Ground:
    """A scene with its ground truth, each read once, on first use."""

    def __init__(self, data: Path, dataset: str, name: str, cache: Path):
        self.data, self.dataset, self.name, self.cache = data, dataset, name, cache
        self._scene: Scene | None = None
        self._reference: SceneReference | None = None

    def scene(self) -> Scene:
        """The scene with all its frames."""
        self._scene = self._scene or load_scene(self.data, self.dataset, self.name)
        return self._scene

    def reference(self) -> SceneReference:
        """Its ground-truth cloud with the search tree."""
        self._reference = self._reference or load_reference(self.scene(), cache=self.cache)
        return self._reference


def _scored(
    task: Task, record: Mapping[str, Any], ground: _Ground, out: Path, device: str | torch.device
) -> list[Problem]:
    """Score one task unless that has been done without a failure; returns the parts that could not be scored."""
    path = task.folder(out) / SCORES_FILE
    scores = _stored_scores(path)
    if scores is not None and not scores["failed"]:
        return []
    remove_file(path)
    if variant(task.variant).measures == "features":
        measured = read_json(task.folder(out) / MEASURED_FILE, dict[str, float])
        write_json(path, {"metrics": measured, "failed": {}})
        return []
    stored = read_stored(task, out)
    scene = ground.scene()
    if max(stored.frames) >= len(scene):
        raise FreeGeoError(f"frame {max(stored.frames)} was predicted, but the data folder holds {len(scene)} frames")
    posed = bool(record["configuration"].get("given_cameras"))
    metrics, failed = _metrics(scene.select(stored.frames), stored, ground, device, posed=posed)
    write_json(path, {"metrics": metrics, "failed": failed})
    return _problems(task, failed)


def _metrics(
    chosen: Scene, stored: Stored, ground: _Ground, device: str | torch.device, *, posed: bool
) -> tuple[dict[str, float], dict[str, str]]:
    """The metrics that could be computed, and the reasons why others could not."""
    metrics: dict[str, float] = {}
    failed: dict[str, str] = {}

    def part(name: str, work: Callable[[], Mapping[str, float]]) -> Iterable[Problem]:
        for metric, value in work().items():
            if math.isfinite(value):
                metrics[metric] = value
            else:
                failed.setdefault(name, f"{metric} is not finite")
        return ()

    def surface() -> dict[str, float]:
        score = score_scene_surface(chosen, stored.prediction, posed=posed, reference=ground.reference(), device=device)
        if score.empty_mesh:
            failed["surface"] = EMPTY_SURFACE
            return {"precision": 0.0, "recall": 0.0, "fscore": 0.0}
        return score.cloud.as_dict()

    def cameras() -> dict[str, float]:
        if not bool(torch.as_tensor(stored.prediction.T_cam_world).isfinite().all()):
            failed["poses"] = "predicted poses hold values that are not finite; their pairs count as failures"
        return score_scene_poses(chosen, stored.prediction)

    parts = {"poses": cameras, "surface": surface}
    if chosen.depth_z is not None:
        parts["points"] = lambda: _point_metrics(chosen, stored)
    parts["depth"] = lambda: _depth_metrics(chosen, stored)
    for name, work in parts.items():
        for problem in run_each(
            [name],
            lambda name, work=work: part(name, work),
            lambda name, error: Problem(dataset="", scene="", stage="evaluate", what=name, reason=reason_of(error)),
        ):
            failed[problem.what] = problem.reason
    return metrics, failed


def _point_metrics(chosen: Scene, stored: Stored) -> dict[str, float]:
    depth_z, T_cam_world, K = require_prediction(chosen, stored.prediction)
    assert chosen.depth_z is not None and chosen.K is not None and chosen.T_cam_world is not None
    depth_true, K_true = at_size(chosen.depth_z, chosen.K, (depth_z.shape[-2], depth_z.shape[-1]))
    return {"f1_rel5": f1_rel5(depth_z, K, T_cam_world, depth_true, K_true, chosen.T_cam_world).fscore}


def _depth_metrics(chosen: Scene, stored: Stored) -> dict[str, float]:
    depth_z = stored.prediction.depth_z
    assert depth_z is not None
    depth_true = true_depth(chosen, (depth_z.shape[-2], depth_z.shape[-1]))
    if depth_true is None:
        return {}
    score = score_depth(depth_z, depth_true)
    return {"abs_rel": float(score.abs_rel), "delta1": float(score.delta1)}


def _stored_scores(path: Path) -> dict[str, Any] | None:
    """Return what a task was scored with; None where it has not been, or its file is damaged."""
    try:
        return read_json(path, _Scores) if path.is_file() else None
    except DamagedError as error:
        logger.warning("%s: the stored scores are damaged (%s); they are computed again.", path, error.reason)
        return None


def _problems(task: Task, failed: Mapping[str, str]) -> list[Problem]:
    what = f"{task.views} views, seed {task.seed}, {task.variant}"
    return [
        Problem(dataset=task.dataset, scene=task.scene, stage="evaluate", what=f"{name} ({what})", reason=reason)
        for name, reason in failed.items()
    ]


def _rows(task: Task, record: Mapping[str, Any], out: Path) -> list[Row]:
    path = task.folder(out) / SCORES_FILE
    scores = _stored_scores(path)
    if scores is None:
        return []
    metrics = {**scores["metrics"], **_costs(record, out)}
    return rows_of(task, record["configuration"]["model"], len(record["frames"]), metrics)


def _costs(record: Mapping[str, Any], out: Path) -> dict[str, float]:
    costs = {name: record[name] for name in ("seconds", "peak_gb") if record.get(name) is not None}
    finished = Path(out) / FOLDER / record["task"]["dataset"] / str(record.get("adapter")) / FINISHED
    if os.path.isfile(finished):  # noqa: PTH113 (false for a name that is too long for a file, too)
        facts = read_json(finished, Facts)
        costs |= {f"adapt_{name}": facts[name] for name in ("steps", "seconds", "peak_gb")}
        costs["trainable"] = facts["trainable"]
    return costs
