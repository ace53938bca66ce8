"""Image files of every kind: told by content, upright whatever else their EXIF data say, with the right brightness."""

import errno
import io
import os
import resource
import shutil
import struct
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngImageFile

from data.test_photos import ORIENTATION, STORED, names, quarters, refusal, save
from freegeo.data.datasets.base import read_gray
from freegeo.data.image_files import FORMATS, UnreadableImageError, is_blank
from freegeo.data.masks import load_masks
from freegeo.data.photos import load_photos, open_photos
from freegeo.errors import UserError
from png_header import png_header


def read(path) -> np.ndarray:
    (photo,) = load_photos(path)
    pixels = photo.read()
    assert pixels.shape == (*photo.size_hw, 3)
    return pixels


# -- kinds


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("a.bmp", "BMP"), ("a.avif", "AVIF"), ("a.jfif", "JPEG"), ("a.jpe", "JPEG"), ("a.ppm", "PPM"),
        ("a.mpo", "MPO"), ("a.gif", "GIF"), ("a.jp2", "JPEG2000"), ("a.png", "JPEG"), ("a.jpg", "TIFF"),
        ("a.HEIC", "JPEG"), ("a.photo", "PNG"), ("a", "WEBP"),
    ],
)  # fmt: skip
def test_images_are_told_by_their_content(tmp_path, name, kind):
    save(tmp_path / name, format=kind)
    assert names(tmp_path) == names(tmp_path / name) == [name]
    assert np.median(np.abs(read(tmp_path / name).astype(int) - quarters())) <= 8


def test_grey_maps_and_bitmaps(tmp_path):
    ramp = np.arange(240, dtype=np.uint8).reshape(12, 20)
    save(tmp_path / "a.pgm", ramp, mode="L")
    assert (read(tmp_path / "a.pgm") == ramp[..., None]).all()
    save(tmp_path / "b.pbm", ramp, mode="1")
    assert set(np.unique(read(tmp_path / "b.pbm"))) == {0, 255}


@pytest.mark.parametrize("name", ["a.jpg", "a.eps", "a"])
@pytest.mark.parametrize("content", [b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", b"%PDF-1.4\n", b"GIMP"])
def test_files_for_which_pillow_would_start_programs_or_guess_are_refused(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    assert "not a readable image" in refusal(tmp_path / name) or "not a photo" in refusal(tmp_path / name)


@pytest.mark.parametrize("opening", ["pathlib.Path.open", "PIL.Image.open"])
def test_a_photo_is_not_to_blame_for_the_limit_of_open_files(tmp_path, monkeypatch, opening):
    """Else it would be called damaged, or left out where that is allowed."""
    save(tmp_path / "a.png")

    def refuse(*arguments, **options):
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(opening, refuse)
    with pytest.raises(OSError, match="Too many open files"):
        load_photos(tmp_path, skip_bad=True)


def test_spider_and_raw_files_are_no_photos(tmp_path):
    # Under its own ending first, since Pillow registers the ending that it is saved under.
    Image.fromarray(np.zeros((8, 8), np.float32)).save(tmp_path / "a.spider", format="SPIDER")
    (tmp_path / "a.spider").rename(tmp_path / "a.png")
    assert "not a readable image" in refusal(tmp_path / "a.png")
    save(tmp_path / "shot.NEF", format="TIFF")
    assert "not a photo" in refusal(tmp_path / "shot.NEF")
    assert not {"EPS", "SPIDER", "WMF", "HDF5"} & set(FORMATS)


def test_only_the_first_picture_of_an_animation_is_used_and_that_is_said(tmp_path, caplog):
    first, second = Image.fromarray(quarters()), Image.fromarray(255 - quarters())
    for name in ("a.gif", "b.webp", "c.png", "d.tif"):
        first.save(
            tmp_path / name, save_all=True, append_images=[second], **({"lossless": True} if "w" in name else {})
        )
        assert np.abs(read(tmp_path / name).astype(int) - quarters()).max() <= 2
        assert f"only the first picture is used of files that hold several: {name}" in caplog.text
    caplog.clear()
    first.save(tmp_path / "e.jpg", format="MPO", save_all=True, append_images=[second])  # a phone's portrait
    read(tmp_path / "e.jpg")
    assert not caplog.text


# -- orientation


def exif_block(entries, order=b"II*\0", extra=b"") -> bytes:
    """Tags (tag, type, count, four bytes) as an EXIF block."""
    mark = "<" if order[:2] == b"II" else ">"
    fields = b"".join(struct.pack(f"{mark}HHL", tag, kind, count) + value for tag, kind, count, value in entries)
    return b"Exif\0\0" + order + struct.pack(f"{mark}LH", 8, len(entries)) + fields + struct.pack("<L", 0) + extra


SIX = (ORIENTATION, 3, 1, struct.pack("<HH", 6, 0))


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
@pytest.mark.parametrize(
    "block",
    [
        exif_block([SIX, (0x011A, 10, 1, struct.pack("<L", 38))], extra=struct.pack("<ll", -72, 1)),
        exif_block([SIX, (0x0132, 11, 1, struct.pack("<f", 1.0))]),
        exif_block([(0x010F, 2, 2**31, struct.pack("<L", 2**31)), SIX]),
        exif_block([(0x010F, 99, 7, b"abcd"), SIX, (0x8769, 4, 1, struct.pack("<L", 2**30))]),
    ],
    ids=["negative resolution", "date as float", "pointer out of the block", "unknown type"],
)
@pytest.mark.filterwarnings("ignore::UserWarning:PIL")
def test_senseless_fields_do_not_keep_a_photo_from_being_turned(tmp_path, caplog, suffix, block):
    stored = Image.fromarray(np.ascontiguousarray(STORED[6](quarters())))
    stored.save(tmp_path / f"a{suffix}", exif=block, quality=95)
    pixels = read(tmp_path / f"a{suffix}")
    assert pixels.shape == (24, 40, 3)
    assert np.median(np.abs(pixels.astype(int) - quarters())) <= 8
    assert not caplog.text


@pytest.mark.parametrize("block", [exif_block([SIX], order=b"IM*\0"), exif_block([SIX])[:12], b"Exif\0\0nonsense"])
def test_damaged_exif_is_no_damaged_image_but_said(tmp_path, caplog, block):
    save(tmp_path / "a.webp", exif=block, lossless=True)
    assert (read(tmp_path / "a.webp") == quarters()).all()
    assert "damaged EXIF data do not say how these photos are turned: a.webp" in caplog.text


@pytest.mark.filterwarnings("ignore::UserWarning:PIL")
@pytest.mark.parametrize("suffix", [".jpg", ".tif"])
def test_photos_with_random_bytes_in_their_exif_are_read(tmp_path, suffix):
    exif = Image.Exif()
    for tag, value in {ORIENTATION: 6, 0x010F: "Maker", 0x011A: 72.0, 0x0132: "2024:01:01 00:00:00"}.items():
        exif[tag] = value
    exif.get_ifd(0x8769).update({0x829A: 0.02, 0x9003: "2024:01:01 00:00:00", 0x927C: b"x" * 20})
    exif.get_ifd(0x8825).update({1: "N", 2: (1.0, 2.0, 3.0)})
    path = save(tmp_path / f"a{suffix}", np.ascontiguousarray(STORED[6](quarters())), exif=exif)
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    first = whole.index(b"Exif\0\0") + 6 if suffix == ".jpg" else whole.index(b"Maker")
    span = len(exif.tobytes()) - 6 if suffix == ".jpg" else len(whole) - first
    turned = 0
    for _ in range(100):
        content = bytearray(whole)
        for place in rng.integers(first, first + span, rng.integers(1, 7)):
            content[place] = rng.integers(256)
        path.write_bytes(content)
        turned += read(path).shape == (24, 40, 3)
    assert turned > 80, "only a changed orientation may turn the photo differently"


def test_images_in_memory_with_senseless_exif():
    turned = Image.fromarray(np.ascontiguousarray(STORED[6](quarters())))
    turned.info["exif"] = exif_block([SIX, (0x0132, 11, 1, struct.pack("<f", 1.0))])
    (photo,) = load_photos([turned])
    assert (photo.read() == quarters()).all()


# -- brightness


def true_grey() -> np.ndarray:
    """A grey picture (24, 40) that is neither dark nor bright and reaches 255."""
    return np.linspace(10, 255, 24 * 40).reshape(24, 40).round()


def gap(path) -> float:
    return float(np.abs(read(path).astype(float).mean(2) - true_grey()).max())


@pytest.mark.parametrize("white", [1.0, 255.0])
def test_floats_are_scaled_by_their_range(tmp_path, white):
    save(tmp_path / "a.tif", (true_grey() / 255 * white).astype(np.float32), mode="F")
    assert gap(tmp_path / "a.tif") <= 1


@pytest.mark.parametrize("change", [lambda v: v * 7, lambda v: v - 0.5, lambda v: v * np.nan, lambda v: v * 65535])
def test_floats_that_are_no_brightness_are_refused(tmp_path, change):
    save(tmp_path / "a.tif", change(true_grey() / 255).astype(np.float32), mode="F")
    assert "save it with 8 bits a channel" in refusal(tmp_path / "a.tif")


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("name", ["a.png", "b.tif", "colour.png", "colour.tif"])
def test_values_of_fewer_bits_in_files_of_sixteen(tmp_path, caplog, bits, name):
    values = (true_grey() * ((2**bits - 1) / 255)).astype(np.uint16)
    values = np.dstack([values] * 3) if "colour" in name else values
    assert cv2.imwrite(str(tmp_path / name), values)
    assert gap(tmp_path / name) <= 1.1
    assert ("brightened" in caplog.text) == (bits < 16)


def test_sixteen_bits_of_colour_are_turned_and_not_mixed_up(tmp_path):
    stored = np.ascontiguousarray(STORED[6](quarters())).astype(np.uint16) * 257
    cv2.imwrite(str(tmp_path / "a.png"), stored[..., ::-1])
    cv2.imwrite(str(tmp_path / "b.tif"), stored[..., ::-1])
    cv2.imwrite(str(tmp_path / "c.ppm"), stored[..., ::-1])
    for name in ("a.png", "b.tif", "c.ppm"):
        assert (read(tmp_path / name) == STORED[6](quarters())).all()
    opacity = np.full((*stored.shape[:2], 1), 65535, np.uint16)
    opacity[:4] = 0
    cv2.imwrite(str(tmp_path / "d.png"), np.dstack([stored[..., ::-1] // 16, opacity]))
    pixels = read(tmp_path / "d.png")
    assert (pixels[:4] == 255).all()
    assert (pixels[4:] == STORED[6](quarters())[4:]).all()


def test_a_dark_photo_of_twelve_bits_stays_darker_than_the_others(tmp_path):
    for name, share in (("a.png", 1), ("b.png", 0.2)):
        Image.fromarray((true_grey() * 16 * share).astype(np.uint16)).save(tmp_path / name)
    bright, dark = (photo.read().mean() for photo in load_photos(tmp_path))
    assert dark == pytest.approx(0.2 * bright, rel=0.02)
    (alone,) = open_photos([tmp_path / "a.png"])
    assert alone.read().mean() == pytest.approx(bright, rel=0.01)


def test_more_than_sixteen_bits_are_refused(tmp_path):
    save(tmp_path / "a.tif", (true_grey() * 1000).astype(np.int32), mode="I")
    assert "its values go from" in refusal(tmp_path / "a.tif")


@pytest.mark.parametrize("value", [0, 6, 128, 254, 255])
def test_blank_photos_are_named_once(tmp_path, caplog, value):
    save(tmp_path / "a.png")
    for name in ("b.png", "c.png"):
        save(tmp_path / name, np.full((24, 40, 3), value, np.uint8))
    load_photos([tmp_path / "a.png", tmp_path / "b.png", tmp_path / "c.png", np.full((9, 9, 3), value, np.uint8)])
    assert "3 of 4 photos are almost black, white or of one colour: b.png, c.png, image-003." in caplog.text


def test_dark_and_bright_pictures_with_content_are_not_blank():
    rng = np.random.default_rng(0)
    night = np.kron(rng.integers(0, 60, (12, 20), dtype=np.uint8), np.ones((20, 20), np.uint8))
    assert not is_blank(night)
    assert not is_blank(255 - night)
    noise = rng.normal(128, 5, (240, 400)).clip(0, 255).astype(np.uint8)
    assert is_blank(noise), "a lens cap in noise"


# -- other formats of Pillow, of which some start programs


def others() -> dict[str, bytes]:
    """A file in every format that Pillow can write and that is not read."""
    Image.init()
    found = {}
    for kind in sorted(set(Image.SAVE) - {*FORMATS, "MPO", "HEIF"}):
        for mode in ("RGB", "L", "1", "P", "F"):
            buffer = io.BytesIO()
            try:
                Image.new(mode, (64, 64)).save(buffer, kind)
            except (OSError, ValueError, KeyError):
                continue
            found[kind] = buffer.getvalue()
            break
    return found


@pytest.mark.filterwarnings("ignore:IM image format is deprecated")
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".gif", ""])
def test_other_formats_are_refused_whatever_they_are_called(tmp_path, monkeypatch, suffix):
    def start(*arguments, **options):
        pytest.fail("a program was started")

    monkeypatch.setattr(subprocess.Popen, "__init__", start)
    kinds = others()
    assert {"EPS", "SPIDER", "TGA", "PCX", "ICO", "DDS"} <= kinds.keys()
    for content in kinds.values():
        (tmp_path / "photos").mkdir()
        file = tmp_path / "photos" / f"a{suffix}"
        file.write_bytes(content)
        with pytest.raises(UserError, match=r"not a photo|not a readable image|no photos found"):
            load_photos(file)
        with pytest.raises(UnreadableImageError):
            read_gray(file)
        with pytest.raises(UserError, match="not a readable image" if suffix else "have no mask"):
            load_masks(file.parent, ["a.jpg"], [(64, 64)])
        shutil.rmtree(file.parent)


# -- files that announce more than they hold


def announced(kind: str, side: int) -> bytes:
    """Return a small file that says it has so many pixels a side."""
    if kind == "PNG":
        return png_header(side, side)
    out = io.BytesIO()
    frame = Image.fromarray(np.arange(256, dtype=np.uint8).reshape(16, 16)).convert("RGB")
    frame.save(out, kind, **({"save_all": True, "append_images": [frame.rotate(90)]} if kind == "WEBP" else {}))
    content, size = bytearray(out.getvalue()), struct.pack(">HH", side, side)
    if kind == "JPEG":
        start = content.index(b"\xff\xc0") + 5
        content[start : start + 4] = size
    elif kind == "WEBP":
        content[24:30] = 2 * (side - 1).to_bytes(3, "little")
    else:
        # Width and length of a TIFF are the first two entries of its table.
        table = content.index(struct.pack("<HHI", 256, 4, 1))
        content[table + 8 : table + 12] = content[table + 20 : table + 24] = struct.pack("<I", side)
    return bytes(content)


@pytest.mark.parametrize("door", [lambda path: load_photos([path])[0].read(), read_gray], ids=["photo", "map"])
def test_an_image_that_does_not_fit_into_memory_is_named(tmp_path, monkeypatch, door):
    def fail(image):
        raise MemoryError

    path = tmp_path / "a.png"
    save(path)
    monkeypatch.setattr(PngImageFile, "load", fail)
    with pytest.raises(UnreadableImageError, match=r"a\.png: \d+ x \d+ pixels do not fit into memory"):
        door(path)


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "TIFF", "WEBP"])
@pytest.mark.parametrize("door", ["photo", "mask", "map"])
def test_an_image_that_announces_too_many_pixels_is_refused_before_there_is_room_for_them(tmp_path, kind, door):
    path = tmp_path / f"a.{kind.lower()}"
    path.write_bytes(announced(kind, 60_000))
    read = {
        "photo": lambda: load_photos([path])[0].read(),
        "mask": lambda: load_masks(tmp_path, ["a.jpg"], [(16, 16)]),
        "map": lambda: read_gray(path),
    }[door]
    before = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + (1 << 30), before[1]))
    try:
        with pytest.raises(UserError) as refused:
            read()
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
    assert "more than the limit of 150 megapixels" in str(refused.value)


@pytest.mark.parametrize("door", [lambda path: load_photos([path]), read_gray], ids=["photo", "map"])
def test_a_jpeg_that_is_too_small_for_its_pixels_is_refused_before_there_is_room_for_them(tmp_path, door):
    """Its decoder would make grey of what is missing, 432 MB of it."""
    (tmp_path / "a.jpg").write_bytes(announced("JPEG", 12_000))
    with pytest.raises(UserError, match=r"damaged or truncated \(\d+ bytes are too few for a JPEG of 12000 x 12000"):
        door(tmp_path / "a.jpg")


@pytest.mark.parametrize("mode", ["RGB", "L"])
def test_a_plain_jpeg_is_not_too_small_for_its_pixels(tmp_path, mode):
    Image.new(mode, (2048, 2048)).save(tmp_path / "a.jpg", quality=5, optimize=True)
    (photo,) = load_photos([tmp_path / "a.jpg"])
    assert photo.size_hw == (2048, 2048)
