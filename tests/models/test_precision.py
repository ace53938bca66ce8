"""A run's device and precision: what is asked for, or the best at hand."""

import pytest
import torch

from freegeo.errors import UserError
from freegeo.models.precision import PRECISIONS, Compute
from tiny_models import noise, tiny_da3

DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}


def without_accelerators(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)


def with_cuda(monkeypatch, *, bf16: bool):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda: bf16)


def test_a_machine_without_accelerators_computes_in_float32(monkeypatch):
    without_accelerators(monkeypatch)
    assert Compute.choose() == Compute()
    assert Compute.choose("cpu", "bf16") == Compute(device=torch.device("cpu"), precision="bf16")


@pytest.mark.parametrize(("bf16", "precision"), [(True, "bf16"), (False, "fp32")])
def test_the_best_at_hand_is_taken(monkeypatch, bf16, precision):
    with_cuda(monkeypatch, bf16=bf16)
    assert Compute.choose() == Compute(device=torch.device("cuda"), precision=precision)
    assert Compute.choose("cpu") == Compute()
    assert Compute.choose("cuda:0", "fp16") == Compute(device=torch.device("cuda:0"), precision="fp16")


def test_published_work_takes_its_precision_on_a_gpu_unless_another_is_asked_for(monkeypatch):
    with_cuda(monkeypatch, bf16=True)
    assert Compute.choose().preferring("fp16").precision == "fp16"
    assert Compute.choose().preferring("fp32").preferring(None).precision == "fp32"
    assert Compute.choose().preferring("fp32").preferring("fp16").precision == "fp16"
    assert Compute.choose(precision="bf16").preferring("fp16").precision == "bf16"
    assert Compute(device=torch.device("cuda"), precision="bf16").preferring("fp16").precision == "bf16"
    assert Compute.choose("cpu").preferring("fp16") == Compute()
    with pytest.raises(UserError, match="unknown precision 'half'"):
        Compute.choose().preferring("half")


def test_a_gpu_without_bf16_takes_fp16_for_it_as_the_released_evaluation_does(monkeypatch):
    with_cuda(monkeypatch, bf16=False)
    assert Compute.choose().preferring("bf16").precision == "fp16"
    assert Compute.choose().precision == "fp32"


def test_what_is_not_there_is_refused(monkeypatch):
    without_accelerators(monkeypatch)
    with pytest.raises(UserError, match="'cuda' is not available here"):
        Compute.choose("cuda")
    with pytest.raises(UserError, match="unknown device 'gpu'"):
        Compute.choose("gpu")
    with pytest.raises(UserError, match="unknown precision 'half'"):
        Compute.choose("cpu", "half")
    with_cuda(monkeypatch, bf16=True)
    with pytest.raises(UserError, match="this machine has 1 CUDA devices"):
        Compute.choose("cuda:1")


@torch.no_grad()
@pytest.mark.parametrize("precision", PRECISIONS)
def test_linear_layers_run_in_the_precision_and_heads_in_float32(precision):
    model, compute = tiny_da3(), Compute(precision=precision)
    linear = model.get_submodule(model.adapter_targets()[0])
    seen = []
    linear.register_forward_hook(lambda _module, _inputs, output: seen.append(output.dtype))
    with compute.autocast():
        features = model.aggregate(model.embed(noise(3)[None]))
    assert seen == [DTYPES[precision]]
    assert model.decode(features).depth_z.dtype == torch.float32


def test_fp32_on_a_gpu_is_computed_without_tf32_and_leaves_the_settings_as_they_were():
    settings = [torch.backends.cuda.matmul, torch.backends.cudnn.conv, torch.backends.cudnn.rnn]
    before = [each.fp32_precision for each in settings]
    with Compute(device=torch.device("cuda")).autocast():
        assert [each.fp32_precision for each in settings] == ["ieee"] * 3
    assert [each.fp32_precision for each in settings] == before
    with Compute().autocast():
        assert [each.fp32_precision for each in settings] == before
