"""`--process-res`: another size is another result, in the settings, the summary and the adapter."""

import json
import shutil

import numpy as np
import pytest

from cli.conftest import QUICK
from freegeo.export.reconstruction import Reconstruction

LITTLE = ["--formats", "npz"]


def summary(folder):
    return json.loads((folder / "reconstruction.json").read_text())


@pytest.mark.slow
def test_a_side_is_another_prediction(freegeo, photo_folder, tiny, tmp_path):
    command = ["reconstruct", photo_folder, "-o", tmp_path / "out", *tiny, *LITTLE]
    outcome = freegeo(*command, "--process-res", "78")
    assert outcome.code == 0, outcome.err
    assert "--process-res 78 is rounded to patches of 8: images are 80 x 56." in outcome.err
    about = summary(tmp_path / "out")
    assert (about["process_res"], about["image_hw"]) == (78, [56, 80])
    assert "already finished" in freegeo(*command, "--process-res=78").out
    outcome = freegeo(*command)
    assert outcome.code == 2
    assert "--process-res: 78 there, none now" in outcome.sentence()
    assert "read at another size" in outcome.sentence()
    assert freegeo(*command, "--overwrite", "--process-res", "96").code == 0
    assert summary(tmp_path / "out")["process_res"] == 96
    assert "already finished" in freegeo(*command).out, "96 is the default"


@pytest.mark.parametrize("command", ["run", "reconstruct", "adapt", "batch"])
def test_sides_that_cannot_be_are_refused_before_anything(freegeo, photo_folder, tiny, tmp_path, command):
    outcome = freegeo(command, photo_folder, "-o", tmp_path / "out", *tiny, "--process-res", "600")
    assert outcome.code == 2
    assert "--process-res 600: freegeo-tiny reads photos with a longest side of 24 to 384" in outcome.sentence()
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_side_far_from_the_model_s_is_a_warning_of_the_result(freegeo, photo_folder, tiny, tmp_path):
    assert freegeo("reconstruct", photo_folder, "-o", tmp_path, *tiny, *LITTLE, "--process-res", "160").code == 0
    assert any("160 is far from that: compare with" in sentence for sentence in summary(tmp_path)["warnings"])


@pytest.mark.slow
def test_an_adapter_is_used_at_its_side_or_doubted(freegeo, photo_folder, tiny, tmp_path):
    made = freegeo("adapt", photo_folder, "-o", tmp_path / "adapter", *tiny, *QUICK, "--process-res", "80")
    assert made.code == 0, made.err
    assert json.loads((tmp_path / "adapter" / "freegeo.json").read_text())["process_res"] == 80
    options = ["--adapter", tmp_path / "adapter", *tiny[2:], *LITTLE]
    words = "the adapter was trained on images of 80 pixels and is used on 96"
    assert freegeo("reconstruct", photo_folder, "-o", tmp_path / "a", *options).code == 0
    assert any(words in sentence for sentence in summary(tmp_path / "a")["warnings"])
    assert freegeo("reconstruct", photo_folder, "-o", tmp_path / "b", *options, "--process-res", "80").code == 0
    assert not any(words in sentence for sentence in summary(tmp_path / "b")["warnings"])


@pytest.mark.slow
def test_run_adapts_and_predicts_at_one_side(freegeo, photo_folder, tiny, tmp_path):
    assert freegeo("run", photo_folder, "-o", tmp_path, *tiny, *QUICK, *LITTLE, "--process-res", "48").code == 0
    for folder in (tmp_path, tmp_path / "frozen"):
        assert Reconstruction.load(folder).image_hw == (40, 48)
    assert json.loads((tmp_path / "adapter" / "freegeo.json").read_text())["process_res"] == 48


@pytest.mark.slow
def test_chunks_are_predicted_at_the_side(freegeo, photo_folder, tiny, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for k in range(8):
        shutil.copy(photo_folder / f"{k % 4}.png", folder / f"{k}.png")
    options = ["--chunk", "4", "--process-res", "80", "--order", "given", "--no-loops"]
    outcome = freegeo("reconstruct", folder, "-o", tmp_path / "out", *tiny, *LITTLE, *options)
    assert outcome.code in (0, 3), outcome.err
    assert summary(tmp_path / "out")["process_res"] == 80
    assert Reconstruction.load(tmp_path / "out").image_hw == (64, 80)


@pytest.mark.slow
def test_known_intrinsics_come_back_in_pixels_of_the_photo_at_any_side(freegeo, photo_folder, tiny, tmp_path):
    K = [[70.0, 0, 32], [0, 70.0, 24], [0, 0, 1]]
    cameras = {"metric": False, "frames": [{"name": f"{k}.png", "K": K, "width": 64, "height": 48} for k in range(4)]}
    (tmp_path / "cameras.json").write_text(json.dumps(cameras))
    found = {}
    for side in ("48", "80"):
        options = ["--process-res", side, "--cameras", tmp_path / "cameras.json"]
        outcome = freegeo("reconstruct", photo_folder, "-o", tmp_path / side, *tiny, *LITTLE, *options)
        assert outcome.code == 0, outcome.err
        result = Reconstruction.load(tmp_path / side)
        K_of_corner = result.K[:, :2] + [[0, 0, 0.5], [0, 0, 0.5]]
        found[side] = K_of_corner / np.asarray(result.scale_xy)[:, :, None]
    np.testing.assert_allclose(found["48"], found["80"], rtol=1e-6)
    np.testing.assert_allclose(found["48"], np.broadcast_to(K[:2], (4, 2, 3)), rtol=1e-6)
