"""Every model family on a pretended GPU: operations keep to one device, steps never wait, no float64 for Apple's.

`pretend_device` says what is pretended and what is found. Named here are the places where the host does wait.
"""

from dataclasses import asdict

import numpy as np
import pytest
import torch

from evidence_tools import VIEWS, exact_matches
from exact_rooms import room
from freegeo.adaptation import recipe as recipes
from freegeo.adaptation.adapt import adapt
from freegeo.adaptation.losses.divergence import all_pairs_divergence
from freegeo.adaptation.memory import Plan
from freegeo.adaptation.samples import SceneImages
from freegeo.evidence import dense
from freegeo.evidence.candidate import Candidate
from freegeo.evidence.guard import Reference
from freegeo.evidence.scores import epipolar, reprojection
from freegeo.fusion.tsdf import TsdfVolume
from freegeo.models.api import embed_in_chunks
from freegeo.models.precision import Compute
from freegeo.pipeline import predict
from freegeo.training.config import TrainConfig
from freegeo.training.loop import train
from freegeo.types import ImageBatch, Priors
from pretend_device import MixedDevicesError, NoFloat64Error, PretendDevice
from tiny_models import (
    noise,
    noise_scene,
    quick,
    tensors,
    tiny_da3,
    tiny_mapanything,
    tiny_nested,
    tiny_pi3,
    tiny_pi3x,
    tiny_vggt,
)

ONCE_A_RUN = {
    "adaptation/adapt.py:_train",  # the model moves to the device
    "adaptation/adapter.py:Adapter.attach",
    "adaptation/adapter.py:_draw_start",
    "adaptation/state.py:State.update",  # the guard's states of the adapter
    "models/images.py:_statistics",
}
ONCE_A_VIEW_SET = {
    "models/api.py:embed_in_chunks",  # images go to the device
    "adaptation/samples.py:Samples._make",  # `choose_form` reads the teacher's spread
    "adaptation/losses/sampling.py:held_out_tokens",
    "adaptation/samples.py:Samples._in_file",
}
ONCE_AN_EPOCH = {"adaptation/state.py:State.read_terms"}
ONCE_A_STEP = {
    "disk": {f"types.py:{name}.to" for name in ("ViewTokens", "Features")} | {"adaptation/samples.py:Sample.to"},
    "device": set(),
}
"""By where the samples are kept."""
ANGLES_ON_THE_HOST = {
    "adaptation/losses/numerics.py:doubled", "adaptation/losses/numerics.py:sent",
    "adaptation/losses/angles.py:_AngleTerms.forward",
}  # fmt: skip
"""In every step on Apple's GPUs: the angle terms are computed in float64, which they lack."""


def pretended(name: str) -> PretendDevice:
    """CUDA, or Apple's GPU, which has no float64."""
    return PretendDevice(name, float64=name == "cuda")


def places(pretend: PretendDevice) -> set[str]:
    """Functions of the package in which the host waited."""
    return {wait.rpartition(" in ")[2] for wait in pretend.waits}


def test_what_a_device_refuses_is_refused():
    with PretendDevice()() as pretend:
        here, there = torch.ones(3), torch.ones(3, device="cuda")
        assert there.device == torch.device("cuda:0")
        assert there[1:].device == (2 * there).device == torch.zeros_like(there).device == there.device
        assert here.device.type == "cpu"
        for mixed in (
            lambda: here + there, lambda: there[torch.tensor([0])], lambda: torch.stack([here, there]),
            lambda: torch.where(here > 0, there, there), lambda: there.index_select(0, torch.tensor([0])),
            lambda: there.numpy(), lambda: there.add_(here), lambda: torch.nn.Linear(3, 3)(there),
        ):  # fmt: skip
            with pytest.raises(MixedDevicesError):
                mixed()
        # A number of the host is no second device.
        assert (there * torch.tensor(2.0)).device == there.device
        assert not pretend.waits


def test_what_a_device_is_waited_for_is_counted():
    with PretendDevice()() as pretend:
        there = torch.ones(3, device="cuda")
        assert not pretend.waits
        for wait in (
            lambda: float(there[0]), lambda: bool(there.sum() > 0), lambda: there.tolist(), lambda: there.cpu(),
            lambda: there.nonzero(), lambda: there[there > 0], lambda: there.unique(), lambda: there[[0, 2]],
            lambda: torch.ones(3).to("cuda"), lambda: there.new_tensor([1.0]), lambda: torch.tensor(1, device="cuda"),
            lambda: torch.zeros(3).copy_(there),
        ):  # fmt: skip
            pretend.waits.clear()
            wait()
            assert len(pretend.waits) == 1
        pretend.waits.clear()
        assert torch.ones(3).to("cuda", non_blocking=True).device == there.device
        there[there > 0] = 2.0
        assert not pretend.waits


def test_gradients_are_on_the_device_of_their_tensors():
    with PretendDevice()():
        layer = torch.nn.Linear(3, 2).to("cuda")
        start = torch.ones(3, requires_grad=True)
        layer(start.to("cuda")).square().sum().backward()
        assert layer.weight.grad.device == layer.weight.device == torch.device("cuda:0")
        assert start.grad.device.type == "cpu"


def test_a_device_without_float64_refuses_it():
    with pretended("mps")():
        there = torch.ones(3, device="mps")
        for wide in (lambda: there.double(), lambda: torch.ones(3, device="mps", dtype=torch.float64)):
            with pytest.raises(NoFloat64Error):
                wide()


@pytest.mark.parametrize("device", ["cuda", "mps"])
@pytest.mark.parametrize("make", [tiny_da3, tiny_vggt, tiny_pi3, tiny_pi3x, tiny_mapanything])
@torch.no_grad()
def test_a_prediction_stays_on_its_device(make, device):
    images, rule = noise(4), "saddle_balanced" if make is tiny_da3 else "first"
    extra = "rays" if make is tiny_da3 else "points"

    def predicted(model, where):
        tokens = embed_in_chunks(model, images, device=where)
        features = model.aggregate(tokens, reference=rule)
        return tokens, model.decode(features, want=("depth", "cameras", extra))

    _, expected = predicted(make(), torch.device("cpu"))
    with pretended(device)() as pretend:
        model = make().to(device)
        tokens, found = predicted(model, pretend.device)
        if make in (tiny_da3, tiny_pi3x, tiny_mapanything):
            priors = Priors(T_cam_world=found.T_cam_world.cpu(), K=found.K.cpu())
            model.aggregate(tokens, priors=priors)
        pretend.waits.clear()
        features = model.aggregate(tokens, reference=rule)
        assert not pretend.waits
        model.decode(features)
        assert all(wait.startswith("copy from the host") for wait in pretend.waits)
    for name in ("depth_z", "conf", "T_cam_world", "K", extra):
        # Of the whole: rounding is no small part of a coordinate near zero.
        there, here = getattr(found, name), getattr(expected, name)
        assert torch.dist(there, here) < 1e-4 * torch.linalg.vector_norm(here), name


def padded_scene() -> SceneImages:
    """Five images of noise, two of which have padding."""
    images, inside = noise(5), torch.ones(5, 32, 32, dtype=torch.bool)
    inside[1, :, :12] = inside[3, :12] = False
    return SceneImages(name="padded", count=5, load=lambda frames: images[list(frames)], inside=inside)


RUNS = {
    "DA3, padding, hold": (tiny_da3, "cuda", "fp32", {"hold": 1.0}),
    "DA3, fp16 with its scaler, dropout": (tiny_da3, "cuda", "fp16", {"dropout": 0.1}),
    "VGGT, bf16, activations computed twice, samples on disk": (tiny_vggt, "cuda", "bf16", {}),
    "VGGT, released losses": (tiny_vggt, "cuda", "fp32", {"loss": asdict(recipes.RELEASED_VGGT.loss)}),
    "Pi3, activations computed twice": (tiny_pi3, "cuda", "bf16", {"hold": 1.0}),
    "DA3 on Apple's GPU": (tiny_da3, "mps", "fp32", {"hold": 1.0}),
    "MapAnything, bf16": (tiny_mapanything, "cuda", "bf16", {}),
}


@pytest.mark.parametrize("run", RUNS)
def test_an_adaptation_waits_for_its_device_only_where_named(run):
    make, device, precision, changes = RUNS[run]
    scene = padded_scene() if "padding" in run else noise_scene(5)
    plan = Plan(checkpointing=True, place="disk") if "disk" in run else None
    always = ONCE_A_STEP["disk" if plan else "device"] | (ANGLES_ON_THE_HOST if device == "mps" else set())
    with pretended(device)() as pretend:
        model = make()

        def after_step(progress):
            # In the second epoch the view sets are known.
            assert places(pretend) <= always | (set() if progress.epoch else ONCE_A_RUN | ONCE_A_VIEW_SET)
            pretend.waits.clear()

        def after_epoch(epoch, adapter):
            assert places(pretend) == ONCE_AN_EPOCH
            pretend.waits.clear()

        result = adapt(
            model, [scene], quick(model, epochs=2, sets_per_scene=1, **changes), seed=1,
            compute=Compute(device=torch.device(device), precision=precision), plan=plan, on_step=after_step,
            on_epoch=after_epoch, keep_after=(0.5,),
        )  # fmt: skip
        assert places(pretend) <= always | {"adaptation/adapt.py:_gain"}
        assert {parameter.device for parameter in model.parameters()} == {pretend.device}
        assert result.trouble is None
        last = [tensor.clone() for tensor in tensors(result)]
        adapter = result.adapter
        adapter.load(result.earlier[0.5])
        adapter.set_strength(0.5)
        adapter.settle()
        adapter.detach()
        adapter.reattach()
        assert {tensor.device for tensor in tensors(result)} == {pretend.device}
    if precision == "fp32" and "dropout" not in changes:
        plain = make()
        alike = adapt(plain, [scene], quick(plain, epochs=2, sets_per_scene=1, **changes), seed=1, plan=Plan())
        for found, expected in zip(last, tensors(alike), strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-2, atol=1e-4)


def test_a_stopped_adaptation_continues_on_its_device(tmp_path):
    compute = Compute(device=torch.device("cuda"), precision="fp16")

    def run(folder, on_step):
        model = tiny_da3()
        return adapt(
            model, [noise_scene(4)], quick(model, steps=2, dropout=0.1), seed=1, compute=compute, plan=Plan(),
            resume_in=folder, on_step=on_step,
        )  # fmt: skip

    def stop(progress):
        raise KeyboardInterrupt

    with pretended("cuda")():
        expected = run(None, lambda progress: None)
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path, stop)
        found = run(tmp_path, lambda progress: None)
    assert len(found.curve) == 2
    for one, two in zip(tensors(found), tensors(expected), strict=True):
        torch.testing.assert_close(one, two)


def three_images() -> ImageBatch:
    """Noise, as a model reads it."""
    return ImageBatch(
        images=noise(3), names=("a", "b", "c"), photo_hw=torch.tensor([[32, 32]] * 3),
        scale_xy=torch.ones(3, 2).double(), offset_xy=torch.zeros(3, 2).double(),
    )  # fmt: skip


@pytest.mark.parametrize("device", ["cuda", "mps"])
@pytest.mark.parametrize("pose_from", ["camera", "rays"])
def test_metres_and_cameras_of_rays_are_the_same_on_every_device(device, pose_from):
    batch = three_images()
    expected = predict(tiny_nested(), batch, pose_from=pose_from)
    with pretended(device)():
        found = predict(tiny_nested(), batch, pose_from=pose_from, compute=Compute(device=torch.device(device)))
    for name in ("depth_z", "sky", "T_cam_world", "K"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-3, atol=1e-4)
    assert found.scale.value == pytest.approx(expected.scale.value, rel=1e-4)


def test_a_prediction_comes_back_from_its_device():
    batch = three_images()
    expected = predict(tiny_vggt(), batch)
    with pretended("cuda")():
        found = predict(tiny_vggt(), batch, compute=Compute(device=torch.device("cuda")))
    np.testing.assert_allclose(found.depth_z, expected.depth_z, rtol=1e-4)


@pytest.mark.parametrize("device", ["cuda", "mps"])
@pytest.mark.parametrize("form", ["float32", "float64", "direct"])
def test_every_form_of_the_divergence_keeps_to_its_device(form, device):
    generator = torch.Generator().manual_seed(0)
    x, y, teacher_x, teacher_y = (torch.randn(1, 5, 16, generator=generator) for _ in range(4))

    def divergence(*tokens):
        student = tuple(token.requires_grad_() for token in tokens[:2])
        kl = all_pairs_divergence(student, tokens[2:], temperature=1.0, form=form)
        kl.sum().backward()
        return kl.detach(), *(token.grad for token in student)

    expected = divergence(*(token.clone() for token in (x, y, teacher_x, teacher_y)))
    with pretended(device)() as pretend:
        found = divergence(*(token.to(device) for token in (x, y, teacher_x, teacher_y)))
        assert {tensor.device for tensor in found} == {pretend.device}
    for one, two in zip(found, expected, strict=True):
        torch.testing.assert_close(one, two)


def test_a_surface_is_fused_where_float64_is():
    z = 2 + 0.1 * torch.rand(24, 24, generator=torch.Generator().manual_seed(0))
    K, T = torch.tensor([[30.0, 0, 12], [0, 30, 12], [0, 0, 1]]), torch.eye(4)

    def fused(device):
        volume = TsdfVolume(voxel=0.05, truncation=0.2, device=device)
        for depth in (z, z + 0.02):
            volume.integrate(depth, K, T)
        return volume.device.type, volume.extract_mesh()

    _, expected = fused("cpu")
    for device, where in (("cuda", "cuda"), ("mps", "cpu")):
        with pretended(device)():
            used, mesh = fused(device)
        assert used == where
        np.testing.assert_allclose(mesh.vertices, expected.vertices, atol=1e-6)
        np.testing.assert_array_equal(mesh.triangles, expected.triangles)


@pytest.mark.parametrize("device", ["cuda", "mps"])
def test_evidence_is_the_same_on_every_device(device):
    scene = room(views=VIEWS, hw=(72, 96), seed=5)

    def measured(where):
        candidate = Candidate.of(scene, where)
        reference = Reference.of(candidate, matches)
        agreement = dense.depth_agreement(candidate, reference.common)
        return [
            reference.common.share, agreement.share, agreement.log_ratio, reference.keep,
            epipolar(candidate, matches).values, reprojection(candidate, matches).values,
            [dense.stability(candidate, [([0, 2, 1], candidate.select([0, 2, 1]))])[0].depth_log],
        ]  # fmt: skip

    matches = exact_matches(Candidate.of(scene))
    expected = measured("cpu")
    with pretended(device)():
        found = measured(device)
    for one, two in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_training_on_a_gpu_renders_learns_and_saves_there(tmp_path):
    config = TrainConfig(
        minutes=0.0, views=8, views_per_step=2, rooms=3, rooms_per_shard=1, rooms_at_start=0, render_share=0.0,
        frames=3, depth_views=1, warmup_views=1,
    )  # fmt: skip
    with pretended("cuda")() as pretend:
        waits = []

        def after_step(state):
            waits.append(list(pretend.waits))
            pretend.waits.clear()

        weights = train(config, tmp_path, device="cuda", progress=after_step)
    assert weights.is_file()
    # The first step fills tables; a shard is rendered, and its rooms copied, only every so many steps.
    assert len(waits) > 2
    assert waits[2:] == [[]] * len(waits[2:])
