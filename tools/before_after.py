"""Draws docs/figures/before-after.png: a generated room before and after `freegeo run`, and as it is.

`python tools/before_after.py [DOMAIN ROOM]` needs the extra `colmap` and takes a minute. The scores are in the picture.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

import freegeo
from freegeo.data.procedural import get_domain, photograph_room
from freegeo.data.scene import Scene
from freegeo.export.reconstruction import Reconstruction
from freegeo.fusion.filtering import filter_pixels
from freegeo.fusion.settings import FilterSettings
from freegeo.geometry.depth import depth_to_world
from freegeo.geometry.sim3 import align_cameras
from freegeo.metrics.scene import at_size, evaluate

FIGURE = Path(__file__).parents[1] / "docs" / "figures" / "before-after.png"
FRAMES, SHOWN = 16, (0, 4, 8, 12)
PANEL, PHOTO, HEAD, GAP = (440, 350), (108, 81), 62, 10
SCALE = 2
"""Pixels that are drawn for one of the picture."""
BACKGROUND, INK, PALE, CAMERA = (255, 255, 255), (30, 30, 40), (110, 110, 125), (225, 60, 40)
CUT = 0.35
"""Height above the highest camera, in metres, above which nothing is drawn: one looks into the room from above."""


class Shown:
    """Points, colours and cameras of one panel, in the true world."""

    def __init__(self, result: Reconstruction, scene: Scene, filters: FilterSettings):
        assert scene.T_cam_world is not None
        T, K, depth = (torch.as_tensor(value).double() for value in (result.T_cam_world, result.K, result.depth_z))
        fit = align_cameras(scene.T_cam_world.double(), T, ransac=False)
        kept, _ = filter_pixels(result.depth_z, result.conf, *result.cameras(), settings=filters)
        self.points = fit.sim3.apply(depth_to_world(depth, K, T))[torch.as_tensor(kept)].numpy()
        self.colours = result.images[kept]
        self.cameras = torch.linalg.inv(fit.T_cam_world).numpy()
        self.K = result.K


def true_result(scene: Scene, like: Reconstruction) -> Reconstruction:
    """Return the truth at the size of a prediction."""
    assert scene.depth_z is not None and scene.K is not None and scene.T_cam_world is not None
    depth_z, K = at_size(scene.depth_z, scene.K, like.image_hw)
    return Reconstruction(
        depth_z=depth_z.numpy(), conf=np.full(depth_z.shape, 2, np.float32), images=like.images, names=like.names,
        photo_hw=like.photo_hw, scale_xy=like.scale_xy, offset_xy=like.offset_xy,
        T_cam_world=scene.T_cam_world.numpy(), K=K.numpy(),
    )  # fmt: skip


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return world to camera (4, 4) of a camera that looks from one point to another; z is up."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    R = np.stack((right, np.cross(forward, right), forward))
    return np.block([[R, (-R @ eye)[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def draw(shown: Shown, T: np.ndarray, focal: float, ceiling: float) -> Image.Image:
    """Draw points, nearest last, and the cameras over them."""
    width, height = PANEL[0] * SCALE, PANEL[1] * SCALE
    canvas = np.full((height, width, 3), BACKGROUND, np.uint8)

    def places(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        seen = points @ T[:3, :3].T + T[:3, 3]
        return seen[:, :2] / seen[:, 2:] * focal + (width / 2, height / 2), seen[:, 2]

    below = shown.points[:, 2] < ceiling
    xy, depth = places(shown.points[below])
    order = np.argsort(-depth)
    colours = shown.colours[below][order]
    for (x, y), z, colour in zip(xy[order], depth[order], colours, strict=True):
        if z > 0.5:
            half = 0.042 * focal / z
            left, top = max(0, round(x - half)), max(0, round(y - half))
            canvas[top : max(0, round(y + half)), left : max(0, round(x + half))] = colour
    image = Image.fromarray(canvas)
    pen = ImageDraw.Draw(image)
    for pose, K in zip(shown.cameras, shown.K, strict=True):
        corners = [(x, y, 1.0) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        rays = np.array(corners) * (K[0, 2] / K[0, 0], K[1, 2] / K[1, 1], 1) * 0.22
        frame = np.vstack(([0, 0, 0], rays)) @ pose[:3, :3].T + pose[:3, 3]
        (tip, *base), _ = places(frame)
        for here, there in zip(base, [*base[1:], base[0]], strict=True):
            pen.line([tuple(tip), tuple(here), tuple(there)], fill=CAMERA, width=2 * SCALE)
    return image.resize(PANEL, Image.Resampling.LANCZOS)


def picture(photos: Sequence[np.ndarray], panels: Sequence[tuple[str, str, Image.Image]]) -> Image.Image:
    """Put photos and panels beside each other, with a title and a line over each."""
    width = PHOTO[0] + len(panels) * (PANEL[0] + GAP)
    image = Image.new("RGB", (width + 2 * GAP, PANEL[1] + HEAD + GAP), BACKGROUND)
    pen = ImageDraw.Draw(image)
    title, line = ImageFont.load_default(22), ImageFont.load_default(16)
    pen.text((GAP, 8), "Photos", fill=INK, font=title)
    pen.text((GAP, 36), f"4 of {FRAMES}", fill=PALE, font=line)
    step = (PANEL[1] - PHOTO[1]) / (len(photos) - 1)
    for number, photo in enumerate(photos):
        image.paste(Image.fromarray(photo).resize(PHOTO, Image.Resampling.LANCZOS), (GAP, HEAD + round(number * step)))
    for number, (name, about, panel) in enumerate(panels):
        x = GAP + PHOTO[0] + GAP + number * (PANEL[0] + GAP)
        pen.text((x, 8), name, fill=INK, font=title)
        pen.text((x, 36), about, fill=PALE, font=line)
        image.paste(panel, (x, HEAD))
    return image


def main(domain: str, room: int) -> None:
    """Photograph, reconstruct, adapt, refine, draw."""
    torch.set_num_threads(1)
    scene = photograph_room(next(iter(get_domain(domain).seeds(1, start=room))), domain, frames=FRAMES)
    photos, model = list(scene.photos), freegeo.load_model("freegeo-tiny")
    frozen = freegeo.reconstruct(model, photos)
    adapted = freegeo.adapt(model, photos)
    predicted = freegeo.reconstruct(model, photos)
    refined = freegeo.refine(predicted, photos, frozen=frozen)
    print("adaptation:", adapted.verdict["reason"])
    print("refinement:", refined.about["reason"])

    def scores(result: Reconstruction) -> str:
        found = evaluate(result, scene)
        return f"AUC@15 {found['auc15']:.2f}, F1 {found['f1_rel5']:.2f}"

    assert scene.T_cam_world is not None
    cameras = torch.linalg.inv(scene.T_cam_world.double()).numpy()
    truth = Shown(true_result(scene, frozen), scene, FilterSettings(drop_share=0))
    low, high = np.percentile(truth.points, (2, 98), axis=0)
    middle, extent = (low + high) / 2, float(np.linalg.norm(high[:2] - low[:2]))
    away = np.array((np.cos(AZIMUTH), np.sin(AZIMUTH), 1.35))
    T = look_at(middle + 1.05 * extent * away / np.linalg.norm(away) * 1.2, middle)
    focal, ceiling = 1.24 * PANEL[0] * SCALE, float(cameras[:, 2, 3].max()) + CUT
    usual = FilterSettings()
    panels = [
        ("Before: the frozen model", scores(frozen), draw(Shown(frozen, scene, usual), T, focal, ceiling)),
        ("After: freegeo run", scores(refined.result), draw(Shown(refined.result, scene, usual), T, focal, ceiling)),
        ("The room as it is", "at the model's 96 x 72 pixels", draw(truth, T, focal, ceiling)),
    ]
    whole = picture([photos[number].read() for number in SHOWN], panels)
    whole.quantize(256, kmeans=3).save(FIGURE, optimize=True)
    print(f"{FIGURE}: {FIGURE.stat().st_size / 1000:.0f} kB")


AZIMUTH = 0.5
"""Direction that one looks from, in radians around the vertical axis."""

if __name__ == "__main__":
    logging.getLogger("freegeo").setLevel(logging.ERROR)
    main(*(sys.argv[1:2] or ["tex"]), int(sys.argv[2]) if len(sys.argv) > 2 else 2)
