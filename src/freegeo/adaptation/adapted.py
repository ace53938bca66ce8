"""What a run of adaptation returns: the adapter, how it was trained, and whether it may be used."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.adapter_files import save_adapter
from freegeo.adaptation.recipe import Recipe
from freegeo.adaptation.state import remove_state

SAME_LOSS = 1e-4
"""Relative difference up to which two losses of the same view sets and tokens are taken for equal: rounding makes 1e-6
in float32, more in half precision, and a run of three steps at a hundredth of the usual rate changes 1e-3."""


@dataclass
class Adapted:
    """A trained adapter, attached to its model, with the settings and the loss curve of its run.

    `trouble` says whether it may be used.
    """

    adapter: Adapter
    recipe: Recipe
    seed: int
    scenes: tuple[str, ...]
    curve: list[dict[str, float]] = field(default_factory=list)
    """Loss terms of every step."""
    gain: dict[str, float] = field(default_factory=dict)
    """Total loss of the last step's view sets: `frozen` without the adapter, `adapted` with it, equal tokens drawn."""
    earlier: dict[float, dict[str, Tensor]] = field(default_factory=dict)
    """The adapter after the shares of the steps that `adapt` was told to keep, as `Adapter.load` takes it."""
    verdict: Mapping[str, Any] | None = None
    """What the matches between the photos say (`freegeo.evidence.guard.Verdict.as_dict`); None: nobody asked."""
    harm: str | None = None
    """What is so wrong with the predictions that the adapter is not to be used, in one sentence; see `trouble`."""
    seconds: float = 0.0
    """Duration, with that of the earlier parts of a run that was continued."""
    precision: str = "fp32"
    with_cameras: bool = False
    """Whether the model was told known cameras."""
    own_loss: str | None = None
    """Name of the user's own term of the loss."""
    windows: tuple[int | None, ...] = ()
    """Of each scene, how many windows its view sets were drawn from; None: from all its images."""

    def __repr__(self) -> str:
        """Return the recipe, the number of steps, the loss at start and end, the duration, and whether to beware."""
        change = self.loss_change()
        return (
            f"Adapted({self.recipe.name} recipe, {len(self.curve)} steps, loss {change['first']:.4g} -> "
            f"{change['last']:.4g}, {self.seconds:.0f} s{', not to be used: see trouble' if self.trouble else ''})"
        )

    @property
    def trouble(self) -> str | None:
        """Why the adapter should not be used, in one sentence, and what to do; None where it may be (see `trouble`)."""
        broken = [name for name, value in self.adapter.named_parameters().items() if not bool(value.isfinite().all())]
        return trouble(self.gain, broken, self.recipe) or self.harm

    def metadata(self) -> dict[str, Any]:
        """Return the entries of freegeo.json that describe the run."""
        return {
            "recipe": asdict(self.recipe),
            "seed": self.seed,
            "scenes": list(self.scenes),
            "precision": self.precision,
            "with_cameras": self.with_cameras,
            "process_res": self.adapter.process_res,
            "own_loss": self.own_loss,
            "windows": list(self.windows),
            "loss_curve": self.curve,
            # JSON has no infinity.
            "gain": {name: value if math.isfinite(value) else None for name, value in self.gain.items()},
            "trouble": self.trouble,
            "verdict": self.verdict,
            "seconds": round(self.seconds, 2),
        }

    def save(self, folder: Path | str) -> None:
        """Write the adapter, and remove the state of the run from the folder."""
        folder = Path(folder).expanduser()
        save_adapter(self.adapter, folder, self.metadata())
        remove_state(folder)

    def loss_change(self) -> dict[str, float]:
        """Return the mean total loss of the first and of the last tenth of the steps."""
        return loss_change(self.curve)


def loss_change(curve: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the mean total of the first and of the last tenth of a loss curve."""
    totals = [terms["total"] for terms in curve]
    tenth = max(1, len(totals) // 10)
    return {"first": sum(totals[:tenth]) / tenth, "last": sum(totals[-tenth:]) / tenth}


def trouble(gain: Mapping[str, float], broken: Sequence[str], recipe: Recipe) -> str | None:
    """Say in one sentence why a finished adapter should not be used, and what to do; None where it may be.

    The rule compares like with like: the same view sets and tokens, without the adapter and with it, after the last
    update. Why the loss curve cannot decide that: docs/method.md, "Schedule and optimiser".

    Args:
        gain: `Adapted.gain`.
        broken: the adapter's tensors with values that are not finite.
        recipe: of the run.
    """
    lower = f"Lower --lr (now {recipe.lr:g}), take fewer --steps or another --recipe."
    if broken:
        return f"the adapter has values that are not finite ({len(broken)} tensors, first {broken[0]}). {lower}"
    if not all(map(math.isfinite, gain.values())):
        return f"with the adapter the loss is not finite. {lower}"
    losses = (
        f"the loss of the last view sets is {gain['adapted']:.4g} with the adapter and {gain['frozen']:.4g} without"
    )
    if gain["adapted"] > gain["frozen"] * (1 + SAME_LOSS):
        return f"adaptation made the model worse at its own task: {losses}. {lower}"
    if gain["adapted"] >= gain["frozen"] * (1 - SAME_LOSS):
        return f"adaptation gained nothing: {losses}. Raise --lr (now {recipe.lr:g}) or take more --steps."
    return None
