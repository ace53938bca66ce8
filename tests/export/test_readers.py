"""Exports read by programs that know nothing of freegeo: pycolmap, and readers written as those of 3DGS and nerfstudio.

The photos show one generated room, landscape and portrait, stored in all eight EXIF orientations and in sub-folders of
which files have the same names. Depth and cameras are exact, so that every point must come back where it is.
"""

import json
import struct
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from export.test_photos import plain, stored
from freegeo.data.photos import Photo, load_photos
from freegeo.data.procedural import render, sample_rooms
from freegeo.export.formats import export, filter_reconstruction
from freegeo.export.pixels import masks_for_model
from freegeo.export.reconstruction import Reconstruction
from freegeo.fusion.settings import FilterSettings
from freegeo.models.catalog import build_empty
from freegeo.models.images import read_photos

VIEWS, HW = 8, (96, 128)
SIDES = {True: slice(28, 100), False: slice(0, 128)}
"""Columns of the room's images that portraits and landscapes show."""
EVERYTHING = FilterSettings(drop_share=0, flying=False, multi_view=False)
ALL_FORMATS = ["colmap", "nerfstudio", "tum", "kitti", "npz", "depth", "depth-npy", "depth-exr"]


@dataclass(frozen=True)
class Exported:
    """An export, and what is true of its photos."""

    folder: Path
    photos: list[Photo]
    depth_z: list[np.ndarray]
    """(h, w) of each upright photo."""
    K: np.ndarray
    """(S, 3, 3), counted from the corner of the upright photos."""
    T_cam_world: np.ndarray
    masks: list[np.ndarray]

    def world(self, view: int) -> np.ndarray:
        """Points (h, w, 3) that the pixels of a photo show."""
        return lifted(self.depth_z[view], self.K[view], np.linalg.inv(self.T_cam_world[view]))


def lifted(depth: np.ndarray, K: np.ndarray, T_world_cam: np.ndarray) -> np.ndarray:
    row, column = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    x, y = (column - K[0, 2]) / K[0, 0] * depth, (row - K[1, 2]) / K[1, 1] * depth
    return np.stack((x, y, depth), -1) @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]


def projected(world: np.ndarray, K: np.ndarray, T_cam_world: np.ndarray) -> np.ndarray:
    camera = world @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
    pixels = camera @ K.T
    return pixels[..., :2] / pixels[..., 2:]


@pytest.fixture(scope="module", params=["crop", "pad"])
def out(request, tmp_path_factory) -> Exported:
    pytest.importorskip("pycolmap", reason="needs the extra colmap")
    pytest.importorskip("OpenEXR", reason="needs the extra exr")
    folder = tmp_path_factory.mktemp(request.param)
    room = render(sample_rooms([7], frames=VIEWS), *HW)
    images = (room.images[0].permute(0, 2, 3, 1) * 255).round().byte().numpy()
    sides = [SIDES[view % 3 == 1] for view in range(VIEWS)]
    files = [folder / "in" / "ab"[view % 2] / f"IMG_{view // 2}.jpg" for view in range(VIEWS)]
    paths = [
        stored(file, images[view][:, sides[view]], view + 1, quality=98, subsampling=0)
        for view, file in enumerate(files)
    ]
    photos = load_photos(paths)
    K = room.K[0].double().numpy().copy()
    K[:, :2, 2] += 0.5
    K[:, 0, 2] -= [side.start for side in sides]
    depth = [room.depth_z[0][v].numpy()[:, sides[v]] for v in range(VIEWS)]
    scene = exact(photos, depth, K, room.T_cam_world[0].double().numpy(), request.param)
    masks = [np.ones(d.shape, np.uint8) for d in depth]
    masks[2][:40, 50:] = 0
    wanted = masks_for_model(scene, masks)
    filtered = filter_reconstruction(scene, masks=wanted, settings=EVERYTHING)
    result = export(scene, folder / "out", ALL_FORMATS, photos=photos, masks=wanted, filtered=filtered, max_tracks=600)
    assert result.failed == {}
    return Exported(folder / "out", photos, depth, K, scene.T_cam_world, masks)


def exact(photos, depth, K, T_cam_world, mixed: str) -> Reconstruction:
    """What a model would return that reads the photos as ours do and makes no mistake."""
    batch = read_photos(build_empty("freegeo-tiny"), photos, mixed=mixed)
    scale, offset = batch.scale_xy.numpy(), batch.offset_xy.numpy()
    maps = []
    for view, one in enumerate(depth):
        row, column = (
            np.clip(((np.arange(side) + 0.5 - offset[view, axis]) / scale[view, axis]).astype(int), 0, limit - 1)
            for axis, side, limit in ((1, batch.image_hw[0], one.shape[0]), (0, batch.image_hw[1], one.shape[1]))
        )
        maps.append(one[row[:, None], column])
    model_K = K.copy()
    model_K[:, :2] *= scale[:, :, None]
    model_K[:, :2, 2] += offset - 0.5
    depth_z = np.stack(maps)
    return Reconstruction(
        depth_z=depth_z, conf=np.ones_like(depth_z), T_cam_world=T_cam_world, K=model_K, names=batch.names,
        images=(batch.images * 255).round().byte().permute(0, 2, 3, 1).numpy(), photo_hw=batch.photo_hw.numpy(),
        scale_xy=scale, offset_xy=offset,
    )  # fmt: skip


def assert_upright(image: Path, photo: Photo) -> np.ndarray:
    """The pixels of a file as a reader sees them that does not know EXIF; they are those of the upright photo."""
    pixels = plain(image)
    assert pixels.shape[:2] == photo.size_hw
    assert np.abs(pixels.astype(int) - photo.read()).mean() < 2
    return pixels


def assert_lands(out: Exported, view: int, K: np.ndarray, T_cam_world: np.ndarray) -> None:
    """What each pixel of a photo shows is seen at that pixel by a camera that was read."""
    row, column = np.mgrid[: out.depth_z[view].shape[0], : out.depth_z[view].shape[1]] + 0.5
    places = projected(out.world(view), K, T_cam_world)
    np.testing.assert_allclose(places, np.stack((column, row), -1), atol=0.01)


# -- 3DGS: the binary model parsed as its reference reader does, and nothing but PINHOLE accepted


def rotation(quat_wxyz) -> np.ndarray:
    w, x, y, z = quat_wxyz
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


class Binary:
    """Little-endian numbers from a file."""

    def __init__(self, path: Path):
        self.content, self.at = path.read_bytes(), 0

    def take(self, kinds: str) -> tuple:
        values = struct.unpack_from("<" + kinds, self.content, self.at)
        self.at += struct.calcsize("<" + kinds)
        return values

    def text(self) -> str:
        end = self.content.index(b"\0", self.at)
        found, self.at = self.content[self.at : end].decode(), end + 1
        return found

    def require_end(self) -> None:
        assert self.at == len(self.content)


def read_cameras(path: Path) -> dict:
    file, found = Binary(path), {}
    for _ in range(file.take("Q")[0]):
        number, model, width, height = file.take("iiQQ")
        assert model == 1, "only undistorted PINHOLE cameras are accepted"
        fx, fy, cx, cy = file.take("4d")
        found[number] = (int(height), int(width)), np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    file.require_end()
    return found


def read_images(path: Path) -> dict:
    file, found = Binary(path), {}
    for _ in range(file.take("Q")[0]):
        number, *pose, camera = file.take("i7di")
        name, count = file.text(), file.take("Q")[0]
        points = [file.take("ddq") for _ in range(count)]
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation(pose[:4]), pose[4:]
        found[number] = T, camera, name, points
    file.require_end()
    return found


def read_points(path: Path) -> dict:
    file, found = Binary(path), {}
    for _ in range(file.take("Q")[0]):
        number, x, y, z, *colour, error, length = file.take("Q3d3BdQ")
        found[number] = np.array([x, y, z]), np.array(colour), error, [file.take("ii") for _ in range(length)]
    file.require_end()
    return found


def test_a_reader_as_that_of_3dgs_finds_every_image_and_its_points(out):
    source = out.folder / "colmap"
    cameras = read_cameras(source / "sparse/0/cameras.bin")
    images = read_images(source / "sparse/0/images.bin")
    points = read_points(source / "sparse/0/points3D.bin")
    by_name = {photo.name: view for view, photo in enumerate(out.photos)}
    assert {name for _, _, name, _ in images.values()} == set(by_name)
    assert len(points) == 600
    seen, differences = 0, []
    for T, camera, name, observed in images.values():
        view, (size, K) = by_name[name], cameras[camera]
        pixels = assert_upright(source / "images" / name, out.photos[view])
        assert size == pixels.shape[:2]
        assert_lands(out, view, K, T)
        for x, y, number in observed:
            xyz, colour, _, track = points[number]
            np.testing.assert_allclose(projected(xyz, K, T), (x, y), atol=1.5)
            assert len(track) >= 2
            differences.append(np.abs(pixels[int(y), int(x)] - colour.astype(float)).mean())
            seen += 1
    assert seen == sum(len(track) for *_, track in points.values())
    assert np.mean(differences) < 12


# -- pycolmap


def test_pycolmap_undistorts_every_image(out, tmp_path):
    import pycolmap

    source = out.folder / "colmap"
    pycolmap.undistort_images(str(tmp_path), str(source / "sparse/0"), str(source / "images"))
    model = pycolmap.Reconstruction(tmp_path / "sparse")
    assert len(model.images) == VIEWS and len(model.points3D) == 600
    by_name = {photo.name: view for view, photo in enumerate(out.photos)}
    for image in model.images.values():
        view = by_name[image.name]
        pixels = assert_upright(tmp_path / "images" / image.name, out.photos[view])
        assert (image.camera.height, image.camera.width) == pixels.shape[:2]
        T = np.vstack((image.cam_from_world().matrix(), (0, 0, 0, 1)))
        assert_lands(out, view, image.camera.calibration_matrix(), T)


# -- nerfstudio: as its data parser and its depth dataset read


def nerfstudio_frames(folder: Path):
    """Yield each frame with its files, read as nerfstudio reads them with its default settings."""
    meta = json.loads((folder / "transforms.json").read_text())
    assert meta["camera_model"] == "OPENCV"
    assert not any(meta[name] for name in ("k1", "k2", "p1", "p2"))
    for key in ("depth_file_path", "mask_path"):
        assert sum(key in frame for frame in meta["frames"]) in (0, len(meta["frames"])), "for all or for none"
    for frame in meta["frames"]:
        depth = mask = None
        if "depth_file_path" in frame:
            depth = np.load(folder / frame["depth_file_path"]) * 1e-3
            assert depth.shape == (frame["h"], frame["w"]), "so that resizing it to the image changes nothing"
        if "mask_path" in frame:
            with Image.open(folder / frame["mask_path"]) as image:
                assert image.mode == "L", "one channel"
                mask = np.asarray(image) > 0
        yield frame, folder / frame["file_path"], depth, mask


def test_a_reader_as_that_of_nerfstudio_finds_images_depth_and_masks(out):
    frames = list(nerfstudio_frames(out.folder))
    assert len(frames) == VIEWS
    for view, (frame, image, depth, mask) in enumerate(frames):
        assert_upright(image, out.photos[view])
        K = np.array([[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]])
        c2w = np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])
        assert_lands(out, view, K, np.linalg.inv(c2w))
        wanted = out.masks[view] > 0
        assert (mask[~wanted].mean() if view == 2 else 0) < 0.05, "soft by one pixel of the model"
        assert mask[wanted].mean() > 0.65, "but for what is cut away"
        assert ((depth > 0) == mask).all(), "every wanted pixel is a point here"
        apart = (np.linalg.norm(lifted(depth, K, c2w) - out.world(view), axis=-1) / out.depth_z[view])[mask]
        assert np.median(apart) < 0.01 and np.quantile(apart, 0.9) < 0.03


# -- depth and trajectories


def test_depth_files_hold_the_values_of_the_prediction(out):
    import OpenEXR

    prediction = np.load(out.folder / "prediction.npz")
    wanted = masks_for_model(Reconstruction.load(out.folder), out.masks)
    scale = json.loads((out.folder / "depth/depth.json").read_text())["scale"]
    for view, name in enumerate(prediction["names"]):
        expected = np.where(wanted[view], prediction["depth_z"][view], 0)
        stem = name.removesuffix(".jpg")
        values = cv2.imread(str(out.folder / "depth" / f"{stem}.png"), cv2.IMREAD_UNCHANGED)
        assert values.dtype == np.uint16
        np.testing.assert_allclose(values * scale, expected, atol=0.51 * scale)
        assert ((values > 0) == (expected > 0)).all()
        array = np.load(out.folder / "depth-npy" / f"{stem}.npy")
        assert array.dtype == np.float32
        np.testing.assert_array_equal(array, expected)
        with OpenEXR.File(str(out.folder / "depth-exr" / f"{stem}.exr")) as file:
            pixels = file.channels()["Y"].pixels
            assert pixels.dtype == np.float32
            np.testing.assert_array_equal(pixels, expected)


def test_both_trajectories_hold_the_same_poses(out):
    rows = np.loadtxt(out.folder / "trajectory-kitti.txt")
    assert rows.shape == (VIEWS, 12)
    poses = np.linalg.inv(out.T_cam_world)
    np.testing.assert_allclose(rows.reshape(-1, 3, 4), poses[:, :3], atol=1e-9)
    tum = np.loadtxt(out.folder / "trajectory.txt")
    np.testing.assert_allclose(tum[:, 1:4], rows.reshape(-1, 3, 4)[:, :, 3], atol=1e-9)
