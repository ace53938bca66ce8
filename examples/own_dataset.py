"""A data set of your own in the benchmark: one `Dataset`, and every `freegeo bench` command knows it.

A scene here is a folder with images/*.png (undistorted), cameras.json (as `freegeo cameras convert` writes it), and the
truth: depth/*.npy in metres, and points.ply. Without such a folder, a generated room is written like that and scored.
Adding the value to `freegeo.data.datasets.registry.DATASETS` is all there is to it (docs/benchmark.md).
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import freegeo
from freegeo.cli.app import main as freegeo_command
from freegeo.data.datasets import registry
from freegeo.data.datasets.base import Dataset, DatasetConstants, existing, require_folder
from freegeo.data.scene import Scene, SceneTruth

NAME = "captures"
HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
"""cameras.json counts pixels from the corner of the photo, the benchmark from the centre of its first pixel."""


def scene_names(root: Path) -> list[str]:
    """Return the scenes: sub-folders with cameras, in a fixed order."""
    folder = require_folder(root, "a folder of captures")
    return sorted(path.name for path in folder.iterdir() if (path / "cameras.json").is_file())


def load_scene(root: Path, name: str) -> Scene:
    """Read photos, cameras and where the truth is; depth is read later, frame by frame."""
    folder = require_folder(root / name, "a capture")
    photos = freegeo.load_photos(folder / "images", max_views=100_000)
    known = freegeo.read_cameras(folder / "cameras.json", photos)
    truth = SceneTruth(
        dataset=NAME,
        surface=folder / "points.ply",
        depth=tuple(existing(folder / "depth" / f"{Path(photo.name).stem}.npy") for photo in photos),
        mask=(None,) * len(photos),
        camera_hw=tuple(photo.size_hw for photo in photos),
    )
    return Scene(
        name=name,
        photos=tuple(photos),
        T_cam_world=torch.from_numpy(np.stack([camera.T_cam_world for camera in known.cameras])).float(),
        K=torch.from_numpy(np.stack([camera.K - HALF_PIXEL for camera in known.cameras])).float(),
        truth=truth,
    )


CAPTURES = Dataset(
    name=NAME,
    constants=DatasetConstants(
        voxel=0.04, truncation=0.16, depth_limit=20.0, down_sample=0.04, threshold=0.15, truth="points"
    ),
    scene_names=scene_names,
    load_scene=load_scene,
    read_depth=lambda path, photo_hw: np.load(path),
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("out/own-dataset/data"), help="holds captures/<scene>/")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/own-dataset/bench"))
    parser.add_argument("--model", default="freegeo-tiny", help="see `freegeo models`")
    parser.add_argument("--steps", default="5", help="of the adaptation; without it the recipe decides")
    arguments = parser.parse_args()
    if not (arguments.data / NAME).exists():
        write_generated(arguments.data / NAME / "room")
    registry.DATASETS[NAME] = CAPTURES
    options = ["--datasets", NAME, "--data", str(arguments.data), "-o", str(arguments.output)]
    settings = ["--model", arguments.model, "--steps", arguments.steps, "--views", "4", "--seeds", "43"]
    if code := freegeo_command(["bench", "check", str(arguments.data), "--datasets", NAME]):
        return code
    return freegeo_command(["bench", "run", "main", *options, *settings])


def write_generated(folder: Path) -> None:
    """Write a generated room in the layout above, as an example of it."""
    from freegeo.cameras.known import KnownCamera, KnownCameras
    from freegeo.cameras.plain import write
    from freegeo.data.procedural import photograph_room
    from freegeo.data.procedural.splits import surface_points, write_points

    room = photograph_room(20_000_001, "test-id", frames=8)
    for name in ("images", "depth"):
        (folder / name).mkdir(parents=True)
    for photo, depth in zip(room.photos, room.depth_z, strict=True):
        Image.fromarray(photo.read()).save(folder / "images" / photo.name)
        np.save(folder / "depth" / f"{Path(photo.name).stem}.npy", depth.numpy())
    cameras = [
        KnownCamera(T_cam_world=T.double().numpy(), K=K.double().numpy() + HALF_PIXEL, size_hw=photo.size_hw)
        for T, K, photo in zip(room.T_cam_world, room.K, room.photos, strict=True)
    ]
    names = tuple(photo.name for photo in room.photos)
    write(KnownCameras(names=names, cameras=tuple(cameras), source="a generated room"), folder / "cameras.json")
    write_points(folder / "points.ply", surface_points(room.depth_z, room.K, room.T_cam_world))


if __name__ == "__main__":
    sys.exit(main())
