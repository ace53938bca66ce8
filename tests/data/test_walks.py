"""Long closed walks: exact geometry, a camera that comes back, overlap of neighbours, and look-alike rooms."""

from functools import cache

import numpy as np
import pytest
import torch

from freegeo.data.procedural import get_domain, render, walk
from freegeo.data.procedural.rooms import CLEARANCE_M, distance_m
from freegeo.data.procedural.walks import _PARTITION_CLEARANCE_M, ROOM_M, TURN_DEG, Walk
from freegeo.errors import UserError
from freegeo.geometry.reproject import reproject
from freegeo.geometry.rotation import rotation_angle
from freegeo.geometry.se3 import inverse

HW = (48, 64)
FRAMES = 300
SEED = get_domain("test-id").first_seed


@cache
def walked(frames: int = FRAMES, *, alike: bool = False) -> Walk:
    return walk(SEED, "test-id", frames, alike=alike)


def centres(of: Walk) -> torch.Tensor:
    return inverse(of.T_cam_world)[:, :3, 3]


def turns_deg(of: Walk) -> torch.Tensor:
    R = of.T_cam_world[:, :3, :3]
    return torch.rad2deg(rotation_angle(R, R.roll(-1, dims=0)))


def shared(of: Walk, first: int, second: int) -> tuple[float, float]:
    """Share of the first frame that the second one sees, and the median error of the depth there."""
    source, target = (of.render(frame, *HW, supersample=1) for frame in (first, second))
    carried = reproject(
        source.depth_z[0].double(),
        K_source=source.K[0].double(),
        T_source_world=source.T_cam_world[0].double(),
        K_target=target.K[0].double(),
        T_target_world=target.T_cam_world[0].double(),
        target_hw=HW,
    )
    column, row = torch.where(carried.in_view[..., None], (carried.pixel + 0.5).floor(), 0.0).long().unbind(-1)
    measured = target.depth_z[0, 0].double()[row, column]
    off = (carried.depth_z - measured).abs()
    # The two faces of a wall between rooms are 10 cm apart, and are not one surface.
    agrees = carried.in_view & (off < 0.05)
    off = off / measured
    return float(agrees.double().mean()), float(off[agrees].median()) if agrees.any() else float("nan")


@pytest.mark.parametrize("frames", [FRAMES, 1000])
def test_the_last_frame_is_one_step_before_the_first(frames):
    around = walked(frames)
    steps = (centres(around).roll(-1, dims=0) - centres(around)).norm(dim=-1)
    assert steps[-1] < 1.2 * steps.max() < 1.0
    assert turns_deg(around).max() < 1.8 * TURN_DEG


def test_neighbours_overlap_and_agree_and_far_frames_share_nothing():
    around = walked()
    near = [shared(around, i, (i + 1) % FRAMES) for i in [*range(0, FRAMES, 30), FRAMES - 1]]
    assert min(share for share, _ in near) > 0.5
    assert np.median([error for _, error in near]) < 0.005
    for apart, most in ((25, 0.25), (90, 0.02), (FRAMES // 2, 0.02)):
        assert max(shared(around, i, (i + apart) % FRAMES)[0] for i in range(0, FRAMES, 30)) < most


def test_cameras_stand_in_free_space():
    for around in (walked(), walked(1000)):
        rooms = around.rooms
        camera = inverse(rooms.T_cam_room)[..., :3, 3]
        assert (rooms.size[:, None, 0, :2] - camera[..., :2].abs()).min() > 0.7
        away = distance_m(camera, rooms.center, rooms.yaw, rooms.size, rooms.first_sphere, rooms.first_cylinder).amin(
            dim=(0, 1)
        )
        assert away[1:].min() >= min(CLEARANCE_M, _PARTITION_CLEARANCE_M) - 0.05
        present = rooms.size[0, :, 0] > 0
        assert present.float().mean() > 0.5


def test_what_is_left_out_of_a_frame_is_not_in_it():
    around = walked()
    for frame in (0, 70, 150, 222):
        whole = render(around.rooms, *HW, views=[frame])
        assert torch.equal(around.render(frame, *HW, supersample=1).depth_z, whole.depth_z)


def test_photos_are_rendered_when_they_are_read_and_the_same_again():
    around, again = walked(), walk(SEED, "test-id", FRAMES)
    photo, other = around.photos[17], again.photos[17]
    assert photo.name == "0017.png" and len(around.photos) == FRAMES
    assert photo.read().shape == (*photo.size_hw, 3) and photo.read().dtype == np.uint8
    assert np.array_equal(photo.read(), other.read())
    scene = around.scene([3, 17])
    assert np.array_equal(scene.photos[1].read(), photo.read())
    assert scene.depth_z.shape == (2, *photo.size_hw)
    assert torch.equal(scene.depth_z[1], again.scene([17]).depth_z[0])
    assert not torch.equal(walk(SEED + 1, "test-id", FRAMES).rooms.colour[:, :9], around.rooms.colour[:, :9])


def test_more_frames_walk_through_more_rooms_at_the_same_pace():
    short, long = walked(), walked(1000)
    assert long.room_count > 2 * short.room_count
    assert turns_deg(long).median() == pytest.approx(float(turns_deg(short).median()), rel=0.25)
    steps = [centres(around).diff(dim=0).norm(dim=-1).mean() for around in (short, long)]
    assert steps[1] == pytest.approx(float(steps[0]), rel=0.25)


def test_look_alike_rooms_are_far_apart_and_look_alike():
    around = walked(alike=True)
    plain = walked()
    assert around.look_alikes is not None and plain.look_alikes is None
    first, second = around.look_alikes
    assert (centres(around)[first] - centres(around)[second]).norm() > ROOM_M / 2
    assert shared(around, first, second)[0] < 0.05

    def difference(of: Walk) -> float:
        pairs = [[of.render(frame + i, *HW).images for frame in (first, second)] for i in (-6, 0, 6)]
        return float(torch.stack([(a - b).abs().mean() for a, b in pairs]).mean())

    # The same walls and floors, seen from the same places, with the same things elsewhere in the room.
    assert difference(around) < 0.7 * difference(plain)
    moved = around.rooms.center != plain.rooms.center
    assert not moved.any() and not torch.equal(around.rooms.texture, plain.rooms.texture)


@pytest.mark.parametrize(
    "wrong", [lambda: walk(SEED, "test-id", 60), lambda: walk(-1, "test-id"), lambda: walk(0, "kitchen")]
)
def test_mistakes_are_explained(wrong):
    with pytest.raises(UserError):
        wrong()
