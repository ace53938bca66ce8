"""Options that several commands share. Every default of the command line is written here, once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from freegeo.models.catalog import DEFAULT_MODEL, EMBEDDED_MODEL

SMALL_MODEL = 20_000_000
"""Parameters below which a model runs on one CPU thread."""

if TYPE_CHECKING:
    from freegeo.adaptation.recipe import Recipe
    from freegeo.models.api import ModelSpec, ReconstructionModel
    from freegeo.models.precision import Compute


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """Which model runs, and where."""

    model: str = DEFAULT_MODEL
    """Catalog name (`freegeo models`) or a plug-in's."""
    checkpoint: Path | None = None
    """Local weight file or folder, instead of the download."""
    device: str | None = None
    """cpu, cuda, cuda:N or mps; default: the best at hand."""
    precision: Literal["fp32", "bf16", "fp16"] | None = None
    """Arithmetic of the transformer; default: bf16 on CUDA, else fp32."""
    seed: int = 43
    """Seed of everything random."""
    reference: str | None = None
    """Reference view of the frozen model: first, middle, saddle_balanced, saddle_sim_range; default: the model's."""

    def load(self) -> ReconstructionModel:
        """Load the model."""
        from freegeo.models.catalog import load_model

        model = load_model(self.model, checkpoint=self.checkpoint)
        use_few_threads(model)
        return model

    def compute(self) -> Compute:
        """Return where adaptation and reconstruction run, and in which precision."""
        from freegeo.models.precision import Compute

        return Compute.choose(self.device, self.precision)

    def settings(self, model: ReconstructionModel) -> dict[str, object]:
        """Return what the result depends on, for comparison with an existing folder."""
        loaded = getattr(model, "loaded_from", None)
        return {
            "model": self.model,
            "checkpoint": loaded.fingerprint if loaded else None,
            "precision": self.compute().precision,
            "seed": self.seed,
            "reference": self.reference or model.spec.reference,
        }


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class DemoModelOptions(ModelOptions):
    """A class of its own, since the parser takes the defaults of options that are left out from the class."""

    model: str = EMBEDDED_MODEL
    """Catalog name (`freegeo models`) or a plug-in's."""


def use_few_threads(model: ReconstructionModel) -> None:
    """Run small models on one thread: their matrices are too small to share out, and waiting threads cost more."""
    import torch

    if sum(parameter.numel() for parameter in model.parameters()) < SMALL_MODEL:
        torch.set_num_threads(1)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RecipeOptions:
    """How the model is adapted; options left out come from the recipe."""

    recipe: Literal["scene", "paper", "released-da3", "released-vggt"] = "scene"
    """Named settings; the last three also need --dataset."""
    dataset: Literal["eth3d", "7scenes", "scannetpp", "hiroom", "procedural"] | None = None
    """Whose published settings a dataset recipe takes."""
    views: int | None = None
    """Views the teacher sees (8)."""
    keep: str | None = None
    """Positions the student keeps, such as 0,2,4,6 (every second)."""
    steps: int | None = None
    """Optimiser steps."""
    epochs: int | None = None
    """Passes over all view sets, instead of steps."""
    sets: int | None = None
    """View sets per scene."""
    lr: float | None = None
    """Peak learning rate."""
    rank: int | None = None
    """Rank of the adapter."""
    hold: float | None = None
    """Weight of keeping what the model says with all views as it is (0: the paper; 1 where more views get worse)."""

    def build(self, spec: ModelSpec) -> Recipe:
        """Return the recipe for a model."""
        from freegeo.adaptation import recipe as recipes

        named = recipes.named(self.recipe, spec, self.dataset)
        return named.changed(
            views=self.views, keep=parse_keep(self.keep), steps=self.steps, epochs=self.epochs,
            sets_per_scene=self.sets, lr=self.lr, rank=self.rank, hold=self.hold,
        )  # fmt: skip


def parse_keep(text: str | None) -> tuple[int, ...] | None:
    """Read positions such as 0,2,4,6."""
    from freegeo.errors import UserError

    if text is None:
        return None
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise UserError(f"--keep '{text}' is no list of positions. Write it as 0,2,4,6.") from None


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class PhotoOptions:
    """Which photos are used."""

    max_views: int = 32
    """Most photos that are used; of more, as many are chosen evenly."""
    fps: float | None = None
    """Videos: take a frame this often per second; default: by sharpness and parallax."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class OutputOptions:
    """Where results go."""

    output: Annotated[Path, Parameter(name=("--output", "-o"))]
    """Folder for the results."""
    overwrite: bool = False
    """Replace what an earlier run with other options wrote there."""
