"""`freegeo export`: a finished reconstruction in other tools' formats."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from freegeo.cli import console
from freegeo.cli.files import FORMAT_NAMES, FilterOptions, require_complete
from freegeo.errors import UserError
from freegeo.export.base import MAX_TRACKS, DepthSize
from freegeo.fusion.settings import MAX_POINTS

if TYPE_CHECKING:
    import numpy as np

    from freegeo.data.photos import Photo
    from freegeo.export.reconstruction import Reconstruction


def export(
    source: Path,
    *,
    format: Annotated[list[str], FORMAT_NAMES, Parameter(name=("--format", "-f"))],
    output: Annotated[Path | None, Parameter(name=("--output", "-o"))] = None,
    frozen: bool = False,
    max_points: int = MAX_POINTS,
    max_tracks: int = MAX_TRACKS,
    voxel: float | None = None,
    depth_size: DepthSize | None = None,
    filters: FilterOptions | None = None,
) -> None:
    """Write a reconstruction in other formats.

    Parameters
    ----------
    source
        Folder that `run` or `reconstruct` wrote, or a prediction.npz. The points are those that the run kept, unless
        an option of the filters below is given; then all filters run again.
    output
        Folder for the files; default: that of the prediction.
    frozen
        Export the prediction before adaptation (default output: frozen/ in the folder).
    max_points
        Most points in point clouds.
    max_tracks
        Most points of the COLMAP model.
    voxel
        Voxel edge of the mesh, in the reconstruction's units; default: from its resolution.
    depth_size
        Size of depth files: model, that of the model's images, or photo, interpolated from it along the photos' edges.
        Default: as the command that made the result wrote them.
    """
    from freegeo.export import formats
    from freegeo.export.kept import load_kept, load_masks
    from freegeo.export.measured import load_tracks
    from freegeo.export.pixels import masks_for_model
    from freegeo.export.reconstruction import Reconstruction
    from freegeo.files import remove_parts
    from freegeo.job import FROZEN_FOLDER, before_adaptation
    from freegeo.lock import kept_still, locked

    source = source.expanduser()
    stored = source / FROZEN_FOLDER if frozen else source
    home = stored.parent if stored.is_file() else stored
    target = home if output is None else output.expanduser()
    run = result_folder(home)
    if result_folder(target) not in (None, run):
        raise UserError(f"{target}: holds another result. Choose another folder for the files (--output).")
    with kept_still(run):
        reconstruction = Reconstruction.load(stored)
        names = formats.check_formats(format, reconstruction.names, has_cameras=reconstruction.has_cameras)
        filtered, masks = None, None
        if filters is None:
            filtered = load_kept(home, reconstruction.depth_z.shape)
            masks = None if filtered is None else load_masks(home)
        else:
            sizes = [(height, width) for height, width in reconstruction.photo_hw.tolist()]
            given = filters.load_masks(reconstruction.names, sizes, model_hw=reconstruction.image_hw)
            masks = None if given is None else masks_for_model(reconstruction, given)
            if reconstruction.has_cameras:
                filtered = formats.filter_reconstruction(reconstruction, masks=masks, settings=filters.settings())
                if target.resolve() == run:
                    require_points_of_report(target, filtered[0])
        summary = stored_summary(run or home)
        if depth_size is None:
            depth_size = "photo" if summary["settings"].get("depth_size") == "photo" else "model"
        before = None
        if home.resolve() == run and summary.get("adapter"):
            before = before_adaptation(home, summary)
        if before is not None and filters is not None:
            before = replace(before, filters=filters.settings())
        place = result_folder(target) or target
        with nullcontext() if place == run else locked(place):
            remove_parts(place)
            result = formats.export(
                reconstruction, target, names, filtered=filtered, masks=masks,
                photos=find_photos(reconstruction, run or home), max_points=max_points, max_tracks=max_tracks,
                voxel=voxel, tracks=load_tracks(home, len(reconstruction)), before=before,
                depth_size=depth_size,
            ).require_any()  # fmt: skip
    for path in dict.fromkeys(target / file.relative_to(target).parts[0] for file in result.files):
        console.say(f"  {path}  {console.size(path)}")
    require_complete(target, result.failed)


def require_points_of_report(folder: Path, keep: np.ndarray) -> None:
    """Raise UserError when a run's folder would get files with other points than its report and other files show."""
    from freegeo.export.kept import load_kept

    shown = load_kept(folder, keep.shape)
    if shown is not None and (shown[0] != keep).any():
        raise UserError(
            f"{folder}: its report and other files show other points than these options keep. Give another folder "
            "(--output), or repeat the command that made it with these options: it writes all files again without "
            "adapting."
        )


def result_folder(folder: Path) -> Path | None:
    """Return the output folder of a run that a folder is, or is in; None where it is in none."""
    from freegeo.files import RUN_FILE

    folder = folder.resolve()
    return next((parent for parent in (folder, *folder.parents) if (parent / RUN_FILE).is_file()), None)


def stored_summary(folder: Path) -> dict[str, Any]:
    """Return what later commands read of reconstruction.json in a folder; DamagedError when it is damaged.

    `images`, `photo_files`, `refinement`, `settings` and `warnings` are empty where the file, or the field, is missing.
    """
    from freegeo.job import SUMMARY_NAME
    from freegeo.report.schema import Summary, read_part

    summary = read_part(folder / SUMMARY_NAME, Summary)
    empty = {"images": [], "photo_files": [], "refinement": {}, "settings": {}, "warnings": []}
    return summary | {name: summary.get(name) or nothing for name, nothing in empty.items()}


def find_photos(reconstruction: Reconstruction, run: Path) -> list[Photo] | None:
    """Return the photos of a stored result if all are as they were, or as upright copies in its folder; else None."""
    from freegeo.data.photos import Photo
    from freegeo.export import colmap
    from freegeo.export.photos import FOLDER, content_hash, copy_names
    from freegeo.files import ledger

    summary = stored_summary(run)
    records = dict(zip(map(str, summary["images"]), summary["photo_files"], strict=False))
    own = set(ledger(run))
    photos = []
    for name, copy, (height, width) in zip(
        reconstruction.names, copy_names(reconstruction.names), reconstruction.photo_hw.tolist(), strict=True
    ):
        record = records.get(name)
        file = Path(record["file"]) if record else run
        if not record or "\0" in record["file"] or not file.is_file() or content_hash(file) != record["sha256"]:
            places = [f"{folder}{FOLDER}/{copy}" for folder in ("", f"{colmap.FORMAT.path}/")]
            copied = [run / place for place in places if place in own and (run / place).is_file()]
            if not copied:
                return None
            file = copied[0]
        photos.append(Photo(name, file, (height, width)))
    return photos
