"""7-Scenes, as laid out in the benchmark archive.

```
<root>/7Scenes/<scene>/seq-01/frame-%06d.color.png   (stairs: seq-02)
                              frame-%06d.pose.txt    4x4 camera-to-world
                              frame-%06d.depth.png   16-bit, millimetres, 65535 = invalid, not registered to colour
<root>/7Scenes/meshes/<scene>.ply                    ground-truth mesh, metres
```

Source: docs/benchmark.md, "Files of a scene".
"""

from pathlib import Path

import numpy as np
import torch

from freegeo.data.datasets.base import Archive, Dataset, DatasetConstants, existing, read_gray, require_folder
from freegeo.data.photos import open_photos
from freegeo.data.scene import Scene, SceneTruth
from freegeo.errors import FreeGeoError

SCENES = ("chess", "fire", "heads", "office", "pumpkin", "redkitchen", "stairs")
NAME = "7scenes"
K_COLOR = ((585.0, 0.0, 320.0), (0.0, 585.0, 240.0), (0.0, 0.0, 1.0))
SIZE_HW = (480, 640)
_SEQUENCE = {"stairs": ("seq-02", 500)}
_DEFAULT_SEQUENCE = ("seq-01", 1000)
_INVALID_MM = 65535


def scene_names(root: Path) -> list[str]:
    """The published scenes; `root` does not matter here."""
    return list(SCENES)


def load_scene(root: Path, name: str) -> Scene:
    """Read the cameras and paths of one scene; frames without colour image or pose are skipped.

    Raises:
        UserError: the folder is missing. FreeGeoError: a pose is damaged, or no frame is left.
    """
    sequence, count = _SEQUENCE.get(name, _DEFAULT_SEQUENCE)
    folder = require_folder(Path(root) / "7Scenes" / name / sequence, "a 7-Scenes sequence")
    stems = [folder / f"frame-{number:06d}" for number in range(count)]
    stems = [stem for stem in stems if _part(stem, "color.png").is_file() and _part(stem, "pose.txt").is_file()]
    if not stems:
        raise FreeGeoError(f"{folder} holds no frame with both a colour image and a pose.")
    poses = np.stack([_read_pose(_part(stem, "pose.txt")) for stem in stems])
    return Scene(
        name=name,
        photos=tuple(open_photos([_part(stem, "color.png") for stem in stems])),
        T_cam_world=torch.tensor(np.linalg.inv(poses), dtype=torch.float32),
        K=torch.tensor(K_COLOR).repeat(len(stems), 1, 1),
        truth=SceneTruth(
            dataset=NAME,
            surface=Path(root) / "7Scenes" / "meshes" / f"{name}.ply",
            depth=tuple(existing(_part(stem, "depth.png")) for stem in stems),
            mask=(None,) * len(stems),
            camera_hw=(SIZE_HW,) * len(stems),
        ),
    )


def valid_mask(truth: SceneTruth, index: int, size_hw: tuple[int, int]) -> np.ndarray | None:
    """Pixels of one frame with a ground-truth depth, (H, W) bool; None without a depth file. `size_hw` is not used."""
    path = truth.depth[index]
    return None if path is None else read_depth(path, size_hw) > 0


def read_depth(path: Path, photo_hw: tuple[int, int]) -> np.ndarray:
    """Ground-truth depth (H, W) float32 metres, 0 where there is none. `photo_hw` is not used."""
    millimetres = read_gray(path)
    return np.where(millimetres == _INVALID_MM, 0, millimetres).astype(np.float32) / 1000


def _part(stem: Path, ending: str) -> Path:
    return stem.with_name(f"{stem.name}.{ending}")


def _read_pose(path: Path) -> np.ndarray:
    try:
        return np.loadtxt(path).reshape(4, 4)
    except ValueError as error:
        raise FreeGeoError(f"{path}: not a 4 x 4 matrix ({error}).") from error


SEVEN_SCENES = Dataset(
    name=NAME,
    constants=DatasetConstants(
        voxel=4 / 512,
        truncation=0.04,
        depth_limit=1_000_000.0,
        down_sample=4 / 512,
        threshold=0.05,
        truth="mesh",
    ),
    scene_names=scene_names,
    load_scene=load_scene,
    read_depth=read_depth,
    valid_mask=valid_mask,
    recipe_row=NAME,
    archive=Archive(
        gb=3.3,
        terms="research only, under Microsoft Research's terms of 7-Scenes: "
        "https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes",
    ),
)
