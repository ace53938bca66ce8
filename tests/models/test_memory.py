"""The memory of a model and of a reconstruction: what a GPU measured, and tensors that really live."""

import pytest
import torch

from freegeo.errors import UserError
from freegeo.models import memory
from freegeo.models.api import embed_in_chunks
from freegeo.models.catalog import build_empty
from freegeo.models.memory import plan_reconstruction, shape_of
from freegeo.models.precision import Compute
from live_bytes import LiveBytes
from tiny_models import attach, tiny_da3, tiny_mapanything, tiny_pi3, tiny_pi3x, tiny_vggt

CPU, CUDA, MPS = Compute(), torch.device("cuda"), torch.device("mps")
GB = 1_000_000_000


def test_a_model_that_is_in_memory_already_is_not_counted_twice(monkeypatch):
    monkeypatch.setattr(memory, "host_available", lambda: 1_000_000)
    model = tiny_da3()
    assert memory.available(CPU.device, model) == 800_000 + sum(p.nbytes for p in model.parameters())
    assert memory.available(MPS, model) == 800_000


def test_reconstruction_says_how_many_views_fit():
    model, compute = build_empty("da3-giant"), Compute(device=CUDA, precision="bf16")
    _, fitting = plan_reconstruction(model, 8, (504, 378), compute=compute, budget=16 * GB)
    parts, _ = plan_reconstruction(model, fitting, (504, 378), compute=compute, budget=16 * GB)
    assert sum(size for _, size in parts) <= 16 * GB
    with pytest.raises(UserError, match=f"at most {fitting} views .--max-views {fitting}. or smaller images"):
        plan_reconstruction(model, fitting + 1, (504, 378), compute=compute, budget=16 * GB)
    with pytest.raises(UserError, match="smaller model"):
        plan_reconstruction(model, 4, (504, 378), compute=compute, budget=2 * GB)


@pytest.mark.parametrize("build", [tiny_da3, tiny_vggt, tiny_pi3x, tiny_mapanything])
def test_an_adapter_that_is_on_does_not_change_a_model_s_shape(build):
    model = build()
    before = shape_of(model)
    attach(model, rank=2)
    assert shape_of(model) == before


RECONSTRUCTION_GB = {
    ("da3-giant", 8): 8.42, ("da3-giant", 32): 10.89, ("da3-giant", 100): 20.13,
    ("vggt-1b", 8): 7.32, ("vggt-1b", 32): 8.22, ("vggt-1b", 100): 12.31,
    ("da3-base", 8): 2.41, ("da3-base", 32): 3.66, ("da3-base", 100): 8.07,
}  # fmt: skip
"""Peaks of 504 x 378 pixels in bf16 (benchmarks/results/gpu-reconstruct.json)."""


@pytest.mark.parametrize(("name", "views"), RECONSTRUCTION_GB)
def test_reconstruction_s_peak_agrees_with_what_a_gpu_measured(name, views):
    compute = Compute(device=CUDA, precision="bf16")
    parts, _ = plan_reconstruction(build_empty(name), views, (378, 504), compute=compute, budget=80 * GB)
    assert sum(size for _, size in parts) / GB == pytest.approx(RECONSTRUCTION_GB[name, views], rel=0.15)


@pytest.mark.parametrize("build", [tiny_da3, tiny_vggt, tiny_pi3, tiny_pi3x, tiny_mapanything])
@pytest.mark.parametrize("views", [4, 24])
def test_reconstruction_s_peak_covers_the_tensors_alive(build, views):
    model = build()
    pixels = torch.rand(views, 3, 64, 64)
    parts, _ = plan_reconstruction(model, views, (64, 64), compute=CPU, budget=GB)
    with torch.no_grad(), LiveBytes(model) as live:
        tokens = embed_in_chunks(model, pixels, device=CPU.device)
        model.decode(model.aggregate(tokens))
    alive = live.peak + pixels.nbytes + sum(p.nbytes for p in model.parameters())
    assert sum(size for _, size in parts) == pytest.approx(alive, rel=0.35)
