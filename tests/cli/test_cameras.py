"""`freegeo cameras check` and `convert`: what they print, write and refuse."""

import json
import re

import numpy as np
import pytest
from PIL import Image

from freegeo.data.procedural import render, sample_rooms

HW = (144, 192)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A folder with four photos of a generated room and their cameras in cameras.json."""
    folder = tmp_path_factory.mktemp("room")
    views = render(sample_rooms([20_000_001], domain="test-id", frames=4), *HW)
    (folder / "photos").mkdir()
    frames = []
    for k, image in enumerate(views.images[0].permute(0, 2, 3, 1)):
        Image.fromarray((image * 255).round().byte().numpy()).save(folder / "photos" / f"{k}.png")
        K = views.K[0, k].double().numpy() + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        pose = views.T_cam_world[0, k].double().tolist()
        frames.append({"name": f"{k}.png", "width": HW[1], "height": HW[0], "K": K.tolist(), "w2c": pose})
    (folder / "cameras.json").write_text(json.dumps({"metric": True, "frames": frames}))
    return folder


def test_check_says_what_is_known_and_the_four_errors(freegeo, room):
    outcome = freegeo("cameras", "check", room / "photos", room / "cameras.json")
    assert outcome.code == 0, outcome.err
    assert "poses of 4 of 4 photos, intrinsics of 4, metres" in outcome.out
    assert "192 x 144 pixels, focal length" in outcome.out
    rows = re.findall(r"^(\S+) with (OpenCV|OpenGL) axes +([\d.]+) px", outcome.out, re.MULTILINE)
    errors = {(direction, axes): float(error) for direction, axes, error in rows}
    assert len(errors) == 4
    right = errors.pop(("world-to-camera", "OpenCV"))
    assert right < 0.5
    assert min(errors.values()) > 3 * right
    assert "accepted: " in outcome.out


def test_check_refuses_a_wrong_reading_and_takes_the_option_it_names(freegeo, room, tmp_path):
    content = json.loads((room / "cameras.json").read_text())
    for frame in content["frames"]:
        frame["w2c"] = np.linalg.inv(frame["w2c"]).tolist()
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    outcome = freegeo("cameras", "check", room / "photos", tmp_path / "cameras.json")
    assert outcome.code == 2
    assert "they fit as camera-to-world with OpenCV axes" in outcome.sentence()
    option = outcome.sentence().rpartition("Add ")[2].rstrip(".").split()
    assert freegeo("cameras", "check", room / "photos", tmp_path / "cameras.json", *option).code == 0


def test_check_without_poses_has_nothing_to_compare(freegeo, room, tmp_path):
    content = json.loads((room / "cameras.json").read_text())
    for frame in content["frames"]:
        del frame["w2c"]
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    outcome = freegeo("cameras", "check", room / "photos", tmp_path / "cameras.json")
    assert outcome.code == 0
    assert "poses of 0 of 4 photos, intrinsics of 4" in outcome.out
    assert "nothing to check by matches" in outcome.out


@pytest.mark.parametrize("to", ["cameras.json", "colmap", "nerfstudio", "tum", "kitti"])
def test_convert_goes_there_and_back(freegeo, room, tmp_path, to):
    there, back = (
        tmp_path / ("model" if to == "colmap" else "there.json" if to == "nerfstudio" else "there"),
        tmp_path / "b",
    )
    there = there.with_suffix(".json") if to == "cameras.json" else there
    outcome = freegeo("cameras", "convert", room / "cameras.json", "-o", there, "--to", to)
    assert outcome.code == 0, outcome.err
    assert "4 cameras" in outcome.out
    assert freegeo("cameras", "convert", there, "-o", back, "--photos", room / "photos").code == 0
    first, second = (json.loads(path.read_text())["frames"] for path in (room / "cameras.json", back))
    assert [frame["name"] for frame in second] == [frame["name"] for frame in first]
    for one, other in zip(first, second, strict=True):
        np.testing.assert_allclose(other["w2c"], one["w2c"], rtol=0, atol=1e-6)


def test_convert_does_not_replace_a_file_unasked(freegeo, room, tmp_path):
    (tmp_path / "out.json").write_text("mine")
    arguments = ("cameras", "convert", room / "cameras.json", "-o", tmp_path / "out.json")
    outcome = freegeo(*arguments)
    assert outcome.code == 2
    assert "exists already. Add --overwrite" in outcome.sentence()
    assert (tmp_path / "out.json").read_text() == "mine"
    assert freegeo(*arguments, "--overwrite").code == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--to", "poses"], "--to poses: cannot be written. Choose one of cameras.json, colmap"),
        (["--cameras-format", "colmap"], "neither cameras.bin nor cameras.txt"),
        (["--cameras-convention", "upside-down"], "no reading of poses"),
    ],
)
def test_convert_refuses_in_one_sentence(freegeo, room, tmp_path, arguments, words):
    outcome = freegeo("cameras", "convert", room / "cameras.json", "-o", tmp_path / "out", *arguments)
    assert outcome.code == 2
    assert words in outcome.sentence()
    assert not (tmp_path / "out").exists()


def test_a_binary_colmap_model_is_not_written_over(freegeo, room, tmp_path):
    (tmp_path / "images.bin").write_bytes(b"")
    outcome = freegeo(
        "cameras", "convert", room / "cameras.json", "-o", tmp_path, "--to", "colmap", "--overwrite"
    )  # fmt: skip
    assert outcome.code == 2
    assert "holds a binary COLMAP model" in outcome.sentence()
