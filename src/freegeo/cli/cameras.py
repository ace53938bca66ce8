"""`freegeo cameras`: look at known cameras before they are used, and write them in other formats."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from cyclopts import App, Parameter

from freegeo.cli import console
from freegeo.cli.options import PhotoOptions
from freegeo.cli.sources import load_source
from freegeo.data.photos import MAX_VIEWS
from freegeo.errors import UserError

if TYPE_CHECKING:
    from freegeo.cameras.known import KnownCamera, KnownCameras

SHOWN = 5
"""Most different intrinsics that are listed."""
app = App(name="cameras", help="Check known cameras against photos, and convert them.", help_format="plaintext")


@app.command
def check(
    photos: str,
    file: Path,
    *,
    cameras_format: str | None = None,
    cameras_convention: str | None = None,
    max_views: int = MAX_VIEWS,
) -> None:
    """Say what a file of cameras holds and whether it fits the photos; exit code 2 when it does not.

    Parameters
    ----------
    photos
        A folder of photos, a glob in quotes or a video.
    file
        The cameras: a file, or a folder such as a COLMAP project.
    cameras_format
        cameras.json, colmap, nerfstudio, tum, kitti or poses; default: by content.
    cameras_convention
        How pose matrices are meant: w2c-opencv, c2w-opencv, w2c-opengl or c2w-opengl; default: as the format says.
    max_views
        Most photos that are looked at; of more, as many are chosen evenly.
    """
    from freegeo.cameras.convention import READINGS, check_convention, pairs_to_check
    from freegeo.cameras.reading import read_cameras
    from freegeo.cameras.undistortion import undistorted
    from freegeo.evidence.matches import find_matches

    loaded = load_source([photos], PhotoOptions(max_views=max_views))
    known = read_cameras(file, loaded, format=cameras_format, convention=cameras_convention)
    for line in described(known):
        console.say(line)
    seen, pinholes = undistorted(loaded, known)
    if not known.has_pose.any():
        console.say("No pose is known, so that there is nothing to check by matches.")
        return
    found = check_convention(pinholes, find_matches(seen, pairs_to_check(len(seen))))
    rows = [
        [READINGS[reading], _pixels(error), "behind" if found.behind[reading] else ""]
        for reading, error in found.errors.items()
    ]
    console.say(f"\nMedian epipolar error in {found.pairs} pairs of photos ({found.matches} matches):")
    console.say(console.table(["reading", "error", "points"], rows))
    console.say()
    found.require()
    if found.outcome == "accepted":
        console.say(f"accepted: {found.sentence}")


@app.command
def convert(
    file: Path,
    *,
    output: Annotated[Path, Parameter(name=("--output", "-o"))],
    to: str = "cameras.json",
    photos: str | None = None,
    cameras_format: str | None = None,
    cameras_convention: str | None = None,
    metric: bool = False,
    overwrite: bool = False,
) -> None:
    """Write known cameras in another format.

    Parameters
    ----------
    file
        The cameras: a file, or a folder such as a COLMAP project.
    output
        File to write, or for colmap a folder.
    to
        cameras.json, colmap, nerfstudio, tum or kitti.
    photos
        Photos that the cameras are of: only theirs are written, by their names, at their sizes and in their order.
    cameras_format
        Format of FILE: cameras.json, colmap, nerfstudio, tum, kitti or poses; default: by content.
    cameras_convention
        How pose matrices are meant: w2c-opencv, c2w-opencv, w2c-opengl or c2w-opengl; default: as the format says.
    metric
        Lengths are metres, which cameras.json can say.
    overwrite
        Replace an existing file.
    """
    from freegeo.cameras.formats import FORMATS
    from freegeo.cameras.reading import read_camera_file, read_cameras

    writable = [name for name, format in FORMATS.items() if format.write is not None]
    write = FORMATS[to].write if to in writable else None
    if write is None:
        raise UserError(f"--to {to}: cannot be written. Choose one of {', '.join(writable)}.")
    if not overwrite and output.exists() and (output.is_file() or any(output.iterdir())):
        raise UserError(f"{output}: exists already. Add --overwrite to replace it, or choose another name.")
    if photos is None:
        known = read_camera_file(file, format=cameras_format, metric=metric, convention=cameras_convention)
    else:
        loaded = load_source([photos], PhotoOptions(max_views=sys.maxsize))
        known = read_cameras(file, loaded, format=cameras_format, metric=metric, convention=cameras_convention)
    write(known, output)
    console.say(f"{output}: {len(known)} cameras as {to}")


def described(known: KnownCameras) -> list[str]:
    """Return what is known, as lines of text."""
    count, poses, K = len(known), int(known.has_pose.sum()), int(known.has_K.sum())
    lines = [f"{known.source}: poses of {poses} of {count} photos, intrinsics of {K}{', metres' * known.metric}"]
    optics = list(dict.fromkeys(_optics(one) for one in known.cameras if one.K is not None))
    lines += [f"  {text}" for text in optics[:SHOWN]]
    return [*lines, f"  and {len(optics) - SHOWN} other intrinsics"] if len(optics) > SHOWN else lines


def _optics(one: KnownCamera) -> str:
    assert one.K is not None
    size = "" if one.size_hw is None else f"{one.size_hw[1]} x {one.size_hw[0]} pixels, "
    lens = "pinhole" if one.lens is None else f"{one.lens.model} {', '.join(f'{k:.4g}' for k in one.lens.params)}"
    focal, centre = (", ".join(f"{value:.1f}" for value in pair) for pair in (np.diag(one.K)[:2], one.K[:2, 2]))
    return f"{size}focal length {focal}, principal point {centre}, {lens}"


def _pixels(error: float) -> str:
    return "none" if np.isnan(error) else f"{error:.3g} px"
