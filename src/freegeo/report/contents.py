"""The files of an output folder and what they are for: for the summary of a command, and the links of a report."""

from __future__ import annotations

from pathlib import Path

from freegeo.export import depth_files
from freegeo.export import reconstruction as npz
from freegeo.export.base import KEPT_NAME, TRACKS_NAME
from freegeo.export.formats import FORMATS
from freegeo.export.nerfstudio import DEPTH_FOLDER, MASK_FOLDER
from freegeo.export.photos import FOLDER as COPIES_FOLDER

FILES = {
    "report.html": "the page to look at first",
    **{format.path: format.about for format in FORMATS.values() if format is not npz.FORMAT},
    DEPTH_FOLDER: "depth for transforms.json, interpolated to the size of the photos",
    MASK_FOLDER: "masks for transforms.json",
    COPIES_FOLDER: "upright copies of the photos (undistorted ones), or the frames of the video that were used",
    npz.FORMAT.path: npz.FORMAT.about,
    "frozen/prediction.npz": "the same before adaptation",
    "unrefined/prediction.npz": "the same before refinement",
    "predicted/prediction.npz": "as the model predicted it, before known or shared cameras and scale",
    KEPT_NAME: "which pixels the filters kept as points",
    "matches.npz": "matches between the photos",
    TRACKS_NAME: "measured points of the refinement",
    "adapter": "the adapter (peft format)",
    "chunks": "predictions of the chunks; they may be removed when the result is finished",
    "pieces": "parts of the photos that could not be joined to the result",
    "reconstruction.json": "settings, timings, versions, licence of the weights",
}


def contents(folder: Path) -> dict[str, str]:
    """Return file -> what it is for, for an output folder: its depth files say whether they have the photos' size."""
    depth = [format for format in FORMATS.values() if format.holds_depth]
    interpolated = [format for format in depth if depth_files.size_of(folder / format.path) == "photo"]
    return FILES | {format.path: f"{format.about}, interpolated to the size of the photos" for format in interpolated}
