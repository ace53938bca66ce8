"""Pages of sequences: what they say of chunks, seams, loops and pieces, and that they stay small with many views."""

import re
from dataclasses import replace

import numpy as np
import pytest

from example_sequences import CHUNK, OVERLAP, ring, write_sequence
from freegeo.report import page, result, scene3d, sequence
from freegeo.report.figures import trajectory
from freegeo.report.result import even_choice, load_result, thinned

FRAMES, CUT = 120, 4


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    found = write_sequence(tmp_path_factory.mktemp("walk") / "out", FRAMES, cut=CUT)
    for folder in reversed(found):
        page.write_report(folder)
    return found


@pytest.fixture
def pieces(folders):
    return [load_result(folder) for folder in folders]


def test_ranges_of_more_frames_than_there_are_views_are_not_counted(pieces):
    told = dict(pieces[0].summary["sequence"])
    told["pieces"] = [{**piece, "ranges": [(0, 10**15)]} for piece in told["pieces"]]
    assert sequence.frames_of(replace(pieces[0], summary={"sequence": told})) is None


def test_every_view_is_called_by_its_frame(pieces):
    step = CHUNK - OVERLAP
    assert sequence.frames_of(pieces[0]) == list(range((CUT - 1) * step + CHUNK))
    assert sequence.frames_of(pieces[1]) == list(range((CUT - 1) * step + CHUNK, FRAMES))
    for piece in pieces:
        numbers = sequence.view_numbers(piece)
        assert [f"frame_{int(number.removeprefix('frame ')):05d}.jpg" for number in numbers] == list(piece.names)
    assert [sequence.title(piece) for piece in pieces] == ["out", "out, piece 2"]
    assert sequence.piece_folders(pieces[0]) == [pieces[1].folder]
    assert sequence.piece_folders(pieces[1]) == []


def test_an_ordinary_result_says_nothing_of_sequences(tmp_path):
    ring(4, (24, 32)).save(tmp_path)
    plain = load_result(tmp_path)
    assert (sequence.told(plain), sequence.frames_of(plain), sequence.course(plain)) == (None, None, None)
    assert sequence.view_numbers(plain) == ["1", "2", "3", "4"]
    assert 'id="sequence"' not in page.render(plain)


def test_the_page_names_the_seam_that_failed_and_leads_to_the_other_pieces(folders):
    for folder, other, there in zip(folders, reversed(folders), ("frames 0 to 71", "frames 72 to 119"), strict=True):
        text = (folder / "report.html").read_text(encoding="utf-8")
        top = text[: text.index("<main>")]
        assert "This result is in 2 pieces" in top
        assert "Chunks 3 and 4 (frames 48 to 71, and frames 64 to 87) could not be joined: only 12 % of" in top
        assert f"{there}</b>: this page" in top
        (link,) = re.findall('href="([^"]*)"', top)
        assert (folder / link).resolve() == (other / "report.html").resolve()
        assert "120 frames, in the order given, predicted in 7 chunks of up to 24 frames" in text
        assert (
            "1 of 6 seams between neighbours could not be used. 1 of 2 loops (places seen twice) used. 2 pieces."
            in text
        )


def test_a_missing_chunk_and_a_bridge_are_told(tmp_path):
    missing, bridged = (
        load_result(write_sequence(tmp_path / name, **fault)[0])
        for name, fault in (("missing", {"frames": FRAMES, "missing": 3}), ("bridged", {"frames": FRAMES, "unused": 4}))
    )
    told = sequence.told(missing)
    assert told.problems == ["Chunk 3 (frames 48 to 71) is missing: its frames are black."]
    assert [piece.link for piece in told.pieces] == [None, None]
    assert told.pieces[1].name == "piece 2, frames 64 to 119, in pieces/2"
    told = sequence.told(bridged)
    assert (told.problems, told.pieces) == ([], [])
    assert "1 of 6 seams between neighbours could not be used; 1 of them is bridged by others." in told.sentences


def test_a_chunk_whose_frames_surer_ones_have_is_no_problem(tmp_path):
    found = load_result(write_sequence(tmp_path, frames=FRAMES)[0])
    record = found.summary["sequence"]
    record["chunks"][2] |= {"piece": None, "spare": True, "reason": "no matches prove its cameras."}
    record["chunks"][4] |= {"piece": None, "reason": "its prediction has no finite numbers."}
    record["pieces"][0]["together"] = {"accepted": True}
    told = sequence.told(found)
    assert [problem.split(" (")[0] for problem in told.problems] == ["Chunk 4"]
    assert "1 chunk left out: surer ones have these frames." in told.sentences
    assert "All photos refined together, from where the seams put them." in told.sentences


def test_seams_of_loops_and_chunks_without_a_seam_are_told(pieces):
    found = pieces[0]
    content = found.summary["sequence"]
    refused = {**content["seams"][0], "first": 1, "second": 9, "kind": "loop", "used": False, "reason": "It is apart."}
    seams = [refused, *(seam for seam in content["seams"] if seam["second"] != CUT)]
    told = sequence.told(replace(found, summary={"sequence": {**content, "seams": seams}}))
    assert (
        "5 seams between neighbours, all used." in told.sentences
        and "1 seam of loops could not be used." in told.sentences
    )
    assert told.seams.rows[0].cells[0] == "1–9, loop" and not told.seams.rows[0].is_used
    assert told.problems == [
        "Chunks 3 and 4 (frames 48 to 71, and frames 64 to 87) could not be joined: they share no frames."
    ]


def test_what_is_drawn_lies_at_its_frames(pieces):
    first, second = (sequence.course(piece) for piece in pieces)
    for piece, course in zip(pieces, (first, second), strict=True):
        rows = [row for _, part in course.parts for row in part]
        assert sorted(set(rows)) == list(range(len(piece.names)))
        assert all(a[1][-1] == b[1][0] for a, b in zip(course.parts, course.parts[1:], strict=False))
    assert [number for number, _ in second.parts] == [4, 5, 6]
    # Frame 67 is in the middle of the frames 64 to 71 that the chunks share, and in the first piece only.
    assert (67, False, "3–4") in first.seams and (0, False, "3–4") in second.seams
    assert first.loops == [(15, 60, False)] and second.loops == []
    drawing = trajectory(pieces[0], first)
    assert all(colour in drawing for colour in ("var(--chunk0)", "var(--chunk3)", "var(--doubt)", ">3–4<"))


def test_views_of_unknown_frames_keep_their_numbers(folders):
    found = load_result(folders[0])
    content = found.summary["sequence"]
    content = {**content, "pieces": [{**piece, "ranges": piece["ranges"][1:]} for piece in content["pieces"]]}
    odd = replace(found, summary={**found.summary, "sequence": content})
    assert sequence.frames_of(odd) is None
    assert sequence.view_numbers(odd)[0] == "1"
    text = page.render(odd)
    assert 'id="sequence"' in text and "path of the cameras" not in text


def test_long_tables_begin_with_what_is_bad():
    rows = [sequence.Row(cells=(str(k),), is_used=k != 33) for k in range(50)]
    table = sequence._table(("n",), rows, "the fewest inliers", [float(-k) for k in range(50)])
    assert [row.cells[0] for row in table.rows][:3] == ["33", "49", "48"]
    assert len(table.rows) == sequence.MOST_ROWS
    assert [row.cells[0] for row in table.others] == [str(k) for k in range(31) if k != 33][: len(table.others)]
    assert sorted(row.cells for row in table.rows + table.others) == sorted(row.cells for row in rows)
    assert sequence._table(("n",), rows[:20], "", [None] * 20).rows == rows[:20]


# -- many views


@pytest.mark.parametrize("step", [2, 3])
def test_a_thinned_reconstruction_has_points_of_the_whole(step):
    whole = ring(5, (24, 33))
    whole.offset_xy[:] = (4.0, 0.0)
    some = thinned(whole, step)
    rows = slice(step // 2, None, step)
    assert np.array_equal(some.inside(), whole.inside()[:, rows, rows]) and not some.inside().all()
    found, expected = (
        result._stage("frozen", value, value, None, None).world_points() for value in (some, whole)
    )  # fmt: skip
    assert np.allclose(found, expected[:, rows, rows], atol=1e-4)
    assert thinned(whole, 1) is whole


def test_an_even_choice_has_both_ends():
    assert even_choice(5, 48) == [0, 1, 2, 3, 4]
    chosen = even_choice(1000, 48)
    assert (len(chosen), chosen[0], chosen[-1]) == (48, 0, 999)
    assert set(np.diff(chosen)) <= {21, 22}


def test_many_views_are_bounded_and_counted_in_full(tmp_path, monkeypatch):
    monkeypatch.setattr(result, "MOST_PIXELS", 20_000)
    monkeypatch.setattr(scene3d, "MAX_KEPT_OF_MANY", 5_000)
    (folder,) = write_sequence(tmp_path / "out", FRAMES)
    found = load_result(folder)
    assert found.step > 1 and found.final.depth_z.size < 20_000 * 1.5
    text = page.write_report(folder).read_text(encoding="utf-8")
    assert text.count('<div class="view">') == 48
    assert "48 of 120 views, evenly spread." in text
    kept = np.load(folder / "kept.npz")["keep"]
    assert f"{100 * kept.mean():.1f} % of {kept.size:,}" in text
    assert f"kept</th><td>{kept.sum():,}<" in text
    assert text.count('<option value="') == 1 + scene3d.MOST_CAMERAS
    (stage,) = scene3d.scene_data(found)["stages"]
    assert len(stage["cameras"]) == scene3d.MOST_CAMERAS and len(stage["path"]) == FRAMES
    assert "Of 120 cameras, 100 are drawn" in text
    # The pictures have all pixels, whatever the points have.
    first = next(page.views(found))
    assert first["title"] == "frame 0. frame_00000.jpg"
    assert np.array_equal(found.view_depth(found.final, 7), found.full["frozen"].depth_z[7])


def test_many_warnings_do_not_fill_the_page(folders):
    found = load_result(folders[0])
    warnings = [f"Warning {k} <i>." for k in range(40)]
    text = page.render(replace(found, summary={**found.summary, "warnings": warnings}))
    assert f"<summary>{40 - page.MOST_WARNINGS} more</summary>" in text
    assert all(f"Warning {k} &lt;i&gt;." in text for k in range(40))
