"""What Pi3X is told of its views, as its network reads it (docs/models/pi3.md, "What is known of the views").

Letters as in pi3.py; d is the width of an attention head.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from freegeo.geometry.se3 import inverse
from freegeo.models.transformer import ROPE_BASE
from freegeo.types import Priors

STATIC = 0.02
"""Largest distance of normalised cameras from the first up to which they count as standing in one place."""
SMALL = 1e-8


@dataclass(frozen=True, kw_only=True, eq=False)
class Given:
    """What is known of the views, normalised; on the model's device, in float32."""

    T_cam_world: Tensor | None = None
    """(B, S, 4, 4), the world being the frame of a scene's first view; None: no pose is used."""
    posed: tuple[list[int], ...] = ()
    """Views of each scene whose pose is used."""
    rays: tuple[Tensor, Tensor] | None = None
    """The slopes x/z and y/z of every pixel's ray (B, S, 2, H, W), and views where they are known (B, S)."""
    depth: tuple[Tensor, Tensor] | None = None
    """Depth over the scene's mean depth, and 1 where it is known (B, S, 2, H, W); views with depth (B, S)."""


def given_of(priors: Priors, image_hw: tuple[int, int], device: torch.device) -> Given:
    """Prepare priors: what is known of each view, whatever its frame and unit.

    Unlike in the reference implementation, where views without a pose have an arbitrary one, these count neither as the
    frame nor in the scale of the poses.
    """
    has_pose, has_rays = priors.views_with("pose"), priors.views_with("K")
    depth_z = None if priors.depth_z is None else priors.depth_z.float()
    has_depth = torch.zeros_like(has_pose) if depth_z is None else (depth_z > 0).flatten(2).any(-1)
    T_world_cam = None
    if priors.T_cam_world is not None:
        T_world_cam = inverse(priors.T_cam_world.double())
        first = has_pose.int().argmax(1)
        frame = T_world_cam[torch.arange(len(first)), first]
        T_world_cam = torch.where(has_pose[..., None, None], T_world_cam, frame[:, None])
        T_world_cam = frame[:, None].inverse() @ T_world_cam
    rays = None if priors.K is None else pixel_slopes(priors.K, image_hw)
    return prepare(
        T_world_cam, rays, depth_z, has_pose=has_pose, has_rays=has_rays, has_depth=has_depth, counted=has_pose,
        device=device,
    )  # fmt: skip


def pixel_slopes(K: Tensor, image_hw: tuple[int, int]) -> Tensor:
    """Slopes x/z and y/z (..., 2, H, W), float32, of the rays through the pixels, whose centres are whole numbers."""
    height, width = image_hw
    x = (torch.arange(width) - K[..., 0, 2, None]) / K[..., 0, 0, None]
    y = (torch.arange(height) - K[..., 1, 2, None]) / K[..., 1, 1, None]
    size = (*K.shape[:-2], height, width)
    return torch.stack((x[..., None, :].expand(size), y[..., :, None].expand(size)), dim=-3).float()


def prepare(
    T_world_cam: Tensor | None,
    rays: Tensor | None,
    depth_z: Tensor | None,
    *,
    has_pose: Tensor,
    has_rays: Tensor,
    has_depth: Tensor,
    counted: Tensor,
    device: torch.device,
) -> Given:
    """Normalise what is known and bring it to a device; everything is (B, S, ...).

    Args:
        T_world_cam: camera to world, (B, S, 4, 4).
        rays: slopes, (B, S, 2, H, W).
        depth_z: (B, S, H, W), 0 where it is not known.
        has_pose: bool, as the next four: views whose pose is known.
        has_rays: views whose rays are known.
        has_depth: views whose depth is used; the others' has a part in the mean depth.
        counted: views whose distance from the first has a part in the scale of the poses.
        device: where the network is.
    """
    unit = torch.ones(len(has_depth))
    if depth_z is not None:
        known = depth_z > 0
        total, count = (depth_z * known).flatten(1).sum(1), known.flatten(1).sum(1)
        unit = torch.where(count > 0, total / count.clamp(min=1), 1.0)
        scaled = depth_z / (unit[:, None, None, None] + SMALL)
        depth_z = torch.stack((scaled, (scaled > 0).float()), dim=2)
    T_cam_world, posed = None, ()
    if T_world_cam is not None:
        # A single pose says nothing.
        used = has_pose & (has_pose.sum(1, keepdim=True) > 1)
        posed = tuple(views.nonzero()[:, 0].tolist() for views in used)
        if any(posed):
            T_cam_world = inverse(_normalised(T_world_cam, unit, has_depth, counted)).float().to(device)
    return Given(
        T_cam_world=T_cam_world,
        posed=posed,
        rays=None if rays is None or not has_rays.any() else (rays.to(device), has_rays.to(device)),
        depth=None if depth_z is None or not has_depth.any() else (depth_z.to(device), has_depth.to(device)),
    )


def _normalised(T_world_cam: Tensor, unit_B: Tensor, has_depth: Tensor, counted: Tensor) -> Tensor:
    """Return poses in the first view's frame, float64; depth gives their unit, and where there is none, they do."""
    T = inverse(T_world_cam[:, :1].double()) @ T_world_cam.double()
    t = T[..., :3, 3] / unit_B[:, None, None]
    distance, others = t.norm(dim=-1), counted[:, 1:].double()
    mean = (distance[:, 1:] * others).sum(1) / others.sum(1).clamp(min=1)
    rescaled = ~has_depth.any(1) & (distance.amax(1) >= STATIC)
    t = torch.where(rescaled[:, None, None], t / (mean + SMALL)[:, None, None], t)
    T = T.clone()
    T[..., :3, 3] = t
    return T


@dataclass(frozen=True, eq=False)
class PoseTables:
    """How the attention between posed views turns tokens: by the views' poses, and by the patches' places."""

    T_S44: Tensor
    T_inverse_S44: Tensor
    column_Pf: tuple[Tensor, Tensor]
    """Cosines and sines."""
    row_Pf: tuple[Tensor, Tensor]


def pose_tables(T_cam_world_S44: Tensor, grid_hw: tuple[int, int], head_dim: int) -> PoseTables:
    """Build the tables of the posed views of a scene, in float32 under autocast too.

    ValueError for a head width that 8 does not divide.
    """
    if head_dim % 8:
        raise ValueError(f"poses turn heads of a width divisible by 8, got {head_dim}")
    device, count = T_cam_world_S44.device, head_dim // 8
    frequencies = ROPE_BASE ** -(torch.arange(count, device=device) / count)
    rows, columns = torch.meshgrid(*(torch.arange(n, device=device) for n in grid_hw), indexing="ij")
    (column, row) = (
        (angle.cos(), angle.sin()) for angle in (n.flatten()[:, None] * frequencies for n in (columns, rows))
    )
    with torch.autocast(device.type, enabled=False):
        return PoseTables(T_cam_world_S44, inverse(T_cam_world_S44), column, row)


def turn(x_HLd: Tensor, tables: PoseTables, what: Literal["query", "value", "output"]) -> Tensor:
    """Turn queries, keys and values ("value" for both), or what attention returns; heads, tokens of all views, d.

    In float32 under autocast too.
    """
    views, patches = len(tables.T_S44), len(tables.row_Pf[0])
    x = x_HLd.float().unflatten(1, (views, patches))
    half, quarter = x.shape[-1] // 2, x.shape[-1] // 4
    matrix = {"query": tables.T_S44.mT, "value": tables.T_inverse_S44, "output": tables.T_S44}[what]
    with torch.autocast(x.device.type, enabled=False):
        by_pose = torch.einsum("sij,hspkj->hspki", matrix, x[..., :half].unflatten(-1, (-1, 4))).flatten(-2)
    back = what == "output"
    by_column = _rotated(x[..., half : half + quarter], tables.column_Pf, back=back)
    by_row = _rotated(x[..., half + quarter :], tables.row_Pf, back=back)
    return torch.cat([by_pose, by_column, by_row], dim=-1).flatten(1, 2).to(x_HLd.dtype)


def _rotated(x: Tensor, table: tuple[Tensor, Tensor], *, back: bool) -> Tensor:
    (cosine, sine), (first, second) = table, x.chunk(2, dim=-1)
    sine = -sine if back else sine
    return torch.cat([first * cosine + second * sine, second * cosine - first * sine], dim=-1)
