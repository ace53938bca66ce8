"""Many photos that are read when they are needed: the same images as all at once."""

import numpy as np
import pytest
import torch

from freegeo.data.photos import MemoryPhoto
from freegeo.models.images import look_at_photos, read_photos
from tiny_models import tiny_da3


def photos(*sizes_hw: tuple[int, int]) -> list[MemoryPhoto]:
    generator = np.random.default_rng(0)
    return [
        MemoryPhoto(f"{k}.png", generator.integers(0, 256, (*size, 3), dtype=np.uint8))
        for k, size in enumerate(sizes_hw)
    ]


SAME = [(48, 64)] * 20
MIXED = [(48, 64)] * 12 + [(64, 48)] * 5 + [(48, 96)]


@pytest.mark.parametrize("mixed", ["crop", "pad", "upstream"])
@pytest.mark.parametrize("sizes", [SAME, MIXED], ids=["one shape", "several shapes"])
def test_a_part_is_as_it_is_among_all(sizes, mixed):
    model, found = tiny_da3(), photos(*sizes)
    whole, frames = read_photos(model, found, mixed=mixed), look_at_photos(model, found, mixed=mixed)
    chosen = [1, 12, 17, 3]
    part = frames.select(chosen).read()
    assert part.names == tuple(whole.names[i] for i in chosen)
    assert torch.equal(part.images, whole.images[chosen])
    for one in (part, frames.select(chosen)):
        assert one.image_hw == whole.image_hw
        for name in ("photo_hw", "scale_xy", "offset_xy"):
            assert torch.equal(getattr(one, name), getattr(whole, name)[chosen])
    assert torch.equal(frames.read().images, whole.images)


def test_photos_are_read_when_they_are_needed():
    reads = []

    class Counted(MemoryPhoto):
        def read(self):
            reads.append(self.name)
            return super().read()

    found = [Counted(photo.name, photo.pixels) for photo in photos(*SAME)]
    frames = look_at_photos(tiny_da3(), found)
    assert reads == [photo.name for photo in found]
    part = frames.select([4, 9])
    assert len(reads) == len(found)
    part.read()
    assert reads[len(found) :] == ["4.png", "9.png"]


def test_the_fingerprint_is_that_of_pixels_and_order():
    model, found = tiny_da3(), photos(*SAME)
    frames = look_at_photos(model, found)
    assert frames.digest() == look_at_photos(model, photos(*SAME)).digest()
    assert frames.digest() != frames.select(range(19, -1, -1)).digest()
    found[19] = MemoryPhoto("19.png", 255 - found[19].pixels)
    assert frames.digest() != look_at_photos(model, found).digest()


def test_what_is_cut_is_said_once_for_all(caplog):
    look_at_photos(tiny_da3(), photos(*[(48, 64)] * 30, (48, 96)))
    warnings = [record.message for record in caplog.records if record.levelname == "WARNING"]
    assert len([sentence for sentence in warnings if "another shape" in sentence]) == 1
