"""Generated rooms as datasets of the benchmark: rendered on first use, kept in files, read like a downloaded scene.

```
<root>/<seed>.npz          photos (F, H, W, 3) uint8, depth_z (F, H, W) float32, T_cam_world, K
<root>/<seed>.ply          ground-truth points of all frames, metres
```

`<root>` is `<data>/procedural-<domain>`. Source: docs/benchmark.md, "Generated rooms".
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import torch

from freegeo.data.datasets.base import Dataset, DatasetConstants
from freegeo.data.photos import MemoryPhoto
from freegeo.data.procedural.domains import DOMAINS, get_domain
from freegeo.data.procedural.photographs import photograph_room
from freegeo.data.scene import Scene, SceneTruth
from freegeo.errors import DamagedError, UserError
from freegeo.files import Kind, atomic_path, read_npz, shared_folder, write_npz
from freegeo.geometry.depth import depth_to_world, valid_depth

PREFIX = "procedural-"
FRAMES = 16
POINT_SPACING = 0.04
_AGAIN = "Remove it; it is rendered again."
_KINDS: dict[str, Kind] = {
    "photos": ("u", (-1, -1, -1, 3)), "depth_z": ("f", (-1, -1, -1)), "T_cam_world": ("f", (-1, 4, 4)),
    "K": ("f", (-1, 3, 3)),
}  # fmt: skip
CONSTANTS = DatasetConstants(
    voxel=0.04,
    truncation=0.16,
    depth_limit=20.0,  # beyond any wall; a broken scale would otherwise fill the memory with empty voxels
    down_sample=POINT_SPACING,
    threshold=0.15,
    truth="points",
    samples=200_000,
)


def room_split(domain: str) -> Dataset:
    """Return a domain of generated rooms as a dataset; UserError for an unknown domain."""
    get_domain(domain)
    return Dataset(
        name=f"{PREFIX}{domain}",
        constants=CONSTANTS,
        scene_names=partial(room_names, domain),
        load_scene=partial(load_room, domain),
        recipe_row="procedural",
        generated=True,
    )


def room_names(domain: str, root: Path) -> list[str]:
    """Return the seeds of a domain's rooms, as text; `root` does not matter here."""
    return [str(seed) for seed in get_domain(domain).seeds()]


def load_room(domain: str, root: Path, name: str) -> Scene:
    """Read a room, rendering it first when its files are not there.

    Raises:
        UserError: no seed of this domain. FreeGeoError: a file is damaged.
    """
    own = get_domain(domain)
    if not name.isdigit() or int(name) not in own.seeds(own.seed_count):
        raise UserError(f"{name!r} is no room of the split {domain}; its first is {own.first_seed}.")
    images, points = Path(root) / f"{name}.npz", Path(root) / f"{name}.ply"
    if not (images.is_file() and points.is_file()):
        _render(int(name), domain, images, points)
    arrays = _read(images)
    photos = tuple(MemoryPhoto(f"{i:02d}.png", pixels) for i, pixels in enumerate(arrays["photos"]))
    return Scene(
        name=name,
        photos=photos,
        T_cam_world=torch.from_numpy(arrays["T_cam_world"]),
        K=torch.from_numpy(arrays["K"]),
        depth_z=torch.from_numpy(arrays["depth_z"]),
        truth=SceneTruth(
            dataset=f"{PREFIX}{domain}",
            surface=points,
            depth=(None,) * len(photos),
            mask=(None,) * len(photos),
            camera_hw=(photos[0].size_hw,) * len(photos),
        ),
    )


SPLITS = tuple(room_split(domain) for domain in DOMAINS)
"""Every domain as a dataset, such as `procedural-light`."""


def _render(seed: int, domain: str, images: Path, points: Path) -> None:
    room = photograph_room(seed, domain, frames=FRAMES)
    assert room.T_cam_world is not None and room.K is not None and room.depth_z is not None
    arrays = {"T_cam_world": room.T_cam_world, "K": room.K, "depth_z": room.depth_z}
    seen = surface_points(room.depth_z, room.K, room.T_cam_world)
    photos = np.stack([photo.read() for photo in room.photos])
    with shared_folder(images.parent):
        write_points(points, seen)
        write_npz(images, {"photos": photos, **{name: value.float().numpy() for name, value in arrays.items()}})


def surface_points(depth_z: torch.Tensor, K: torch.Tensor, T_cam_world: torch.Tensor) -> np.ndarray:
    """World points (n, 3) float32 seen by any frame, at most one (the first) in every cell of 4 cm."""
    points = depth_to_world(depth_z.double(), K.double(), T_cam_world.double())[valid_depth(depth_z)].numpy()
    cells = np.floor(points / POINT_SPACING).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return points[np.sort(first)].astype(np.float32)


def write_points(path: Path, points: np.ndarray) -> None:
    """Write a PLY cloud."""
    import trimesh

    with atomic_path(path) as part:
        trimesh.PointCloud(points).export(part, file_type="ply")


def _read(path: Path) -> dict[str, np.ndarray]:
    arrays = read_npz(path, _KINDS, advice=_AGAIN)
    if len({value.shape[0] for value in arrays.values()}) != 1 or arrays["photos"].shape[:3] != arrays["depth_z"].shape:
        raise DamagedError(path, "its photos, depth and cameras are not of the same views", _AGAIN)
    return arrays
