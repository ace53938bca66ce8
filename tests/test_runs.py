"""Runs into folders from Python: what they return, and that the model is as it was."""

import numpy as np
import pytest
import torch

import freegeo
from freegeo.adaptation.adapter import is_adapted
from freegeo.errors import UserError
from tiny_models import noise, quick, same, tiny_da3

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
        ({"chunk": 0}, "--chunk must be at least 2"),
        ({"order": "name"}, "order is auto, given, similar"),
        ({"refine": True, "cameras": "cameras.json"}, "Leave out refine or cameras"),
    ],
)
def test_what_cannot_be_is_refused_and_nothing_is_written(tmp_path, wrong, words):
    with pytest.raises(UserError, match=words):
        freegeo.reconstruct_sequence(tiny_da3(), pictures(), tmp_path / "out", **wrong)
    assert not (tmp_path / "out").exists()
