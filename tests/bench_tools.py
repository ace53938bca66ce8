"""Small generated rooms and tasks on them, for the tests of the benchmark."""

from functools import cache

from freegeo.benchmark.stored import write_stored
from freegeo.benchmark.tasks import Task, choose_frames, finish
from freegeo.data.datasets.registry import load_scene
from freegeo.data.photos import MemoryPhoto
from freegeo.data.procedural import render, sample_rooms
from freegeo.data.scene import Scene
from freegeo.types import Prediction

DATASET = "procedural-test-id"
ROOMS = ("20000000", "20000001")
CONFIGURATION = {"model": "tiny", "checkpoint": None, "precision": "fp32", "adaptation": None}


@cache
def small_room(seed: int, domain: str, frames: int) -> Scene:
    """A room at 48 x 64 without supersampling."""
    views = render(sample_rooms([seed], domain=domain, frames=frames), 48, 64)
    images = [(image.permute(1, 2, 0) * 255).round().byte().numpy() for image in views.images[0]]
    return Scene(
        name=str(seed),
        photos=tuple(MemoryPhoto(f"{i:02d}.png", image) for i, image in enumerate(images)),
        T_cam_world=views.T_cam_world[0],
        K=views.K[0],
        depth_z=views.depth_z[0],
    )


def task(variant: str = "frozen", *, scene: str = ROOMS[0], views: int = 4, seed: int = 43, **others) -> Task:
    return Task(**{"dataset": DATASET, "rule": "da3", **others}, scene=scene, views=views, seed=seed, variant=variant)


def store_truth(data, out, one, configuration=CONFIGURATION, **changes):
    """Store exact depth and cameras of a room, in another frame and scale, as a task's prediction."""
    scene = load_scene(data, one.dataset, one.scene)
    frames = choose_frames(one.rule, len(scene), one.views, one.seed)
    chosen = scene.select(frames)
    T = chosen.T_cam_world.clone()
    T[:, :3, 3] /= 2
    prediction = Prediction(**{"depth_z": chosen.depth_z / 2, "T_cam_world": T, "K": chosen.K, **changes})
    write_stored(one, out, prediction, frames)
    finish(one, out, configuration, frames=frames, seconds=0.5, peak_gb=1.0, adapter=None)
    return prediction
