"""Any number of photos into a folder from Python, by the run that `freegeo run` and its kin share (`runs`)."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from freegeo.adaptation.adapter import is_adapted
from freegeo.adaptation.adapter_files import find_adapter, load_adapter
from freegeo.adaptation.recipe import SEED, Guard, Recipe, require_guard, require_seed
from freegeo.data.photos import all_of
from freegeo.errors import UserError
from freegeo.evidence.bundle import pycolmap_module
from freegeo.export.base import DEFAULT_FORMATS
from freegeo.export.formats import check_formats
from freegeo.export.reconstruction import Reconstruction
from freegeo.fusion.settings import FilterSettings
from freegeo.job import Hooks
from freegeo.models.catalog import caution_of
from freegeo.models.checkpoints import fingerprint_of
from freegeo.models.images import chosen_side
from freegeo.models.precision import Compute
from freegeo.models.reference import require_no_choice, require_rule
from freegeo.models.spec import MIXED, NO_REFERENCE, Mixed, PoseFrom
from freegeo.pipeline import (
    named_recipe,
    require_enough_photos,
    require_model,
    require_pose_from,
    warn_of_model,
)
from freegeo.posed import known_cameras, require_cameras
from freegeo.progress import remembered, step_bar
from freegeo.runs import (
    SequenceWish,
    check_inputs,
    check_place,
    identity,
    read_inputs,
    run_in_folder,
    settings_of,
    together_before,
)
from freegeo.sequence.chunks import OrderRule

if TYPE_CHECKING:
    from freegeo.cameras.known import KnownCameras
    from freegeo.data.photos import PhotoSource
    from freegeo.models.api import ReconstructionModel

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, eq=False)
class SequenceResult:
    """The result of `freegeo.reconstruct_sequence`."""

    folder: Path
    """Where it is: the files and `report.html` that `freegeo run` writes."""
    pieces: tuple[Reconstruction, ...]
    """Reconstructions, mapped from files, not loaded. One, unless there are photos that could not be joined to the
    others: each piece then has a world frame and a scale of its own. The first has the most photos."""
    summary: Mapping[str, Any]
    """The content of reconstruction.json: `warnings`, and `sequence` with chunks, seams, loops and pieces (where all
    photos were predicted at once there is no `sequence`)."""

    @property
    def result(self) -> Reconstruction:
        """The first piece."""
        return self.pieces[0]

    def __repr__(self) -> str:
        """Return the numbers of photos, such as SequenceResult(300 views)."""
        return f"SequenceResult({' and '.join(str(len(piece)) for piece in self.pieces)} views)"


def reconstruct_sequence(
    model: ReconstructionModel,
    photos: PhotoSource,
    output: str | Path,
    *,
    chunk: int | None = None,
    overlap: int | None = None,
    order: OrderRule = "auto",
    loops: bool = True,
    recipe: str | Recipe | None = None,
    guard: Guard = "select",
    seed: int = SEED,
    adapter: str | Path | None = None,
    cameras: KnownCameras | str | Path | None = None,
    trust_cameras: bool = False,
    one_camera: bool | None = None,
    scale: str | None = None,
    reference: str | None = None,
    refine: bool = False,
    formats: Sequence[str] = DEFAULT_FORMATS,
    filters: FilterSettings | None = None,
    device: str | None = None,
    precision: str | None = None,
    max_views: int | None = None,
    fps: float | None = None,
    mixed: Mixed = MIXED,
    process_res: int | None = None,
    pose_from: PoseFrom = "camera",
    overwrite: bool = False,
    progress: bool = False,
) -> SequenceResult:
    """Reconstruct any number of photos into a folder, as `freegeo run` and `freegeo reconstruct` do.

    Of more photos than are predicted at once, chunks that overlap are predicted one after the other and joined
    (docs/sequences.md), with a few of them in memory at a time. The same call continues a run that was stopped, and
    reads a finished one.

    Args:
        model: from `freegeo.load_model`, without an adapter; it is moved to the device, and without one afterwards.
        photos: what `freegeo.load_photos` takes or returned; all of them are used.
        output: folder for the result.
        chunk: photos that are predicted together; None: as many as fit into memory and suit the model.
        overlap: photos that two neighbouring chunks share; None: half of a chunk.
        order: `given`; `similar`: by what photos show; `auto`: given, unless neighbours do not look alike.
        loops: look for places that the photos come back to, and let them correct the way between.
        recipe: adapt the model to the photos by this recipe, one adapter for all chunks (`scene`, or a recipe of your
            own); None: no adaptation.
        guard: of an adaptation, as for `freegeo.adapt`.
        seed: of everything random.
        adapter: folder of a saved adapter, instead of a recipe.
        cameras: known cameras, as for `freegeo.reconstruct`; of more photos than are predicted at once, poses of some
            take two or more in different places. Photos with distortion are undistorted, and copies of them written.
        trust_cameras: use poses without checking them by the matches between the photos.
        one_camera: as for `freegeo.reconstruct`.
        scale: as for `freegeo.reconstruct`; it holds for a piece that shows the measured places.
        reference: rule of the reference view; None: the model's own.
        refine: bring the cameras to the matches between the photos; needs the extra `colmap`.
        formats: files to write besides the predictions, as for `Reconstruction.export`.
        filters: which points are kept; None: the defaults.
        device: cpu, cuda, cuda:N or mps; None: the best available.
        precision: fp32, bf16 or fp16; None: bf16 on CUDA, else fp32.
        max_views: most photos that are used; None: all.
        fps: of a video, take a frame this often per second; None: 32 frames, or `max_views`, by sharpness and parallax.
        mixed: how photos of different shapes become images of one size, as for `freegeo.reconstruct`.
        process_res: longest side of the model's images, as for `freegeo.reconstruct`.
        pose_from: where cameras come from, as for `freegeo.reconstruct`.
        overwrite: replace what an earlier run with other settings wrote into the folder.
        progress: show a bar, and log the stages; without it nothing is printed.

    Raises:
        UserError: an argument that cannot be used, or a folder with another result or with files of others.
        FreeGeoError: no chunk has a usable prediction.
    """
    require_model(model)
    if is_adapted(model):
        raise UserError("the model carries an adapter; detach it, and give the folder of a saved one as adapter.")
    require_pose_from(model.spec, pose_from)
    require_seed(seed)
    require_guard(guard)
    wish = SequenceWish(chunk=chunk, overlap=overlap, order=order, loops=loops)
    wish.check()
    if reference is not None:
        require_rule(reference)
        if model.spec.reference == NO_REFERENCE:
            require_no_choice(reference, model.spec.name)
    if recipe is not None and adapter is not None:
        raise UserError("recipe trains an adapter, and adapter names one that is there. Leave out one of them.")
    if refine:
        if cameras is not None:
            raise UserError("refine would move the cameras that are known. Leave out refine or cameras.")
        pycolmap_module()
    if cameras is not None or scale is not None or refine:
        require_cameras(model.spec)
    compute, folder = Compute.choose(device, precision), Path(output).expanduser()
    process_res = chosen_side(model.spec, process_res)
    check_place(folder, overwrite=overwrite)
    saved = None if adapter is None else find_adapter(adapter)
    if saved is not None:
        # One that does not fit is refused before a result gives way.
        load_adapter(model, saved).detach()
    with remembered() as warned:
        warn_of_model(model)
        if (caution := caution_of(model.spec)) and caution not in warned:
            # It is logged once in a process, and belongs to every result.
            warned.append(caution)
        plan = None
        if recipe is not None:
            model.adaptable()
            plan = named_recipe(recipe, model, None)
            require_pose_from(model.spec, pose_from, plan)
            if plan.cameras:
                pycolmap_module()
        seen, known = all_of(photos, max_views, fps=fps), None
        if plan is not None:
            require_enough_photos(seen)
        if overwrite:
            check_inputs(folder, seen, saved, cameras, scale)
        if cameras is not None:
            seen, known = known_cameras(seen, cameras)
        written = check_formats(formats, [photo.name for photo in seen], has_cameras=model.spec.cameras)
        found = read_inputs(
            seen, model, plan, wish, compute, known=known, mixed=mixed, process_res=process_res, reference=reference,
            scale=scale, one_camera=one_camera, before=None if overwrite else together_before(folder),
        )  # fmt: skip
        points = filters or FilterSettings()
        settings = settings_of(
            found, model.spec, plan, command="reconstruct_sequence", adapter=saved, guard=guard, reference=reference,
            model=identity(model.spec.name, fingerprint_of(model), compute, plan, seed), pose_from=pose_from,
            trusted=trust_cameras, refine=refine, filters=asdict(points), formats=written,
        )  # fmt: skip
        with step_bar() if progress else nullcontext(lambda step: None) as on_step:
            summary, _ = run_in_folder(
                folder, settings, found, model, overwrite=overwrite, trusted=trust_cameras, load=lambda: model,
                spec=model.spec, recipe=plan, adapter=saved, guard=guard, seed=seed, compute=compute,
                hooks=Hooks(stage=_said if progress else lambda stage: None, step=on_step), reference=reference,
                warnings=warned, formats=written, filters=points, refine=refine, pose_from=pose_from,
                checkpoint=lambda: None if model.loaded_from is None else model.loaded_from.weights(),
            )  # fmt: skip
    pieces = [part["folder"] for part in summary["sequence"]["pieces"]] if "sequence" in summary else ["."]
    return SequenceResult(
        folder=folder, pieces=tuple(Reconstruction.load(folder / piece) for piece in pieces), summary=summary
    )


def _said(stage: str) -> None:
    logger.info("%s ...", stage)
