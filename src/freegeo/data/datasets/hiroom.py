"""HiRoom scenes, as laid out in the benchmark archive.

```
<root>/selected_scene_list_val.txt                 one scene per line, three path components each
<root>/data/<scene>/image/<frame>.<ext>            any extension, sorted by file name
                    depth/<frame>.png              16-bit, metres = value / 65535 * 100
                    pose/<frame>.npy               world-to-camera matrix
                    cam_K.npy                      3x3 intrinsics of all frames
                    aliasing_mask/<frame>.png      > 0 means "exclude"
<root>/fused_pcd/<a>-<b>-<c>.ply                   ground-truth points; a, b, c are the components of the scene name
```

Source: docs/benchmark.md, "Files of a scene".
"""

from pathlib import Path
from tokenize import TokenError

import numpy as np
import torch

from freegeo.data.datasets.base import Archive, Dataset, DatasetConstants, existing, read_gray, require_folder
from freegeo.data.photos import open_photos
from freegeo.data.scene import Scene, SceneTruth
from freegeo.errors import FreeGeoError, UserError
from freegeo.files import read_text

NAME = "hiroom"
_AGAIN = "Download it again."
SCENE_LIST = "selected_scene_list_val.txt"
_LARGEST_MATRIX = 1 << 16
"""Bytes of a file that can hold a matrix of a camera."""
_METRES_PER_STEP = 100 / 65535


def scene_names(root: Path) -> list[str]:
    """The scenes of the list file, in its order; UserError when the file is missing."""
    path = Path(root) / SCENE_LIST
    if not path.is_file():
        raise UserError(f"{path}: no such file. It lists the HiRoom scenes and comes with the benchmark data.")
    return [line.strip() for line in read_text(path, advice=_AGAIN).splitlines() if line.strip()]


def load_scene(root: Path, name: str) -> Scene:
    """Read the cameras and paths of one scene; frames without a pose are skipped.

    Raises:
        UserError: the folder is missing. FreeGeoError: a matrix is damaged, or no frame is left.
    """
    folder = require_folder(Path(root) / "data" / name, "a HiRoom scene")
    files = sorted((path for path in require_folder(folder / "image", "images").iterdir()), key=lambda path: path.name)
    frames = [path.name.split(".", 1)[0] for path in files]
    posed = [i for i, frame in enumerate(frames) if (folder / "pose" / f"{frame}.npy").is_file()]
    if not posed:
        raise FreeGeoError(f"{folder} holds no frame with both an image and a pose.")
    files, frames = [files[i] for i in posed], [frames[i] for i in posed]
    photos = open_photos(files)
    T = np.stack([_read_pose(folder / "pose" / f"{frame}.npy") for frame in frames])
    return Scene(
        name=name,
        photos=tuple(photos),
        T_cam_world=torch.tensor(T, dtype=torch.float32),
        K=torch.tensor(_read_matrix(folder / "cam_K.npy"), dtype=torch.float32)[:3, :3].repeat(len(frames), 1, 1),
        truth=SceneTruth(
            dataset=NAME,
            surface=Path(root) / "fused_pcd" / f"{'-'.join(Path(name).parts[-3:])}.ply",
            depth=tuple(existing(folder / "depth" / f"{frame}.png") for frame in frames),
            mask=tuple(existing(folder / "aliasing_mask" / f"{frame}.png") for frame in frames),
            camera_hw=tuple(photo.size_hw for photo in photos),
        ),
    )


def valid_mask(truth: SceneTruth, index: int, size_hw: tuple[int, int]) -> np.ndarray | None:
    """Pixels of one frame with a depth and without aliasing, (H, W) bool; None without a depth file."""
    depth_path, aliasing_path = truth.depth[index], truth.mask[index]
    if depth_path is None:
        return None
    keep = read_depth(depth_path, size_hw) > 0
    return keep if aliasing_path is None else keep & ~(read_gray(aliasing_path) > 0)


def read_depth(path: Path, photo_hw: tuple[int, int]) -> np.ndarray:
    """Ground-truth depth (H, W) float32 metres, 0 where there is none. `photo_hw` is not used."""
    return (read_gray(path) * _METRES_PER_STEP).astype(np.float32)


def _read_pose(path: Path) -> np.ndarray:
    T = np.eye(4)
    T[:3] = _read_matrix(path)[:3, :4]
    return T


def _read_matrix(path: Path) -> np.ndarray:
    try:
        if path.stat().st_size > _LARGEST_MATRIX:
            raise ValueError("far too large")
        matrix = np.load(path, allow_pickle=False)
    except (OSError, ValueError, TypeError, SyntaxError, TokenError, MemoryError, EOFError) as error:
        raise FreeGeoError(f"{path}: not a readable matrix ({error}).") from error
    if not isinstance(matrix, np.ndarray) or matrix.dtype.kind not in "fiu":
        raise FreeGeoError(f"{path}: a matrix of numbers was expected.")
    if matrix.ndim != 2 or min(matrix.shape) < 3:
        raise FreeGeoError(f"{path}: a matrix was expected, not shape {matrix.shape}.")
    return matrix


HIROOM = Dataset(
    name=NAME,
    constants=DatasetConstants(
        voxel=4 / 512,
        truncation=0.04,
        depth_limit=10_000.0,
        down_sample=4 / 512,
        threshold=0.05,
        truth="points",
    ),
    scene_names=scene_names,
    load_scene=load_scene,
    read_depth=read_depth,
    valid_mask=valid_mask,
    recipe_row=NAME,
    archive=Archive(
        gb=0.7,
        terms="research only, under the terms of SVLightVerse, its source: https://jerrypiglet.github.io/SVLightVerse",
    ),
)
