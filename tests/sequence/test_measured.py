"""Seams by points that matches measure in two chunks."""

from dataclasses import replace
from functools import cache

import numpy as np

from evidence_tools import matched
from exact_rooms import room
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.matches import Matches
from freegeo.export.reconstruction import Reconstruction
from freegeo.sequence.alignment import Seam
from freegeo.sequence.chunks import Chunk
from freegeo.sequence.measured import measured_seam
from sequence.test_join import part_of, similarity

VIEWS = 8


def only(matches: Matches, *views: int) -> Matches:
    """The matches between some of the photos."""
    return matches.only(np.flatnonzero(np.isin(matches.pairs, views).all(axis=1)))


@cache
def whole() -> Reconstruction:
    return room(views=VIEWS, hw=(72, 96), seed=1)


def seam_of(matches: list[Matches], *frames: tuple[int, ...]) -> Seam | None:
    """The seam of two chunks of the room, each in a frame and unit of its own, with depth that says nothing."""
    found = [part_of(whole(), Chunk(frames=own), similarity(k)) for k, own in enumerate(frames)]
    found = [replace(one, depth_z=np.ones_like(one.depth_z)) for one in found]
    one, two = (Candidate.of(chunk) for chunk in found)
    return measured_seam(one, two, (found[0].names, found[1].names), matches)


def off(sim3) -> float:
    return float((sim3 @ similarity(1) @ similarity(0).inverse()).log().abs().max())


def test_chunks_that_share_frames_and_whose_depth_is_wrong():
    matches = matched(whole(), noise_px=0.0)
    seam = seam_of([only(matches, 0, 1, 2, 3), only(matches, 2, 3, 4, 5)], (0, 1, 2, 3), (2, 3, 4, 5))
    assert seam is not None and seam.by_matches
    assert off(seam.sim3) < 1e-3


def test_a_third_chunk_leads_from_one_to_the_other():
    matches = matched(whole(), noise_px=0.0)
    own = [only(matches, 0, 1, 2, 3), only(matches, 4, 5, 6, 7)]
    assert seam_of(own, (0, 1, 2, 3), (4, 5, 6, 7)) is None
    seam = seam_of([*own, only(matches, 2, 3, 4, 5)], (0, 1, 2, 3), (4, 5, 6, 7))
    assert seam is not None
    assert off(seam.sim3) < 1e-3
