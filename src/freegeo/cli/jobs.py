"""What `run`, `reconstruct` and `demo` share: prepare photos, run a job with progress, print the outcome."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from freegeo.adaptation.recipe import Guard
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
from freegeo.models.spec import MIXED, Mixed, PoseFrom
from freegeo.progress import step_bar
from freegeo.report.contents import contents

if TYPE_CHECKING:
    from freegeo.adaptation.recipe import Recipe
    from freegeo.job import Hooks, Job
    from freegeo.models.api import ReconstructionModel
    from freegeo.types import PhotoLike

logger = logging.getLogger(__name__)

DEFAULT_FILES = FileOptions()
NO_CAMERAS, DEFAULT_PLACING, DEFAULT_SEQUENCE = CameraOptions(), PlacingOptions(), SequenceOptions()


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
    from freegeo.adaptation.adapter_files import require_fitting
    from freegeo.models.images import chosen_side
    from freegeo.pipeline import require_enough_photos
    from freegeo.posed import undistorted_masks
    from freegeo.runs import check_inputs, check_place, read_inputs, run_in_folder, settings_of, together_before

    check_place(output.output, overwrite=output.overwrite)
    if output.overwrite:
        check_inputs(output.output, photos, adapter, cameras.cameras, files.filters.masks, placing.scale)
    empty = model_options.build_empty()
    process_res = chosen_side(empty.spec, process_res)
    formats = files.all_formats(output, photos, has_cameras=empty.spec.cameras)
    depth_size = files.size_of_depth(output)
    plan, refining = planned(empty, recipe, refine=refine, pose_from=pose_from, cameras=cameras, placing=placing)
    if plan is not None:
        require_enough_photos(photos)
    if empty.spec.caution:
        logger.warning("%s", empty.spec.caution)
    masks, compute = files.checked_masks(photos), model_options.compute()
    photos, known = cameras.read(photos)
    found = read_inputs(
        photos, empty, plan, sequence.wish(), compute, known=known, masks=undistorted_masks(masks, photos), mixed=mixed,
        process_res=process_res, reference=model_options.reference, scale=placing.scale, one_camera=placing.one_camera,
        before=None if output.overwrite else together_before(output.output),
    )  # fmt: skip
    same: dict[str, Any] = {
        "adapter": adapter, "guard": guard, "reference": model_options.reference, "pose_from": pose_from,
        "refine": refining, "formats": formats, "depth_size": depth_size,
    }  # fmt: skip
    settings = settings_of(
        found, empty.spec, plan, command=command, model=model_options.identity(plan), trusted=cameras.trust_cameras,
        filters=files.filter_settings(found.masks), extra=extra_settings, **same,
    )  # fmt: skip
    if adapter is not None:
        # Before a result that is there gives way.
        require_fitting(empty, adapter, model_options.fingerprint)
    with progress_hooks() as hooks:
        summary, finished_at = run_in_folder(
            output.output, settings, found, empty, overwrite=output.overwrite, trusted=cameras.trust_cameras,
            load=model_options.load, spec=empty.spec, recipe=plan, seed=model_options.seed, compute=compute,
            hooks=hooks, command=console.command_line(), warnings=console.warned(), after=after,
            filters=files.filters.settings(), checkpoint=model_options.origin, **same,
        )  # fmt: skip
    if finished_at is not None:
        say_finished(output.output, finished_at)
    else:
        describe(summary, output.output)
    require_complete(output.output, summary.get("not_written", {}), summary.get("sequence"))


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
    require_pose_from(empty.spec, pose_from, plan)
    return plan, refining


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
    from freegeo.report.answer import rescaled, ties

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
    if "untied" in about:
        parts.append(f"poses {ties(about)}")
    elif about["rotation_deg"] is not None:
        far = "" if about["position"] is None else f", {100 * about['position']:.2g} % of the longest distance"
        parts.append(f"predicted cameras differed by {about['rotation_deg']:.2g} degrees{far} in the median")
    console.say(f"cameras of {about['source']}: {'; '.join(parts)}")
