"""The memory planner: published measurements, tensors that really live, and what it chooses."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from freegeo.adaptation import memory
from freegeo.adaptation.adapt import adapt
from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.memory import Footprint, plan_adaptation
from freegeo.adaptation.recipe import named, scene
from freegeo.adaptation.samples import Samples, SceneImages
from freegeo.adaptation.views import schedule, visited
from freegeo.errors import UserError
from freegeo.models.catalog import build_empty
from freegeo.models.da3 import DA3
from freegeo.models.da3_config import DA3Config
from freegeo.models.memory import shape_of
from freegeo.models.precision import Compute
from live_bytes import LiveBytes
from tiny_models import DEFAULTS, parts_of, randomise, tiny_da3, tiny_vggt

CPU, CUDA, MPS = Compute(), torch.device("cuda"), torch.device("mps")
GB = 1_000_000_000


def wide_da3(ffn: str = "mlp") -> DA3:
    """A model whose activations outweigh everything else."""
    config = DA3Config(
        width=128, depth=8, heads=2, out_layers=(4, 5, 6, 7), alt_start=2, qknorm_start=2, rope_start=2, ffn=ffn,
        head_features=8, head_channels=(4, 8, 8, 8), patch_size=8, position_grid=4, camera_encoder_depth=1,
        camera_encoder_heads=2,
    )  # fmt: skip
    return randomise(
        DA3(config, replace(tiny_da3().spec, name="wide", loss_layers=config.out_layers, adaptation=DEFAULTS)), 0
    )


# Published: kB per token and adapted block that the student keeps for its backward pass (docs/method.md, "Memory of a
# step"). The published numbers with dropout have masks of 4 bytes per element.
PUBLISHED = [
    ("da3-giant", "bf16", True, 108.8),
    ("da3-giant", "bf16", False, 74.0),
    ("da3-giant", "fp32", True, 170),
    ("da3-giant", "fp32", False, 135),
    ("vggt-1b", "bf16", True, 72.8),
    ("vggt-1b", "bf16", False, 44.1),
    ("vggt-1b", "fp32", True, 108),
    ("vggt-1b", "fp32", False, 80),
]


@pytest.mark.parametrize(("name", "precision", "dropout", "kilobytes"), PUBLISHED)
def test_activations_per_token_are_those_that_were_measured(name, precision, dropout, kilobytes):
    compute = Compute(device=MPS, precision=precision)
    found = shape_of(build_empty(name)).saved_per_token(compute, rank=32, dropout=dropout)
    assert found / 1e3 == pytest.approx(kilobytes, rel=0.02)


@pytest.mark.parametrize("ffn", ["mlp", "swiglu"])
@pytest.mark.parametrize(("precision", "dropout"), [("fp32", 0.0), ("fp32", 0.1), ("bf16", 0.1)])
def test_activations_per_token_are_what_autograd_keeps(ffn, precision, dropout):
    """The difference of two depths: what everything else keeps falls out."""
    compute = Compute(precision=precision)

    def kept(last: int) -> int:
        model = wide_da3(ffn)
        Adapter.attach(model, rank=8, alpha=8, dropout=dropout, generator=torch.Generator())
        model.train()
        owned = {p.untyped_storage()._cdata for p in model.parameters()}
        seen: dict[int, tuple[int, object]] = {}

        def pack(tensor):
            storage = tensor.untyped_storage()
            if storage._cdata not in owned:
                seen[storage._cdata] = storage.nbytes(), storage
            return tensor

        with compute.autocast():
            tokens = model.embed(torch.rand(1, 4, 3, 64, 64), layers=[7])
        with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor), compute.autocast():
            levels = model.aggregate(tokens, layers=[last]).levels
        assert levels
        return sum(size for size, _ in seen.values())

    tokens = 4 * 65
    found = (kept(7) - kept(5)) / 2 / tokens
    shape = shape_of(wide_da3(ffn))
    predicted = shape.saved_per_token(compute, rank=8, dropout=dropout > 0)
    if precision != "fp32":
        # Autocast also keeps half copies of the weights.
        predicted += shape.half_copies(compute) / shape.blocks / tokens
    assert found == pytest.approx(predicted, rel=0.02 if precision == "fp32" else 0.08)


def images(count: int, side: int) -> SceneImages:
    pixels = torch.rand(count, 3, side, side, generator=torch.Generator().manual_seed(0))
    return SceneImages(name="s", count=count, load=lambda frames: pixels[list(frames)])


@pytest.mark.parametrize(("place", "checkpointing"), [("device", False), ("disk", True)])
@pytest.mark.parametrize("hold", [0.0, pytest.param(1.0, marks=pytest.mark.slow)])
def test_the_peak_is_that_of_the_tensors_alive(place, checkpointing, hold, tmp_path):
    model = wide_da3()
    recipe = scene(model.spec).changed(epochs=2, batch=2, sets_per_scene=2, distinct_seeds=2, rank=8, hold=hold)
    scenes = [images(24, 128)]
    job = Footprint(model, scenes, recipe, schedule([24], recipe, 42), CPU)
    plan = job.plan(place, checkpointing)
    weights = dict(plan.parts)["weights"]
    assert weights == sum(p.nbytes for p in model.parameters())
    with LiveBytes(model) as live:
        adapt(model, scenes, recipe, seed=42, plan=plan, resume_in=tmp_path)
    assert plan.peak_bytes - weights == pytest.approx(live.peak, rel=0.15)


@pytest.mark.parametrize("build", [tiny_da3, tiny_vggt])
@pytest.mark.parametrize("hold", [0.0, 1.0])
def test_samples_are_counted_to_the_byte(build, hold):
    model = build()
    recipe = scene(model.spec).changed(epochs=1, sets_per_scene=1, distinct_seeds=1, rank=2, hold=hold)
    steps = schedule([12], recipe, 42)
    samples = Samples(
        Adapter.attach(model, rank=2, alpha=2, dropout=0.0, generator=torch.Generator()), [images(12, 32)], recipe,
        steps, compute=CPU, place="device", folder=None, seed=42,
    )  # fmt: skip
    sample = samples.take(steps[0][0])
    samples.close()
    extra = sum(value.nbytes for value in sample.tokens.extra.values())
    sizes = sum(tensor.nbytes for tensor in parts_of(sample)) - extra
    twice = recipe.changed(epochs=2)
    plan = plan_adaptation(model, [images(12, 32)], twice, schedule([12], twice, 42), compute=CPU)
    # VGGT adds its special tokens after embedding; they are counted all the same.
    uncounted = 0 if build is tiny_da3 else 4 * 32 * 3 * sample.tokens.tokens.shape[1]
    assert plan.kept_bytes == sizes + uncounted


def eth3d(budget_gb: float, name: str = "da3-giant", **changes):
    """The ETH3D-sized job: 11 scenes, 5 view sets each, 3 epochs, batch 4."""
    model = build_empty(name)
    recipe = named("paper", model.spec, "eth3d").changed(sets_per_scene=5, **changes)
    scenes = [
        SceneImages(name=str(n), count=40, load=lambda f: torch.empty(len(f), 3, 518, 518, device="meta"))
        for n in range(11)
    ]
    compute = Compute(device=CUDA, precision="bf16")
    steps = schedule([40] * 11, recipe, 42)
    return plan_adaptation(model, scenes, recipe, steps, compute=compute, budget=int(budget_gb * GB))


def test_the_plan_gives_up_speed_only_where_memory_asks_for_it(monkeypatch):
    monkeypatch.setattr(memory.shutil, "disk_usage", lambda path: SimpleNamespace(free=100 * GB))
    large, middle, small = eth3d(74), eth3d(28), eth3d(14.7)
    assert (large.place, large.checkpointing) == ("device", False)
    assert (middle.place, middle.checkpointing) == ("disk", False)
    assert (small.place, small.checkpointing) == ("disk", True)
    for plan, budget in ((large, 74), (middle, 28), (small, 14.7)):
        assert plan.peak_bytes <= budget * GB
    # One view set's samples weigh the same whether the job has few or many.
    assert large.kept_bytes == middle.kept_bytes
    assert eth3d(14.7, hold=1.0).kept_bytes > 1.4 * small.kept_bytes


def test_a_job_that_fits_nowhere_is_refused_with_its_need(monkeypatch):
    with pytest.raises(UserError, match=r"needs [\d.]+ GB even with activation checkpointing .*, and 2.0 GB are free"):
        eth3d(2)
    monkeypatch.setattr(memory.shutil, "disk_usage", lambda path: SimpleNamespace(free=1 * GB))
    with pytest.raises(UserError, match=r"GB of disk"):
        eth3d(14.7)


def test_the_disk_is_looked_at_where_the_files_will_be(tmp_path, monkeypatch):
    asked, model = [], tiny_da3()
    monkeypatch.setattr(memory.shutil, "disk_usage", lambda path: asked.append(path) or SimpleNamespace(free=GB))
    adapt(model, [images(9, 32)], scene(model.spec).changed(steps=1), seed=0, resume_in=tmp_path / "not" / "yet")
    assert asked == [tmp_path]


def test_the_plan_is_said_in_one_line_and_its_parts_to_those_who_ask(caplog, monkeypatch):
    monkeypatch.setattr(memory.shutil, "disk_usage", lambda path: SimpleNamespace(free=100 * GB))
    caplog.set_level("DEBUG", logger="freegeo")
    plan = eth3d(14.7)
    said, parts = caplog.messages
    assert said == (
        f"adaptation needs about {plan.peak_bytes / 1e9:.1f} GB of memory (to fit: {plan.kept_bytes / 1e9:.1f} GB of "
        "teacher features on disk and activations computed twice, which is slower); 14.7 GB are free"
    )
    assert "weights" in parts and "optimiser" in parts
    caplog.clear()
    eth3d(200.0)
    assert caplog.messages[0].endswith("GB of memory; 200.0 GB are free")


def test_every_run_plans_with_what_is_free(monkeypatch):
    monkeypatch.setattr(memory, "available", lambda device, model: 1_000_000)
    model = tiny_da3()
    with pytest.raises(UserError, match="MB are free"):
        adapt(model, [images(9, 32)], scene(model.spec), seed=0)


MEASURED_GB = [
    # model, recipe, images, place, checkpointing, hold, measured peak (benchmarks/results/gpu-steps.json)
    ("da3-giant", "released-da3", (518, 518), "device", False, 0.0, 24.01),
    ("da3-giant", "released-da3", (518, 518), "device", True, 0.0, 9.49),
    ("da3-giant", "released-da3", (378, 504), "device", False, 0.0, 19.27),
    ("da3-giant", "released-da3", (518, 518), "device", False, 1.0, 40.21),
    ("da3-giant", "paper", (518, 518), "device", False, 0.0, 22.57),
    ("vggt-1b", "released-vggt", (518, 518), "device", False, 0.0, 23.72),
    ("vggt-1b", "released-vggt", (518, 518), "disk", True, 0.0, 7.33),
    ("da3-base", "released-da3", (518, 518), "device", False, 0.0, 4.16),
    ("da3-base", "released-da3", (378, 504), "device", False, 0.0, 3.26),
]


@pytest.mark.parametrize(("name", "recipe", "image_hw", "place", "checkpointing", "hold", "peak"), MEASURED_GB)
def test_the_peak_agrees_with_what_a_gpu_measured(name, recipe, image_hw, place, checkpointing, hold, peak):
    model = build_empty(name)
    once = {"sets_per_scene": 1, "distinct_seeds": 1, "batch": 1, "epochs": 2, "redraw": False, "hold": hold}
    recipe = named(recipe, model.spec, "eth3d").changed(**once)
    scenes = [SceneImages(name="", count=8, load=lambda f: torch.empty(len(f), 3, *image_hw, device="meta"))] * 4
    compute = Compute(device=CUDA, precision="bf16")
    job = Footprint(model, scenes, recipe, visited(schedule([8] * 4, recipe, 42)), compute)
    assert job.plan(place, checkpointing).peak_bytes / GB == pytest.approx(peak, rel=0.13)
