"""`freegeo run`: photos in, adapted reconstruction out."""

from __future__ import annotations

from freegeo.adaptation.recipe import Guard
from freegeo.cli.files import FileOptions
from freegeo.cli.jobs import DEFAULT_FILES, run_job
from freegeo.cli.options import (
    CameraOptions,
    ModelOptions,
    OutputOptions,
    PhotoOptions,
    PlacingOptions,
    RecipeOptions,
    Refine,
    SequenceOptions,
    refines_with,
)
from freegeo.cli.sources import load_source
from freegeo.models.spec import PoseFrom

DEFAULT_RECIPE, DEFAULT_MODEL, DEFAULT_PHOTOS = RecipeOptions(), ModelOptions(), PhotoOptions()
NO_CAMERAS, DEFAULT_PLACING, DEFAULT_SEQUENCE = CameraOptions(), PlacingOptions(), SequenceOptions()


def run(
    *sources: str,
    output: OutputOptions,
    model: ModelOptions = DEFAULT_MODEL,
    recipe: RecipeOptions = DEFAULT_RECIPE,
    photos: PhotoOptions = DEFAULT_PHOTOS,
    cameras: CameraOptions = NO_CAMERAS,
    placing: PlacingOptions = DEFAULT_PLACING,
    sequence: SequenceOptions = DEFAULT_SEQUENCE,
    files: FileOptions = DEFAULT_FILES,
    adapt: bool = True,
    guard: Guard = "select",
    refine: Refine = "auto",
    pose_from: PoseFrom = "camera",
) -> None:
    """Reconstruct photos with a model adapted to them.

    The same command continues an unfinished run.

    Parameters
    ----------
    sources
        A folder of photos, a glob in quotes, photo files, a video, or `demo` (a generated room).
    adapt
        Adapt before reconstructing; --no-adapt uses the frozen model.
    guard
        select: matches between the photos decide whether and in which state the adapter is used; report: they are only
        asked; off.
    refine
        ba: bring the cameras to the matches by bundle adjustment, where matches that had no part in it then fit better
        (needs the extra: pip install 'freegeo[colmap]'); auto: ba where the extra is installed; off.
    pose_from
        camera: cameras of the model's camera head; rays: found from the rays that it predicts (any-view models of DA3).
    """
    refines_with(cameras, refine)  # refused, where it has to be, before photos are read
    found = load_source(sources, photos, doubt=False)  # once it is known which are left out
    model.warn_of_embedded(sources)
    plan = recipe if adapt else None
    run_job(
        found, model, output, command="run", recipe=plan, mixed=photos.mixed,
        process_res=photos.process_res, files=files, guard=guard, refine=refine,
        pose_from=pose_from, cameras=cameras, placing=placing, sequence=sequence,
    )  # fmt: skip
