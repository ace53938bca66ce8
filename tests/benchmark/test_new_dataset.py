"""A dataset with its own ground truth: one value, one entry of the registry, and every command knows it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench_tools import ROOMS, small_room
from freegeo.benchmark.check import check_dataset
from freegeo.benchmark.predict import Predictor
from freegeo.benchmark.results import read_results
from freegeo.cli.app import main
from freegeo.data.datasets import registry
from freegeo.data.datasets.base import Dataset, DatasetConstants, existing, require_folder
from freegeo.data.procedural.splits import surface_points, write_points
from freegeo.data.scene import Scene, SceneTruth
from freegeo.errors import UserError


def load_toy(root: Path, name: str) -> Scene:
    folder = require_folder(root / name, "a toy scene")
    room = small_room(int(name), "test-id", 16)
    depth = tuple(existing(folder / f"{i}.npy") for i in range(len(room)))
    truth = SceneTruth(
        dataset="toy", surface=folder / "points.ply", depth=depth, mask=(None,) * len(room),
        camera_hw=tuple(photo.size_hw for photo in room.photos),
    )  # fmt: skip
    return replace(room, depth_z=None, truth=truth)


TOY = Dataset(
    name="toy",
    constants=DatasetConstants(
        voxel=0.04, truncation=0.16, depth_limit=20.0, down_sample=0.04, threshold=0.15, truth="points", samples=10_000
    ),
    scene_names=lambda root: list(ROOMS),
    load_scene=load_toy,
    read_depth=lambda path, photo_hw: np.load(path),
)


@pytest.fixture
def data(tmp_path, monkeypatch):
    """The folder of two complete scenes of the registered dataset."""
    monkeypatch.setitem(registry.DATASETS, "toy", TOY)
    for name in ROOMS:
        room = small_room(int(name), "test-id", 16)
        folder = tmp_path / "data" / "toy" / name
        write_points(folder / "points.ply", surface_points(room.depth_z, room.K, room.T_cam_world))
        for i, depth_z in enumerate(room.depth_z):
            np.save(folder / f"{i}.npy", depth_z.numpy())
    return tmp_path / "data"


def test_check_knows_what_is_there_and_where_it_belongs(data, tmp_path, capsys):
    assert check_dataset(data, "toy").complete
    (data / "toy" / ROOMS[0] / "3.npy").unlink()
    (data / "toy" / ROOMS[1] / "points.ply").unlink()
    found = check_dataset(data, "toy").problems
    assert [problem.split(": ")[0] for problem in found] == list(ROOMS)
    assert "1 of 16 frames have no ground-truth depth" in found[0]
    assert main(["bench", "check", str(tmp_path / "nowhere")]) == 1
    said = capsys.readouterr()
    assert f"put its scenes into {tmp_path / 'nowhere' / 'toy'}" in said.out
    assert "toy" in said.err


@pytest.mark.parametrize("name", ["scene", "paper", "released-da3", "released-vggt"])
def test_every_recipe_accepts_it(data, setup, name):
    predictor = Predictor(replace(setup, recipe=name, changes={}))
    recipe = predictor.recipe("toy")
    assert recipe.name == name
    assert recipe == predictor.recipe("procedural-light")
    if name != "scene":
        assert (recipe.sets_per_scene, recipe.distinct_seeds, recipe.epochs, recipe.final_lr) == (4, 4, 3, 1e-6)
        assert recipe.lr == predictor.model.spec.adaptation.scene_lr
        assert recipe != predictor.recipe("eth3d")
    with pytest.raises(UserError, match="no dataset"):
        predictor.recipe("toys")


@pytest.mark.slow
def test_a_run_scores_it_and_says_whose_settings_it_took(data, tiny_model, tmp_path, capsys):
    options = ["--scenes", "1", "--seeds", "43", "--views", "4", "--steps", "1", "--device", "cpu"]
    code = main(
        ["bench", "run", "main", "--data", str(data), "-o", str(tmp_path / "out"), "--datasets", "toy", *options]
    )
    assert code in (0, 1)  # an empty surface of random weights is reported
    assert "recipe 'paper' has no settings for toy; those of generated rooms are used" in capsys.readouterr().err
    found = {(row.variant, row.metric) for row in read_results(tmp_path / "out")}
    assert {(variant, metric) for variant in ("frozen", "adapted") for metric in ("auc30", "abs_rel")} <= found
