"""A generated room whose cameras are known exactly, its matches, and its cameras in files of every format."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from freegeo.cameras.known import KnownCamera, KnownCameras
from freegeo.data.photos import MemoryPhoto
from freegeo.data.procedural import render, sample_rooms
from freegeo.evidence.matches import Matches, find_matches

ROOM, DOMAIN, FRAMES, HW = 20_000_001, "test-id", 5, (144, 192)
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(autouse=True)
def always_one_thread(one_thread):
    """Every test of this folder computes with one thread."""


@dataclass(frozen=True)
class Room:
    """Photos of a room and their exact cameras."""

    photos: tuple[MemoryPhoto, ...]
    known: KnownCameras


@pytest.fixture(scope="session")
def scene() -> Room:
    views = render(sample_rooms([ROOM], domain=DOMAIN, frames=FRAMES), *HW)
    images = (views.images[0].permute(0, 2, 3, 1) * 255).round().byte().numpy()
    photos = tuple(MemoryPhoto(f"{k:02d}.png", image) for k, image in enumerate(images))
    # The renderer counts from the first pixel's centre.
    K = views.K[0].double().numpy() + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    cameras = []
    for T, own in zip(views.T_cam_world[0].double().numpy(), K, strict=True):
        u, _, vh = np.linalg.svd(T[:3, :3])
        rigid = T.copy()
        rigid[:3, :3] = u @ vh
        cameras.append(KnownCamera(T_cam_world=rigid, K=own, size_hw=HW))
    names = tuple(photo.name for photo in photos)
    return Room(photos, KnownCameras(names=names, cameras=tuple(cameras), source="the room"))


@pytest.fixture(scope="session")
def known(scene) -> KnownCameras:
    return scene.known


@pytest.fixture(scope="session")
def matches(scene) -> Matches:
    return find_matches(scene.photos)


def matrices(known: KnownCameras, reading: str) -> np.ndarray:
    """Pose matrices that mean the known cameras under a reading, written without the code under test."""
    T = np.stack([one.T_cam_world for one in known.cameras])
    T = FLIP @ T if reading.endswith("opengl") else T
    return np.linalg.inv(T) if reading.startswith("c2w") else T


@dataclass(frozen=True)
class Written:
    """Cameras in a file: what to name, and whether it has intrinsics."""

    path: Path
    has_K: bool


def write(format: str, known: KnownCameras, folder: Path, reading: str) -> Written:
    """Write cameras in a format by hand, with matrices that are meant as `reading` says."""
    poses = matrices(known, reading)
    rows = list(zip(known.names, poses, known.cameras, strict=True))
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / {"tum": "traj.txt", "kitti": "poses.txt"}.get(format, format)
    if format == "cameras.json":
        frames = [
            {"name": name, "width": one.size_hw[1], "height": one.size_hw[0], "K": one.K.tolist(), "w2c": T.tolist()}
            for name, T, one in rows
        ]
        path.write_text(json.dumps({"frames": frames}))
    elif format == "colmap":
        path.mkdir()
        K = known.cameras[0].K
        height, width = known.cameras[0].size_hw
        params = f"{K[0, 0]!r} {K[1, 1]!r} {K[0, 2]!r} {K[1, 2]!r}".replace("np.float64(", "").replace(")", "")
        (path / "cameras.txt").write_text(f"# cameras\n7 PINHOLE {width} {height} {params}\n")
        lines = [
            f"{k + 3} {text(quat_xyzw(T)[[3, 0, 1, 2]])} {text(T[:3, 3])} 7 {name}\n\n"
            for k, (name, T, _) in enumerate(rows)
        ]
        (path / "images.txt").write_text("# images\n" + "".join(lines))
    elif format == "nerfstudio":
        path = folder / "transforms.json"
        one = known.cameras[0]
        shared = {"w": one.size_hw[1], "h": one.size_hw[0], "fl_x": one.K[0, 0], "fl_y": one.K[1, 1]}
        shared |= {"cx": one.K[0, 2], "cy": one.K[1, 2]}
        frames = [{"file_path": f"./images/{name}", "transform_matrix": T.tolist()} for name, T, _ in rows]
        path.write_text(json.dumps({**shared, "frames": frames}))
    elif format == "tum":
        path.write_text(
            "# time\n" + "".join(f"{k}.0 {text(T[:3, 3])} {text(quat_xyzw(T))}\n" for k, T in enumerate(poses))
        )
    elif format == "kitti":
        path.write_text("".join(f"{text(T[:3].ravel())}\n" for T in poses))
    else:
        path.mkdir()
        for name, T, _ in rows:
            (path / f"{Path(name).stem}.pose.txt").write_text("".join(f"{text(row)}\n" for row in T))
    return Written(path, format not in ("tum", "kitti", "poses"))


def quat_xyzw(T: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(T[:3, :3]).as_quat()


def text(numbers: np.ndarray) -> str:
    return " ".join(repr(float(number)) for number in numbers)
