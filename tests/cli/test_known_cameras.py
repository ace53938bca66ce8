"""`--cameras`, `--scale` and `--one-camera`: what the commands do with them, and what a second run makes again."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cli.conftest import PHOTOS, QUICK
from freegeo.cameras.known import KnownCamera, KnownCameras
from freegeo.cameras.plain import write
from freegeo.data.procedural import render, sample_rooms
from freegeo.errors import UserError
from freegeo.export.pixels import corner_K
from freegeo.export.reconstruction import Reconstruction

LITTLE = ["--formats", "npz"]


@pytest.fixture(scope="module")
def known() -> KnownCameras:
    """The true cameras of `photo_folder`."""
    views = render(sample_rooms([20_000_003], domain="test-id", frames=PHOTOS), 48, 64)
    cameras = []
    for T, K in zip(views.T_cam_world[0].double().numpy(), views.K[0].double().numpy(), strict=True):
        u, _, vh = np.linalg.svd(T[:3, :3])
        T[:3, :3] = u @ vh
        K[:2, 2] += 0.5
        cameras.append(KnownCamera(T_cam_world=T, K=K, size_hw=(48, 64)))
    return KnownCameras(names=tuple(f"{k}.png" for k in range(PHOTOS)), cameras=tuple(cameras), source="x")


@pytest.fixture(scope="module")
def file(known, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("known") / "cameras.json"
    write(known, path)
    return path


def summary(folder: Path) -> dict:
    return json.loads((folder / "reconstruction.json").read_text())


@pytest.mark.slow
def test_run_returns_the_given_cameras_and_keeps_what_the_model_predicted(
    freegeo, photo_folder, tiny, file, known, tmp_path
):
    out = tmp_path / "out"
    command = ["run", photo_folder, "-o", out, *tiny, *QUICK, *LITTLE, "--cameras", file, "--trust-cameras", "--metric"]
    outcome = freegeo(*command)
    assert outcome.code == 0, outcome.err
    assert "is told the cameras of" in outcome.err
    result, frozen = Reconstruction.load(out), Reconstruction.load(out / "frozen")
    np.testing.assert_allclose(result.T_cam_world, [c.T_cam_world for c in known.cameras], atol=1e-12)
    np.testing.assert_allclose(corner_K(result), [c.K for c in known.cameras], atol=1e-9)
    assert result.scale is not None and "metres" in outcome.out
    about = summary(out)
    assert about["known_cameras"]["poses"] == PHOTOS and "is told" in about["known_cameras"]["model"]
    assert about["reference_view"] == "first"
    assert frozen.T_cam_world.dtype == np.float32
    # A scale costs no training, and starts from what the model predicted.
    before = (out / "adapter" / "adapter_model.safetensors").stat().st_mtime_ns
    outcome = freegeo(*command, "--scale", "0.png:30,24 2.png:10,20 = 2")
    assert outcome.code == 0 and "adaptation ..." not in outcome.err
    assert (out / "adapter" / "adapter_model.safetensors").stat().st_mtime_ns == before
    scaled = Reconstruction.load(out)
    factor = summary(out)["scale"]["value"]
    np.testing.assert_allclose(scaled.depth_z, result.depth_z * factor, rtol=1e-5)
    np.testing.assert_allclose(scaled.T_cam_world[:, :3, 3], result.T_cam_world[:, :3, 3] * factor, rtol=1e-9)


@pytest.mark.slow
def test_other_cameras_are_another_run_where_the_model_is_told_them(freegeo, photo_folder, tiny, file, known, tmp_path):
    out = tmp_path / "out"
    command = ["run", photo_folder, "-o", out, *tiny, *QUICK, *LITTLE, "--trust-cameras"]
    assert freegeo(*command, "--cameras", file).code == 0
    other = tmp_path / "other.json"
    moved = known.cameras[0].T_cam_world.copy()
    moved[0, 3] += 0.1
    write(replace(known, cameras=(replace(known.cameras[0], T_cam_world=moved), *known.cameras[1:])), other)
    refused = freegeo(*command, "--cameras", other)
    assert refused.code == 2 and "other known cameras" in refused.sentence()
    replaced = freegeo(*command, "--cameras", other, "--overwrite")
    assert replaced.code == 0 and "adaptation ..." in replaced.err
    # A part of the cameras is not told to this model: nothing of it is trained again, only returned.
    part = tmp_path / "part.json"
    write(replace(known, cameras=(*known.cameras[:2], *(KnownCamera() for _ in known.cameras[2:]))), part)
    outcome = freegeo(*command, "--cameras", part, "--overwrite")
    assert outcome.code == 0 and "poses and intrinsics of all photos, or none" in outcome.err
    np.testing.assert_allclose(Reconstruction.load(out).T_cam_world[1], known.cameras[1].T_cam_world, atol=1e-12)
    assert freegeo("refine", out, "-o", tmp_path / "refined").code == 2


def test_refused_cameras_leave_a_result_that_is_there(freegeo, photo_folder, tiny, file, tmp_path, monkeypatch):
    out = tmp_path / "out"
    command = ["reconstruct", photo_folder, "-o", out, *tiny, *LITTLE]
    assert freegeo(*command, "--cameras", file, "--trust-cameras").code == 0
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}

    def refuse(*arguments, **options):
        raise UserError("the cameras do not fit")

    monkeypatch.setattr("freegeo.runs.check_known", refuse)
    # Cameras that were trusted are not taken for checked ones.
    outcome = freegeo(*command, "--cameras", file)
    assert outcome.code == 2 and "the cameras do not fit" in outcome.sentence()
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    assert "already finished" in freegeo(*command, "--cameras", file, "--trust-cameras").out


def test_shared_focal_lengths_and_back(freegeo, photo_folder, tiny, tmp_path):
    out = tmp_path / "out"
    command = ["reconstruct", photo_folder, "-o", out, *tiny, *LITTLE]
    assert freegeo(*command).code == 0
    plain = Reconstruction.load(out)
    assert freegeo(*command, "--one-camera").code == 0
    shared = Reconstruction.load(out)
    assert np.ptp(shared.K[:, 0, 0]) == 0 and np.ptp(plain.K[:, 0, 0]) > 0
    assert summary(out)["one_camera"]["cameras"][0]["photos"] == PHOTOS
    assert freegeo(*command).code == 0
    again = Reconstruction.load(out)
    assert np.array_equal(again.K, plain.K) and not (out / "predicted").exists()


@pytest.mark.parametrize(
    "options, words",
    [
        (["--metric"], "--cameras FILE"),
        (["--cameras", "FILE", "--refine", "ba"], "would move the cameras"),
        (["--cameras", "FILE", "--reference", "middle"], "Leave --reference out"),
        (["--cameras", "nowhere.json"], "nowhere.json"),
        (["--scale", "1.5"], "neither gps, nor a distance"),
    ],
)
def test_what_cannot_be_is_refused_before_the_model_is_loaded(
    freegeo, photo_folder, tiny, file, tmp_path, options, words
):
    options = [file if option == "FILE" else option for option in options]
    outcome = freegeo("reconstruct", photo_folder, "-o", tmp_path / "out", *tiny, *options)
    assert outcome.code == 2 and words in outcome.sentence()
    assert not (tmp_path / "out").exists()


def test_wrongly_read_cameras_are_refused_and_leave_no_folder(freegeo, tmp_path, tiny):
    from PIL import Image

    from freegeo.data.procedural import get_domain, photograph_room

    scene = photograph_room(next(iter(get_domain("test-id").seeds(1))), "test-id", frames=8)
    photos = tmp_path / "photos"
    photos.mkdir()
    cameras = []
    for photo, T, K in zip(
        scene.photos[:3], scene.T_cam_world[:3].double().numpy(), scene.K[:3].double().numpy(), strict=True
    ):
        Image.fromarray(photo.read()).save(photos / photo.name)
        cameras.append(KnownCamera(T_cam_world=np.linalg.inv(T), K=K, size_hw=photo.size_hw))
    names = tuple(photo.name for photo in scene.photos[:3])
    write(KnownCameras(names=names, cameras=tuple(cameras), source="x"), tmp_path / "wrong.json")
    out = tmp_path / "out"
    outcome = freegeo("reconstruct", photos, "-o", out, *tiny, "--cameras", tmp_path / "wrong.json")
    assert outcome.code == 2 and "--cameras-convention c2w-opencv" in outcome.sentence()
    assert not out.exists()
    right = ["--cameras", tmp_path / "wrong.json", "--cameras-convention", "c2w-opencv"]
    assert freegeo("reconstruct", photos, "-o", out, *tiny, *LITTLE, *right).code == 0
