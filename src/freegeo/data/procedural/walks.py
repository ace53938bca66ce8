"""A long closed walk through a ring of rooms, photographed by a camera that comes back to its start.

Source: docs/embedded-model.md, "A long walk". The rooms are the cells around the edge of a grid, with a doorway from
each to the next. All of them are one scene of the ray tracer, whose box is the outer wall and whose second primitive is
the block within the ring, so depth and cameras are exact. With more frames there are more rooms at the same pace.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from freegeo.data.procedural.cameras import look
from freegeo.data.procedural.domains import Domain, get_domain
from freegeo.data.procedural.photographs import PHOTO_HW, SUPERSAMPLE, Aspect, to_bytes
from freegeo.data.procedural.raytrace import RenderedViews, intrinsics, render
from freegeo.data.procedural.rooms import (
    CLEARANCE_M,
    RoomBatch,
    distance_m,
    object_sizes,
    room_light,
    room_materials,
    uniform,
    upright_world,
)
from freegeo.data.scene import Scene
from freegeo.errors import UserError

TURN_DEG = 6.0
"""The camera turns by about this much from one frame to the next, times the domain's pace."""
ROOM_M = 6.0
"""Side of the square rooms."""
RADIUS_M = 2.1
"""The camera circles the middle of a room at this distance and looks inwards."""
CROSSING_DEG = 240.0
"""The place that the camera circles moves to the next room during so much of a circle."""
TARGET_HEIGHT_M = 0.9
CACHED_PHOTOS = 32

_HALF = ROOM_M / 2
_PARTITION_CLEARANCE_M = 0.95
_DOOR_M = _HALF - RADIUS_M + _PARTITION_CLEARANCE_M
"""Width of a doorway. It is at the outer wall, where the camera passes."""
_PANEL_M, _SLAB_M = 0.03, 0.01
_LAMP_SHARE, _LAMP_REACH_M = 0.6, 15.0
_FIRST_OBJECT = 4
_OBJECTS = ("box", "box", "box", "sphere", "cylinder", "box", "box", "sphere", "cylinder")
_CENTRAL = 5
"""How many of the things in a room, the first ones, stand in its middle; the others stand along its walls."""


class _Cell(NamedTuple):
    """One room: its middle on the ground, and the directions of walking into and out of it in quarter turns."""

    x: float
    y: float
    into: int
    out: int


class _Part(NamedTuple):
    """One box, sphere or cylinder besides the block."""

    kind: str
    cell: int
    slot: int
    """Its place in the list of the cell: walls, floor, then things."""
    center: tuple[float, float, float]
    yaw: float
    size: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Walk:
    """Rooms with the cameras of a walk through them; photos are rendered when they are read."""

    rooms: RoomBatch
    """One scene that holds all rooms."""
    photo_hw: tuple[int, int]
    room_count: int
    look_alikes: tuple[int, int] | None
    """Two frames that show the same view of the two rooms with the same surfaces and things, where there are such."""

    def __len__(self) -> int:
        """Return the number of frames."""
        return self.rooms.frames

    @property
    def name(self) -> str:
        """Domain and seed, such as `walk-test-id-20000000`."""
        return f"walk-{self.rooms.domain.name}-{self.rooms.seeds[0]}"

    @property
    def photos(self) -> tuple[WalkPhoto, ...]:
        """All frames as photos."""
        return tuple(WalkPhoto(self, frame) for frame in range(len(self)))

    @property
    def T_cam_world(self) -> Tensor:
        """(N, 4, 4) metres."""
        return self.rooms.T_cam_world[0]

    @property
    def K(self) -> Tensor:
        """(N, 3, 3) pixels of the photos."""
        return intrinsics(self.rooms.fov_rad, *self.photo_hw).expand(len(self), 3, 3).clone()

    def render(self, frame: int, height: int, width: int, *, supersample: int = SUPERSAMPLE) -> RenderedViews:
        """Image and exact ground truth of one frame (B = S = 1), at any size."""
        return render(_in_view(self.rooms, frame), height, width, supersample=supersample, views=[frame])

    def scene(self, frames: Sequence[int] | None = None) -> Scene:
        """Chosen frames, or all, as a scene; their true depth is traced and held in memory."""
        views = list(range(len(self)) if frames is None else frames)
        return Scene(
            name=self.name,
            photos=tuple(WalkPhoto(self, frame) for frame in views),
            T_cam_world=self.T_cam_world[views],
            K=self.K[views],
            depth_z=torch.cat([self.render(frame, *self.photo_hw, supersample=1).depth_z[0] for frame in views]),
        )


@dataclass(frozen=True)
class WalkPhoto:
    """One frame of a walk; usable wherever a photo is."""

    walk: Walk
    frame: int

    @property
    def name(self) -> str:
        """Number of the frame, such as `0012.png`."""
        return f"{self.frame:04d}.png"

    @property
    def size_hw(self) -> tuple[int, int]:
        """Height and width."""
        return self.walk.photo_hw

    def read(self) -> np.ndarray:
        """Render the frame (H, W, 3) uint8; the last few are kept."""
        return _pixels(self.walk, self.frame)


@lru_cache(maxsize=CACHED_PHOTOS)
def _pixels(walk: Walk, frame: int) -> np.ndarray:
    pixels = to_bytes(walk.render(frame, *walk.photo_hw).images[0, 0])
    pixels.flags.writeable = False
    return pixels


def walk(seed: int, domain: str | Domain, frames: int = 300, *, aspect: Aspect = "4:3", alike: bool = False) -> Walk:
    """Walk once through a ring of rooms; the last frame is one step before the first one.

    Args:
        seed: one that the domain owns (`Domain.seeds`).
        domain: gives surfaces, light, lens and the camera's response; its `pace` is a factor on the turns.
        frames: how many photos; about 60 to a room, of which there are at least four.
        aspect: of the photos, which have the size of other generated photos.
        alike: two corner rooms on opposite sides of the ring have the same walls, floor and things, which stand in
            other places.

    Raises:
        UserError: a negative seed, an unknown domain, or fewer frames than four rooms need.
    """
    domain = get_domain(domain)
    if seed < 0:
        raise UserError("a walk needs a seed of 0 or more")
    # The way into and out of every room is one circle, and going round the ring is one more.
    count = 2 * round((frames * domain.pace * TURN_DEG / 360 - 1) / 2)
    if count < 4:
        fewest = math.ceil(4 * 360 / (domain.pace * TURN_DEG))
        raise UserError(f"a walk through four rooms has at least {fewest} frames, not {frames}")
    numbers = uniform([seed], 6, 8)[0].tolist()
    height = 2.5 + 0.8 * numbers[0]
    cells, edges = _ring(count)
    corner = next(number for number, cell in enumerate(cells) if number and cell.into != cell.out)
    parts = _parts(seed, cells, height)
    first_sphere = 2 + sum(part.kind == "box" for part in parts)
    first_cylinder = first_sphere + sum(part.kind == "sphere" for part in parts)
    middle = (0.0, 0.0, height / 2)
    block = tuple(max(edge - ROOM_M, 0.02) for edge in edges)
    center = torch.tensor([[middle, middle, *(part.center for part in parts)]])
    size = torch.tensor([[(*edges, height / 2), (*block, height / 2), *(part.size for part in parts)]])
    angle = torch.tensor([[0.0, 0.0, *(part.yaw for part in parts)]])
    yaw = torch.stack([angle.cos(), angle.sin()], dim=-1)
    materials = room_materials([seed], domain, 7 + len(parts))
    if alike:
        _copy_room(parts, size, materials, corner, corner + count // 2)
    T_cam_room = _cameras(seed, frames, cells, numbers[1])
    camera = -(T_cam_room[:, :3, :3].mT @ T_cam_room[:, :3, 3:])[None, ..., 0]
    near = (distance_m(camera, center, yaw, size, first_sphere, first_cylinder) < CLEARANCE_M).any(dim=1)
    # Only things make way: walls and floors stay.
    near &= torch.tensor([False, False, *(part.slot >= _FIRST_OBJECT for part in parts)])
    light = room_light([seed], domain, torch.tensor([[1.0, 1.0, height]]))
    low, high = domain.field_of_view_deg
    rooms = RoomBatch(
        domain=domain,
        seeds=(seed,),
        center=center,
        yaw=yaw,
        size=torch.where(near[..., None], -1.0, size),
        **materials,
        **light
        | {
            "lamp_position": torch.tensor([[(cell.x, cell.y, 0.85 * height) for cell in cells]]),
            "lamp_colour": _LAMP_SHARE * light["lamp_colour"].expand(1, count, 3),
        },
        fov_rad=torch.deg2rad(torch.tensor([low + (high - low) * numbers[2]])),
        is_arc=torch.tensor([True]),
        T_cam_room=T_cam_room[None],
        T_room_world=upright_world(torch.tensor([numbers[3:7]])),
        first_sphere=first_sphere,
        first_cylinder=first_cylinder,
    )
    # Halfway through the turn of the first corner after the start, and half the way round later.
    first = round(frames * (corner + 1 / 8) / (count + 1))
    return Walk(rooms, PHOTO_HW[aspect], count, (first, first + frames // 2) if alike else None)


def _ring(count: int) -> tuple[list[_Cell], tuple[float, float]]:
    """Cells around the edge of a grid, counter-clockwise from the first after a corner, and the grid's half sizes."""
    long, short = (count + 2) // 4 + 1, count // 4 + 1
    assert 2 * (long + short) - 4 == count
    steps = [side for side, cells in enumerate((long, short, long, short)) for _ in range(cells - 1)]
    x, y = -(long - 1) * _HALF, -(short - 1) * _HALF
    cells = []
    for number, side in enumerate(steps):
        cells.append(_Cell(x, y, steps[number - 1], side))
        x, y = (a + b for a, b in zip((x, y), _turned(side, ROOM_M, 0.0), strict=True))
    return cells, (long * _HALF, short * _HALF)


def _turned(side: int, along: float, inwards: float) -> tuple[float, float]:
    """Place so far along the way, and so far to its left, where the way goes in direction `side` (quarter turns)."""
    x, y = along, inwards
    return ((x, y), (-y, x), (-x, -y), (y, -x))[side % 4]


def _parts(seed: int, cells: list[_Cell], height: float) -> list[_Part]:
    """Walls, floors and things of all rooms; boxes first, then spheres, then cylinders."""
    numbers = uniform([seed], 7, len(cells) * len(_OBJECTS) * 8)[0].view(len(cells), len(_OBJECTS), 8)
    sizes = object_sizes(numbers)
    partition = ROOM_M - _DOOR_M
    parts = []
    for number, cell in enumerate(cells):

        def add(kind: str, slot: int, side: int, along: float, inwards: float, z: float, yaw: float, size) -> None:
            x, y = _turned(side, along, inwards)
            center = (cell.x + x, cell.y + y, z)  # noqa: B023 (called in this round of the loop only)
            parts.append(_Part(kind, number, slot, center, yaw + side % 4 * math.pi / 2, tuple(size)))  # noqa: B023

        wall = (_HALF, _PANEL_M, height / 2)
        add("box", 0, cell.into, 0.0, _PANEL_M - _HALF, height / 2, 0.0, wall)
        # A corner has a second outer wall where another room has the block.
        other = (cell.into, _HALF - _PANEL_M) if cell.into == cell.out else (cell.out, _PANEL_M - _HALF)
        add("box", 1, other[0], 0.0, other[1], height / 2, 0.0, wall)
        add(
            "box", 2, cell.out, _HALF, _HALF - partition / 2, height / 2, math.pi / 2, (partition / 2, 0.05, height / 2)
        )
        add("box", 3, cell.into, 0.0, 0.0, _SLAB_M, 0.0, (_HALF, _HALF, _SLAB_M))
        for slot, kind in enumerate(_OBJECTS):
            drawn = numbers[number, slot].tolist()
            size = sizes[kind][number, slot].tolist()
            lift = (drawn[3] - 0.75) * 4 * (height - 2 * size[2]) if drawn[3] > 0.75 else 0.0
            bearing = 2 * math.pi * drawn[0]
            if slot < _CENTRAL:
                along, inwards = (0.25 * _HALF * math.sqrt(drawn[2]) * f(bearing) for f in (math.cos, math.sin))
            else:
                limit = _HALF - max(size[:2]) / 2
                along, inwards = (max(-limit, min(limit, 1.5 * _HALF * f(bearing))) for f in (math.cos, math.sin))
            add(kind, _FIRST_OBJECT + slot, cell.into, along, inwards, lift + size[2], 2 * math.pi * drawn[4], size)
    return sorted(parts, key=lambda part: ("box", "sphere", "cylinder").index(part.kind))


def _copy_room(parts: list[_Part], size: Tensor, materials: dict[str, Tensor], source: int, target: int) -> None:
    """Give one room the surfaces of another, and things of the same sizes."""
    where = {(part.cell, part.slot): number for number, part in enumerate(parts, start=2)}
    for slot in range(_FIRST_OBJECT + len(_OBJECTS)):
        old, new = where[source, slot], where[target, slot]
        size[:, new] = size[:, old]
        for value in materials.values():
            value[:, 5 + new] = value[:, 5 + old]


def _cameras(seed: int, frames: int, cells: list[_Cell], phase: float) -> Tensor:
    """`T_cam_room` (N, 4, 4): the camera circles one room's middle after the other, with the jitter of a hand."""
    jitter = 2 * uniform([seed], 8, frames * 6).view(frames, 6) - 1
    turned = 360 * (len(cells) + 1) * torch.arange(frames) / frames
    target = torch.tensor([cells[0].x, cells[0].y]).repeat(frames, 1)
    side = 0
    for number, cell in enumerate(cells):
        side += (cell.out - side) % 4
        # It passes the doorway where it is at the outer wall, to the right of the way.
        share = (turned - 360 * number - 90 * side - 180) / CROSSING_DEG + 0.5
        target = target + share.clamp(0, 1)[:, None] * torch.tensor(_turned(side, ROOM_M, 0.0))
    bearing = torch.deg2rad(turned + 90)
    ground = target + RADIUS_M * torch.stack([bearing.cos(), bearing.sin()], dim=-1)
    height = 1.4 + 0.2 * torch.sin(2 * bearing + 2 * math.pi * phase)
    position = torch.cat([ground, height[:, None]], dim=-1) + torch.tensor([0.02, 0.02, 0.05]) * jitter[:, :3]
    yaw = bearing + math.pi + math.radians(0.8) * jitter[:, 3]
    pitch = torch.atan2(TARGET_HEIGHT_M - height, torch.tensor(RADIUS_M)) + math.radians(2.0) * jitter[:, 4]
    return look(position, yaw, pitch, math.radians(3.0) * jitter[:, 5])


def _in_view(rooms: RoomBatch, frame: int) -> RoomBatch:
    """The rooms with only what one frame may see, by a ball around each thing, and with the lamps that are near it."""
    T = rooms.T_cam_room[0, frame]
    x, y, z = (rooms.center[0] @ T[:3, :3].mT + T[:3, 3]).unbind(-1)
    radius = rooms.size[0].norm(dim=-1)
    half = rooms.fov_rad[0] / 2
    # Photos are not higher than they are wide.
    inside = torch.maximum(x.abs(), y.abs()) * half.cos() - z * half.sin() <= radius
    keep = inside & (z + radius > 0) & (rooms.size[0, :, 0] > 0)
    keep[:2] = True
    surfaces = torch.cat([torch.ones(6, dtype=torch.bool), keep[1:]])
    camera = -(T[:3, :3].mT @ T[:3, 3])
    lit = (rooms.lamp_position[0] - camera).norm(dim=-1) < _LAMP_REACH_M
    chosen = {name: getattr(rooms, name)[:, keep] for name in ("center", "yaw", "size")}
    chosen |= {name: getattr(rooms, name)[:, surfaces] for name in ("texture", "period_m", "offset", "colour")}
    chosen |= {name: getattr(rooms, name)[:, lit] for name in ("lamp_position", "lamp_colour")}
    first_sphere, first_cylinder = (int(keep[:end].sum()) for end in (rooms.first_sphere, rooms.first_cylinder))
    return replace(rooms, **chosen, first_sphere=first_sphere, first_cylinder=first_cylinder)
