"""Another longest side (`process_res`): each model's own rule at it, what is refused, and what is said."""

import logging
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import freegeo
from freegeo.data.photos import MemoryPhoto
from freegeo.errors import UserError
from freegeo.files import read_json
from freegeo.models import catalog, da3, da3_images, memory, vggt_images
from freegeo.models.da3_config import EMBEDDED, SMALL
from freegeo.models.images import SIDE_FACTOR, chosen_side, look_at_photos, read_photos
from freegeo.models.precision import Compute
from freegeo.runs import SequenceWish
from tiny_models import tiny_da3, tiny_vggt

QUICK = {"steps": 2, "sets": 1, "guard": "off"}
BOTH = pytest.mark.parametrize("build", [tiny_da3, tiny_vggt], ids=["da3", "vggt"])


def sized(build=tiny_da3):
    """A tiny model of 32 pixels and patches of 8 that takes other sizes, without a warning from 24 to 64."""
    model = build()
    part = model.cross_view
    model.spec = part.spec = replace(model.spec, sides=(24, 64))
    return model


def photos(*sizes_hw: tuple[int, int]) -> list[MemoryPhoto]:
    generator = np.random.default_rng(0)
    return [
        MemoryPhoto(f"{k}.png", generator.integers(0, 256, (*size, 3), dtype=np.uint8))
        for k, size in enumerate(sizes_hw)
    ]


FOUR = [(96, 128)] * 4


@pytest.mark.parametrize(
    ("side", "of_da3", "of_vggt"),
    [(504, (378, 504), (378, 504)), (756, (574, 756), (560, 756)), (500, (378, 504), (378, 504)),
     (252, (196, 252), (196, 252)), (1008, (756, 1008), (756, 1008))],
)  # fmt: skip
def test_the_rule_is_the_model_s_at_every_side(side, of_da3, of_vggt):
    assert da3_images.plan_size((3000, 4000), side, 14).final == of_da3
    assert vggt_images.plan_size((3000, 4000), side, 14).resized == of_vggt


@BOTH
def test_photos_are_read_at_the_side_that_is_asked_for(build):
    model, found = sized(build), photos(*FOUR, (96, 96))
    batch = read_photos(model, found, process_res=48)
    module = da3_images if build is tiny_da3 else vggt_images
    assert torch.equal(batch.images, module.preprocess(found, side=48, patch=8).images)
    assert (batch.process_res, batch.select([1, 3]).process_res) == (48, 48)
    frames = look_at_photos(model, found, process_res=48)
    assert torch.equal(frames.select([4, 0]).read().images, batch.images[[4, 0]])
    K = torch.tensor([[100.0, 0, 64], [0, 100, 48], [0, 0, 1]]).expand(5, 3, 3)
    small, large = (read_photos(model, found, process_res=side).model_K(K)[0] for side in (32, 64))
    assert torch.allclose(large[:2], 2 * small[:2])


@pytest.mark.parametrize("config", [SMALL, EMBEDDED])
def test_positions_are_made_for_every_grid_that_may_be_asked_for(config):
    """DA3 asks for a scale, from which the number of rows follows by rounding; VGGT and Pi3 ask for the number."""
    learned = SimpleNamespace(config=config, pos_embed=torch.arange(config.position_grid**2 + 1.0).view(1, -1, 1))
    for n in range(1, 4 * config.position_grid + 1):
        found = da3.Backbone.position_embedding(learned, (n, 3))
        assert found.shape == (1, 1 + 3 * n, 1)
        assert found[0, 0, 0] == 0, "the class token keeps its own"


@pytest.mark.parametrize("side", [287, 400])
def test_pi3_is_asked_for_the_pixels_of_a_photo_of_that_side(side):
    model = catalog.build_empty("pi3")
    for size in ((300, 400), (200, 600)):
        batch = read_photos(model, photos(size), process_res=side)
        height, width = batch.image_hw
        assert 0.9 * side**2 * 3 / 4 <= height * width <= side**2 * 3 / 4 * 1.04
        assert abs(width / height - size[1] / size[0]) < 0.2


def test_mapanything_s_sizes_are_scaled():
    model = catalog.build_empty("map-anything")
    sizes = {side: read_photos(model, photos((300, 400)), process_res=side).image_hw for side in (518, 259, 756)}
    assert sizes == {518: (392, 518), 259: (196, 252), 756: (574, 756)}


@BOTH
def test_the_network_computes_at_other_sides(build):
    model = sized(build)
    sizes = {}
    for side in (None, 24, 64):
        result = freegeo.reconstruct(model, photos(*FOUR), process_res=side, device="cpu")
        assert np.isfinite(result.depth_z).all()
        sizes[side] = result.image_hw
    assert sizes == {None: (24, 32), 24: (16, 24), 64: (48, 64)}


def test_a_default_that_is_asked_for_is_the_default():
    spec = sized().spec
    assert chosen_side(spec, None) is None
    assert chosen_side(spec, spec.default_side) is None
    assert chosen_side(replace(spec, sides=None), spec.default_side) is None
    assert chosen_side(spec, 40) == 40


@pytest.mark.parametrize("side", [-1, 0, 7, 129])
def test_sides_that_cannot_be_are_refused_with_the_range(side):
    with pytest.raises(UserError, match=rf"--process-res {side}: .* 8 to 128 pixels, rounded to patches of 8; .* 32\."):
        read_photos(sized(), photos(*FOUR), process_res=side)


def test_a_model_of_one_size_refuses_others():
    model = tiny_da3()
    with pytest.raises(UserError, match=r"reads photos at 32 pixels only\. Leave --process-res out"):
        freegeo.reconstruct(model, photos(*FOUR), process_res=48)


@pytest.mark.parametrize(("side", "doubted"), [(24, False), (64, False), (16, True), (72, True), (None, False)])
def test_sides_far_from_what_the_model_is_used_to_are_doubted(side, doubted, caplog):
    read_photos(sized(), photos(*FOUR), process_res=side)
    assert (f"and {side} is far from that: compare with a result of --process-res 24 to 64" in caplog.text) == doubted


def test_rounding_is_said(caplog):
    with caplog.at_level(logging.INFO, logger="freegeo"):
        read_photos(sized(), photos(*FOUR), process_res=40)
        assert "rounded" not in caplog.text
        read_photos(sized(), photos(*FOUR), process_res=43)
    assert "--process-res 43 is rounded to patches of 8: images are 40 x 32." in caplog.text


@pytest.mark.slow
def test_an_adapter_says_at_which_side_it_was_trained(tmp_path, caplog):
    model, found = sized(), photos(*FOUR)
    result = freegeo.adapt(model, found, process_res=48, device="cpu", **QUICK)
    result.save(tmp_path)
    assert read_json(tmp_path / "freegeo.json")["process_res"] == 48
    words = "trained on images of 48 pixels and is used on 32, for which it was not made: take --process-res 48"

    def doubted(process_res, adapter=None) -> bool:
        caplog.clear()
        freegeo.reconstruct(model, found, adapter=adapter, process_res=process_res, device="cpu")
        return words in caplog.text

    assert doubted(None) and not doubted(48)
    with result.adapter.off():
        assert not doubted(None)
    result.adapter.detach()
    assert not doubted(None)
    assert doubted(None, result.adapter) and not doubted(48, result.adapter)
    assert doubted(None, tmp_path) and not doubted(48, tmp_path)


def test_a_recipe_with_squares_of_its_own_says_that_it_keeps_to_them(caplog):
    squashing = freegeo.adaptation.recipe.scene(sized().spec).changed(squash=32, steps=1, sets_per_scene=1)
    result = freegeo.adapt(sized(), photos(*FOUR), recipe=squashing, process_res=48, device="cpu", guard="off")
    assert "adapts to images of 32 x 32 pixels whatever is asked for: --process-res 48" in caplog.text
    assert result.adapter.process_res is None


def test_the_memory_planner_and_chunks_count_the_pixels_that_are_asked_for(monkeypatch):
    model, found = sized(), photos(*FOUR * 3)
    sizes = {side: sum(size for _, size in planned(model, found, side)) for side in (32, 128)}
    budget = sum(sizes.values()) // 2
    monkeypatch.setattr(memory, "available", lambda device, model: budget)
    wish = SequenceWish(chunk=12)
    assert wish.plan(model, found, Compute()) is None
    with pytest.raises(UserError, match=r"at most .* photos of 128 x 96 pixels fit into memory"):
        wish.plan(model, found, Compute(), process_res=128)
    with pytest.raises(
        UserError, match=r"the run in the output folder predicts 12 photos together, and at most"
    ) as said:
        SequenceWish().plan(model, found, Compute(), process_res=128, before=12)
    assert "--chunk" not in str(said.value)
    with pytest.raises(UserError, match=r"12 images of 128 x 96 pixels .* use at most"):
        freegeo.reconstruct(model, found, process_res=128, device="cpu")


def planned(model, found, side):
    image_hw = read_photos(model, found, process_res=side).image_hw
    return memory.plan_reconstruction(model, len(found), image_hw, compute=Compute(), budget=10**9)[0]


@pytest.mark.parametrize(
    ("row", "name"),
    [
        ("DA3", "da3-base"),
        ("VGGT", "vggt-1b"),
        ("Pi3", "pi3"),
        ("MapAnything", "map-anything"),
        ("freegeo-tiny", "freegeo-tiny"),
    ],
)
def test_the_docs_name_the_sides(row, name):
    page = (Path(__file__).parents[2] / "docs" / "photos.md").read_text(encoding="utf-8")
    (line,) = [line for line in page.splitlines() if line.startswith(f"| {row} |")]
    spec = catalog.build_empty(name).spec
    _, _, default, _, quiet, ends, _ = (cell.strip() for cell in line.split("|"))
    assert default.split()[0] == str(spec.default_side)
    assert quiet == f"{spec.sides[0]} to {spec.sides[1]}"
    assert ends == f"{spec.default_side // SIDE_FACTOR}, {spec.default_side * SIDE_FACTOR}"
