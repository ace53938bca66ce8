"""One photo of another shape: the command says what it costs, in the log, the summary and the report."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from freegeo.export.reconstruction import Reconstruction


@pytest.fixture
def with_portrait(photo_folder, tmp_path):
    """Four photos, and a portrait of the same room."""
    folder = tmp_path / "photos"
    shutil.copytree(photo_folder, folder)
    Image.open(folder / "3.png").crop((14, 0, 50, 48)).save(folder / "portrait.png")
    return folder


def test_a_cut_photo_is_said_in_log_summary_and_report(freegeo, with_portrait, tmp_path, tiny):
    sentence = "portrait.png (36 x 48) has another shape than the rest: 44 % of it is cut; take it out, or use"
    outcome = freegeo("reconstruct", with_portrait, "-o", tmp_path / "out", *tiny, "--formats", "ply")
    assert outcome.code == 0
    assert f"warning: {sentence} --mixed pad." in outcome.err.splitlines()
    summary = json.loads((tmp_path / "out" / "reconstruction.json").read_text(encoding="utf-8"))
    assert f"{sentence} --mixed pad." in summary["warnings"]
    assert sentence in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    result = Reconstruction.load(tmp_path / "out")
    assert result.image_hw == (72, 96)
    assert (result.offset_xy[:4] == 0).all(), "the others are whole"


@pytest.mark.slow
def test_adaptation_with_padding_runs_and_its_points_are_of_photos(freegeo, with_portrait, tmp_path, tiny):
    out = tmp_path / "out"
    quick = ["--steps", "2", "--sets", "1", "--formats", "ply", "--mixed", "pad", "--drop-share", "0"]
    outcome = freegeo("run", with_portrait, "-o", out, *tiny, *quick)
    assert outcome.code == 0
    assert "cut" not in outcome.err
    result = Reconstruction.load(out)
    inside = result.inside()
    assert result.image_hw == (96, 96)
    assert inside.mean((1, 2)) == pytest.approx([0.75] * 5)
    summary = json.loads((out / "reconstruction.json").read_text(encoding="utf-8"))
    assert summary["filters"]["removed"]["outside the photo"] == (~inside).sum()
    assert np.isfinite([summary["loss"]["first"], summary["loss"]["last"]]).all()


def test_another_rule_is_another_result(freegeo, with_portrait, tmp_path, tiny):
    command = ["reconstruct", with_portrait, "-o", tmp_path / "out", *tiny, "--formats", "ply"]
    assert freegeo(*command).code == 0
    assert freegeo(*command, "--mixed", "upstream").code == 2, "the folder holds a result of other images"


def test_an_unknown_rule_is_refused(freegeo, with_portrait, tmp_path, tiny):
    outcome = freegeo("reconstruct", with_portrait, "-o", tmp_path / "out", *tiny, "--mixed", "separate")
    assert outcome.code == 2
    assert not (tmp_path / "out").exists()
