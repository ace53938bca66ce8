"""What `run`, `reconstruct` and `demo` share: prepare photos, run a job with progress, print the outcome."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from freegeo.adaptation.recipe import SMALLEST_SCENE, Guard
from freegeo.cli import console
from freegeo.cli.files import FileOptions, require_complete
from freegeo.cli.options import (
    CameraOptions,
    ModelOptions,
    OutputOptions,
    PlacingOptions,
    RecipeOptions,
    Refine,
    SequenceOptions,
    refines_with,
)
from freegeo.errors import UserError
from freegeo.export.photos import FOLDER as COPIES_FOLDER
from freegeo.export.photos import write_copies
from freegeo.files import ledger, read_json
from freegeo.models.spec import MIXED, Mixed, PoseFrom
from freegeo.progress import step_bar
from freegeo.report.contents import contents
from freegeo.run_folder import check_folder, run_folder, stored_state

if TYPE_CHECKING:
    import numpy as np

    from freegeo.adaptation.recipe import Recipe
    from freegeo.cameras.known import KnownCameras
    from freegeo.job import Hooks, Job
    from freegeo.metres import ScaleSource
    from freegeo.models.api import ReconstructionModel
    from freegeo.models.images import Frames
    from freegeo.models.spec import ModelSpec
    from freegeo.sequence_job import Plan
    from freegeo.types import ImageBatch, PhotoLike, Priors

logger = logging.getLogger(__name__)

DEFAULT_FILES = FileOptions()
NO_CAMERAS, DEFAULT_PLACING, DEFAULT_SEQUENCE = CameraOptions(), PlacingOptions(), SequenceOptions()
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


@contextmanager
def progress_hooks() -> Generator[Hooks]:
    """Show stages and adaptation steps."""
    from freegeo.job import Hooks

    with step_bar() as on_step:
        yield Hooks(stage=lambda name: console.note(f"{name} ..."), step=on_step)


def run_job(
    photos: Sequence[PhotoLike],
    model_options: ModelOptions,
    output: OutputOptions,
    *,
    command: str,
    recipe: RecipeOptions | None,
    adapter: Path | None = None,
    mixed: Mixed = MIXED,
    process_res: int | None = None,
    files: FileOptions = DEFAULT_FILES,
    guard: Guard = "select",
    refine: Refine = "off",
    pose_from: PoseFrom = "camera",
    cameras: CameraOptions = NO_CAMERAS,
    placing: PlacingOptions = DEFAULT_PLACING,
    sequence: SequenceOptions = DEFAULT_SEQUENCE,
    extra_settings: dict[str, Any] | None = None,
    after: Callable[[Job], None] = lambda job: None,
) -> None:
    """Run a job in its output folder and print the outcome.

    Everything that can be refused is refused before the weights are loaded. A finished folder is not changed; other
    filters, masks and formats are written from the predictions that it holds. `after` writes more before the folder
    counts as finished.
    """
    from freegeo.cameras.undistortion import UndistortedPhoto
    from freegeo.data.video import VideoFrame
    from freegeo.job import MATCHES_NAME, PARTS, SUMMARY_NAME, Job
    from freegeo.models.images import chosen_side
    from freegeo.pipeline import require_enough_photos
    from freegeo.sequence_job import SEQUENCE_PARTS, SequenceJob

    check_place(output)
    check_inputs(output, photos, adapter, cameras.cameras)
    empty = model_options.build_empty()
    process_res = chosen_side(empty.spec, process_res)
    formats = files.all_formats(output, photos, has_cameras=empty.spec.cameras)
    depth_size = files.size_of_depth(output)
    plan, refining = planned(empty, recipe, refine=refine, pose_from=pose_from, cameras=cameras, placing=placing)
    if plan is not None:
        require_enough_photos(photos)
    if empty.spec.caution:
        logger.warning("%s", empty.spec.caution)
    found = _read_inputs(
        photos, empty, model_options, plan, mixed=mixed, process_res=process_res, files=files, cameras=cameras,
        placing=placing, sequence=sequence, before=None if output.overwrite else _together_before(output.output),
    )  # fmt: skip
    settings = {
        "command": command,
        **(extra_settings or {}),
        **_asked_of_model(found, empty.spec, model_options, plan, adapter=adapter, guard=guard, pose_from=pose_from),
        **placing_settings(found.known, found.scale, one_camera=found.one_camera, trusted=cameras.trust_cameras),
        "refinement": "ba" if refining else "off",
        **({} if found.chunks is None else {"joining": {"loops": found.chunks.loops}}),
        "filters": files.filter_settings(found.masks),
        "formats": formats,
        # Only where it is not the default, so that folders of earlier versions count as finished.
        **({} if depth_size == "model" else {"depth_size": depth_size}),
    }
    unchecked = None if cameras.trust_cameras else found.known
    state = stored_state(output.output)
    if unchecked is not None and state is not None and state["settings"].get("placing") != settings["placing"]:
        # Before a result that is there gives way to one with cameras that may be refused.
        _check_cameras(unchecked, found.photos)
        unchecked = None
    options = {
        "overwrite": output.overwrite, "parts": PARTS if found.chunks is None else SEQUENCE_PARTS, "labels": LABELS,
    }  # fmt: skip
    with run_folder(output.output, settings, **options) as folder, progress_hooks() as hooks:
        if folder.finished:
            say_finished(output.output, folder.finished_at)
            before = read_json(folder / SUMMARY_NAME)
            require_complete(output.output, before.get("not_written", {}), before.get("sequence"))
            return
        if unchecked is not None:
            _check_cameras(unchecked, found.photos, folder / MATCHES_NAME)
        if any(isinstance(photo, VideoFrame | UndistortedPhoto) for photo in found.photos):
            write_copies(found.photos, folder / COPIES_FOLDER)
        kind = Job if found.chunks is None else partial(SequenceJob, plan=found.chunks)
        job = kind(
            load=model_options.load, spec=empty.spec, folder=folder, recipe=plan, adapter=adapter, guard=guard,
            seed=model_options.seed, compute=model_options.compute(), hooks=hooks, reference=model_options.reference,
            command=console.command_line(), warnings=console.warned(), after=after, formats=formats,
            depth_size=depth_size, filters=files.filters.settings(), checkpoint=model_options.origin(),
            refine=refining, pose_from=pose_from, photos=found.photos, batch=found.batch, masks=found.masks,
            known=found.known, priors=found.priors, one_camera=found.one_camera, scale=found.scale,
        )  # fmt: skip
        summary = job.run()
        describe(summary, output.output)
    require_complete(output.output, summary["not_written"], summary.get("sequence"))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Inputs:
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


def _read_inputs(
    photos: Sequence[PhotoLike],
    empty: ReconstructionModel,
    model_options: ModelOptions,
    plan: Recipe | None,
    *,
    mixed: Mixed,
    process_res: int | None,
    files: FileOptions,
    cameras: CameraOptions,
    placing: PlacingOptions,
    sequence: SequenceOptions,
    before: int | None,
) -> _Inputs:
    """Read photos and what belongs to them; UserError for what does not go together.

    Of a sequence, the photos that show nothing are left out. `before`: how many photos an earlier run of the folder
    predicted together.
    """
    from freegeo.adaptation.adapt import require_unchanged_images
    from freegeo.metres import read_scale
    from freegeo.models.images import look_at_photos, read_photos
    from freegeo.pipeline import require_reference
    from freegeo.posed import is_one_camera, told, undistorted_masks

    masks = files.checked_masks(photos)
    photos, known = cameras.read(photos)
    masks = undistorted_masks(masks, photos)
    chunks = sequence.plan(
        empty, photos, mixed, model_options.compute(), process_res=process_res, before=before
    )  # fmt: skip
    if chunks is None:
        batch: ImageBatch = read_photos(empty, photos, mixed=mixed, process_res=process_res)
    else:
        _require_joinable(chunks, known, plan)
        frames = look_at_photos(empty, photos, mixed=mixed, process_res=process_res)
        shown = _shown(frames)
        batch, photos = frames.select(shown), [photos[view] for view in shown]
        known = None if known is None else known.select(shown)
        masks = None if masks is None else [masks[view] for view in shown]
    priors, sentence = told(known, batch, empty.spec)
    if sentence:
        console.note(sentence)
    require_reference(model_options.reference, priors)
    if plan is not None and priors is not None:
        require_unchanged_images(plan)
    return _Inputs(
        photos=photos, batch=batch, chunks=chunks, known=known, priors=priors, masks=masks,
        scale=None if placing.scale is None else read_scale(placing.scale, photos),
        one_camera=is_one_camera(photos) if placing.one_camera is None else placing.one_camera,
    )  # fmt: skip


def _together_before(folder: Path) -> int | None:
    """Return how many photos the run in a folder predicts together; None where there is none."""
    state = stored_state(folder)
    adaptation = {} if state is None else state["settings"].get("adaptation") or {}
    if "sequence" in adaptation:
        return adaptation["sequence"]["chunk"]
    return len(adaptation["photos"]) if adaptation.get("photos") else None


def _asked_of_model(
    found: _Inputs,
    spec: ModelSpec,
    model_options: ModelOptions,
    plan: Recipe | None,
    *,
    adapter: Path | None,
    guard: Guard,
    pose_from: PoseFrom,
) -> dict[str, Any]:
    """Return the parts of a job's settings that adapter and predictions depend on."""
    adaptation: dict[str, Any] = {
        "photos": list(found.batch.names), "photo_contents": found.batch.digest(), **model_options.identity(plan),
        "recipe": None if plan is None else asdict(plan),
        "guard": None if plan is None else guard,
        "adapter": None if adapter is None else adapter_identity(adapter),
        **({} if found.priors is None else {"known_cameras": found.priors.digest()}),
        **size_settings(found.batch),
    }  # fmt: skip
    # Only where it is not the default, so that folders of earlier versions count as finished.
    rays = {} if pose_from == "camera" else {"pose_from": pose_from}
    reference = model_options.reference or spec.reference
    judged = rays | ({} if reference == spec.reference else {"reference": reference})
    if plan is not None and guard != "off" and judged:
        adaptation["judged_by"] = judged
    if (chunks := found.chunks) is not None:
        adaptation["sequence"] = {"chunk": chunks.size, "overlap": chunks.overlap, "order": chunks.order}
    return {"adaptation": adaptation, "prediction": {"reference": reference, **rays}}


def _check_cameras(known: KnownCameras, photos: Sequence[PhotoLike], store: Path | None = None) -> None:
    """Raise UserError for known cameras that matches between the photos contradict; `store` keeps the matches."""
    from freegeo.posed import check_known

    console.note("known cameras against matches between the photos ...")
    check_known(known, photos, store)


def _shown(frames: Frames) -> list[int]:
    """Return the photos of a sequence that show something, and say which ones are left out."""
    from freegeo.data.photos import some_of

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


def _require_joinable(chunks: Plan, known: KnownCameras | None, plan: Recipe | None) -> None:
    """Raise UserError for what photos that are predicted in chunks cannot have."""
    if plan is not None and chunks.size < SMALLEST_SCENE:
        raise UserError(
            f"--chunk {chunks.size}: adaptation needs chunks of at least {SMALLEST_SCENE} photos. Take larger ones, or "
            "reconstruct without adapting (--no-adapt)."
        )
    if known is not None and known.has_pose.any() and not known.has_pose.all():
        raise UserError(
            f"{known.source}: of some photos the pose is known and of others not, and these are more photos than are "
            "predicted at once. Give the poses of all photos, or of none, or only the photos whose poses are known."
        )
    if plan is not None and plan.cameras:
        raise UserError(
            f"recipe {plan.name} learns from cameras of one chunk, and these are more photos than are predicted at "
            "once. Take recipe scene, or --max-views."
        )


def planned(
    empty: ReconstructionModel,
    recipe: RecipeOptions | None,
    *,
    refine: Refine,
    pose_from: PoseFrom,
    cameras: CameraOptions = NO_CAMERAS,
    placing: PlacingOptions = DEFAULT_PLACING,
) -> tuple[Recipe | None, bool]:
    """Return the recipe for a model, if it is to adapt, and whether refinement follows.

    UserError for options that the model has no use for, or that do not go together.
    """
    from freegeo.pipeline import require_pose_from
    from freegeo.posed import require_cameras

    require_pose_from(empty.spec, pose_from)
    refining = refines_with(cameras, refine) and empty.spec.cameras
    if refine == "ba" and not refining:
        raise UserError(f"{empty.spec.name} predicts no cameras, so there are none to refine. Leave --refine out.")
    if cameras.cameras is not None or placing.scale is not None:
        require_cameras(empty.spec)
    if recipe is None:
        return None, refining
    empty.adaptable()
    plan = recipe.build(empty.spec)
    if plan.cameras and pose_from == "rays":
        raise UserError(
            f"recipe {plan.name} teaches the camera head, which --pose-from rays does not read. Leave out one of them."
        )
    return plan, refining


def size_settings(batch: ImageBatch) -> dict[str, int]:
    """Return the part of settings about the size of images; empty for the model's default."""
    return {} if batch.process_res is None else {"process_res": batch.process_res}


def placing_settings(
    known: KnownCameras | None, scale: ScaleSource | None, *, one_camera: bool, trusted: bool
) -> dict[str, Any]:
    """Return the part of a job's settings about known and shared cameras, and scale; empty without any of them."""
    from freegeo.posed import digest

    values = {
        "known_cameras": None if known is None else digest(known), "one_camera": one_camera,
        "scale": None if scale is None else hashlib.sha256(repr(scale).encode()).hexdigest()[:16],
        **({"trusted_cameras": True} if known is not None and trusted else {}),
    }  # fmt: skip
    return {"placing": values} if any(values.values()) else {}


def check_place(output: OutputOptions) -> None:
    """Refuse a folder that cannot be used whatever the settings are, before anything is loaded or downloaded."""
    if stored_state(output.output) is None:
        check_folder(output.output, {}, overwrite=output.overwrite)


def check_inputs(output: OutputOptions, photos: Iterable[PhotoLike], *others: Path | None) -> None:
    """Refuse to remove with --overwrite the photos, or other files and folders, that the command reads."""
    if not output.overwrite:
        return
    out = output.output.resolve()
    own = {(out / name).resolve() for name in ledger(out)}
    own |= {folder for file in own for folder in file.parents if folder.is_relative_to(out)}
    inputs = [*(getattr(photo, "path", None) for photo in photos), *others]
    taken = next((path for path in inputs if isinstance(path, Path) and path.resolve() in own), None)
    if taken is not None:
        raise UserError(
            f"{taken}: the command reads it, and --overwrite would remove it. Choose another output folder."
        )


def adapter_identity(folder: Path) -> dict[str, str]:
    """Return what identifies an adapter; UserError when the folder holds none."""
    from freegeo.adaptation.adapter_files import WEIGHTS, read_peft
    from freegeo.models.checkpoints import fingerprint

    read_peft(folder)
    return {"folder": str(folder.resolve()), "weights": fingerprint(folder / WEIGHTS)}


def say_finished(folder: Path, finished_at: str | None) -> None:
    """Say that there is nothing left to do."""
    console.say(f"{folder}: already finished on {finished_at}; nothing to do.")


def say_answer(summary: dict[str, Any]) -> None:
    """Print whether adaptation and refinement helped, the scores of that, and what to try where they did not."""
    from freegeo.report.answer import HEADER, answer

    found = answer(summary)
    if found is None:
        return
    console.say("\nDid it help?")
    for part in found.parts:
        console.say(f"{part.what}: {part.outcome}. {part.sentence}")
    if found.rows:
        console.say(console.table(HEADER, found.rows))
    if found.advice:
        console.say("What to try next:")
        for sentence in found.advice:
            console.say(f"  {sentence}")
    console.say()


def describe(summary: dict[str, Any], folder: Path) -> None:
    """Print the outcome of a job."""
    say_answer(summary)
    console.say(f"{len(summary['images'])} views at {summary['image_hw'][1]} x {summary['image_hw'][0]} pixels")
    if summary["known_cameras"]:
        say_known(summary)
    if summary["scale"]:
        spread = summary["scale"]["spread"]
        certain = "" if spread is None else f", to {100 * spread:.2g} %"
        console.say(f"lengths are metres (from {summary['scale']['source']}){certain}")
    if summary["loss"]:
        first, last = summary["loss"]["first"], summary["loss"]["last"]
        console.say(f"adaptation loss {first:.4f} -> {last:.4f} (means of the first and last tenth of the steps)")
    console.say("seconds: " + ", ".join(f"{name} {value:.1f}" for name, value in summary["seconds"].items()))
    console.say(f"licence of the weights: {summary['licence_of_weights']}")
    for sentence in summary["warnings"]:
        console.say(f"warning: {sentence}")
    console.written(folder, contents(folder))


def say_known(summary: dict[str, Any]) -> None:
    """Print what known cameras made of the prediction."""
    from freegeo.report.answer import rescaled

    about = summary["known_cameras"]
    parts = [f"poses of {about['poses']} and intrinsics of {about['intrinsics']} photos as given"]
    metres = rescaled(summary)
    if metres is not None:
        parts[0] += f", positions times {metres:.4g} to be metres"
    if about["scale"] is not None:
        measured = about.get("measured")
        factor = (metres or 1) * (1 if measured is None else measured["factor"])
        by = "" if measured is None else f" (by {measured['points']:,} points that matches measure with these cameras)"
        parts.append(f"depth times {about['scale'] * factor:.4g}{by}")
    if about["rotation_deg"] is not None:
        far = "" if about["position"] is None else f", {100 * about['position']:.2g} % of the longest distance"
        parts.append(f"predicted cameras differed by {about['rotation_deg']:.2g} degrees{far} in the median")
    console.say(f"cameras of {about['source']}: {'; '.join(parts)}")
