"""Photos of different shapes become images of one size: what is seen of each, what is padding, and what is said."""

import logging
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image

from freegeo.data.photos import MemoryPhoto, load_photos
from freegeo.errors import UserError
from freegeo.models import da3_images, vggt_images
from freegeo.models.images import read_photos
from tiny_models import tiny_da3, tiny_vggt

SIDE, PATCH = 64, 8
BOTH = pytest.mark.parametrize("preprocess", [da3_images.preprocess, vggt_images.preprocess], ids=["da3", "vggt"])
LANDSCAPE, PORTRAIT, SQUARE, PANORAMA = (256, 192), (192, 256), (224, 224), (1536, 192)


def photos(*sizes_wh) -> list[MemoryPhoto]:
    """Smooth gradients with some noise, so that every place of a photo looks different."""
    found = []
    for number, (width, height) in enumerate(sizes_wh):
        noise = np.random.default_rng(number).integers(0, 40, (height, width, 3))
        ramp = np.linspace(0, 100, width)[None, :, None] + np.linspace(0, 100, height)[:, None, None]
        found.append(MemoryPhoto(f"{number}.png", (ramp + noise).astype(np.uint8)))
    return found


def read(preprocess, found, mixed="crop", patch=PATCH):
    return preprocess(found, side=SIDE, patch=patch, mixed=mixed)


@pytest.fixture
def said(caplog):
    """What `read_photos` warns of."""

    def sentences(found, mixed="crop", model=None):
        caplog.clear()
        with caplog.at_level(logging.WARNING, logger="freegeo"):
            read_photos(model or tiny_model(), found, mixed=mixed)
        return [record.getMessage() for record in caplog.records]

    return sentences


def tiny_model(build=tiny_da3):
    """A tiny model that reads images with a longest side of 64."""
    model = build()
    model.spec = replace(model.spec, default_side=SIDE)
    return model


@BOTH
def test_photos_of_one_shape_are_read_the_same_by_every_rule(preprocess):
    found = photos(LANDSCAPE, (512, 384), LANDSCAPE)
    batches = [read(preprocess, found, mixed) for mixed in ("crop", "pad", "upstream")]
    assert len({batch.digest() for batch in batches}) == 1
    for batch in batches:
        assert batch.images.shape == (3, 3, 48, 64)
        assert batch.images.is_contiguous()
        assert batch.inside().all()
        assert batch.seen_share().tolist() == [1, 1, 1]
        assert not batch.offset_xy.any()


@BOTH
@pytest.mark.parametrize(
    ("usual", "odd"),
    [(LANDSCAPE, PORTRAIT), (LANDSCAPE, SQUARE), (LANDSCAPE, PANORAMA), (PORTRAIT, SQUARE), (PANORAMA, LANDSCAPE)],
)
def test_an_odd_photo_is_cut_and_changes_nothing_for_the_others(preprocess, usual, odd):
    found = photos(usual, usual, odd, usual)
    alone, batch = read(preprocess, [found[i] for i in (0, 1, 3)]), read(preprocess, found)
    rest = batch.select([0, 1, 3])
    assert torch.equal(rest.images, alone.images)
    assert torch.equal(rest.scale_xy, alone.scale_xy)
    assert torch.equal(rest.offset_xy, alone.offset_xy)
    assert batch.inside().all(), "a cut photo fills its image"
    ratio = (odd[0] * usual[1]) / (odd[1] * usual[0])
    assert batch.seen_share()[2] == pytest.approx(min(ratio, 1 / ratio), rel=0.02)


@BOTH
@pytest.mark.parametrize("odd", [PORTRAIT, SQUARE, PANORAMA, (1024, 192)])
def test_padding_is_white_outside_the_photo_and_cuts_nothing(preprocess, odd):
    found = photos(odd, LANDSCAPE, LANDSCAPE)
    batch = read(preprocess, found, "pad")
    inside = batch.inside()
    assert batch.seen_share().tolist() == [1, 1, 1]
    assert not inside.all()
    for view, photo in enumerate(found):
        alone = read(preprocess, [photo]).images[0]
        assert torch.equal(batch.images[view][:, inside[view]], alone.flatten(1)), "pixels are those of the photo alone"
        assert (batch.images[view][:, ~inside[view]] == 1).all()


def test_the_upstream_rules_cut_to_the_smallest_and_pad_to_the_largest_sides():
    found = photos(LANDSCAPE, LANDSCAPE, PORTRAIT)
    cut, padded = (read(module.preprocess, found, "upstream") for module in (da3_images, vggt_images))
    assert cut.image_hw == (48, 48)
    assert cut.inside().all()
    assert cut.seen_share().tolist() == pytest.approx([0.75] * 3)
    assert padded.image_hw == (64, 64)
    assert padded.seen_share().tolist() == [1] * 3
    assert padded.inside().float().mean((1, 2)).tolist() == [0.75] * 3
    assert padded.inside()[0, 8:56].all() and padded.inside()[2, :, 8:56].all()


@BOTH
@pytest.mark.parametrize("mixed", ["crop", "pad", "upstream"])
def test_a_mark_in_an_odd_photo_lands_where_scale_and_offset_say(preprocess, mixed):
    found = [MemoryPhoto(f"{n}.png", np.full((h, w, 3), 128, np.uint8)) for n, (w, h) in enumerate([LANDSCAPE] * 3)]
    marked = np.full((300, 180, 3), 128, np.uint8)
    marked[160:176, 92:108] = (255, 0, 0)
    batch = read(preprocess, [*found, MemoryPhoto("mark.png", marked)], mixed)
    redness = (batch.images[3, 0] - batch.images[3, 1]).clamp(min=0)
    rows, columns = torch.meshgrid(*(torch.arange(n) + 0.5 for n in redness.shape), indexing="ij")
    place = torch.stack([(redness * axis).sum() / redness.sum() for axis in (columns, rows)])
    expected = torch.tensor([100.0, 168.0]) * batch.scale_xy[3] + batch.offset_xy[3]
    assert (place - expected).abs().max() < 0.15


def test_the_common_shape_is_the_one_that_loses_least():
    size = partial(read, da3_images.preprocess)
    assert size(photos(LANDSCAPE, PANORAMA, PANORAMA, PANORAMA)).image_hw == (8, 64), "two thirds are panoramas"
    assert size(photos(PANORAMA, (1024, 128), LANDSCAPE, LANDSCAPE, LANDSCAPE)).image_hw == (48, 64)
    # Between landscape and portrait, the square loses a quarter of either.
    assert size(photos(LANDSCAPE, PORTRAIT, SQUARE)).image_hw == (64, 64)
    halves = photos(LANDSCAPE, PORTRAIT, PORTRAIT, LANDSCAPE)
    assert size(halves).image_hw == (48, 48)
    assert size(halves, "pad").image_hw == (64, 64)
    assert size([*halves, *photos(LANDSCAPE)]).image_hw == (48, 48)
    assert size([*photos(LANDSCAPE, LANDSCAPE, LANDSCAPE), *halves[:2]]).image_hw == (48, 64)


@pytest.mark.parametrize("module", [da3_images, vggt_images])
def test_as_many_portraits_as_landscapes_are_read_as_upstream_reads_them(module):
    found = photos(LANDSCAPE, PORTRAIT, PORTRAIT, LANDSCAPE)
    batch = read(module.preprocess, found, "crop" if module is da3_images else "pad")
    assert batch.digest() == read(module.preprocess, found, "upstream").digest()


def test_a_photo_turned_by_exif_counts_as_what_it_is(tmp_path, said):
    for number in range(4):
        exif = Image.Exif()
        exif[0x0112] = 6 if number == 3 else 1
        pixels = np.random.default_rng(number).integers(0, 200, (192, 256, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / f"{number}.jpg", exif=exif)
    found = load_photos(tmp_path)
    assert said(found) == [
        "3.jpg (192 x 256) has another shape than the rest: 44 % of it is cut; take it out, or use --mixed pad."
    ]
    assert read(da3_images.preprocess, found).image_hw == (48, 64)


def test_what_is_cut_is_said_with_the_photo_to_blame(said):
    assert said(photos(LANDSCAPE, LANDSCAPE, (250, 192))) == [], "a few per cent are not worth a word"
    assert said(photos(LANDSCAPE, LANDSCAPE, PANORAMA)) == [
        "2.png (1536 x 192) has another shape than the rest: 83 % of it is cut; take it out, or use --mixed pad."
    ]
    assert said(photos(LANDSCAPE, LANDSCAPE, PANORAMA), "upstream") == [
        "2.png (1536 x 192) makes all photos 64 x 8: up to 83 % of each is cut; take it out, or use --mixed crop or "
        "pad."
    ]
    assert said(photos(LANDSCAPE, LANDSCAPE, LANDSCAPE, PORTRAIT, PANORAMA)) == [
        "2 of 5 photos have another shape than the rest: up to 83 % of each is cut, most of 4.png (1536 x 192); take "
        "them out, or use --mixed pad."
    ]
    assert said(photos(LANDSCAPE, PORTRAIT, SQUARE)) == [
        "the photos have different shapes and are all read at 64 x 64: up to 25 % of each is cut, most of 0.png (256 x "
        "192); sort them by shape, or use --mixed pad."
    ]
    assert said(photos(LANDSCAPE, LANDSCAPE, PANORAMA), "pad") == []


@pytest.mark.parametrize("build", [tiny_da3, tiny_vggt])
def test_enlarged_photos_are_said(said, build):
    model = tiny_model(build)
    assert said(photos((32, 24), (64, 48)), model=model) == []
    assert said(photos((64, 48), (16, 12)), model=model) == [
        "1.png (16 x 12) must be enlarged up to 4.0 times for the model, which adds no detail; use the originals if "
        "these are previews."
    ]


def test_a_model_that_cuts_by_a_rule_of_its_own_gets_the_warning_too(said):
    model = tiny_model()
    rule = model.preprocess

    def middle(found, *, mixed):
        batch = rule(found, mixed=mixed)
        return replace(batch, images=batch.images[..., 8:40, 16:48], offset_xy=batch.offset_xy - torch.tensor([16, 8]))

    model.preprocess = middle
    assert said(photos(LANDSCAPE, LANDSCAPE), model=model) == [
        "the model reads the middle of the photos only, at 32 x 32: 67 % of each is cut."
    ]


@BOTH
@pytest.mark.parametrize("size_wh", [(1, 1), (1, 4000), (4000, 1), (7, 400)])
def test_photos_without_a_patch_are_refused_by_name(preprocess, size_wh):
    with pytest.raises(
        UserError, match=rf"1\.png: a photo of {size_wh[0]} x {size_wh[1]} pixels is too small or too n"
    ):
        read(preprocess, photos(LANDSCAPE, size_wh))


@BOTH
@pytest.mark.parametrize("mixed", ["crop", "pad", "upstream"])
def test_an_extreme_aspect_is_read_or_refused_by_name(preprocess, mixed):
    found = photos(LANDSCAPE, LANDSCAPE, (4000, 60))
    try:
        batch = read(preprocess, found, mixed)
    except UserError as error:
        assert "2.png" in str(error)
    else:
        assert all(side % PATCH == 0 for side in batch.image_hw)
        assert batch.inside()[2].any()


def test_an_unknown_rule_is_refused():
    with pytest.raises(UserError, match=r"mixed is one of crop, pad, upstream, not 'separate'\."):
        read_photos(tiny_model(), photos(LANDSCAPE), mixed="separate")  # ty: ignore[invalid-argument-type]
