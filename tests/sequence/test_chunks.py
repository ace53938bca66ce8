"""Which frames are predicted together."""

from itertools import pairwise

import pytest

from freegeo.errors import UserError
from freegeo.sequence.chunks import Chunk, common_rows, plan_chunks


@pytest.mark.parametrize(
    ("count", "size", "overlap"), [(300, 16, 8), (17, 16, 8), (100, 7, 3), (5, 2, 1), (64, 16, 15)]
)
def test_chunks_cover_all_frames_and_share_what_they_should(count, size, overlap):
    chunks = plan_chunks(count, size, overlap)
    assert sorted({frame for chunk in chunks for frame in chunk.frames}) == list(range(count))
    assert all(len(chunk.frames) == size for chunk in chunks[:-1])
    assert overlap < len(chunks[-1].frames) <= size
    for one, two in pairwise(chunks):
        assert len(set(one.frames) & set(two.frames)) == overlap


@pytest.mark.parametrize("count", [1, 8, 16])
def test_frames_that_fit_are_one_chunk(count):
    assert plan_chunks(count, 16, 8) == [Chunk(frames=tuple(range(count)))]


@pytest.mark.parametrize(("size", "overlap"), [(1, 1), (8, 8), (8, 0), (8, 9)])
def test_sizes_that_cut_nothing_are_refused(size, overlap):
    with pytest.raises(UserError, match=r"--chunk|--overlap"):
        plan_chunks(100, size, overlap)


def test_common_rows_name_the_same_frame():
    one, two = Chunk(frames=(2, 3, 4, 5)), Chunk(frames=(4, 5, 20, 21), tie="loop")
    assert common_rows(one, two) == [(2, 0), (3, 1)]
    assert common_rows(two, one) == [(0, 2), (1, 3)]


def test_a_chunk_reads_as_its_frames():
    assert str(Chunk(frames=(4, 5, 6, 20, 21), tie="loop")) == "4-6 and 20-21"
