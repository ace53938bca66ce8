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
    cameras_given: Tensor
    """(B,) bool: the model is told the cameras of the sample."""

    @property
    def views(self) -> int:
        """Number of views in all samples."""
        return self.images.shape[0] * self.images.shape[1]


def to_device(tensor: Tensor, device: torch.device | str) -> Tensor:
    """Copy a small tensor without waiting for the work that the device has still to do."""
    return tensor.to(device, non_blocking=True)


def windows(count: int, frames: int, views: int, phase: Phase, generator: torch.Generator) -> Tensor:
    """Draw the frame numbers (count, views) of samples: random strides, in walking order or reversed.

    In a share `phase.any_reference` of the samples a random view comes first, so that any view may be the reference;
    the others stay in order, which makes no difference to the model.
    """
    steps = max(views - 1, 1)
    most = min(phase.max_stride, max(1, phase.reach // steps), (frames - 1) // steps)
    stride = torch.randint(1, most + 1, (count, 1), generator=generator)
    room_left = frames - stride * (views - 1)
    start = (torch.rand(count, 1, generator=generator, dtype=torch.float64) * room_left).long()
    picked = start + stride * torch.arange(views)
    picked = torch.where(torch.rand(count, 1, generator=generator) < 0.5, picked.flip(1), picked)
    first = torch.randint(views, (count, 1), generator=generator)
    first = torch.where(torch.rand(count, 1, generator=generator) < phase.any_reference, first, 0)
    order = (torch.arange(views) != first).to(torch.uint8).argsort(dim=1, stable=True)
    return picked.gather(1, order)


def draw_batch(
    pool: Pool, config: TrainConfig, position: float, generator: torch.Generator, device: torch.device | str = "cpu"
) -> Batch:
    """Draw one step's samples for the phase of the run; the numbers are drawn on the CPU whatever the device.

    `position` is the place in the schedule, in views (`TrainConfig.position`).
    """
    phase = config.phase(position)
    views = phase.views[int(torch.randint(len(phase.views), (), generator=generator))]
    bank, picked = pool.draw(max(1, config.views_per_step // views), generator)
    frames = windows(len(picked), bank.frames, views, phase, generator)
    samples = to_device(torch.cat([picked[:, None], frames], dim=1), bank.images.device)
    batch = to_batch(bank.select(samples[:, :1], samples[:, 1:]))
    if phase.side != pool.side:
        batch = shrink(batch, phase.side / pool.side, pool.patch)
    told = torch.rand(len(picked), generator=generator) < config.cameras_given
    return augment(replace(batch, cameras_given=to_device(told, device)), generator)


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
        cameras_given=torch.zeros(len(depth_z), dtype=torch.bool, device=depth_z.device),
    )


def augment(batch: Batch, generator: torch.Generator) -> Batch:
    """Permute colour channels, change exposure per sample and view, mirror half of the samples."""
    (count, views), device = batch.images.shape[:2], batch.images.device
    order = to_device(torch.rand(count, 3, generator=generator).argsort(dim=1), device)
    images = batch.images.gather(2, order[:, None, :, None, None].expand_as(batch.images))
    gain = 0.8 + 0.4 * torch.rand(count, 1, generator=generator)
    gain = gain * (0.93 + 0.14 * torch.rand(count, views, generator=generator))
    images = (images * to_device(gain, device)[:, :, None, None, None]).clamp(0, 1)
    mirrored = to_device(torch.rand(count, generator=generator) < 0.5, device)
    flip = torch.where(torch.arange(4, device=device) == 0, -1.0, 1.0)
    choose = mirrored[:, None, None, None]
    return replace(
        batch,
        images=torch.where(choose[..., None], images.flip(-1), images),
        depth_z=torch.where(choose, batch.depth_z.flip(-1), batch.depth_z),
        T_world_cam=torch.where(choose, flip[:, None] * batch.T_world_cam * flip, batch.T_world_cam),
    )
