"""Everything that only a CUDA device can tell, in parts ordered by importance, each in a process of its own.

Run: python benchmarks/gpu.py [PART...] [--out benchmarks/results] [--minutes 9] [--dry-run]

A part whose file `gpu-PART.json` is in the output folder is not run again, so that a stopped run continues; every part
has a time limit and writes what it has measured so far after every case. Models have random weights, photos are noise:
times and memory depend on shapes alone. `--dry-run` takes the CPU and tiny shapes, to see that every line works.
"""

import argparse
import itertools
import json
import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from statistics import median

from record import write_result

ROOT = Path(__file__).resolve().parent.parent
SEED = 42
LIMITS_S = {
    "parity": 200, "commands": 240, "steps": 150, "job": 120, "plain": 60, "reconstruct": 60, "precision": 60,
    "fusion": 90, "families": 70, "saved": 40, "profile": 60, "training": 60, "compile": 90,
}  # fmt: skip
"""Parts in the order in which they run, and how long each may take."""
BIG, MIDDLE, OTHER = "da3-giant", "da3-base", "vggt-1b"
FAMILIES = ("pi3", "pi3x", "map-anything")
RECIPES = {BIG: "released-da3", MIDDLE: "released-da3", OTHER: "released-vggt"} | dict.fromkeys(FAMILIES, "paper")


class Bench:
    """What the parts share: device, shapes, and the file that their numbers go to."""

    def __init__(self, part: str, out: Path, dry: bool):
        import torch

        from freegeo.models.precision import Compute

        self.part, self.out, self.dry = part, out, dry
        self.device = torch.device("cpu" if dry else "cuda")
        self.compute = Compute(device=self.device, precision="bf16")
        self.results: dict[str, object] = {}
        self.started = time.monotonic()

    def keep(self, name: str, found: object) -> None:
        """Add a result and write the file."""
        import torch

        self.results[name] = found
        settings = {
            "part": self.part, "device": str(self.device), "dry_run": self.dry, "cuda": torch.version.cuda,
            "driver": driver(), "command": f"python benchmarks/gpu.py {self.part}",
        }  # fmt: skip
        write_result(result_file(self.part, self.out), settings=settings, results=self.results, show=False)
        print(f"{self.part}: {name}: {json.dumps(found)[:700]}", flush=True)

    def late(self, share: float = 0.7) -> bool:
        """Whether so much of the part's time is over that no further case should begin."""
        return time.monotonic() - self.started > share * LIMITS_S[self.part]

    def side(self, side: int) -> int:
        """The side of an image, in whole patches of 14."""
        return 56 if self.dry else side

    def model(self, name: str):
        """A published shape with random weights on the device; in a dry run a model of one tenth of the width."""
        import torch

        from freegeo.models.catalog import entry
        from freegeo.models.transformer import initialise

        with torch.device(self.device):
            model = small_model(name) if self.dry else entry(name).build()
        initialise(model, torch.Generator(self.device).manual_seed(0))
        return model.eval().requires_grad_(False)

    def forget(self) -> None:
        """Free what the last case held, and measure the peak anew."""
        import torch

        if self.device.type == "cuda":
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats()

    def peak_gb(self) -> float | None:
        """Most memory that tensors have held since `forget`."""
        import torch

        return torch.cuda.max_memory_allocated() / 1e9 if self.device.type == "cuda" else None

    def held_gb(self) -> float | None:
        """Memory that tensors hold now."""
        import torch

        return torch.cuda.memory_allocated() / 1e9 if self.device.type == "cuda" else None

    def now(self) -> float:
        """Wall clock, once the device has done all its work."""
        import torch

        if self.device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    def seconds(self, function: Callable[[], object], repeats: int = 3) -> list[float]:
        """Seconds of every call, after one that is not counted."""
        function()
        found = []
        for _ in range(1 if self.dry else repeats):
            started = self.now()
            function()
            found.append(self.now() - started)
        return found

    @contextmanager
    def case(self, name: str) -> Iterator[dict]:
        """Collect one case; what goes wrong in it is written down, and the next one begins."""
        found: dict[str, object] = {}
        self.forget()
        started = time.monotonic()
        try:
            yield found
        except Exception as error:  # one broken case must not cost the others their device time
            import traceback

            traceback.print_exc()
            found["error"] = f"{type(error).__name__}: {error}"
        self.keep(name, {**found, "case_s": round(time.monotonic() - started, 2)})


def small_model(name: str):
    """A model of the family and with the layers' structure of a published one, small enough for a dry run."""
    from freegeo.models.catalog import build_empty

    if name == OTHER:
        from freegeo.models.vggt import VGGT
        from freegeo.models.vggt_config import VGGTConfig

        config = VGGTConfig(
            width=64, depth=4, heads=1, encoder_depth=2, encoder_heads=1, camera_depth=1, camera_heads=1,
            out_layers=(0, 1, 2, 3), head_features=16, head_channels=(8, 16, 16, 16),
        )  # fmt: skip
        return VGGT(config, replace(build_empty(name).spec, loss_layers=config.out_layers))
    if name in FAMILIES:
        return small_family(name, build_empty(name))
    from freegeo.models.da3 import DA3
    from freegeo.models.da3_config import DA3Config

    config = DA3Config(
        width=64, depth=6, heads=1, out_layers=(2, 3, 4, 5), alt_start=2, qknorm_start=2, rope_start=2,
        head_features=16, head_channels=(8, 16, 16, 16),
    )  # fmt: skip
    return DA3(config, replace(build_empty(name).spec, loss_layers=config.out_layers))


def small_family(name: str, published):
    """A small model of the other families, with the structure of a published one (built on the meta device)."""
    if name == "map-anything":
        from freegeo.models import mapanything_config

        config = replace(
            published.config, width=64, heads=1, encoder_depth=2, depth=6, out_layers=(1, 3, 5), head_features=16,
            head_channels=(8, 16, 16, 16), dense_encoder=(8, 8, 8), global_encoder=(8, 8, 8),
        )  # fmt: skip
        return mapanything_config.build(config, replace(published.spec, loss_layers=config.out_layers))
    from freegeo.models import pi3_config

    config = replace(
        published.config, width=64, pairs=2, heads=1, encoder_depth=2, encoder_heads=1, head_width=64, head_depth=1,
        head_heads=1, dense_out=16, camera_out=16,
    )  # fmt: skip
    if config.x:
        small = {"head_channels": (16, 16, 16), "scale_width": 16, "scale_depth": 1, "scale_heads": 2, "scale_out": 16}
        config = replace(config, x=replace(config.x, pose_pairs=(0,), **small))
    return pi3_config.build(config, replace(published.spec, loss_layers=(config.readout,)))


def noise_scenes(count: int, frames: int, hw: tuple[int, int]):
    """Scenes of noise images in main memory."""
    import torch

    from freegeo.adaptation.samples import SceneImages

    scenes = []
    for number in range(count):
        images = torch.rand(frames, 3, *hw, generator=torch.Generator().manual_seed(number))
        scenes.append(SceneImages(name=str(number), count=frames, load=lambda f, i=images: i[list(f)]))
    return scenes


def adaptation_case(bench: Bench, model, scenes, recipe, found: dict, *, compute=None, **options) -> None:
    """Adapt once and note seconds of first and later steps, the peak, and the planner's prediction of it."""
    from freegeo.adaptation.adapt import adapt
    from freegeo.adaptation.memory import Footprint, plan_adaptation
    from freegeo.adaptation.views import schedule, visited

    compute = compute or bench.compute
    steps = schedule([scene.count for scene in scenes], recipe, SEED)
    if options:
        plan = Footprint(model, scenes, recipe, visited(steps), compute).plan(**options)
    else:
        plan = plan_adaptation(model, scenes, recipe, visited(steps), compute=compute)
    marks = [bench.now()]
    result = adapt(
        model, scenes, recipe, seed=SEED, compute=compute, plan=plan, on_step=lambda _: marks.append(bench.now())
    )
    took = [after - before for before, after in itertools.pairwise(marks)]
    per_epoch = len(steps) // (recipe.epochs or 1)
    peak, planned = bench.peak_gb(), plan.peak_bytes / 1e9
    found |= {
        "precision": compute.precision, "place": plan.place, "checkpointing": plan.checkpointing,
        "first_epoch_step_s": median(took[1:per_epoch] or took[:1]), "later_step_s": median(took[per_epoch:] or took),
        "steps_s": took[:8], "all_steps_s": marks[-1] - marks[0], "steps": len(steps),
        "peak_gb": peak, "planned_gb": planned, "planned_over_peak": peak and planned / peak,
        "planned_parts_gb": {name: size / 1e9 for name, size in plan.parts},
        "losses": [result.curve[0]["total"], result.curve[-1]["total"]], "gain": result.gain,
    }  # fmt: skip
    result.adapter.detach()


def one_set_recipe(model, name: str, **changes):
    """The named recipe with one view set a scene, a batch of one and two epochs, so that both kinds of step occur."""
    from freegeo.adaptation.recipe import named

    recipe = named(name, model.spec, "eth3d")
    once = {"sets_per_scene": 1, "distinct_seeds": 1, "batch": 1, "epochs": 2, "redraw": False}
    return recipe.changed(**{**once, **changes})


def steps(bench: Bench) -> None:
    """Seconds of a step and peak memory of the published models, 8 -> 4 views, with every plan."""
    from freegeo.models.precision import Compute

    square = (bench.side(518),) * 2
    wide = square if bench.dry else (378, 504)
    for name in (BIG, OTHER, MIDDLE):
        model = bench.model(name)
        scenes = noise_scenes(4, 8, square)
        kept, disk = {"place": "device", "checkpointing": False}, {"place": "disk", "checkpointing": True}
        cases: dict[str, tuple] = {
            "released": (scenes, {}, kept, None),
            "checkpointing, disk": (scenes, {}, disk, None),
            "hold": (scenes, {"hold": 1.0}, kept, None),
            "504 x 378": (noise_scenes(4, 8, wide), {}, kept, None),
        }
        if name == BIG:
            cases["checkpointing"] = (scenes, {}, {"place": "device", "checkpointing": True}, None)
            cases["hold, checkpointing, disk"] = (scenes, {"hold": 1.0}, disk, None)
            cases["fp16"] = (scenes, {}, kept, Compute(device=bench.device, precision="fp16"))
            cases["paper"] = (scenes, {"base": "paper"}, kept, None)
        for label, (images, changes, options, compute) in cases.items():
            if bench.late():
                return
            changes = dict(changes)
            base = changes.pop("base", RECIPES[name])
            with bench.case(f"{name}, {label}") as found:
                recipe = one_set_recipe(model, base, **changes)
                adaptation_case(bench, model, images, recipe, found, compute=compute, **options)
        del model


def job(bench: Bench) -> None:
    """The ETH3D-sized adaptation of DA3-Giant: 11 scenes, 55 view sets, 3 epochs, as the published recipe has it."""
    from freegeo.adaptation.recipe import named

    side = bench.side(518)
    model = bench.model(BIG)
    recipe = named("released-da3", model.spec, "eth3d").changed(epochs=3)
    if bench.dry:
        recipe = recipe.changed(sets_per_scene=1, distinct_seeds=1)
    scenes = noise_scenes(2 if bench.dry else 11, 20, (side, side))
    with bench.case(f"{BIG}, 518 px") as found:
        started = bench.now()
        adaptation_case(bench, model, scenes, recipe, found)
        found |= {"whole_job_s": bench.now() - started, "target_s": 60}


def plain(bench: Bench) -> None:
    """Steps of the plain reference on the same device."""
    from plain import PlainAdaptation

    from freegeo.adaptation.adapt import learning_rate
    from freegeo.adaptation.samples import released_augmentation
    from freegeo.adaptation.views import schedule

    for name in (BIG, MIDDLE):
        if bench.late(0.5):
            return
        model = bench.model(name)
        recipe = one_set_recipe(model, RECIPES[name])
        scenes = noise_scenes(2, 8, (bench.side(518),) * 2)
        visits = schedule([8, 8], recipe, SEED)
        with bench.case(f"{name}, freegeo") as found:
            adaptation_case(bench, model, scenes, recipe, found, place="device", checkpointing=False)
        with bench.case(name) as found:
            reference = PlainAdaptation(model, recipe, SEED, bench.compute)
            took, losses = [], []
            for number in range(2):
                view_set = visits[number][0].view_set
                started = bench.now()
                images = released_augmentation(scenes[view_set.scene].load(view_set.frames), view_set.seed)
                rate = learning_rate(number, len(visits), recipe)
                losses.append(reference.step(number, images, view_set.kept, rate))
                took.append(bench.now() - started)
            found |= {"steps_s": took, "losses": losses, "peak_gb": bench.peak_gb()}


def noise_batch(views: int, hw: tuple[int, int]):
    """Noise images as photos of the same size."""
    import torch

    from freegeo.types import ImageBatch

    images = torch.rand(views, 3, *hw, generator=torch.Generator().manual_seed(0))
    size = torch.tensor([hw] * views)
    one = torch.ones(views, 2, dtype=torch.float64)
    names = tuple(f"{i:03d}.png" for i in range(views))
    return ImageBatch(images=images, names=names, photo_hw=size, scale_xy=one, offset_xy=0 * one)


def reconstruct(bench: Bench) -> None:
    """Seconds and peak memory of reconstructing 8, 32 and 100 views of 504 x 378 pixels."""
    hw = (bench.side(378), bench.side(504))
    for name in (BIG, OTHER, MIDDLE):
        reconstruct_model(bench, bench.model(name), name, hw, (2, 3) if bench.dry else (8, 32, 100))


def reconstruct_model(bench: Bench, model, name: str, hw: tuple[int, int], counts: tuple[int, ...]) -> None:
    """The same for one model and some numbers of views."""
    from freegeo.models.memory import plan_reconstruction
    from freegeo.pipeline import predict

    for views in counts:
        if not bench.late():
            batch = noise_batch(views, hw)
            with bench.case(f"{name}, {views} views") as found:
                parts, fitting = plan_reconstruction(model, views, hw, compute=bench.compute)
                took = bench.seconds(lambda m=model, b=batch: predict(m, b, compute=bench.compute), repeats=2)
                planned, peak = sum(size for _, size in parts) / 1e9, bench.peak_gb()
                found["stage_peaks_gb"] = stage_peaks(bench, model, batch)
                found |= {
                    "s": took, "peak_gb": peak, "planned_gb": planned, "planned_over_peak": peak and planned / peak,
                    "planned_parts_gb": {part: size / 1e9 for part, size in parts}, "would_fit": fitting,
                }  # fmt: skip


def families(bench: Bench) -> None:
    """Adaptation (8 -> 4 views, recipe `paper`) and reconstruction of Pi3, Pi3X and MapAnything."""
    hw = (bench.side(378), bench.side(504))
    kept, disk = {"place": "device", "checkpointing": False}, {"place": "disk", "checkpointing": True}
    for name in FAMILIES:
        model = bench.model(name)
        for label, options in {"kept": kept, "checkpointing, disk": disk}.items():
            if not bench.late():
                with bench.case(f"{name}, {label}") as found:
                    recipe = one_set_recipe(model, RECIPES[name])
                    adaptation_case(bench, model, noise_scenes(4, 8, hw), recipe, found, **options)
        reconstruct_model(bench, model, name, hw, (2, 3) if bench.dry else (8, 32))
        del model


def stage_peaks(bench: Bench, model, batch) -> dict[str, float | None]:
    """Peak of each of the three stages of a reconstruction."""
    import torch

    from freegeo.models.api import embed_in_chunks

    found = {}
    with torch.no_grad(), bench.compute.autocast():
        bench.forget()
        tokens = embed_in_chunks(model, batch.images, device=bench.device)
        found["embedding"] = bench.peak_gb()
        bench.forget()
        features = model.aggregate(tokens, reference=model.spec.reference)
        found["aggregating"] = bench.peak_gb()
        bench.forget()
        model.decode(features)
        found["decoding"] = bench.peak_gb()
    return found


def saved(bench: Bench) -> None:
    """What autograd keeps of a student's pass (4 views of 518 pixels, adapter of rank 32), by type and shape."""
    from collections import Counter

    import torch

    from freegeo.adaptation.adapter import Adapter
    from freegeo.models.memory import shape_of

    for name in (BIG, OTHER, MIDDLE):
        model = bench.model(name)
        adapter = Adapter.attach(model, rank=32, alpha=32, dropout=0.0, generator=torch.Generator().manual_seed(0))
        images = noise_batch(4, (bench.side(518),) * 2).images.to(bench.device)[None]
        with bench.case(name) as found, bench.compute.autocast():
            tokens = model.embed(images, layers=model.spec.loss_layers)
            seen: dict[int, tuple[str, int]] = {}

            def keep(tensor, seen=seen):
                storage = tensor.untyped_storage()
                seen[storage.data_ptr()] = (f"{str(tensor.dtype)[6:]} {tuple(tensor.shape)}", storage.nbytes())
                return tensor

            before = bench.held_gb()
            with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
                levels = model.aggregate(tokens, layers=model.spec.loss_layers).levels
            after, peak = bench.held_gb(), bench.peak_gb()
            weights = {p.untyped_storage().data_ptr() for p in model.parameters()}
            kept = [entry for place, entry in seen.items() if place not in weights]
            bytes_of = Counter()
            for label, size in kept:
                bytes_of[label] += size
            shape, count = shape_of(model), tokens.tokens.shape[1] * tokens.tokens.shape[2]
            found |= {
                "before_gb": before, "after_gb": after, "peak_gb": peak, "tokens": count,
                "saved_gb": sum(size for _, size in kept) / 1e9, "blocks": shape.blocks,
                "planned_bytes_per_token_and_block": shape.saved_per_token(bench.compute, rank=32, dropout=False),
                "by_shape_mb": {label: round(size / 1e6, 1) for label, size in bytes_of.most_common(40)},
                "how_many": dict(Counter(label for label, _ in kept).most_common(40)),
            }  # fmt: skip
            del levels
        adapter.detach()
        del model


def profile(bench: Bench) -> None:
    """Where a later step of the big model spends its time: the operations that take the device longest."""
    import torch
    from torch.profiler import ProfilerActivity

    from freegeo.adaptation.adapt import adapt

    model = bench.model(BIG)
    recipe = one_set_recipe(model, RECIPES[BIG], epochs=3)
    profiler = torch.profiler.profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA])
    with bench.case(BIG) as found:

        def on_step(progress) -> None:
            if progress.step == 2:
                bench.now()
                profiler.start()
            if progress.step == 4:
                bench.now()
                profiler.stop()

        adapt(
            model, noise_scenes(2, 8, (bench.side(518),) * 2), recipe, seed=SEED, compute=bench.compute, on_step=on_step
        )
        events = sorted(profiler.key_averages(), key=lambda e: -(e.self_device_time_total or e.self_cpu_time_total))
        found["ms_of_2_steps"] = {e.key[:80]: [round(e.self_device_time_total / 1e3, 2), e.count] for e in events[:40]}
        # Kernels are listed under their own names and, once more, under the operations that launch them.
        found["device_ms"] = sum(e.self_device_time_total for e in events if e.key.startswith("aten::")) / 1e3


def precision(bench: Bench) -> None:
    """How far features, depth and cameras of every arithmetic are from those of fp32 (again: its own scatter)."""
    import torch

    from freegeo.models.precision import PRECISIONS, autocast

    images = noise_batch(8, (bench.side(378), bench.side(504))).images.to(bench.device)[None]
    for name in (BIG, OTHER, MIDDLE):
        if bench.late():
            return
        model = bench.model(name)

        @torch.no_grad()
        def answer(context, model=model):
            with context:
                features = model.aggregate(model.embed(images))
                found = model.decode(features)
            return {
                "features": features.levels[max(features.levels)][0].float(), "depth": found.depth_z,
                "cameras": found.T_cam_world, "K": found.K,
            }  # fmt: skip

        with bench.case(name) as found:
            exact = answer(autocast(bench.device, "fp32"))
            contexts = {kind: autocast(bench.device, kind) for kind in PRECISIONS}
            for label, context in {**contexts, "fp32 with PyTorch's TF32 convolutions": nullcontext()}.items():
                other = answer(context)
                found[label] = {key: float((other[key] - v).norm() / v.norm()) for key, v in exact.items()}
        del model


def fusion(bench: Bench) -> None:
    """TSDF fusion of 100 depth maps of 1024 x 768 pixels: CUDA, and the CPU with all its cores."""
    import torch
    import tsdf

    from freegeo.fusion.tsdf import TsdfVolume

    tsdf.HEIGHT, tsdf.WIDTH, tsdf.FOCAL = (48, 64, 52.0) if bench.dry else (768, 1024, 840.0)
    count = 4 if bench.dry else 100
    K = torch.tensor([[tsdf.FOCAL, 0, tsdf.WIDTH / 2], [0, tsdf.FOCAL, tsdf.HEIGHT / 2], [0, 0, 1]]).double()
    cameras = [tsdf.camera(index, count) for index in range(count)]
    depths = [tsdf.render(T, K) for T in cameras]
    meshes = {}
    for device in dict.fromkeys((str(bench.device), "cpu")):
        with bench.case(device) as found:
            on_device = [depth.to(device) for depth in depths]
            TsdfVolume(voxel=0.02, truncation=0.15, device=device).integrate(on_device[0], K, cameras[0])
            volume = TsdfVolume(voxel=0.02, truncation=0.15, device=device)
            started = bench.now()
            for depth, T in zip(on_device, cameras, strict=True):
                volume.integrate(depth, K, T)
            fused = bench.now()
            mesh = meshes[device] = volume.extract_mesh()
            found |= {
                "frames": count, "fusion_s": fused - started, "mesh_s": bench.now() - fused,
                "blocks": volume.block_count, "vertices": len(mesh.vertices), "triangles": len(mesh.triangles),
                "peak_gb": bench.peak_gb(), "threads": torch.get_num_threads(),
            }  # fmt: skip
    with bench.case("difference") as found:
        a, b = (mesh.vertices for mesh in (meshes[str(bench.device)], meshes["cpu"]))
        found["vertices"] = len(a) - len(b)
        if len(a) == len(b):
            found["largest_m"] = float(abs(a - b).max())


def training(bench: Bench) -> None:
    """Views a second of the embedded model's training, from the log of a short leg."""
    folder = bench.out / "training-run"
    minutes = 0.05 if bench.dry else 0.6
    with bench.case("default settings") as found:
        command = ["train-tiny", str(folder), "--device", str(bench.device), "--minutes", str(minutes), "--rooms", "16"]
        command += ["--views-per-step", "16"] * bench.dry  # more takes the memory and the patience of a CPU
        started = time.monotonic()
        found["rc"] = freegeo(*command)
        found["wall_s"] = time.monotonic() - started
        log = folder / "log.jsonl"
        found["log"] = [json.loads(line) for line in log.read_text().splitlines()[-3:]] if log.is_file() else []


def compiled(bench: Bench) -> None:
    """Seconds of `aggregate`, and of it with its backward pass, as it is and through torch.compile."""
    import torch

    for name in (MIDDLE, BIG):
        if bench.late(0.4):
            return
        model = bench.model(name)
        views = noise_batch(4, (bench.side(518),) * 2).images.to(bench.device)[None]
        with torch.no_grad(), bench.compute.autocast():
            tokens = model.embed(views, layers=model.spec.loss_layers)
        tokens.tokens.requires_grad_()

        def both(aggregate, tokens=tokens, layers=model.spec.loss_layers):
            with bench.compute.autocast():
                levels = aggregate(tokens, layers=layers).levels
            sum(patch.float().square().mean() for patch, _ in levels.values()).backward()

        with bench.case(name) as found:
            found["eager_s"] = bench.seconds(lambda m=model: both(m.aggregate), repeats=5)
            fast = torch.compile(model.aggregate, backend="eager" if bench.dry else "inductor")
            started = bench.now()
            both(fast)
            found["compile_s"] = bench.now() - started
            found["compiled_s"] = bench.seconds(lambda f=fast: both(f), repeats=5)
        del model


def freegeo(*arguments: str) -> int:
    """Run a command of freegeo; its output goes to ours."""
    return subprocess.run(
        [sys.executable, "-m", "freegeo.cli.app", *arguments], check=False, env=environment()
    ).returncode


def environment(**changes: str) -> dict[str, str]:
    """The environment of a child process that finds the package in this tree."""
    paths = [str(ROOT / "src"), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths)), **changes}


def parity(bench: Bench) -> None:
    """The recorded numbers of networks, losses, functions and fusion, on the device, in float32 without TF32."""
    with bench.case("fixtures") as found:
        errors, failed = {}, {}
        with subprocess.Popen(
            [sys.executable, "parity.py"], cwd=ROOT / "tests", env=environment(FREEGEO_DEVICE=str(bench.device)),
            stdout=subprocess.PIPE, text=True,
        ) as process:  # fmt: skip
            for line in process.stdout:
                if match := re.match(r"(\S+): error (\S+) of the tolerance (\S+)", line):
                    name, error, word = match.groups()
                    errors[name] = float(error)
                    failed |= {name: float(error)} if word != "ok" else {}
                    found |= {"cases": len(errors), "failed": failed}
                    found["worst"] = sorted(((e, n) for n, e in errors.items()), reverse=True)[:8]
                    if len(errors) % 20 == 0:
                        bench.keep("fixtures", {**found, "so_far_s": round(time.monotonic() - bench.started)})


def commands(bench: Bench) -> None:
    """`freegeo run` and a benchmark task with the embedded model, on the device and on the CPU."""
    import numpy as np

    folder = bench.out / "commands"
    devices = dict.fromkeys((str(bench.device), "cpu"))
    few = ("--steps", "4") if bench.dry else ("--steps", "20")
    for device in devices:
        with bench.case(f"run, {device}, fp32") as found:
            found["rc"] = freegeo(
                "run", "demo", "-o", str(folder / f"run-{device}"), "--model", "freegeo-tiny", "--device", device,
                "--precision", "fp32", "--guard", "off", "--formats", "npz,ply,mesh", *few, "--overwrite",
            )  # fmt: skip
    with bench.case("run, difference") as found:
        for stage in ("frozen/prediction.npz", "prediction.npz"):
            here, there = (np.load(folder / f"run-{device}" / stage) for device in (str(bench.device), "cpu"))
            for key in ("depth_z", "T_cam_world", "K"):
                difference = np.linalg.norm(here[key] - there[key]) / np.linalg.norm(there[key])
                found[f"{stage}: {key}"] = float(difference)
    with bench.case("run, default precision") as found:
        found["rc"] = freegeo(
            "run", "demo", "-o", str(folder / "run-default"), "--model", "freegeo-tiny", "--device", str(bench.device),
            *few, "--overwrite",
        )  # fmt: skip
    for device in devices:
        with bench.case(f"bench, {device}, fp32") as found:
            out = folder / f"bench-{device}"
            found["rc"] = freegeo(
                "bench", "run", "main", "--scenes", "1" if bench.dry else "3", "--seeds", "43", *few, "-o", str(out),
                "--data", str(folder / "data"), "--datasets", "procedural-light", "--device", device, "--precision",
                "fp32", "--overwrite",
            )  # fmt: skip
            table = out / "tables" / "main.txt"
            found["table"] = table.read_text().splitlines() if table.is_file() else []


PARTS: dict[str, Callable[[Bench], None]] = {
    "parity": parity, "commands": commands, "steps": steps, "job": job, "plain": plain, "reconstruct": reconstruct,
    "precision": precision, "fusion": fusion, "families": families, "saved": saved, "profile": profile,
    "training": training, "compile": compiled,
}  # fmt: skip


def result_file(part: str, out: Path) -> Path:
    """Where the numbers of a part are written."""
    return out / f"gpu-{part}.json"


def driver() -> str | None:
    """Version of the NVIDIA driver."""
    file = Path("/proc/driver/nvidia/version")
    found = re.search(r"\d+\.\d+(\.\d+)?", file.read_text()) if file.is_file() else None
    return found and found.group()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; default: all")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--minutes", type=float, default=9.0, help="no part begins after so long")
    parser.add_argument("--dry-run", action="store_true", help="on the CPU, with tiny shapes")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    unknown = set(options.parts) - set(PARTS)
    if unknown:
        parser.error(f"unknown part {', '.join(sorted(unknown))}; choose among {', '.join(PARTS)}")
    out = options.out.resolve()
    if options.worker:
        [part] = options.parts
        PARTS[part](Bench(part, out, options.dry_run))
        return
    begun, failed = time.monotonic(), []
    for part in options.parts or PARTS:
        left = 60 * options.minutes - (time.monotonic() - begun)
        if result_file(part, out).is_file() or left <= 0:
            print(f"{part}: {'already there' if left > 0 else 'no time left'}", flush=True)
            continue
        started = time.monotonic()
        command = [sys.executable, __file__, part, "--worker", "--out", str(out), *["--dry-run"] * options.dry_run]
        try:
            code = subprocess.run(
                command, env=environment(), timeout=min(LIMITS_S[part], math.ceil(left)), check=False
            ).returncode
        except subprocess.TimeoutExpired:
            code = "out of time"
        failed += [part] if code else []
        print(f"{part}: {code or 'done'} after {time.monotonic() - started:.0f} s", flush=True)
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
