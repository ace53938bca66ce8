"""Rendered rooms on disk: shards of one aspect each, written once, read whole into memory as bytes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from freegeo.data.procedural import get_domain, render, sample_rooms
from freegeo.files import write_tensors

ROOMS_PER_SHARD = 96
ASPECTS = ((1, 1), (3, 4), (2, 3))
"""Height to width of the images; successive shards cycle through them."""


@dataclass(frozen=True, kw_only=True)
class Rooms:
    """Some rooms of one image size, with exact ground truth."""

    images: Tensor
    """(R, F, 3, H, W) uint8."""
    depth_z: Tensor
    """(R, F, H, W) float16, metres."""
    T_cam_world: Tensor
    """(R, F, 4, 4) float32."""
    fov_vh: Tensor
    """(R, F, 2) float32, radians, vertical first."""

    @property
    def frames(self) -> int:
        """Views of each room."""
        return self.images.shape[1]


def image_size(side: int, aspect: tuple[int, int], patch: int) -> tuple[int, int]:
    """Return height and width of an aspect at a longest side, in whole patches (ties upwards, as the model resizes)."""
    height = side * aspect[0] / aspect[1]
    return int(height + patch / 2) // patch * patch, side


def render_rooms(seeds, domain: str, frames: int, size: tuple[int, int], *, device: str = "cpu") -> Rooms:
    """Render rooms straight at the model's size, four rays a pixel."""
    views = render(sample_rooms(seeds, domain=domain, frames=frames, device=device), *size, supersample=2)
    half_extent = torch.stack([torch.full_like(views.K[..., 1, 1], n / 2) for n in size], dim=-1)
    focal = torch.stack([views.K[..., 1, 1], views.K[..., 0, 0]], dim=-1)
    return Rooms(
        images=(views.images * 255).round().to(torch.uint8),
        depth_z=views.depth_z.half(),
        T_cam_world=views.T_cam_world.float(),
        fov_vh=2 * torch.atan(half_extent / focal),
    )


class Pool:
    """The training rooms of a run; `grow` adds a shard until all rooms are there."""

    def __init__(
        self, folder: Path, *, rooms: int, frames: int, side: int, patch: int, first_room: int = 0, device: str = "cpu"
    ):
        self.folder, self.frames, self.side, self.patch, self.device = folder, frames, side, patch, device
        self.first_room = first_room
        self.total_shards = max(len(ASPECTS), -(-rooms // ROOMS_PER_SHARD))
        self.shards: list[Rooms] = []

    @property
    def complete(self) -> bool:
        """Whether every room is in memory."""
        return len(self.shards) >= self.total_shards

    def grow(self, *, render_new: bool = True) -> bool:
        """Load the next shard, rendering it first where needed; False when there is none."""
        index = len(self.shards)
        path = self.folder / f"rooms-{self.side}-{index:05d}.safetensors"
        if self.complete or not (render_new or path.is_file()):
            return False
        if not path.is_file():
            self._render(index, path)
        from safetensors.torch import load_file

        self.shards.append(Rooms(**load_file(path)))
        return True

    def _render(self, index: int, path: Path) -> None:
        seeds = get_domain("train").seeds(ROOMS_PER_SHARD, start=self.first_room + index * ROOMS_PER_SHARD)
        size = image_size(self.side, ASPECTS[index % len(ASPECTS)], self.patch)
        write_tensors(path, vars(render_rooms(seeds, "train", self.frames, size, device=self.device)))

    def draw(self, count: int, generator: torch.Generator) -> list[tuple[Rooms, int]]:
        """Draw rooms of one image size at random."""
        first = int(torch.randint(len(self.shards), (), generator=generator))
        same_size = self.shards[first % len(ASPECTS) :: len(ASPECTS)]
        per_shard = len(same_size[0].images)
        picks = torch.randint(len(same_size) * per_shard, (count,), generator=generator).tolist()
        return [(same_size[i // per_shard], i % per_shard) for i in picks]
