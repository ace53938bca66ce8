import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file

from fixture_tools import fixture_path, relative_error
from freegeo.errors import UserError
from freegeo.geometry import camera, depth, reproject, se3
from rotations import rotation_of


def random_poses(*leading, seed=0, spread=1.0):
    generator = torch.Generator().manual_seed(seed)
    R = rotation_of(torch.randn(*leading, 3, generator=generator, dtype=torch.float64))
    return se3.from_Rt(R, spread * torch.randn(*leading, 3, generator=generator, dtype=torch.float64))


def pinhole(fx=300.0, fy=310.0, cx=41.0, cy=30.5, skew=0.0):
    return torch.tensor([[fx, skew, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


@given(seed=st.integers(0, 10**6))
@settings(max_examples=30, deadline=None)
def test_inverse_relative_and_centres(seed):
    T = random_poses(2, 3, seed=seed)
    assert torch.allclose(se3.inverse(T) @ T, torch.eye(4, dtype=torch.float64).expand(2, 3, 4, 4), atol=1e-12)
    assert torch.allclose(se3.relative(T[:, 0], T[:, 1]) @ T[:, 0], T[:, 1], atol=1e-12)
    centres = se3.camera_centres(T)
    assert torch.allclose(centres, se3.inverse(T)[..., :3, 3], atol=1e-12)
    assert torch.allclose(se3.transform_points(T, centres), torch.zeros(2, 3, 3, dtype=torch.float64), atol=1e-12)


def test_recorded_inverse_and_normalisation():
    recorded = load_file(fixture_path("vggt", "functions", "geometry.safetensors"))
    assert relative_error(se3.inverse(se3.to_4x4(recorded["se3_in"])), recorded["se3_inverse"]) < 1e-5
    recorded = load_file(fixture_path("da3", "functions", "normalize_extrinsics.safetensors"))
    for case in range(4):
        given_poses = recorded[f"in.{case}"]
        before = given_poses.clone()
        assert relative_error(se3.normalise_poses(given_poses), recorded[f"out.{case}"]) < 1e-5
        assert torch.equal(before, given_poses)


def test_wrong_shapes_are_refused():
    with pytest.raises(UserError, match="3x4 or 4x4"):
        se3.to_4x4(torch.eye(3))
    with pytest.raises(UserError, match="9 numbers"):
        camera.decode_world_to_camera(torch.zeros(2, 8), (10, 10))


def test_recorded_da3_encoding():
    recorded = load_file(fixture_path("da3", "functions", "pose_encoding.safetensors"))
    image_hw = tuple(recorded["image_size_hw"].tolist())
    T, K = camera.decode_camera_to_world(recorded["dec.pose_enc"], image_hw)
    assert relative_error(T[..., :3, :], recorded["dec.w2c"]) < 1e-5
    assert relative_error(se3.inverse(T)[..., :3, :], recorded["dec.c2w"]) < 1e-5
    assert torch.allclose(K, recorded["dec.intrinsics"], rtol=1e-4, atol=0)
    encoded = camera.encode_camera_to_world(se3.inverse(recorded["enc.c2w"]), recorded["enc.intrinsics"], image_hw)
    assert relative_error(encoded, recorded["enc.pose_enc"]) < 1e-5


def test_recorded_vggt_decoding():
    recorded = load_file(fixture_path("vggt", "functions", "pose_encoding.safetensors"))
    image_hw = tuple(recorded["image_hw"].tolist())
    for source, target in (("dec_pose", "dec"), ("enc_pose", "roundtrip")):
        T, K = camera.decode_world_to_camera(recorded[source], image_hw)
        assert relative_error(T[..., :3, :], recorded[f"{target}_extrinsics"]) < 1e-5
        assert torch.allclose(K, recorded[f"{target}_intrinsics"], rtol=1e-4, atol=0)


def test_fields_of_view_by_hand():
    K = camera.K_from_fov(torch.tensor(math.pi / 2), torch.tensor(0.0), (40, 60))
    assert K[1, 1].item() == pytest.approx(20)  # a right angle: focal length is half the height
    assert K[0, 0].item() == pytest.approx(30e6)
    assert K[:2, 2].tolist() == [30, 20]
    vertical, horizontal = camera.fov_from_K(pinhole(fx=30, fy=20), (40, 60))
    assert (vertical.item(), horizontal.item()) == pytest.approx((math.pi / 2, math.pi / 2))


def test_resizing_intrinsics():
    K = camera.resize_K(pinhole(), (100, 200), (50, 400))
    assert torch.equal(K, pinhole(fx=600, fy=155, cx=82, cy=15.25))
    scale, offset = torch.tensor([2.0, 0.5], dtype=torch.float64), torch.tensor([5.0, -3.0], dtype=torch.float64)
    assert torch.equal(camera.photo_K(pinhole(skew=4), scale, offset), pinhole(fx=150, fy=620, cx=18, cy=67, skew=2))


def test_pixel_centres_are_whole_numbers():
    grid = camera.pixel_grid((2, 3), like=torch.zeros((), dtype=torch.float64))
    assert grid[1, 2].tolist() == [2, 1, 1]
    assert grid[0, 0].tolist() == [0, 0, 1]


@given(
    seed=st.integers(0, 10**6), skew=st.sampled_from([0.0, 2.5]), shape=st.tuples(st.integers(1, 7), st.integers(1, 7))
)
@settings(max_examples=40, deadline=None)
def test_project_undoes_unproject(seed, skew, shape):
    depth_z = 0.5 + torch.rand(3, *shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    K = torch.stack([pinhole(fx=200 + 50 * i, skew=skew) for i in range(3)])
    points = depth.unproject(depth_z, K)
    expected = camera.pixel_grid(shape, like=depth_z)[..., :2].expand(3, *shape, 2)
    assert torch.allclose(camera.project(points, K), expected, atol=1e-9)
    assert torch.equal(points[..., 2], depth_z)
    T = random_poses(3, seed=seed)
    world = depth.depth_to_world(depth_z, K, T)
    assert torch.allclose(se3.transform_points(T, world), points, atol=1e-10)


def test_recorded_unprojection():
    recorded = load_file(fixture_path("vggt", "functions", "geometry.safetensors"))
    T = se3.to_4x4(recorded["extrinsic"])
    assert relative_error(depth.unproject(recorded["depth"], recorded["intrinsic"]), recorded["cam_points"]) < 1e-5
    world = depth.depth_to_world(recorded["depth"], recorded["intrinsic"], T)
    assert relative_error(world, recorded["world_points"]) < 1e-5
    assert torch.equal(depth.valid_depth(recorded["depth"]), recorded["valid_mask"])


def test_valid_depth_rule():
    values = torch.tensor([1.0, 0.0, -1.0, float("nan"), float("inf"), 1e-9])
    assert depth.valid_depth(values).tolist() == [True, False, False, False, False, False]


def wall_depth(pixel, K, T_cam_world):
    """Depth (...) of the world plane z = 4 at places (..., 2) of an image."""
    rays = torch.cat((pixel, torch.ones_like(pixel[..., :1])), dim=-1) @ torch.linalg.inv(K).mT
    T_world_cam = se3.inverse(T_cam_world)
    directions_z = (rays @ T_world_cam[:3, :3].mT)[..., 2]
    return (4 - T_world_cam[2, 3]) / directions_z


def test_points_of_a_wall_land_on_the_wall():
    image_hw, K = (60, 80), pinhole(fx=90, fy=90, cx=40, cy=30)
    T_a = torch.eye(4, dtype=torch.float64)
    motion = torch.tensor([0.02, -0.05, 0.03], dtype=torch.float64)
    T_b = se3.from_Rt(rotation_of(motion), torch.tensor([0.2, 0.1, 0.3], dtype=torch.float64))
    depth_a = wall_depth(camera.pixel_grid(image_hw, like=K)[..., :2], K, T_a)
    depth_a[0, 0] = float("nan")
    cameras = {"K_source": K, "T_source_world": T_a, "K_target": K, "T_target_world": T_b, "target_hw": image_hw}
    landed = reproject.reproject(depth_a, **cameras)
    assert not landed.in_view[0, 0]
    assert 0.5 < landed.in_view.double().mean() < 1
    expected = wall_depth(landed.pixel[landed.in_view], K, T_b)
    assert torch.allclose(landed.depth_z[landed.in_view], expected, rtol=1e-12)
    column, row = (landed.pixel[landed.in_view] + 0.5).floor().long().unbind(-1)
    assert ((row >= 0) & (row < 60) & (column >= 0) & (column < 80)).all()


def test_same_camera_maps_every_pixel_to_itself_in_batches():
    K, T = pinhole(fx=90, fy=80, cx=4, cy=3).expand(2, 3, 3), random_poses(2)
    depth_z = torch.full((2, 6, 8), 2.0, dtype=torch.float64)
    landed = reproject.reproject(depth_z, K_source=K, T_source_world=T, K_target=K, T_target_world=T, target_hw=(6, 8))
    expected = camera.pixel_grid((6, 8), like=K)[..., :2].expand(2, 6, 8, 2)
    assert torch.allclose(landed.pixel, expected, atol=1e-9)
    assert landed.in_view.all()
    turned = se3.from_Rt(rotation_of(torch.tensor([0.0, math.pi, 0.0], dtype=torch.float64)), K.new_zeros(3)) @ T
    away = reproject.reproject(
        depth_z, K_source=K, T_source_world=T, K_target=K, T_target_world=turned, target_hw=(6, 8)
    )
    assert not away.in_view.any()
