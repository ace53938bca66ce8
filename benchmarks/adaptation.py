"""CPU seconds, memory and loss of adaptation steps: a plain reference, then freegeo with its memory plans in turn.

Run: python benchmarks/adaptation.py CASE... [--out benchmarks/results]     (cases: see CASES below)

Every variant runs in a process of its own, on one thread, with random weights. Times are CPU seconds (process time, all
threads of the process), medians over the steps of a kind; memory is the peak resident size less the size after the
imports. The plain reference runs one step only where a step takes minutes.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from statistics import median

from record import machine, write_result

SEED = 42
SCENES = 3
"""Scenes of 8 frames, one view set each: no image is shared between view sets."""

VARIANTS: dict[str, dict] = {
    "plain": {"plain": True},
    "freegeo": {},
    "freegeo, checkpointing": {"checkpointing": True},
    "freegeo, samples on disk": {"place": "disk"},
}
CASES: dict[str, dict] = {
    "small-112": {"model": "da3-small", "px": 112, "recipe": "released-da3", "plain_steps": 3},
    "small-112-hold": {"model": "da3-small", "px": 112, "recipe": "paper", "hold": 1.0, "variants": ["freegeo"]},
    "small-224": {"model": "da3-small", "px": 224, "recipe": "released-da3", "plain_steps": 1},
    "small-224-paper": {"model": "da3-small", "px": 224, "recipe": "paper", "variants": ["freegeo"]},
    "base-112": {
        "model": "da3-base", "px": 112, "recipe": "released-da3", "plain_steps": 1, "variants": ["plain", "freegeo"],
    },
    "base-224": {
        "model": "da3-base", "px": 224, "recipe": "released-da3", "plain_steps": 1,
        "variants": ["plain", "freegeo", "freegeo, checkpointing"],
    },
    "vggt-112": {
        "model": "vggt-small-shape", "px": 112, "recipe": "released-vggt", "plain_steps": 1,
        "variants": ["plain", "freegeo", "freegeo, checkpointing"],
    },
    "vggt-224": {
        "model": "vggt-small-shape", "px": 224, "recipe": "released-vggt", "plain_steps": 1,
        "variants": ["plain", "freegeo"],
    },
    "small-518": {
        "model": "da3-small", "px": 518, "recipe": "released-da3", "epochs": 2, "scenes": 1, "variants": ["freegeo"],
    },
    "curve-112": {"model": "da3-small", "px": 112, "recipe": "paper", "curve": True},
}  # fmt: skip


def build_model(name: str):
    """A model with seeded random weights, frozen; `vggt-small-shape` is VGGT's architecture at width 384, 6 pairs."""
    import torch

    from freegeo.models.catalog import build_empty, entry
    from freegeo.models.transformer import initialise

    if name == "vggt-small-shape":
        from dataclasses import replace

        from freegeo.models.vggt import VGGT
        from freegeo.models.vggt_config import VGGTConfig

        config = VGGTConfig(
            width=384, depth=6, heads=6, encoder_depth=6, encoder_heads=6, camera_depth=1, camera_heads=6,
            out_layers=(2, 3, 4, 5), head_features=64, head_channels=(48, 96, 192, 384),
        )  # fmt: skip
        spec = replace(build_empty("vggt-1b").spec, name=name, loss_layers=config.out_layers)
        model = VGGT(config, spec)
    else:
        model = entry(name).build()
    initialise(model, torch.Generator().manual_seed(0))
    return model.eval().requires_grad_(False)


def build_recipe(model, case: dict):
    """The case's recipe with one view set a scene and a batch of one, unless the case says otherwise."""
    from freegeo.adaptation.recipe import named

    recipe = named(case["recipe"], model.spec, "eth3d")
    # `released-vggt` draws new views in every epoch; keeping them shows what keeping the teacher gives.
    return recipe.changed(
        sets_per_scene=1, distinct_seeds=1, batch=1, epochs=case.get("epochs", 2), redraw=False, hold=case.get("hold")
    )


def scene_images(count: int, px: int):
    """Scenes of 8 noise images."""
    import torch

    from freegeo.adaptation.samples import SceneImages

    scenes = []
    for number in range(count):
        images = torch.rand(8, 3, px, px, generator=torch.Generator().manual_seed(number))
        scenes.append(SceneImages(name=str(number), count=8, load=lambda f, i=images: i[list(f)]))
    return scenes


def teacher_seconds(model, images, adapter) -> float:
    """CPU seconds of the teacher's whole forward pass on 8 views."""
    import torch

    layers = model.spec.loss_layers
    started = time.process_time()
    with torch.no_grad(), adapter.off():
        model.aggregate(model.embed(images[None], layers=layers), layers=layers)
    return time.process_time() - started


def resident_bytes() -> int:
    """Resident size now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def work(job: dict) -> dict:
    """Run one variant in this process."""
    import peft  # noqa: F401
    import torch

    from freegeo.adaptation import adapt  # noqa: F401

    torch.set_num_threads(1)
    before = resident_bytes()
    case, options = job["case"], VARIANTS[job["variant"]]
    model = build_model(case["model"])
    scenes = scene_images(case.get("scenes", SCENES), case["px"])
    run = run_plain if options.get("plain") else run_freegeo
    result = run(model, scenes, build_recipe(model, case), case, options, job["tensors"])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {**result, "peak_above_start_mb": (peak - before) / 1e6, "load": os.getloadavg()[0]}


def run_plain(model, scenes, recipe, case: dict, _options: dict, tensors: str) -> dict:
    """Steps of the plain reference."""
    import torch
    from plain import PlainAdaptation

    from freegeo.adaptation.adapt import learning_rate
    from freegeo.adaptation.samples import released_augmentation
    from freegeo.adaptation.views import schedule

    reference = PlainAdaptation(model, recipe, SEED)
    steps = schedule([scene.count for scene in scenes], recipe, SEED)
    seconds, losses = [], []
    for number, visits in enumerate(steps[: case["plain_steps"]]):
        view_set = visits[0].view_set
        started = time.process_time()
        images = released_augmentation(scenes[view_set.scene].load(view_set.frames), view_set.seed)
        losses.append(reference.step(number, images, view_set.kept, learning_rate(number, len(steps), recipe)))
        seconds.append(time.process_time() - started)
    torch.save({n: p.detach() for n, p in reference.adapter.named_parameters().items()}, tensors)
    per_step = median(seconds)
    return {"first_step_s": per_step, "later_step_s": per_step, "steps": len(seconds), "losses": losses}


def run_freegeo(model, scenes, recipe, case: dict, options: dict, tensors: str) -> dict:
    """A whole run; the loss is timed inside the steps, and the teacher alone after each, under the same load."""
    import torch

    from freegeo.adaptation import adapt as adapting
    from freegeo.adaptation.memory import Footprint
    from freegeo.adaptation.views import schedule
    from freegeo.models.precision import Compute

    steps = schedule([scene.count for scene in scenes], recipe, SEED)
    options = {"place": "device", "checkpointing": False, **options}
    plan = Footprint(model, scenes, recipe, steps, Compute()).plan(**options)
    marks, seconds, in_loss, teacher = [0.0], [], [0.0], []
    images = scenes[0].load(range(8))
    original = adapting.adaptation_loss

    def timed_loss(*args, **keywords):
        started = time.process_time()
        found = original(*args, **keywords)
        in_loss[-1] += time.process_time() - started
        return found

    def after_step(progress) -> None:
        seconds.append(time.process_time() - marks[-1])
        teacher.append(teacher_seconds(model, images, adapters[0]))
        in_loss.append(0.0)
        marks.append(time.process_time())

    adapters = []
    attach = adapting.Adapter.attach
    adapting.Adapter.attach = lambda *args, **keywords: adapters.append(attach(*args, **keywords)) or adapters[0]
    adapting.adaptation_loss = timed_loss
    marks[0] = time.process_time()
    result = adapting.adapt(model, scenes, recipe, seed=SEED, plan=plan, on_step=after_step)
    torch.save({n: p.detach() for n, p in result.adapter.named_parameters().items()}, tensors)
    epoch = len(seconds) // recipe.epochs
    return {
        "first_step_s": median(seconds[:epoch]),
        "later_step_s": median(seconds[epoch:]),
        "steps_s": seconds,
        "loss_s": median(in_loss[:-1]),
        "losses": [terms["total"] for terms in result.curve],
        "planned_mb": plan.peak_bytes / 1e6,
        "teacher_s": median(teacher),
    }


def curve(case: dict) -> dict:
    """CPU seconds per epoch for 1, 2 and 4 view sets."""
    import torch

    from freegeo.adaptation.adapt import adapt

    torch.set_num_threads(1)
    found = {}
    for sets in (1, 2, 4):
        model = build_model(case["model"])
        recipe = build_recipe(model, case).changed(epochs=4)
        ends = []
        started = time.process_time()
        adapt(
            model,
            scene_images(sets, case["px"]),
            recipe,
            seed=SEED,
            on_epoch=lambda *_, e=ends: e.append(time.process_time()),
        )
        found[f"{sets} view sets"] = [round(b - a, 3) for a, b in pairwise([started, *ends])]
    return {"cpu_s_per_epoch": found}


def relative_difference(ours: str, theirs: str) -> float:
    """Norm of the difference of two sets of adapter tensors, over the norm of the second."""
    import torch

    a, b = torch.load(ours), torch.load(theirs)
    squares = [((a[name] - b[name]).double().square().sum(), b[name].double().square().sum()) for name in b]
    return float((sum(s for s, _ in squares) / sum(s for _, s in squares)).sqrt())


def spawn(job: dict) -> dict:
    """Run one job in a fresh process."""
    done = subprocess.run(
        [sys.executable, __file__, "--worker", json.dumps(job)], stdout=subprocess.PIPE, text=True, check=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    return json.loads(done.stdout.splitlines()[-1])


def run_case(name: str, only: list[str], before: dict) -> dict:
    """Run the variants of a case; losses of the first step and adapters are compared with the first one that is there.

    `only` names variants to run; results of the others are taken over from `before`.
    """
    case = CASES[name]
    if case.get("curve"):
        return spawn({"case": case, "curve": True})
    variants = case.get("variants") or list(VARIANTS)
    results: dict[str, dict] = {}
    with tempfile.TemporaryDirectory() as folder:
        files: dict[str, str] = {}
        for variant in variants:
            if only and variant not in only:
                results |= {variant: before[variant]} if variant in before else {}
                continue
            path = str(Path(folder) / f"{len(files)}.pt")
            found = spawn({"case": case, "variant": variant, "tensors": path})
            first = next(iter(results.values()))["losses"][0] if results else found["losses"][0]
            # From the second step on the plain reference draws other dropout masks.
            found["loss_difference"] = abs(found["losses"][0] - first) / abs(first)
            if variant != "plain":
                files[variant] = path
                found["adapter_difference"] = relative_difference(path, next(iter(files.values())))
            results[variant] = found
            print(f"{name}: {variant}: {json.dumps(found)}", file=sys.stderr, flush=True)
    return results


def table(name: str, results: dict) -> list[str]:
    """Markdown lines of one case."""
    case = CASES[name]
    hold = f", hold {case['hold']}" if "hold" in case else ""
    title = f"### {name}: {case['model']}, {case['px']} px, 8 -> 4, `{case['recipe']}`{hold}"
    if "cpu_s_per_epoch" in results:
        rows = [f"| {sets} | " + " | ".join(map(str, s)) + " |" for sets, s in results["cpu_s_per_epoch"].items()]
        return [title, "", "| CPU s of epoch | 1 | 2 | 3 | 4 |", "|---|---|---|---|---|", *rows, ""]
    columns = (
        *(
            "variant",
            "step, 1st epoch (CPU s)",
            "step, later (CPU s)",
            "1st / teacher forward",
            "later / teacher forward",
        ),
        *("losses / 1st step", "peak above start (MB)", "planned (MB)", "loss differs by", "adapter differs by"),
    )
    lines = [title, "", "| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
    teacher = median([r["teacher_s"] for r in results.values() if "teacher_s" in r])
    for variant, r in results.items():
        own = r.get("teacher_s", teacher)
        cells = [
            variant,
            f"{r['first_step_s']:.2f}",
            f"{r['later_step_s']:.2f}",
            f"{r['first_step_s'] / own:.2f}",
            f"{r['later_step_s'] / own:.2f}",
            f"{100 * r['loss_s'] / r['first_step_s']:.1f} %" if "loss_s" in r else "",
            f"{r['peak_above_start_mb']:.0f}",
            f"{r['planned_mb']:.0f}" if "planned_mb" in r else "",
            f"{r['loss_difference']:.1e}",
            f"{r['adapter_difference']:.1e}" if "adapter_difference" in r else "",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return [*lines, ""]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"of {', '.join(CASES)}; default: all")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--only", nargs="+", default=[], metavar="VARIANT", help="keep the other variants' numbers")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        job = json.loads(options.worker)
        print(json.dumps(curve(job["case"]) if job.get("curve") else work(job)))
        return
    for name in options.cases or CASES:
        path = options.out / f"adaptation-{name}.json"
        before = json.loads(path.read_text(encoding="utf-8"))["results"] if path.is_file() else {}
        command = f"python benchmarks/adaptation.py {name}"
        results = run_case(name, options.only, before)
        write_result(path, settings={**CASES[name], "command": command, "threads": 1}, results=results)
    write_tables(options.out)


def write_tables(folder: Path) -> None:
    """Write adaptation.md from the JSON files that are there."""
    lines = ["# Adaptation steps on the CPU", ""]
    for name in CASES:
        path = folder / f"adaptation-{name}.json"
        if path.is_file():
            record = json.loads(path.read_text(encoding="utf-8"))
            lines += table(name, record["results"])
    about = machine()
    lines += [
        f"One thread of {about['processor']} ({about['cores']} cores). Versions and commands: the JSON files.",
        "",
    ]
    (folder / "adaptation.md").write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    main()
