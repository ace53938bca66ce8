"""Train the embedded model on a GPU within a time limit: `python benchmarks/train_embedded.py OUT`.

One run with compiled blocks, in a process of its own, which cools down by the end of `--seconds`.
If that process dies, another goes on from its last saved state without compiled blocks, and may end before the rate has
fallen to zero. OUT receives the weights, the
restart file for a later run (`--continue-from`), the log and the settings. Only torch, numpy and safetensors are
imported.
"""

import argparse
import json
import logging
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch

from freegeo.training import loop
from freegeo.training.config import TrainConfig
from freegeo.training.state import RESTART_FILE, new_state, read_state

ROOMS_S, SAVING_S = 8.0, 6.0
"""What the first rooms take, and what the files of the end do."""
SAVE_EVERY_S = 45.0
SHORTEST_S = 120.0


def main() -> None:
    """Run the training in a child process, and once more without compilation if that fails."""
    begun = time.monotonic()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--seconds", type=float, default=540.0, help="for everything; default %(default)s")
    parser.add_argument("--eager", action="store_true", help="without compiled blocks")
    parser.add_argument("--views-per-step", type=int, default=TrainConfig.views_per_step)
    parser.add_argument("--continue-from", type=Path, help=f"folder with the {RESTART_FILE} of an earlier run")
    parser.add_argument("--first-room", type=int, default=0)
    parser.add_argument("--peak", type=float, default=1.0)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--run", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--left", type=float, help=argparse.SUPPRESS)
    given = parser.parse_args()
    given.output.mkdir(parents=True, exist_ok=True)
    if given.run:
        leg(given)
        return
    if any(given.output.iterdir()):
        parser.error(f"{given.output} holds files; name a new folder")
    if given.seconds < SHORTEST_S:
        parser.error(f"--seconds {given.seconds:g}: at least {SHORTEST_S:g}, for compilation and the first rooms")
    run = Path(tempfile.mkdtemp()) / "run"
    for compiled in (True, False) if not given.eager else (False,):
        left = given.seconds - (time.monotonic() - begun)
        command = [sys.executable, __file__, *sys.argv[1:], "--run", str(run), "--left", str(left)]
        code = subprocess.run([*command, *["--eager"] * (not compiled and not given.eager)], check=False).returncode
        copy(run, given.output)
        if code == 0:
            break
        print(f"the process with compiled blocks {compiled} ended with {code}", flush=True)
    else:
        sys.exit("no process ended well; what the last one saved is in the output folder")
    print((given.output / loop.LOG).read_text().splitlines()[-1])


def leg(given: argparse.Namespace) -> None:
    """Train in this process until the time is over."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", force=True)
    torch.set_num_threads(8)
    torch.backends.cuda.enable_cudnn_sdp(False)  # it plans anew, for .1 s and more, for every shape of a sample
    loop.SAVE_EVERY_S = SAVE_EVERY_S
    begun = time.monotonic()
    config = TrainConfig(first_room=given.first_room, peak=given.peak, views_per_step=given.views_per_step)
    if not given.eager:
        loop.compile_all(new_state(config, given.device))  # kept by PyTorch, so that the schedule can take what is left
        print(f"compiled after {time.monotonic() - begun:.1f} s", flush=True)
    if (given.run / loop.CONFIG).is_file():
        minutes = json.loads((given.run / loop.CONFIG).read_text())["minutes"]
    else:
        minutes = (given.left - (time.monotonic() - begun) - ROOMS_S - SAVING_S) / 60
    config = replace(config, minutes=minutes)
    if given.continue_from:
        seen = read_state(given.continue_from / RESTART_FILE)["views"]
        config = replace(config, views=config.views + seen, pairs_until=0, short_until=0, small_until=0)
    loop.train(
        config, given.run, device=given.device, compile_blocks=not given.eager, continue_from=given.continue_from,
        minutes=(given.left - SAVING_S - (time.monotonic() - begun)) / 60,
        progress=Copies(config, given.run, given.output),
    )  # fmt: skip


class Copies:
    """Keeps log and weights in OUT, once a minute: what is there if the machine is taken away."""

    def __init__(self, config: TrainConfig, run: Path, output: Path):
        self.config, self.run, self.output, self.at = config, run, output, time.monotonic()

    def __call__(self, state) -> None:
        """Write the weights so far, copy the log, and print its last line."""
        if time.monotonic() - self.at > 60:
            self.at = time.monotonic()
            loop.write_weights(state, self.config, self.output / loop.WEIGHTS)
            if (self.run / loop.LOG).is_file():
                shutil.copy(self.run / loop.LOG, self.output)
                print((self.run / loop.LOG).read_text().splitlines()[-1], flush=True)


def copy(run: Path, output: Path) -> None:
    """Copy what a run leaves and a small disk can hold."""
    for name in (loop.WEIGHTS, RESTART_FILE, loop.LOG, loop.CONFIG):
        if (run / name).is_file():
            shutil.copy(run / name, output)


if __name__ == "__main__":
    main()
