"""Runs into folders from Python: what they return, and that the model is as it was."""

import io
import logging
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

import freegeo
from freegeo import runs
from freegeo.adaptation import memory as adaptation_memory
from freegeo.adaptation import recipe as recipes
from freegeo.adaptation.adapter import is_adapted
from freegeo.adaptation.adapter_files import load_adapter, save_adapter
from freegeo.data.photos import load_photos
from freegeo.errors import FreeGeoError, UserError
from freegeo.files import atomic_path, write_json
from freegeo.models import memory as models_memory
from freegeo.models.checkpoints import fingerprint_of
from freegeo.models.precision import CPU
from freegeo.run_folder import run_folder
from tiny_models import attach, noise, quick, same, tiny_da3, tiny_nested, tiny_vggt

FRAMES = 5


def pictures() -> list[np.ndarray]:
    return list((noise(FRAMES).permute(0, 2, 3, 1) * 255).round().byte().numpy())


@pytest.mark.slow
def test_every_photo_is_in_one_piece(tmp_path):
    found = freegeo.reconstruct_sequence(
        tiny_da3(), pictures(), tmp_path / "out", chunk=4, overlap=2, order="given", formats=["tum"]
    )
    names = [name for piece in found.pieces for name in piece.names]
    assert sorted(names) == [f"image-{k:03d}" for k in range(FRAMES)]
    assert len(found.summary["sequence"]["chunks"]) == 2


@pytest.mark.slow
def test_one_adapter_is_trained_for_all_chunks_and_the_model_is_as_it_was(tmp_path):
    model = tiny_da3()
    before = [value.clone() for value in model.state_dict().values()]
    found = freegeo.reconstruct_sequence(
        model, pictures(), tmp_path / "out", chunk=4, overlap=2, order="given", recipe=quick(model), guard="off",
        formats=["tum"],
    )  # fmt: skip
    assert found.summary["recipe"]["steps"] == 4 and (tmp_path / "out/adapter").is_dir()
    assert not is_adapted(model) and same(list(model.state_dict().values()), before)


@pytest.mark.slow
def test_photos_that_fit_are_predicted_at_once_as_by_reconstruct(tmp_path):
    model = tiny_da3()
    found = freegeo.reconstruct_sequence(model, pictures(), tmp_path / "out", formats=["tum"])
    assert "sequence" not in found.summary
    assert torch.equal(*(torch.tensor(one.depth_z) for one in (found.result, freegeo.reconstruct(model, pictures()))))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"recipe": "scene", "adapter": "adapter"}, "Leave out one of them"),
        ({"chunk": "auto"}, "chunk is a number of photos, or None"),
        ({"chunk": 0}, r"a chunk has at least 2 photos \(--chunk\)"),
        ({"loops": "no"}, "loops is True or False, not 'no'"),
        ({"guard": "foo"}, "guard is select, report, off, not 'foo'"),
        ({"order": "name"}, "order is auto, given, similar"),
        ({"refine": True, "cameras": "cameras.json"}, "Leave out refine or cameras"),
    ],
)
def test_what_cannot_be_is_refused_and_nothing_is_written(tmp_path, wrong, words):
    with pytest.raises(UserError, match=words):
        freegeo.reconstruct_sequence(tiny_da3(), pictures(), tmp_path / "out", **wrong)
    assert not (tmp_path / "out").exists()


def test_numbers_of_numpy_are_numbers_of_photos():
    runs.SequenceWish(chunk=np.int64(3), overlap=np.int64(1)).check()  # ty: ignore[invalid-argument-type]


def test_a_recipe_that_teaches_cameras_is_refused_where_they_come_from_rays(tmp_path):
    model = tiny_nested()
    with pytest.raises(UserError, match="recipe evidence teaches the camera head"):
        freegeo.reconstruct_sequence(
            model, pictures(), tmp_path / "out", recipe=recipes.named("evidence", model.spec), pose_from="rays"
        )
    assert not (tmp_path / "out").exists()


def write_adapter(model, folder: Path) -> Path:
    adapter = attach(model)
    save_adapter(adapter, folder, {})
    adapter.detach()
    return folder


def contents(folder: Path) -> dict[Path, bytes]:
    return {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_memory_for_adapting_is_asked_for_where_an_adapter_has_to_be_trained(monkeypatch, tmp_path):
    """Not where only what comes after it changes: the adapter stays."""
    found = runs.Inputs(
        photos=[], batch=tiny_da3().preprocess(load_photos(pictures())), chunks=None, known=None, priors=None,
        masks=None, scale=None, one_camera=False,
    )  # fmt: skip
    asked = []
    monkeypatch.setattr(runs, "require_adaptation_fits", lambda *given, **named: asked.append(given[1]))
    monkeypatch.setattr(runs.Job, "run", lambda job: {})

    def asks(filters, overwrite, seed=1):
        asked.clear()
        runs.run_in_folder(
            tmp_path / "out", {"adaptation": {"seed": seed}, "filters": filters}, found, tiny_da3(),
            overwrite=overwrite, trusted=True, recipe=recipes.named("scene", tiny_da3().spec), compute=CPU,
            checkpoint=dict, load=tiny_da3, spec=tiny_da3().spec,
        )  # fmt: skip
        return asked == [FRAMES]

    assert asks("a", overwrite=False)
    assert not asks("b", overwrite=False)
    assert not asks("c", overwrite=True)
    # Nothing differs, so all of it is made anew.
    assert asks("c", overwrite=True)
    assert asks("c", overwrite=True, seed=2)


@pytest.mark.parametrize(
    "read", ["own adapter", "own photos", "adapter of another model", "adapter of nobody knows what", "too much memory"]
)
def test_nothing_is_removed_for_a_run_that_is_refused(monkeypatch, tmp_path, read):
    out, model = tmp_path / "out", tiny_da3()
    with run_folder(out, {"command": "reconstruct"}) as run:
        write_json(run / "reconstruction.json", {})
        write_adapter(model, run / "adapter")
        for k, picture in enumerate(pictures()):
            with atomic_path(run / f"images/{k}.png") as part:
                Image.fromarray(picture).save(part, format="png")
        run.finish()
    other = write_adapter(tiny_vggt(), tmp_path / "other")
    if read.endswith("what"):
        (other / "freegeo.json").unlink()
    photos = out / "images" if read == "own photos" else pictures()
    adapter = {"own adapter": out, "own photos": None, "too much memory": None}.get(read, other)
    wish: dict = {} if read != "too much memory" else {"recipe": "scene"}
    if wish:
        free = iter((10**9, 10**5))  # to predict, and to adapt
        for planner in (models_memory, adaptation_memory):
            monkeypatch.setattr(planner, "available", lambda device, model: next(free))
    before = contents(out)
    refused = r"--overwrite would remove it|made for tiny-vggt|belongs to another model|adapting tiny-da3 needs"
    with pytest.raises(UserError, match=refused):
        freegeo.reconstruct_sequence(model, photos, out, adapter=adapter, overwrite=True, **wish)
    assert contents(out) == before and not is_adapted(model)
    load_adapter(model, out)


def test_weights_are_told_apart_wherever_they_came_from():
    model = tiny_da3()
    before = fingerprint_of(model)
    assert before == fingerprint_of(tiny_da3()) != fingerprint_of(tiny_da3(seed=1))
    next(iter(model.parameters())).data.view(-1)[-1] += 1e-3
    assert fingerprint_of(model) != before


def test_a_result_knows_its_weights_and_has_every_warning_whatever_the_caller_logs(tmp_path, monkeypatch, caplog):
    shown, package, model = io.StringIO(), logging.getLogger("freegeo"), tiny_da3()
    monkeypatch.setattr(package, "handlers", [logging.StreamHandler(shown)])
    caplog.set_level(logging.ERROR, logger="freegeo")
    model.spec = replace(model.spec, caution="Depth is a guess.")
    black = [np.zeros_like(picture) for picture in pictures()[:2]]
    for name in ("first", "second"):
        found = freegeo.reconstruct_sequence(model, black, tmp_path / name, formats=["tum"], device="cpu")
        assert found.summary["warnings"][0] == "Depth is a guess."
        assert any("almost black" in sentence for sentence in found.summary["warnings"])
    assert not shown.getvalue() and package.level == logging.ERROR
    model.load_state_dict(tiny_da3(seed=1).state_dict())
    with pytest.raises(UserError, match="other weights"):
        freegeo.reconstruct_sequence(model, black, tmp_path / "first", formats=["tum"], device="cpu")


def test_a_finished_folder_needs_no_look_at_the_weights(tmp_path):
    with run_folder(tmp_path / "out", {}) as run:
        write_json(run / "reconstruction.json", {"images": []})
        run.finish()
    found = SimpleNamespace(known=None, chunks=None, photos=[])

    def read() -> None:
        raise AssertionError("the weight file was read")

    run = partial(
        runs.run_in_folder, tmp_path / "out", {}, found, tiny_da3(), overwrite=False, trusted=False, recipe=None,
        compute=CPU, checkpoint=read,
    )  # fmt: skip
    summary, finished_at = run()
    assert finished_at and summary == {"images": []}
    (tmp_path / "out" / "reconstruction.json").unlink()
    with pytest.raises(FreeGeoError, match=r"was removed after the run was finished\. Run again with --overwrite\."):
        run()
