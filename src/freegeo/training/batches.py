"""Training samples: view windows of random rooms, augmented, in the frame and scale the model learns."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from freegeo.geometry import se3
from freegeo.training.config import Phase, TrainConfig
from freegeo.training.pool import Pool, Rooms


@dataclass(frozen=True, kw_only=True)
class Batch:
    """B samples of S views; world is view 0's camera, one unit is the sample's mean depth."""

    images: Tensor
    """(B, S, 3, H, W) in [0, 1]."""
    depth_z: Tensor
    """(B, S, H, W)."""
    T_world_cam: Tensor
    """(B, S, 4, 4)."""
    fov_vh: Tensor
    """(B, S, 2)."""

    @property
    def views(self) -> int:
        """Number of views in all samples."""
        return self.images.shape[0] * self.images.shape[1]


def window(frames: int, views: int, phase: Phase, generator: torch.Generator) -> list[int]:
    """Draw `views` frame numbers with a random stride, in walking order or reversed."""
    steps = max(views - 1, 1)
    most = min(phase.max_stride, max(1, phase.reach // steps), (frames - 1) // steps)
    stride = int(torch.randint(1, most + 1, (), generator=generator))
    start = int(torch.randint(frames - stride * (views - 1), (), generator=generator))
    picked = list(range(start, start + stride * views, stride))
    return picked[::-1] if torch.rand((), generator=generator) < 0.5 else picked


def draw_batch(
    pool: Pool, config: TrainConfig, seen: int, generator: torch.Generator, device: torch.device | str = "cpu"
) -> Batch:
    """Draw one step's samples for the phase of the run; the numbers are drawn on the CPU whatever the device."""
    phase = config.phase(seen)
    views = phase.views[int(torch.randint(len(phase.views), (), generator=generator))]
    picks = pool.draw(max(1, config.views_per_step // views), generator)
    parts = [(rooms, room, torch.tensor(window(rooms.frames, views, phase, generator))) for rooms, room in picks]
    gathered = Rooms(
        **{
            name: torch.stack([getattr(rooms, name)[room, frames] for rooms, room, frames in parts]).to(device)
            for name in ("images", "depth_z", "T_cam_world", "fov_vh")
        }
    )
    batch = to_batch(gathered)
    if phase.side != pool.side:
        batch = shrink(batch, phase.side / pool.side, pool.patch)
    return augment(batch, generator)


def shrink(batch: Batch, factor: float, patch: int) -> Batch:
    """Resize images and depth to whole patches; the fields of view stay."""
    size = [round(n * factor / patch) * patch for n in batch.images.shape[-2:]]
    images = F.interpolate(batch.images.flatten(0, 1), size, mode="bilinear", antialias=True)
    depth_z = F.interpolate(batch.depth_z, size, mode="bilinear")
    return replace(batch, images=images.unflatten(0, batch.images.shape[:2]), depth_z=depth_z)


def to_batch(rooms: Rooms) -> Batch:
    """Express rooms in view 0's frame and in units of their mean depth."""
    depth_z = rooms.depth_z.float()
    T_world_cam = rooms.T_cam_world[:, :1] @ se3.inverse(rooms.T_cam_world)
    scale = depth_z.mean(dim=(1, 2, 3))
    T_world_cam[..., :3, 3] /= scale[:, None, None]
    return Batch(
        images=rooms.images.float() / 255,
        depth_z=depth_z / scale[:, None, None, None],
        T_world_cam=T_world_cam,
        fov_vh=rooms.fov_vh,
    )


def augment(batch: Batch, generator: torch.Generator) -> Batch:
    """Permute colour channels, change exposure per sample and view, mirror half of the samples."""
    (count, views), device = batch.images.shape[:2], batch.images.device
    order = torch.stack([torch.randperm(3, generator=generator) for _ in range(count)]).to(device)
    images = batch.images.gather(2, order[:, None, :, None, None].expand_as(batch.images))
    gain = 0.8 + 0.4 * torch.rand(count, 1, generator=generator)
    gain = gain * (0.93 + 0.14 * torch.rand(count, views, generator=generator))
    images = (images * gain.to(device)[:, :, None, None, None]).clamp(0, 1)
    mirrored = (torch.rand(count, generator=generator) < 0.5).to(device)
    flip = torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0], device=device))
    choose = mirrored[:, None, None, None]
    return Batch(
        images=torch.where(choose[..., None], images.flip(-1), images),
        depth_z=torch.where(choose, batch.depth_z.flip(-1), batch.depth_z),
        T_world_cam=torch.where(choose, flip @ batch.T_world_cam @ flip, batch.T_world_cam),
        fov_vh=batch.fov_vh,
    )
