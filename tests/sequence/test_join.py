"""Chunks of one piece become one prediction: every frame once, no double surface, bounded memory."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from exact_rooms import room
from freegeo.export.reconstruction import Reconstruction
from freegeo.geometry.sim3 import Sim3
from freegeo.sequence.chunks import Chunk, plan_chunks
from freegeo.sequence.join import Joined, Member, weights

FRAMES, HW = 12, (12, 16)


def similarity(seed: int) -> Sim3:
    generator = torch.Generator().manual_seed(seed)
    R = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
    R = R * torch.linalg.det(R).sign()
    s = torch.rand((), generator=generator, dtype=torch.float64) + 0.5
    return Sim3(s=s, R=R, t=torch.randn(3, generator=generator, dtype=torch.float64))


def part_of(whole: Reconstruction, chunk: Chunk, own: Sim3) -> Reconstruction:
    """The frames of a chunk in a frame of its own."""
    frames = list(chunk.frames)
    T, K = whole.cameras()
    cameras = own.apply_to_cameras(torch.from_numpy(T[frames]).double()).numpy()
    return replace(
        whole, depth_z=(whole.depth_z[frames] * float(own.s)).astype(np.float32), conf=whole.conf[frames],
        images=whole.images[frames], names=tuple(whole.names[i] for i in frames), photo_hw=whole.photo_hw[frames],
        scale_xy=whole.scale_xy[frames], offset_xy=whole.offset_xy[frames], T_cam_world=cameras, K=K[frames],
    )  # fmt: skip


@pytest.fixture(scope="module")
def whole() -> Reconstruction:
    return room(FRAMES, HW)


def members(whole: Reconstruction, size: int, overlap: int) -> list[Member]:
    found = []
    for number, chunk in enumerate(plan_chunks(FRAMES, size, overlap)):
        own = similarity(number)
        part = part_of(whole, chunk, own)
        found.append(Member(chunk=chunk, sim3=own.inverse(), load=lambda part=part: part))
    return found


@pytest.mark.parametrize(("size", "overlap"), [(6, 3), (5, 1), (6, 5)])
def test_exact_chunks_give_the_whole_and_every_frame_once(whole, size, overlap):
    joined = Joined(members(whole, size, overlap), range(FRAMES))
    T, K = whole.cameras()
    np.testing.assert_allclose(np.concatenate(list(joined.blocks("depth_z"))), whole.depth_z, rtol=1e-5)
    np.testing.assert_allclose(joined.T_cam_world, T, atol=1e-5)
    np.testing.assert_allclose(joined.K, K, rtol=1e-6)
    np.testing.assert_array_equal(joined.K[:, 2], np.broadcast_to((0, 0, 1), (FRAMES, 3)))
    np.testing.assert_array_equal(np.concatenate(list(joined.blocks("images"))), whole.images)
    assert len(joined.T_cam_world) == FRAMES


def test_one_chunk_stays_as_it_is_to_the_bit(whole):
    same = Sim3(s=torch.ones(()).double(), R=torch.eye(3).double(), t=torch.zeros(3).double())
    joined = Joined([Member(chunk=Chunk(frames=tuple(range(FRAMES))), sim3=same, load=lambda: whole)], range(FRAMES))
    for name in ("depth_z", "conf", "images"):
        np.testing.assert_array_equal(np.concatenate(list(joined.blocks(name))), getattr(whole, name))


def test_depth_passes_from_one_chunk_to_the_next(whole):
    two = members(whole, 8, 4)
    wrong = replace(two[1].load(), depth_z=two[1].load().depth_z * np.float32(1.05))
    depth = np.concatenate(list(Joined([two[0], replace(two[1], load=lambda: wrong)], range(FRAMES)).blocks("depth_z")))
    ratio = np.median(depth / whole.depth_z, axis=(1, 2))
    np.testing.assert_allclose(ratio[:4], 1, rtol=1e-5)
    np.testing.assert_allclose(ratio[8:], 1.05, rtol=1e-5)
    assert (np.diff(ratio[3:9]) > 0).all()


def test_surfaces_that_differ_are_not_averaged(whole):
    two = members(whole, 8, 4)
    wrong = replace(two[1].load(), depth_z=two[1].load().depth_z * np.float32(2))
    depth = np.concatenate(list(Joined([two[0], replace(two[1], load=lambda: wrong)], range(FRAMES)).blocks("depth_z")))
    ratio = depth / whole.depth_z
    assert (np.isclose(ratio, 1, rtol=1e-4) | np.isclose(ratio, 2, rtol=1e-4)).all()
    assert np.isclose(ratio[4], 1, rtol=1e-4).all()
    assert np.isclose(ratio[7], 2, rtol=1e-4).all()


def test_a_pixel_without_depth_in_one_chunk_takes_the_other_one_s(whole):
    two = members(whole, 8, 4)
    holes = two[1].load().depth_z.copy()
    holes[:, 3] = np.nan
    part = replace(two[1].load(), depth_z=holes)
    depth = np.concatenate(list(Joined([two[0], replace(two[1], load=lambda: part)], range(FRAMES)).blocks("depth_z")))
    np.testing.assert_allclose(depth[:8], whole.depth_z[:8], rtol=1e-5)
    assert np.isnan(depth[8:, 3]).all()


def test_a_chunk_is_read_once_for_each_array(whole):
    reads = []

    def counted(member: Member, number: int) -> Member:
        return replace(member, load=lambda: reads.append(number) or member.load())

    all_members = [counted(member, number) for number, member in enumerate(members(whole, 4, 2))]
    joined = Joined(all_members, range(FRAMES))
    before = len(reads)
    list(joined.blocks("depth_z"))
    assert len(reads) - before == len(all_members)


def test_weights_fall_towards_ends_that_are_joined_to_other_chunks():
    chunk = Chunk(frames=(4, 5, 6, 7))
    assert weights(chunk, 0, 20) == [1, 2, 2, 1]
    assert weights(chunk, 4, 20) == [4, 3, 2, 1]
    assert weights(chunk, 4, 7) == [4, 4, 4, 4]
