"""Writes the sample export that the pictures docs/figures/open-*.png show: a generated room, exact depth and cameras.

`python tools/open_elsewhere.py FOLDER` needs the extra `colmap` and takes a minute; the files are the same each time.
They are what `freegeo export` writes of ten photos of 1008 x 756 pixels and maps of 504 x 378. The world is that of the
first camera, as a model predicts it, so nothing is upright by itself.

The pictures are windows on a virtual screen (Xvfb, 1280 x 900 pixels, `LIBGL_ALWAYS_SOFTWARE=1`) after the steps of
docs/formats.md, "Open the files in other programs". They were taken with `import -window root` of ImageMagick, cropped,
and reduced to 220 colours. In Blender, a script did the steps, and chose the view.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch

from freegeo.data.photos import MemoryPhoto
from freegeo.data.procedural import get_domain, render, sample_rooms
from freegeo.data.procedural.photographs import SUPERSAMPLE, to_bytes
from freegeo.export.reconstruction import Reconstruction, Scale

DOMAIN, ROOM, VIEWS = "tex", 2, 10
MAP_HW, PHOTO_SCALE = (378, 504), 2
FORMATS = ("ply", "glb", "mesh", "colmap", "video")


def sample() -> tuple[Reconstruction, list[MemoryPhoto]]:
    """Return the room as an exact result in metres, and its photos."""
    domain = get_domain(DOMAIN)
    room = sample_rooms([next(iter(domain.seeds(1, start=ROOM)))], domain=domain, frames=VIEWS)
    maps = render(room, *MAP_HW, supersample=SUPERSAMPLE)
    large = render(room, *(PHOTO_SCALE * side for side in MAP_HW), supersample=SUPERSAMPLE)
    photos = [MemoryPhoto(f"{i:02d}.jpg", to_bytes(image)) for i, image in enumerate(large.images[0])]
    T_cam_world = maps.T_cam_world[0].double()
    result = Reconstruction(
        depth_z=maps.depth_z[0].numpy(),
        conf=np.ones((VIEWS, *MAP_HW), np.float32),
        images=np.stack([to_bytes(image) for image in maps.images[0]]),
        names=tuple(photo.name for photo in photos),
        photo_hw=np.array([photo.size_hw for photo in photos]),
        scale_xy=np.full((VIEWS, 2), 1 / PHOTO_SCALE),
        offset_xy=np.zeros((VIEWS, 2)),
        T_cam_world=(T_cam_world @ torch.linalg.inv(T_cam_world[0])).numpy(),
        K=maps.K[0].numpy(),
        scale=Scale(value=1.0, source="the generated room"),
    )
    return result, photos


def main(folder: Path) -> None:
    """Write the files and name them."""
    torch.set_num_threads(1)
    result, photos = sample()
    for path in result.export(folder, FORMATS, photos=photos).require_any().files:
        print(path)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
