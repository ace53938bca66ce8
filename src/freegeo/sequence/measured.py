"""How two refined chunks lie to each other, by points that matches measure in both (docs/sequences.md, "Seams")."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from freegeo.evidence.bundle import points_of
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.matches import Matches, combined
from freegeo.evidence.tracks import join_matches
from freegeo.geometry.se3 import camera_centres
from freegeo.sequence.alignment import Seam, align_points

__all__ = ["measured_seam"]


def measured_seam(
    first: Candidate,
    second: Candidate,
    names: tuple[Sequence[str], Sequence[str]],
    parts: Sequence[Matches],
    *,
    fixed_scale: bool = False,
) -> Seam | None:
    """Find how `second` lies in the frame of `first`; both have cameras that are right, whatever their depth is worth.

    Matches are joined to tracks, and a track that several views of each chunk show is measured twice. The chunks need
    not share a frame: matches of a third chunk may lead from one to the other.

    Args:
        first: the chunk that stays.
        second: the chunk that moves.
        names: of the photos of each.
        parts: matches of both, and of what lies between.
        fixed_scale: as for `align`.

    Returns:
        None where too few points agree.
    """
    every = list(dict.fromkeys((*names[0], *names[1])))
    matches = combined(parts, every)
    tracks = join_matches(matches)
    points, depths = [], []
    for chunk, own in zip((first, second), names, strict=True):
        row_of = {name: row for row, name in enumerate(own)}
        inside = np.array([name in row_of for name in every])
        # What stands in the place of cameras that the chunk does not have is not read.
        cameras = chunk.select([row_of.get(name, 0) for name in every])
        points.append(torch.from_numpy(points_of(cameras, matches, tracks, inside)))
        middle = camera_centres(cameras.T_cam_world[torch.from_numpy(inside)]).mean(0)
        depths.append(torch.linalg.vector_norm(points[-1] - middle, dim=-1))
    both = ~(points[0].isnan() | points[1].isnan()).any(-1)
    return align_points(points[0][both], points[1][both], torch.stack(depths)[:, both], fixed_scale=fixed_scale)
