"""Generated rooms: exact geometry, determinism, sane cameras and light."""

import math
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import torch

from bench_tools import small_room
from freegeo.data.procedural import (
    DOMAINS,
    Domain,
    RoomBatch,
    get_domain,
    intrinsics,
    photograph_room,
    render,
    resized_intrinsics,
    sample_rooms,
    splits,
)
from freegeo.data.procedural.raytrace import RenderedViews
from freegeo.data.procedural.rooms import CLEARANCE_M, FIRST_CYLINDER, FIRST_SPHERE
from freegeo.data.procedural.textures import BANKS, LEVEL_SIZES, TEXTURE_COUNT, texture_bank
from freegeo.errors import UserError
from freegeo.geometry.camera import K_from_fov, resize_K
from freegeo.geometry.depth import unproject
from freegeo.geometry.reproject import reproject
from freegeo.geometry.rotation import rotation_angle
from freegeo.geometry.se3 import inverse, transform_points

HW = (36, 48)
SHIFTED = ("light", "lowtex", "tex", "big", "sparse")


@cache
def rooms(domain: str = "train", count: int = 12, frames: int = 10) -> RoomBatch:
    return sample_rooms(get_domain(domain).seeds(count), domain=domain, frames=frames)


@cache
def views(domain: str = "train", count: int = 12) -> RenderedViews:
    return render(rooms(domain, count), *HW)


def neighbours(rendered: RenderedViews, tolerance: float):
    """Pixels of views 0..S-2 carried into views 1..S-1, the depth at the nearest pixel there, and where both agree."""
    carried = reproject(
        rendered.depth_z[:, :-1].double(),
        K_source=rendered.K[:, :-1].double(),
        T_source_world=rendered.T_cam_world[:, :-1].double(),
        K_target=rendered.K[:, 1:].double(),
        T_target_world=rendered.T_cam_world[:, 1:].double(),
        target_hw=HW,
    )
    column, row = torch.where(carried.in_view[..., None], (carried.pixel + 0.5).floor(), 0.0).long().unbind(-1)
    index = (row * HW[1] + column).flatten(-2)
    measured = rendered.depth_z[:, 1:].double().flatten(-2).gather(-1, index).view_as(carried.depth_z)
    return carried, measured, carried.in_view & ((carried.depth_z - measured).abs() <= tolerance * measured)


def camera_centres(batch: RoomBatch) -> torch.Tensor:
    """(B, S, 3) in the room frame."""
    return inverse(batch.T_cam_room)[..., :3, 3]


def distance_to_furniture(points: torch.Tensor, batch: RoomBatch) -> torch.Tensor:
    """Signed distance of points (B, N, 3) from the surface of every primitive but the room; infinite where absent.

    A signed distance q per side gives the distance from a convex body: |max(q, 0)| outside, max(q) inside.
    """
    offset = points[:, :, None] - batch.center[:, None, 1:]
    size, (cosine, sine) = batch.size[:, None, 1:], batch.yaw[:, None, 1:].unbind(-1)
    x, y, z = offset.unbind(-1)
    turned = torch.stack([cosine * x + sine * y, cosine * y - sine * x, z], dim=-1)
    box = turned.abs() - size
    sphere = (offset.norm(dim=-1) - size[..., 0])[..., None]
    cylinder = torch.stack([torch.hypot(x, y) - size[..., 0], z.abs() - size[..., 2]], dim=-1)
    by_kind = [sides.clamp(min=0).norm(dim=-1) + sides.amax(-1).clamp(max=0) for sides in (box, sphere, cylinder)]
    ends = (0, FIRST_SPHERE - 1, FIRST_CYLINDER - 1, offset.shape[2])
    distance = torch.cat([d[..., a:b] for d, (a, b) in zip(by_kind, pairwise(ends), strict=True)], dim=-1)
    return torch.where(size[..., 0] > 0, distance, torch.inf)


def test_every_pixel_unprojects_onto_a_surface_of_the_room():
    batch, rendered = rooms(), views()
    points_cam = unproject(rendered.depth_z.double(), rendered.K.double())
    points = transform_points(inverse(rendered.T_cam_world.double()), points_cam).flatten(1, 3)
    points_room = transform_points(batch.T_room_world.double(), points).float()
    wall = (points_room.sub(batch.center[:, None, 0]).abs() - batch.size[:, None, 0]).amax(-1).abs()
    surface = distance_to_furniture(points_room, batch).abs().amin(-1)
    assert torch.minimum(wall, surface).max() < 2e-4


def test_views_of_one_room_agree_where_both_see_the_surface():
    carried, measured, agrees = neighbours(views(), 0.05)
    off = (carried.depth_z / measured - 1.0)[agrees].abs()
    assert off.median() < 0.005
    # A point of one view may hide behind something, but nothing of it may float in front of what the other view sees
    # (the silhouettes' nearest-pixel look-up aside).
    in_front = carried.in_view & (carried.depth_z < 0.95 * measured)
    assert in_front.double().mean() < 0.02


def test_neighbouring_views_overlap():
    _, _, agrees = neighbours(views(), 0.05)
    overlap = agrees.double().mean((-1, -2))
    assert overlap.median() > 0.4
    assert overlap[rooms().is_arc].median() > 0.6
    assert overlap[~rooms().is_arc].median() > 0.4
    assert (overlap > 0.1).double().mean() > 0.97


def test_turns_and_baselines_between_neighbours():
    T = rooms().T_cam_room
    relative = T[:, 1:, :3, :3] @ T[:, :-1, :3, :3].mT
    cosine = (relative.diagonal(dim1=-2, dim2=-1).sum(-1) - 1.0) / 2.0
    turn_deg = torch.rad2deg(torch.arccos(cosine.clamp(-1.0, 1.0)))
    assert ((turn_deg > 8.0) & (turn_deg < 27.0)).all()
    assert 12.0 < turn_deg.median() < 19.0
    step = camera_centres(rooms()).diff(dim=1).norm(dim=-1)
    assert step[~rooms().is_arc].min() > 0.3
    assert (step / views().depth_z.mean((1, 2, 3))[:, None]).min() > 0.05


def test_poses_are_rigid_and_the_world_frame_is_nobody_s_camera():
    for T in (rooms().T_cam_world, rooms().T_room_world):
        R = T[..., :3, :3]
        assert torch.allclose(R @ R.mT, torch.eye(3).expand_as(R), atol=1e-5)
        assert torch.allclose(torch.linalg.det(R), torch.ones(R.shape[:-2]), atol=1e-5)
    assert (rooms().T_cam_world[:, 0] - torch.eye(4)).abs().amax((-1, -2)).min() > 0.1


def test_a_faster_pace_turns_and_moves_farther_through_the_same_rooms():
    seeds = get_domain("sparse").seeds(24)
    fast, slow = (sample_rooms(seeds, domain=replace(get_domain("sparse"), pace=pace)) for pace in (1.5, 1.0))
    rotations = [batch.T_cam_world[..., :3, :3] for batch in (fast, slow)]
    fast_turn, slow_turn = (rotation_angle(R[:, :-1], R[:, 1:]).mean(1) for R in rotations)
    # Pitch and roll have their own jitter, which the pace leaves alone.
    assert ((fast_turn / slow_turn - 1.5).abs() < 0.1).all()
    walked = [camera_centres(batch).diff(dim=1).norm(dim=-1).mean(1)[~batch.is_arc] for batch in (fast, slow)]
    assert (walked[0] > 1.3 * walked[1]).all()
    assert torch.equal(fast.texture, slow.texture) and torch.equal(fast.T_cam_room[:, 0], slow.T_cam_room[:, 0])


@pytest.mark.parametrize("domain", ["train", "big", "sparse"])
def test_cameras_stand_inside_off_the_walls_and_clear_of_everything(domain):
    batch = rooms(domain, 24, 16)
    centres = camera_centres(batch)
    assert (batch.size[:, None, 0, :2] - centres[..., :2].abs()).min() > 0.29
    assert centres[..., 2].min() > 0.9 and centres[..., 2].max() < 1.9
    present = batch.size[:, 1:, 0] > 0
    assert distance_to_furniture(centres, batch).min() >= CLEARANCE_M
    assert 0.5 < present.float().mean() < 1.0


def test_both_families_at_their_shares():
    share = sample_rooms(range(600), frames=1).is_arc.float().mean()
    assert 0.54 < share < 0.66


def test_scored_rooms_have_one_lens_and_the_lens_domain_many():
    for name in ("test-id", "val-id", "big", "val-light"):
        fov_deg = torch.rad2deg(sample_rooms(DOMAINS[name].seeds(20), domain=name, frames=1).fov_rad)
        torch.testing.assert_close(fov_deg, torch.full_like(fov_deg, 65.0))
    fov_deg = torch.rad2deg(sample_rooms(DOMAINS["lens"].seeds(20), domain="lens", frames=1).fov_rad)
    assert 58.0 <= fov_deg.min() < 63.0 < 67.0 < fov_deg.max() <= 72.0


def test_field_of_view_is_drawn_per_room_and_within_its_range():
    fov_deg = torch.rad2deg(rooms().fov_rad)
    assert fov_deg.min() >= 58.0 and fov_deg.max() <= 72.0 and fov_deg.std() > 2.0
    half_width = torch.atan(0.5 * HW[1] / views().K[..., 0, 0])
    assert torch.allclose(2.0 * half_width, rooms().fov_rad[:, None].expand_as(half_width))


def test_a_seed_gives_its_room_whatever_the_batch():
    together = render(sample_rooms([5, 6, 7], domain="light"), 12, 16, views=[0, 3, 4])
    alone = render(sample_rooms([6], domain="light"), 12, 16, views=[3])
    for batched, single in zip(together, alone, strict=True):
        assert torch.allclose(batched[1, 1], single[0, 0], atol=1e-5)
    again = render(sample_rooms([5, 6, 7], domain="light"), 12, 16, views=[0, 3, 4])
    assert all(torch.equal(a, b) for a, b in zip(together, again, strict=True))
    assert not torch.allclose(together.images[0], together.images[1], atol=0.05)


def test_slices_and_chunks_leave_the_picture_alone(monkeypatch):
    whole = render(rooms().rooms(2, 4), 12, 16)
    assert torch.equal(whole.depth_z, render(rooms(), 12, 16).depth_z[2:4])
    monkeypatch.setattr("freegeo.data.procedural.raytrace.RAYS_PER_CHUNK_CPU", 1)
    view_by_view = render(rooms().rooms(2, 4), 12, 16)
    assert torch.allclose(whole.images, view_by_view.images, atol=1e-6)
    assert torch.equal(whole.depth_z, view_by_view.depth_z)


def test_more_frames_show_the_same_room():
    short, long = sample_rooms([3], frames=4), sample_rooms([3], frames=16)
    assert torch.equal(short.texture, long.texture)
    assert torch.equal(short.lamp_position, long.lamp_position)
    assert torch.equal(short.center, long.center)


def test_supersampling_changes_the_colours_but_not_the_ground_truth():
    plain = render(rooms().rooms(0, 2), 24, 32)
    smooth = render(rooms().rooms(0, 2), 24, 32, supersample=2)
    assert torch.equal(plain.depth_z, smooth.depth_z)
    difference = (plain.images - smooth.images).abs().mean()
    assert 1e-4 < difference < 0.03


def test_shrinking_a_photo_gives_the_small_rendering():
    """Area averaging of a large image is the supersampled small one: no half-pixel shift between sizes."""
    batch = rooms().rooms(0, 4)
    large = render(batch, 96, 128).images.flatten(0, 1)
    shrunk = torch.nn.functional.avg_pool2d(large, 4)
    small = render(batch, 24, 32, supersample=4).images.flatten(0, 1)
    shifted = torch.nn.functional.avg_pool2d(large.roll(2, dims=-1), 4)
    error, shifted_error = (shrunk - small).abs().mean(), (shifted - small).abs().mean()
    assert error < 1e-3 < shifted_error


def test_intrinsics_follow_a_resize_exactly():
    fov = torch.tensor([1.1, 1.2])
    large, small = intrinsics(fov, 192, 256), intrinsics(fov, 48, 64)
    assert torch.allclose(resized_intrinsics(large, (192, 256), (48, 64)), small, atol=1e-5)
    assert torch.allclose(resized_intrinsics(small, (48, 64), (192, 256)), large, atol=1e-4)
    # What the models do instead is off by the half pixel of the module docstring.
    scaled = resize_K(large, (192, 256), (48, 64))
    assert torch.allclose((scaled - small)[..., :2, 2], torch.full((2, 2), (1 - 64 / 256) / 2), atol=1e-5)
    vertical = 2.0 * torch.atan(0.5 * 48 / small[..., 1, 1])
    decoded = K_from_fov(vertical, fov, (48, 64))
    assert torch.allclose((decoded - small)[..., :2, 2], torch.full((2, 2), 0.5), atol=1e-5)
    assert torch.allclose(decoded[..., :2, :2], small[..., :2, :2], atol=1e-4)


def test_seeds_of_the_domains_are_disjoint():
    spans = sorted((d.first_seed, d.first_seed + d.seed_count, d.name) for d in DOMAINS.values())
    assert all(before[1] <= after[0] for before, after in pairwise(spans))
    assert set(DOMAINS) == {"train", "test-id", *SHIFTED, "lens", "val-id", *(f"val-{name}" for name in SHIFTED)}
    for name, domain in DOMAINS.items():
        assert domain.name == name
        assert domain.room_count <= domain.seed_count
        assert domain.bank in BANKS


def test_validation_domains_look_like_their_counterparts():
    for name in SHIFTED:
        test, validation = DOMAINS[name], DOMAINS[f"val-{name}"]
        own = ("name", "first_seed", "room_count")
        assert {k: v for k, v in vars(test).items() if k not in own} == {
            k: v for k, v in vars(validation).items() if k not in own
        }
        assert test.bank != DOMAINS["train"].bank


def test_what_sets_the_shifted_domains_apart():
    def spread(name):
        colour = rooms(name).colour
        return (colour[:, :, 1:] - colour[:, :, :1]).abs().mean().item()

    def saturation(name):
        colour = rooms(name).colour
        return (colour - colour.mean(-1, keepdim=True)).abs().mean().item()

    assert spread("lowtex") < 0.35 * spread("test-id")
    assert saturation("tex") == pytest.approx(0.5 * saturation("test-id"), rel=0.1)
    assert rooms("big").size[:, 0, :2].min() >= 3.6 > 3.5 >= rooms("test-id").size[:, 0, :2].max()
    assert views("light").images.mean() < 0.75 * views("test-id").images.mean()


@pytest.mark.parametrize("domain", ["train", *SHIFTED])
def test_views_are_lit_textured_and_finite(domain):
    images = views(domain).images
    assert torch.isfinite(images).all() and images.min() >= 0.0 and images.max() <= 1.0
    view_means = images.mean((2, 3, 4))
    assert (view_means > (0.04 if domain == "light" else 0.15)).all()
    assert (images > 0.999).float().mean() < 0.05
    assert images.std((-1, -2)).mean() > 0.05


def test_grain_depends_on_room_and_view_only():
    quiet = Domain(**{**vars(get_domain("light")), "grain": 0.0})
    seeds = quiet.seeds(2)
    noise = [
        render(sample_rooms(seeds, domain=domain, frames=2), 48, 64).images for domain in (get_domain("light"), quiet)
    ]
    visible = (noise[1] > 0.15) & (noise[1] < 0.85)
    grain = (noise[0] - noise[1])[visible]
    assert grain.std() == pytest.approx(0.04, rel=0.1)
    first = (noise[0] - noise[1])[0, 0].flatten()
    second = (noise[0] - noise[1])[0, 1].flatten()
    assert abs(torch.corrcoef(torch.stack([first, second]))[0, 1]) < 0.1


@pytest.mark.parametrize("bank", ["train", "tex"])
def test_textures_tile(bank):
    """The step over the border is no larger than the largest step from one row or column to the next."""
    texels = texture_bank(bank).texels[: TEXTURE_COUNT * LEVEL_SIZES[0] ** 2].view(TEXTURE_COUNT, LEVEL_SIZES[0], -1)
    assert texels.min() >= 0.0 and texels.max() <= 1.0
    assert texels.std((-1, -2)).min() > 0.08
    for axis in (1, 2):
        step = (texels - texels.roll(1, dims=axis)).abs().mean(dim=3 - axis)
        seam = step[:, 0] / step[:, 1:].amax(1)
        # Patterns with an edge on the border may have their strongest edge there.
        assert seam.max() < 1.5
        if axis == 1 and bank == "train":
            assert seam[2::5].max() < 1.0, "slanted stripes change their tint at the border"


def test_texture_look_up_is_periodic_and_exact_at_texel_centres():
    bank = texture_bank("train")
    index = torch.tensor([0, 7, 39])
    row, column = torch.tensor([0, 100, 255]), torch.tensor([255, 31, 0])
    u, v = (column + 0.5) / 256, (row + 0.5) / 256
    expected = bank.texels[(index * 256 + row) * 256 + column]
    assert torch.allclose(bank.sample(index, u, v, torch.ones(3)), expected, atol=1e-4)
    assert torch.allclose(bank.sample(index, u + 3, v - 2, torch.ones(3)), expected, atol=1e-3)
    coarsest = bank.texels[int(bank.level_offsets[-1]) + 7 * 16 * 16 + 3 * 16 + 5]
    found = bank.sample(torch.tensor([7]), torch.tensor([5.5 / 16]), torch.tensor([3.5 / 16]), torch.tensor([1e6]))
    assert torch.allclose(found, coarsest)


def test_a_ray_meets_each_kind_of_primitive_where_it_should():
    """One camera at (-1.5, 0, 1) looks along +x at a single primitive two metres ahead."""
    batch = sample_rooms([0], frames=1)
    batch.T_cam_room[0, 0] = torch.tensor(
        [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 1.0], [1.0, 0.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]]
    )
    turned = torch.tensor([math.cos(math.pi / 4), math.sin(math.pi / 4)])
    for k, size, expected in (
        (1, (0.3, 0.3, 0.5), 2.0 - 0.3 * math.sqrt(2.0)),
        (FIRST_SPHERE, (0.4, 0.4, 0.4), 1.6),
        (8, (0.25, 0.25, 0.5), 1.75),
        (None, None, 1.5 + float(batch.size[0, 0, 0])),
    ):
        batch.size[0, 1:] = -1.0
        if k is not None:
            batch.size[0, k] = torch.tensor(size)
            batch.center[0, k] = torch.tensor([0.5, 0.0, 1.0])
            batch.yaw[0, k] = turned
        assert render(batch, 33, 33).depth_z[0, 0, 16, 16] == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(("aspect", "hw"), [("1:1", (192, 192)), ("4:3", (192, 256)), ("3:2", (170, 256))])
def test_photographs(aspect, hw):
    seed = get_domain("light").seeds(1)[0]
    scene = photograph_room(seed, "light", frames=2, aspect=aspect)
    assert scene.name == f"light-{seed}"
    assert len(scene) == 2
    assert scene.depth_z.shape == (2, *hw) and scene.K.shape == (2, 3, 3) and scene.T_cam_world.shape == (2, 4, 4)
    for photo in scene.photos:
        pixels = photo.read()
        assert photo.size_hw == hw and pixels.shape == (*hw, 3) and pixels.dtype == np.uint8
    truth = render(sample_rooms([seed], domain="light", frames=2), *hw, supersample=2)
    assert np.abs(scene.photos[1].read() / 255.0 - truth.images[0, 1].permute(1, 2, 0).numpy()).max() < 0.51 / 255


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: sample_rooms([]),
        lambda: sample_rooms([-1]),
        lambda: sample_rooms([0], frames=0),
        lambda: sample_rooms([0], domain="kitchen"),
        lambda: render(rooms(), 0, 8),
        lambda: render(rooms(), 8, 8, supersample=0),
        lambda: get_domain("light").seeds(10, start=9_995),
        lambda: get_domain("light").seeds(1, start=-1),
    ],
)
def test_mistakes_are_explained(wrong):
    with pytest.raises(UserError):
        wrong()


def test_half_written_rooms_of_a_killed_process_are_removed_by_the_next_that_renders_there(tmp_path, monkeypatch):
    monkeypatch.setattr(splits, "photograph_room", small_room)
    left = [tmp_path / f".20000001.0123abcd.part.{suffix}" for suffix in ("npz", "ply")]
    for file in left:
        file.write_bytes(b"half")
    scene = splits.load_room("test-id", tmp_path, "20000003")
    assert len(scene.photos) == splits.FRAMES
    assert {file.name for file in tmp_path.iterdir()} == {"20000003.npz", "20000003.ply"}
