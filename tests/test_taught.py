"""Recipe `evidence`: what photos teach, what is left to judge, and what happens where they prove nothing."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import freegeo
from evidence_tools import VIEWS, exact_matches, truth, turned, without_matches
from freegeo import pipeline, taught
from freegeo.adaptation.recipe import evidence, scene
from freegeo.data.procedural import photograph_room
from freegeo.errors import NoEvidenceError, UserError
from freegeo.evidence.matches import Outcome
from freegeo.export.reconstruction import Reconstruction
from freegeo.metrics.pose import pair_errors
from freegeo.taught import lesson, split_pairs
from tiny_models import tiny_da3


@pytest.fixture(scope="module")
def room():
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    return photograph_room(30_300_000, "val-tex", frames=8)


def predicted(room, degrees: float = 2.0) -> Reconstruction:
    """True depth, and cameras that are turned."""
    count, height, width = room.depth_z.shape
    return Reconstruction(
        depth_z=room.depth_z.numpy(), conf=np.ones((count, height, width), np.float32),
        images=np.stack([photo.read() for photo in room.photos]), names=tuple(photo.name for photo in room.photos),
        photo_hw=np.array([photo.size_hw for photo in room.photos]), scale_xy=np.ones((count, 2)),
        offset_xy=np.zeros((count, 2)), T_cam_world=turned(room.T_cam_world.double(), degrees).float().numpy(),
        K=room.K.numpy(),
    )  # fmt: skip


def test_a_pair_teaches_or_judges_and_keeps_its_matches():
    matches = exact_matches(truth())
    for seed in (0, 1):
        teaching, judging = split_pairs(matches, seed)
        whole = {tuple(pair): matches.of_pair(row) for row, pair in enumerate(matches.pairs.tolist())}
        parts = [
            (tuple(pair), one.of_pair(row))
            for one in (teaching, judging)
            for row, pair in enumerate(one.pairs.tolist())
        ]
        assert sorted(pair for pair, _ in parts) == sorted(whole)
        assert all(np.array_equal(a, b) for pair, found in parts for a, b in zip(found, whole[pair], strict=True))
        assert len(judging.pairs) == round(len(whole) / 3)
    assert not np.array_equal(split_pairs(matches, 0)[1].pairs, split_pairs(matches, 1)[1].pairs)
    assert [len(one.pairs) for one in split_pairs(without_matches(matches), 0)] == [0, 0]


@pytest.mark.slow
def test_what_photos_teach_is_nearer_to_the_truth_than_the_prediction(room):
    frozen = predicted(room)
    found = lesson("room", room.photos, frozen, seed=44)
    known = found.targets.known
    errors = [
        pair_errors(T[known].double(), room.T_cam_world[known].double()).worst_deg.median()
        for T in (found.targets.T_cam_world, torch.from_numpy(frozen.T_cam_world))
    ]
    assert errors[0] < 0.2 * errors[1]
    nearest, farthest = room.depth_z.quantile(torch.tensor([0.05, 0.95]))
    assert nearest < found.targets.distance < farthest
    again = lesson("room", room.photos, frozen, seed=44)
    assert again.targets.digest() == found.targets.digest()
    assert lesson("room", room.photos, frozen, seed=45).targets.digest() != found.targets.digest()


def test_photos_that_prove_nothing_end_in_a_sentence(monkeypatch):
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    from exact_rooms import room

    nothing = without_matches(exact_matches(truth()), Outcome.FEW_KEYPOINTS)
    monkeypatch.setattr(taught, "scene_matches", lambda *arguments, **options: nothing)
    with pytest.raises(NoEvidenceError, match=r"the photos of kitchen prove no cameras to learn from\. None of the"):
        lesson("kitchen", (), room(views=VIEWS, hw=(72, 96), seed=5), seed=43)


def test_adapt_learns_from_some_pairs_and_is_judged_by_the_others(room, monkeypatch):
    lessons, judging = [], []

    def kept(*arguments, **options):
        lessons.append(lesson(*arguments, **options))
        return lessons[-1]

    def judged(result, scenes, predict, **options):
        judging.extend(one.matches for one in scenes)
        return SimpleNamespace(reason="Because.", as_dict=dict)

    monkeypatch.setattr(pipeline, "lesson", kept)
    monkeypatch.setattr(pipeline, "judge_adapter", judged)
    monkeypatch.setattr(pipeline, "predict", lambda *arguments, **options: predicted(room))
    result = freegeo.adapt(tiny_da3(), room.photos, recipe="evidence", steps=2, sets=2, lr=1e-4)
    assert {"cameras", "cameras_all"} <= set(result.curve[0])
    assert len(lessons) == 1
    assert judging == [lessons[0].judging]


def test_without_pycolmap_nothing_is_read_or_computed(monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(UserError, match=r"pip install 'freegeo\[colmap\]'"):
        freegeo.adapt(tiny_da3(), "no such folder", recipe="evidence")


def test_the_recipe_is_that_of_a_scene_with_cameras_to_learn():
    spec = tiny_da3().spec
    plain, ours = scene(spec), evidence(spec)
    assert plain.cameras == 0
    assert ours.cameras > 0
    assert (plain.features, ours.features, ours.hold) == (1, 0, 1)
    assert replace(ours, name="scene", cameras=0.0, features=1.0, hold=plain.hold) == plain
