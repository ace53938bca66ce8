"""`run`, `adapt` and `reconstruct`: what they write, that they continue, and that they leave results alone."""

import json
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh
from safetensors.numpy import load_file

from cli.conftest import PHOTOS, QUICK
from freegeo import job, pipeline
from freegeo.adaptation import adapt as adapting
from freegeo.adaptation.adapter import is_adapted
from freegeo.adaptation.state import UNFINISHED_FILE
from freegeo.export import formats
from freegeo.files import LEDGER_FILE, RUN_FILE
from freegeo.lock import LOCK_FILE
from freegeo.models.hub import sha256_of

ADAPTER_FILES = {"adapter_config.json", "adapter_model.safetensors", "camera_token.safetensors", "freegeo.json"}
RESULT_FILES = {"reconstruction.json", "prediction.npz", "kept.npz", "points.ply", "scene.glb"}
ARRAYS = {
    "depth_z": (PHOTOS, 72, 96),
    "conf": (PHOTOS, 72, 96),
    "images": (PHOTOS, 72, 96, 3),
    "T_cam_world": (PHOTOS, 4, 4),
    "K": (PHOTOS, 3, 3),
    "names": (PHOTOS,),
    "photo_hw": (PHOTOS, 2),
    "scale_xy": (PHOTOS, 2),
    "offset_xy": (PHOTOS, 2),
    "format": (),
}


def files(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()} - {RUN_FILE, LEDGER_FILE}


def prediction(folder: Path) -> dict[str, np.ndarray]:
    with np.load(folder / "prediction.npz", allow_pickle=False) as content:
        return dict(content)


def same(one: dict[str, np.ndarray], two: dict[str, np.ndarray]) -> bool:
    return set(one) == set(two) and all(np.array_equal(one[name], two[name]) for name in one)


@pytest.fixture(scope="module")
def finished(tmp_path_factory, photo_folder, tiny) -> Path:
    """The result of one uninterrupted `run`."""
    from freegeo.cli.app import main

    out = tmp_path_factory.mktemp("finished") / "out"
    assert main(["run", str(photo_folder), "-o", str(out), *tiny, *QUICK]) == 0
    return out


# -- run


def test_run_writes_what_the_design_says(finished):
    expected = (
        RESULT_FILES
        | {"frozen/prediction.npz", "frozen/kept.npz", "matches.npz"}
        | {f"adapter/{name}" for name in ADAPTER_FILES}
    )
    assert files(finished) - {"report.html"} == expected
    assert not (finished / LOCK_FILE).exists()


def test_predictions_hold_all_arrays_and_the_way_back_to_the_photos(finished):
    for folder in (finished, finished / "frozen"):
        arrays = prediction(folder)
        assert {name: value.shape for name, value in arrays.items() if name != "sky"} == ARRAYS
        assert (arrays["depth_z"] > 0).all()
        assert arrays["images"].dtype == np.uint8
        assert list(arrays["names"]) == [f"{k}.png" for k in range(PHOTOS)]
        assert (arrays["photo_hw"] == (48, 64)).all()
    assert not same(prediction(finished), prediction(finished / "frozen"))


def test_three_dimensional_files_open_elsewhere(finished):
    points = trimesh.load(finished / "points.ply")
    assert len(points.vertices) > 0
    assert points.colors.shape == (len(points.vertices), 4)
    scene = trimesh.load(finished / "scene.glb")
    assert len(scene.geometry) >= 2


def test_summary_says_how_the_result_came_about(finished, weights):
    summary = json.loads((finished / "reconstruction.json").read_text())
    assert summary["format"] == 1
    assert summary["model"] == "freegeo-tiny"
    assert summary["checkpoint"]["file"] == weights.name
    assert summary["licence_of_weights"] == "Apache-2.0"
    assert summary["images"] == [f"{k}.png" for k in range(PHOTOS)]
    assert summary["recipe"]["steps"] == 2
    assert summary["recipe"]["name"] == "scene"
    assert summary["adapter"] == "adapter"
    assert summary["command"].startswith("freegeo run ")
    assert set(summary["versions"]) >= {"freegeo", "torch", "python"}
    assert all(seconds >= 0 for seconds in summary["seconds"].values())
    metadata = json.loads((finished / "adapter" / "freegeo.json").read_text())
    assert metadata["base"]["model"] == "freegeo-tiny"
    assert summary["checkpoint"]["sha256"] == {weights.name: sha256_of(weights)}
    assert metadata["base"] == {**metadata["base"], **summary["checkpoint"]}
    assert [set(step) >= {"total"} for step in metadata["loss_curve"]] == [True, True]
    assert load_file(finished / "adapter" / "camera_token.safetensors")


def test_same_command_again_is_finished(freegeo, finished, photo_folder, tiny):
    before = (finished / "prediction.npz").stat().st_mtime_ns
    outcome = freegeo("run", photo_folder, "-o", finished, *tiny, *QUICK)
    assert outcome.code == 0
    assert "already finished on 20" in outcome.out
    assert (finished / "prediction.npz").stat().st_mtime_ns == before


def test_other_options_ask_for_overwrite(freegeo, finished, photo_folder, tiny):
    before = files(finished)
    outcome = freegeo("run", photo_folder, "-o", finished, *tiny, *QUICK, "--seed", 7)
    assert outcome.code == 2
    assert "--seed: 43 there, 7 now" in outcome.sentence()
    assert "--overwrite" in outcome.sentence()
    assert files(finished) == before


def test_other_photos_of_the_same_names_are_other_options(freegeo, finished, photo_folder, tiny, tmp_path):
    from PIL import Image

    for path in photo_folder.iterdir():
        Image.open(path).transpose(Image.Transpose.FLIP_LEFT_RIGHT).save(tmp_path / path.name)
    outcome = freegeo("run", tmp_path, "-o", finished, *tiny, *QUICK)
    assert outcome.code == 2
    assert "photos with other contents" in outcome.sentence()


@pytest.mark.slow
def test_overwrite_replaces_the_result_and_spares_the_users_files(freegeo, photo_folder, tiny, tmp_path):
    out = tmp_path / "out"
    assert freegeo("run", photo_folder, "-o", out, *tiny, *QUICK).code == 0
    (out / "notes.txt").write_text("mine")
    outcome = freegeo("run", photo_folder, "-o", out, *tiny, "--no-adapt", "--refine", "off", "--overwrite")
    assert outcome.code == 0, outcome.err
    assert files(out) - {"report.html"} == RESULT_FILES | {"notes.txt"}


@pytest.fixture
def no_model(monkeypatch):
    """Fails when anything is computed with a model."""

    def load(*arguments, **options):
        raise AssertionError("the weights were loaded")

    monkeypatch.setattr("freegeo.models.catalog.load_model", load)


@pytest.fixture
def copy(finished, tmp_path) -> Path:
    shutil.copytree(finished, tmp_path / "copy")
    return tmp_path / "copy"


def write_masks(folder: Path, rows: int) -> Path:
    from PIL import Image

    folder.mkdir(exist_ok=True)
    mask = np.zeros((48, 64), np.uint8)
    mask[:rows] = 255
    for k in range(PHOTOS):
        Image.fromarray(mask).save(folder / f"{k}.png")
    return folder


def points(folder: Path) -> int:
    return len(trimesh.load(folder / "points.ply").vertices)


def test_a_finished_folder_is_recognised_without_the_weights(freegeo, finished, photo_folder, tiny, no_model):
    assert "already finished" in freegeo("run", photo_folder, "-o", finished, *tiny, *QUICK).out


def test_other_formats_and_filters_are_written_without_adapting_again(freegeo, copy, photo_folder, tiny, no_model):
    before, adapter = prediction(copy), (copy / "adapter" / "adapter_model.safetensors").stat().st_mtime_ns
    few = points(copy)
    command = ("run", photo_folder, "-o", copy, *tiny, *QUICK)
    outcome = freegeo(*command, "--formats", "depth")
    assert outcome.code == 0, outcome.err
    assert {"points.ply", "scene.glb", "depth/0.png", "report.html"} <= files(copy)
    outcome = freegeo(*command, "--drop-share", 0, "--no-flying", "--no-multi-view")
    assert outcome.code == 0, outcome.err
    assert points(copy) == PHOTOS * 72 * 96 > few
    assert (copy / "depth" / "0.png").is_file()
    assert same(prediction(copy), before)
    assert (copy / "adapter" / "adapter_model.safetensors").stat().st_mtime_ns == adapter
    summary = json.loads((copy / "reconstruction.json").read_text())
    assert sum(summary["filters"]["removed"].values()) == 0
    assert "adaptation" in summary["seconds"]
    assert "100.0 % of" in (copy / "report.html").read_text()
    again = freegeo(*command, "--drop-share", 0, "--no-flying", "--no-multi-view")
    assert "already finished" in again.out


def test_masks_that_changed_in_place_are_other_masks(freegeo, copy, photo_folder, tiny, tmp_path, no_model):
    masks = write_masks(tmp_path / "masks", 30)
    command = ("run", photo_folder, "-o", copy, *tiny, *QUICK, "--masks", masks)
    assert freegeo(*command).code == 0
    assert "already finished" in freegeo(*command).out
    with_30 = points(copy)
    write_masks(masks, 10)
    outcome = freegeo(*command)
    assert outcome.code == 0
    assert "already finished" not in outcome.out
    assert points(copy) < with_30
    with np.load(copy / "kept.npz") as kept, np.load(copy / "frozen" / "kept.npz") as frozen:
        assert not kept["keep"][:, 15:].any()
        assert not frozen["keep"][:, 15:].any()
        assert f"{100 * kept['keep'].mean():.1f} % of" in (copy / "report.html").read_text()


def test_another_reference_view_keeps_the_adapter(freegeo, copy, photo_folder, tiny):
    trained = (copy / "adapter" / "adapter_model.safetensors").stat().st_mtime_ns
    before, frozen = prediction(copy), prediction(copy / "frozen")
    command = ("run", photo_folder, "-o", copy, *tiny, *QUICK, "--reference", "middle")
    outcome = freegeo(*command)
    assert outcome.code == 2
    assert '--reference: "first" there, "middle" now' in outcome.sentence()
    assert freegeo(*command, "--overwrite").code == 0
    assert (copy / "adapter" / "adapter_model.safetensors").stat().st_mtime_ns == trained
    assert not np.allclose(prediction(copy)["depth_z"], before["depth_z"])
    assert not np.allclose(prediction(copy / "frozen")["depth_z"], frozen["depth_z"])
    assert json.loads((copy / "reconstruction.json").read_text())["reference_view"] == "middle"


@pytest.mark.slow
def test_an_adapter_is_judged_again_by_predictions_of_another_reference_view(freegeo, photo_folder, tiny, tmp_path):
    command = ("run", photo_folder, "-o", tmp_path / "out", *tiny, *QUICK[:-1], "report", "--formats", "npz")
    assert freegeo(*command).code == 0
    trained = (tmp_path / "out" / "adapter" / "freegeo.json").stat().st_mtime_ns
    outcome = freegeo(*command, "--reference", "middle")
    assert outcome.code == 2 and "the predictions that the guard judges by" in outcome.sentence()
    assert freegeo(*command, "--reference", "middle", "--overwrite").code == 0
    assert (tmp_path / "out" / "adapter" / "freegeo.json").stat().st_mtime_ns != trained


@pytest.mark.slow
def test_an_adapter_that_changes_nothing_gives_the_frozen_result(freegeo, photo_folder, weights, tmp_path, monkeypatch):
    from freegeo.models import da3_config

    entry = next(e for e in da3_config.ENTRIES if e.name == "freegeo-tiny")
    spec = replace(entry.build().spec, reference="middle")
    other = replace(entry, build=partial(da3_config.build, da3_config.EMBEDDED, spec))
    monkeypatch.setattr(da3_config, "ENTRIES", (other,))
    arguments = ("--model", "freegeo-tiny", "--checkpoint", weights, *QUICK, "--lr", 1e-30)
    outcome = freegeo("run", photo_folder, "-o", tmp_path / "out", *arguments)
    assert outcome.code == 0, outcome.err
    frozen, adapted = prediction(tmp_path / "out" / "frozen"), prediction(tmp_path / "out")
    for name in ("depth_z", "T_cam_world", "K"):
        assert np.allclose(frozen[name], adapted[name], rtol=1e-3, atol=1e-4)
    first = freegeo("run", photo_folder, "-o", tmp_path / "a", *arguments, "--no-adapt", "--reference", "first")
    assert first.code == 0
    assert not np.allclose(prediction(tmp_path / "a")["T_cam_world"], frozen["T_cam_world"], rtol=1e-2, atol=1e-2)


@pytest.mark.slow
def test_numbers_that_are_not_finite_after_adaptation_leave_the_frozen_result(
    freegeo, finished, photo_folder, tiny, tmp_path, monkeypatch
):
    out, plain = tmp_path / "out", pipeline.predict_unchecked

    def broken(model, batch, **options):
        found = plain(model, batch, **options)
        return replace(found, depth_z=np.full_like(found.depth_z, np.nan)) if is_adapted(model) else found

    for module in (pipeline, job):
        monkeypatch.setattr(module, "predict_unchecked", broken)
    for more in ((), ("--formats", "depth")):
        outcome = freegeo("run", photo_folder, "-o", out, *tiny, *QUICK, *more)
        assert outcome.code == 0, outcome.err
        sentences = f"not a finite number for {PHOTOS} of {PHOTOS} views.", "The result is that of the frozen model."
        summary = json.loads((out / "reconstruction.json").read_text())
        for text in (outcome.err, outcome.out, " ".join(summary["warnings"]), (out / "report.html").read_text()):
            assert all(sentence in text for sentence in sentences)
        assert same(prediction(out), prediction(finished / "frozen"))
        assert summary["adapter"] is None


def test_run_without_adapting_is_the_frozen_reconstruction(freegeo, finished, photo_folder, tiny, tmp_path):
    assert freegeo("run", photo_folder, "-o", tmp_path / "a", *tiny, "--no-adapt", "--refine", "off").code == 0
    assert freegeo("reconstruct", photo_folder, "-o", tmp_path / "b", *tiny).code == 0
    for name in ("a", "b"):
        assert files(tmp_path / name) - {"report.html"} == RESULT_FILES
        assert same(prediction(tmp_path / name), prediction(finished / "frozen"))
        summary = json.loads((tmp_path / name / "reconstruction.json").read_text())
        assert summary["adapter"] is None
        assert summary["recipe"] is None


def test_run_refines_where_the_extra_is_installed(freegeo, finished, photo_folder, tiny, tmp_path, monkeypatch):
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    assert json.loads((finished / "reconstruction.json").read_text())["refinement"]["accepted"] is False
    monkeypatch.setattr("freegeo.cli.options.find_spec", lambda name: None)
    outcome = freegeo("run", photo_folder, "-o", tmp_path / "out", *tiny, "--no-adapt")
    assert outcome.code == 0, outcome.err
    assert json.loads((tmp_path / "out/reconstruction.json").read_text())["refinement"] is None


def test_output_lists_the_files_and_the_licence(freegeo, photo_folder, tiny, tmp_path):
    outcome = freegeo("run", photo_folder, "-o", tmp_path / "out", *tiny, "--no-adapt")
    for name in RESULT_FILES:
        assert str(tmp_path / "out" / name) in outcome.out
    assert "licence of the weights: Apache-2.0" in outcome.out
    assert "Traceback" not in outcome.err


def test_files_and_patterns_are_sources_too(freegeo, photo_folder, tiny, tmp_path):
    listed = freegeo("reconstruct", photo_folder / "3.png", photo_folder / "0.png", "-o", tmp_path / "a", *tiny)
    assert listed.code == 0
    assert list(prediction(tmp_path / "a")["names"]) == ["3.png", "0.png"]
    pattern = freegeo("reconstruct", f"{photo_folder}/*.png", "-o", tmp_path / "b", *tiny, "--max-views", 2)
    assert pattern.code == 0
    assert list(prediction(tmp_path / "b")["names"]) == ["0.png", "3.png"]


def test_one_photo_is_enough_to_reconstruct(freegeo, photo_folder, tiny, tmp_path):
    assert freegeo("reconstruct", photo_folder / "1.png", "-o", tmp_path / "out", *tiny).code == 0
    assert prediction(tmp_path / "out")["depth_z"].shape == (1, 72, 96)


# -- adapt, and reconstruct with its adapter


@pytest.mark.slow
def test_adapter_of_one_scene_gives_the_run_s_result(freegeo, finished, photo_folder, tiny, tmp_path):
    adapter, out = tmp_path / "adapter", tmp_path / "out"
    outcome = freegeo("adapt", photo_folder, "-o", adapter, *tiny, *QUICK)
    assert outcome.code == 0, outcome.err
    assert files(adapter) == ADAPTER_FILES
    assert "already finished" in freegeo("adapt", photo_folder, "-o", adapter, *tiny, *QUICK).out
    assert freegeo("adapt", photo_folder, "-o", adapter, *tiny, "--steps", 3).code == 2
    assert freegeo("reconstruct", photo_folder, "-o", out, *tiny, "--adapter", adapter).code == 0
    assert same(prediction(out), prediction(finished))
    assert json.loads((out / "reconstruction.json").read_text())["adapter"] == str(adapter)


def test_several_sources_make_one_adapter(freegeo, photo_folder, tiny, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    for k in range(3):
        (other / f"{k}.png").write_bytes((photo_folder / f"{k + 1}.png").read_bytes())
    adapter = tmp_path / "adapter"
    assert freegeo("adapt", photo_folder, other, "-o", adapter, *tiny, "--epochs", 1, "--sets", 1).code == 0
    metadata = json.loads((adapter / "freegeo.json").read_text())
    assert metadata["scenes"] == [str(photo_folder), str(other)]
    assert len(metadata["loss_curve"]) * metadata["recipe"]["batch"] >= 2
    assert files(adapter) == ADAPTER_FILES | {f"epochs/epoch_0/{name}" for name in ADAPTER_FILES}


@pytest.mark.slow
def test_retrained_adapter_is_another_option(freegeo, photo_folder, tiny, tmp_path):
    adapter, out = tmp_path / "adapter", tmp_path / "out"
    assert freegeo("adapt", photo_folder, "-o", adapter, *tiny, *QUICK).code == 0
    assert freegeo("reconstruct", photo_folder, "-o", out, *tiny, "--adapter", adapter).code == 0
    assert freegeo("adapt", photo_folder, "-o", adapter, *tiny, *QUICK, "--seed", 7, "--overwrite").code == 0
    outcome = freegeo("reconstruct", photo_folder, "-o", out, *tiny, "--adapter", adapter)
    assert outcome.code == 2
    assert "another adapter" in outcome.sentence()


# -- interruption


# A run of two steps reads the loss four times: in every step, and after the last without and with the adapter.
@pytest.mark.slow
@pytest.mark.parametrize(("stop_after", "left"), [(1, 3), (2, 2), (4, 0)])
def test_interrupted_run_continues_to_the_same_result(
    freegeo, finished, photo_folder, tiny, tmp_path, monkeypatch, stop_after, left
):
    out, steps = tmp_path / "out", []
    losses = adapting.adaptation_loss

    def counted(*arguments, **options):
        steps.append(len(steps))
        return losses(*arguments, **options)

    def interrupted(*arguments, **options):
        if len(steps) == stop_after:
            raise KeyboardInterrupt
        return counted(*arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(adapting, "adaptation_loss", interrupted)
        if left == 0:
            # Adaptation is complete; the interruption comes while the files are written.
            patch.setattr(formats, "export", lambda *a, **k: (_ for _ in ()).throw(KeyboardInterrupt))
            patch.setattr(job, "export", formats.export)
        outcome = freegeo("run", photo_folder, "-o", out, *tiny, *QUICK)
    assert outcome.code == 130
    assert "the same command continues" in outcome.sentence()
    assert "reconstruction.json" not in files(out)
    if left:
        assert (out / "adapter" / UNFINISHED_FILE).is_file()
    steps.clear()
    monkeypatch.setattr(adapting, "adaptation_loss", counted)
    assert freegeo("run", photo_folder, "-o", out, *tiny, *QUICK).code == 0
    assert len(steps) == left
    assert same(prediction(out), prediction(finished))
    assert files(out) == files(finished)


@pytest.mark.slow
def test_what_a_killed_process_leaves_continues_to_the_same_result(
    freegeo, finished, photo_folder, tiny, tmp_path, monkeypatch
):
    out, left, steps = tmp_path / "out", tmp_path / "left", []
    losses = adapting.adaptation_loss

    def copied(*arguments, **options):
        if len(steps) == 1:
            shutil.copytree(out, left)
        steps.append(len(steps))
        return losses(*arguments, **options)

    monkeypatch.setattr(adapting, "SAVE_EVERY_S", -1.0)
    monkeypatch.setattr(adapting, "adaptation_loss", copied)
    assert freegeo("run", photo_folder, "-o", out, *tiny, *QUICK).code == 0
    assert {RUN_FILE, LOCK_FILE, "adapter"} <= {path.name for path in left.iterdir()}
    assert (left / "adapter" / UNFINISHED_FILE).is_file()
    outcome = freegeo("run", photo_folder, "-o", left, *tiny, *QUICK)
    assert outcome.code == 0, outcome.err
    # Two steps and the look at what came out, then one step and the look.
    assert len(steps) == 4 + 3
    assert same(prediction(left), prediction(finished))
    assert files(left) == files(finished)


@pytest.mark.slow
def test_killed_process_continues_to_the_same_result(freegeo, finished, photo_folder, tiny, tmp_path):
    out = tmp_path / "out"
    arguments = ["run", str(photo_folder), "-o", str(out), *tiny, *QUICK]
    code = f"""
import time
from freegeo.adaptation import adapt as adapting
from freegeo.adaptation.adapter import is_adapted
from freegeo.cli.app import main
plain, calls = adapting.adaptation_loss, []
def slow(*arguments, **options):
    calls.append(1)
    if len(calls) == 2:
        time.sleep(120)
    return plain(*arguments, **options)
adapting.adaptation_loss, adapting.SAVE_EVERY_S = slow, -1.0
main({arguments!r})
"""
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 110
    while not (out / "adapter" / UNFINISHED_FILE).is_file() and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert (out / "adapter" / UNFINISHED_FILE).is_file()
    outcome = freegeo(*arguments)
    assert outcome.code == 0, outcome.err
    assert same(prediction(out), prediction(finished))
    assert files(out) == files(finished)


def test_two_processes_do_not_write_into_one_folder(freegeo, photo_folder, tiny, tmp_path):
    from freegeo.lock import locked

    with locked(tmp_path):
        outcome = freegeo("run", photo_folder, "-o", tmp_path, *tiny, *QUICK)
    assert outcome.code == 2
    assert "another freegeo process" in outcome.sentence()


@pytest.mark.parametrize("command", ["run", "adapt"])
def test_photos_that_prove_no_cameras_are_not_learned_from(freegeo, photo_folder, tiny, tmp_path, command):
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    out = tmp_path / "out"
    options = [*tiny, *QUICK, "--recipe", "evidence"]
    outcome = freegeo(command, photo_folder, "-o", out, *options)
    words = "the matches between the photos of"
    if command == "adapt":
        assert outcome.code == 1
        assert f"not adapted: {words} {photo_folder} prove no cameras to learn from." in outcome.sentence()
        assert not (out / "adapter_model.safetensors").exists()
        return
    assert outcome.code == 0, outcome.err
    summary = json.loads((out / "reconstruction.json").read_text())
    (warning,) = [sentence for sentence in summary["warnings"] if sentence.startswith(f"Not adapted: {words} photos")]
    assert warning.endswith("The result is that of the frozen model.")
    assert summary["adapter"] is None
    assert (out / "prediction.npz").read_bytes() == (out / "frozen" / "prediction.npz").read_bytes()
    assert "already finished" in freegeo("run", photo_folder, "-o", out, *options).out


@pytest.mark.parametrize("command", ["run", "adapt"])
def test_the_extra_of_recipe_evidence_is_asked_for_before_anything_is_written(
    freegeo, photo_folder, tiny, tmp_path, monkeypatch, command
):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    outcome = freegeo(command, photo_folder, "-o", tmp_path / "out", *tiny, "--recipe", "evidence")
    assert outcome.code == 2
    assert "pip install 'freegeo[colmap]'" in outcome.sentence()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("when", ["adaptation", "adapted prediction", "points and files", "report"])
def test_a_run_whose_folder_is_deleted_ends_with_a_sentence_and_makes_nothing_anew(
    freegeo, photo_folder, tiny, tmp_path, monkeypatch, when
):
    out = tmp_path / "out"
    plain = job.Hooks

    def deleting(*, stage, step):
        def told(name):
            stage(name)
            if name == when:
                shutil.rmtree(out)

        return plain(stage=told, step=step)

    monkeypatch.setattr(job, "Hooks", deleting)
    outcome = freegeo("run", photo_folder, "-o", out, *tiny, *QUICK)
    assert outcome.code == 1
    assert "was removed or replaced while freegeo was writing there" in outcome.sentence()
    assert not out.exists()


@pytest.mark.slow
def test_a_run_that_lost_its_frozen_prediction_is_not_finished(freegeo, photo_folder, tiny, tmp_path, monkeypatch):
    out = tmp_path / "out"
    plain = job.write_report

    def report(folder, **options):
        shutil.rmtree(out / "frozen")
        return plain(folder, **options)

    with monkeypatch.context() as patch:
        patch.setattr(job, "write_report", report)
        outcome = freegeo("run", photo_folder, "-o", out, *tiny, *QUICK)
        assert outcome.code == 1
        assert "run the command again" in outcome.sentence()
    outcome = freegeo("run", photo_folder, "-o", out, *tiny, *QUICK)
    assert outcome.code == 0, outcome.err
    assert (out / "frozen" / "prediction.npz").is_file()


def test_an_adapter_is_not_overwritten_by_the_result_that_it_is_for(freegeo, finished, photo_folder, tiny, tmp_path):
    out = Path(shutil.copytree(finished, tmp_path / "out"))
    before = files(out)
    outcome = freegeo("reconstruct", photo_folder, "--adapter", out, "-o", out, *tiny, "--overwrite")
    assert outcome.code == 2
    assert "it is read, and --overwrite would remove it" in outcome.sentence()
    assert files(out) == before
