"""A generated room as a reconstruction: exact depth and cameras, photos at twice the model's resolution."""

from functools import cache

import numpy as np
import torch

from freegeo.data.procedural import render, sample_rooms
from freegeo.export.reconstruction import Reconstruction
from freegeo.fusion.points import PointCloud, coloured_points

PHOTO_SCALE = 2


@cache
def room(views: int = 4, hw: tuple[int, int] = (48, 64), seed: int = 3, crop: int = 0) -> Reconstruction:
    """Exact prediction for a room; `crop` columns of the resized photos are cut away on both sides."""
    rendered = render(sample_rooms([seed], frames=views), hw[0], hw[1])
    depth_z, images = rendered.depth_z[0], rendered.images[0]
    K, T_cam_world = rendered.K[0].clone(), rendered.T_cam_world[0]
    sides = slice(crop, hw[1] - crop)
    K[:, 0, 2] -= crop
    return Reconstruction(
        depth_z=depth_z[..., sides].numpy().copy(),
        conf=torch.ones_like(depth_z[..., sides]).numpy(),
        T_cam_world=T_cam_world.numpy(),
        K=K.numpy(),
        images=(images[..., sides].permute(0, 2, 3, 1) * 255).round().byte().numpy(),
        names=tuple(f"photo {i}.JPG" for i in range(views)),
        photo_hw=np.tile([hw[0] * PHOTO_SCALE, hw[1] * PHOTO_SCALE], (views, 1)),
        scale_xy=np.full((views, 2), 1 / PHOTO_SCALE),
        offset_xy=np.tile([-float(crop), 0.0], (views, 1)),
    )


def cloud_of(scene: Reconstruction, **options) -> PointCloud:
    """The points of a reconstruction with cameras."""
    assert scene.T_cam_world is not None
    assert scene.K is not None
    return coloured_points(scene.depth_z, scene.conf, scene.T_cam_world, scene.K, scene.images, **options)
