"""`refine`: a result whose cameras fit the photos better, or a sentence and nothing."""

import json
import shutil
import sys

import numpy as np
import pytest

from cli.conftest import QUICK
from evidence_tools import turned
from freegeo.data.procedural import photograph_room
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.matches import load_matches
from freegeo.evidence.scores import epipolar
from freegeo.export.photos import photo_records
from freegeo.export.reconstruction import Reconstruction
from freegeo.files import write_json
from freegeo.lock import locked
from freegeo.report.result import load_result

VIEWS = 8


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """The folder of a result with true depth and cameras that are turned by 2 degrees."""
    import torch
    from PIL import Image

    from freegeo.data.photos import load_photos

    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    folder = tmp_path_factory.mktemp("refine")
    scene = photograph_room(30_300_000, "val-tex", frames=VIEWS)
    (folder / "photos").mkdir()
    for photo in scene.photos:
        Image.fromarray(photo.read()).save(folder / "photos" / photo.name)
    photos = load_photos(folder / "photos")
    height, width = photos[0].size_hw
    found = Reconstruction(
        depth_z=scene.depth_z.numpy(), conf=np.ones((VIEWS, height, width), np.float32),
        images=np.stack([photo.read() for photo in photos]), names=tuple(photo.name for photo in photos),
        photo_hw=np.array([photo.size_hw for photo in photos]), scale_xy=np.ones((VIEWS, 2)),
        offset_xy=np.zeros((VIEWS, 2)), T_cam_world=turned(scene.T_cam_world.double(), 2).float().numpy(),
        K=scene.K.numpy(),
    )  # fmt: skip
    assert isinstance(scene.T_cam_world, torch.Tensor)
    found.save(folder / "out")
    records = {"format": 1, "images": list(found.names), "photo_files": photo_records(photos), "warnings": ["Old."]}
    write_json(folder / "out" / "reconstruction.json", records)
    return folder


@pytest.mark.slow
def test_refined_cameras_fit_the_photos(freegeo, result, tmp_path):
    out = tmp_path / "refined"
    outcome = freegeo("refine", result / "out", "-o", out, "--formats", "ply")
    assert outcome.code == 0, outcome.err
    matches = load_matches(out / "matches.npz")
    assert matches is not None
    before, after = (
        epipolar(Candidate.of(Reconstruction.load(folder)), matches).mean for folder in (result / "out", out)
    )
    assert after < 0.2 * before
    assert {"points.ply", "report.html", "kept.npz"} <= {path.name for path in out.iterdir()}
    summary = json.loads((out / "reconstruction.json").read_text())
    assert summary["refinement"]["probability"] >= 0.9
    assert summary["warnings"][0] == "Old."
    assert "already finished" in freegeo("refine", result / "out", "-o", out, "--formats", "ply").out


def test_photos_that_cannot_judge_leave_nothing(freegeo, photo_folder, tiny, tmp_path):
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    assert freegeo("reconstruct", photo_folder, "-o", tmp_path / "out", *tiny, "--formats", "npz").code == 0
    outcome = freegeo("refine", tmp_path / "out", "-o", tmp_path / "refined")
    assert outcome.code == 1
    assert "not refined, nothing is written" in outcome.sentence()
    assert not (tmp_path / "refined" / "prediction.npz").exists()


def test_photos_that_are_gone_are_missed(freegeo, result, tmp_path):
    shutil.copytree(result / "out", tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "reconstruction.json").read_text())
    for record in summary["photo_files"]:
        record["file"] = str(tmp_path / "nowhere")
    write_json(tmp_path / "out" / "reconstruction.json", summary)
    outcome = freegeo("refine", tmp_path / "out", "-o", tmp_path / "refined")
    assert outcome.code == 2
    assert "its photos are not where they were" in outcome.sentence()
    assert not (tmp_path / "refined").exists()


def test_a_result_is_not_refined_into_itself_nor_while_it_is_written(freegeo, photo_folder, tiny, tmp_path):
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    out = tmp_path / "out"
    assert freegeo("reconstruct", photo_folder, "-o", out, *tiny, "--formats", "npz").code == 0
    before = sorted(path.name for path in out.iterdir())
    outcome = freegeo("refine", out, "-o", out, "--overwrite")
    assert outcome.code == 2
    assert "holds the result that is to be refined" in outcome.sentence()
    with locked(out):
        outcome = freegeo("refine", out, "-o", tmp_path / "refined")
    assert outcome.code == 2
    assert "another freegeo process is writing here" in outcome.sentence()
    assert sorted(path.name for path in out.iterdir()) == before
    assert not (tmp_path / "refined").exists()


# -- as a part of `run` and `reconstruct`


def cameras(folder):
    return Reconstruction.load(folder).cameras()[0]


@pytest.mark.slow
def test_a_refined_reconstruction_is_the_result_and_can_be_taken_back(freegeo, result, tiny, tmp_path, monkeypatch):
    out = tmp_path / "out"
    command = ("reconstruct", result / "photos", "-o", out, *tiny, "--formats", "ply", "colmap", "--refine")
    outcome = freegeo(*command, "ba")
    assert outcome.code == 0, outcome.err
    summary = json.loads((out / "reconstruction.json").read_text())
    told = summary["refinement"]
    assert told["accepted"] and told["probability"] >= 0.9 and told["after"]["matches"] > 100
    assert told["after"]["epipolar_px"] < 0.2 * told["before"]["epipolar_px"]
    assert told["reason"] in outcome.out
    assert "refinement" in summary["seconds"]
    refined, before = cameras(out), cameras(out / "unrefined")
    assert not np.allclose(refined, before, atol=1e-3)
    assert "Observations are measured matches" in (out / "colmap/README.txt").read_text()
    assert {"tracks.npz", "matches.npz", "kept.npz"} <= {path.name for path in out.iterdir()}
    assert "already finished" in freegeo(*command, "ba").out
    assert freegeo("export", out, "-f", "colmap", "-o", tmp_path / "copy").code == 0
    assert "Observations are measured matches" in (tmp_path / "copy/colmap/README.txt").read_text()
    assert "refined already" in freegeo("refine", out, "-o", tmp_path / "twice").sentence()

    # Neither the network nor the matcher is asked again.
    monkeypatch.setattr("freegeo.evidence.matches._matched", None)
    with monkeypatch.context() as patch:
        patch.setattr("freegeo.models.catalog.load_model", None)
        assert freegeo(*command, "off").code == 0
    assert np.array_equal(cameras(out), before)
    assert "Observations are re-projections" in (out / "colmap/README.txt").read_text()
    assert not (out / "tracks.npz").exists() and not (out / "unrefined").exists()
    assert json.loads((out / "reconstruction.json").read_text())["refinement"] is None
    assert freegeo(*command, "ba").code == 0
    assert np.array_equal(cameras(out), refined)


def test_a_refused_refinement_leaves_the_result_and_says_why(freegeo, photo_folder, tiny, tmp_path):
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    command = ("reconstruct", photo_folder, "-o", tmp_path / "out", *tiny, "--formats", "npz")
    assert freegeo(*command).code == 0
    before = cameras(tmp_path / "out")
    outcome = freegeo(*command, "--refine", "ba")
    assert outcome.code == 0, outcome.err
    assert np.array_equal(cameras(tmp_path / "out"), before)
    told = json.loads((tmp_path / "out/reconstruction.json").read_text())["refinement"]
    assert not told["accepted"]
    for text in (outcome.out, outcome.err):
        assert told["reason"] in text
    assert not (tmp_path / "out/unrefined").exists() and not (tmp_path / "out/tracks.npz").exists()


@pytest.mark.slow
@pytest.mark.parametrize("adapts", [True, False])
def test_steps_of_earlier_settings_do_not_stay_beside_a_refined_result(
    freegeo, result, tiny, tmp_path, monkeypatch, adapts
):
    out = tmp_path / "out"
    command = ["reconstruct", result / "photos", "-o", out, *tiny, "--formats", "npz", "--refine", "ba"]
    if adapts:
        # An adapter that cannot be used: the result is that of the frozen model.
        monkeypatch.setattr("freegeo.job.not_finite", lambda result: "broken.")
        command = ["run", *command[1:], *QUICK]
    assert freegeo(*command, "--one-camera").code == 0
    assert (out / "unrefined").exists() and (out / "predicted").exists() is not adapts
    assert freegeo(*command).code == 0
    assert not (out / "predicted").exists() and (out / "unrefined").exists() is not adapts
    before = load_result(out).stages["frozen"].K[:, 0, 0]
    assert np.ptp(before) > 0


@pytest.mark.slow
def test_metres_of_a_measured_distance_are_said_to_be_moved_by_refinement(freegeo, result, tmp_path):
    shutil.copytree(result / "out", tmp_path / "out")
    found = Reconstruction.load(tmp_path / "out")
    found.scaled(2.0, source="a measured distance").save(tmp_path / "out")
    outcome = freegeo("refine", tmp_path / "out", "-o", tmp_path / "refined", "--formats", "npz")
    assert outcome.code == 0 and "metres from a measured distance" in outcome.err
    warnings = json.loads((tmp_path / "refined/reconstruction.json").read_text())["warnings"]
    assert any("metres from a measured distance" in sentence for sentence in warnings)


@pytest.mark.parametrize("command", ["run", "reconstruct"])
def test_a_missing_extra_is_said_before_the_photos_are_read(freegeo, tmp_path, monkeypatch, command):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    outcome = freegeo(command, tmp_path / "no photos", "-o", tmp_path / "out", "--refine", "ba")
    assert outcome.code == 2
    assert "pip install 'freegeo[colmap]'" in outcome.sentence()


def test_python_refuses_photos_of_another_reconstruction(result, tmp_path):
    from freegeo import refine
    from freegeo.errors import UserError

    found = Reconstruction.load(result / "out")
    fewer = sorted((result / "photos").iterdir())[:-1]
    with pytest.raises(UserError, match="the 7 photos are not those of the reconstruction, which has 8 views"):
        refine(found, fewer)
