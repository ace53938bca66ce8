"""A run into an output folder: photos are read, settings compared with those of the folder, and a job does the rest.

`freegeo run` and its kin share this with `freegeo.reconstruct_sequence` (`sequence_api`).
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypedDict, get_args

import numpy as np
from msgspec import Meta

from freegeo.adaptation.adapter_files import WEIGHTS, read_peft
from freegeo.adaptation.memory import require_adaptation_fits
from freegeo.adaptation.recipe import SMALLEST_SCENE, Guard, Recipe, require_unchanged_images
from freegeo.cameras.undistortion import UndistortedPhoto
from freegeo.data.photos import doubt_blank, some_of
from freegeo.data.video import VideoFrame
from freegeo.errors import FreeGeoError, UserError
from freegeo.export.base import DepthSize
from freegeo.export.photos import FOLDER as COPIES_FOLDER
from freegeo.export.photos import write_copies
from freegeo.files import ledger, read_json
from freegeo.host import gigabytes
from freegeo.job import ADAPTATION, MATCHES_NAME, PARTS, SUMMARY_NAME, Job
from freegeo.metres import read_scale, require_in_view
from freegeo.models.checkpoints import fingerprint
from freegeo.models.images import look_at_photos, read_photos, read_some
from freegeo.models.memory import plan_reconstruction
from freegeo.models.precision import Compute
from freegeo.models.spec import MIXED, Mixed, ModelSpec, PoseFrom
from freegeo.pipeline import require_reference
from freegeo.posed import check_known, digest, is_one_camera, told, told_in_chunks
from freegeo.run_folder import check_folder, kept_parts, run_folder, stored_state
from freegeo.sequence.chunks import OVERLAP, OrderRule, plan_chunks
from freegeo.sequence_job import SEQUENCE_PARTS, Plan, SequenceJob

if TYPE_CHECKING:
    from freegeo.cameras.known import KnownCameras
    from freegeo.metres import ScaleSource
    from freegeo.models.api import ReconstructionModel
    from freegeo.models.images import Frames
    from freegeo.types import ImageBatch, PhotoLike, Priors

logger = logging.getLogger(__name__)

_OTHER_CONTENTS = "photos with other contents, or read at another size"
LABELS = {
    "photos": "other photos", "photo_contents": _OTHER_CONTENTS, "contents": _OTHER_CONTENTS, "scenes": "other scenes",
    "checkpoint": "other weights", "weights": "another adapter", "folder": "--adapter", "masks": "other masks",
    "known_cameras": "other known cameras", "trusted_cameras": "--trust-cameras",
    "scale": "another --scale",
    "one_camera": "--one-camera",
    "command": "the command", "recipe": "--adapt", "name": "--recipe", "sets_per_scene": "--sets",
    "adapting_precision": "--precision", "refinement": "--refine",
    **dict.fromkeys(
        ("alpha", "first_seed", "distinct_seeds", "final_lr", "batch", "features", "cameras"),
        "what follows from the recipe",
    ),
    **{
        name: f"--{name}"
        for name in (
            "model", "precision", "seed", "reference", "adapter", "steps", "epochs", "lr", "rank", "hold", "views",
            "keep", "room", "domain", "published", "guard",
        )
    },
    "pose_from": "--pose-from",
    "process_res": "--process-res",
    "chunk": "--chunk", "overlap": "--overlap", "order": "--order", "loops": "--loops",
    "judged_by": "the predictions that the guard judges by",
}  # fmt: skip
"""What messages call the settings of an output folder."""


class _Piece(TypedDict):
    folder: str
    frames: int


class _Sequence(TypedDict):
    frames: int
    pieces: Annotated[list[_Piece], Meta(min_length=1)]


class _Record(TypedDict, total=False):
    """Of a finished result's reconstruction.json, what is read again."""

    not_written: dict[str, str] | None
    sequence: _Sequence | None


@dataclass(frozen=True, kw_only=True)
class SequenceWish:
    """How more photos than are predicted at once are to become one result; `Plan` is what comes of it."""

    chunk: int | None = None
    """Photos that are predicted together; None: as many as fit into memory, at most as many as suit the model."""
    overlap: int | None = None
    """Photos that two neighbouring chunks share; None: half of a chunk."""
    order: OrderRule = "auto"
    loops: bool = True

    def check(self) -> None:
        """Raise UserError for values of a caller that are no numbers of photos, or no rule."""
        for name, value in (("chunk", self.chunk), ("overlap", self.overlap)):
            if value is not None and (not isinstance(value, Integral) or isinstance(value, bool)):
                raise UserError(f"{name} is a number of photos, or None, not {value!r}.")
        if not isinstance(self.loops, bool):
            raise UserError(f"loops is True or False, not {self.loops!r}.")
        if self.order not in get_args(OrderRule):
            raise UserError(f"order is {', '.join(get_args(OrderRule))}, not {self.order!r}.")

    def plan(
        self,
        model: ReconstructionModel,
        photos: Sequence[PhotoLike],
        compute: Compute,
        *,
        mixed: Mixed = MIXED,
        process_res: int | None = None,
        before: int | None = None,
    ) -> Plan | None:
        """Return how photos are cut into chunks; None where all are predicted at once.

        `before` is the size of a chunk in the run that is continued, which is kept where none is asked for: what fits
        into memory may be another number now.
        """
        count, image_hw = len(photos), read_some(model, photos, [0], mixed, process_res).image_hw
        _, fitting = plan_reconstruction(model, 1, image_hw, compute=compute)
        size = (before or min(fitting, model.spec.chunk)) if self.chunk is None else int(self.chunk)
        if min(size, count) > fitting:
            fit = (
                f"at most {fitting} photos of {image_hw[1]} x {image_hw[0]} pixels fit into memory together with "
                f"{model.spec.name}"
            )
            if self.chunk is None:
                raise UserError(
                    f"the run in the output folder predicts {min(size, count)} photos together, and {fit} here. "
                    "Continue it where there is as much memory as before, choose another folder, or replace it "
                    "(--overwrite)."
                )
            raise UserError(f"chunks of {size} photos are too large: {fit}. Take smaller ones (--chunk {fitting}).")
        overlap = max(1, int(size * OVERLAP)) if self.overlap is None else int(self.overlap)
        if len(plan_chunks(count, size, overlap)) == 1:
            return None
        if not model.spec.cameras:
            raise UserError(
                f"{model.spec.name} predicts no cameras, so that chunks of {count} photos cannot be joined. Take "
                "another model, or fewer photos (--max-views)."
            )
        return Plan(size=size, overlap=overlap, order=self.order, loops=self.loops)


@dataclass(frozen=True, kw_only=True, eq=False)
class Inputs:
    """The photos of a job, and what is known of them; all parts have the same photos in the same order."""

    photos: Sequence[PhotoLike]
    batch: ImageBatch
    chunks: Plan | None
    """How they are cut into chunks; None: they are predicted at once."""
    known: KnownCameras | None
    priors: Priors | None
    masks: list[np.ndarray] | None
    scale: ScaleSource | None
    one_camera: bool


def read_inputs(
    photos: Sequence[PhotoLike],
    model: ReconstructionModel,
    recipe: Recipe | None,
    wish: SequenceWish,
    compute: Compute,
    *,
    known: KnownCameras | None = None,
    masks: list[np.ndarray] | None = None,
    mixed: Mixed = MIXED,
    process_res: int | None = None,
    reference: str | None = None,
    scale: str | None = None,
    one_camera: bool | None = None,
    before: int | None = None,
) -> Inputs:
    """Read photos and what belongs to them; UserError for what does not go together.

    Of a sequence, the photos that show nothing are left out, and its plan is logged.

    Args:
        photos: without distortion.
        model: decides the size of images; its weights have no part in that.
        recipe: by which the model is adapted to the photos; None: it is not.
        wish: how photos are cut into chunks, where they are too many to be predicted at once.
        compute: where the model runs, whose memory limits what is predicted at once.
        known: cameras of the photos.
        masks: one for each photo.
        mixed: how photos of different shapes get one size.
        process_res: longest side of images; None: the model's default.
        reference: rule of the reference view that was asked for.
        scale: where metres come from (`freegeo.metres.read_scale`).
        one_camera: whether photos of one camera share a focal length; None: those of a video do.
        before: how many photos an earlier run of the folder predicted together.
    """
    chunks = wish.plan(model, photos, compute, mixed=mixed, process_res=process_res, before=before)
    if chunks is None:
        doubt_blank(photos)
        batch: ImageBatch = read_photos(model, photos, mixed=mixed, process_res=process_res)
    else:
        _require_adaptable(chunks, recipe)
        frames = look_at_photos(model, photos, mixed=mixed, process_res=process_res)
        shown = _shown(frames)
        batch, photos = frames.select(shown), [photos[view] for view in shown]
        known = None if known is None else known.select(shown)
        masks = None if masks is None else [masks[view] for view in shown]
        _require_joinable(known)
        _say_plan(chunks, model, batch, compute)
    priors, sentence = (told if chunks is None else told_in_chunks)(known, batch, model.spec)
    if sentence:
        logger.info("%s", sentence)
    require_reference(reference, priors)
    if recipe is not None and priors is not None:
        require_unchanged_images(recipe)
    source = None if scale is None else read_scale(scale, photos)
    if source is not None:
        require_in_view(source, batch, photos)
    return Inputs(
        photos=photos, batch=batch, chunks=chunks, known=known, priors=priors, masks=masks, scale=source,
        one_camera=is_one_camera(photos) if one_camera is None else one_camera,
    )  # fmt: skip


def _shown(frames: Frames) -> list[int]:
    """Return the photos of a sequence that show something, and say which ones are left out."""
    shown = frames.shown()
    if not shown:
        raise UserError(f"all {len(frames)} photos are almost black, white or of one colour. Give photos of a scene.")
    blank = [name for view, name in enumerate(frames.names) if view not in set(shown)]
    if blank:
        logger.warning(
            "%d of %d photos are almost black, white or of one colour, and are left out: %s.",
            len(blank), len(frames), some_of(blank),
        )  # fmt: skip
    return shown


def _require_adaptable(chunks: Plan, recipe: Recipe | None) -> None:
    """Raise UserError for a recipe that cannot adapt to chunks."""
    if recipe is None:
        return
    if chunks.size < SMALLEST_SCENE:
        raise UserError(
            f"chunks of {chunks.size} photos: adaptation needs at least {SMALLEST_SCENE} in each. Take larger ones "
            "(--chunk), or reconstruct without adapting (--no-adapt; in Python without a recipe)."
        )
    if recipe.cameras:
        raise UserError(
            f"recipe {recipe.name} learns from cameras of one chunk, and these are more photos than are predicted at "
            "once. Take recipe scene, or fewer photos (--max-views)."
        )


def _require_joinable(known: KnownCameras | None) -> None:
    """Raise UserError for known cameras that chunks cannot have."""
    if known is None or not known.has_pose.any() or known.has_pose.all():
        return
    centres = np.stack([-T[:3, :3].T @ T[:3, 3] for T in known.poses.values()])
    if np.ptp(centres, axis=0).max() <= 1e-9 * np.abs(centres).max():
        raise UserError(
            f"{known.source}: more photos than are predicted at once take known poses of two photos or more in "
            f"different places, and there {'is one' if len(centres) == 1 else 'are none'}. Give poses of more "
            "photos, or of none."
        )


def _say_plan(chunks: Plan, model: ReconstructionModel, batch: ImageBatch, compute: Compute) -> None:
    """Log chunks, overlap and memory; how long it takes is measured on the first chunk, and said from then on."""
    count = len(plan_chunks(len(batch), chunks.size, chunks.overlap))
    parts, _ = plan_reconstruction(model, min(chunks.size, len(batch)), batch.image_hw, compute=compute)
    peak = sum(size for _, size in parts)
    logger.info(
        "%d photos in %d chunks of %d, neighbours share %d: about %s of memory at a time; the time is measured on "
        "the first chunk",
        len(batch), count, chunks.size, chunks.overlap, gigabytes(peak),
    )  # fmt: skip


def together_before(folder: Path) -> int | None:
    """Return how many photos the run in a folder predicts together; None where there is none."""
    state = stored_state(folder)
    adaptation = {} if state is None else state["settings"].get("adaptation") or {}
    if "sequence" in adaptation:
        return adaptation["sequence"]["chunk"]
    return len(adaptation["photos"]) if adaptation.get("photos") else None


def settings_of(
    found: Inputs,
    spec: ModelSpec,
    recipe: Recipe | None,
    *,
    command: str,
    model: Mapping[str, object],
    adapter: Path | None,
    guard: Guard,
    reference: str | None,
    pose_from: PoseFrom,
    trusted: bool,
    refine: bool,
    filters: Mapping[str, object],
    formats: Sequence[str],
    depth_size: DepthSize = "model",
    extra: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return what the result in a folder depends on, in the parts that jobs know (`freegeo.job.PARTS`).

    Args:
        found: photos and what is known of them.
        spec: of the model.
        recipe: of the adaptation, if there is one.
        command: what writes the folder.
        model: what identifies model, weights, precision and seed.
        adapter: folder of a saved adapter.
        guard: whether matches judge the adapter.
        reference: rule of the reference view that was asked for.
        pose_from: where cameras of predictions come from.
        trusted: known poses are not checked.
        refine: whether bundle adjustment follows.
        filters: which points are kept.
        formats: files to write.
        depth_size: of depth files.
        extra: further settings, on which everything depends.
    """
    adaptation: dict[str, Any] = {
        "photos": list(found.batch.names), "photo_contents": found.batch.digest(), **model,
        "recipe": None if recipe is None else asdict(recipe),
        "guard": None if recipe is None else guard,
        "adapter": None if adapter is None else adapter_identity(adapter),
        **({} if found.priors is None else {"known_cameras": found.priors.digest()}),
        **size_settings(found.batch),
    }  # fmt: skip
    # Only where it is not the default, so that folders of earlier versions count as finished.
    rays = {} if pose_from == "camera" else {"pose_from": pose_from}
    rule = reference or spec.reference
    judged = rays | ({} if rule == spec.reference else {"reference": rule})
    if recipe is not None and guard != "off" and judged:
        adaptation["judged_by"] = judged
    if (chunks := found.chunks) is not None:
        adaptation["sequence"] = {"chunk": chunks.size, "overlap": chunks.overlap, "order": chunks.order}
    return {
        "command": command,
        **(extra or {}),
        "adaptation": adaptation,
        "prediction": {"reference": rule, **rays},
        **_placing_settings(found, trusted=trusted),
        "refinement": "ba" if refine else "off",
        **({} if chunks is None else {"joining": {"loops": chunks.loops}}),
        "filters": filters,
        "formats": formats,
        # Only where it is not the default, so that folders of earlier versions count as finished.
        **({} if depth_size == "model" else {"depth_size": depth_size}),
    }


def size_settings(batch: ImageBatch) -> dict[str, int]:
    """Return the part of settings about the size of images; empty for the model's default."""
    return {} if batch.process_res is None else {"process_res": batch.process_res}


def _placing_settings(found: Inputs, *, trusted: bool) -> dict[str, Any]:
    """Return the part of settings about known and shared cameras, and scale; empty without any of them."""
    values = {
        "known_cameras": None if found.known is None else digest(found.known), "one_camera": found.one_camera,
        "scale": None if found.scale is None else hashlib.sha256(repr(found.scale).encode()).hexdigest()[:16],
        **({"trusted_cameras": True} if found.known is not None and trusted else {}),
    }  # fmt: skip
    return {"placing": values} if any(values.values()) else {}


def identity(model: str, checkpoint: str, compute: Compute, recipe: Recipe | None, seed: int) -> dict[str, object]:
    """Return what identifies model, weights, precision and seed in the settings of a folder.

    Args:
        model: its name.
        checkpoint: fingerprint of the weights.
        compute: says the precision that was asked for.
        recipe: of the adaptation, which may prefer another precision.
        seed: of everything random.
    """
    return {
        "model": model,
        "checkpoint": checkpoint,
        "precision": compute.precision,
        "adapting_precision": None if recipe is None else compute.preferring(recipe.precision).precision,
        "seed": seed,
    }


def adapter_identity(folder: Path) -> dict[str, str]:
    """Return what identifies an adapter; UserError when the folder holds none."""
    read_peft(folder)
    return {"folder": str(folder.resolve()), "weights": fingerprint(folder / WEIGHTS)}


def check_place(output: Path, *, overwrite: bool) -> None:
    """Refuse a folder that cannot be used whatever the settings are, before anything is loaded or downloaded."""
    if stored_state(output) is None:
        check_folder(output, {}, overwrite=overwrite)


def check_inputs(output: Path, photos: Iterable[PhotoLike], *others: object) -> None:
    """Refuse to overwrite a folder that holds, as files of freegeo, what is read for its new content.

    Args:
        output: the folder.
        photos: that are read.
        *others: other files and folders that are read; what is no path, such as None, is passed over.
    """
    out = output.resolve()
    own = {(out / name).resolve() for name in ledger(out)}
    own |= {folder for file in own for folder in file.parents if folder.is_relative_to(out)}
    inputs = [*(getattr(photo, "path", None) for photo in photos), *others]
    paths = [Path(path) for path in inputs if isinstance(path, str | Path)]
    taken = next((path for path in paths if path.expanduser().resolve() in own), None)
    if taken is not None:
        raise UserError(f"{taken}: it is read, and --overwrite would remove it. Choose another output folder.")


def run_in_folder(
    output: Path,
    settings: Mapping[str, Any],
    found: Inputs,
    model: ReconstructionModel,
    *,
    overwrite: bool,
    trusted: bool,
    recipe: Recipe | None,
    compute: Compute,
    checkpoint: Callable[[], Mapping[str, Any] | None],
    **job: Any,
) -> tuple[dict[str, Any], str | None]:
    """Start or continue a run in its folder; one that is finished is not changed.

    Args:
        output: the folder.
        settings: from `settings_of`.
        found: the photos.
        model: decides how much memory adapting takes; its weights have no part in that.
        overwrite: replace what an earlier run with other settings wrote.
        trusted: known poses are not checked by matches.
        recipe: of the adaptation; None: there is none.
        compute: where the model runs.
        checkpoint: gives what a `Job` takes as checkpoint; called where the folder is not finished, since it may read
            the whole weight file.
        **job: what else a `Job` takes.

    Returns:
        The content of reconstruction.json, and when the folder was finished before; None: just now.
    """
    unchecked = None if trusted else found.known
    state, parts = stored_state(output), PARTS if found.chunks is None else SEQUENCE_PARTS
    # An adapter that stays needs no memory, and a run that continues looks at it again.
    stays = state is not None and (not overwrite or ADAPTATION in kept_parts(state["settings"], settings, parts))
    if recipe is not None and not stays:
        # Before a result that is there gives way.
        together = len(found.batch) if found.chunks is None else min(found.chunks.size, len(found.batch))
        require_adaptation_fits(model, together, found.batch.image_hw, recipe, compute=compute)
    if unchecked is not None and state is not None and state["settings"].get("placing") != settings["placing"]:
        # Before a result that is there gives way to one with cameras that may be refused.
        _check_cameras(unchecked, found.photos)
        unchecked = None
    with run_folder(output, settings, overwrite=overwrite, parts=parts, labels=LABELS) as folder:
        if folder.finished:
            summary, advice = folder / SUMMARY_NAME, "Run again with --overwrite."
            if not summary.is_file():
                raise FreeGeoError(f"{summary}: was removed after the run was finished. {advice}")
            return read_json(summary, _Record, advice=advice), folder.finished_at
        if unchecked is not None:
            _check_cameras(unchecked, found.photos, folder / MATCHES_NAME)
        if any(isinstance(photo, VideoFrame | UndistortedPhoto) for photo in found.photos):
            write_copies(found.photos, folder / COPIES_FOLDER)
        kind = Job if found.chunks is None else partial(SequenceJob, plan=found.chunks)
        work = kind(
            folder=folder, photos=found.photos, batch=found.batch, masks=found.masks, known=found.known,
            priors=found.priors, one_camera=found.one_camera, scale=found.scale, checkpoint=checkpoint(),
            recipe=recipe, compute=compute, **job,
        )  # fmt: skip
        try:
            return work.run(), None
        finally:
            work.release()


def _check_cameras(known: KnownCameras, photos: Sequence[PhotoLike], store: Path | None = None) -> None:
    """Raise UserError for known cameras that matches between the photos contradict; `store` keeps the matches."""
    logger.info("known cameras against matches between the photos ...")
    check_known(known, photos, store)
