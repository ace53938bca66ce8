"""The values that packages hand to each other: chosen, joined, moved and cast without loss."""

import pytest
import torch

from freegeo.geometry.camera import photo_K
from freegeo.types import Features, ImageBatch, Prediction, ViewTokens
from tiny_models import parts_of, same

VIEWS = 5


def batch(seed: int = 0) -> ImageBatch:
    generator = torch.Generator().manual_seed(seed)
    return ImageBatch(
        images=torch.rand(VIEWS, 3, 8, 12, generator=generator),
        names=tuple("abcde"),
        photo_hw=torch.tensor([[100 + k, 200] for k in range(VIEWS)]),
        scale_xy=torch.rand(VIEWS, 2, dtype=torch.float64, generator=generator) + 0.1,
        offset_xy=torch.randn(VIEWS, 2, dtype=torch.float64, generator=generator) * 20,
    )


def tokens(samples: int = 2, views: int = VIEWS, hw: tuple[int, int] = (8, 12)) -> ViewTokens:
    generator = torch.Generator().manual_seed(views)
    extra = {"selection": torch.randn(samples, views, 4, generator=generator)}
    return ViewTokens(
        tokens=torch.randn(samples, views, 7, 4, generator=generator), image_hw=hw, grid_hw=(2, 3), extra=extra
    )


def features() -> Features:
    generator = torch.Generator().manual_seed(1)
    levels = {
        layer: (torch.randn(2, VIEWS, 6, 4, generator=generator), torch.randn(2, VIEWS, 1, 4, generator=generator))
        for layer in (3, 11)
    }
    return Features(levels=levels, image_hw=(8, 12), grid_hw=(2, 3))


def equal(one, two) -> bool:
    return (one.image_hw, one.grid_hw) == (two.image_hw, two.grid_hw) and same(parts_of(one), parts_of(two))


def test_intrinsics_go_to_the_photo_and_back():
    images = batch()
    K = torch.eye(3, dtype=torch.float64).repeat(VIEWS, 1, 1) * 50
    K[:, :2, 2], K[:, 2, 2] = 5.0, 1.0
    before = K.clone()
    assert torch.allclose(images.model_K(photo_K(K, images.scale_xy, images.offset_xy)), K)
    assert torch.allclose(photo_K(images.model_K(K), images.scale_xy, images.offset_xy), K)
    assert torch.equal(K, before)


def test_intrinsics_follow_the_pixels():
    """A point that a camera sees at photo pixel u is seen by the moved camera at u * scale + offset."""
    images = batch()
    K_photo = torch.tensor([[90.0, 0, 100], [0, 95, 50], [0, 0, 1]], dtype=torch.float64).repeat(VIEWS, 1, 1)
    point = torch.tensor([0.3, -0.2, 2.0], dtype=torch.float64)
    in_photo, in_model = (K @ point for K in (K_photo, images.model_K(K_photo)))
    moved = in_photo[:, :2] / in_photo[:, 2:] * images.scale_xy + images.offset_xy
    assert torch.allclose(in_model[:, :2] / in_model[:, 2:], moved)


def test_selected_photos_keep_everything_together():
    chosen = batch().select([4, 0])
    assert chosen.names == ("e", "a")
    assert len(chosen) == 2
    assert torch.equal(chosen.images, batch().images[[4, 0]])
    assert chosen.photo_hw.tolist() == [[104, 200], [100, 200]]


def test_digest_is_of_the_pixels():
    assert batch().digest() == batch().digest()
    assert batch().digest() != batch(1).digest()
    assert batch().digest() != batch().select([1, 0, 2, 3, 4]).digest()


@pytest.mark.parametrize("value", [tokens(), features()], ids=["tokens", "features"])
def test_selection_and_casting(value):
    assert equal(value.select([3, 1]).select([1, 0]), value.select([1, 3]))
    assert equal(value.select(range(VIEWS)), value)
    assert not equal(value.select([1, 0, 2, 3, 4]), value)
    assert {tensor.dtype for tensor in parts_of(value.to(torch.float16))} == {torch.float16}


def test_views_of_several_parts_are_joined_in_order():
    whole = tokens()
    assert equal(ViewTokens.join_views([whole.select([0, 1]), whole.select([2, 3, 4])]), whole)
    with pytest.raises(ValueError, match="different image sizes"):
        ViewTokens.join_views([whole, tokens(hw=(8, 16))])


def test_prediction_maps_what_is_there():
    mapped = Prediction(depth_z=torch.ones(2)).map(lambda t: t * 3)
    assert mapped.depth_z is not None
    assert mapped.depth_z.tolist() == [3, 3]
    assert mapped.conf is None
