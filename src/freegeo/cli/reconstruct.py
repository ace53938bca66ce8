"""`freegeo reconstruct`: a frozen model or a saved adapter, no training."""

from __future__ import annotations

from pathlib import Path

from freegeo.cli.files import FileOptions
from freegeo.cli.jobs import DEFAULT_FILES, run_job
from freegeo.cli.options import (
    CameraOptions,
    ModelOptions,
    OutputOptions,
    PhotoOptions,
    PlacingOptions,
    Refine,
    SequenceOptions,
    refines_with,
)
from freegeo.cli.sources import load_source
from freegeo.models.spec import PoseFrom

DEFAULT_MODEL, DEFAULT_PHOTOS = ModelOptions(), PhotoOptions()
NO_CAMERAS, DEFAULT_PLACING, DEFAULT_SEQUENCE = CameraOptions(), PlacingOptions(), SequenceOptions()


def reconstruct(
    *sources: str,
    output: OutputOptions,
    model: ModelOptions = DEFAULT_MODEL,
    photos: PhotoOptions = DEFAULT_PHOTOS,
    cameras: CameraOptions = NO_CAMERAS,
    placing: PlacingOptions = DEFAULT_PLACING,
    sequence: SequenceOptions = DEFAULT_SEQUENCE,
    files: FileOptions = DEFAULT_FILES,
    adapter: Path | None = None,
    refine: Refine = "off",
    pose_from: PoseFrom = "camera",
) -> None:
    """Reconstruct photos; one photo is enough.

    Parameters
    ----------
    sources
        A folder of photos, a glob in quotes, photo files, a video, or `demo` (a generated room).
    adapter
        Folder of a saved adapter, or the output folder of a run; it decides the model. Without it the frozen
        model is used.
    refine
        ba: bring the cameras to the matches between the photos by bundle adjustment, where matches that had no part in
        it then fit better (needs the extra: pip install 'freegeo[colmap]'); auto: ba where the extra is installed; off.
    pose_from
        camera: cameras of the model's camera head; rays: found from the rays that it predicts (any-view models of DA3).
    """
    from freegeo.adaptation.adapter_files import find_adapter

    refines_with(cameras, refine)  # refused, where it has to be, before photos are read
    if adapter is not None:
        adapter = find_adapter(adapter)
        model = model.for_adapter(adapter)
    found = load_source(sources, photos, doubt=False)  # once it is known which are left out
    model.warn_of_embedded(sources)
    run_job(
        found, model, output, command="reconstruct", recipe=None, adapter=adapter, mixed=photos.mixed,
        process_res=photos.process_res, files=files,
        refine=refine, pose_from=pose_from, cameras=cameras, placing=placing, sequence=sequence,
    )  # fmt: skip
