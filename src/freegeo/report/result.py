"""The reconstructions of an output folder, moved into one world frame and scale for comparison.

A model before and after adaptation gives two reconstructions, each with its own world frame and scale, and refinement a
third. With ground truth all are moved onto it, otherwise those before onto the result.

A result may have hundreds of views, and its files may be mapped into memory. Of more than `MANY_VIEWS` views only every
n-th pixel of each row and column is copied, which is enough for points and for ranges of colours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from freegeo.errors import FreeGeoError, UserError
from freegeo.export.alignment import align, median_ratio, moved_cameras, similarity, valid_pixels
from freegeo.export.formats import filter_reconstruction
from freegeo.export.kept import Filtered, load_kept
from freegeo.export.reconstruction import FILE_NAME, Reconstruction
from freegeo.files import FORMAT
from freegeo.geometry.depth import depth_to_world
from freegeo.geometry.rotation import rotation_angle
from freegeo.geometry.se3 import camera_centres
from freegeo.geometry.sim3 import Sim3
from freegeo.report.schema import AdapterNotes, DemoScores, Summary, read_part

SUMMARY_NAME, SCORES_NAME, REPORT_NAME = "reconstruction.json", "scores.json", "report.html"
FROZEN_FOLDER, UNREFINED_FOLDER, TRUTH_FOLDER = "frozen", "unrefined", "truth"
ADAPTER_PAGE = "adapter/freegeo.json"
MANY_VIEWS = 48
"""Up to so many views, all pixels are read and all views are shown."""
MOST_PIXELS = 4_000_000
"""About so many pixels of each stage are read of more views."""
FEWEST_OF_A_PATH, STEP_OF_A_PATH = 8, 1.5
"""Views of a path, unless they are a sequence; and how many times as far as the nearest camera the next one is."""
LABELS = {"frozen": "frozen", "adapted": "adapted", "refined": "refined", "truth": "ground truth"}


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One reconstruction in the common frame and scale; its maps (S, H, W) have every `Result.step`-th pixel."""

    key: str
    """`frozen`, `adapted`, `refined` or `truth`."""
    depth_z: np.ndarray
    """(S, H, W) float32."""
    conf: np.ndarray
    """(S, H, W) float32."""
    T_cam_world: np.ndarray | None
    """(S, 4, 4) float32."""
    K: np.ndarray | None
    """(S, 3, 3) float32, of these maps."""
    keep: np.ndarray
    """(S, H, W) bool: what the export's filters keep; all valid depth of ground truth or without cameras."""
    removed: Mapping[str, int]
    """Of all pixels, those removed by each filter; empty where none ran."""
    scale: float = 1.0
    """Factor from the file's depth to `depth_z`."""
    error: np.ndarray | None = None
    """(S, H, W) float32 |d - d_true| / d_true, NaN where one of them is not valid; None without ground truth."""
    own_cameras: bool = False
    """Whether it has the cameras that the model predicted, where the result has known or shared ones."""

    @property
    def label(self) -> str:
        """The name shown in the report."""
        return stage_label(self.key, own_cameras=self.own_cameras)

    def world_points(self) -> np.ndarray:
        """World points (S, H, W, 3) float32; UserError without cameras."""
        if self.T_cam_world is None or self.K is None:
            raise UserError("This reconstruction has no cameras, so it has no 3D points.")
        depth_z, K, T_cam_world = (torch.from_numpy(a) for a in (self.depth_z, self.K, self.T_cam_world))
        return depth_to_world(depth_z, K, T_cam_world).numpy()


@dataclass(frozen=True, kw_only=True)
class Result:
    """One output folder."""

    folder: Path
    summary: Mapping[str, Any]
    """Content of reconstruction.json; empty when the folder has none."""
    adaptation: Mapping[str, Any]
    """Content of adapter/freegeo.json; empty without adaptation."""
    scores: Mapping[str, Any]
    """Content of scores.json; empty when there is none."""
    stages: Mapping[str, Stage]
    """Those that exist, in the order frozen, adapted, refined, truth."""
    names: Sequence[str]
    images: np.ndarray
    """(S, H, W, 3) uint8, what the model read, at the pixels of the stages."""
    full: Mapping[str, Reconstruction]
    """The files of the stages, with all pixels, in their own frames and scales."""
    step: int
    """Of how many pixels in a row or column one is in the stages."""
    lengths: str
    """Unit of the folder's files, as it reads after "lengths are"."""
    from_own_frame: Sim3 | None
    """From the world frame of the folder's files to the common one; None without cameras."""

    @property
    def predictions(self) -> list[Stage]:
        """The stages other than ground truth."""
        return [stage for stage in self.stages.values() if stage.key != "truth"]

    @property
    def final(self) -> Stage:
        """The stage that was exported, the last one."""
        return self.predictions[-1]

    @property
    def truth(self) -> Stage | None:
        """Ground truth."""
        return self.stages.get("truth")

    @property
    def has_cameras(self) -> bool:
        """Whether there is anything to show in 3D."""
        return self.final.T_cam_world is not None

    @property
    def is_path(self) -> bool:
        """Whether a line through the cameras shows a way: the photos are a sequence, or each is near the one before."""
        if self.summary.get("sequence"):
            return True
        if self.final.T_cam_world is None or len(self.names) < FEWEST_OF_A_PATH:
            return False
        centres = camera_centres(torch.from_numpy(self.final.T_cam_world).double())
        apart = torch.cdist(centres, centres)
        steps = apart.diagonal(1).median()
        nearest = apart.fill_diagonal_(torch.inf).min(1).values.median()
        return bool(steps <= STEP_OF_A_PATH * nearest)

    @property
    def pixels(self) -> int:
        """Number of pixels of all views."""
        return self.full[self.final.key].depth_z.size

    def view_depth(self, stage: Stage, view: int) -> np.ndarray:
        """Return all pixels (H, W) float32 of a view's depth in the common scale."""
        return (self.full[stage.key].depth_z[view] * stage.scale).astype(np.float32)

    def view_error(self, stage: Stage, view: int) -> np.ndarray | None:
        """Return all pixels (H, W) of a view's `Stage.error`; None without ground truth."""
        if self.truth is None:
            return None
        return relative_error(self.view_depth(stage, view), self.full["truth"].depth_z[view])


def stage_label(key: str, *, own_cameras: bool) -> str:
    """Return the name of a stage, in reports and videos; `own_cameras` as in `Stage`."""
    return f"{LABELS[key]}, own cameras" if own_cameras else LABELS[key]


def has_other_cameras(summary: Mapping[str, Any]) -> bool:
    """Whether a result has known or shared cameras, by its reconstruction.json; its frozen prediction has its own."""
    return bool(summary.get("known_cameras") or summary.get("one_camera"))


def load_result(folder: Path, *, truth: Reconstruction | None = None) -> Result:
    """Read an output folder.

    Args:
        folder: as `freegeo run`, `reconstruct` and `demo` write it.
        truth: ground truth at the prediction's resolution; default: `truth/prediction.npz` of the folder, if there.

    Raises:
        UserError: no reconstruction there, or one of a newer format.
        FreeGeoError: a damaged file, or ground truth of another size.
    """
    folder = Path(folder)
    if not (folder / FILE_NAME).is_file():
        raise UserError(f"{folder}: holds no reconstruction ({FILE_NAME} is missing). Name the output folder of a run.")
    summary = read_part(folder / SUMMARY_NAME, Summary)
    if summary.get("format", FORMAT) > FORMAT:
        raise UserError(f"{folder}: written by a newer freegeo (format {summary['format']}). Update freegeo.")
    final = Reconstruction.load(folder)
    places = _places(folder, summary)
    found = {key: final if place == folder else Reconstruction.load(place) for key, place in places.items()}
    if truth is None and (folder / TRUTH_FOLDER / FILE_NAME).is_file():
        truth = Reconstruction.load(folder / TRUTH_FOLDER)
    for other in (*found.values(), *([truth] if truth else [])):
        if other.depth_z.shape != final.depth_z.shape:
            raise FreeGeoError(f"{folder}: reconstructions of different sizes cannot be compared. Run again.")
    whole = {**found, **({"truth": truth} if truth else {})}
    step = _step(final.depth_z.shape)
    read = {key: thinned(value, step) for key, value in whole.items()}
    last = list(found)[-1]
    reference = read["truth" if truth else last]
    stages = {}
    replaced = has_other_cameras(summary)
    for key, place in places.items():
        kept = _kept(read[key], final.depth_z.shape, place, step) if read[key].has_cameras else None
        stage = _stage(key, read[key], reference, read.get("truth"), kept)
        # The frozen prediction stays as it was; what comes after it has the other cameras.
        stages[key] = replace(stage, own_cameras=replaced and place == folder / FROZEN_FOLDER)
    if truth is not None:
        stages["truth"] = _truth_stage(read["truth"])
    return Result(
        folder=folder,
        summary=summary,
        adaptation=read_part(folder / ADAPTER_PAGE, AdapterNotes),
        scores=read_part(folder / SCORES_NAME, DemoScores),
        stages=stages,
        names=final.names,
        images=read[last].images,
        full=whole,
        step=step,
        lengths=final.lengths,
        from_own_frame=align(read[last], reference) if final.has_cameras and reference.has_cameras else None,
    )


def even_choice(count: int, most: int) -> list[int]:
    """Return at most `most` of the numbers 0 to count - 1, evenly spread from the first to the last, ascending."""
    return list(range(count)) if count <= most else np.linspace(0, count - 1, most).round().astype(int).tolist()


def _step(shape: tuple[int, ...]) -> int:
    views, height, width = shape
    step = 1
    while views > MANY_VIEWS and views * (height // step) * (width // step) > MOST_PIXELS:
        step += 1
    return step


def _rows(step: int) -> slice:
    """Every `step`-th pixel, the middle one of each group."""
    return slice(step // 2, None, step)


def thinned(value: Reconstruction, step: int) -> Reconstruction:
    """Return a copy with one pixel of `step` in each row and column; cameras follow. A step of 1 copies nothing."""
    if step == 1:
        return value
    rows, first = _rows(step), step // 2
    maps = {name: getattr(value, name) for name in ("depth_z", "conf", "sky", "images")}
    K = value.K
    if K is not None:
        # The pixel u of the copy is the pixel step * u + first.
        K = K.copy()
        K[:, :2, 2] -= first
        K[:, :2] /= step
    return replace(
        value, **{name: None if a is None else np.ascontiguousarray(a[:, rows, rows]) for name, a in maps.items()}, K=K,
        scale_xy=value.scale_xy / step, offset_xy=(value.offset_xy - 0.5 - first) / step + 0.5,
    )  # fmt: skip


def _places(folder: Path, summary: Mapping[str, Any]) -> dict[str, Path]:
    """Return the folder of each prediction to show, the result's last."""
    frozen, unrefined = folder / FROZEN_FOLDER, folder / UNREFINED_FOLDER
    refined = bool((summary.get("refinement") or {}).get("accepted"))
    found = {}
    if (frozen / FILE_NAME).is_file() and (refined or not summary.get("rejected_adapter")):
        found["frozen"] = frozen
    if refined and (unrefined / FILE_NAME).is_file():
        found["adapted" if summary.get("adapter") else "frozen"] = unrefined
    last = "refined" if refined else "adapted" if summary.get("adapter") or found else "frozen"
    return {**found, last: folder}


def moved(result: Result, onto: Stage) -> Result:
    """Return a result of the same photos moved into the frame of another one's final stage."""
    if result.final.depth_z.shape != onto.depth_z.shape:
        raise UserError(f"{result.folder}: shows other photos or another resolution; only one scene can be compared.")
    if result.final.T_cam_world is None or onto.T_cam_world is None:
        return result
    return moved_by(result, similarity(result.final.depth_z, result.final.T_cam_world, onto.depth_z, onto.T_cam_world))


def moved_by(result: Result, move: Sim3) -> Result:
    """Return a result with cameras in another frame and scale."""
    stages = {}
    for key, stage in result.stages.items():
        assert stage.T_cam_world is not None
        scale = float(move.s)
        stages[key] = replace(
            stage, depth_z=(stage.depth_z * scale).astype(np.float32), scale=stage.scale * scale,
            T_cam_world=moved_cameras(stage.T_cam_world, move),
        )  # fmt: skip
    own = result.from_own_frame
    both = None if own is None else Sim3(s=move.s * own.s, R=move.R @ own.R, t=move.apply(own.t))
    return replace(result, stages=stages, from_own_frame=both)


def _stage(
    key: str,
    value: Reconstruction,
    reference: Reconstruction,
    truth: Reconstruction | None,
    kept: Filtered | None,
) -> Stage:
    keep, removed = valid_pixels(value.depth_z) & value.inside(), {}
    if kept is not None:
        keep, removed = kept[0], dict(kept[1].removed)
    move = align(value, reference) if value.has_cameras and reference.has_cameras else None
    scale = median_ratio(reference.depth_z, value.depth_z) if move is None else float(move.s)
    T_cam_world = value.T_cam_world if move is None else moved_cameras(value.cameras()[0], move)
    depth_z = (value.depth_z * scale).astype(np.float32)
    error = None if truth is None else relative_error(depth_z, truth.depth_z)
    return Stage(
        key=key, depth_z=depth_z, conf=value.conf, T_cam_world=T_cam_world, K=_single(value.K), keep=keep,
        removed=removed, scale=scale, error=error,
    )  # fmt: skip


def _kept(value: Reconstruction, shape: tuple[int, ...], folder: Path, step: int) -> Filtered | None:
    """What the command that wrote the folder kept, thinned like `value`; without one, filtered here if all is read."""
    kept = load_kept(folder, shape)
    if kept is None:
        return filter_reconstruction(value) if step == 1 else None
    rows = _rows(step)
    return np.ascontiguousarray(kept[0][:, rows, rows]), kept[1]


def _truth_stage(truth: Reconstruction) -> Stage:
    return Stage(
        key="truth", depth_z=truth.depth_z, conf=np.ones_like(truth.depth_z),
        T_cam_world=_single(truth.T_cam_world), K=_single(truth.K), keep=valid_pixels(truth.depth_z), removed={},
        error=np.zeros_like(truth.depth_z),
    )  # fmt: skip


def _single(values: np.ndarray | None) -> np.ndarray | None:
    return None if values is None else values.astype(np.float32)


def relative_error(depth_z: np.ndarray, true_z: np.ndarray) -> np.ndarray:
    """|d - d_true| / d_true (S, H, W) float32, NaN where one of the two is not valid."""
    valid = valid_pixels(depth_z) & valid_pixels(true_z)
    error = np.full(depth_z.shape, np.nan, dtype=np.float32)
    error[valid] = np.abs(depth_z[valid] - true_z[valid]) / true_z[valid]
    return error


def camera_difference(estimate: Stage, reference: Stage) -> tuple[np.ndarray, np.ndarray]:
    """Angle in degrees (S,) and distance in the common units (S,) between two stages' cameras, view by view."""
    assert estimate.T_cam_world is not None
    assert reference.T_cam_world is not None
    a, b = (torch.from_numpy(s.T_cam_world).double() for s in (estimate, reference))
    angle = rotation_angle(a[:, :3, :3], b[:, :3, :3])
    distance = torch.linalg.vector_norm(camera_centres(a) - camera_centres(b), dim=-1)
    return torch.rad2deg(angle).numpy(), distance.numpy()
