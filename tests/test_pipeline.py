"""The pipeline as a library: predictions in chunks, adaptation by name, and the pieces of a summary."""

import numpy as np
import pytest
import torch

from freegeo import pipeline
from freegeo.errors import UserError
from freegeo.export.reconstruction import Reconstruction
from freegeo.types import ImageBatch
from tiny_models import noise, quick, tiny_da3


def batch(views: int) -> ImageBatch:
    return ImageBatch(
        images=noise(views),
        names=tuple(map(str, range(views))),
        photo_hw=torch.full((views, 2), 32),
        scale_xy=torch.ones(views, 2, dtype=torch.float64),
        offset_xy=torch.zeros(views, 2, dtype=torch.float64),
    )


@pytest.fixture
def model(monkeypatch):
    """A model of a few thousand parameters that takes a batch for photos."""
    model = tiny_da3()
    monkeypatch.setattr(model, "preprocess", lambda photos: photos)
    return model


def close(one: Reconstruction, two: Reconstruction) -> bool:
    return np.allclose(one.depth_z, two.depth_z, atol=1e-5)


def test_embedding_in_chunks_changes_nothing(model, monkeypatch):
    whole = pipeline.predict(model, batch(5))
    monkeypatch.setattr(pipeline, "VIEWS_PER_CHUNK", 2)
    parts = pipeline.predict(model, batch(5))
    assert close(whole, parts)
    assert parts.names == tuple("01234")
    assert whole.T_cam_world is not None and parts.T_cam_world is not None
    assert np.allclose(whole.T_cam_world, parts.T_cam_world, atol=1e-5)


def test_adapted_model_sees_from_the_first_view_and_detaching_restores(model):
    photos = batch(4)
    before = pipeline.reconstruct(model, photos)
    result = pipeline.adapt(model, photos, recipe=quick(model))
    assert len(result.curve) == 4
    after = pipeline.reconstruct(model, photos, adapter=result.adapter)
    assert not close(before, after)
    with result.adapter.off():
        assert close(before, pipeline.reconstruct(model, photos))
    result.adapter.detach()
    assert close(before, pipeline.reconstruct(model, photos))


def test_reference_of_an_adapter_may_be_chosen(model, monkeypatch):
    asked = []
    plain = model.aggregate
    monkeypatch.setattr(
        model, "aggregate", lambda tokens, **options: (asked.append(options["reference"]), plain(tokens, **options))[1]
    )
    pipeline.reconstruct(model, batch(3), adapter=object())
    pipeline.reconstruct(model, batch(3), adapter=object(), reference="middle")
    pipeline.reconstruct(model, batch(3))
    assert asked == ["first", "middle", model.spec.reference]


@pytest.mark.parametrize("views", [1, 2])
def test_too_few_photos_to_hold_one_out(model, views):
    with pytest.raises(UserError, match=f"needs at least 3 photos, got {views}"):
        pipeline.adapt(model, batch(views))
    assert pipeline.reconstruct(model, batch(views)).depth_z.shape == (views, 32, 32)


@pytest.mark.parametrize(
    ("totals", "first", "last"), [([3.0], 3.0, 3.0), ([4.0, 2.0], 4.0, 2.0), ([4.0, 2.0] * 10, 3.0, 3.0)]
)
def test_loss_change_is_of_the_first_and_last_tenth(totals, first, last):
    assert pipeline.loss_change(totals) == {"first": first, "last": last}


def test_settings_spell_the_recipe_out(model):
    settings = pipeline.settings_of(quick(model), command="run")
    assert settings["command"] == "run"
    assert settings["recipe"]["steps"] == 4
    assert pipeline.settings_of(None)["recipe"] is None
