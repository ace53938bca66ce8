"""Photos from folders, patterns and lists: which, in what order, how upright and in what colours; and every refusal."""

import builtins
import logging
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from freegeo.cli.files import FileOptions, FilterOptions
from freegeo.data import image_files
from freegeo.data.image_files import MAX_PIXELS
from freegeo.data.photos import MemoryPhoto, evenly_spaced, load_photos, natural_key, unique_names
from freegeo.errors import UserError
from freegeo.files import RUN_FILE
from png_header import png_header

ORIENTATION = 0x0112
# How the upright picture has to be turned before it is stored with each orientation (EXIF 2.32, tag 274).
STORED = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.transpose(1, 0, 2),
    6: lambda a: np.rot90(a, 1),
    7: lambda a: np.rot90(a, 2).transpose(1, 0, 2),
    8: lambda a: np.rot90(a, -1),
}


def quarters(height=24, width=40) -> np.ndarray:
    """Red, green, blue and white quarters: every turn and mirror of it is another picture."""
    pixels = np.zeros((height, width, 3), np.uint8)
    top, left = height // 2, width // 2
    pixels[:top, :left, 0] = pixels[:top, left:, 1] = pixels[top:, :left, 2] = 255
    pixels[top:, left:] = 255
    return pixels


def save(path: Path, pixels: np.ndarray | None = None, mode: str = "RGB", **options) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(quarters() if pixels is None else pixels).convert(mode).save(path, **options)
    return path


def names(source, **options) -> list[str]:
    return [photo.name for photo in load_photos(source, **options)]


def refusal(source) -> str:
    """Return the sentence with which a source is refused, at the latest when the pixels are read."""
    with pytest.raises(UserError) as caught:
        for photo in load_photos(source):
            photo.read()
    message = str(caught.value)
    assert "\n" not in message
    assert message.endswith(".")
    return message


# -- which photos, in what order


def test_folder_is_read_in_natural_order(tmp_path):
    for name in ("frame10.png", "frame2.PNG", "Frame1.jpg", "a.webp", "b.tiff", "c.tif", "d.jpeg"):
        save(tmp_path / name)
    save(tmp_path / ".hidden.png")
    save(tmp_path / "sub" / "x.png")
    for system in ("Thumbs.db", "desktop.ini", ".DS_Store"):
        (tmp_path / system).write_bytes(b"x")
    expected = ["a.webp", "b.tiff", "c.tif", "d.jpeg", "Frame1.jpg", "frame2.PNG", "frame10.png"]
    assert names(tmp_path) == names(str(tmp_path)) == expected


def test_pattern_list_and_single_file(tmp_path):
    files = [save(tmp_path / f"{k}.png") for k in (11, 2, 1)]
    (tmp_path / "notes.txt").write_text("")
    assert names(f"{tmp_path}/*.png") == ["1.png", "2.png", "11.png"]
    assert names(files) == names([str(f) for f in files]) == ["11.png", "2.png", "1.png"]
    assert names(files[0]) == ["11.png"]
    save(tmp_path / "deep" / "er" / "3.png")
    assert names(f"{tmp_path}/**/*.png") == ["1.png", "2.png", "11.png", "3.png"]


@pytest.mark.parametrize("folder", ["day[1]", "scan [final]", "a*b", "what?", "x/[y]"])
def test_a_folder_that_exists_is_a_name_whatever_its_characters(tmp_path, folder):
    save(tmp_path / folder / "a.png")
    save(tmp_path / folder / "b[2].jpg")
    save(tmp_path / "day1" / "other.png")
    assert names(tmp_path / folder) == ["a.png", "b[2].jpg"]
    assert names(f"{tmp_path}/{folder}/*") == ["a.png", "b[2].jpg"]
    assert names(f"{tmp_path}/{folder}/?.png") == names(f"{tmp_path}/{folder}/[ab].png") == ["a.png"]
    assert names(f"{tmp_path}/{folder}/b[2].jpg") == ["b[2].jpg"]


def test_patterns_relative_to_the_working_folder(tmp_path, monkeypatch):
    save(tmp_path / "p" / "a.png")
    (tmp_path / "q").mkdir()
    monkeypatch.chdir(tmp_path / "q")
    assert names("../p/*.png") == names("../*/a.png") == ["a.png"]
    monkeypatch.chdir(tmp_path / "p")
    assert names("*.png") == ["a.png"]


def test_at_most_max_views_evenly_first_and_last_included(tmp_path, caplog):
    for k in range(10):
        save(tmp_path / f"{k}.png")
    with caplog.at_level(logging.INFO, "freegeo"):
        assert names(tmp_path, max_views=4) == ["0.png", "3.png", "6.png", "9.png"]
    assert "10 photos found, 4 kept" in caplog.text
    assert len(names(tmp_path, max_views=10)) == 10
    assert names(tmp_path, max_views=1) == ["0.png"]
    with pytest.raises(UserError, match="--max-views"):
        load_photos(tmp_path, max_views=0)


@given(st.integers(1, 300), st.integers(1, 300))
def test_even_choice_is_ascending_distinct_and_even(count, keep):
    chosen = evenly_spaced(count, keep)
    assert len(chosen) == min(count, keep)
    assert chosen[0] == 0
    steps = np.diff(chosen)
    assert (steps >= 1).all()
    if len(chosen) > 1:
        assert chosen[-1] == count - 1
        assert steps.max() - steps.min() <= 1


@given(st.lists(st.text(min_size=1, max_size=8), min_size=1, max_size=8))
def test_natural_order_exists_for_every_name(texts):
    ordered = sorted((Path("folder") / text.replace("/", "_") for text in texts), key=natural_key)
    assert len(ordered) == len(texts)


@given(st.lists(st.integers(0, 10**6), min_size=2, max_size=8, unique=True))
def test_natural_order_is_the_order_of_the_numbers(numbers):
    ordered = sorted((Path(f"a/img_{n}_x.jpg") for n in numbers), key=natural_key)
    assert [int(path.stem.split("_")[1]) for path in ordered] == sorted(numbers)


def test_same_names_in_several_folders_are_told_apart(tmp_path):
    files = [save(tmp_path / folder / "a.png") for folder in ("left", "right")]
    assert names(files) == ["left/a.png", "right/a.png"]
    assert "listed twice" in refusal([files[0], files[0]])
    with pytest.raises(UserError, match="listed twice"):
        unique_names([Path("/x/a.png"), Path("/x/a.png")])
    with pytest.raises(UserError, match=r"x/../x/a.png is listed twice"):
        unique_names([Path("x/a.png"), Path("x/../x/a.png")])


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        (["../x/p.png", "../../x/p.png"], ["one/x/p.png", "x/p.png"]),
        (["p.png", "../p.png"], ["two/p.png", "one/p.png"]),
        (["../../p.png", "q.png"], ["p.png", "q.png"]),
        (["./a.png", "b/../b/a.png"], ["two/a.png", "b/a.png"]),
    ],
)
def test_names_of_photos_stay_below_a_folder(tmp_path, monkeypatch, files, expected):
    (tmp_path / "one" / "two" / "b").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "one" / "two")
    for file in files:
        save(Path(file))
    found = names(files)
    assert all(name.endswith(end) for name, end in zip(found, expected, strict=True))
    assert all(".." not in Path(name).parts and not Path(name).is_absolute() for name in found)


@given(st.lists(st.lists(st.sampled_from(["..", "a", "b"]), max_size=4), min_size=1, max_size=4), st.booleans())
def test_unique_names_are_unique_and_inside(folders, absolute):
    paths = [Path("/" if absolute else "", *parts, "p.png") for parts in folders]
    try:
        found = unique_names(paths)
    except UserError as error:
        assert "listed twice" in str(error)
    else:
        assert len(set(found)) == len(paths)
        assert all(".." not in Path(name).parts and not Path(name).is_absolute() for name in found)


@pytest.mark.parametrize("name", ["/etc/a.png", "../a.png", "x/../../a.png"])
def test_photos_of_other_code_may_not_be_named_out_of_a_folder(name):
    assert f"a photo has the name {name}" in refusal([MemoryPhoto(name, quarters())])


# -- images in memory, videos


def test_images_and_arrays_are_photos(tmp_path):
    file, image = save(tmp_path / "a.png"), Image.fromarray(quarters())
    turned = Image.fromarray(np.ascontiguousarray(STORED[6](quarters())))
    turned.getexif()[ORIENTATION] = 6
    found = load_photos([quarters(), file, image, turned, image.convert("P")])
    assert [p.name for p in found] == ["image-000", "a.png", "image-002", "image-003", "image-004"]
    for photo in found:
        assert photo.size_hw == (24, 40)
        assert (photo.read() == quarters()).all()


def test_one_image_and_a_stack_of_images():
    assert names(quarters()) == names(Image.fromarray(quarters())) == ["image-000"]
    assert names(np.stack([quarters()] * 3)) == ["image-000", "image-001", "image-002"]
    assert names(pixels for pixels in [quarters()] * 2) == ["image-000", "image-001"]


def test_an_array_that_is_changed_later_does_not_change_the_photo():
    pixels = quarters()
    (photo,) = load_photos([pixels])
    pixels[:] = 0
    assert (photo.read() == quarters()).all()


def test_loaded_photos_stay_as_they_are(tmp_path):
    for k in range(5):
        save(tmp_path / f"{k}.png")
    loaded = load_photos(tmp_path)
    assert load_photos(loaded, max_views=2) == loaded
    assert load_photos(tuple(loaded[:3])) == loaded[:3]
    assert len(load_photos([*loaded, quarters()], max_views=2)) == 2
    assert "two photos have the name 1.png" in refusal([loaded[1], loaded[1]])
    assert "two photos have the name 1.png" in refusal([loaded[1], tmp_path / "1.png"])


def test_the_home_folder_may_be_short(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    save(tmp_path / "p" / "a.png")
    for source in ("~/p", Path("~/p"), "~/p/*.png", "~/p/a.png", ["~/p/a.png"]):
        assert names(source) == ["a.png"]


@pytest.mark.parametrize(
    ("pixels", "words"),
    [
        (quarters() / 255, "image-001 is an array of float64 and shape (24, 40, 3)"),
        (quarters().astype(np.int32), "array of int32"),
        (quarters()[..., 0], "shape (24, 40)"),
        (quarters().transpose(2, 0, 1), "shape (3, 24, 40)"),
        (np.zeros((0, 4, 3), np.uint8), "shape (0, 4, 3)"),
        (None, "element 1 of the photos is None"),
        (7, "element 1 of the photos is of the type int"),
    ],
)
def test_images_that_cannot_be_used(pixels, words):
    assert words in refusal([quarters(), pixels])


@pytest.mark.parametrize("source", [None, 3, lambda: None])
def test_what_is_no_source(source):
    assert "not of the type" in refusal(source) or "not None" in refusal(source)


def test_frames_per_second_are_for_videos(tmp_path):
    with pytest.raises(UserError, match="--fps is for videos"):
        load_photos(save(tmp_path / "a.png"), fps=2.0)
    with pytest.raises(UserError, match="no such video"):
        load_photos(tmp_path / "a.mp4", fps=2.0)
    with pytest.raises(UserError, match="empty"):
        load_photos("")


# -- pixels


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tiff"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_photos_are_upright(tmp_path, suffix, orientation):
    stored = Image.fromarray(np.ascontiguousarray(STORED[orientation](quarters())))
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    stored.save(tmp_path / f"a{suffix}", exif=exif, quality=95)
    (photo,) = load_photos(tmp_path)
    assert photo.size_hw == (24, 40)
    pixels = photo.read()
    assert pixels.dtype == np.uint8
    assert pixels.shape == (24, 40, 3)
    # Corners, away from the edges that lossy formats blur.
    for row, column in ((3, 5), (3, 34), (20, 5), (20, 34)):
        assert np.abs(pixels[row, column].astype(int) - quarters()[row, column]).max() < 40


@pytest.mark.parametrize("orientation", [0, 9, 77])
def test_meaningless_orientation_is_ignored(tmp_path, orientation):
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    save(tmp_path / "a.png", exif=exif)
    (photo,) = load_photos(tmp_path)
    assert photo.size_hw == (24, 40)
    assert (photo.read() == quarters()).all()


@pytest.mark.parametrize(
    ("name", "mode"), [("a.png", "RGB"), ("a.png", "P"), ("a.tiff", "RGB"), ("a.tif", "CMYK"), ("a.png", "RGBA")]
)
def test_modes_keep_their_colours(tmp_path, name, mode):
    save(tmp_path / name, mode=mode)
    assert np.abs(load_photos(tmp_path)[0].read().astype(int) - quarters()).max() <= 2


def test_lossless_webp_is_exact(tmp_path):
    save(tmp_path / "a.webp", lossless=True)
    assert (load_photos(tmp_path)[0].read() == quarters()).all()


def test_grey_is_spread_over_the_channels(tmp_path):
    ramp = np.arange(240, dtype=np.uint8).reshape(12, 20)
    save(tmp_path / "a.png", ramp, mode="L")
    assert (load_photos(tmp_path)[0].read() == ramp[..., None]).all()


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_sixteen_bits_are_scaled_not_clipped(tmp_path, name):
    ramp = np.linspace(0, 65535, 240).round().astype(np.uint16).reshape(12, 20)
    Image.fromarray(ramp).save(tmp_path / name)
    pixels = load_photos(tmp_path)[0].read()
    assert np.abs(pixels - ramp[..., None] / 257).max() <= 0.5


def test_transparent_pixels_become_white(tmp_path):
    pixels = np.zeros((4, 4, 4), np.uint8)
    pixels[:2] = (255, 0, 0, 255)
    pixels[2] = (255, 0, 0, 51)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    read = load_photos(tmp_path)[0].read()
    assert (read[0] == (255, 0, 0)).all()
    assert np.abs(read[2].astype(int) - (255, 204, 204)).max() <= 1
    assert (read[3] == 255).all()


def test_palette_with_a_transparent_colour(tmp_path):
    image = Image.fromarray(quarters()).convert("P")
    image.save(tmp_path / "a.png", transparency=image.getpixel((0, 0)))
    read = load_photos(tmp_path)[0].read()
    assert (read[0, 0] == 255).all()
    assert (read[0, -1] == (0, 255, 0)).all()


# -- refusals


def test_no_photos(tmp_path):
    assert "no photos found" in refusal(tmp_path)
    (tmp_path / "notes.txt").write_text("")
    assert "no photos found" in refusal(tmp_path)
    assert "no photos found" in refusal(f"{tmp_path}/*.png")
    assert "no photos found" in refusal([])
    assert "no such folder" in refusal(tmp_path / "missing")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("cameras.json", b"{}"),
        ("IMG_0001.MOV", b"\0\0\0\x14ftypqt  "),
        ("IMG_0001.AAE", b"<?xml"),
        ("scan.pdf", b"%PDF-1.7\n"),
        ("raw.dng", None),
        ("empty", b""),
    ],
)
def test_other_files_in_a_folder_or_pattern_are_left_out_and_named(tmp_path, caplog, name, content):
    save(tmp_path / "a.JPG")
    if content is None:  # raw files are TIFF files whose first image is a thumbnail
        save(tmp_path / name, format="TIFF")
    else:
        (tmp_path / name).write_bytes(content)
    for source in (tmp_path, f"{tmp_path}/*"):
        caplog.clear()
        assert names(source) == ["a.JPG"]
        assert f"1 of 2 files are no photos and are left out: {name}." in caplog.text
    assert f"{name}: " in refusal([tmp_path / "a.JPG", tmp_path / name])


def test_many_other_files_are_counted(tmp_path, caplog):
    save(tmp_path / "a.png")
    for k in range(8):
        (tmp_path / f"{k}.txt").write_text("")
    assert names(tmp_path) == ["a.png"]
    assert "8 of 9 files are no photos and are left out: 0.txt, 1.txt, 2.txt, 3.txt, 4.txt and 3 more." in caplog.text


def test_list_with_something_else_in_it(tmp_path):
    photo = save(tmp_path / "a.png")
    (tmp_path / "notes.txt").write_text("")
    assert "not a photo" in refusal([photo, tmp_path / "notes.txt"])
    assert "b.png: the file cannot be opened (No such file" in refusal([photo, tmp_path / "b.png"])
    assert "a folder among several sources" in refusal([photo, tmp_path])


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tiff", ".heic"])
def test_file_that_is_no_image(tmp_path, suffix):
    (tmp_path / f"a{suffix}").write_bytes(b"no image at all")
    assert f"a{suffix}: the file is not a readable image" in refusal(tmp_path)


def test_all_photos_that_cannot_be_used_are_named_at_once(tmp_path, encoded, caplog):
    for name in ("a.png", "b.png", "e.png"):
        save(tmp_path / name)
    (tmp_path / "c.jpg").write_bytes(encoded[".jpg"][:-400])
    (tmp_path / "d.png").write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    (tmp_path / "f.webp").write_bytes(b"")
    (tmp_path / "g.jpg").symlink_to(tmp_path / "gone.jpg")
    (tmp_path / "h.png").write_bytes(png_header(20_000, 20_000))
    message = refusal(tmp_path)
    assert message.startswith("5 of 8 photos cannot be used: ")
    assert message.endswith(". Replace them, or leave them out with --skip-bad.")
    for words in (
        "c.jpg: the image is damaged or truncated", f"{tmp_path}/d.png, {tmp_path}/f.webp: the file is not a readable",
        "g.jpg: the file cannot be opened (No such file or directory)", "h.png: its pixels are more than the limit",
    ):  # fmt: skip
        assert words in message
    assert names(tmp_path, skip_bad=True) == ["a.png", "b.png", "e.png"]
    assert "5 of 8 photos cannot be used and are left out: " in caplog.text


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("share", [0.4, 0.9, 1])
def test_a_jpeg_that_was_cut_off_and_closed_is_doubted(tmp_path, caplog, share, orientation):
    """It has the mark of its end, so that no decoder finds fault with it."""
    noise = np.random.default_rng(0).integers(0, 256, (160, 96, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(noise).save(tmp_path / "a.jpg", exif=exif)
    data = (tmp_path / "a.jpg").read_bytes()[:-2]
    (tmp_path / "a.jpg").write_bytes(data[: int(len(data) * share)] + b"\xff\xd9")
    load_photos(tmp_path)
    assert ("end in plain grey, as a JPEG does that was cut off: a.jpg" in caplog.text) == (share < 1)


def test_a_grey_border_at_the_side_is_no_end(tmp_path, caplog):
    noise = np.random.default_rng(0).integers(0, 256, (160, 96, 3), dtype=np.uint8)
    noise[:, -32:] = noise[:, :32] = noise[:32] = 128
    Image.fromarray(noise).save(tmp_path / "a.jpg", quality=100)
    load_photos(tmp_path)
    assert "end in plain grey" not in caplog.text


def test_one_bad_photo_among_others(tmp_path, encoded, caplog):
    save(tmp_path / "a.png")
    bad = tmp_path / "b.jpg"
    bad.write_bytes(encoded[".jpg"][:-400])
    assert refusal(tmp_path).startswith(f"{bad}: the image is damaged or truncated (")
    assert refusal(tmp_path).endswith("). Replace it, or leave it out with --skip-bad.")
    assert [p.name for p in load_photos([bad, quarters()], skip_bad=True)] == ["image-001"]
    assert names([tmp_path / "a.png", tmp_path / "gone.png"], skip_bad=True) == ["a.png"]
    with pytest.raises(UserError, match=r"Replace it or take it out\.$"):
        load_photos(bad, skip_bad=True)


def test_photos_that_are_not_kept_are_not_looked_at(tmp_path):
    for k in range(5):
        save(tmp_path / f"{k}.png")
    (tmp_path / "1.png").write_bytes(b"")
    assert names(tmp_path, max_views=3) == ["0.png", "2.png", "4.png"]


def test_where_the_photos_are_instead(tmp_path):
    for name in ("left/1.jpg", "left/2.HEIC", "deep/er/3.png"):
        save(tmp_path / name, format="PNG")
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "x.txt").write_text("")
    for source in (tmp_path, f"{tmp_path}/*"):
        assert f"{tmp_path}/left (2)" in refusal(source)
        assert "`freegeo adapt` takes several" in refusal(source)
        assert "notes" not in refusal(source)
    assert f"in 2 folders: {tmp_path}/deep/er (1), {tmp_path}/left (2)" in refusal(tmp_path)


def test_photos_in_sub_folders_of_a_folder_of_photos_are_named(tmp_path, caplog):
    for name in ("a.png", "day one/1.jpg", "day one/2.HEIC", "deep/er/3.png", ".thumbs/4.jpg", "out/images/5.png"):
        save(tmp_path / name, format="PNG")
    (tmp_path / "out" / RUN_FILE).touch()
    assert names(tmp_path) == ["a.png"]
    found = f"2 hold images: {tmp_path}/day one (2), {tmp_path}/deep/er (1)."
    assert f"{tmp_path}: sub-folders are not searched, and {found}" in caplog.text
    caplog.clear()
    assert names(f"{tmp_path}/*") == ["a.png"]
    assert caplog.text == "", "a pattern says what it is about"


def test_masks_beside_the_photos_are_not_taken_for_photos_but_named_where_they_are_not_used(tmp_path, caplog):
    for name in ("a.png", "b.png", "masks/a.png", "masks/b.png"):
        save(tmp_path / name, format="PNG", pixels=np.full((24, 32, 3), 255, np.uint8))
    photos = load_photos(tmp_path)
    assert [photo.name for photo in photos] == ["a.png", "b.png"]
    assert "sub-folders" not in caplog.text
    FileOptions(filters=FilterOptions(masks=tmp_path / "masks")).checked_masks(photos)
    assert "masks holds images" not in caplog.text
    assert FileOptions().checked_masks(photos) is None
    assert f"{tmp_path}/masks holds images that are not used" in caplog.text


def test_videos_in_place_of_photos(tmp_path):
    for name in ("b.mp4", "a.ts"):
        (tmp_path / name).write_bytes(b"x")
    for source in (tmp_path, f"{tmp_path}/*"):
        assert f"no photos, but 2 videos. Give one video by its name, such as {tmp_path}/a.ts." in refusal(source)
    photo = save(tmp_path / "p.png")
    assert "b.mp4: a video among photos, which has to be given alone" in refusal([photo, tmp_path / "b.mp4"])
    assert "b.mp4: not a readable video" in refusal(f"{tmp_path}/*.mp4")
    (tmp_path / "c.mp4").write_bytes(b"x")
    assert "no photos, but 2 videos" in refusal(f"{tmp_path}/*.mp4")


def test_a_folder_that_is_named_like_a_video(tmp_path):
    save(tmp_path / "IMG_0021.MOV" / "a.png")
    assert names(tmp_path / "IMG_0021.MOV") == names(f"{tmp_path}/IMG_0021.MOV/*") == ["a.png"]


def test_empty_file(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"")
    assert "a.jpg" in refusal(tmp_path)


@pytest.fixture(scope="module")
def encoded(tmp_path_factory) -> dict[str, bytes]:
    """The same noise in every format."""
    import pillow_heif

    pillow_heif.register_heif_opener()
    folder = tmp_path_factory.mktemp("encoded")
    noise = np.random.default_rng(0).integers(0, 256, (40, 48, 3), dtype=np.uint8)
    return {s: save(folder / f"a{s}", noise).read_bytes() for s in (".jpg", ".png", ".webp", ".tiff", ".heic")}


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tiff", ".heic"])
@pytest.mark.parametrize("share", [0.3, 0.9])
def test_truncated_image(tmp_path, encoded, suffix, share):
    data = encoded[suffix]
    (tmp_path / f"a{suffix}").write_bytes(data[: int(len(data) * share)])
    assert f"a{suffix}: the " in refusal(tmp_path)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
@pytest.mark.filterwarnings("ignore::UserWarning:PIL")
def test_damaged_images_are_read_or_refused(tmp_path, encoded, data):
    suffix = data.draw(st.sampled_from(sorted(encoded)))
    content = bytearray(encoded[suffix])
    for _ in range(data.draw(st.integers(1, 12))):
        content[data.draw(st.integers(0, min(len(content), 600) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content)
    try:
        (photo,) = load_photos(path)
        pixels = photo.read()
    except UserError as error:
        assert path.name in str(error)
    else:
        assert pixels.shape == (*photo.size_hw, 3)


@pytest.mark.parametrize("side", [12_248, 20_000])
def test_image_above_the_pixel_limit_is_refused_by_its_header(tmp_path, side, recwarn):
    assert side**2 > MAX_PIXELS
    (tmp_path / "a.png").write_bytes(png_header(side, side))
    assert "more than the limit of 150 megapixels" in refusal(tmp_path)
    assert not recwarn.list


def test_limit_is_ours_not_pillows(tmp_path, monkeypatch, recwarn):
    save(tmp_path / "a.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 600)
    monkeypatch.setattr(image_files, "MAX_PIXELS", 24 * 40)
    (photo,) = load_photos(tmp_path)
    assert (photo.read() == quarters()).all()
    assert not recwarn.list
    monkeypatch.setattr(image_files, "MAX_PIXELS", 24 * 40 - 1)
    assert "40 x 24 pixels are more than the limit" in refusal(tmp_path)


def test_heic_without_the_extra_names_it(tmp_path, encoded, monkeypatch):
    (tmp_path / "a.jpg").write_bytes(encoded[".heic"])
    plain = builtins.__import__

    def without_heif(name, *args, **options):
        if name == "pillow_heif":
            raise ImportError(name)
        return plain(name, *args, **options)

    monkeypatch.setattr(builtins, "__import__", without_heif)
    assert "freegeo[heif]" in refusal(tmp_path)


def test_heic_with_the_extra(tmp_path, encoded):
    (tmp_path / "a.HEIC").write_bytes(encoded[".heic"])
    (photo,) = load_photos(tmp_path)
    assert photo.read().shape == (40, 48, 3)
