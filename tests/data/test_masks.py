"""Masks: which file belongs to which photo, what is white in it, and every refusal."""

import numpy as np
import pytest
from PIL import Image

from data.test_photos import ORIENTATION, STORED
from freegeo.data.masks import load_masks
from freegeo.errors import UserError

HW = (24, 40)


def wanted(height=24, width=40) -> np.ndarray:
    """What the masks here keep: an off-centre rectangle."""
    mask = np.zeros((height, width), bool)
    mask[height // 4 : height // 2, width // 8 : width // 2] = True
    return mask


def grey(mask=None) -> Image.Image:
    return Image.fromarray((wanted() if mask is None else mask).astype(np.uint8) * 255)


def save(path, image=None, **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    (grey() if image is None else image).save(path, **options)
    return path


def load(folder, names, sizes=None) -> list[np.ndarray]:
    return load_masks(folder, names, sizes or [HW] * len(names))


def refusal(folder, names, sizes=None) -> str:
    with pytest.raises(UserError) as caught:
        load(folder, names, sizes)
    message = str(caught.value)
    assert "\n" not in message
    assert message.endswith(".")
    return message


# -- names


@pytest.mark.parametrize(
    "name",
    [
        "IMG_1.png", "IMG_1.jpg.png", "IMG_1_mask.png", "IMG_1.mask.png", "mask_IMG_1.png", "IMG_1-Mask.PNG",
        "IMG_1.jpg_mask.png", "img_1.PNG", "IMG_1.gif", "left/IMG_1.jpg.png",
    ],
)  # fmt: skip
def test_naming_conventions(tmp_path, name):
    save(tmp_path / name)
    (tmp_path / "notes.txt").write_text("")
    (mask,) = load(tmp_path, ["IMG_1.jpg"])
    assert (mask == wanted()).all()


def test_photos_in_sub_folders(tmp_path):
    photos = ["left/a.jpg", "right/a.jpg"]
    save(tmp_path / "left" / "a.png")
    save(tmp_path / "right" / "a.jpg.png", grey(~wanted()))
    left, right = load(tmp_path, photos)
    assert (left == wanted()).all()
    assert (right == ~wanted()).all()
    assert "several masks fit a.jpg (left/a.png, right/a.jpg.png)" in refusal(tmp_path, ["a.jpg"])
    (tmp_path / "right" / "a.jpg.png").unlink()
    assert "1 of 2 photos have no mask (right/a.jpg)" in refusal(tmp_path, photos)
    save(tmp_path / "flat" / "a.png")
    assert "fits left/a.jpg and right/a.jpg" in refusal(tmp_path / "flat", photos)


def test_names_that_do_not_decide_are_refused(tmp_path):
    save(tmp_path / "a.png")
    assert "fits a.jpg and a.tif" in refusal(tmp_path, ["a.jpg", "a.tif"])
    save(tmp_path / "a_mask.png")
    assert "several masks fit a.jpg (a.png, a_mask.png). Keep one." in refusal(tmp_path, ["a.jpg"])
    assert "no mask (b.jpg)" in refusal(tmp_path, ["b.jpg"])
    assert "no such folder of masks" in refusal(tmp_path / "none", ["a.jpg"])


def test_masks_of_video_frames_and_images_in_memory(tmp_path):
    for name in ("walk_000012.png", "image-000.png"):
        save(tmp_path / name)
    assert len(load(tmp_path, ["walk_000012.png", "image-000"])) == 2


# -- kinds


def as_kind(kind: str) -> Image.Image:
    mask, level = wanted(), wanted().astype(np.uint8) * 255
    if kind == "bitmap":
        return grey().convert("1")
    if kind == "palette of black and white":
        return grey().convert("P")
    if kind == "0 and 1":
        return Image.fromarray(mask.astype(np.uint8))
    if kind == "16 bits, 65535":
        return Image.fromarray(mask.astype(np.uint16) * 65535)
    if kind == "16 bits, 255":
        return Image.fromarray(mask.astype(np.uint16) * 255)
    if kind == "16 bits, 1":
        return Image.fromarray(mask.astype(np.uint16))
    if kind == "float, 1":
        return Image.fromarray(mask.astype(np.float32))
    if kind == "float, 255":
        return Image.fromarray(mask.astype(np.float32) * 255)
    if kind == "colour file":
        return grey().convert("RGB")
    if kind == "opaque":
        return grey().convert("RGBA")
    if kind == "white and transparent":
        return Image.fromarray(np.dstack([np.full((*HW, 3), 255, np.uint8), level]))
    if kind == "white on transparent black":
        return Image.fromarray(np.dstack([level, level]), "LA")
    assert kind == "cut-out photo"
    colours = np.random.default_rng(0).integers(0, 256, (*HW, 3), dtype=np.uint8)
    return Image.fromarray(np.dstack([colours, level]))


@pytest.mark.parametrize(
    "kind",
    [
        "bitmap", "palette of black and white", "0 and 1", "16 bits, 65535", "16 bits, 255", "16 bits, 1", "float, 1",
        "float, 255", "colour file", "opaque", "white and transparent", "white on transparent black", "cut-out photo",
    ],
)  # fmt: skip
def test_every_kind_that_is_black_and_white(tmp_path, kind):
    save(tmp_path / ("a.tif" if "float" in kind else "a.png"), as_kind(kind))
    (mask,) = load(tmp_path, ["a.jpg"])
    assert mask.dtype == bool
    assert (mask == wanted()).all()


def test_lossy_and_soft_masks_are_cut_at_half(tmp_path):
    big = wanted(240, 400)
    save(tmp_path / "a.jpg", grey(big), quality=60)
    soft = grey(big).resize((200, 120), Image.Resampling.BOX).resize((400, 240), Image.Resampling.BILINEAR)
    save(tmp_path / "b.png", soft)
    for mask in load(tmp_path, ["a.jpg", "b.jpg"], [(240, 400)] * 2):
        assert (mask != big).mean() < 0.01


def unclear(kind: str) -> Image.Image:
    levels = np.zeros(HW, np.uint8)
    if kind == "labels":
        levels[:8], levels[8:16] = 1, 2
    elif kind == "a grey value":
        levels[:8] = 128
    elif kind == "constant grey":
        levels[:] = 200
    elif kind == "depth":
        levels = np.linspace(0, 255, levels.size).reshape(HW).astype(np.uint8)
    elif kind == "16 bit labels":
        return Image.fromarray(levels.astype(np.uint16) + wanted() * np.uint16(4000))
    elif kind == "float above 65535":
        return Image.fromarray(wanted().astype(np.float32) * 1e6)
    elif kind == "negative":
        return Image.fromarray(wanted().astype(np.float32) - 1)
    elif kind == "not a number":
        return Image.fromarray(np.where(wanted(), np.nan, 0).astype(np.float32))
    elif kind == "black on transparent":
        return Image.fromarray(np.dstack([levels, wanted() * np.uint8(255)]), "LA")
    elif kind == "palette of colours":
        image = Image.fromarray(wanted().astype(np.uint8)).convert("P")
        image.putpalette([0, 0, 0, 128, 0, 0])
        return image
    else:
        assert kind == "photo"
        return Image.fromarray(np.random.default_rng(0).integers(0, 256, (*HW, 3), dtype=np.uint8))
    return Image.fromarray(levels)


@pytest.mark.parametrize(
    "kind",
    [
        "labels", "a grey value", "constant grey", "depth", "16 bit labels", "float above 65535", "negative",
        "not a number", "black on transparent", "palette of colours", "photo",
    ],
)  # fmt: skip
def test_what_is_not_understood_is_refused(tmp_path, kind):
    path = save(tmp_path / "a.tif", unclear(kind))
    message = refusal(tmp_path, ["a.jpg"])
    assert message.startswith(f"{path}: not a mask that is understood, ")
    assert message.endswith("Save it in black and white; white is kept.")


def test_masks_that_select_nothing_or_everything(tmp_path, caplog):
    nothing, everything = np.zeros(HW, bool), np.ones(HW, bool)
    save(tmp_path / "a.png", grey(nothing))
    assert "the masks select nothing" in refusal(tmp_path, ["a.jpg"])
    save(tmp_path / "b.png", grey(everything))
    save(tmp_path / "c.png")
    caplog.clear()
    assert [mask.mean() for mask in load(tmp_path, ["a.jpg", "b.jpg"])] == [0, 1]
    assert "masks of 1 of 2 photos are all black, so these give no points: a.jpg." in caplog.text
    assert "masks of 1 of 2 photos are all white and keep everything: b.jpg." in caplog.text
    caplog.clear()
    load(tmp_path, ["c.jpg"])
    assert not caplog.text
    save(tmp_path / "clear" / "c.png", Image.new("RGBA", HW[::-1], (255, 255, 255, 0)))
    assert "the masks select nothing" in refusal(tmp_path / "clear", ["c.jpg"])


# -- size


@pytest.mark.parametrize("factor", [0.25, 0.5, 2, 3])
def test_masks_of_another_scale_are_resized(tmp_path, factor):
    height, width = 48, 80
    save(tmp_path / "a.png", grey(wanted(int(height * factor), int(width * factor))))
    (mask,) = load(tmp_path, ["a.jpg"], [(height, width)])
    assert mask.shape == (height, width)
    assert (mask != wanted(height, width)).mean() < 0.02


def test_a_side_that_was_rounded_is_no_other_shape(tmp_path):
    save(tmp_path / "a.png", grey(wanted(378, 504)))
    (mask,) = load(tmp_path, ["a.jpg"], [(3024, 4033)])
    assert mask.shape == (3024, 4033)


def test_masks_of_another_shape_are_refused(tmp_path):
    save(tmp_path / "a.png")
    message = refusal(tmp_path, ["a.jpg"], [(24, 48)])
    assert "the mask has 40 x 24 pixels, the photo a.jpg 48 x 24, which is another shape." in message
    assert "turned by its EXIF data" in refusal(tmp_path, ["a.jpg"], [(40, 24)])
    (own,) = load_masks(tmp_path, ["a.jpg"], [(24, 48)], model_hw=HW)
    assert own.shape == HW


def test_a_mask_is_turned_as_its_own_exif_says(tmp_path):
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    stored = STORED[6](np.dstack([wanted()] * 3))[..., 0]
    save(tmp_path / "a.png", grey(stored), exif=exif)
    (mask,) = load(tmp_path, ["a.jpg"])
    assert (mask == wanted()).all()


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n broken"])
def test_files_that_are_no_images_are_no_masks(tmp_path, content):
    # What is called an image was meant to be one; other files lie beside masks.
    (tmp_path / "a").write_bytes(content)
    assert "have no mask" in refusal(tmp_path, ["a.jpg"])
    (tmp_path / "a.png").write_bytes(content)
    assert "a.png: the file is not a readable image" in refusal(tmp_path, ["a.jpg"])


def test_a_truncated_mask_is_refused(tmp_path):
    noise = np.random.default_rng(0).integers(0, 2, HW).astype(bool)
    whole = save(tmp_path / "a.png", grey(noise)).read_bytes()
    (tmp_path / "a.png").write_bytes(whole[: len(whole) * 2 // 3])
    assert "damaged or truncated" in refusal(tmp_path, ["a.jpg"])
