"""Rendered rooms on disk: shards of one aspect each, written once, read whole into memory as bytes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from freegeo.data.procedural import get_domain, render, sample_rooms
from freegeo.data.procedural.domains import Domain
from freegeo.files import write_tensors

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

    def select(self, rooms: Tensor, frames: Tensor) -> Rooms:
        """Return some frames (R, F) of some rooms (R, 1)."""
        return Rooms(**{name: value[rooms, frames] for name, value in vars(self).items()})


def image_size(side: int, aspect: tuple[int, int], patch: int) -> tuple[int, int]:
    """Return height and width of an aspect at a longest side, in whole patches (ties upwards, as the model resizes)."""
    height = side * aspect[0] / aspect[1]
    return int(height + patch / 2) // patch * patch, side


def empty_rooms(rooms: int, frames: int, size: tuple[int, int], device: str) -> Rooms:
    """Reserve memory for rooms; on the CPU it is taken as it is written to."""
    return Rooms(
        images=torch.empty(rooms, frames, 3, *size, dtype=torch.uint8, device=device),
        depth_z=torch.empty(rooms, frames, *size, dtype=torch.float16, device=device),
        T_cam_world=torch.empty(rooms, frames, 4, 4, device=device),
        fov_vh=torch.empty(rooms, frames, 2, device=device),
    )


def render_rooms(seeds, domain: str | Domain, frames: int, size: tuple[int, int], *, device: str = "cpu") -> Rooms:
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
    """The training rooms of a run, one bank for each aspect; `grow` adds a shard until all rooms are there.

    On the CPU shards are files, which later legs read; on another device they stay in its memory.
    """

    def __init__(
        self,
        folder: Path,
        *,
        rooms: int,
        frames: int,
        side: int,
        patch: int,
        rooms_per_shard: int,
        domain: str | Domain = "train",
        first_room: int = 0,
        device: str = "cpu",
    ):
        self.folder, self.frames, self.side, self.patch, self.device = folder, frames, side, patch, device
        self.domain, self.first_room = get_domain(domain), first_room
        self.rooms_per_shard = rooms_per_shard
        self.total_shards = max(len(ASPECTS), -(-rooms // rooms_per_shard))
        self.shards = 0
        most = -(-self.total_shards // len(ASPECTS)) * rooms_per_shard
        self.banks = [empty_rooms(most, frames, image_size(side, aspect, patch), device) for aspect in ASPECTS]

    @property
    def rooms(self) -> int:
        """Rooms in memory."""
        return self.shards * self.rooms_per_shard

    @property
    def complete(self) -> bool:
        """Whether every room is in memory."""
        return self.shards >= self.total_shards

    def grow(self) -> bool:
        """Add the next shard, rendering it first where needed; False when there is none."""
        index = self.shards
        path = self.folder / f"rooms-{self.side}-{index:05d}.safetensors"
        if self.complete:
            return False
        if torch.device(self.device).type != "cpu":
            rooms = self._render(index)
        else:
            if not path.is_file():
                write_tensors(path, vars(self._render(index)))
            rooms = Rooms(**load_file(path))
        start = index // len(ASPECTS) * self.rooms_per_shard
        for name, kept in vars(self.banks[index % len(ASPECTS)]).items():
            kept[start : start + self.rooms_per_shard] = getattr(rooms, name)
        self.shards += 1
        return True

    def _render(self, index: int) -> Rooms:
        seeds = self.domain.seeds(self.rooms_per_shard, start=self.first_room + index * self.rooms_per_shard)
        size = image_size(self.side, ASPECTS[index % len(ASPECTS)], self.patch)
        return render_rooms(seeds, self.domain, self.frames, size, device=self.device)

    def draw(self, count: int, generator: torch.Generator) -> tuple[Rooms, Tensor]:
        """Draw rooms of one image size at random: their bank, and their places in it (count,) on the CPU."""
        aspect = int(torch.randint(self.shards, (), generator=generator)) % len(ASPECTS)
        filled = len(range(aspect, self.shards, len(ASPECTS))) * self.rooms_per_shard
        return self.banks[aspect], torch.randint(filled, (count,), generator=generator)
