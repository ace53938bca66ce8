from dataclasses import replace

import numpy as np
import pytest
import torch

from exact_rooms import room
from freegeo.errors import FreeGeoError, UserError
from freegeo.export.reconstruction import METRIC_MODEL, Reconstruction, Scale
from freegeo.types import ImageBatch, Prediction


def batch_of(views=3, hw=(8, 12)):
    generator = torch.Generator().manual_seed(0)
    return ImageBatch(
        images=torch.rand(views, 3, *hw, generator=generator),
        names=tuple(f"ü{i}.jpg" for i in range(views)),
        photo_hw=torch.tensor([[33, 50]] * views),
        scale_xy=torch.tensor([[0.25, 0.26]] * views, dtype=torch.float64),
        offset_xy=torch.tensor([[-1.0, 0.0]] * views, dtype=torch.float64),
    )


def prediction_of(views=3, hw=(8, 12)):
    K = torch.eye(3).repeat(1, views, 1, 1)
    K[..., 0, 0], K[..., 1, 1], K[..., 0, 2], K[..., 1, 2] = 9.0, 10.0, 6.0, 4.0
    return Prediction(
        depth_z=torch.rand(1, views, *hw) + 1,
        conf=torch.rand(1, views, *hw) + 1,
        T_cam_world=torch.eye(4).repeat(1, views, 1, 1),
        K=K,
    )


def test_describes_itself_without_its_arrays():
    assert repr(room()).startswith("Reconstruction(4 views, ")
    assert repr(room()).endswith(" pixels, cameras)")
    assert repr(replace(room(), T_cam_world=None, K=None)).endswith(" pixels, no cameras)")


def test_a_saved_reconstruction_comes_back_bit_for_bit(tmp_path):
    stored = Reconstruction.from_prediction(prediction_of(), batch_of())
    assert stored.save(tmp_path / "out") == tmp_path / "out" / "prediction.npz"
    loaded = Reconstruction.load(tmp_path / "out")
    assert loaded.names == stored.names == ("ü0.jpg", "ü1.jpg", "ü2.jpg")
    assert loaded.arrays().keys() == stored.arrays().keys()
    for name, array in stored.arrays().items():
        assert loaded.arrays()[name].dtype == array.dtype, name
        np.testing.assert_array_equal(loaded.arrays()[name], array)
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["prediction.npz"]


@pytest.mark.parametrize(
    ("name", "place", "value"),
    [
        ("K", (1, 0, 0), 0), ("K", (1, 2, 2), 0), ("K", (1, 1, 1), np.nan), ("T_cam_world", (1, 0, 0), 2),
        ("T_cam_world", (1, 0, 3), np.inf), ("scale_xy", (1, 0), np.nan), ("scale_xy", (1, 0), 0),
        ("offset_xy", (1, 0), 1e30), ("photo_hw", (1, 0), 1 << 40),
    ],
    ids=str,
)  # fmt: skip
def test_numbers_that_no_photo_has_are_refused_with_its_name(tmp_path, name, place, value):
    file = Reconstruction.from_prediction(prediction_of(), batch_of()).save(tmp_path)
    arrays = dict(np.load(file))
    arrays[name][place] = value
    np.savez(file, **arrays)
    with pytest.raises(FreeGeoError, match=f"damaged, {name} of ü1.jpg is not that of a photo"):
        Reconstruction.load(file)


def test_the_file_holds_what_its_description_says(tmp_path):
    prediction, batch = prediction_of(), batch_of()
    file = Reconstruction.from_prediction(prediction, batch).save(tmp_path / "scene.npz")
    content = np.load(file, allow_pickle=False)
    types = {"depth_z": "f4", "conf": "f4", "T_cam_world": "f4", "K": "f4", "images": "u1", "photo_hw": "i8"}
    assert {name: content[name].dtype.str[1:] for name in types} == types
    np.testing.assert_array_equal(content["depth_z"], prediction.depth_z[0].numpy())
    np.testing.assert_allclose(content["images"] / 255, batch.images.permute(0, 2, 3, 1).numpy(), atol=0.5 / 255 + 1e-6)


def test_photo_intrinsics_are_those_of_the_batch():
    prediction, batch = prediction_of(), batch_of()
    found = torch.from_numpy(Reconstruction.from_prediction(prediction, batch).photo_K())
    torch.testing.assert_close(batch.model_K(found), prediction.K[0].double(), rtol=1e-12, atol=0)


def test_a_model_without_cameras_is_stored_and_says_so(tmp_path):
    prediction = Prediction(depth_z=prediction_of().depth_z)
    Reconstruction.from_prediction(prediction, batch_of()).save(tmp_path)
    loaded = Reconstruction.load(tmp_path)
    assert not loaded.has_cameras
    np.testing.assert_array_equal(loaded.conf, np.ones_like(loaded.depth_z))
    with pytest.raises(UserError, match="no cameras"):
        loaded.photo_K()


def test_a_metric_prediction_stays_metric_in_the_file(tmp_path):
    prediction = replace(prediction_of(), scale=torch.tensor([[2.5, torch.nan]]))
    stored = Reconstruction.from_prediction(prediction, batch_of())
    assert stored.scale == Scale(value=2.5, source=METRIC_MODEL)
    assert repr(stored).endswith(" cameras, metres)")
    for scale in (stored.scale, Scale(value=1e-3, source="known distances", spread=0.02), None):
        replace(stored, scale=scale).save(tmp_path)
        assert Reconstruction.load(tmp_path).scale == scale
    assert Reconstruction.load(tmp_path).lengths == "up to scale"


@pytest.mark.parametrize("wrong", [{"value": 0.0}, {"value": np.nan}, {"value": 1.0, "spread": -1.0}])
def test_a_scale_that_is_none_is_refused(tmp_path, wrong):
    with pytest.raises(FreeGeoError, match="scale"):
        Scale(source="known distances", **wrong)
    np.savez(tmp_path / "prediction.npz", **room().arrays(), **{f"scale_{k}": v for k, v in wrong.items()})
    with pytest.raises(FreeGeoError, match="not a reconstruction"):
        Reconstruction.load(tmp_path)


@pytest.mark.parametrize(
    ("damage", "error", "message"),
    [
        ("missing", UserError, "prediction.npz is missing"),
        ("truncated", FreeGeoError, "damaged"),
        ("text", FreeGeoError, "damaged"),
        ("pickle", FreeGeoError, "damaged"),
        ("newer", UserError, "newer freegeo"),
        ("keys", FreeGeoError, "conf, scale_xy missing"),
        ("shape", FreeGeoError, "expected"),
    ],
)
def test_bad_files_are_named(tmp_path, damage, error, message):
    file = tmp_path / "prediction.npz"
    arrays = room().arrays()
    if damage == "truncated":
        room().save(file)
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    elif damage == "text":
        file.write_text("not arrays")
    elif damage == "pickle":
        np.savez(file, **(arrays | {"names": np.array([{"a": 1}], dtype=object)}))
    elif damage == "newer":
        np.savez(file, **(arrays | {"format": 2}))
    elif damage == "keys":
        np.savez(file, **{k: v for k, v in arrays.items() if k not in ("conf", "scale_xy")})
    elif damage == "shape":
        np.savez(file, **(arrays | {"conf": arrays["conf"][:, 1:]}))
    with pytest.raises(error, match=message) as caught:
        Reconstruction.load(tmp_path)
    assert str(tmp_path) in str(caught.value)
    assert isinstance(caught.value, UserError) == (error is UserError)


def test_shapes_must_fit():
    with pytest.raises(FreeGeoError, match="names"):
        replace(room(), names=("a.jpg",))
    with pytest.raises(FreeGeoError, match="holds one scene"):
        Reconstruction.from_prediction(Prediction(depth_z=torch.ones(2, 3, 8, 12)), batch_of())
