"""The camera term: what changes it and what does not, where its gradient goes, and runs that learn from it."""

from dataclasses import replace
from itertools import product

import pytest
import torch

from freegeo.adaptation.adapt import adapt
from freegeo.adaptation.losses import CameraTargets, camera_loss
from freegeo.adaptation.recipe import evidence
from freegeo.adaptation.samples import SceneImages
from freegeo.adaptation.state import UNFINISHED_FILE
from freegeo.errors import UserError
from freegeo.geometry.rotation import quat_xyzw_to_matrix
from freegeo.geometry.se3 import from_Rt
from freegeo.models.precision import Compute
from tiny_models import noise_scene, quick, same, tensors, tiny_da3, tiny_mapanything, tiny_vggt

VIEWS = 6
WEIGHTS = {"cameras": 1.0, "features": 0.0}
MODELS = [tiny_da3, tiny_vggt]


def cameras(count: int = VIEWS, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    quaternion = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    R = quat_xyzw_to_matrix(quaternion / quaternion.norm(dim=1, keepdim=True))
    T = from_Rt(R, torch.randn(count, 3, generator=generator, dtype=torch.float64))
    K = torch.tensor([[30.0, 0, 16], [0, 28, 16], [0, 0, 1]], dtype=torch.float64).repeat(count, 1, 1)
    return T, K


def targets(T: torch.Tensor, K: torch.Tensor, **changes) -> CameraTargets:
    known = torch.ones(len(T), dtype=torch.bool)
    return replace(CameraTargets(T_cam_world=T, K=K, known=known, distance=1.0), **changes)


def taught(views: int = VIEWS, seed: int = 3, **changes) -> SceneImages:
    """A scene of noise with cameras to learn."""
    T, K = cameras(views, seed)
    return replace(noise_scene(views), targets=targets(T.float(), K.float(), **changes))


def trained(build, recipe=WEIGHTS, scene=None, **options):
    model = build()
    plan = quick(model, **{"views": 5, **recipe})
    return adapt(model, [scene or taught()], plan, seed=42, **options)


# The loss -------------------------------------------------------------------------------------------------------------


def test_world_frame_and_scale_do_not_matter():
    T, K = cameras()
    frame = from_Rt(quat_xyzw_to_matrix(torch.tensor([0.5, 0.5, -0.5, 0.5]).double()), torch.ones(3).double())
    moved = T @ frame
    moved[:, :3, 3] *= 3.7
    assert camera_loss(moved, K, targets(T, K)).item() == pytest.approx(0, abs=1e-12)


def test_each_part_has_the_value_of_its_formula():
    T, K = cameras()
    longer = K.clone()
    longer[:, 0, 0] *= 1.1
    assert camera_loss(T, longer, targets(T, K)).item() == pytest.approx(torch.tensor(1.1).log().item() / 2, rel=1e-6)
    # Two cameras, the second turned by 90 degrees on the spot: |R - R'| is 2 sqrt 2 sin 45 in both pairs. Seen from the
    # first camera the direction is the same, seen from the turned one it is turned, too.
    pair, eye = T[:2], torch.eye(4, dtype=torch.float64)
    quarter = eye.clone()
    quarter[:3, :3] = quat_xyzw_to_matrix(torch.tensor([0, 0, 0.5**0.5, 0.5**0.5], dtype=torch.float64))
    pair = torch.stack((eye, from_Rt(torch.eye(3).double(), torch.tensor([1.0, 0, 0]).double())))
    turned = torch.stack((pair[0], quarter @ pair[1]))
    assert camera_loss(turned, K[:2], targets(pair, K[:2])).item() == pytest.approx(2 + 2**0.5 / 2, rel=1e-6)


def test_near_cameras_have_no_direction_to_learn_and_unknown_ones_are_in_no_term():
    T, K = cameras(3)
    near = T.clone()
    near[1] = T[0]
    near[1, :3, 3] += 1e-3
    other = near.clone()
    other[1, :3, 3] += torch.tensor([2e-3, -3e-3, 0])
    assert camera_loss(near, K, targets(other, K)).item() == pytest.approx(0, abs=0.01)
    assert camera_loss(near, K, targets(other, K, distance=1e-3)).item() > 0.1
    wrong, wide = T.clone(), K.clone()
    wrong[2] = cameras(1, seed=9)[0]
    wide[2, 0, 0] *= 2
    known = torch.tensor([True, True, False])
    assert camera_loss(wrong, wide, targets(T, K)).item() > 0.1
    assert camera_loss(wrong, wide, targets(T, K, known=known)).item() == pytest.approx(0, abs=1e-12)
    assert camera_loss(wrong, wide, targets(T, K, known=torch.zeros(3, dtype=torch.bool))).item() == 0


def test_the_gradient_is_finite_where_the_loss_is_zero_and_points_down_elsewhere():
    T, K = cameras()
    for seed in (0, 4):
        found = cameras(seed=seed)[0].requires_grad_()
        loss = camera_loss(found, K, targets(T, K))
        loss.backward()
        assert found.grad is not None
        assert bool(found.grad.isfinite().all())
    assert camera_loss(found.detach() - 1e-4 * found.grad, K, targets(T, K)) < loss


# Runs -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("build", "precision"), [*product(MODELS, ("fp32", "bf16")), (tiny_mapanything, "fp32")])
def test_the_adapter_learns_the_cameras_and_nothing_else_changes(build, precision):
    model = build()
    frozen = {name: p.detach().clone() for name, p in model.named_parameters()}
    plan = quick(model, **WEIGHTS, views=5, steps=25, lr=1e-2)
    result = adapt(model, [taught()], plan, seed=42, compute=Compute(precision=precision))
    assert result.trouble is None
    assert result.gain["adapted"] < 0.9 * result.gain["frozen"]
    result.adapter.detach()
    assert all(torch.equal(p, frozen[name]) for name, p in model.named_parameters())


@pytest.mark.parametrize("build", MODELS)
def test_terms_without_weight_are_absent_and_the_others_add_up(build):
    alone = trained(build).curve[0]
    assert set(alone) == {"cameras", "cameras_all", "total"}
    both = trained(build, {"cameras": 0.5, "features": 2.0, "hold": 1.0}).curve[-1]
    parts = 2 * (both["intra"] + both["cross"]) + both["cameras"] + both["cameras_all"] + both["hold"]
    assert both["total"] == pytest.approx(parts, rel=1e-5)
    plain = trained(build, {}).curve[0]
    assert not {"cameras", "cameras_all"} & set(plain)
    assert trained(build, {"cameras": 0.5}).curve[0]["cameras"] == pytest.approx(alone["cameras"] / 2, rel=1e-5)


def test_targets_change_nothing_where_the_recipe_has_no_camera_term():
    assert same(tensors(trained(tiny_da3, {})), tensors(trained(tiny_da3, {}, noise_scene(VIEWS))))


@pytest.mark.parametrize("build", MODELS)
def test_a_stopped_run_continues_to_the_bit_with_the_same_targets_only(build, tmp_path):
    def stop(progress):
        if progress.step == 1:
            raise KeyboardInterrupt

    whole = trained(build)
    with pytest.raises(KeyboardInterrupt):
        trained(build, resume_in=tmp_path, on_step=stop)
    assert (tmp_path / UNFINISHED_FILE).is_file()
    with pytest.raises(UserError, match="belongs to another run"):
        trained(build, scene=taught(seed=4), resume_in=tmp_path)
    assert same(tensors(trained(build, resume_in=tmp_path)), tensors(whole))


def test_a_scene_without_targets_and_settings_that_would_move_the_images_are_refused():
    with pytest.raises(UserError, match="learns from cameras that matches between photos prove, and noise-0 has none"):
        trained(tiny_da3, scene=noise_scene(VIEWS))
    plan = evidence(tiny_da3().spec)
    for change in ({"squash": 32}, {"augmentation": "released"}):
        with pytest.raises(UserError, match="no squash, no augmentation"):
            plan.changed(**change)
    with pytest.raises(UserError, match="a weight of features or of cameras above 0"):
        plan.changed(features=0.0, cameras=0.0)
    with pytest.raises(UserError, match="cameras must be 0 or more and finite"):
        plan.changed(cameras=float("nan"))
