"""What `freegeo run` and its kin do with an output folder: photos in, predictions, adapter, files and report out."""

from __future__ import annotations

import logging
import platform
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Required, TypedDict

import numpy as np
import torch

from freegeo import __version__
from freegeo.adaptation import adapter_files
from freegeo.adaptation.adapt import adapt as train_adapter
from freegeo.adaptation.adapted import Adapted, loss_change
from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.adapter_files import ADAPTER_FOLDER, METADATA
from freegeo.adaptation.recipe import SEED, Guard, Recipe
from freegeo.adaptation.samples import SceneImages
from freegeo.adaptation.state import Progress, remove_state
from freegeo.errors import DivergedError, NoEvidenceError
from freegeo.evidence.guard import SHARES
from freegeo.export.base import DEFAULT_FORMATS, TRACKS_NAME, Before, DepthSize
from freegeo.export.formats import export, filter_reconstruction
from freegeo.export.kept import save_kept
from freegeo.export.measured import load_tracks, save_tracks
from freegeo.export.photos import FOLDER as COPIES_FOLDER
from freegeo.export.photos import photo_records
from freegeo.export.pixels import masks_for_model
from freegeo.export.reconstruction import FILE_NAME as PREDICTION_NAME
from freegeo.export.reconstruction import Reconstruction
from freegeo.files import FORMAT, as_json, read_json, remove_written, write_json
from freegeo.fusion.filtering import FilterReport
from freegeo.fusion.settings import FilterSettings
from freegeo.guarded import Evidence, scene_matches
from freegeo.metres import ScaleSource, in_metres
from freegeo.models.api import ReconstructionModel
from freegeo.models.precision import Compute
from freegeo.models.spec import NO_REFERENCE, ModelSpec, PoseFrom
from freegeo.pipeline import (
    CPU,
    capital,
    judge_by_photos,
    not_finite,
    other_size,
    other_use,
    predict,
    predict_unchecked,
    scene_images,
    with_targets,
)
from freegeo.posed import (
    doubt_focal_length,
    is_measurable,
    told,
    with_known_cameras,
    with_measured_depth,
    with_one_camera,
)
from freegeo.refined import refine_by_photos
from freegeo.report.page import write_report
from freegeo.report.result import has_other_cameras, stage_label
from freegeo.run_folder import Part, RunFolder
from freegeo.types import ImageBatch, PhotoLike, Priors

if TYPE_CHECKING:
    from freegeo.cameras.known import KnownCameras
    from freegeo.evidence.matches import Matches
    from freegeo.fusion.tracks import Tracks

logger = logging.getLogger(__name__)

SUMMARY_NAME = "reconstruction.json"
FROZEN_FOLDER = "frozen"
FILES_STAGE = "points and files"
MATCHES_NAME = "matches.npz"
UNREFINED_FOLDER = "unrefined"
"""Holds what was refined where the result is a refined one, unless that is the frozen prediction."""
PREDICTED_FOLDER = "predicted"
"""Holds the model's prediction where known or shared cameras, or a scale, make another result of it, unless that is the
frozen one of `FROZEN_FOLDER`."""
ADAPTATION = Part("adaptation", (f"{ADAPTER_FOLDER}/", MATCHES_NAME))
PREDICTION = Part(
    "prediction",
    (
        f"{FROZEN_FOLDER}/{PREDICTION_NAME}", PREDICTION_NAME, f"{UNREFINED_FOLDER}/{PREDICTION_NAME}",
        f"{PREDICTED_FOLDER}/{PREDICTION_NAME}", f"{COPIES_FOLDER}/",
    ),
)  # fmt: skip
PLACING = Part("placing", (), free=True)
REFINEMENT = Part("refinement", (TRACKS_NAME,), free=True)
FILTERS = Part("filters", ("",), free=True)
FORMATS = Part("formats", (), free=True)
DEPTH_SIZE = Part("depth_size", (), free=True)
PARTS = (ADAPTATION, PREDICTION, PLACING, REFINEMENT, FILTERS, FORMATS, DEPTH_SIZE)
"""Parts of a job's settings: photos, model and adapter; how they are used; known and shared cameras, and scale; whether
bundle adjustment follows; which pixels become points; which files; at which size depth is written."""


class _Step(TypedDict):
    total: float


class _Notes(TypedDict, total=False):
    """Of the notes of the run's own adapter, what is read again."""

    loss_curve: Required[list[_Step]]
    trouble: str | None
    verdict: dict[str, Any] | None


@dataclass(frozen=True, kw_only=True)
class Hooks:
    """Callbacks of a run."""

    stage: Callable[[str], None] = lambda name: None
    step: Callable[[Progress], None] = lambda progress: None


@dataclass(frozen=True, kw_only=True)
class Adaptation:
    """What came of adapting the model to the photos."""

    used: bool = False
    """Whether the result is that of the adapted model."""
    rejected: str | None = None
    """Why the adapter could not be used."""
    verdict: Mapping[str, Any] | None = None
    """Of the guard on the adapter."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Computed:
    """What a job made with the model."""

    result: Reconstruction
    """As it is in the folder."""
    about: Mapping[str, Any]
    """Facts for reconstruction.json: `known_cameras` and `one_camera`."""
    adaptation: Adaptation = Adaptation()


@dataclass
class Job:
    """The inputs and settings that turn photos into an output folder; parts that already exist are kept."""

    load: Callable[[], ReconstructionModel]
    """Loads the model; called when something has to be computed with it."""
    spec: ModelSpec
    batch: ImageBatch
    folder: RunFolder
    recipe: Recipe | None
    """None: reconstruct with the frozen model, or with `adapter`."""
    adapter: Path | None = None
    """A saved adapter to reconstruct with, instead of training one."""
    guard: Guard = "select"
    """Whether the photos' matches judge the adapter, and whether their verdict decides what is used."""
    known: KnownCameras | None = None
    """Known cameras of the photos, which the result has as they were given."""
    priors: Priors | None = None
    """What the model is told of them (`freegeo.posed.told`)."""
    one_camera: bool = False
    """Whether photos of one camera share one focal length."""
    scale: ScaleSource | None = None
    """Where metres come from; None: from known cameras or a metric model, if at all."""
    pose_from: PoseFrom = "camera"
    """Where the cameras of all predictions come from."""
    refine: bool = False
    """Whether the cameras are brought to the matches between the photos by bundle adjustment."""
    seed: int = SEED
    compute: Compute = CPU
    reference: str | None = None
    """Reference-view rule of all predictions; None: the model's own."""
    formats: Sequence[str] = DEFAULT_FORMATS
    """Files to write besides the predictions, names of `freegeo.export.formats.FORMATS`."""
    photos: Sequence[PhotoLike] | None = None
    """The photos of the batch, of which some formats write copies."""
    depth_size: DepthSize = "model"
    """Of depth files."""
    filters: FilterSettings = field(default_factory=FilterSettings)
    masks: list[np.ndarray] | None = None
    """One (H, W) array per photo at its size, not zero where points are wanted."""
    hooks: Hooks = field(default_factory=Hooks)
    checkpoint: Mapping[str, Any] | None = None
    """Which weights the model has, for reconstruction.json (`LoadedFrom.weights`)."""
    command: str | None = None
    """The command line, for reconstruction.json."""
    warnings: list[str] = field(default_factory=list)
    """What makes the result doubtful, one sentence each, for reconstruction.json; may grow until that is written."""
    after: Callable[[Job], None] = lambda job: None
    """Called before the folder is marked as finished, to write more."""

    @cached_property
    def model(self) -> ReconstructionModel:
        """The frozen model, loaded when it is first used."""
        return self.load()

    @cached_property
    def in_place(self) -> Adapter | None:
        """The adapter of the result, trained or loaded; attached to the model and switched on when first used."""
        if self.recipe is not None:
            return adapter_files.load_adapter(self.model, self.folder / ADAPTER_FOLDER)
        if self.adapter is None:
            return None
        about = adapter_files.adapter_metadata(self.adapter) or {}
        verdict = about.get("verdict") or {}
        if said := other_use(about, self.priors):
            self._warn(f"{self.adapter}: {said}")
        doubt = about.get("trouble") or (verdict.get("reason") if verdict.get("outcome") != "adapted" else None)
        if doubt:
            self._warn(f"{self.adapter}: an adapter to be doubted. {capital(doubt)}")
        found = adapter_files.load_adapter(self.model, self.adapter)
        if said := other_size(self.model, self.batch):
            self._warn(f"{self.adapter}: {said}")
        return found

    @property
    def _attached(self) -> Adapter | None:
        """The adapter that is in the model by now, if any."""
        return vars(self).get("in_place")

    def release(self) -> None:
        """Take the adapter of the result off the model, if it is there."""
        if self._attached is not None:
            self._attached.detach()
            del self.in_place

    def run(self) -> dict[str, Any]:
        """Write everything and return the content of reconstruction.json."""
        found = self.make()
        if self.photos is not None:
            doubt_focal_length(found.result, self.photos)
        report, failed = self._export(found)
        summary = self._summary(found, report, failed, self.photos)
        write_json(self.folder / SUMMARY_NAME, summary)
        self.after(self)
        self.hooks.stage("report")
        write_report(self.folder.path, photos=self.photos)
        self.folder.finish()
        return summary

    def make(self) -> Computed:
        """Write all that needs the model and the photos, and return the result."""
        frozen, rejected, verdict = None, None, None
        if self.recipe is None:
            final = self._predicted(self.folder.path, "adapted prediction" if self.adapter else "prediction")
        else:
            frozen = self.frozen()
            rejected, verdict = self._trained(self.recipe, frozen)
            final = frozen
            if self._may_use(rejected, verdict):
                final, rejected = self._adapted_prediction(frozen)
        if rejected is not None:
            self._warn(f"{capital(rejected)} The result is that of the frozen model.")
        result, about = self._result(final, frozen)
        used = self.recipe is not None and final is not frozen
        return Computed(
            result=result, about=about, adaptation=Adaptation(used=used, rejected=rejected, verdict=verdict)
        )

    def _may_use(self, rejected: str | None, verdict: Mapping[str, Any] | None) -> bool:
        """Whether a trained adapter makes the result, after what `_trained` returned."""
        return rejected is None and not (verdict and self.guard == "select" and verdict["outcome"] != "adapted")

    def frozen(self) -> Reconstruction:
        """Predict with the frozen model before an adaptation, or read what is there already."""
        return self._predicted(self.folder / FROZEN_FOLDER, "frozen prediction")

    @property
    def _asked(self) -> dict[str, Any]:
        """How the frozen and the adapted model are asked: arguments of `predict`."""
        return {
            "reference": self.reference, "priors": self.priors, "pose_from": self.pose_from, "compute": self.compute,
        }  # fmt: skip

    def _predicted(self, folder: Path, stage: str) -> Reconstruction:
        """Predict with the frozen model, or with `adapter`, or read what is there already."""
        if (folder / PREDICTION_NAME).is_file():
            return Reconstruction.load(self._predicted_folder if folder == self.folder.path else folder)
        if self.adapter is not None:
            assert self.in_place is not None
        with self._timed(stage):
            result = predict(self.model, self.batch, **self._asked)
            result.save(folder)
        return result

    def _trained(self, recipe: Recipe, frozen: Reconstruction | None) -> tuple[str | None, dict[str, Any] | None]:
        """Train the adapter, or continue training it, unless it is finished, and let the guard judge it.

        Returns why it cannot be used, and the verdict; both may be None.
        """
        folder = self.folder / ADAPTER_FOLDER
        noted = self._noted("adaptation")
        if "failed" in noted:
            return noted["failed"], None
        if not (folder / METADATA).is_file():
            images, judging = [self._scene_images()], None
            try:
                if recipe.cameras:
                    assert self.photos is not None and frozen is not None
                    self.hooks.stage("cameras to learn from")
                    images, judging = with_targets(
                        images, [self.photos], [frozen], seed=self.seed, compute=self.compute,
                        stores=[self.folder / MATCHES_NAME],
                    )  # fmt: skip
                self.hooks.stage("adaptation")
                result = train_adapter(
                    self.model, images, recipe, seed=self.seed, compute=self.compute,
                    resume_in=folder, on_step=self.hooks.step, keep_after=() if self.guard == "off" else SHARES,
                )  # fmt: skip
            except (DivergedError, NoEvidenceError) as error:
                remove_state(folder)
                self.folder.note("adaptation", {**noted, "failed": str(error)})
                return str(error), None
            self.in_place = result.adapter
            seconds = {"adaptation": round(result.seconds, 2)}
            if self.photos is not None and result.trouble is None:
                self.hooks.stage(
                    "evidence of the photos" if self.guard != "off" else "comparison with the frozen model"
                )
                started = time.monotonic()
                self._judge(result, frozen, judging)
                seconds["evidence"] = round(time.monotonic() - started, 2)
            self.folder.note("adaptation", {"seconds": seconds})
            result.save(folder)
        # A process that was killed after it had written the adapter has left it.
        remove_state(folder)
        metadata = read_json(folder / METADATA, _Notes)
        return metadata.get("trouble"), metadata.get("verdict")

    def _scene_images(self) -> SceneImages:
        """Return the photos as a scene to adapt to."""
        assert self.photos is not None and self.recipe is not None
        return scene_images("photos", self.photos, self.model, self.recipe, self.batch, self.priors)

    def _judge(self, result: Adapted, frozen: Reconstruction | None, judging: list[Matches] | None) -> None:
        """Let the guard judge a finished adapter, and keep its verdict in the result."""
        assert self.photos is not None and frozen is not None
        evidence = Evidence.in_memory(
            self.photos, self.batch, frozen, priors=self.priors, store=self.folder / MATCHES_NAME,
            matches=None if judging is None else judging[0],
        )  # fmt: skip
        judge_by_photos(
            self.model, result, [evidence], compute=self.compute, guard=self.guard, reference=self.reference,
            pose_from=self.pose_from,
        )  # fmt: skip

    def _adapted_prediction(self, frozen: Reconstruction) -> tuple[Reconstruction, str | None]:
        """Predict with the trained adapter; the frozen prediction and the reason when that gives no usable numbers."""
        path = self.folder.path
        if (path / PREDICTION_NAME).is_file():
            rejected = self._noted("prediction").get("rejected")
            return (Reconstruction.load(self._predicted_folder), None) if rejected is None else (frozen, rejected)
        assert self.in_place is not None
        with self._timed("adapted prediction"):
            result = predict_unchecked(self.model, self.batch, **self._asked)
            rejected = not_finite(result)
            if rejected is None:
                result.save(path)
        if rejected is None:
            return result, None
        rejected = f"With the adapter: {rejected}"
        self.folder.note("prediction", {**self._noted("prediction"), "rejected": rejected})
        return frozen, rejected

    @property
    def _predicted_folder(self) -> Path:
        """Folder of the model's prediction, whatever the result made of it."""
        places = (self.folder / PREDICTED_FOLDER, self.folder / UNREFINED_FOLDER)
        return next((place for place in places if (place / PREDICTION_NAME).is_file()), self.folder.path)

    def _result(
        self, predicted: Reconstruction, frozen: Reconstruction | None
    ) -> tuple[Reconstruction, dict[str, Any]]:
        """Make the result of a prediction, and see that it is in the folder; returns facts for reconstruction.json."""
        path, kept, before = self.folder.path, self.folder / PREDICTED_FOLDER, self.folder / UNREFINED_FOLDER
        placed, about = self._placed(predicted)
        changed = placed is not predicted or self.scale is not None
        if changed and predicted is not frozen and not (kept / PREDICTION_NAME).is_file():
            predicted.save(kept)
        if self.refine and self._is_refined(placed, frozen, is_frozen=predicted is frozen):
            result, unrefined = Reconstruction.load(path), placed is not frozen
        else:
            (result, _), unrefined = self._in_metres(placed), False
            if changed or predicted is frozen or self._predicted_folder != path:
                result.save(path)
        # What earlier settings of this folder left must not count as steps on the way to this result.
        if not unrefined:
            remove_written(before)
        if not changed:
            remove_written(kept)
        return result, about

    def _placed(self, predicted: Reconstruction) -> tuple[Reconstruction, dict[str, Any]]:
        """Give a prediction known and shared cameras; it comes back as it is where there is nothing to do."""
        about: dict[str, Any] = {"known_cameras": None, "one_camera": None}
        if self.known is not None:
            posed = with_known_cameras(predicted, self.known)
            if is_measurable(posed, self.known):
                assert self.photos is not None
                store, device = self.folder / MATCHES_NAME, str(self.compute.device)
                matches = scene_matches(self.photos, predicted, store, device=device)
                posed = with_measured_depth(posed, self.known, matches)
            predicted = posed.result
            about["known_cameras"] = {**posed.about, "model": self.said_of_known()}
        if self.one_camera:
            assert self.photos is not None
            predicted, about["one_camera"] = with_one_camera(predicted, self.photos, self.known)
        return predicted, about

    def said_of_known(self) -> str | None:
        """Return what is said of known cameras that the model is told, or not told; None without any."""
        return told(self.known, self.batch, self.spec)[1]

    def _in_metres(self, result: Reconstruction, tracks: Tracks | None = None) -> tuple[Reconstruction, Tracks | None]:
        """Bring a result, and points measured in it, to metres where that is asked for."""
        if self.scale is None:
            return result, tracks
        assert self.photos is not None
        metric = in_metres(result, self.scale, self.photos)
        if tracks is not None and metric is not result:
            assert metric.scale is not None
            tracks = replace(tracks, xyz=tracks.xyz * metric.scale.value)
        return metric, tracks

    def _is_refined(self, placed: Reconstruction, frozen: Reconstruction | None, *, is_frozen: bool) -> bool:
        """Refine a prediction, unless that is done, and write what comes of it where it is accepted."""
        path, before = self.folder.path, self.folder / UNREFINED_FOLDER
        noted = self._noted("refinement")
        # The folder of a chunk may have been removed and made again, but for this; others may need its matches.
        there = path / (TRACKS_NAME if noted.get("accepted") else MATCHES_NAME)
        if "accepted" not in noted or not there.is_file():
            assert self.photos is not None
            with self._timed("refinement", REFINEMENT):
                found = refine_by_photos(
                    placed, self.photos, frozen=None if is_frozen else frozen, store=self.folder / MATCHES_NAME,
                    device=str(self.compute.device),
                    again=partial(self._told, is_frozen=is_frozen) if self.spec.takes != "nothing" else None,
                )  # fmt: skip
                if found.tracks is not None:
                    if placed is not frozen:
                        placed.save(before)
                    result, tracks = self._in_metres(found.result, found.tracks)
                    assert tracks is not None
                    save_tracks(path, tracks)
                    result.save(path)
                self.folder.note("refinement", {**self._noted("refinement"), **found.about})
            logger.info("%s: %s", "refined" if found.tracks is not None else "not refined", found.about["reason"])
        return self._noted("refinement")["accepted"]

    def _told(self, priors: Priors, *, is_frozen: bool) -> Reconstruction | None:
        """Predict again with the model of the result, which is told cameras; None without finite numbers."""
        # The adapter of a result that is the frozen model's may still be in place.
        adapter = self._attached if is_frozen else self.in_place
        with adapter.off() if is_frozen and adapter is not None else nullcontext():
            found = predict_unchecked(
                self.model, self.batch, reference=None, priors=priors, pose_from="camera", compute=self.compute
            )
        return found if not_finite(found) is None else None

    def _warn(self, sentence: str) -> None:
        """Log a warning that reconstruction.json must hold, whoever listens to the log."""
        logger.warning("%s", sentence)
        if sentence not in self.warnings:
            self.warnings.append(sentence)

    def _export(self, found: Computed) -> tuple[FilterReport | None, Mapping[str, str]]:
        """Filter each reconstruction once and write all formats; returns as `write_files`."""
        final = found.result
        about = {**found.about, "refinement": self._refinement()}
        before = before_adaptation(self.folder.path, about) if found.adaptation.used else None
        with self._timed(FILES_STAGE, FILTERS):
            masks = None if self.masks is None else masks_for_model(final, self.masks)
            return write_files(
                self.folder.path, final, self.formats, filters=self.filters, masks=masks, photos=self.photos,
                before=before, depth_size=self.depth_size, seed=self.seed,
            )  # fmt: skip

    def _summary(
        self,
        found: Computed,
        report: FilterReport | None,
        failed: Mapping[str, str],
        photos: Sequence[PhotoLike] | None,
        **more: Any,
    ) -> dict[str, Any]:
        final, adaptation = found.result, found.adaptation
        why_not = adaptation.rejected or (adaptation.verdict or {}).get("reason")
        settings = dict(self.folder.settings)
        told_in_order = self.priors is not None and self.spec.reference != NO_REFERENCE
        return {
            "format": FORMAT,
            "model": self.spec.name,
            "checkpoint": self.checkpoint,
            "licence_of_weights": self.spec.weights_licence,
            "images": list(final.names),
            "photo_files": None if photos is None else photo_records(photos),
            "image_hw": list(final.image_hw),
            "process_res": self.batch.process_res or self.spec.default_side,
            "scale": None if final.scale is None else asdict(final.scale),
            "adapter": ADAPTER_FOLDER if adaptation.used else (str(self.adapter) if self.adapter else None),
            "rejected_adapter": None if adaptation.used or self.recipe is None else why_not,
            "verdict": adaptation.verdict,
            "refinement": self._refinement(),
            **found.about,
            "frozen_prediction": None if self.recipe is None else f"{FROZEN_FOLDER}/{PREDICTION_NAME}",
            "reference_view": "first" if told_in_order else self.reference or self.spec.reference,
            "pose_from": self.pose_from if self.spec.cameras else None,
            "not_written": dict(failed),
            "warnings": list(self.warnings),
            "loss": self._loss_change(),
            "filters": None if report is None else {"pixels": report.pixels, "removed": dict(report.removed)},
            "recipe": None if self.recipe is None else as_json(asdict(self.recipe)),
            "settings": settings,
            "command": self.command,
            "seconds": self._seconds(),
            "versions": versions(),
            **more,
        }

    def _refinement(self) -> dict[str, Any] | None:
        """Return what refinement made of the prediction; None where it was not asked for."""
        return {k: v for k, v in self._noted("refinement").items() if k != "seconds"} or None

    def _seconds(self) -> dict[str, float]:
        """Return how long each stage took."""
        return {name: value for part in self.folder.notes.values() for name, value in part["seconds"].items()}

    def _noted(self, part: str) -> dict[str, Any]:
        return {"seconds": {}, **(self.folder.notes.get(part) or {})}

    def _loss_change(self) -> dict[str, float] | None:
        """Return the mean total loss of the first and last tenth of the steps."""
        metadata = self.folder / ADAPTER_FOLDER / METADATA
        if self.recipe is None or not metadata.is_file():
            return None
        return loss_change(read_json(metadata, _Notes)["loss_curve"])

    @contextmanager
    def _timed(self, stage: str, part: Part = PREDICTION) -> Generator[None]:
        """Announce a stage and note how long it took, also for processes that continue this run."""
        self.hooks.stage(stage)
        started = time.monotonic()
        yield
        noted = self._noted(part.name)
        seconds = {**noted["seconds"], stage: round(time.monotonic() - started, 2)}
        self.folder.note(part.name, {**noted, "seconds": seconds})


def before_adaptation(folder: Path, summary: Mapping[str, Any]) -> Before | None:
    """Return the frozen model's prediction in the folder of an adapted result; None where there is none.

    `summary` is what reconstruction.json says, of which refinement and cameras count.
    """
    if not (folder / FROZEN_FOLDER / PREDICTION_NAME).is_file():
        return None
    refined = bool((summary.get("refinement") or {}).get("accepted"))
    label = stage_label("frozen", own_cameras=has_other_cameras(summary))
    return Before(folder=folder / FROZEN_FOLDER, label=label, result_label="refined" if refined else "adapted")


def write_files(
    folder: Path,
    result: Reconstruction,
    formats: Sequence[str],
    *,
    filters: FilterSettings | None = None,
    masks: np.ndarray | None = None,
    photos: Sequence[PhotoLike] | None = None,
    before: Before | None = None,
    depth_size: DepthSize = "model",
    seed: int = SEED,
) -> tuple[FilterReport | None, Mapping[str, str]]:
    """Choose the points of a result and of the predictions before it, and write the result's files.

    Args:
        folder: holds the result, and in subfolders the predictions before adaptation and before refinement, if any.
        result: what is in the folder.
        formats: names of `freegeo.export.formats.FORMATS`.
        filters: which points are kept; None: the defaults.
        masks: (S, H, W) bool, pixels that the user wants; None: all.
        photos: the photos, of which some formats write copies.
        before: the prediction before adaptation, which the fly-through shows beside the result.
        depth_size: of depth files.
        seed: of the random choice of points.

    Returns:
        What the filters removed (None without cameras, which have no points), and why formats were not written.
    """
    filtered = None
    if result.has_cameras:
        for name in (FROZEN_FOLDER, UNREFINED_FOLDER):
            if (folder / name / PREDICTION_NAME).is_file():
                earlier = Reconstruction.load(folder / name)
                save_kept(folder / name, filter_reconstruction(earlier, masks=masks, settings=filters), masks)
        filtered = filter_reconstruction(result, masks=masks, settings=filters)
        save_kept(folder, filtered, masks)
    exported = export(
        result,
        folder,
        formats,
        filtered=filtered,
        masks=masks,
        photos=photos,
        tracks=load_tracks(folder, len(result)),
        before=before,
        depth_size=depth_size,
        seed=seed,
    )
    return None if filtered is None else filtered[1], exported.failed


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    return {"freegeo": __version__, "torch": torch.__version__, "python": platform.python_version()}
