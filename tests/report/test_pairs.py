"""Pictures of matches: points lie on the lines that the cameras give, as far off as the scores say."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from evidence_tools import VIEWS, exact_matches, turned
from exact_rooms import room
from example_results import write_example
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.scores import epipolar
from freegeo.export.reconstruction import Reconstruction
from freegeo.report.page import write_report
from freegeo.report.pairs import DRAWN, pair_pictures, spread


@pytest.fixture(scope="module")
def scene() -> Reconstruction:
    return room(views=VIEWS, hw=(72, 96), seed=5)


@pytest.fixture(scope="module")
def matches(scene):
    return replace(exact_matches(Candidate.of(scene)), names=scene.names)


class Picture:
    """A photo of the room, at its own size."""

    def __init__(self, scene, view):
        self.name, self.size_hw = scene.names[view], tuple(scene.photo_hw[view].tolist())

    def read(self):
        return np.zeros((*self.size_hw, 3), np.uint8)


def from_line(mark) -> float:
    (u, v), (a, b) = mark.point, np.array(mark.line)
    along = (b - a) / np.linalg.norm(b - a)
    return abs(along[0] * (v - a[1]) - along[1] * (u - a[0]))


@pytest.mark.parametrize("with_photos", [False, True])
def test_exact_matches_lie_on_the_lines_of_true_cameras(scene, matches, tmp_path, with_photos):
    matches.save(tmp_path / "matches.npz")
    photos = [Picture(scene, view) for view in range(VIEWS)] if with_photos else None
    found = pair_pictures(tmp_path, scene, photos)
    assert [one.what for one in found] == ["best", "worst"]
    for one in found:
        first, second = one.sides
        assert len(first.marks) == len(second.marks) == len(one.distances_px) == DRAWN
        assert max(one.distances_px) < 0.05
        assert all(from_line(mark) < 0.05 for mark in second.marks)
        assert [mark.colour for mark in first.marks] == [mark.colour for mark in second.marks]
        assert not any(mark.line for mark in first.marks)


def test_distances_are_those_of_the_wrong_cameras(scene, matches, tmp_path):
    matches.save(tmp_path / "matches.npz")
    wrong = replace(scene, T_cam_world=turned(torch.from_numpy(scene.T_cam_world).double(), 3).float().numpy())
    best, worst = pair_pictures(tmp_path, wrong, None)
    scores = epipolar(Candidate.of(wrong), matches).values
    assert (best.median_px, worst.median_px) == (scores.min(), scores.max())
    factor = scene.scale_xy[0, 0]  # from photo pixels, which are matched here, to the model's
    for mark, distance in zip(worst.sides[1].marks, worst.distances_px, strict=True):
        if mark.line is not None:
            assert from_line(mark) / factor == pytest.approx(distance, rel=1e-6)


def test_nothing_is_drawn_without_matches_lines_or_for_other_photos(scene, matches, tmp_path):
    assert pair_pictures(tmp_path, scene, None) == []
    matches.save(tmp_path / "matches.npz")
    assert pair_pictures(tmp_path, replace(scene, names=tuple(f"other {k}" for k in range(VIEWS))), None) == []
    together = replace(scene, T_cam_world=np.tile(np.eye(4, dtype=np.float32), (VIEWS, 1, 1)))
    assert pair_pictures(tmp_path, together, None) == []


def test_places_are_spread():
    grid = np.stack(np.meshgrid(np.arange(10.0), np.arange(10.0)), -1).reshape(-1, 2)
    rows = spread(np.concatenate((grid / 100, grid)), 5)
    places = np.concatenate((grid / 100, grid))[rows]
    assert len({tuple(place) for place in places}) == 5
    assert {(0.0, 0.0), (9.0, 0.0), (0.0, 9.0), (9.0, 9.0)} <= {tuple(np.rint(place)) for place in places}
    assert sorted(spread(grid[:3], 12)) == [0, 1, 2]


def test_the_page_shows_the_pairs(tmp_path):
    folder = write_example(tmp_path, views=VIEWS)
    result = Reconstruction.load(folder)
    replace(exact_matches(Candidate.of(result)), names=result.names).save(folder / "matches.npz")
    text = write_report(folder).read_text(encoding="utf-8")
    assert text.count('<figure class="pair">') == 2
    assert "Best pair:" in text and "Worst pair:" in text and "px from their lines (1 to 12)" in text
