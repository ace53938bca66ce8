"""Chunks put together: places, pieces, bridges, and what is said of each seam."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from exact_rooms import room
from freegeo.export.reconstruction import Reconstruction
from freegeo.geometry.se3 import camera_centres
from freegeo.geometry.sim3 import Sim3
from freegeo.sequence.alignment import align_points
from freegeo.sequence.assembly import CONTRADICTED, assemble, broken, seams_between
from freegeo.sequence.chunks import Chunk, bridge, plan_chunks
from sequence.test_join import part_of, similarity

FRAMES, HW = 14, (24, 32)


@pytest.fixture(scope="module")
def whole() -> Reconstruction:
    return room(FRAMES, HW)


def noise(part: Reconstruction) -> Reconstruction:
    """The same with depth that fits nothing."""
    factor = np.random.default_rng(0).lognormal(0, 1, part.depth_z.shape)
    return replace(part, depth_z=(part.depth_z * factor).astype(np.float32))


def put_together(whole: Reconstruction, chunks: list[Chunk], *lost: int, **options):
    parts = [part_of(whole, chunk, similarity(number)) for number, chunk in enumerate(chunks)]
    parts = [noise(part) if number in lost else part for number, part in enumerate(parts)]
    return assemble(chunks, seams_between(chunks, parts.__getitem__), parts.__getitem__, **options), parts


def test_chunks_in_frames_of_their_own_come_together(whole):
    chunks = plan_chunks(FRAMES, 6, 2)
    found, parts = put_together(whole, chunks)
    assert found.pieces == [list(range(len(chunks)))]
    assert [joint.kind for joint in found.joints] == ["neighbours"] * (len(chunks) - 1)
    assert all(joint.reason is None and joint.gap is not None and joint.gap < 1e-4 for joint in found.joints)
    first = similarity(0)
    true = first.apply(camera_centres(torch.from_numpy(whole.cameras()[0]).double()))
    for chunk, part, sim3 in zip(chunks, parts, found.sim3, strict=True):
        moved = camera_centres(sim3.apply_to_cameras(torch.from_numpy(part.cameras()[0]).double()))
        torch.testing.assert_close(moved, true[list(chunk.frames)], atol=1e-3, rtol=0)


def test_a_chunk_that_fits_nowhere_leaves_pieces_that_share_no_frame(whole):
    chunks = plan_chunks(FRAMES, 6, 2)
    found, _ = put_together(whole, chunks, 1)
    assert found.pieces == [[0], [1], [2]]
    assert [joint.reason is None for joint in found.joints] == [False, False]
    assert all(joint.gap is None for joint in found.joints)


def test_where_more_frames_are_shared_a_lost_chunk_is_passed_over(whole):
    chunks = plan_chunks(FRAMES, 6, 4)
    found, _ = put_together(whole, chunks, 2)
    assert found.pieces == [[0, 1, 3, 4]]
    assert {(joint.first, joint.second): joint.kind for joint in found.joints}[1, 3] == "bridge"


def test_the_frames_around_a_seam_tie_chunks_together(whole):
    chunks = plan_chunks(FRAMES, 8, 2)
    parts = [part_of(whole, chunk, similarity(number)) for number, chunk in enumerate(chunks)]
    # What the two share is lost in the second one.
    depth = parts[1].depth_z.copy()
    depth[:2] = noise(parts[1]).depth_z[:2]
    parts[1] = replace(parts[1], depth_z=depth)
    seams = seams_between(chunks, parts.__getitem__)
    assert broken(chunks, seams) == [(0, 1)]
    tie = bridge(chunks[0], chunks[1], 8)
    assert tie.frames == tuple(range(3, 11))
    chunks, parts = [*chunks, tie], [*parts, part_of(whole, tie, similarity(9))]
    found = assemble(chunks, seams_between(chunks, parts.__getitem__, known=seams), parts.__getitem__)
    assert found.pieces == [[0, 1]]
    assert [(joint.kind, joint.reason is None) for joint in found.joints] == [
        ("neighbours", False), ("bridge", True), ("bridge", True),
    ]  # fmt: skip


def test_seams_that_are_known_are_not_measured_again(whole):
    chunks = plan_chunks(FRAMES, 6, 2)
    parts = [part_of(whole, chunk, similarity(number)) for number, chunk in enumerate(chunks)]
    seams = seams_between(chunks, parts.__getitem__)
    reads = []
    assert seams_between(chunks, reads.append, known=seams) == seams
    assert reads == []


def test_chunks_without_a_common_frame_are_joined_by_points_that_matches_measure(whole):
    chunks = [Chunk(frames=tuple(range(6))), Chunk(frames=tuple(range(6, FRAMES)))]
    parts = [part_of(whole, chunk, similarity(number)) for number, chunk in enumerate(chunks)]
    assert seams_between(chunks, parts.__getitem__) == {}
    first, second = similarity(0), similarity(1)
    points = torch.from_numpy(np.random.default_rng(0).uniform(-2, 2, (40, 3)))
    seam = align_points(first.apply(points), second.apply(points), torch.ones(2, 40, dtype=torch.float64))
    assert seam is not None
    found = assemble(
        chunks, seams_between(chunks, parts.__getitem__, measured={(0, 1): seam}), parts.__getitem__
    )  # fmt: skip
    assert found.pieces == [[0, 1]]
    assert float((found.sim3[1] @ second @ first.inverse()).log().abs().max()) < 1e-6
    (joint,) = found.joints
    assert joint.gap is None and joint.reason is None and joint.as_dict()["frames"] == 0


def test_chunks_of_known_cameras_are_measured_and_not_moved(whole):
    chunks = plan_chunks(FRAMES, 6, 2)
    parts = [part_of(whole, chunk, similarity(0)) for chunk in chunks]
    parts[1] = replace(parts[1], depth_z=parts[1].depth_z * np.float32(1.02))
    found = assemble(chunks, seams_between(chunks, parts.__getitem__), parts.__getitem__, placed=True)
    assert all(float(sim3.s) == 1 and torch.equal(sim3.R, torch.eye(3).double()) for sim3 in found.sim3)
    # Along the ray, which is longer than the depth.
    assert all(joint.gap is not None and 0.02 <= joint.gap < 0.024 for joint in found.joints)


def test_what_ties_placed_chunks_gives_no_frames(whole):
    chunks = [*plan_chunks(FRAMES, 6, 2), Chunk(frames=(0, 1, 2, 11, 12, 13), tie="loop")]
    found, _ = put_together(whole, chunks, placed=True)
    assert found.pieces == [list(range(len(chunks) - 1))]


def test_a_seam_of_black_frames_is_told_in_numbers_that_json_has(whole):
    black = replace(whole, images=np.zeros_like(whole.images))
    found, _ = put_together(black, plan_chunks(FRAMES, 6, 2))
    said = [joint.as_dict() for joint in found.joints]
    assert json.loads(json.dumps(said, allow_nan=False)) == said and {seam["rms"] for seam in said} == {None}


def test_placed_chunks_whose_surfaces_are_apart_are_doubted(whole):
    chunks = plan_chunks(FRAMES, 6, 2)
    found, _ = put_together(whole, chunks, placed=True)
    told = [joint.as_dict() for joint in found.joints]
    assert all(seam["used"] and "of their depth apart" in seam["reason"] for seam in told)
    parts = [part_of(whole, chunk, Sim3.identity()) for chunk in chunks]
    found = assemble(chunks, seams_between(chunks, parts.__getitem__), parts.__getitem__, placed=True)
    assert all(joint.as_dict()["reason"] is None for joint in found.joints)


def test_loops_that_contradict_each_other_or_the_chain_are_all_left_out(whole):
    chunks = plan_chunks(FRAMES, 4, 2)
    true = Chunk(frames=(0, 1, 12, 13), tie="loop")
    parts = [part_of(whole, chunk, similarity(number)) for number, chunk in enumerate([*chunks, true, true])]
    alone, _ = put_together(whole, [*chunks, true])
    assert all(joint.reason is None for joint in alone.joints)
    # The second one takes its two places for one.
    T = parts[-1].cameras()[0].copy()
    T[2:] = T[2:] @ np.linalg.inv(T[2]) @ T[0]
    parts[-1] = replace(parts[-1], T_cam_world=T)
    both = [*chunks, true, replace(true)]
    found = assemble(both, seams_between(both, parts.__getitem__), parts.__getitem__)
    reasons = {joint.reason for joint in found.joints if joint.kind == "loop"}
    assert reasons == {CONTRADICTED}
    assert all(joint.reason is None for joint in found.joints if joint.kind != "loop")
    assert found.pieces == [list(range(len(chunks)))]


def test_loops_that_contradict_each_other_leave_those_of_another_part_alone(whole):
    """The same walk twice, the second time as other frames."""
    walk, loop = plan_chunks(FRAMES, 8, 2), Chunk(frames=(0, 1, 12, 13), tie="loop")
    again = [replace(chunk, frames=tuple(frame + FRAMES for frame in chunk.frames)) for chunk in (*walk, loop)]
    chunks, shown = [*walk, *again[:-1], loop, replace(loop), again[-1]], [*walk, *walk, loop, loop, loop]
    parts = [part_of(whole, chunk, similarity(number)) for number, chunk in enumerate(shown)]
    T = parts[-2].cameras()[0].copy()
    T[2:] = T[2:] @ np.linalg.inv(T[2]) @ T[0]
    parts[-2] = replace(parts[-2], T_cam_world=T)
    found = assemble(chunks, seams_between(chunks, parts.__getitem__), parts.__getitem__)
    wrong, right = ({len(chunks) - 3, len(chunks) - 2}, {len(chunks) - 1})
    for ties, reason in ((wrong, CONTRADICTED), (right, None)):
        assert {joint.reason for joint in found.joints if ties & {joint.first, joint.second}} == {reason}
    assert [len(frames) for frames in found.frames] == [FRAMES, FRAMES]


def poses_of(whole: Reconstruction, *frames: int, wrong: int | None = None) -> dict[int, np.ndarray]:
    """The true poses of some frames; the wrong one is turned by 20 degrees and moved."""
    T = torch.from_numpy(whole.cameras()[0]).double()
    off = Sim3.exp(torch.tensor([0, 0.35, 0, 0.5, 0, 0, 0], dtype=torch.float64))
    return {k: (off.apply_to_cameras(T[k][None])[0] if k == wrong else T[k]).numpy() for k in frames}


def assert_true(found, parts: list[Reconstruction], chunks: list[Chunk], whole: Reconstruction, numbers) -> None:
    """Chunks are in the frame and scale of the truth."""
    true = camera_centres(torch.from_numpy(whole.cameras()[0]).double())
    for number in numbers:
        T = found.sim3[number].apply_to_cameras(torch.from_numpy(parts[number].cameras()[0]).double())
        torch.testing.assert_close(camera_centres(T), true[list(chunks[number].frames)], atol=1e-3, rtol=0)
        assert float(found.sim3[number].s * similarity(number).s) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("frames", [(0, 13), (2, 3, 9)])
def test_known_poses_of_some_frames_give_frame_and_scale(whole, frames):
    chunks = plan_chunks(FRAMES, 6, 2)
    found, parts = put_together(whole, chunks, poses=poses_of(whole, *frames))
    assert (found.world, found.odd) == (0, [])
    assert_true(found, parts, chunks, whole, range(len(chunks)))


def test_a_wrong_pose_among_known_ones_is_named_and_bends_nothing(whole):
    chunks = plan_chunks(FRAMES, 6, 2)
    found, parts = put_together(whole, chunks, poses=poses_of(whole, 1, 4, 7, 12, wrong=7))
    assert found.odd == [7]
    assert_true(found, parts, chunks, whole, range(len(chunks)))


def test_pieces_with_known_poses_become_one(whole):
    chunks = plan_chunks(FRAMES, 6, 2)
    found, parts = put_together(whole, chunks, 1, poses=poses_of(whole, 0, 1, 11, 13))
    assert (found.world, found.odd, found.pieces) == (0, [], [[0, 2], [1]])
    assert_true(found, parts, chunks, whole, (0, 2))
    found, _ = put_together(whole, chunks, 1, poses=poses_of(whole, 0, 1, 13))
    assert (found.world, found.pieces) == (0, [[0], [1], [2]])


@pytest.mark.slow
def test_known_poses_take_drift_away(whole):
    """Every seam turns the next chunk by .1 radians too far and makes it a tenth too large."""
    chunks = plan_chunks(FRAMES, 6, 2)
    parts = [part_of(whole, chunk, similarity(number)) for number, chunk in enumerate(chunks)]
    seams = {
        pair: replace(seam, sim3=seam.sim3 @ Sim3.exp(torch.tensor([0, 0.1, 0, 0, 0, 0, 0.1], dtype=torch.float64)))
        for pair, seam in seams_between(chunks, parts.__getitem__).items()
    }
    true = camera_centres(torch.from_numpy(whole.cameras()[0]).double())

    def error(*frames: int) -> float:
        found = assemble(chunks, seams, parts.__getitem__, poses=poses_of(whole, *frames))
        placed = [
            camera_centres(sim3.apply_to_cameras(torch.from_numpy(part.cameras()[0]).double())) - true[list(c.frames)]
            for c, part, sim3 in zip(chunks, parts, found.sim3, strict=True)
        ]
        return float(torch.cat(placed).norm(dim=-1).max())

    assert error(0, 1, 6, 7, 12, 13) < 0.3 * error(0, 1)
