"""The memory planner: published measurements, tensors that really live, and what it chooses."""

import weakref

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from freegeo.adaptation import footprint, trainer
from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.dropout import pack_dropout
from freegeo.adaptation.engine import Engine
from freegeo.adaptation.images import SceneImages
from freegeo.adaptation.planner import choose_adaptation, plan_adaptation, plan_reconstruction
from freegeo.adaptation.recipe import paper, scene
from freegeo.errors import UserError
from freegeo.models.catalog import build_empty
from freegeo.models.da3 import DA3, DA3Config
from freegeo.models.precision import cast_linears
from tiny_models import DEFAULTS, randomise, tiny_da3, tiny_vggt

CPU, CUDA = torch.device("cpu"), torch.device("cuda")
GB = 1_000_000_000


class LiveBytes(TorchDispatchMode):
    """Counts the bytes of all tensors made while it is on, from their making to their end."""

    def __init__(self, model):
        super().__init__()
        # Weights are there before; views of them are made all the time.
        self.sizes = {p.untyped_storage()._cdata: 0 for p in model.parameters()}
        self.live = self.peak = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        found = func(*args, **(kwargs or {}))
        for tensor in found if isinstance(found, tuple | list) else (found,):
            if isinstance(tensor, torch.Tensor):
                self._count(tensor.untyped_storage())
        return found

    def _count(self, storage) -> None:
        key = storage._cdata
        if key not in self.sizes:
            self.sizes[key] = storage.nbytes()
            self.live += storage.nbytes()
            self.peak = max(self.peak, self.live)
            weakref.finalize(storage, self._end, key)

    def _end(self, key: int) -> None:
        self.live -= self.sizes.pop(key)


def wide_da3(ffn: str = "mlp") -> DA3:
    """A model whose activations outweigh everything else."""
    config = DA3Config(
        width=128, depth=8, heads=2, out_layers=(4, 5, 6, 7), alt_start=2, qknorm_start=2, rope_start=2, ffn=ffn,
        head_features=8, head_channels=(4, 8, 8, 8), patch_size=8, position_grid=4, camera_encoder_depth=1,
        camera_encoder_heads=2,
    )  # fmt: skip
    spec = tiny_da3().spec
    from dataclasses import replace

    return randomise(DA3(config, replace(spec, name="wide", loss_layers=config.out_layers, adaptation=DEFAULTS)), 0)


# Published: kB per token and adapted block that the student keeps for its backward pass (fact sheet, section 6.4). The
# published numbers with dropout have masks of 4 bytes per element.
PUBLISHED = [
    ("da3-giant", "bf16", torch.device("mps"), 108.8),
    ("da3-giant", "bf16", None, 74.0),
    ("da3-giant", "fp32", torch.device("mps"), 170),
    ("da3-giant", "fp32", None, 135),
    ("vggt-1b", "bf16", torch.device("mps"), 72.8),
    ("vggt-1b", "bf16", None, 44.1),
    ("vggt-1b", "fp32", torch.device("mps"), 108),
    ("vggt-1b", "fp32", None, 80),
]


@pytest.mark.parametrize(("name", "precision", "dropping_on", "kilobytes"), PUBLISHED)
def test_activations_per_token_are_those_that_were_measured(name, precision, dropping_on, kilobytes):
    shape = footprint.shape_of(build_empty(name))
    options = {"rank": 32, "dropout": dropping_on is not None, "device": dropping_on or CPU}
    assert footprint.saved_per_token(shape, precision, **options) / 1e3 == pytest.approx(kilobytes, rel=0.02)


@pytest.mark.parametrize("ffn", ["mlp", "swiglu"])
@pytest.mark.parametrize(("precision", "dropout"), [("fp32", 0.0), ("fp32", 0.1), ("bf16", 0.1)])
def test_activations_per_token_are_what_autograd_keeps(ffn, precision, dropout):
    """The difference of two depths: what everything else keeps falls out."""

    def kept(last: int) -> int:
        model = wide_da3(ffn)
        adapter = Adapter.attach(model, rank=8, alpha=8, dropout=dropout, generator=torch.Generator())
        pack_dropout(adapter)
        cast_linears(model, precision)
        model.train()
        owned = {p.untyped_storage()._cdata for p in model.parameters()}
        seen: dict[int, tuple[int, object]] = {}

        def pack(tensor):
            storage = tensor.untyped_storage()
            if storage._cdata not in owned:
                seen[storage._cdata] = storage.nbytes(), storage
            return tensor

        with trainer.autocast(CPU, precision):
            tokens = model.embed(torch.rand(1, 4, 3, 64, 64), layers=[7])
        hooks = torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor)
        with hooks, trainer.autocast(CPU, precision):
            levels = model.aggregate(tokens, layers=[last]).levels
        assert levels
        return sum(size for size, _ in seen.values())

    tokens = 4 * 65
    found = (kept(7) - kept(5)) / 2 / tokens
    shape = footprint.shape_of(wide_da3(ffn))
    predicted = footprint.saved_per_token(shape, precision, rank=8, dropout=dropout > 0, device=CPU)
    # In half precision autograd also keeps half copies of the small LoRA matrices.
    assert found == pytest.approx(predicted, rel=0.02 if precision == "fp32" else 0.08)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"recompute_blocks": True},
        {"micro_batch": 2},
        {"cache_teacher": False, "share_prefix": False},
        {"cache_place": "disk", "recompute_blocks": True},
        {"half_cache": True},
        {"hold": 1.0},
    ],
    ids=str,
)
def test_the_peak_is_that_of_the_tensors_alive(options, tmp_path):
    model = wide_da3()
    options = dict(options)
    changes = {"epochs": 2, "batch": 2, "sets_per_scene": 2, "distinct_seeds": 2, "rank": 8}
    recipe = scene(model.spec).changed(**changes, hold=options.pop("hold", None))
    images = torch.rand(24, 3, 128, 128, generator=torch.Generator().manual_seed(0))
    engine = Engine(cache_folder=tmp_path, **options)
    plan = plan_adaptation(model, [(24, (128, 128))], recipe, seed=42, engine=engine)
    weights = dict(plan.parts)["weights"]
    assert weights == sum(p.nbytes for p in model.parameters())
    scenes = [SceneImages(name="s", count=24, load=lambda frames: images[list(frames)], in_memory=True)]
    with LiveBytes(model) as live:
        trainer.adapt(model, scenes, recipe, engine=engine)
    assert plan.peak_bytes - weights == pytest.approx(live.peak, rel=0.15)


def test_what_is_kept_is_what_was_planned(monkeypatch, tmp_path):
    sizes = []
    step = trainer._Run.step

    def watched(self, number):
        result = step(self, number)
        sizes.append(self.bank.nbytes() + self.teacher.nbytes())
        return result

    monkeypatch.setattr(trainer._Run, "step", watched)
    for build in (tiny_da3, tiny_vggt):
        model = build()
        recipe = scene(model.spec).changed(epochs=3, batch=2, sets_per_scene=2, distinct_seeds=2, rank=2)
        images = torch.rand(12, 3, 32, 32)
        scenes = [SceneImages(name="s", count=12, load=lambda f, i=images: i[list(f)], in_memory=True)]
        plan = plan_adaptation(model, [(12, (32, 32))], recipe, seed=42, engine=Engine())
        trainer.adapt(model, scenes, recipe)
        assert max(sizes) == pytest.approx(plan.cache_bytes, rel=0.2)
        sizes.clear()


def eth3d(budget_gb: float, name: str = "da3-giant", host_gb: float = 60, side: int = 518, **options):
    """The ETH3D-sized job: 11 scenes, 5 view sets each, 3 epochs, batch 4."""
    model = build_empty(name)
    engine = Engine(device=CUDA, precision="bf16", half_weights=True, **options)
    recipe = paper(model.spec, "eth3d").changed(sets_per_scene=5)
    return choose_adaptation(
        model, [(40, (side, side))] * 11, recipe, seed=42, engine=engine, budget=int(budget_gb * GB),
        host_budget=int(host_gb * GB),
    )  # fmt: skip


def test_the_plan_gives_up_speed_only_where_memory_asks_for_it():
    large, middle, small = eth3d(74), eth3d(22), eth3d(14.7)
    assert (large.engine.cache_place, large.engine.recompute_blocks) == ("device", False)
    assert (middle.engine.cache_place, middle.engine.recompute_blocks) == ("host", False)
    assert (small.engine.cache_place, small.engine.recompute_blocks) == ("host", True)
    assert eth3d(22, host_gb=4).engine.cache_place == "disk"
    assert small.peak_bytes < 8 * GB
    for plan, budget in ((large, 74), (middle, 22), (small, 14.7)):
        assert plan.peak_bytes <= budget * GB


def test_half_caches_take_half_the_room():
    assert eth3d(74, half_cache=True).cache_bytes == pytest.approx(eth3d(74).cache_bytes / 2)


def test_small_images_make_larger_micro_batches():
    assert eth3d(74).engine.micro_batch == 1
    assert eth3d(74, side=224).engine.micro_batch == 4


def test_a_job_that_cannot_fit_is_refused_with_its_need():
    with pytest.raises(UserError, match=r"needs [\d.]+ GB even with activation checkpointing, and 2.0 GB are free"):
        eth3d(2)


def test_the_summary_names_the_parts():
    line = eth3d(14.7).summary()
    for part in ("weights", "optimiser", "of 14.7 GB", "checkpointing", "host memory"):
        assert part in line


def test_reconstruction_says_how_many_views_fit():
    model = build_empty("da3-giant")
    options = {"device": CUDA, "precision": "bf16", "half_weights": True}
    fitting = plan_reconstruction(model, 8, (504, 378), budget=16 * GB, **options).max_views
    plan = plan_reconstruction(model, fitting, (504, 378), budget=16 * GB, **options)
    assert plan.peak_bytes <= 16 * GB
    assert str(fitting) in plan.summary()
    with pytest.raises(UserError, match=f"at most {fitting} views .--max-views {fitting}. or smaller images"):
        plan_reconstruction(model, fitting + 1, (504, 378), budget=16 * GB, **options)
    with pytest.raises(UserError, match="smaller model"):
        plan_reconstruction(model, 4, (504, 378), budget=2 * GB, **options)


@pytest.mark.parametrize("build", [tiny_da3, tiny_vggt])
@pytest.mark.parametrize("views", [4, 24])
def test_reconstruction_s_peak_covers_the_tensors_alive(build, views):
    from freegeo.adaptation.bank import embed_in_chunks

    model = build()
    images = torch.rand(views, 3, 64, 64)
    plan = plan_reconstruction(model, views, (64, 64), device=CPU, precision="fp32", budget=GB)
    with torch.no_grad(), LiveBytes(model) as live:
        tokens = embed_in_chunks(model, images, device=CPU)
        model.decode(model.aggregate(tokens))
    alive = live.peak + images.nbytes + sum(p.nbytes for p in model.parameters())
    assert plan.peak_bytes == pytest.approx(alive, rel=0.35)


def test_the_plan_without_a_budget_takes_what_is_free():
    model = tiny_da3()
    plan = choose_adaptation(model, [(9, (32, 32))], scene(model.spec), seed=0, engine=Engine())
    assert plan.engine == Engine()
    assert plan.budget is not None
    assert plan.budget > 100_000_000
    assert plan_reconstruction(model, 9, (32, 32), device=CPU, precision="fp32").max_views > 9
