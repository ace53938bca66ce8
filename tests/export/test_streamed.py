"""Reconstructions written in parts and mapped from their file, and the trajectory format."""

import subprocess
import sys
import tracemalloc
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from exact_rooms import room
from freegeo.cameras.trajectories import read_tum
from freegeo.data.photos import MemoryPhoto
from freegeo.errors import FreeGeoError
from freegeo.export.formats import export
from freegeo.export.reconstruction import METRIC_MODEL, Reconstruction, Scale, save_streamed
from freegeo.files import read_npz
from freegeo.geometry.se3 import inverse

BIG = ("depth_z", "conf", "images", "sky")


def streamed(scene, path, *, step=3, **changes):
    """Write a reconstruction `step` views at a time."""

    def blocks(name):
        whole = changes.get(name, getattr(scene, name))
        return None if whole is None else (whole[at : at + step] for at in range(0, len(whole), step))

    names = ("names", "photo_hw", "scale_xy", "offset_xy", "T_cam_world", "K")
    rest = {name: changes.get(name, getattr(scene, name)) for name in names}
    return save_streamed(path, **rest, scale=scene.scale, blocks=blocks)


def full_room():
    scene = room()
    scale = Scale(value=2.0, source=METRIC_MODEL, spread=0.1)
    return replace(scene, sky=np.zeros_like(scene.depth_z), K=scene.K.astype(np.float64), scale=scale)


def test_what_is_streamed_is_what_would_be_saved(tmp_path):
    for scene in (room(), full_room(), replace(room(), T_cam_world=None, K=None)):
        file = streamed(scene, tmp_path)
        assert file == tmp_path / "prediction.npz"
        assert [path.name for path in tmp_path.iterdir()] == [file.name]
        loaded = Reconstruction.load(tmp_path)
        assert loaded.scale == scene.scale
        with np.load(file, allow_pickle=False) as content:  # as a user's script reads it
            assert set(content.files) == set(scene.arrays())
            for name, array in scene.arrays().items():
                for found in (content[name], loaded.arrays().get(name, content[name])):
                    assert found.dtype == array.dtype, name
                    np.testing.assert_array_equal(found, array)


def test_uncompressed_arrays_are_mapped_and_stay_as_they_are_in_the_file(tmp_path):
    scene = full_room()
    before = streamed(scene, tmp_path).read_bytes()
    loaded = Reconstruction.load(tmp_path)
    for name in BIG:
        mapped = getattr(loaded, name)
        assert isinstance(mapped, np.memmap) and mapped.flags.aligned and mapped.flags.writeable, name
        mapped[1] = 7
        assert (getattr(loaded, name)[1] == 7).all()
    assert (tmp_path / "prediction.npz").read_bytes() == before
    np.testing.assert_array_equal(Reconstruction.load(tmp_path).depth_z, scene.depth_z)
    scene.save(tmp_path)
    assert not isinstance(Reconstruction.load(tmp_path).depth_z, np.memmap)


def test_a_mapped_reconstruction_is_saved_uncompressed_too_also_over_its_own_file(tmp_path):
    streamed(full_room(), tmp_path)
    loaded = Reconstruction.load(tmp_path)
    expected = loaded.depth_z.copy()
    loaded.save(tmp_path)
    again = Reconstruction.load(tmp_path)
    assert isinstance(again.depth_z, np.memmap)
    for depth in (loaded.depth_z, again.depth_z):
        np.testing.assert_array_equal(depth, expected)


def test_every_export_of_a_mapped_reconstruction_has_the_same_bytes(tmp_path):
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    streamed(room(), tmp_path / "mapped.npz")
    formats = ["ply", "glb", "mesh", "colmap", "nerfstudio", "tum", "depth"]
    for name, scene in (("whole", room()), ("mapped", Reconstruction.load(tmp_path / "mapped.npz"))):
        export(scene, tmp_path / name, formats, max_points=500, max_tracks=100)
    one, two = (
        {path.relative_to(folder): path.read_bytes() for path in folder.rglob("[!.]*") if path.is_file()}
        for folder in (tmp_path / "whole", tmp_path / "mapped")
    )
    assert one == two and len(one) > len(formats)


@pytest.mark.parametrize("name", ["depth_z", "images", "names", "K"])
def test_damage_anywhere_in_a_mapped_file_is_found_when_it_is_opened(tmp_path, name):
    file = streamed(full_room(), tmp_path)
    with zipfile.ZipFile(file) as archive:
        entry = archive.getinfo(f"{name}.npy")
    content = bytearray(file.read_bytes())
    content[entry.header_offset + 250 + entry.file_size // 2] ^= 1
    file.write_bytes(content)
    with pytest.raises(FreeGeoError, match="damaged file"):
        Reconstruction.load(tmp_path)


def test_an_array_longer_than_its_content_is_damage(tmp_path):
    with zipfile.ZipFile(tmp_path / "prediction.npz", "w") as archive, archive.open("depth_z.npy", "w") as stream:
        header = {"descr": "<f4", "fortran_order": False, "shape": (1000, 8, 12)}
        np.lib.format.write_array_header_1_0(stream, header)
        stream.write(bytes(400))
    with pytest.raises(FreeGeoError, match="damaged file"):
        Reconstruction.load(tmp_path)


def test_arrays_that_cannot_be_mapped_are_read(tmp_path):
    arrays = {
        "number": np.array(3.5),
        "nothing": np.zeros((0, 4), np.float32),
        "columns": np.asfortranarray(np.arange(12.0).reshape(3, 4)),
        "swapped": np.arange(5, dtype=">f4"),
        "text": np.array(["a", "bcd"]),
    }
    np.savez(tmp_path / "x.npz", **arrays)
    found = read_npz(tmp_path / "x.npz")
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype and found[name].flags.aligned
        np.testing.assert_array_equal(found[name], array)


def test_rows_that_do_not_fit_leave_no_file(tmp_path):
    scene = room()
    wrong = {
        "short": {"conf": scene.conf[:3]},
        "long": {"conf": np.concatenate((scene.conf, scene.conf))},
        "narrow": {"images": scene.images[:, :, 1:]},
        "empty": {"depth_z": scene.depth_z[:0]},
        "names": {"names": scene.names[:3]},
        "cameras": {"K": scene.K[:3]},
    }
    for name, changes in wrong.items():
        with pytest.raises(FreeGeoError, match=r"rows|expected"):
            streamed(scene, tmp_path, **changes)
        assert list(tmp_path.iterdir()) == [], name


def test_writing_and_opening_hold_one_block_at_a_time(tmp_path):
    views, hw, step = 120, (96, 128), 4
    depth = np.ones((step, *hw), np.float32)
    block = {"depth_z": depth, "conf": depth, "images": np.zeros((*depth.shape, 3), np.uint8), "sky": depth}
    tracemalloc.start()
    try:
        file = save_streamed(
            tmp_path, names=[f"{view}.jpg" for view in range(views)], photo_hw=np.tile(hw, (views, 1)),
            scale_xy=np.ones((views, 2)), offset_xy=np.zeros((views, 2)),
            blocks=lambda name: (block[name].copy() for _ in range(views // step)),
        )  # fmt: skip
        scene = Reconstruction.load(tmp_path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(scene) == views
    assert peak < file.stat().st_size / 5 < scene.depth_z.nbytes


PEAK = """
import sys
from pathlib import Path
from freegeo.export.formats import export, filter_reconstruction
from freegeo.export.reconstruction import Reconstruction
scene = Reconstruction.load(Path(sys.argv[1]))
formats = ["ply", "glb", "depth", "depth-npy", "tum", "kitti"]
export(scene, sys.argv[2], formats, filtered=filter_reconstruction(scene), max_points=1000)
status = Path("/proc/self/status").read_text()
print(next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:")))
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="reads the peak of a process from Linux")
def test_memory_of_filters_and_exports_grows_by_the_file_and_masks_alone(tmp_path):
    peaks, sizes = [], []
    for views in (20, 400):
        scene = room(20, (96, 128), 7)
        times = views // 20
        many = {
            name: np.tile(getattr(scene, name), (times, *[1] * (getattr(scene, name).ndim - 1)))
            for name in ("depth_z", "conf", "images", "photo_hw", "scale_xy", "offset_xy", "T_cam_world", "K")
        }
        names = tuple(f"{view}.jpg" for view in range(views))
        file = streamed(Reconstruction(**many, names=names), tmp_path / f"{views}.npz", step=20)
        done = subprocess.run(
            [sys.executable, "-c", PEAK, file, tmp_path / f"out{views}"], capture_output=True, text=True, check=True
        )
        peaks.append(1000 * int(done.stdout.split()[-1]))
        sizes.append(file.stat().st_size)
    pixels = (400 - 20) * 96 * 128
    # Pages of the mapped file count as this process's memory, though the system may drop them; six masks; and what the
    # allocator keeps, 20 to 21 MB by machine. One more copy of the depth would be 19 MB.
    assert peaks[1] - peaks[0] < sizes[1] - sizes[0] + 6 * pixels + 28_000_000


@dataclass(frozen=True)
class Frame(MemoryPhoto):
    """A photo with a time, as the frames of a video."""

    time_s: float | None = None


def test_a_trajectory_comes_back_as_the_cameras(tmp_path):
    scene = room()
    written = scene.export(tmp_path, ["tum"]).files
    assert written == [tmp_path / "trajectory.txt"]
    found = read_tum(written[0]).cameras
    poses = inverse(torch.from_numpy(scene.T_cam_world).double()).numpy()
    np.testing.assert_allclose(np.stack([one.matrix for one in found]), poses, atol=1e-6)
    assert [float(one.name) for one in found] == [0, 1, 2, 3]
    assert "lengths are up to scale" in written[0].read_text().splitlines()[0]


@pytest.mark.parametrize(
    ("times", "expected"),
    [((0.0, 0.5, 1.25, 2.0), (0.0, 0.5, 1.25, 2.0)), ((0.0, 0.5, None, 2.0), range(4)), ((0, 1, 0, 1), range(4))],
)
def test_a_trajectory_has_the_times_of_a_video(tmp_path, times, expected):
    scene = room()
    photos = [
        Frame(name, np.zeros((*hw, 3), np.uint8), time_s=time)
        for name, hw, time in zip(scene.names, scene.photo_hw.tolist(), times, strict=True)
    ]
    export(scene, tmp_path, ["tum"], photos=photos)
    assert [float(one.name) for one in read_tum(tmp_path / "trajectory.txt").cameras] == list(expected)


@pytest.mark.parametrize(
    ("names", "rows", "expected"),
    [
        (("036.png", "007.png", "9.5", "100.jpg"), [1, 2, 0, 3], (7, 9.5, 36, 100)),
        (("2.png", "02.png", "1.png", "3.png"), [0, 1, 2, 3], range(4)),
        (("2.png", "b.png", "1.png", "3.png"), [0, 1, 2, 3], range(4)),
    ],
)
def test_a_trajectory_has_the_names_of_photos_that_are_numbers(tmp_path, names, rows, expected):
    scene = replace(room(), names=names)
    export(scene, tmp_path, ["tum"])
    found = read_tum(tmp_path / "trajectory.txt").cameras
    assert [float(one.name) for one in found] == list(expected)
    poses = inverse(torch.from_numpy(scene.T_cam_world).double()).numpy()
    np.testing.assert_allclose(np.stack([one.matrix for one in found]), poses[rows], atol=1e-6)
