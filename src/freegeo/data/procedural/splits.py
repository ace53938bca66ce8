"""Generated rooms as datasets of the benchmark: rendered on first use, kept in files, read like a downloaded scene.

```
<root>/<seed>.npz          photos (F, H, W, 3) uint8, depth_z (F, H, W) float32, T_cam_world, K
<root>/<seed>.ply          ground-truth points of all frames, metres
```

`<root>` is `<data>/procedural-<domain>`. Source: specification of the embedded model, section 9.
"""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np
import torch

from freegeo.data.datasets.base import Protocol, SceneTruth
from freegeo.data.procedural.domains import DOMAINS, get_domain
from freegeo.data.procedural.photographs import RenderedPhoto, photograph_room
from freegeo.data.scene import Scene
from freegeo.errors import FreeGeoError, UserError
from freegeo.files import atomic_path, write_npz
from freegeo.geometry.depth import depth_to_world, valid_depth

PREFIX = "procedural-"
FRAMES = 16
POINT_SPACING = 0.04
DEPTH_LIMIT_M = 20.0
"""Farther than any wall; a prediction with a broken scale would otherwise fill the memory with empty voxels."""


class RoomSplit:
    """One domain of generated rooms with the functions of a dataset module."""

    def __init__(self, domain: str):
        self.domain = get_domain(domain)
        self.PROTOCOL = Protocol(
            dataset=f"{PREFIX}{domain}",
            voxel=0.04,
            truncation=0.16,
            depth_limit=DEPTH_LIMIT_M,
            down_sample=POINT_SPACING,
            threshold=0.15,
            truth="points",
            samples=200_000,
        )

    def scene_names(self, root: Path) -> list[str]:
        """The seeds of the split's rooms, as text; `root` does not matter here."""
        return [str(seed) for seed in self.domain.seeds()]

    def load_scene(self, root: Path, name: str) -> Scene:
        """Read a room, rendering it first when its files are not there.

        Raises:
            UserError: no seed of this split. FreeGeoError: a file is damaged.
        """
        if not name.isdigit() or int(name) not in self.domain.seeds(self.domain.seed_count):
            raise UserError(
                f"{name!r} is no room of the split {self.domain.name}; its first is {self.domain.first_seed}."
            )
        images, points = Path(root) / f"{name}.npz", Path(root) / f"{name}.ply"
        if not (images.is_file() and points.is_file()):
            _render(int(name), self.domain.name, images, points)
        arrays = _read(images)
        photos = tuple(RenderedPhoto(f"{i:02d}.png", pixels) for i, pixels in enumerate(arrays["photos"]))
        size_hw = photos[0].size_hw
        return Scene(
            name=name,
            photos=photos,
            T_cam_world=torch.from_numpy(arrays["T_cam_world"]),
            K=torch.from_numpy(arrays["K"]),
            depth_z=torch.from_numpy(arrays["depth_z"]),
            truth=SceneTruth(
                dataset=self.PROTOCOL.dataset,
                surface=points,
                depth=(None,) * len(photos),
                mask=(None,) * len(photos),
                camera_hw=(size_hw,) * len(photos),
            ),
        )

    def valid_mask(self, truth: SceneTruth, index: int, size_hw: tuple[int, int]) -> None:
        """No pixel of a room is masked."""
        return


SPLITS = {f"{PREFIX}{name}": RoomSplit(name) for name in DOMAINS}


def _render(seed: int, domain: str, images: Path, points: Path) -> None:
    room = photograph_room(seed, domain, frames=FRAMES)
    assert room.T_cam_world is not None and room.K is not None and room.depth_z is not None
    arrays = {"T_cam_world": room.T_cam_world, "K": room.K, "depth_z": room.depth_z}
    write_points(points, surface_points(room.depth_z, room.K, room.T_cam_world))
    photos = np.stack([photo.read() for photo in room.photos])
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
    try:
        with np.load(path, allow_pickle=False) as content:
            return {name: content[name] for name in ("photos", "depth_z", "T_cam_world", "K")}
    except (zipfile.BadZipFile, zlib.error, ValueError, KeyError, EOFError, OSError) as error:
        raise FreeGeoError(f"{path}: damaged room ({error}). Remove it; it is rendered again.") from None
