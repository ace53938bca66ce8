"""ETH3D training scenes, as laid out in the benchmark archive.

```
<root>/<scene>/images/<NAME>                              NAME as in images.txt, e.g. dslr_images/DSC_0286.JPG
               dslr_calibration_jpg/cameras.txt, images.txt   COLMAP text files
               combined_mesh.ply                          ground-truth mesh, metres
               ground_truth_depth/dslr_images/DSC_xxxx.JPG    raw little-endian float32, image-sized, optional
               masks_for_images/dslr_images/DSC_xxxx.png  8-bit, 1 marks occlusion, optional
```

Frames come in the order of images.txt. The lens distortion of the raw JPEGs is ignored, as published. Source:
docs/benchmark.md, "Files of a scene".
"""

from pathlib import Path

import numpy as np
import torch

from freegeo.data.colmap_files import read_cameras, read_images
from freegeo.data.datasets.base import Archive, Dataset, DatasetConstants, existing, read_gray, require_folder
from freegeo.data.photos import open_photos
from freegeo.data.scene import Scene, SceneTruth
from freegeo.errors import FreeGeoError

SCENES = (
    "courtyard",
    "electro",
    "kicker",
    "pipes",
    "relief",
    "delivery_area",
    "facade",
    "office",
    "playground",
    "relief_2",
    "terrains",
)
NAME = "eth3d"
EXCLUDED = {  # frames left out, by the number at the end of their name
    "delivery_area": range(711, 715),
    "electro": (*range(9289, 9294), 9298),
    "playground": range(587, 593),
    "relief": range(427, 439),
    "relief_2": range(458, 469),
}
_OCCLUDED = 1


def scene_names(root: Path) -> list[str]:
    """The published scenes; `root` does not matter here."""
    return list(SCENES)


def load_scene(root: Path, name: str) -> Scene:
    """Read the cameras and paths of one scene.

    Raises:
        UserError: the folder or its calibration is missing. FreeGeoError: a file is damaged, or no frame is left.
    """
    folder = require_folder(Path(root) / name, "an ETH3D scene")
    cameras = {k: c for k, c in read_cameras(folder / "dslr_calibration_jpg").items() if c.has_pinhole}
    excluded = tuple(f"{number}.JPG" for number in EXCLUDED.get(name, ()))
    images = [
        image
        for image in read_images(folder / "dslr_calibration_jpg")
        if image.camera in cameras and not image.name.endswith(excluded) and (folder / "images" / image.name).is_file()
    ]
    if not images:
        raise FreeGeoError(f"{folder} holds no usable frame: none of the images in images.txt was found.")
    files = [folder / "images" / image.name for image in images]
    depth = folder / "ground_truth_depth" / "dslr_images"
    masks = folder / "masks_for_images" / "dslr_images"
    return Scene(
        name=name,
        photos=tuple(open_photos(files)),
        T_cam_world=torch.tensor(np.stack([image.T_cam_world for image in images]), dtype=torch.float32),
        K=torch.tensor(np.stack([cameras[image.camera].K for image in images]), dtype=torch.float32),
        truth=SceneTruth(
            dataset=NAME,
            surface=folder / "combined_mesh.ply",
            depth=tuple(existing(depth / file.name) for file in files),
            mask=tuple(existing(masks / file.name.replace(".JPG", ".png")) for file in files),
            camera_hw=tuple(cameras[image.camera].size_hw for image in images),
        ),
    )


def valid_mask(truth: SceneTruth, index: int, size_hw: tuple[int, int]) -> np.ndarray:
    """Pixels of one frame that may be fused, (H, W) bool: not occluded, with a ground-truth depth where one is given.

    Raises:
        FreeGeoError: the depth file or the mask does not have the size of the image.
    """
    keep = np.ones(size_hw, dtype=bool)
    if (mask_path := truth.mask[index]) is not None:
        mask = read_gray(mask_path)
        if mask.shape != size_hw:
            raise FreeGeoError(f"{mask_path}: the mask is {mask.shape}, its image {size_hw}.")
        keep &= mask != _OCCLUDED
    if (depth_path := truth.depth[index]) is not None:
        depth = read_depth(depth_path, size_hw)
        keep &= (depth != 0) & (depth != np.inf)
    return keep


def read_depth(path: Path, photo_hw: tuple[int, int]) -> np.ndarray:
    """Ground-truth depth (H, W) float32 metres; 0 or inf where there is none."""
    height, width = photo_hw
    if path.stat().st_size != 4 * height * width:
        raise FreeGeoError(f"{path}: {path.stat().st_size} bytes do not fit an image of {width} x {height} pixels.")
    return np.fromfile(path, dtype="<f4").reshape(photo_hw)


ETH3D = Dataset(
    name=NAME,
    constants=DatasetConstants(
        voxel=5 * 4 / 512,
        truncation=0.2,
        depth_limit=100_000.0,
        down_sample=5 * 4 / 512,
        threshold=0.25,
        truth="mesh",
    ),
    scene_names=scene_names,
    load_scene=load_scene,
    read_depth=read_depth,
    valid_mask=valid_mask,
    depth_of_every_frame=False,  # only where a laser scan was rendered
    recipe_row=NAME,
    archive=Archive(
        gb=14.1,
        terms="research only, under the terms of ETH3D: https://www.eth3d.net",
    ),
)
