"""The training loop: can be stopped and resumed at any moment."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Iterable
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import nn

from freegeo import __version__
from freegeo.data.procedural import get_domain
from freegeo.errors import FreeGeoError, UserError
from freegeo.files import as_json, read_json, write_json, write_tensors
from freegeo.host import gigabytes, host_available
from freegeo.lock import locked, require_no_link
from freegeo.models.da3 import Backbone
from freegeo.training.batches import Batch, draw_batch
from freegeo.training.config import TrainConfig
from freegeo.training.objective import encode, objective, zero_motion_rotation
from freegeo.training.pool import ASPECTS, Pool
from freegeo.training.report_card import score_rooms
from freegeo.training.state import (
    NEWEST_FILE,
    PLATEAU_FILE,
    PLATEAU_LR,
    RESTART_FILE,
    START_FILE,
    State,
    averaged,
    new_state,
    read_state,
    restart,
    resume,
    save,
    state_of_weights,
    write_state,
)

logger = logging.getLogger(__name__)

CONFIG, LOG, WEIGHTS = "config.json", "log.jsonl", "freegeo-tiny.safetensors"
GROW_EVERY_STEPS = 40
LOG_EVERY_STEPS = 100
LOG_MEMORY = 0.98
SAVE_EVERY_S = 120.0
EVALUATION_ROOMS = 24
BYTES_PER_PIXEL = 5_000
"""Memory of a step on the CPU for every pixel of its views, if these were square (measured with 96 views of 96 pixels).
"""


def train(
    config: TrainConfig,
    folder: Path,
    *,
    minutes: float | None = None,
    device: str = "cpu",
    compile_blocks: bool = False,
    continue_from: Path | None = None,
    progress: Callable[[State], None] = lambda state: None,
) -> Path:
    """Train until the schedule is complete or the time limit of this leg is used up; return the weight file.

    The same call continues a stopped run: on the CPU, with `minutes=0` and `render_share=0` in the settings, it ends
    with the same tensors as a run that was never stopped. Without a schedule in time, larger `views` continue from
    the plateau before the cool-down. Says so when the time of the schedule was over after a small part of its views.

    Args:
        config: settings; when a run is continued, only `views` may grow, and only with `minutes=0`.
        folder: state, log, rendered rooms and weights of the run.
        minutes: time limit of this leg, which leaves the schedule as it is.
        device: where rooms are rendered and the model learns.
        compile_blocks: compile the blocks of the backbone first.
        continue_from: folder of another run, or a weight file, that this run starts from, with settings and rooms of
            its own.
        progress: called after every step.

    Raises:
        UserError: the folder holds a run with other settings, `continue_from` holds none, or the memory of this machine
            is too small for a step on the CPU.
        FreeGeoError: too many losses or gradients are not finite.
    """
    if device == "cpu":
        require_memory(config)
    with locked(folder), one_thread(device):
        config = begin(config, folder, continue_from)
        keep_settings(config, folder)
        state = new_state(config, device)
        resume(state, config, folder)
        seconds_before = state.seconds
        if compile_blocks:
            compile_all(state)
        pool = open_pool(config, state, folder, device)
        trainer = Trainer(state, pool, config, folder)
        begun = time.monotonic()
        deadline = begun + 60 * (minutes if minutes is not None else float("inf"))
        while time.monotonic() < deadline:
            state.seconds = seconds_before + time.monotonic() - begun
            if position(state, config) >= config.views:
                warn_of_few_views(state, config)
                break
            trainer.step()
            trainer.keep_record()
            progress(state)
        trainer.log("end", trainer.read_recent())
        save(state, config, folder / NEWEST_FILE)
        write_state(restart(state), folder / RESTART_FILE)
        return write_weights(state, config, folder / WEIGHTS)


def require_memory(config: TrainConfig) -> None:
    """Raise UserError when a step on the CPU takes more memory than is free; the system would end the process."""
    view, free = BYTES_PER_PIXEL * config.side**2, host_available()
    needed = config.views_per_step * view
    if needed > free:
        raise UserError(
            f"a step of {config.views_per_step} views takes about {gigabytes(needed)} of memory on the CPU, and "
            f"{gigabytes(free)} are free. Give --views-per-step {max(2, free // (2 * view))}, or train on a GPU."
        )


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


def position(state: State, config: TrainConfig) -> float:
    """Return a run's place in its schedule."""
    return config.position(state.seen, state.seconds)


def warn_of_few_views(state: State, config: TrainConfig) -> None:
    """Say that the time of a schedule was over after less than a tenth of its views."""
    learned, planned = state.seen - config.begin[1], config.views - config.begin[1]
    if learned < planned / 10:
        logger.warning(
            "the %g minutes of the schedule were over after %d of %d views, so these weights have learned little. "
            "Train on a GPU, or with a larger --budget in a new folder.",
            round(config.minutes, 2), learned, planned,
        )  # fmt: skip


def compile_all(state: State) -> None:
    """Compile the blocks of the backbone, for images and samples of any size, before the time of a run begins."""
    from torch._dynamo import config as settings

    # All blocks share one piece of code: about seven versions of it, next to the default limit of eight.
    settings.recompile_limit = 32  # ty: ignore[invalid-assignment]
    for block in cast(Backbone, state.model.backbone["pretrained"]).blocks:
        block.compile(dynamic=True)
    device = next(state.model.parameters()).device
    for shape in ((4, 2, 72, 72), (2, 4, 72, 96), (2, 8, 64, 96)):
        samples, views, *size = shape
        with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
            features = encode(state.model, torch.rand(samples, views, 3, *size, device=device), None)
        torch.stack([patches.float().mean() for patches, _ in features.levels.values()]).sum().backward()
    for parameter in state.parameters():
        parameter.grad = None


class Trainer:
    """One leg of a run: takes steps, renders rooms, saves, scores and logs."""

    def __init__(self, state: State, pool: Pool, config: TrainConfig, folder: Path):
        self.state, self.pool, self.config, self.folder = state, pool, config, folder
        self.device = next(state.model.parameters()).device
        self.recent: dict[str, torch.Tensor] = {}
        """Running means on the device; reading them waits for it."""
        self.broken = torch.zeros((), device=self.device)
        """Steps of this leg that were left out because a number was not finite."""
        self.began_at = self.saved_at = time.monotonic()
        self.rendering_s = 0.0
        self.recorded = (state.step, state.seen, position(state, config))

    def step(self) -> None:
        """Draw a batch and update the weights and their average."""
        state, config = self.state, self.config
        index = state.step
        state.step += 1
        if config.render_share:
            self._render_for_a_while()
        else:
            fill(self.pool, config, index)
        place = position(state, config)
        generator = torch.Generator().manual_seed(config.seed * 1_000_003 + index)
        batch = draw_batch(self.pool, config, place, generator, self.device)
        terms = objective(state.model, state.read_outs, batch, config, index, generator)
        loss = torch.stack(list(terms.values())).sum()
        if not config.broken_steps and not torch.isfinite(loss):
            broken = [name for name, value in terms.items() if not torch.isfinite(value)]
            raise FreeGeoError(f"training step {index}: {', '.join(broken)} not finite. Resume with a lower rate.")
        loss.backward()
        self.broken += ~apply_gradients(state, config.rate(place), config)
        self._remember(terms, batch)
        state.seen += batch.views

    def _render_for_a_while(self) -> None:
        """Render a shard when rendering has taken less than its share of this leg's time."""
        now = time.monotonic()
        if self.rendering_s < self.config.render_share * (now - self.began_at):
            # Work that is still queued belongs to the steps before.
            wait_for(self.device)
            start = time.monotonic()
            self.pool.grow()
            wait_for(self.device)
            self.rendering_s += time.monotonic() - start

    def _remember(self, terms: dict[str, torch.Tensor], batch: Batch) -> None:
        values = terms | {"zero_motion": self.config.weights.rotation * zero_motion_rotation(batch)}
        for name, value in values.items():
            value = value.detach().nan_to_num()
            self.recent[name] = value.lerp(self.recent[name], LOG_MEMORY) if name in self.recent else value

    def read_recent(self) -> dict[str, Any]:
        """Return the running means of the losses, the rate, the rooms so far and the steps left out, for the log.

        FreeGeoError when more steps were left out than allowed.
        """
        broken = int(self.broken)
        if broken > self.config.broken_steps:
            raise FreeGeoError(f"{broken} training steps were not finite. Start a new run at a lower rate.")
        means = zip(self.recent, read(self.recent.values()), strict=True)
        return {
            **{name: round(value, 5) for name, value in means},
            "rate": round(self.config.rate(position(self.state, self.config)), 4),
            "rooms": self.pool.rooms,
            "rendering_s": round(self.rendering_s, 1),
            "broken_steps": broken,
        }

    def keep_record(self) -> None:
        """Save, score and log at their intervals."""
        state, (step_before, seen_before, place_before) = self.state, self.recorded
        place = position(state, self.config)
        self.recorded = (state.step, state.seen, place)
        if place_before < self.config.cooldown_start <= place:
            save(state, self.config, self.folder / PLATEAU_FILE)
        if time.monotonic() - self.saved_at > SAVE_EVERY_S:
            save(state, self.config, self.folder / NEWEST_FILE)
            self.saved_at = time.monotonic()
        if state.step // LOG_EVERY_STEPS > step_before // LOG_EVERY_STEPS:
            self.log("step", self.read_recent())
        every = self.config.evaluate_every
        if every and state.seen // every > seen_before // every:
            scores = score_rooms(averaged(state), "val-id", EVALUATION_ROOMS, side=self.config.side)
            self.log("evaluation", {mode: scores.mean(mode) for mode in scores.per_room})

    def log(self, kind: str, values: dict[str, Any]) -> None:
        """Append one line to the run's log."""
        state = self.state
        counters = {"step": state.step, "views": state.seen, "s": round(state.seconds, 1)}
        require_no_link(self.folder / LOG)
        with (self.folder / LOG).open("a", encoding="utf-8") as file:
            file.write(json.dumps({"kind": kind, **counters, **values}) + "\n")


def wait_for(device: torch.device) -> None:
    """Wait until a device has done everything that was asked of it."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def read(values: Iterable[torch.Tensor]) -> list[float]:
    """Read scalars from their device with one copy."""
    values = list(values)
    return torch.stack(values).tolist() if values else []


def apply_gradients(state: State, rate: float, config: TrainConfig) -> torch.Tensor:
    """Clip, step both optimisers, and move the running average; return whether all gradients are finite.

    If they are not, they count as zero: the step goes on with the momentum alone, and no weight is spoilt.
    """
    parameters = [parameter for parameter in state.parameters() if parameter.grad is not None]
    usable = nn.utils.clip_grad_norm_(parameters, config.clip).isfinite()
    # The bits, because 0 times a number that is not finite is not 0; times 1 they stay as they are. A `where` for every
    # gradient would be hundreds of launches.
    bits = [cast(torch.Tensor, parameter.grad).view(torch.int32) for parameter in parameters]
    torch._foreach_mul_(bits, usable.to(torch.int32))
    for optimiser in state.optimisers:
        for group in optimiser.param_groups:
            group["lr"] = group[PLATEAU_LR] * rate
        optimiser.step()
        optimiser.zero_grad(set_to_none=True)
    decay = min(config.ema, (1 + state.step) / (10 + state.step))
    torch._foreach_lerp_(list(state.average.values()), [p.detach() for p in state.model.parameters()], 1 - decay)
    return usable


def keep_settings(config: TrainConfig, folder: Path) -> None:
    """Store the settings, or refuse to go on with other ones; only the views may grow, without a schedule in time."""
    settings = as_json(asdict(config))
    path = folder / CONFIG
    if path.is_file():
        before = read_json(path, dict[str, Any])
        may_grow = not config.minutes and config.views >= before.get("views", config.views)
        names = sorted({*settings, *before} - ({"views"} if may_grow else set()))
        different = [name for name in names if settings.get(name) != before.get(name)]
        if different:
            raise UserError(f"{folder}: holds a training run with another {', '.join(different)}. Choose a new folder.")
    write_json(path, settings)


def begin(config: TrainConfig, folder: Path, continue_from: Path | None) -> TrainConfig:
    """Copy the state of the run to continue, once, and return the settings with that run's steps and views."""
    start = folder / START_FILE
    if start.is_file():
        before = read_state(start)
    elif continue_from is None:
        return config
    elif (folder / CONFIG).is_file():
        raise UserError(f"{folder}: holds a run that continues no other. Choose a new folder.")
    else:
        before = state_to_continue(continue_from, config)
    if config.views <= before["views"]:
        raise UserError(f"{folder}: the run to continue has seen {before['views']} views. Ask for more than that.")
    if not start.is_file():
        write_state(before, start)
    return replace(config, begin=(before["step"], before["views"]))


def state_to_continue(continue_from: Path, config: TrainConfig) -> dict[str, Any]:
    """Return the newest state in the folder of a run, or one that starts with a weight file."""
    if continue_from.suffix == ".safetensors":
        return state_of_weights(continue_from, config)
    for name in (NEWEST_FILE, RESTART_FILE):
        if (continue_from / name).is_file():
            return read_state(continue_from / name)
    raise UserError(
        f"{continue_from / NEWEST_FILE}: not found, so there is no run to continue. Name the folder of a training run, "
        "or a weight file that ends in .safetensors."
    )


def fill(pool: Pool, config: TrainConfig, step: int) -> None:
    """Load the shards that a step draws from, one of each aspect at least; missing ones are rendered."""
    wanted = max(len(ASPECTS), -(-config.rooms_at_start // pool.rooms_per_shard))
    if not config.render_share:
        wanted += -(-(step - config.begin[0]) // GROW_EVERY_STEPS)
    while pool.shards < wanted and pool.grow():
        pass


def open_pool(config: TrainConfig, state: State, folder: Path, device: str) -> Pool:
    """Open the run's rooms with as many as the next step draws from."""
    patch = state.model.config.patch_size
    pool = Pool(
        folder / "rooms", rooms=config.rooms, rooms_per_shard=config.rooms_per_shard, frames=config.frames,
        side=config.side, patch=patch, first_room=config.first_room, device=device,
        domain=replace(get_domain("train"), field_of_view_deg=config.field_of_view_deg),
    )  # fmt: skip
    begun = time.monotonic()
    fill(pool, config, state.step)
    wait_for(torch.device(device))
    logger.info("%d rooms of %d frames ready after %.1f s", pool.rooms, config.frames, time.monotonic() - begun)
    return pool


def write_weights(state: State, config: TrainConfig, path: Path) -> Path:
    """Write the averaged weights in half precision, under the official DA3 names, with metadata of the run."""
    tensors = {f"model.{name}": value.half().cpu() for name, value in state.average.items()}
    metadata = {
        "freegeo": __version__,
        "views": str(state.seen),
        "step": str(state.step),
        "seconds": str(round(state.seconds)),
        "config": json.dumps(asdict(config)),
    }
    write_tensors(path, tensors, metadata)
    return path
