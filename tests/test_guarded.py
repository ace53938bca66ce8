"""An adapter judged scene by scene: from disk as from memory, with depth maps of one scene at a time."""

import json
import weakref
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from evidence_tools import VIEWS, exact_matches, turned
from exact_rooms import room
from freegeo import guarded
from freegeo.adaptation.adapt import adapt
from freegeo.evidence import guard
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.guard import State
from freegeo.export.reconstruction import Reconstruction
from freegeo.guarded import Evidence, judge_adapter
from tiny_models import noise_scene, quick, tiny_da3

WRONG = 2.0
"""Degrees by which the frozen model's cameras are turned."""
SCENES = 3


def turned_room(degrees: float, number: int = 0) -> Reconstruction:
    """The prediction of a scene, in arrays of its own."""
    found = room(views=VIEWS, hw=(72, 96), seed=5)
    T = turned(Candidate.of(found).T_cam_world, degrees, number)
    return replace(found, T_cam_world=T.numpy(), depth_z=found.depth_z.copy())


@pytest.fixture
def matches():
    return exact_matches(Candidate.of(room(views=VIEWS, hw=(72, 96), seed=5)), noise_px=0.2)


@pytest.fixture
def adapted(monkeypatch):
    """A finished adapter, of which three states are tried."""
    tried = [State(steps=1.0, strength=1.0), State(steps=1.0, strength=0.5), State(steps=0.5, strength=1.0)]
    monkeypatch.setattr(guard, "states", lambda: tried)
    model = tiny_da3()
    return adapt(model, [noise_scene(9)], quick(model, steps=2), seed=42, keep_after=(0.5,))


class Predictor:
    """Stands for the model with the adapter: full strength brings the cameras right, less of it a part of the way."""

    def __init__(self, adapter, broken: dict[int, Any] | None = None):
        self.adapter, self.broken = adapter, broken or {}
        self.asked: list[int] = []

    def __call__(self, batch: Any, priors: Any) -> Reconstruction | None:
        self.asked.append(batch)
        found = turned_room(WRONG * (1 - self.adapter.strength), batch)
        return self.broken.get(batch, lambda found: found)(found)


def evidence(number: int, matches, frozen=None, **more) -> Evidence:
    """A scene; the images of this stand-in are its number."""
    return Evidence(
        photos=(), batch=lambda: cast(Any, number), frozen=frozen or (lambda: turned_room(WRONG, number)),
        matches=matches, name=f"scene {number}", **more,
    )  # fmt: skip


@pytest.mark.parametrize("count", [1, SCENES])
def test_predictions_from_disk_give_the_verdict_of_predictions_in_memory_to_the_bit(adapted, matches, tmp_path, count):
    frozen = [turned_room(WRONG, number) for number in range(count)]
    for number, one in enumerate(frozen):
        one.save(tmp_path / str(number))
    in_memory = [Evidence.in_memory((), cast(Any, number), one, matches=matches) for number, one in enumerate(frozen)]
    stored = [
        evidence(number, matches, frozen=lambda number=number: Reconstruction.load(tmp_path / str(number)))
        for number in range(count)
    ]
    predict = Predictor(adapted.adapter)
    one, two = (judge_adapter(adapted, scenes, predict, device="cpu", select=False) for scenes in (in_memory, stored))
    assert one.outcome == "adapted"
    assert json.dumps(one.as_dict()) == json.dumps(two.as_dict())
    assert one.reason == two.reason
    half = len(predict.asked) // 2
    assert predict.asked[:half] == predict.asked[half:] == [n for n in range(count) for _ in range(3)]


def test_depth_maps_of_one_scene_are_in_memory_at_a_time(adapted, matches):
    made: list[tuple[int, weakref.ref[np.ndarray]]] = []
    together: list[set[int]] = []

    def counted(number: int, found: Reconstruction) -> Reconstruction:
        made.append((number, weakref.ref(found.depth_z)))
        together.append({scene for scene, depth in made if depth() is not None})
        return found

    predict = Predictor(adapted.adapter, {n: lambda found, n=n: counted(n, found) for n in range(SCENES)})
    scenes = [
        evidence(number, matches, frozen=lambda number=number: counted(number, turned_room(WRONG, number)))
        for number in range(SCENES)
    ]
    judge_adapter(adapted, scenes, predict, device="cpu", select=True)
    assert len(made) == SCENES * (3 + 3), "each frozen prediction three times, and three states"
    assert {len(scenes) for scenes in together} == {1}


def collapsed(found: Reconstruction) -> Reconstruction:
    assert found.T_cam_world is not None
    return replace(found, T_cam_world=np.tile(found.T_cam_world[:1], (VIEWS, 1, 1)))


@pytest.mark.parametrize(
    ("broken", "words"),
    [(collapsed, "scene 1: with the adapter the cameras collapse"), (lambda found: None, "no finite numbers")],
)
def test_an_adapter_that_ruins_one_of_several_scenes_is_not_used(adapted, matches, broken, words):
    predict = Predictor(adapted.adapter, {1: broken})
    scenes = [evidence(number, matches) for number in range(SCENES)]
    found = judge_adapter(adapted, scenes, predict, device="cpu", select=True)
    assert found.outcome == "frozen"
    assert found.reason.startswith("Adaptation cannot be used: ") and words in found.reason
    assert adapted.adapter.strength == 0


def test_matches_are_made_once_for_each_scene(adapted, matches, monkeypatch):
    made = []

    def found(photos, prediction, store, *, device):
        made.append(store)
        return matches

    monkeypatch.setattr(guarded, "scene_matches", found)
    scenes = [replace(evidence(number, None), store=number) for number in range(SCENES)]
    judge_adapter(adapted, scenes, Predictor(adapted.adapter), device="cpu", select=True)
    assert made == list(range(SCENES))
