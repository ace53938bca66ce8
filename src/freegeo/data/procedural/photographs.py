"""Generated rooms as scenes with photos at photo size, exact cameras and exact depth."""

from __future__ import annotations

from typing import Literal

import numpy as np
from torch import Tensor

from freegeo.data.photos import MemoryPhoto
from freegeo.data.procedural.domains import Domain, get_domain
from freegeo.data.procedural.raytrace import render
from freegeo.data.procedural.rooms import sample_rooms
from freegeo.data.scene import Scene

Aspect = Literal["1:1", "4:3", "3:2"]
PHOTO_HW: dict[str, tuple[int, int]] = {"1:1": (192, 192), "4:3": (192, 256), "3:2": (170, 256)}
SUPERSAMPLE = 2


def photograph_room(seed: int, domain: str | Domain, frames: int = 16, aspect: Aspect = "4:3") -> Scene:
    """Photograph one room along its camera path; depth and cameras are exact at the photos' size."""
    domain = get_domain(domain)
    views = render(sample_rooms([seed], domain=domain, frames=frames), *PHOTO_HW[aspect], supersample=SUPERSAMPLE)
    photos = tuple(MemoryPhoto(f"{i:02d}.png", to_bytes(image)) for i, image in enumerate(views.images[0]))
    return Scene(
        name=f"{domain.name}-{seed}",
        photos=photos,
        T_cam_world=views.T_cam_world[0],
        K=views.K[0],
        depth_z=views.depth_z[0],
    )


def to_bytes(image: Tensor) -> np.ndarray:
    """Pixels (H, W, 3) uint8 of an image (3, H, W) in [0, 1]."""
    return (image.permute(1, 2, 0) * 255).round().byte().numpy()
