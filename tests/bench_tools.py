"""Small generated rooms and tasks on them, for the tests of the benchmark."""

from functools import cache

from freegeo.benchmark.tasks import Task
from freegeo.data.procedural import render, sample_rooms
from freegeo.data.procedural.photographs import RenderedPhoto
from freegeo.data.scene import Scene

DATASET = "procedural-test-id"
ROOMS = ("20000000", "20000001")


@cache
def small_room(seed: int, domain: str, frames: int) -> Scene:
    """A room at 48 x 64 without supersampling."""
    views = render(sample_rooms([seed], domain=domain, frames=frames), 48, 64)
    images = [(image.permute(1, 2, 0) * 255).round().byte().numpy() for image in views.images[0]]
    return Scene(
        name=str(seed),
        photos=tuple(RenderedPhoto(f"{i:02d}.png", image) for i, image in enumerate(images)),
        T_cam_world=views.T_cam_world[0],
        K=views.K[0],
        depth_z=views.depth_z[0],
    )


def task(variant: str = "frozen", *, scene: str = ROOMS[0], views: int = 4, seed: int = 43, **others) -> Task:
    return Task(**{"dataset": DATASET, "rule": "da3", **others}, scene=scene, views=views, seed=seed, variant=variant)
