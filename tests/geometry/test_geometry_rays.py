import pytest
import torch
from safetensors.torch import load_file

from fixture_tools import fixture_path, relative_error
from freegeo.errors import FreeGeoError
from freegeo.geometry.rays import cameras_from_rays


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("case", [0, 1], ids=["centred", "off-centre"])
def test_recorded_cameras(case):
    recorded = load_file(fixture_path("da3", "functions", "ray_pose.safetensors"))
    image_hw = tuple(recorded["image_size_hw"].tolist())
    T, K = cameras_from_rays(recorded[f"ray.{case}"], recorded[f"ray_conf.{case}"], image_hw, generator=seeded())
    assert relative_error(T[..., :3, :], recorded[f"extrinsics.{case}"]) < 1e-5
    assert relative_error(K, recorded[f"intrinsics.{case}"]) < 1e-4
    if case == 0:
        assert relative_error(T[..., :3, :], recorded["true_w2c.0"]) < 1e-5


def test_outliers_are_ignored_and_the_seed_decides():
    recorded = load_file(fixture_path("da3", "functions", "ray_pose.safetensors"))
    image_hw = tuple(recorded["image_size_hw"].tolist())
    rays, confidence = recorded["ray.0"].clone(), recorded["ray_conf.0"]
    noise = torch.rand(rays.shape[:-1], generator=seeded(1)) < 0.2
    rays[..., :2] += noise[..., None] * 3.0
    rays[..., 0, 0, 2] = 0.0  # a direction without image-plane coordinates
    T, K = cameras_from_rays(rays, confidence, image_hw, generator=seeded(2))
    assert relative_error(T[..., :3, :3], recorded["true_w2c.0"][..., :3]) < 1e-3
    assert relative_error(K, recorded["true_intrinsics.0"]) < 1e-3
    again, _ = cameras_from_rays(rays, confidence, image_hw, generator=seeded(2))
    assert torch.equal(T, again)


def test_views_without_usable_rays_have_no_camera_and_disturb_no_other():
    recorded = load_file(fixture_path("da3", "functions", "ray_pose.safetensors"))
    rays, confidence = recorded["ray.0"], recorded["ray_conf.0"]
    image_hw = tuple(recorded["image_size_hw"].tolist())
    wanted = cameras_from_rays(rays, confidence, image_hw, generator=seeded())
    for nothing in (0.0, torch.nan):
        broken = rays.clone()
        broken[:, 1] = nothing
        found = cameras_from_rays(broken, confidence, image_hw, generator=seeded())
        for mine, other in zip(found, wanted, strict=True):
            assert mine[:, 1].isnan().any()
            assert torch.equal(mine[:, [0, 2]], other[:, [0, 2]])
    holed = rays.clone()
    holed[:, :, 0, 0] = torch.nan
    assert relative_error(cameras_from_rays(holed, confidence, image_hw, generator=seeded())[0], wanted[0]) < 1e-4
    with pytest.raises(FreeGeoError, match="too small"):
        cameras_from_rays(torch.ones(1, 2, 2, 6), torch.ones(1, 2, 2), (16, 16), generator=seeded())
