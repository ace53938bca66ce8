"""`export`, and the formats of `run` and `reconstruct`: what is written, what cannot be, and that nothing is stale."""

import json
import shutil
from pathlib import Path

import av
import numpy as np
import pytest
import trimesh
from PIL import Image

from cli.conftest import PHOTOS, QUICK
from cli.test_run import files
from export.test_photos import stored
from freegeo import files as writing
from freegeo.data.procedural import render, sample_rooms
from freegeo.export.formats import FORMATS
from freegeo.export.reconstruction import Reconstruction
from freegeo.files import LEDGER_FILE, RUN_FILE
from freegeo.fusion.settings import FilterSettings
from freegeo.lock import locked
from freegeo.models.da3 import DA3

RESULT = {"report.html", "reconstruction.json", "prediction.npz", "kept.npz"}
COPIES = {f"images/{k}.png" for k in range(PHOTOS)}


@pytest.fixture(scope="module")
def original(tmp_path_factory, photo_folder, tiny) -> Path:
    """A finished reconstruction and its photos, in one folder; tests use copies of it."""
    from freegeo.cli.app import main

    folder = tmp_path_factory.mktemp("original")
    shutil.copytree(photo_folder, folder / "photos")
    assert main(["reconstruct", str(folder / "photos"), "-o", str(folder / "out"), *tiny, "--formats", "ply"]) == 0
    return folder


@pytest.fixture
def out(original, tmp_path) -> Path:
    return Path(shutil.copytree(original / "out", tmp_path / "out"))


def points(folder: Path) -> int:
    return len(trimesh.load(folder / "points.ply").vertices)


# -- which prediction, and where to


def test_folder_and_file_name_the_same_prediction(freegeo, out, tmp_path, monkeypatch):
    for source in (out, out / "prediction.npz"):
        (out / "points.ply").unlink()
        outcome = freegeo("export", source, "-f", "ply")
        assert outcome.code == 0, outcome.err
        assert str(out / "points.ply") in outcome.out
    shutil.copy(out / "prediction.npz", tmp_path / "kitchen.npz")
    assert freegeo("export", tmp_path / "kitchen.npz", "-f", "ply", "-o", tmp_path / "deep" / "er").code == 0
    assert points(tmp_path / "deep" / "er") == points(out)
    assert freegeo("export", tmp_path / "kitchen.npz", "-f", "glb").code == 0
    assert (tmp_path / "scene.glb").is_file()
    monkeypatch.setenv("HOME", str(tmp_path))
    assert freegeo("export", "~/out", "-f", "ply", "-o", "~/home").code == 0
    assert (tmp_path / "home" / "points.ply").is_file()


def test_the_filters_are_told_once(freegeo, out):
    outcome = freegeo("export", out, "-f", "ply", "glb", "mesh")
    assert (outcome.out + outcome.err).count("% of 27648 pixels") == 1


def test_without_options_the_points_are_those_that_the_run_kept(freegeo, photo_folder, tiny, tmp_path):
    out, masks = tmp_path / "out", tmp_path / "masks"
    masks.mkdir()
    mask = np.zeros((48, 64), np.uint8)
    mask[10:20, 10:30] = 255
    for k in range(PHOTOS):
        Image.fromarray(mask).save(masks / f"{k}.png")
    command = ["reconstruct", photo_folder, "-o", out, *tiny, "--formats", "ply", "--masks", masks, "--drop-share", 0]
    assert freegeo(*command).code == 0
    assert freegeo("export", out, "-f", "ply,depth", "-o", tmp_path / "new").code == 0
    assert (tmp_path / "new" / "points.ply").read_bytes() == (out / "points.ply").read_bytes()
    with Image.open(tmp_path / "new" / "depth" / "0.png") as image:
        shown = Image.fromarray(mask).resize((96, 72), Image.Resampling.NEAREST)
        np.testing.assert_array_equal(np.array(image) > 0, np.array(shown) > 0)
    for options in (["--drop-share", 0.4], ["--drop-share", 0], ["--no-flying"], ["--masks", masks]):
        assert freegeo("export", out, "-f", "ply", "-o", tmp_path / "other", *options).code == 0
        assert points(tmp_path / "other") != points(out), "options are used even if they are the defaults"


def test_the_frozen_prediction_does_not_replace_the_files_of_the_adapted_one(freegeo, out):
    (out / "frozen").mkdir()
    shutil.copy(out / "prediction.npz", out / "frozen")
    before = (out / "points.ply").read_bytes()
    assert freegeo("export", out, "--frozen", "-f", "ply,nerfstudio", "--drop-share", ".9").code == 0
    assert (out / "points.ply").read_bytes() == before
    assert points(out / "frozen") < points(out)
    assert {f"frozen/{copy}" for copy in COPIES} <= files(out)


def test_files_do_not_go_into_the_folder_of_another_result(freegeo, out, original, tmp_path):
    other = shutil.copytree(out, tmp_path / "other")
    before = files(other)
    for target in (other, other / "frozen"):
        outcome = freegeo("export", out, "-f", "glb", "-o", target)
        assert outcome.code == 2
        assert "holds another result" in outcome.sentence()
    assert files(other) == before
    assert freegeo("export", out, "-f", "glb", "-o", out / "sub").code == 0


# -- which formats


def test_commas_spaces_and_all(freegeo, out, tmp_path, short_flights):
    for k, formats in enumerate((["-f", "ply,glb"], ["-f", "ply", "glb"], ["-f", "ply", "-f", "glb"], ["-f=ply,glb"])):
        assert freegeo("export", out, *formats, "-o", tmp_path / str(k)).code == 0
        assert files(tmp_path / str(k)) == {"points.ply", "scene.glb"}
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    assert freegeo("export", out, "-f", "all", "-o", tmp_path / "all").code == 0
    assert {"mesh.ply", "colmap/sparse/0/cameras.bin", "depth/depth.json", *COPIES} <= files(tmp_path / "all")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["-f"], f"Choose from {', '.join(FORMATS)}, or all"),
        (["-f", ","], "Choose from npz"),
        (["-f", "ply,obj"], "Unknown export format 'obj'. Choose from npz, ply"),
        ([], "--format"),
        (["-f", "mesh", "--voxel", "-1"], "must be positive"),
        (["-f", "ply", "--max-points", "0"], "must be at least 1"),
    ],
)
def test_mistakes_are_refused_and_nothing_is_written(freegeo, out, tmp_path, options, words):
    outcome = freegeo("export", out, "-o", tmp_path / "new", *options)
    assert outcome.code == 2
    assert words in outcome.sentence()
    assert not (tmp_path / "new").exists()


def test_formats_of_a_run_without_a_value_are_refused(freegeo, photo_folder, tiny, tmp_path):
    outcome = freegeo("reconstruct", photo_folder, "-o", tmp_path / "out", *tiny, "--formats")
    assert outcome.code == 2
    assert "Choose from npz" in outcome.sentence()


def test_colmap_of_one_photo_is_refused_before_anything_is_computed(
    freegeo, photo_folder, tiny, tmp_path, caplog, short_flights
):
    photo = photo_folder / "0.png"
    outcome = freegeo("reconstruct", photo, "-o", tmp_path / "out", *tiny, "--formats", "ply,colmap")
    assert outcome.code == 2
    assert "there is one photo" in outcome.sentence()
    assert not (tmp_path / "out").exists()
    outcome = freegeo("reconstruct", photo, "-o", tmp_path / "out", *tiny, "--formats", "all")
    assert outcome.code == 0, outcome.err
    assert outcome.err.count("'all' leaves out colmap") == 1
    assert "mesh.ply" in files(tmp_path / "out")


# -- partial results


def test_a_format_that_fails_costs_neither_the_report_nor_the_others(
    freegeo, photo_folder, tiny, tmp_path, monkeypatch
):
    strict = FilterSettings(min_agreeing=50, min_asked=0)
    monkeypatch.setattr("freegeo.cli.files.FilterOptions.settings", lambda self: strict)
    command = ["reconstruct", photo_folder, "-o", tmp_path / "out", *tiny, "--formats", "ply", "depth"]
    first, again = freegeo(*command), freegeo(*command)
    assert first.code == again.code == 3
    for outcome in (first, again):
        assert outcome.sentence().endswith("ply not written, everything else is there. The warnings say why.")
    assert "warning: Format ply is not written: no point is left to write" in first.err
    assert "already finished" in again.out
    expected = {*RESULT, "depth/depth.json"}
    assert files(tmp_path / "out") == expected | {f"depth/{k}.png" for k in range(PHOTOS)}
    summary = json.loads((tmp_path / "out" / "reconstruction.json").read_text())
    assert list(summary["not_written"]) == ["ply"]
    assert any("Format ply is not written" in sentence for sentence in summary["warnings"])
    assert "Format ply is not written" in (tmp_path / "out" / "report.html").read_text()


def test_export_is_partial_too_and_fails_when_nothing_is_written(freegeo, out, tmp_path, monkeypatch):
    other = tmp_path / "other"
    assert freegeo("export", out, "-f", "ply", "-o", other).code == 0
    assert (other / "points.ply").exists()
    strict = FilterSettings(min_agreeing=50, min_asked=0)
    monkeypatch.setattr("freegeo.cli.files.FilterOptions.settings", lambda self: strict)
    outcome = freegeo("export", out, "-f", "ply", "depth", "--min-agreeing", 50, "-o", other)
    assert outcome.code == 3
    assert "ply not written" in outcome.sentence()
    assert str(other / "depth") in outcome.out
    assert not (other / "points.ply").exists(), "the points of other filters are gone"
    outcome = freegeo("export", out, "-f", "ply", "--min-agreeing", 50, "-o", other)
    assert outcome.code == 1
    assert "nothing was written" in outcome.sentence()


def test_files_beside_a_report_show_its_points(freegeo, out):
    before = (out / "points.ply").read_bytes()
    outcome = freegeo("export", out, "-f", "ply", "--drop-share", 0.9)
    assert outcome.code == 2
    assert "show other points than these options keep" in outcome.sentence() and "--output" in outcome.sentence()
    assert (out / "points.ply").read_bytes() == before


@pytest.mark.slow
def test_the_flight_through_an_adapted_result_shows_the_frozen_one_too(
    freegeo, photo_folder, tiny, tmp_path, short_flights, monkeypatch
):
    def width(file):
        with av.open(str(file)) as video:
            return video.streams.video[0].width

    out, name = tmp_path / "out", "flythrough.mp4"
    done = freegeo("run", photo_folder, "-o", out, *tiny, "--steps", 3, "--guard", "off", "--formats", "video")
    assert done.code == 0, done.err
    assert width(out / name) == 2 * 384
    assert freegeo("export", out, "-f", "video", "-o", tmp_path / "again").code == 0
    assert (tmp_path / "again" / name).read_bytes() == (out / name).read_bytes()
    filters = {}
    with monkeypatch.context() as patch:
        patch.setattr(
            "freegeo.export.video.flythrough",
            lambda *_, before, masks: filters.update(before=before.filters) or iter([np.zeros((48, 64, 3), np.uint8)]),
        )
        assert freegeo("export", out, "-f", "video", "-o", tmp_path / "thin", "--drop-share", 0.6).code == 0
    assert filters["before"].drop_share == 0.6, "both sides are filtered alike"
    assert freegeo("export", out, "-f", "video", "--frozen").code == 0
    assert width(out / "frozen" / name) == 384


def test_a_model_without_cameras_writes_what_needs_none(freegeo, photo_folder, tiny, tmp_path, monkeypatch):
    plain = DA3.decode
    monkeypatch.setattr(DA3, "decode", lambda self, features: plain(self, features, want=("depth",)))
    out = tmp_path / "out"
    assert freegeo("reconstruct", photo_folder, "-o", out, *tiny, "--formats", "depth").code == 0
    assert "depth/depth.json" in files(out)
    outcome = freegeo("reconstruct", photo_folder, "-o", tmp_path / "default", *tiny)
    assert outcome.code == 3
    assert "Format ply is not written: this reconstruction has no cameras" in outcome.err
    assert freegeo("export", out, "-f", "ply").code == 2
    assert freegeo("export", out, "-f", "all").code == 0


# -- nothing old is left


def test_overwrite_leaves_nothing_of_the_result_before(freegeo, photo_folder, tiny, tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="needs the extra colmap")
    out, fewer = tmp_path / "out", tmp_path / "fewer"
    fewer.mkdir()
    for k in range(2):
        Image.open(photo_folder / f"{k}.png").save(fewer / f"new{k}.png")
    formats = ["--formats", "colmap", "depth", "nerfstudio"]
    assert freegeo("reconstruct", photo_folder, "-o", out, *tiny, *formats).code == 0
    (out / "colmap" / "mine.txt").write_text("mine")
    assert freegeo("reconstruct", fewer, "-o", out, *tiny, "--formats", "ply", "--overwrite").code == 0
    assert files(out) == {*RESULT, "points.ply", "colmap/mine.txt"}
    assert freegeo("export", out, "-f", "colmap").code == 0
    model = pycolmap.Reconstruction(out / "colmap" / "sparse" / "0")
    assert {image.name for image in model.images.values()} == {"new0.png", "new1.png"}
    assert {p.name for p in (out / "colmap" / "images").iterdir()} == {"new0.png", "new1.png"}


# -- the size of depth files


@pytest.fixture(scope="module")
def large_photos(tmp_path_factory) -> Path:
    """Photos larger than what the model reads, one of them turned by its EXIF data."""
    folder = tmp_path_factory.mktemp("large")
    images = (render(sample_rooms([7], frames=PHOTOS), 96, 128).images[0].permute(0, 2, 3, 1) * 255).byte().numpy()
    for k, pixels in enumerate(images):
        stored(folder / f"{k}.jpg", pixels, 6 if k == 1 else 1)
    return folder


def shapes(folder: Path) -> set[tuple[int, ...]]:
    return {np.load(file).shape for file in (folder / "depth-npy").glob("*.npy")}


@pytest.mark.slow
@pytest.mark.parametrize("command", [["reconstruct"], ["run", *QUICK]])
def test_depth_keeps_the_size_that_a_folder_was_made_with_until_another_is_asked_for(
    freegeo, large_photos, tiny, tmp_path, command
):
    again = [command[0], large_photos, "-o", tmp_path / "out", *tiny, *command[1:]]
    outcome = freegeo(*again, "--formats", "depth-npy,nerfstudio", "--depth-size", "photo")
    assert outcome.code == 0
    assert shapes(tmp_path / "out") == {(96, 128)}
    assert "depth as NumPy arrays, interpolated to the size of the photos" in outcome.out
    assert "depth for transforms.json, interpolated to the size of the photos" in outcome.out
    assert freegeo(*again, "--formats", "kitti").code == 0
    assert shapes(tmp_path / "out") == {(96, 128)}
    assert (tmp_path / "out" / "trajectory-kitti.txt").is_file()
    assert freegeo("export", tmp_path / "out", "-f", "depth-npy").code == 0
    assert shapes(tmp_path / "out") == {(96, 128)}
    outcome = freegeo(*again, "--depth-size", "model", "--formats", "depth-npy")
    assert outcome.code == 0 and "already finished" not in outcome.out
    assert shapes(tmp_path / "out") == {(72, 96)}
    assert "already finished" in freegeo(*again, "--formats", "depth-npy").out


@pytest.mark.slow
def test_a_later_export_interpolates_depth_by_the_photos_and_refuses_without_them(
    freegeo, large_photos, tiny, tmp_path
):
    photos, out = shutil.copytree(large_photos, tmp_path / "photos"), tmp_path / "out"
    assert freegeo("reconstruct", photos, "-o", out, *tiny).code == 0
    asked = ["export", out, "-f", "depth-npy", "--depth-size", "photo"]
    outcome = freegeo(*asked)
    assert outcome.code == 0
    assert "interpolated from the model's along the edges" in outcome.err
    assert shapes(out) == {(96, 128)}
    assert outcome.out.splitlines()[0].split()[0] == str(out / "depth-npy"), (
        "folders are listed, not all of their files"
    )
    shutil.rmtree(photos)
    outcome = freegeo(*asked, "-o", tmp_path / "new")
    assert outcome.code == 2
    assert "they are not at hand" in outcome.sentence()


# -- photos of a stored result


def test_a_later_export_copies_the_photos_as_they_were(freegeo, out, original):
    outcome = freegeo("export", out, "-f", "nerfstudio")
    assert outcome.code == 0
    assert "not at hand" not in outcome.err
    assert files(out) >= COPIES
    for k in range(PHOTOS):
        assert (out / "images" / f"{k}.png").read_bytes() == (original / "photos" / f"{k}.png").read_bytes()


@pytest.mark.parametrize("fate", ["moved", "replaced", "turned"])
def test_photos_that_are_no_longer_as_they_were_are_not_copied(freegeo, out, fate, tmp_path):
    summary = json.loads((out / "reconstruction.json").read_text())
    for k, record in enumerate(summary["photo_files"]):
        moved = tmp_path / "photos" / f"{k}.png"
        moved.parent.mkdir(exist_ok=True)
        shutil.copy(record["file"], moved)
        record["file"] = str(moved)
    (out / "reconstruction.json").write_text(json.dumps(summary))
    photo = tmp_path / "photos" / "2.png"
    if fate == "moved":
        photo.rename(tmp_path / "elsewhere.png")
    elif fate == "replaced":
        Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(photo)
    else:
        Image.open(photo).transpose(Image.Transpose.ROTATE_90).save(photo)
    outcome = freegeo("export", out, "-f", "nerfstudio")
    assert outcome.code == 0
    assert "warning: The photos are not at hand" in outcome.err
    assert not (out / "images").exists()
    assert len(json.loads((out / "transforms.json").read_text())["frames"]) == PHOTOS


@pytest.mark.parametrize("format", ["nerfstudio", "colmap"])
def test_copies_of_the_run_stand_for_photos_that_are_gone(freegeo, photo_folder, tiny, tmp_path, format):
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    photos, out = shutil.copytree(photo_folder, tmp_path / "photos"), tmp_path / "out"
    assert freegeo("reconstruct", photos, "-o", out, *tiny, "--formats", format).code == 0
    shutil.rmtree(photos)
    outcome = freegeo("export", out, "-f", "nerfstudio")
    assert "not at hand" not in outcome.err
    assert files(out) >= COPIES
    (out / LEDGER_FILE).write_text("")
    assert "not at hand" in freegeo("export", out, "-f", "nerfstudio").err, "pictures of others do not stand for them"


def test_a_prediction_alone_has_no_photos(freegeo, out, tmp_path):
    shutil.copy(out / "prediction.npz", tmp_path / "alone.npz")
    assert "not at hand" in freegeo("export", tmp_path / "alone.npz", "-f", "nerfstudio", "-o", tmp_path / "new").err
    assert Reconstruction.load(tmp_path / "alone.npz").names == tuple(f"{k}.png" for k in range(PHOTOS))
    assert not (tmp_path / "new" / RUN_FILE).exists()


# -- other processes, kills, and inputs that are outputs too


def test_an_export_waits_for_nobody_and_disturbs_nobody(freegeo, out, tmp_path):
    before = files(out)
    for arguments in (("-o", tmp_path / "new"), ()):
        with locked(out):
            outcome = freegeo("export", out, "-f", "glb", *arguments)
        assert outcome.code == 2
        assert "another freegeo process is writing here" in outcome.sentence()
    with locked(tmp_path / "new"):
        outcome = freegeo("export", out, "-f", "glb", "-o", tmp_path / "new")
        assert "another freegeo process is writing here" in outcome.sentence()
    assert files(out) == before
    assert not (tmp_path / "new").exists()
    assert freegeo("export", out, "-f", "glb", "-o", tmp_path / "new").code == 0


@pytest.mark.parametrize("inside", [True, False])
def test_what_a_killed_export_left_goes_with_the_next(freegeo, out, tmp_path, monkeypatch, inside):
    target = out if inside else tmp_path / "new"

    def killed(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        # A process that is killed removes nothing.
        patch.setattr(writing, "_remove", lambda path: None)
        patch.setattr(writing, "_flush", killed)
        assert freegeo("export", out, "-f", "glb", "-o", target).code == 130
    assert list(target.rglob("*.part*"))
    assert freegeo("export", out, "-f", "ply", "-o", target).code == 0
    assert not list(target.rglob("*.part*"))


@pytest.mark.parametrize("command", ["reconstruct", "run", "adapt"])
def test_photos_are_not_overwritten_by_their_own_result(freegeo, out, photo_folder, tiny, command):
    assert freegeo("export", out, "-f", "nerfstudio").code == 0
    before = files(out)
    outcome = freegeo(command, out / "images", "-o", out, *tiny, "--overwrite")
    assert outcome.code == 2
    assert "it is read, and --overwrite would remove it" in outcome.sentence()
    assert files(out) == before
