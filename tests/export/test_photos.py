"""Copies of the photos are what every reader takes for upright, under the names that the cameras refer to."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from data.test_photos import ORIENTATION, STORED
from exact_rooms import room
from freegeo.data.photos import MemoryPhoto, Photo, load_photos
from freegeo.errors import UserError
from freegeo.export.formats import export
from freegeo.export.photos import copy_names, own_file, photo_records, write_copies
from freegeo.files import LEDGER_FILE

LANDSCAPE, PORTRAIT = (96, 128), (128, 96)


def picture(hw=(24, 40)) -> np.ndarray:
    """A smooth image that no turn or mirror maps to itself."""
    row, column = np.mgrid[: hw[0], : hw[1]] / np.array(hw)[:, None, None]
    return np.stack((255 * row, 255 * column, 128 * row * column), -1).astype(np.uint8)


def plain(path: Path) -> np.ndarray:
    """An image as a reader without EXIF sees it."""
    with Image.open(path) as image:
        assert image.mode == "RGB"
        return np.array(image)


def stored(path: Path, upright: np.ndarray, orientation: int, **options) -> Path:
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.ascontiguousarray(STORED[orientation](upright))).save(path, exif=exif, **options)
    return path


@pytest.mark.parametrize("suffix", [".jpg", ".JPEG", ".png"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_turned_photos_become_upright_and_upright_ones_stay_byte_for_byte(tmp_path, orientation, suffix):
    options = {} if suffix == ".png" else {"quality": 95, "subsampling": 0}
    file = stored(tmp_path / "in" / f"a{suffix}", picture(), orientation, **options)
    (copy,) = write_copies(load_photos([file]), tmp_path / "out")
    assert copy.name == file.name
    assert (copy.read_bytes() == file.read_bytes()) == (orientation == 1)
    assert np.abs(plain(copy).astype(int) - picture()).mean() < 2


def make(kind: str, folder: Path) -> Photo | MemoryPhoto:
    """A photo that readers without freegeo's rules would see otherwise, or not at all."""
    grey16 = (np.arange(24 * 40).reshape(24, 40) * 60).astype(np.uint16)
    image = Image.fromarray(picture())
    if kind == "memory":
        return MemoryPhoto("image-000", picture())
    if kind == "heic":
        pytest.importorskip("pillow_heif", reason="needs the extra heif").register_heif_opener()
    file = folder / {
        "16 bit": "a.png",
        "alpha": "a.png",
        "palette": "a.png",
        "disguised": "a.png",
        "cmyk": "a.jpg",
    }.get(kind, f"a.{kind}")
    if kind == "16 bit":
        Image.fromarray(grey16).save(file)
    elif kind == "alpha":
        image.putalpha(128)
        image.save(file)
    elif kind == "palette":
        image.quantize(16).save(file)
    elif kind == "cmyk":
        image.convert("CMYK").save(file)
    elif kind == "disguised":
        image.save(file, format="JPEG")
    else:
        image.save(file)
    (photo,) = load_photos([file])
    return photo


@pytest.mark.parametrize(
    "kind", ["16 bit", "alpha", "palette", "cmyk", "disguised", "webp", "tif", "heic", "memory", "mp4"]
)
def test_other_kinds_become_what_every_reader_reads(tmp_path, kind):
    if kind == "mp4":
        pytest.importorskip("av")
        photo = replace_path(make("memory", tmp_path), "walk_000012.png", tmp_path / "walk.mp4")
    else:
        photo = make(kind, tmp_path)
    (copy,) = write_copies([photo], tmp_path / "out")
    assert copy.suffix in (".jpg", ".png")
    with Image.open(copy) as image:
        assert image.format == {".jpg": "JPEG", ".png": "PNG"}[copy.suffix], "the name says what it is"
    difference = np.abs(plain(copy).astype(int) - photo.read())
    assert difference.mean() < (3 if copy.suffix == ".jpg" else 1e-9)


def replace_path(photo: MemoryPhoto, name: str, path: Path):
    """A frame of a video: in memory here, with the path of a file that is no image."""
    frame = type("Frame", (), {"name": name, "path": path, "size_hw": photo.size_hw, "read": photo.read})
    assert own_file(frame()) is None
    return frame()


def test_names_of_copies_stay_apart_and_keep_their_folders():
    assert copy_names(["a.jpg", "s/b.JPEG", "c.png", "d"]) == ["a.jpg", "s/b.JPEG", "c.png", "d.png"]
    assert copy_names(["a.heic", "b.tif", "c.webp"]) == ["a.jpg", "b.png", "c.jpg"]
    assert copy_names(["a.heic", "a.jpg"]) == ["a.heic.jpg", "a.jpg"]
    assert len(set(copy_names(["a.heic", "a.jpg", "a.heic.jpg", "a.tif", "a.png"]))) == 5


def test_a_photo_that_has_gone_is_one_failed_format(tmp_path):
    scene = room()
    files = [stored(tmp_path / f"photo {i}.JPG", picture(LANDSCAPE), 1) for i in range(4)]
    photos = load_photos(files)
    files[2].unlink()
    result = export(scene, tmp_path / "out", ["nerfstudio", "ply"], photos=photos)
    assert "photo 2.JPG" in result.failed["nerfstudio"]
    assert [file.name for file in result.files] == ["points.ply"]
    assert [record is None for record in photo_records(photos)] == [False, False, True, False]


class LostPhotos(list):
    """Photos in memory that cannot be read any more after some reads."""

    def __init__(self, scene, reads: int, error: type[BaseException]):
        self.reads, self.error = reads, error
        super().__init__(_LostPhoto(self, name, hw) for name, hw in zip(scene.names, scene.photo_hw, strict=True))


class _LostPhoto(MemoryPhoto):
    def __init__(self, all_of_them, name, hw):
        super().__init__(name, np.full((*hw, 3), 9, np.uint8))
        object.__setattr__(self, "all_of_them", all_of_them)

    def read(self):
        self.all_of_them.reads -= 1
        if self.all_of_them.reads < 0:
            raise self.all_of_them.error("it was moved")
        return super().read()


@pytest.mark.parametrize(
    ("format", "reads", "error"),
    [
        ("nerfstudio", 1, KeyboardInterrupt),
        ("nerfstudio", 3, KeyboardInterrupt),
        ("nerfstudio", 3, UserError),
        ("depth", 1, KeyboardInterrupt),
        ("depth", 1, UserError),
        ("depth-color", 1, KeyboardInterrupt),
    ],
)
def test_a_format_that_stops_half_way_leaves_nothing_half_written(tmp_path, format, reads, error):
    scene, nearer = room(2, (24, 32)), replace(room(2, (24, 32)), depth_z=room(2, (24, 32)).depth_z / 2)
    options = {"masks": np.ones(scene.depth_z.shape, bool), "depth_size": "photo"}

    def files(folder):
        return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}

    for earlier in (False, True):
        out = tmp_path / str(earlier)
        if earlier:
            export(scene, out, [format], photos=LostPhotos(scene, 99, error), **options)
        before = files(out)
        lost = LostPhotos(scene, reads, error)
        if error is KeyboardInterrupt:
            with pytest.raises(KeyboardInterrupt):
                export(nearer, out, [format], photos=lost, **options)
        else:
            assert list(export(nearer, out, [format], photos=lost, **options).failed) == [format]
        after = files(out)
        assert {name.split("/")[0] for name in after} <= {LEDGER_FILE, "images", "points.ply"} | (
            {format} if earlier and error is KeyboardInterrupt else set()
        )
        assert {name for name in after if name.startswith("images/")} in (
            {f"images/{name}" for name in scene.names},
            set(),
        )
        assert all(after[name] == before[name] for name in after if name.startswith("depth"))


def test_other_photos_than_the_reconstruction_s_are_refused(tmp_path):
    scene = room()
    photos = [MemoryPhoto(name, np.zeros((*LANDSCAPE, 3), np.uint8)) for name in scene.names]
    for wrong in ([], photos[:3], photos[::-1], [*photos[:3], MemoryPhoto("photo 3.JPG", picture())]):
        with pytest.raises(UserError, match="Give the same"):
            export(scene, tmp_path, ["nerfstudio"], photos=wrong)
    assert list(tmp_path.iterdir()) == []


def test_copies_that_are_not_written_again_go_and_those_of_others_stay(tmp_path):
    scene = room()
    photos = [MemoryPhoto(name, np.zeros((*LANDSCAPE, 3), np.uint8)) for name in scene.names]
    export(scene, tmp_path, ["nerfstudio"], photos=photos)
    (tmp_path / "images" / "mine.jpg").write_text("mine")
    renamed = replace(scene, names=("b.jpg", *scene.names[1:]))
    export(renamed, tmp_path, ["nerfstudio"], photos=[MemoryPhoto("b.jpg", photos[0].pixels), *photos[1:]])
    names = {p.name for p in (tmp_path / "images").iterdir()}
    assert names == {"b.jpg", "mine.jpg", *scene.names[1:]}


def test_both_folders_of_copies_are_whole_without_links(tmp_path, monkeypatch):
    pytest.importorskip("pycolmap", reason="needs the extra colmap")

    def refuse(*paths):
        raise OSError(95, "Operation not supported")

    scene = room()
    photos = [MemoryPhoto(name, np.full((*LANDSCAPE, 3), 9, np.uint8)) for name in scene.names]
    monkeypatch.setattr("os.link", refuse)
    export(scene, tmp_path, ["colmap", "nerfstudio"], photos=photos, max_tracks=20)
    for folder in ("images", "colmap/images"):
        assert [p.name for p in sorted((tmp_path / folder).iterdir())] == list(scene.names)
        assert (plain(tmp_path / folder / scene.names[0]) == 9).all()


def test_without_the_photos_the_cameras_are_written_with_a_warning(tmp_path, caplog):
    result = export(room(), tmp_path, ["nerfstudio"])
    assert result.failed == {}
    assert "The photos are not at hand" in caplog.text
    assert not (tmp_path / "images").exists()


# -- the photos of eight orientations, in two sub-folders, in both shapes


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    """The folder of an export whose photos show the room, stored in every way; portraits are stretched."""
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    folder = tmp_path_factory.mktemp("turned")
    scene = room(8, (48, 64), 7)
    sizes = [PORTRAIT if view % 3 == 1 else LANDSCAPE for view in range(8)]
    paths = []
    for view, (height, width) in enumerate(sizes):
        upright = np.array(Image.fromarray(scene.images[view]).resize((width, height), Image.Resampling.NEAREST))
        path = folder / "in" / "ab"[view % 2] / f"IMG_{view // 2}.jpg"
        paths.append(stored(path, upright, view + 1, quality=95, subsampling=0))
    photos = load_photos(paths)
    assert [photo.size_hw for photo in photos] == sizes
    scene = replace(
        scene,
        names=tuple(photo.name for photo in photos),
        photo_hw=np.array(sizes),
        scale_xy=np.array([(64 / width, 48 / height) for height, width in sizes]),
    )
    export(scene, folder / "out", ["colmap", "nerfstudio"], photos=photos, max_tracks=400)
    return folder / "out", photos


def test_undistorting_pairs_every_camera_with_its_upright_photo(turned, tmp_path):
    import pycolmap

    out, photos = turned
    pycolmap.undistort_images(str(tmp_path), str(out / "colmap/sparse/0"), str(out / "colmap/images"))
    model = pycolmap.Reconstruction(tmp_path / "sparse")
    assert {image.name for image in model.images.values()} == {photo.name for photo in photos}
    upright = {photo.name: photo.read().astype(int) for photo in photos}
    differences = []
    for image in model.images.values():
        pixels = plain(tmp_path / "images" / image.name).astype(int)
        assert pixels.shape[:2] == (image.camera.height, image.camera.width)
        assert np.abs(pixels - upright[image.name]).mean() < 2
        for point in image.points2D:
            column, row = np.floor(point.xy).astype(int)
            differences.append(np.abs(pixels[row, column] - model.point3D(point.point3D_id).color).mean())
    assert len(differences) > 400
    assert np.mean(differences) < 12


def test_nerfstudio_sees_the_sizes_that_its_cameras_have(turned):
    out, photos = turned
    frames = json.loads((out / "transforms.json").read_text())["frames"]
    for frame, photo in zip(frames, photos, strict=True):
        pixels = plain(out / frame["file_path"])
        assert pixels.shape[:2] == (frame["h"], frame["w"])
        assert np.abs(pixels.astype(int) - photo.read()).mean() < 2


def test_pycolmap_and_pillow_read_the_copies_alike(turned, tmp_path):
    import pycolmap

    out, photos = turned
    for photo in photos:
        bitmap = pycolmap.Bitmap.read(str(out / "colmap/images" / photo.name), True)
        assert (bitmap.height, bitmap.width) == photo.size_hw
    moved = shutil.move(out / "colmap", tmp_path / "colmap")
    assert all((Path(moved) / "images" / photo.name).is_file() for photo in photos), "the folder is whole by itself"
    shutil.move(moved, out / "colmap")
