"""A run's device and precision: what is asked for, or the best at hand."""

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from freegeo.adaptation.losses import adaptation_loss, draw_tokens, held_out_tokens
from freegeo.adaptation.recipe import scene
from freegeo.errors import UserError
from freegeo.models.precision import PRECISIONS, Compute
from tiny_models import noise, tiny_da3, tiny_mapanything, tiny_pi3, tiny_pi3x, tiny_vggt, trained

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


HALF = {torch.bfloat16, torch.float16}
PRODUCTS = {"mm", "addmm", "bmm", "baddbmm", "convolution"}


def model_loss(model):
    """The loss of the recipe `scene`."""
    return scene(model.spec).loss


class Recorder(TorchDispatchMode):
    """Which floating types every operation reads and gives, by its name."""

    def __init__(self):
        super().__init__()
        self.seen: dict[str, set[torch.dtype]] = {}

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        name = func.name().removeprefix("aten::").partition(".")[0]
        found = {leaf.dtype for leaf in tree_leaves((args, kwargs, result)) if isinstance(leaf, Tensor)}
        self.seen.setdefault(name, set()).update(dtype for dtype in found if dtype.is_floating_point)
        return result

    def of_products(self) -> set[torch.dtype]:
        """Types of all matrix products and convolutions."""
        return set().union(*(types for name, types in self.seen.items() if name in PRODUCTS))

    def everything(self) -> set[torch.dtype]:
        """Types of all operations."""
        return set().union(*self.seen.values())


@pytest.mark.parametrize("precision", ["bf16", "fp16"])
@pytest.mark.parametrize("make", [tiny_da3, tiny_vggt, tiny_pi3, tiny_pi3x, tiny_mapanything])
def test_half_precision_stays_in_the_products_of_embed_and_aggregate(make, precision):
    model, compute, half = make(), Compute(precision=precision), DTYPES[precision]
    adapter = trained(model)
    images, kept = noise(4)[None], (0, 2)
    with compute.autocast():
        with Recorder() as embedding:
            tokens = model.embed(images)
        with Recorder() as aggregating:
            student = model.aggregate(tokens.select(kept))
        with torch.no_grad(), adapter.off():
            teacher = model.aggregate(tokens)
    assert embedding.of_products() == aggregating.of_products() == {half}
    attention = [types for name, types in aggregating.seen.items() if "attention" in name]
    assert attention
    # Besides its half inputs and output, attention gives the logarithms of its softmax's sums, in float32.
    assert all(types <= {half, torch.float32} for types in attention)
    streams = [tokens.tokens, *(tensor for level in student.levels.values() for tensor in level)]
    assert {tensor.dtype for tensor in streams} == {torch.float32}
    with torch.no_grad(), compute.autocast(), Recorder() as decoding:
        model.decode(teacher)
    # MapAnything's intrinsics are fitted in float64, and Pi3X makes its map of places in it.
    wide = {torch.float64} if make in (tiny_mapanything, tiny_pi3x) else set()
    assert decoding.everything() - wide == {torch.float32}

    config, last = model_loss(model), max(teacher.levels)
    with Recorder() as losing:
        loss, _ = adaptation_loss(
            student.levels, teacher.select(kept).levels, held_out_tokens(teacher.levels[last], kept, config),
            draw_tokens(config, tokens_per_view=16, student_views=2, held_out=32, generator=torch.Generator()),
            config,
        )  # fmt: skip
    assert losing.everything() == {torch.float32, torch.float64}
    loss.backward()
    assert {value.dtype for p in adapter.parameters() for value in (p, p.grad)} == {torch.float32}


def test_losses_of_half_features_are_computed_in_float32():
    config = model_loss(tiny_da3())
    generator = torch.Generator().manual_seed(0)
    patch, other = (torch.randn(1, 2, 16, 32, generator=generator).bfloat16() for _ in range(2))
    special = patch[:, :, :1]
    draws = draw_tokens(config, tokens_per_view=16, student_views=2, held_out=32, generator=generator)
    with Recorder() as losing:
        loss, terms = adaptation_loss(
            {0: (patch.requires_grad_(), special)}, {0: (other, special)}, other.flatten(1, 2), draws, config
        )
    assert losing.of_products() <= {torch.float32, torch.float64}
    assert {loss.dtype, *(term.dtype for term in terms.values())} == {torch.float32}


@torch.no_grad()
def test_the_reference_view_is_chosen_in_float32():
    """Views are so alike that half precision would choose another one in every second scene."""
    model = tiny_da3()
    tokens = model.embed(noise(6)[None])
    expected = model.view_order(tokens, "saddle_balanced")
    with Compute(precision="bf16").autocast(), Recorder() as choosing:
        assert torch.equal(model.view_order(tokens, "saddle_balanced"), expected)
    assert choosing.everything() == {torch.float32}
