"""ScanNet++ scenes with the benchmark's own poses, as laid out in its archive.

```
<root>/<scene>/merge_dslr_iphone/colmap/sparse_render_rgb/{cameras,images,points3D}.{bin|txt}   COLMAP model
                                 images/<NAME>                                    raw, distorted images
                                 render_depth/<base name of NAME>.png             16-bit, millimetres
               scans/mesh_aligned_0.05.ply                                        ground-truth mesh, metres
```

Frames are the phone images (`iphone` in the name), sorted by name. The network sees the raw files; depth is fused at
1024 x 768 with the matrix of the undistorted view. Source: docs/benchmark.md, "Files of a scene".
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from freegeo.data.colmap_files import ColmapCamera, read_cameras, read_images
from freegeo.data.datasets.base import Archive, Dataset, DatasetConstants, existing, read_gray, require_folder
from freegeo.data.photos import open_photos
from freegeo.data.scene import Scene, SceneTruth
from freegeo.errors import FreeGeoError, UserError

SCENES = (
    "09c1414f1b",
    "1ada7a0617",
    "40aec5fffa",
    "3e8bba0176",
    "acd95847c5",
    "578511c8a9",
    "5f99900f09",
    "c4c04e6d6c",
    "f3d64c30f8",
    "7bc286c1b6",
    "c5439f4607",
    "286b55a2bf",
    "fb5a96b1a2",
    "7831862f02",
    "38d58a7a31",
    "bde1e479ad",
    "9071e139d9",
    "21d970d8de",
    "bcd2436daf",
    "cc5237fd77",
)
NAME = "scannetpp"
_COLMAP_CENTRE = 0.5


@dataclass(frozen=True)
class UndistortedCamera:
    """A phone camera with pixel centres at whole coordinates."""

    K: np.ndarray
    """(3, 3) float64: of the undistorted view that keeps every pixel (OPENCV), or of the image itself."""
    K_raw: np.ndarray
    """(3, 3) float64: of the image as stored."""
    distortion: tuple[float, float, float, float, float]
    """k1, k2, p1, p2, k3 in OpenCV's order."""
    roi: tuple[int, int, int, int]
    """x, y, width, height of the valid part of the undistorted view."""


def scene_names(root: Path) -> list[str]:
    """The published scenes; `root` does not matter here."""
    return list(SCENES)


def load_scene(root: Path, name: str) -> Scene:
    """Read the cameras and paths of one scene.

    Raises:
        UserError: a folder or a file of the COLMAP model is missing. FreeGeoError: a file is damaged, a camera has no
            pinhole part, or no frame is left.
    """
    folder = require_folder(Path(root) / name, "a ScanNet++ scene") / "merge_dslr_iphone"
    model = folder / "colmap" / "sparse_render_rgb"
    if not any((model / f"points3D{suffix}").is_file() for suffix in (".bin", ".txt")):
        raise UserError(f"{model} holds neither points3D.bin nor points3D.txt; the COLMAP model is incomplete.")
    cameras = read_cameras(model)
    images = sorted((i for i in read_images(model) if "iphone" in i.name), key=lambda image: image.name)
    images = [image for image in images if (folder / "images" / image.name).is_file()]
    if not images:
        raise FreeGeoError(f"{folder} holds no usable frame: none of the phone images of the model was found.")
    used = {number: undistorted(cameras[number]) for number in {image.camera for image in images}}
    files = [folder / "images" / image.name for image in images]
    return Scene(
        name=name,
        photos=tuple(open_photos(files)),
        T_cam_world=torch.tensor(np.stack([image.T_cam_world for image in images]), dtype=torch.float32),
        K=torch.tensor(np.stack([used[image.camera].K for image in images]), dtype=torch.float32),
        truth=SceneTruth(
            dataset=NAME,
            surface=Path(root) / name / "scans" / "mesh_aligned_0.05.ply",
            depth=tuple(existing(folder / "render_depth" / f"{file.name[:-4]}.png") for file in files),
            mask=(None,) * len(files),
            camera_hw=tuple(cameras[image.camera].size_hw for image in images),
        ),
    )


def undistorted(camera: ColmapCamera) -> UndistortedCamera:
    """The camera of the undistorted view: OpenCV's optimal matrix with alpha 1 at the same size."""
    height, width = camera.size_hw
    K_raw = camera.K
    K_raw[:2, 2] -= _COLMAP_CENTRE
    if camera.model != "OPENCV":
        return UndistortedCamera(K_raw, K_raw, (0.0, 0.0, 0.0, 0.0, 0.0), (0, 0, width, height))
    import cv2

    k1, k2, p1, p2 = camera.params[4:8]
    distortion = (k1, k2, p1, p2, 0.0)
    try:
        K, (x, y, valid_width, valid_height) = cv2.getOptimalNewCameraMatrix(
            K_raw, np.array(distortion), (width, height), 1.0, (width, height)
        )
    except cv2.error as error:
        raise FreeGeoError(f"Camera {camera.number} is none that OpenCV can undistort ({error.err}).") from None
    return UndistortedCamera(np.asarray(K, np.float64), K_raw, distortion, (x, y, valid_width, valid_height))


def valid_mask(truth: SceneTruth, index: int, size_hw: tuple[int, int]) -> np.ndarray | None:
    """Pixels of one frame at fusion size with a ground-truth depth, (H, W) bool; None without a depth file."""
    import cv2

    path = truth.depth[index]
    if path is None:
        return None
    height, width = size_hw
    try:
        depth = cv2.resize(read_depth(path, size_hw), (width, height), interpolation=cv2.INTER_LINEAR)
    except cv2.error as error:
        raise FreeGeoError(f"{path}: cannot be brought to {width} x {height} pixels ({error.err}).") from None
    return (depth > 0) & np.isfinite(depth)


def read_depth(path: Path, photo_hw: tuple[int, int]) -> np.ndarray:
    """Rendered ground-truth depth (H, W) float32 metres, 0 where there is none. `photo_hw` is not used."""
    return read_gray(path).astype(np.float32) / 1000


SCANNETPP = Dataset(
    name=NAME,
    constants=DatasetConstants(
        voxel=0.02,
        truncation=0.15,
        depth_limit=5.0,
        down_sample=0.02,
        threshold=0.05,
        truth="mesh",
        crop_margin=0.1,
        fusion_hw=(768, 1024),
        posed_centre_shift=0.5,
    ),
    scene_names=scene_names,
    load_scene=load_scene,
    read_depth=read_depth,
    valid_mask=valid_mask,
    recipe_row=NAME,
    archive=Archive(
        gb=10.1,
        terms="non-commercial research and education only, for people who accepted the terms of ScanNet++ themselves: "
        "apply at https://kaldir.vc.in.tum.de/scannetpp",
    ),
)
