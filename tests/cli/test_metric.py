"""Models without cameras, metric models, and cameras from rays, from photos to files."""

import json

import numpy as np
import pytest

from cli.conftest import QUICK
from freegeo.export.reconstruction import Reconstruction
from freegeo.models import da3_config
from freegeo.models.checkpoints import save_weights
from freegeo.models.da3_config import NESTED_KEYS, SINGLE_VIEW_KEYS
from freegeo.models.spec import ModelEntry
from tiny_models import tiny_nested, tiny_single_view

OPTIONS = [*QUICK, "--refine", "off"]


@pytest.fixture(scope="module")
def entries(tmp_path_factory) -> tuple[ModelEntry, ...]:
    folder, found = tmp_path_factory.mktemp("metric"), []
    for name, build, keys in (
        ("tiny-single-view", tiny_single_view, SINGLE_VIEW_KEYS), ("tiny-nested", tiny_nested, NESTED_KEYS),
    ):  # fmt: skip
        path = folder / f"{name}.safetensors"
        save_weights(build(), path, keys, {})
        found.append(
            ModelEntry(name=name, about="", licence="none", parameters=0, build=build, keys=keys, packaged_weights=path)
        )
    return tuple(found)


@pytest.fixture(autouse=True)
def known(entries, monkeypatch):
    monkeypatch.setattr(da3_config, "ENTRIES", (*da3_config.ENTRIES, *entries))


def summary(folder) -> dict:
    return json.loads((folder / "reconstruction.json").read_text())


def test_a_model_without_cameras_gives_depth(freegeo, photo_folder, tmp_path):
    out = tmp_path / "out"
    outcome = freegeo("reconstruct", photo_folder, "-o", out, "--model", "tiny-single-view")
    assert outcome.code == 0, outcome.err
    assert {p.name for p in (out / "depth").iterdir()} == {"depth.json", *(f"{k}.png" for k in range(4))}
    assert not (out / "points.ply").exists()
    found = Reconstruction.load(out)
    assert not found.has_cameras and found.sky is not None
    assert summary(out)["pose_from"] is None and summary(out)["scale"] is None
    assert "predicts no cameras" in (out / "report.html").read_text()
    assert "already finished" in freegeo("reconstruct", photo_folder, "-o", out, "--model", "tiny-single-view").out


@pytest.mark.parametrize(
    ("command", "options", "reason"),
    [
        ("run", [], "has no cross-view layers, which adaptation works on"),
        ("adapt", [], "has no cross-view layers, which adaptation works on"),
        ("reconstruct", ["--formats", "ply"], "has no cameras"),
        ("reconstruct", ["--pose-from", "rays"], "finds no cameras from rays"),
        ("reconstruct", ["--refine", "ba"], "predicts no cameras, so there are none to refine"),
    ],
)
def test_what_needs_cameras_or_several_views_is_refused_before_anything_is_written(
    freegeo, photo_folder, tmp_path, command, options, reason
):
    outcome = freegeo(command, photo_folder, "-o", tmp_path / "out", "--model", "tiny-single-view", *options)
    assert outcome.code == 2
    assert reason in outcome.sentence()
    assert not (tmp_path / "out").exists()


def test_scores_of_cameras_are_refused(freegeo, tmp_path):
    for command in (["models", "score"], ["bench", "run", "main", "--quick", "--frames", "da3", "--model"]):
        outcome = freegeo(*command, "tiny-single-view", "-o", tmp_path / "out")
        assert outcome.code == 2
        assert "tiny-single-view predicts no cameras" in outcome.sentence()


@pytest.mark.slow
def test_a_metric_model_gives_metres_frozen_and_adapted(freegeo, photo_folder, tmp_path):
    out = tmp_path / "out"
    outcome = freegeo("run", photo_folder, "-o", out, "--model", "tiny-nested", *OPTIONS, "--lr", "1e-6")
    assert outcome.code == 0, outcome.err
    assert "lengths are metres (from a metric model)" in outcome.out
    told, scale = summary(out)["scale"], Reconstruction.load(out).scale
    assert told == {"value": scale.value, "source": "a metric model", "spread": scale.spread}
    assert Reconstruction.load(out / "frozen").scale is not None
    assert "<dd>metres (from a metric model)</dd>" in (out / "report.html").read_text()
    about = json.loads((out / "adapter" / "freegeo.json").read_text())
    assert about["base"]["model"] == "tiny-nested" and about["base"]["fingerprint"]
    again = tmp_path / "again"
    assert freegeo("reconstruct", photo_folder, "-o", again, "--adapter", out / "adapter").code == 0
    np.testing.assert_array_equal(Reconstruction.load(again).depth_z, Reconstruction.load(out).depth_z)
    merged = tmp_path / "merged.safetensors"
    assert freegeo("adapter", "merge", out / "adapter", "-o", merged).code == 0
    assert "fits tiny-nested" in freegeo("models", "check", "tiny-nested", merged).out


@pytest.mark.slow
def test_cameras_of_rays_are_a_setting_of_the_folder(freegeo, photo_folder, tiny, tmp_path):
    by_rays, by_head = tmp_path / "rays", tmp_path / "head"
    assert freegeo("run", photo_folder, "-o", by_rays, *tiny, *OPTIONS, "--pose-from", "rays").code == 0
    assert freegeo("reconstruct", photo_folder, "-o", by_head, *tiny).code == 0
    head, frozen, adapted = (Reconstruction.load(folder) for folder in (by_head, by_rays / "frozen", by_rays))
    np.testing.assert_array_equal(frozen.depth_z, head.depth_z)
    # The camera head puts every principal point in the middle.
    assert (head.K[:, :2, 2] == (48, 36)).all()
    assert (frozen.K[:, :2, 2] != (48, 36)).all() and (adapted.K[:, :2, 2] != (48, 36)).all()
    assert not np.array_equal(frozen.T_cam_world, head.T_cam_world)
    assert (summary(by_rays)["pose_from"], summary(by_head)["pose_from"]) == ("rays", "camera")
    outcome = freegeo("run", photo_folder, "-o", tmp_path / "b", *tiny, "--recipe", "evidence", "--pose-from", "rays")
    assert outcome.code == 2 and "teaches the camera head, which --pose-from rays does not read" in outcome.sentence()
    outcome = freegeo("run", photo_folder, "-o", by_rays, *tiny, *OPTIONS)
    assert outcome.code == 2
    assert '--pose-from: "rays" there, none now' in outcome.sentence()
