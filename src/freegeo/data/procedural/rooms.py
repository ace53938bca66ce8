"""Sampling of generated rooms: primitives, materials, light and cameras.

A room is a box of six faces with five yaw-rotated boxes, two spheres and two capped cylinders. Each room's numbers come
from its own seed, never from its neighbours in a batch. Source: docs/embedded-model.md, "How the rooms are made".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from freegeo.data.procedural.cameras import FRAME_NUMBERS, TRAJECTORY_NUMBERS, camera_poses
from freegeo.data.procedural.domains import Domain, get_domain
from freegeo.data.procedural.textures import TEXTURE_COUNT
from freegeo.errors import UserError

BOXES, SPHERES, CYLINDERS = 5, 2, 2
PRIMITIVES = 1 + BOXES + SPHERES + CYLINDERS
"""Primitive 0 is the room itself; boxes, spheres and cylinders follow in this order."""
FIRST_SPHERE, FIRST_CYLINDER = 1 + BOXES, 1 + BOXES + SPHERES
MATERIALS = 6 + PRIMITIVES - 1
"""Materials 0-5 are the room's faces (-x, +x, -y, +y, floor, ceiling), 5 + k is the material of primitive k."""
CLEARANCE_M = 0.8
"""A primitive that comes closer to a camera is left out: at 0.3 m many views showed one surface and nothing else."""
PERIOD_M = (2.5, 6.0)

_OBJECT_NUMBERS = 8
_MATERIAL_NUMBERS = 17
_LIGHT_NUMBERS = 16


@dataclass(frozen=True)
class RoomBatch:
    """B rooms with S cameras each. Room frame: origin in the middle of the floor, z up, metres."""

    domain: Domain
    seeds: tuple[int, ...]
    center: Tensor  # (B, P, 3) room frame
    yaw: Tensor  # (B, P, 2) cosine and sine
    size: (
        Tensor  # (B, P, 3) half sizes; spheres: radius three times; cylinders: radius, radius, half height; absent: -1
    )
    texture: Tensor  # (B, M, 2) int64
    period_m: Tensor  # (B, M, 2)
    offset: Tensor  # (B, M, 2, 2) texture, then u and v, in periods
    colour: Tensor  # (B, M, 3, 3) three colours, RGB in [0, 1]
    lamp_position: Tensor  # (B, L, 3)
    lamp_colour: Tensor  # (B, L, 3)
    ambient: Tensor  # (B,)
    gamma: Tensor  # (B,)
    cast: Tensor  # (B, 3) factor on each colour channel
    fov_rad: Tensor  # (B,) horizontal
    is_arc: Tensor  # (B,) bool
    T_cam_room: Tensor  # (B, S, 4, 4)
    T_room_world: Tensor  # (B, 4, 4)
    first_sphere: int
    """Number of the first sphere among the primitives; those from 1 to there are boxes."""
    first_cylinder: int
    """Number of the first cylinder."""

    def __len__(self) -> int:
        return len(self.seeds)

    @property
    def frames(self) -> int:
        """Number of cameras in each room."""
        return self.T_cam_room.shape[1]

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self.center.device

    @property
    def T_cam_world(self) -> Tensor:
        """(B, S, 4, 4). The world frame stands upright (z up), turned and moved at random against the room."""
        return self.T_cam_room @ self.T_room_world[:, None]

    def to(self, device: torch.device | str) -> RoomBatch:
        """The same rooms on `device`."""
        tensors = {f.name: value.to(device) for f in fields(self) if isinstance(value := getattr(self, f.name), Tensor)}
        return replace(self, **tensors)

    def rooms(self, start: int, stop: int) -> RoomBatch:
        """Rooms `start` to `stop - 1` of the batch."""
        tensors = {
            f.name: value[start:stop] for f in fields(self) if isinstance(value := getattr(self, f.name), Tensor)
        }
        return replace(self, seeds=self.seeds[start:stop], **tensors)


def sample_rooms(
    seeds: Sequence[int], *, domain: str | Domain = "train", frames: int = 10, device: torch.device | str = "cpu"
) -> RoomBatch:
    """One room per seed with `frames` cameras each.

    A seed always gives the same room; with more frames the same contents are seen along a longer trajectory (primitives
    that come close to the additional cameras are dropped as well).

    Args:
        seeds: non-negative integers; `Domain.seeds` names those that belong to the domain.
        domain: name or `Domain`, see `freegeo.data.procedural.domains`.
        frames: views per room, at least 1.
        device: where the tensors are put; the numbers themselves are always drawn on the CPU.

    Raises:
        UserError: no seeds, a negative seed, no frames, or an unknown domain.
    """
    domain = get_domain(domain)
    seeds = tuple(int(seed) for seed in seeds)
    if not seeds or min(seeds) < 0 or frames < 1:
        raise UserError("rooms need at least one seed, seeds of 0 or more, and at least one frame")
    half_extent, placed = _contents(seeds, domain)
    trajectory = uniform(seeds, 1, TRAJECTORY_NUMBERS + 5)
    jitter = uniform(seeds, 2, frames * FRAME_NUMBERS).view(len(seeds), frames, FRAME_NUMBERS)
    T_cam_room, is_arc = camera_poses(half_extent, trajectory[:, :TRAJECTORY_NUMBERS], jitter, pace=domain.pace)
    center, yaw, size = _placement(half_extent, placed, is_arc)
    camera = -(T_cam_room[..., :3, :3].mT @ T_cam_room[..., :3, 3:])[..., 0]
    near = (distance_m(camera, center, yaw, size, FIRST_SPHERE, FIRST_CYLINDER) < CLEARANCE_M).any(dim=1)
    near[:, 0] = False
    low, high = domain.field_of_view_deg
    batch = RoomBatch(
        domain=domain,
        seeds=seeds,
        center=center,
        yaw=yaw,
        size=torch.where(near[..., None], -1.0, size),
        **room_materials(seeds, domain),
        **room_light(seeds, domain, half_extent),
        fov_rad=torch.deg2rad(low + (high - low) * trajectory[:, TRAJECTORY_NUMBERS]),
        is_arc=is_arc,
        T_cam_room=T_cam_room,
        T_room_world=upright_world(trajectory[:, TRAJECTORY_NUMBERS + 1 :]),
        first_sphere=FIRST_SPHERE,
        first_cylinder=FIRST_CYLINDER,
    )
    return batch.to(device)


def uniform(seeds: Sequence[int], stream: int, count: int) -> Tensor:
    """(B, count) uniform numbers: row b depends on `seeds[b]` and `stream` alone, and is a prefix of longer rows."""
    rows = np.stack([np.random.default_rng((seed, stream)).random(count) for seed in seeds])
    return torch.from_numpy(rows.astype(np.float32))


def _contents(seeds: Sequence[int], domain: Domain) -> tuple[Tensor, Tensor]:
    """(B, 3) half width, half depth and full height; (B, P - 1, 8) uniform numbers of the primitives."""
    numbers = uniform(seeds, 0, 3 + (PRIMITIVES - 1) * _OBJECT_NUMBERS)
    low, high = domain.half_extent_m
    extent = low + (high - low) * numbers[:, :2]
    height = 2.5 + 0.8 * numbers[:, 2:3]
    return torch.cat([extent, height], dim=1), numbers[:, 3:].view(-1, PRIMITIVES - 1, _OBJECT_NUMBERS)


def _placement(half_extent: Tensor, numbers: Tensor, is_arc: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Centre, yaw and size of all primitives, the room first: (B, P, 3), (B, P, 2), (B, P, 3)."""
    size = _sizes(numbers)
    # Arcs look at the middle of the room, walks at its rim: that is where most things stand.
    bearing = 2.0 * math.pi * numbers[..., 0]
    central = (numbers[..., 1] < 0.75) & is_arc[:, None]
    rim = (numbers[..., 1] < 0.8) & ~is_arc[:, None]
    share = torch.where(central, 0.5 * numbers[..., 2].sqrt(), 0.95 * numbers[..., 2].sqrt())
    share = torch.where(rim, 0.75 + 0.3 * numbers[..., 2], share)
    room = half_extent[:, None, :2]
    radius = share / torch.sqrt((bearing.cos() / room[..., 0]) ** 2 + (bearing.sin() / room[..., 1]) ** 2)
    ground = torch.stack([radius * bearing.cos(), radius * bearing.sin()], dim=-1)
    limit = (room - size[..., :2].amax(-1, keepdim=True)).clamp_min(0.0)
    ground = torch.clamp(ground, -limit, limit)
    free_height = half_extent[:, None, 2] - 2.0 * size[..., 2]
    lifted = numbers[..., 3] > 0.75
    base = torch.where(lifted, (numbers[..., 3] - 0.75) * 4.0 * free_height, 0.0)
    center = torch.cat([ground, (base + size[..., 2])[..., None]], dim=-1)
    angle = 2.0 * math.pi * numbers[..., 4]
    yaw = torch.stack([angle.cos(), angle.sin()], dim=-1)

    middle = torch.zeros_like(half_extent)
    middle[:, 2] = 0.5 * half_extent[:, 2]
    walls = half_extent * torch.tensor([1.0, 1.0, 0.5])
    no_turn = torch.tensor([1.0, 0.0]).expand(len(half_extent), 1, 2)
    return (
        torch.cat([middle[:, None], center], dim=1),
        torch.cat([no_turn, yaw], dim=1),
        torch.cat([walls[:, None], size], dim=1),
    )


def _sizes(numbers: Tensor) -> Tensor:
    """(B, P - 1, 3) half sizes in metres from uniform numbers (B, P - 1, 8)."""
    sizes = object_sizes(numbers)
    kind = torch.arange(1, PRIMITIVES)[:, None]
    return torch.where(
        kind < FIRST_SPHERE, sizes["box"], torch.where(kind < FIRST_CYLINDER, sizes["sphere"], sizes["cylinder"])
    )


def object_sizes(numbers: Tensor) -> dict[str, Tensor]:
    """Half sizes (..., 3) in metres of things from uniform numbers (..., 8), for each kind that they could be of."""
    box = torch.tensor([0.2, 0.2, 0.15]) + torch.tensor([0.5, 0.5, 0.75]) * numbers[..., 5:8]
    radius = 0.22 + 0.28 * numbers[..., 5:6]
    sphere = radius.expand(*numbers.shape[:-1], 3)
    cylinder = torch.cat([0.14 + 0.26 * numbers[..., 5:6].expand(*numbers.shape[:-1], 2), box[..., 2:]], dim=-1)
    return {"box": box, "sphere": sphere, "cylinder": cylinder}


def distance_m(
    point: Tensor, center: Tensor, yaw: Tensor, size: Tensor, first_sphere: int, first_cylinder: int
) -> Tensor:
    """Distance in metres of points (B, S, 3) from primitives (B, P, ...): (B, S, P), at most 0 inside."""
    offset = point[:, :, None] - center[:, None]
    cosine, sine = yaw[:, None, :, 0], yaw[:, None, :, 1]
    x, y = cosine * offset[..., 0] + sine * offset[..., 1], cosine * offset[..., 1] - sine * offset[..., 0]
    local = torch.stack([x, y, offset[..., 2]], dim=-1)
    box = (local.abs() - size[:, None]).clamp_min(0.0).norm(dim=-1)
    sphere = local.norm(dim=-1) - size[:, None, :, 0]
    radial = (torch.hypot(x, y) - size[:, None, :, 0]).clamp_min(0.0)
    cylinder = torch.hypot(radial, (offset[..., 2].abs() - size[:, None, :, 2]).clamp_min(0.0))
    kind = torch.arange(center.shape[1])
    return torch.where(kind < first_sphere, box, torch.where(kind < first_cylinder, sphere, cylinder))


def room_materials(seeds: Sequence[int], domain: Domain, count: int = MATERIALS) -> dict[str, Tensor]:
    """Textures, periods, offsets and colours of `count` surfaces."""
    numbers = uniform(seeds, 3, count * _MATERIAL_NUMBERS + 1)
    low, high = domain.contrast
    contrast = (low + (high - low) * numbers[:, -1])[:, None, None, None]
    numbers = numbers[:, :-1].view(-1, count, _MATERIAL_NUMBERS)
    colour = 0.12 + 0.85 * numbers[..., 8:17].unflatten(-1, (3, 3))
    grey = colour.mean(dim=-1, keepdim=True)
    colour = grey + domain.saturation * (colour - grey)
    first = colour[..., :1, :]
    return {
        "texture": (numbers[..., 0:2] * TEXTURE_COUNT).long().clamp_max(TEXTURE_COUNT - 1),
        "period_m": PERIOD_M[0] + (PERIOD_M[1] - PERIOD_M[0]) * numbers[..., 2:4],
        "offset": numbers[..., 4:8].unflatten(-1, (2, 2)),
        "colour": first + contrast * (colour - first),
    }


def room_light(seeds: Sequence[int], domain: Domain, half_extent: Tensor) -> dict[str, Tensor]:
    """Lamp, ambient share, and the gamma and colour cast of the camera."""
    numbers = uniform(seeds, 4, _LIGHT_NUMBERS)
    lamp_ground = (2.0 * numbers[:, :2] - 1.0) * 0.6 * half_extent[:, :2]
    lamp_height = half_extent[:, 2:] * (0.72 + 0.2 * numbers[:, 2:3])
    return {
        "lamp_position": torch.cat([lamp_ground, lamp_height], dim=1)[:, None],
        "lamp_colour": 0.9 + 0.2 * numbers[:, None, 3:6],
        "ambient": domain.ambient[0] + (domain.ambient[1] - domain.ambient[0]) * numbers[:, 6],
        "gamma": domain.gamma[0] + (domain.gamma[1] - domain.gamma[0]) * numbers[:, 7],
        "cast": 1.0 - domain.colour_cast * numbers[:, 8:11],
    }


def upright_world(numbers: Tensor) -> Tensor:
    """`T_room_world` (B, 4, 4): a turn about the vertical and an offset of up to 5 m, from uniform numbers (B, 4)."""
    angle = 2.0 * math.pi * numbers[:, 0]
    pose = torch.eye(4).repeat(len(numbers), 1, 1)
    pose[:, 0, 0], pose[:, 0, 1] = angle.cos(), -angle.sin()
    pose[:, 1, 0], pose[:, 1, 1] = angle.sin(), angle.cos()
    pose[:, :3, 3] = 10.0 * numbers[:, 1:4] - 5.0
    return pose
