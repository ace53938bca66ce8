"""Named settings of an adaptation run: the paper's, the released ones, and ours for one user's photos.

Sources: the method's fact sheet, sections 2 (`paper`, `scene`) and 3 (`released-*`; the per-dataset tables are 3.4).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from freegeo.errors import UserError

if TYPE_CHECKING:
    from freegeo.adaptation.losses import LossConfig
    from freegeo.models.api import ModelSpec

RecipeName = Literal["scene", "paper", "released-da3", "released-vggt"]
DATASETS = ("eth3d", "7scenes", "scannetpp", "hiroom", "procedural")
SMALLEST_SCENE = 3
"""Views below which there is no held-out view to learn from."""


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Everything that decides what an adaptation run computes, except the model, the photos and the seed."""

    name: str
    loss: LossConfig
    views: int
    """Views the teacher sees (N)."""
    keep: tuple[int, ...] | None
    """Positions among the N that the student sees; None: every second one."""
    sets_per_scene: int
    first_seed: int
    """Seed of a scene's first view set; the others count on from it."""
    distinct_seeds: int
    """Number of different seeds; more sets than seeds repeat them."""
    epochs: int | None
    """Passes over all view sets; None where `steps` decides."""
    steps: int | None
    batch: int
    """View sets per optimiser step."""
    drop_last: bool
    """Whether an incomplete last batch of an epoch is left out."""
    redraw: bool
    """Whether every epoch draws new views (and augmentation) for each set."""
    repeat_views: bool
    """Whether a scene with fewer than N frames repeats some; otherwise it uses what it has."""
    neighbours: bool
    """Whether the views of a set are frames in a row, for models that know no others; else random ones."""
    hold: float
    """Weight of staying, with all N views, where the frozen model's features are; 0, as in the paper: no such term."""
    augmentation: Literal["none", "released"]
    """`released`: mirror the set with p = .5, brighten each view with p = .5 by U(.8, 1.2), fixed by the set's seed."""
    squash: int | None
    """Side of a square that the images are squashed to for adaptation; None: the model's own preprocessing."""
    lr: float
    final_lr: float
    warmup: float
    weight_decay: float
    clip: float
    rank: int
    alpha: int
    dropout: float

    def __post_init__(self):
        if self.views < SMALLEST_SCENE:
            raise UserError(f"--views must be at least {SMALLEST_SCENE}, got {self.views}.")
        if self.keep is not None:
            kept = sorted(set(self.keep))
            if len(kept) != len(self.keep) or tuple(kept) != self.keep or kept[0] < 0 or kept[-1] >= self.views:
                raise UserError(f"--keep {self.keep} must ascend within 0..{self.views - 1}.")
            if not 2 <= len(kept) < self.views:
                raise UserError(f"--keep must name at least 2 and fewer than {self.views} of the views.")
        if self.hold < 0:
            raise UserError(f"--hold must be 0 or more, got {self.hold}.")
        for name in ("lr", "rank", "alpha", "batch", "sets_per_scene"):
            if not getattr(self, name) > 0:
                raise UserError(f"recipe setting {name} must be positive, got {getattr(self, name)}.")
        if (self.steps is None) == (self.epochs is None) or (self.steps or self.epochs or 0) < 1:
            raise UserError("a recipe needs either --steps or --epochs, not both, and at least 1.")

    def changed(self, **changes) -> Recipe:
        """Return the recipe with some settings replaced; those given as None stay.

        Setting steps unsets epochs and the reverse; setting the rank sets alpha to it, unless that is given too.
        """
        given = {name: value for name, value in changes.items() if value is not None}
        if ("steps" in given) != ("epochs" in given):
            given["epochs" if "steps" in given else "steps"] = None
        if "rank" in given:
            given.setdefault("alpha", given["rank"])
        return replace(self, **given)


@dataclass(frozen=True, kw_only=True)
class DatasetSettings:
    """One row of a published settings table."""

    sets: int
    seeds: int
    epochs: int
    lr: float
    final_lr: float


PAPER: Mapping[str, DatasetSettings] = {
    "eth3d": DatasetSettings(sets=10, seeds=10, epochs=3, lr=1e-4, final_lr=1e-7),
    "7scenes": DatasetSettings(sets=20, seeds=20, epochs=3, lr=5e-5, final_lr=1e-8),
    "scannetpp": DatasetSettings(sets=10, seeds=10, epochs=3, lr=1e-5, final_lr=1e-8),
    "hiroom": DatasetSettings(sets=5, seeds=5, epochs=5, lr=1e-4, final_lr=1e-7),
}
RELEASED_DA3: Mapping[str, DatasetSettings] = {
    "eth3d": DatasetSettings(sets=5, seeds=5, epochs=3, lr=1e-4, final_lr=1e-7),
    "7scenes": DatasetSettings(sets=10, seeds=10, epochs=3, lr=5e-5, final_lr=1e-8),
    "scannetpp": DatasetSettings(sets=10, seeds=10, epochs=3, lr=1e-5, final_lr=1e-8),
    "hiroom": DatasetSettings(sets=5, seeds=5, epochs=5, lr=1e-4, final_lr=1e-7),
}
RELEASED_VGGT: Mapping[str, DatasetSettings] = {
    "eth3d": DatasetSettings(sets=10, seeds=5, epochs=3, lr=1e-5, final_lr=1e-8),
    "7scenes": DatasetSettings(sets=10, seeds=10, epochs=3, lr=1e-5, final_lr=1e-8),
    "scannetpp": DatasetSettings(sets=10, seeds=10, epochs=3, lr=3e-5, final_lr=1e-8),
    "hiroom": DatasetSettings(sets=5, seeds=5, epochs=3, lr=1e-4, final_lr=1e-8),
}


def named(name: str, spec: ModelSpec, dataset: str | None = None) -> Recipe:
    """Return a recipe by name, for a model and, where the settings depend on it, a dataset.

    UserError for an unknown recipe or dataset, or a dataset recipe without a dataset.
    """
    if name == "scene":
        return scene(spec)
    if name == "paper":
        return paper(spec, dataset)
    if name in ("released-da3", "released-vggt"):
        return released(name, dataset)
    raise UserError(f"unknown recipe '{name}'. Known are scene, paper, released-da3 and released-vggt.")


def scene(spec: ModelSpec) -> Recipe:
    """Return the recipe for one source: 10 view sets, 100 steps of batch 1, the paper's losses."""
    from freegeo.adaptation.losses import paper_loss

    own = spec.adaptation
    return Recipe(
        name="scene", loss=paper_loss(temperature=own.temperature), views=8, keep=None, sets_per_scene=10,
        first_seed=40, distinct_seeds=10, epochs=None, steps=100, batch=1, drop_last=False, redraw=False,
        repeat_views=False, neighbours=own.neighbours, hold=0.0, augmentation="none", squash=None,
        lr=own.scene_lr, final_lr=own.scene_lr / 1000, warmup=0.15, weight_decay=1e-5, clip=1.0,
        rank=own.rank, alpha=own.rank, dropout=0.0,
    )  # fmt: skip


def paper(spec: ModelSpec, dataset: str | None) -> Recipe:
    """Return the paper's settings of a dataset; a model without published settings keeps its own rate and rank."""
    row = _row(PAPER, dataset, "paper", spec)
    own = spec.adaptation
    rank = 32 if own.published else own.rank
    return scene(spec).changed(
        name="paper", sets_per_scene=row.sets, distinct_seeds=row.seeds, epochs=row.epochs, batch=4,
        lr=row.lr, final_lr=row.final_lr, rank=rank, alpha=rank,
    )  # fmt: skip


def released(name: str, dataset: str | None) -> Recipe:
    """Return what the authors' runner of a model family computes, per dataset."""
    from freegeo.adaptation.losses import released_da3_loss, released_vggt_loss

    is_da3 = name == "released-da3"
    row = _row(RELEASED_DA3 if is_da3 else RELEASED_VGGT, dataset, name, None)
    return Recipe(
        name=name, loss=released_da3_loss() if is_da3 else released_vggt_loss(), views=8, keep=None,
        sets_per_scene=row.sets, first_seed=40, distinct_seeds=row.seeds, epochs=row.epochs, steps=None,
        batch=4 if is_da3 else 2, drop_last=True, redraw=not is_da3, repeat_views=True, neighbours=False,
        hold=0.0, augmentation="released",
        squash=518 if is_da3 else None, lr=row.lr, final_lr=row.final_lr, warmup=0.15, weight_decay=1e-5, clip=1.0,
        rank=32, alpha=32, dropout=0.1,
    )  # fmt: skip


def _row(
    table: Mapping[str, DatasetSettings], dataset: str | None, name: str, spec: ModelSpec | None
) -> DatasetSettings:
    if dataset == "procedural" and spec is not None:
        # Generated rooms are no published dataset; 150 steps of batch 4 over 10 to 100 rooms was measured to suffice.
        return DatasetSettings(sets=4, seeds=4, epochs=3, lr=spec.adaptation.scene_lr, final_lr=1e-6)
    if dataset is None or dataset not in table:
        known = ", ".join(table)
        raise UserError(f"recipe '{name}' has settings per dataset: choose --dataset from {known}, or --recipe scene.")
    return table[dataset]
