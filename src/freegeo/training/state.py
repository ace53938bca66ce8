"""State of a training run: weights, their average, optimisers, counters; and its files."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from safetensors import safe_open
from torch import Tensor, nn

from freegeo.errors import UserError
from freegeo.files import atomic_path
from freegeo.models.catalog import EMBEDDED_MODEL
from freegeo.models.checkpoints import build_on_meta, find_file, load_weights, read_pickle
from freegeo.models.da3 import DA3, Backbone
from freegeo.models.da3_config import EMBEDDED, KEYS, build, embedded_spec
from freegeo.models.transformer import Block, initialise
from freegeo.training.config import TrainConfig
from freegeo.training.muon import Muon
from freegeo.training.objective import ReadOuts

logger = logging.getLogger(__name__)

NEWEST_FILE, PLATEAU_FILE, START_FILE, RESTART_FILE = "state.pt", "plateau.pt", "start.pt", "restart.pt"
"""Newest state; state before the cool-down; state of the run that this one continues; the newest weights alone in half
precision, for a run that continues this one on another machine."""
FIRST_FOV_RAD = 1.0
MUON_PARTS = ("backbone.pretrained.blocks.", "cam_dec.backbone.")
PLATEAU_LR = "plateau_lr"
"""Key of a parameter group's learning rate before the schedule's factor."""


@dataclass
class State:
    """Everything that changes during training."""

    model: DA3
    read_outs: ReadOuts
    average: dict[str, Tensor]
    optimisers: tuple[Muon, torch.optim.AdamW]
    step: int = 0
    """Steps begun."""
    seen: int = 0
    """Views learned from."""
    seconds: float = 0.0
    """Time that the run has taken, all legs together."""

    @property
    def counters(self) -> dict[str, float]:
        """Steps begun, views learned from and the time taken, as the files name them."""
        return {"step": self.step, "views": self.seen, "seconds": self.seconds}

    def parameters(self) -> list[nn.Parameter]:
        """Return all parameters that learn."""
        return [*self.model.parameters(), *self.read_outs.parameters()]

    def tensors(self) -> dict[str, Any]:
        """Return the state as plain tensors and numbers."""
        return {
            "model": self.model.state_dict(),
            "read_outs": self.read_outs.state_dict(),
            "average": self.average,
            "optimisers": [optimiser.state_dict() for optimiser in self.optimisers],
            **self.counters,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Load the values that `tensors` returned; without an average and optimisers these start anew."""
        self.model.load_state_dict(saved["model"])
        self.read_outs.load_state_dict(saved["read_outs"])
        for name, value in saved.get("average", dict(self.model.named_parameters())).items():
            self.average[name].copy_(value.detach())
        if "optimisers" in saved:
            for optimiser, values in zip(self.optimisers, saved["optimisers"], strict=True):
                optimiser.load_state_dict(values)
        self.step, self.seen, self.seconds = saved["step"], saved["views"], saved["seconds"]


def new_state(config: TrainConfig, device: torch.device | str = "cpu") -> State:
    """Build model, training-only read-outs and optimisers from the seed."""
    generator = torch.Generator().manual_seed(config.seed)
    model = build_on_meta(partial(build, EMBEDDED, embedded_spec())).to_empty(device="cpu")
    reset_norms(model)
    initialise(model, generator)
    seek_alike(model)
    start_camera_decoder(model)
    read_outs = ReadOuts(model.config.channels)
    initialise(read_outs, generator)
    model, read_outs = model.to(device), read_outs.to(device)
    average = {name: value.detach().clone() for name, value in model.named_parameters()}
    optimisers = build_optimisers(model, read_outs, config)
    return State(model, read_outs, average, optimisers)


def reset_norms(model: nn.Module) -> None:
    """Give norms and layer scales their neutral values."""
    for name, parameter in model.named_parameters():
        if parameter.ndim == 1:
            nn.init.constant_(parameter, 0.0 if name.endswith("bias") else 1.0)


@torch.no_grad()
def seek_alike(model: DA3) -> None:
    """Start the global blocks with equal queries and keys: a token first attends to tokens like itself."""
    backbone = cast(Backbone, model.backbone["pretrained"])
    for index, block in enumerate(backbone.blocks):
        if backbone.is_global(index):
            query, key, _ = cast(Block, block).attn.qkv.weight.chunk(3)
            key.copy_(query)


@torch.no_grad()
def start_camera_decoder(model: DA3) -> None:
    """Initialise the camera decoder so that it predicts no motion and a common field of view.

    Its last layers start at zero: the field of view ends in a rectifier, which a random start can switch off for good.
    """
    for layer in (model.cam_dec.fc_t, model.cam_dec.fc_qvec, cast(nn.Linear, model.cam_dec.fc_fov[0])):
        nn.init.zeros_(layer.weight)
    cast(nn.Linear, model.cam_dec.fc_fov[0]).bias.fill_(FIRST_FOV_RAD)
    model.cam_dec.fc_qvec.bias.copy_(torch.tensor([0.0, 0.0, 0.0, 1.0]))


def build_optimisers(model: DA3, read_outs: ReadOuts, config: TrainConfig) -> tuple[Muon, torch.optim.AdamW]:
    """Split the parameters: inner matrices to Muon, everything else to AdamW; their state is allocated here."""
    matrices, others, top = [], [], list(read_outs.parameters())
    for name, parameter in model.named_parameters():
        if parameter.ndim == 2 and name.startswith(MUON_PARTS):
            matrices.append(parameter)
        else:
            (top if name.startswith(("cam_dec.", "head.")) else others).append(parameter)
    groups = [{"params": others, "lr": config.other_lr}, {"params": top, "lr": config.head_lr}]
    adamw = torch.optim.AdamW(groups, weight_decay=0.01, fused=True)
    for parameter in (*others, *top):
        adamw.state[parameter] = {
            "step": torch.zeros((), device=parameter.device),
            "exp_avg": torch.zeros_like(parameter),
            "exp_avg_sq": torch.zeros_like(parameter),
        }
    muon = Muon(matrices, lr=config.matrix_lr)
    for group in (*muon.param_groups, *adamw.param_groups):
        group[PLATEAU_LR] = group["lr"]
    return muon, adamw


def averaged(state: State) -> DA3:
    """Return a model of its own with the averaged weights, on the CPU."""
    model = build_on_meta(partial(build, state.model.config, state.model.spec))
    aliases = {alias: state.average[stored] for alias, stored in KEYS.aliases.items()}
    weights = state.model.state_dict() | state.average | aliases
    model.load_state_dict({name: value.cpu().clone() for name, value in weights.items()}, assign=True)
    return model.requires_grad_(False).eval()


def resume(state: State, config: TrainConfig, folder: Path) -> None:
    """Continue from the newest state that fits the view budget."""
    for name in (NEWEST_FILE, PLATEAU_FILE, START_FILE):
        path = folder / name
        if not path.is_file():
            continue
        saved = read_state(path, next(state.model.parameters()).device)
        if name == NEWEST_FILE:
            cooling = config.position(saved["views"], saved["seconds"]) > saved["cooldown_start"]
            if cooling and saved["cooldown_start"] < config.cooldown_start:
                continue
        state.restore(saved)
        if name == START_FILE:
            state.seconds = 0.0
        logger.info("resumed %s at %d views", path, state.seen)
        return


def read_state(path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Return what a file of a run holds, on a device; UserError when it is damaged, or an earlier version wrote it."""
    saved = read_pickle(path, device)
    if "step" not in saved:
        raise UserError(f"{path}: an earlier version of freegeo wrote this state. Start a new run in another folder.")
    return saved


def save(state: State, config: TrainConfig, path: Path) -> None:
    """Write the whole state atomically."""
    write_state({**state.tensors(), "cooldown_start": config.cooldown_start}, path)


def write_state(values: dict[str, Any], path: Path) -> None:
    """Write atomically what `read_state` reads."""
    with atomic_path(path) as part:
        torch.save(values, part)


def state_of_weights(weights: Path, config: TrainConfig) -> dict[str, Any]:
    """Return the state of a run that starts with a weight file, after the steps and views that the file names.

    The maps that are only there for training start anew: a weight file has none.
    """
    state = new_state(config)
    load_weights(state.model, find_file(weights), KEYS, EMBEDDED_MODEL)
    with safe_open(weights, "pt") as file:
        metadata = file.metadata() or {}
    state.step, state.seen = (int(metadata.get(name, 0)) for name in ("step", "views"))
    return restart(state)


def restart(state: State) -> dict[str, Any]:
    """Return the weights without average and optimisers in half precision, about a tenth of the whole state."""
    parts = {"model": state.model.state_dict(), "read_outs": state.read_outs.state_dict()}
    halves = {part: {name: value.half().cpu() for name, value in values.items()} for part, values in parts.items()}
    return {**halves, **state.counters}
