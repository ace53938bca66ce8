"""The training loop: can be stopped and resumed at any moment, with one or several processes."""

from __future__ import annotations

import json
import logging
import math
import shutil
import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

from freegeo import __version__
from freegeo.errors import FreeGeoError, UserError
from freegeo.files import as_json, atomic_path, read_json, write_json, write_tensors
from freegeo.run_folder import locked
from freegeo.training.batches import Batch, draw_batch
from freegeo.training.config import TrainConfig
from freegeo.training.objective import objective, zero_motion_rotation
from freegeo.training.pool import ASPECTS, Pool
from freegeo.training.report_card import score_rooms
from freegeo.training.state import (
    NEWEST_FILE,
    PLATEAU_FILE,
    PLATEAU_LR,
    START_FILE,
    State,
    averaged,
    new_state,
    resume,
    save,
)
from freegeo.training.workers import Crew

logger = logging.getLogger(__name__)

CONFIG, LOG, WEIGHTS = "config.json", "log.jsonl", "freegeo-tiny.safetensors"
GROW_EVERY_STEPS = 40
LOG_EVERY_STEPS = 100
LOG_MEMORY = 0.98
SAVE_EVERY_S = 120.0
EVALUATE_EVERY_VIEWS = 25_000
EVALUATION_ROOMS = 24


def train(
    config: TrainConfig,
    folder: Path,
    *,
    minutes: float | None = None,
    workers: int = 1,
    device: str = "cpu",
    continue_from: Path | None = None,
    progress: Callable[[State], None] = lambda state: None,
) -> Path:
    """Train until the view budget or the time limit of this leg is used up; return the weight file.

    The same call continues a stopped run: with one worker it ends with the same tensors as a run that was never
    stopped. A larger `views` continues from the plateau before the cool-down. `workers` processes of one thread each
    change the shared weights without locks; on another device than the CPU there is one. `continue_from` is the folder
    of another run, whose state this one starts from, with settings and rooms of its own. UserError when the folder
    holds a run with other settings or `continue_from` holds none; FreeGeoError when a loss is not finite or a worker
    dies.
    """
    if workers < 1 or (workers > 1 and device != "cpu"):
        raise UserError(f"cannot train with {workers} workers on {device}. Use one, or several on the cpu.")
    with locked(folder), one_thread(device):
        config = begin(config, folder, continue_from)
        keep_settings(config, folder)
        state = new_state(config, device)
        resume(state, config, folder)
        pool = open_pool(config, state, folder, device)
        with Crew(state, config, folder, workers - 1) as crew:
            trainer = Trainer(state, pool, config, folder, crew.lock)
            deadline = time.monotonic() + 60 * (minutes if minutes is not None else float("inf"))
            while state.seen < config.views and time.monotonic() < deadline:
                crew.check()
                trainer.step()
                trainer.keep_record()
                progress(state)
        save(state, config, folder / NEWEST_FILE)
        return write_weights(state, config, folder / WEIGHTS)


@contextmanager
def one_thread(device: str):
    """Compute with one thread on the CPU: several become slow when other programs share the cores."""
    before = torch.get_num_threads()
    if device == "cpu":
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class Trainer:
    """The part of one process in a run; the first process also renders, saves, scores and logs."""

    def __init__(self, state: State, pool: Pool, config: TrainConfig, folder: Path, lock):
        self.state, self.pool, self.config, self.folder, self.lock = state, pool, config, folder, lock
        self.device = next(state.model.parameters()).device
        self.recent: dict[str, float] = {}
        self.saved_at = time.monotonic()
        self.recorded = (state.step, state.seen)

    def step(self, *, render_new: bool = True) -> None:
        """Draw a batch and update the weights and their average."""
        state, config, cpu_before = self.state, self.config, time.process_time()
        with self.lock:
            index, seen = state.step, state.seen
            state.counters[0] += 1
        fill(self.pool, index - config.begin[0], render_new=render_new)
        generator = torch.Generator().manual_seed(config.seed * 1_000_003 + index)
        batch = draw_batch(self.pool, config, seen, generator, self.device)
        terms = objective(state.model, state.read_outs, batch, config, index, generator)
        losses = torch.stack(list(terms.values()))
        losses.sum().backward()
        # One transfer a step: every further one would let an accelerator run dry.
        values = dict(zip(terms, losses.tolist(), strict=True))
        broken = [name for name, value in values.items() if not math.isfinite(value)]
        if broken:
            raise FreeGeoError(f"training step {index}: {', '.join(broken)} not finite. Resume with a lower rate.")
        apply_gradients(state, config)
        self._remember(values, batch)
        with self.lock:
            state.counters[1] += batch.views
            state.counters[2] += time.process_time() - cpu_before

    def _remember(self, values: dict[str, float], batch: Batch) -> None:
        still = self.config.weights.rotation * float(zero_motion_rotation(batch))
        for name, value in {**values, "zero_motion": still}.items():
            self.recent[name] = LOG_MEMORY * self.recent.get(name, value) + (1 - LOG_MEMORY) * value

    def keep_record(self) -> None:
        """Save, score and log at their intervals."""
        state, (step_before, seen_before) = self.state, self.recorded
        self.recorded = (state.step, state.seen)
        if seen_before < self.config.cooldown_start <= state.seen:
            save(state, self.config, self.folder / PLATEAU_FILE)
        if time.monotonic() - self.saved_at > SAVE_EVERY_S:
            save(state, self.config, self.folder / NEWEST_FILE)
            self.saved_at = time.monotonic()
        if state.step // LOG_EVERY_STEPS > step_before // LOG_EVERY_STEPS:
            self.log("step", {name: round(value, 5) for name, value in self.recent.items()})
        if state.seen // EVALUATE_EVERY_VIEWS > seen_before // EVALUATE_EVERY_VIEWS:
            scores = score_rooms(averaged(state), "val-id", EVALUATION_ROOMS, side=self.config.side)
            self.log("evaluation", {mode: scores.mean(mode) for mode in scores.per_room})

    def log(self, kind: str, values: dict[str, Any]) -> None:
        """Append one line to the run's log."""
        state = self.state
        counters = {"step": state.step, "views": state.seen, "cpu_s": round(state.cpu_seconds, 1)}
        with (self.folder / LOG).open("a", encoding="utf-8") as file:
            file.write(json.dumps({"kind": kind, **counters, **values}) + "\n")


def apply_gradients(state: State, config: TrainConfig) -> None:
    """Clip, step both optimisers at the current rate, and move the running average."""
    nn.utils.clip_grad_norm_(state.parameters(), config.clip)
    rate = config.rate(state.seen)
    for optimiser in state.optimisers:
        for group in optimiser.param_groups:
            group["lr"] = group[PLATEAU_LR] * rate
        optimiser.step()
        optimiser.zero_grad(set_to_none=True)
    decay = min(config.ema, (1 + state.step) / (10 + state.step))
    torch._foreach_lerp_(list(state.average.values()), [p.detach() for p in state.model.parameters()], 1 - decay)


def keep_settings(config: TrainConfig, folder: Path) -> None:
    """Store the settings, or refuse to go on with other ones; only the view budget may change."""
    settings, defaults = (as_json(asdict(each)) for each in (config, TrainConfig()))
    path = folder / CONFIG
    if path.is_file():
        before = defaults | read_json(path)  # an older run may lack a newer setting
        different = [name for name in settings if name != "views" and before[name] != settings[name]]
        if different:
            raise UserError(f"{folder}: holds a training run with another {', '.join(different)}. Choose a new folder.")
    write_json(path, settings)


def begin(config: TrainConfig, folder: Path, continue_from: Path | None) -> TrainConfig:
    """Copy the state of the run to continue, once, and return the settings with that run's steps and views."""
    start = folder / START_FILE
    if continue_from is not None and not start.is_file():
        if (folder / CONFIG).is_file():
            raise UserError(f"{folder}: holds a run that continues no other. Choose a new folder.")
        source = continue_from / NEWEST_FILE
        if not source.is_file():
            raise UserError(f"{source}: not found, so there is no run to continue. Name the folder of a training run.")
        with atomic_path(start) as part:
            shutil.copyfile(source, part)
    if not start.is_file():
        return config
    steps, views, _ = torch.load(start, weights_only=True, map_location="cpu", mmap=True)["counters"].tolist()
    if config.views <= views:
        raise UserError(f"{folder}: the run to continue has seen {views:.0f} views. Ask for more than that.")
    return replace(config, begin=(int(steps), int(views)))


def shards_at(step: int) -> int:
    """Return how many shards of rooms a run's step draws from: one of each aspect at first, then more and more."""
    return len(ASPECTS) + -(-step // GROW_EVERY_STEPS)


def fill(pool: Pool, step: int, *, render_new: bool) -> None:
    """Load the shards that a run's step draws from; `render_new`: render missing ones."""
    while len(pool.shards) < shards_at(step) and pool.grow(render_new=render_new):
        pass


def open_pool(config: TrainConfig, state: State, folder: Path, device: str) -> Pool:
    """Open the run's rooms with as many as the next step draws from, so that other processes find them."""
    patch = state.model.config.patch_size
    pool = Pool(
        folder / "rooms", rooms=config.rooms, frames=config.frames, side=config.side, patch=patch,
        first_room=config.first_room, device=device,
    )  # fmt: skip
    fill(pool, state.step - config.begin[0], render_new=True)
    return pool


def write_weights(state: State, config: TrainConfig, path: Path) -> Path:
    """Write the averaged weights in half precision, under the official DA3 names, with metadata of the run."""
    tensors = {f"model.{name}": value.half().cpu() for name, value in state.average.items()}
    metadata = {
        "freegeo": __version__,
        "views": str(state.seen),
        "step": str(state.step),
        "cpu_seconds": str(round(state.cpu_seconds)),
        "config": json.dumps(asdict(config)),
    }
    write_tensors(path, tensors, metadata)
    return path
