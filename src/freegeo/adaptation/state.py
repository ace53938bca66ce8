"""The state of an unfinished run on disk: trained parameters, the optimiser's moments, and JSON-like facts."""

from __future__ import annotations

import json
import signal
import threading
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, TypedDict

import torch
from msgspec import Meta

from freegeo.adaptation.adapter import Adapter
from freegeo.errors import DamagedError, UserError
from freegeo.files import json_of, read_tensors, remove_file, write_tensors


class About(TypedDict):
    """The facts beside the tensors."""

    identity: str
    next_step: Annotated[int, Meta(ge=1)]
    curve: list[dict[str, float]]
    seconds: float
    scaler: dict[str, float]


UNFINISHED_FILE = "adapting.safetensors"
_EARLIER = "earlier|"


def write_state(
    folder: Path,
    adapter: Adapter,
    optimiser: torch.optim.Optimizer,
    about: Mapping[str, Any],
    *,
    earlier: Mapping[float, Mapping[str, torch.Tensor]],
) -> None:
    """Write the state into a folder, with states of the adapter after shares of the steps; replaced atomically."""
    tensors = {f"{_EARLIER}{share}|{name}": value for share, state in earlier.items() for name, value in state.items()}
    for name, parameter in adapter.named_parameters().items():
        tensors[name] = parameter
        for key, value in optimiser.state[parameter].items():
            tensors[f"{name}|{key}"] = value
    write_tensors(folder / UNFINISHED_FILE, tensors, {"run": json.dumps(about)})


def read_state(
    folder: Path, adapter: Adapter, optimiser: torch.optim.Optimizer, identity: str
) -> dict[str, Any] | None:
    """Load a saved state into the adapter and its optimiser and return the facts, among them the `earlier` states.

    None when there is no file.

    UserError for a damaged file, and for the state of another run: one whose facts have another `identity`.
    """
    path = folder / UNFINISHED_FILE
    if not path.is_file():
        return None
    try:
        tensors, metadata = read_tensors(path)
        about = json_of(metadata.get("run", "{}"), path, About)
    except DamagedError as error:
        raise _damaged(path, error.reason) from None
    if about["identity"] != identity:
        raise UserError(f"{path}: this state belongs to another run. Remove it, or choose another output folder.")
    named = adapter.named_parameters()
    wrong = _misfit(named, tensors)
    if wrong is not None:
        raise _damaged(path, wrong)
    adapter.load({name: tensors[name] for name in named})
    for name, parameter in named.items():
        # The fused optimiser needs its state, the step counter included, on the parameter's device.
        optimiser.state[parameter] = {
            key.partition("|")[2]: value.to(parameter.device)
            for key, value in tensors.items()
            if key.startswith(f"{name}|")
        }
    about["earlier"] = {}
    for key, value in tensors.items():
        if key.startswith(_EARLIER):
            share, _, name = key.removeprefix(_EARLIER).partition("|")
            about["earlier"].setdefault(float(share), {})[name] = value
    return about


def _misfit(named: Mapping[str, torch.Tensor], tensors: Mapping[str, torch.Tensor]) -> str | None:
    """Name the first tensor that is missing, or not one of the adapter or its optimiser; None where all fit."""
    shares = {key.removeprefix(_EARLIER).partition("|")[0] for key in tensors if key.startswith(_EARLIER)}
    wanted = [*named, *(f"{_EARLIER}{share}|{name}" for share in shares for name in named)]
    moments = {key.partition("|")[2] for key in tensors if key.partition("|")[0] in named} - {""}
    wanted += [f"{name}|{key}" for name in named for key in sorted(moments) if _has_moments(name, tensors)]
    for name in wanted:
        if name not in tensors:
            return f"{name} is missing"
    for key, value in tensors.items():
        first, _, rest = key.partition("|")
        if first == "earlier":
            share, _, name = rest.partition("|")
            known = name in named and _is_share(share)
        else:
            name, known = first, first in named
        # Counts of steps are single numbers.
        if not known or not (value.ndim == 0 or value.shape == named[name].shape):
            return f"{key} is not expected, or of another shape"
        if not value.is_floating_point() or not value.isfinite().all():
            return f"{key} holds values that are not finite numbers"
    return None


def _has_moments(name: str, tensors: Mapping[str, torch.Tensor]) -> bool:
    return any(key.startswith(f"{name}|") for key in tensors)


def _is_share(text: str) -> bool:
    try:
        return 0 < float(text) <= 1
    except ValueError:
        return False


def _damaged(path: Path, reason: str) -> UserError:
    return UserError(f"{path}: damaged state of an unfinished run ({reason}). Remove it to start again.")


def remove_state(folder: Path) -> None:
    """Remove the state of a run that is finished."""
    remove_file(folder / UNFINISHED_FILE)


@contextmanager
def undisturbed() -> Generator[None]:
    """Let Ctrl-C (and SIGTERM, where the program handles it) wait until the block has ended.

    An optimiser step inside is taken wholly or not at all, so the state after it can be saved at any time.
    """
    if threading.current_thread() is not threading.main_thread():  # Signals reach the main thread only.
        yield
        return
    waiting: list[Any] = []
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    handlers = {number: handler for number, handler in handlers.items() if callable(handler)}
    for number in handlers:
        signal.signal(number, lambda *arguments: waiting.append(arguments))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number, frame in waiting:
            handlers[number](number, frame)
