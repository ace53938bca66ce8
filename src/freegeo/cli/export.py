"""`freegeo export`: a finished reconstruction in other tools' formats."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from freegeo.cli import console
from freegeo.cli.files import FORMAT_NAMES, FilterOptions
from freegeo.export.base import MAX_TRACKS
from freegeo.fusion.settings import MAX_POINTS

DEFAULT_FILTERS = FilterOptions()


def export(
    source: Path,
    *,
    format: Annotated[list[str], FORMAT_NAMES, Parameter(name=("--format", "-f"))],
    output: Annotated[Path | None, Parameter(name=("--output", "-o"))] = None,
    frozen: bool = False,
    max_points: int = MAX_POINTS,
    max_tracks: int = MAX_TRACKS,
    voxel: float | None = None,
    filters: FilterOptions = DEFAULT_FILTERS,
) -> None:
    """Write a reconstruction in other formats.

    Parameters
    ----------
    source
        Folder that `run` or `reconstruct` wrote.
    output
        Folder for the files; default: the reconstruction's own.
    frozen
        Export the prediction before adaptation.
    max_points
        Most points in point clouds.
    max_tracks
        Most points of the COLMAP model.
    voxel
        Voxel edge of the mesh, in the reconstruction's units; default: from its resolution.
    """
    from freegeo.export import formats
    from freegeo.export.pixels import masks_for_model
    from freegeo.export.reconstruction import Reconstruction
    from freegeo.pipeline import FROZEN_FOLDER

    reconstruction = Reconstruction.load(source / FROZEN_FOLDER if frozen else source)
    masks = filters.load_masks(
        reconstruction.names, [(int(h), int(w)) for h, w in reconstruction.photo_hw], model_hw=reconstruction.image_hw
    )
    wanted = None if masks is None else masks_for_model(reconstruction, masks)
    filtered = formats.filter_reconstruction(reconstruction, masks=wanted, settings=filters.settings())
    files = formats.export(
        reconstruction, output or source, format, filtered=filtered, max_points=max_points, max_tracks=max_tracks,
        voxel=voxel,
    )  # fmt: skip
    console.say(filtered[1].summary())
    for file in files:
        console.say(f"  {file}  {console.size(file)}")
