"""Train the next version of the embedded model on a GPU within a time limit: `python benchmarks/train_embedded.py OUT`.

Two short trials say whether compiled blocks are faster (`--trial none`, `eager` or `both`); the rest of `--seconds` is
one run of the preset `v5`, which cools down by then. OUT receives the weights, the restart file for a later run
(`--continue-from`), the log and `speed.json`. Only torch, numpy and safetensors are imported.
"""

import argparse
import json
import logging
import shutil
import tempfile
import time
import traceback
from dataclasses import replace
from pathlib import Path

import torch

from freegeo.training import loop
from freegeo.training.config import PRESETS, TrainConfig
from freegeo.training.state import RESTART_FILE

SAVING_S = 10.0
TRIALS = {"eager": 25.0, "compiled": 75.0}
GAIN = 1.15
"""Compiled blocks must be so much faster, as the run compiles some of them once more."""


def main() -> None:
    """Run the trials and the training."""
    begun = time.monotonic()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--seconds", type=float, default=380.0, help="for everything; default %(default)s")
    parser.add_argument("--trial", choices=("none", "eager", "both"), default="both")
    parser.add_argument("--compile", action="store_true", help="compile without a trial")
    parser.add_argument("--views-per-step", type=int)
    parser.add_argument("--continue-from", type=Path, help=f"folder with the {RESTART_FILE} of an earlier run")
    parser.add_argument("--first-room", type=int, default=0)
    parser.add_argument("--peak", type=float, default=1.0)
    parser.add_argument("--device", default="cuda")
    given = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    torch.set_num_threads(8)
    config = replace(PRESETS["v5"], first_room=given.first_room, peak=given.peak)
    if given.views_per_step:
        config = replace(config, views_per_step=given.views_per_step)
    given.output.mkdir(parents=True, exist_ok=True)
    speeds: dict[str, float] = {}
    for name, seconds in TRIALS.items():
        if given.trial == "both" or given.trial == name:
            speeds[name] = trial(config, seconds, compiled=name == "compiled", device=given.device)
            (given.output / "speed.json").write_text(json.dumps(speeds))
    compiled = given.compile or speeds.get("compiled", 0.0) > GAIN * speeds.get("eager", float("inf"))
    left = given.seconds - SAVING_S - (time.monotonic() - begun)
    print(f"views a second: {speeds}; compiled: {compiled}; {left:.0f} s left for the run", flush=True)
    run = Path(tempfile.mkdtemp()) / "run"
    config = replace(config, minutes=left / 60)
    if given.continue_from:
        seen = int(torch.load(given.continue_from / RESTART_FILE, weights_only=True)["counters"][1])
        config = replace(config, views=config.views + seen, pairs_until=0, short_until=0, small_until=0)
    loop.train(
        config, run, device=given.device, compile_blocks=compiled, continue_from=given.continue_from,
        progress=Copies(config, run, given.output),
    )  # fmt: skip
    copy(run, given.output)
    print((given.output / loop.LOG).read_text().splitlines()[-1])


class Copies:
    """Keeps OUT's log up to date, and its weights every minute: what is there if the run is cut off."""

    def __init__(self, config: TrainConfig, run: Path, output: Path):
        self.config, self.run, self.output, self.at = config, run, output, time.monotonic()

    def __call__(self, state) -> None:
        """Copy once a minute."""
        if time.monotonic() - self.at > 60:
            self.at = time.monotonic()
            loop.write_weights(state, self.config, self.output / loop.WEIGHTS)
            if (self.run / loop.LOG).is_file():
                shutil.copy(self.run / loop.LOG, self.output)


def copy(run: Path, output: Path) -> None:
    """Copy what a run leaves and a small disk can hold."""
    for name in (loop.WEIGHTS, RESTART_FILE, loop.LOG, loop.CONFIG):
        shutil.copy(run / name, output)


def trial(config: TrainConfig, seconds: float, *, compiled: bool, device: str) -> float:
    """Return views a second at full size with all numbers of views; 0 when the trial fails, which is printed."""
    config = replace(
        config, minutes=seconds / 60, pairs_until=0, short_until=0, small_until=0, rooms_at_start=288, render_share=0.02
    )
    every, loop.LOG_EVERY_STEPS = loop.LOG_EVERY_STEPS, 20
    try:
        with tempfile.TemporaryDirectory() as folder:
            run = Path(folder) / "run"
            loop.train(config, run, device=device, compile_blocks=compiled)
            rows = [json.loads(line) for line in (run / loop.LOG).read_text().splitlines()]
    except Exception:
        traceback.print_exc()
        return 0.0
    finally:
        loop.LOG_EVERY_STEPS = every
        torch.compiler.reset()  # the compiled code of this model; the cache on disk stays
        if device == "cuda":
            print(f"peak memory {torch.cuda.max_memory_allocated() / 1e9:.1f} GB", flush=True)
            torch.cuda.empty_cache()
    first, last = rows[len(rows) // 2 - 1], rows[-1]
    print(f"compiled {compiled}: {json.dumps(last)}", flush=True)
    return (last["views"] - first["views"]) / max(last["s"] - first["s"], 1e-3)


if __name__ == "__main__":
    main()
