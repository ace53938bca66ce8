"""Every setting of an adaptation run: the paper's as one literal, and how the other recipes differ from it.

`PAPER` (arXiv 2604.14048, supplement) is the starting point; `scene` is ours for one user's photos, `released-da3` and
`released-vggt` are what the authors' runners compute (docs/method.md, "Released recipes"). Where the paper leaves a
setting open, docs/method.md, "Open points and how we decide them" gives the reason for ours.

This module loads no torch, so that the command line can read names and defaults from it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

from freegeo.errors import UserError

if TYPE_CHECKING:
    from freegeo.models.precision import Precision
    from freegeo.models.spec import ModelSpec

logger = logging.getLogger(__name__)

RecipeName = Literal["scene", "evidence", "paper", "released-da3", "released-vggt"]
DatasetName = Literal["eth3d", "7scenes", "scannetpp", "hiroom", "procedural"]
Guard = Literal["select", "report", "off"]
"""What the matches between the photos decide about an adapter (docs/guard.md)."""
PAPER_SEED = 42
"""Seed of a published run: dataset-wise adaptation and the benchmark."""
SEED = 43
"""Seed of everything else: adaptation to a user's own photos."""
SMALLEST_SCENE = 3
"""Fewest views of a view set: two that the student sees and one held out."""

Selection = Literal["mixed", "topk", "random"]


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """Settings of the loss: everything that distinguishes one published version of it from another.

    Total = intra + sum_i angle_weights[i] * phi_i + weight_pk * kl_pk + weight_pq * kl_pq + weight_kq * kl_kq, where
    p is a reference token, q a query token of another kept view and k an anchor from a held-out view. A term of
    weight 0 is neither computed nor reported. Raises `UserError` for values that no version of the loss can have.
    """

    intra_tokens: Literal["patches", "camera+patches", "all"]
    """Tokens of the intra loss: patches, with the camera token (special token 0), or with every special token."""
    cross_tokens: Literal["patches", "all"]
    """Tokens that references, queries and anchors are drawn from; in `all` special tokens come before patches."""
    weight_huber: float
    weight_cosine: float
    huber_delta: float
    """Where the classical Huber penalty of the intra loss turns from x^2/2 into delta (|x| - delta/2)."""
    angle_weights: tuple[float, float, float]
    """Weights of the angle terms at the reference, at the anchor and at the query."""
    angle_penalty: Literal["l1", "huber"]
    angle_huber_delta: float
    """Delta of the `huber` penalty on a difference of two cosines; not read by `l1`."""
    weight_pk: float
    weight_pq: float
    weight_kq: float
    kq_order: Literal["kq", "qk"]
    """Which of the two tokens is subtracted from the other: softmax((k - q)/tau) or softmax((q - k)/tau)."""
    pairing: Literal["all", "paired"]
    """Pairs of the distance terms: every reference with every query, or the i-th with the i-th query of each row."""
    distance_mode: Literal["kl", "huber"]
    """KL of the softmax distributions, or SmoothL1 between the difference vectors (`paired` only)."""
    distance_beta: float
    """Beta of SmoothL1 in distance mode `huber`; not read by `kl`."""
    outer: Literal["none", "smooth_l1"]
    """What each KL value goes through before the mean; not read by distance mode `huber`."""
    outer_beta: float
    temperature: float
    """tau of softmax((a - b)/tau), in units of the features."""
    num_reference: int
    num_query: int
    queries: Literal["pooled", "per_view"]
    """`num_query` tokens of all remaining kept views together, or the same `num_query` positions in each of them."""
    separate_draws: bool
    """Whether the angle terms and the distance terms draw their own tokens."""
    num_anchors: int
    selection: Selection
    """`mixed`: K//2 most similar, then K - K//2 least similar held-out tokens; `topk`; `random` with replacement."""
    reference_view: int
    """Position of the reference view among the student's views."""

    def __post_init__(self) -> None:
        for name in (
            *("huber_delta", "angle_huber_delta", "distance_beta", "outer_beta", "temperature"),
            *("num_reference", "num_query", "num_anchors"),
        ):
            if not 0 < getattr(self, name) < math.inf:
                raise UserError(f"Loss setting {name} must be positive and finite, not {getattr(self, name)}.")
        for name in ("num_reference", "num_query", "num_anchors", "reference_view"):
            _require_whole(f"Loss setting {name}", getattr(self, name))
        weights = [getattr(self, field.name) for field in fields(self) if field.name.startswith("weight_")]
        if not all(0 <= weight < math.inf for weight in (*weights, *self.angle_weights)):
            raise UserError("Loss weights must be 0 or more and finite.")
        for name, choices in _LOSS_CHOICES.items():
            if getattr(self, name) not in choices:
                raise UserError(f"Loss setting {name} is one of {', '.join(choices)}, not {getattr(self, name)}.")
        if len(self.angle_weights) != 3:
            raise UserError(f"Loss setting angle_weights has 3 numbers, one for each angle, not {self.angle_weights}.")
        if self.distance_mode == "huber" and self.pairing == "all":
            raise UserError("Loss setting distance_mode 'huber' needs pairing 'paired'; change one of the two.")

    @property
    def uses_angles(self) -> bool:
        """Whether any angle term has a weight."""
        return any(self.angle_weights)

    @property
    def uses_distances(self) -> bool:
        """Whether any distance term has a weight."""
        return any((self.weight_pk, self.weight_pq, self.weight_kq))

    def changed(self, changes: Mapping[str, Any]) -> LossConfig:
        """Return the settings with some replaced; UserError for an unknown name."""
        known = [field.name for field in fields(self)]
        for name in changes:
            if name not in known:
                raise UserError(f"There is no loss setting '{name}'; known are {', '.join(known)}.")
        return replace(self, **changes)


_LOSS_CHOICES = {
    name: get_args(kind) for name, kind in get_type_hints(LossConfig).items() if get_origin(kind) is Literal
}


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
    """Whether the views of a set are consecutive frames, for models trained on such views only; else random ones."""
    hold: float
    """Weight of the distance between adapted and frozen features of all N views; 0: no such term, as in the paper."""
    features: float
    """Weight of the losses between the features of student and teacher; 0 in `evidence`, 1 in all others."""
    cameras: float
    """Weight of the distance of the decoded cameras, of the student's and of all N views, from those of the scene's
    `targets`; 0: no such term, as in the paper."""
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
    precision: Precision | None
    """Arithmetic of the adaptation on a CUDA device unless the user asks for another; None: the device's default."""

    def __post_init__(self):
        for name in ("views", "sets_per_scene", "first_seed", "distinct_seeds", "batch", "rank", "alpha"):
            _require_whole(_OPTIONS.get(name, f"recipe setting {name}"), getattr(self, name))
        for name in ("steps", "epochs"):
            if getattr(self, name) is not None:
                _require_whole(_OPTIONS[name], getattr(self, name))
        if self.views < SMALLEST_SCENE:
            raise UserError(f"--views must be at least {SMALLEST_SCENE}, got {self.views}.")
        if self.keep is not None:
            self._check_keep(self.keep)
        if not 0 <= self.hold < math.inf:
            raise UserError(f"--hold must be 0 or more and finite, got {self.hold}.")
        for name in ("features", "cameras"):
            if not 0 <= getattr(self, name) < math.inf:
                raise UserError(f"recipe setting {name} must be 0 or more and finite, got {getattr(self, name)}.")
        if not (self.features or self.cameras):
            raise UserError("a recipe needs a weight of features or of cameras above 0.")
        if self.cameras and self.changes_images:
            raise UserError("recipe setting cameras needs images as the model makes them: no squash, no augmentation.")
        for name in ("lr", "rank", "alpha", "batch", "sets_per_scene", "distinct_seeds", "clip"):
            if not 0 < getattr(self, name) < math.inf:
                option = _OPTIONS.get(name, f"recipe setting {name}")
                raise UserError(f"{option} must be positive and finite, got {getattr(self, name)}.")
        if not 0 <= self.final_lr <= self.lr:
            raise UserError(
                f"recipe setting final_lr must be from 0 to the peak rate {self.lr:g}, got {self.final_lr}."
            )
        for name, end in {"weight_decay": math.inf, "warmup": 1, "dropout": 1}.items():
            if not 0 <= getattr(self, name) < end:
                raise UserError(f"recipe setting {name} must be from 0 to below {end}, got {getattr(self, name)}.")
        if (self.steps is None) == (self.epochs is None) or (self.steps or self.epochs or 0) < 1:
            raise UserError("a recipe needs either --steps or --epochs, not both, and at least 1.")

    @property
    def sees_all(self) -> bool:
        """Whether a term compares what the adapted model says with all N views."""
        return bool(self.hold or self.cameras)

    @property
    def changes_images(self) -> bool:
        """Whether images are mirrored or squashed, which known cameras do not follow."""
        return self.squash is not None or self.augmentation != "none"

    def _check_keep(self, keep: tuple[int, ...]) -> None:
        listed = ",".join(map(str, keep))
        if not all(isinstance(position, int) for position in keep) or list(keep) != sorted(set(keep)):
            raise UserError(f"--keep {listed} must be ascending positions, such as 0,2,4,6.")
        if not 2 <= len(keep) < self.views:
            raise UserError(f"--keep {listed} must name at least 2 and fewer than all {self.views} views.")
        if keep[0] < 0 or keep[-1] >= self.views:
            raise UserError(
                f"--keep {listed}: positions are within 0..{self.views - 1}, as the teacher sees {self.views}."
            )
        if keep[0] != 0:
            raise UserError(f"--keep {listed} must begin with 0: view 0 is the reference of teacher and student.")

    def changed(self, *, loss: Mapping[str, Any] | None = None, **changes) -> Recipe:
        """Return the recipe with some settings replaced; those given as None stay.

        Setting steps unsets epochs and the reverse; setting the rank sets alpha to it, and a rate below the final rate
        lowers that by the same factor as the rate, unless they are given too. `loss`
        names settings of the loss, such as `{"weight_kq": 0.0}`; the others of the loss stay, and what changes nothing
        is said in a warning. UserError for a loss setting that does not exist, and for invalid values.
        """
        given = {name: value for name, value in changes.items() if value is not None}
        if loss:
            given["loss"] = self.loss.changed(loss)
        if ("steps" in given) != ("epochs" in given):
            given["epochs" if "steps" in given else "steps"] = None
        if "rank" in given:
            given.setdefault("alpha", given["rank"])
        if given.get("lr", math.inf) < self.final_lr:
            given.setdefault("final_lr", self.final_lr * given["lr"] / self.lr)
        changed = replace(self, **given)
        idle = sorted(set(loss or ()) - _HELD)
        if idle and not changed.features:
            logger.warning(
                "--loss %s: recipe '%s' compares no features of student and teacher, so this changes nothing.",
                ", ".join(idle), self.name,
            )  # fmt: skip
        return changed


_HELD = {"intra_tokens", "weight_huber", "weight_cosine", "huber_delta"}
"""Settings of the loss that `hold` reads."""
_OPTIONS = {
    "views": "--views", "steps": "--steps", "epochs": "--epochs", "sets_per_scene": "--sets", "lr": "--lr",
    "rank": "--rank",
}  # fmt: skip
"""Options of the command line by the name of the setting, for messages."""


def _require_whole(what: str, value: object) -> None:
    if not isinstance(value, int) or isinstance(value, bool):
        raise UserError(f"{what} must be a whole number (int), got {value!r}.")


def require_seed(seed: int) -> None:
    """Raise UserError for a seed that a generator of random numbers cannot take."""
    _require_whole("--seed", seed)
    if not 0 <= seed < 2**64:
        raise UserError(f"--seed must be from 0 to 2^64 - 1, got {seed}.")


def require_guard(guard: object) -> None:
    """Raise UserError for something that is no `Guard`."""
    if guard not in get_args(Guard):
        raise UserError(f"guard is {', '.join(get_args(Guard))}, not {guard!r}.")


def require_unchanged_images(recipe: Recipe) -> None:
    """Raise UserError for a recipe that cannot be used with known cameras."""
    if recipe.changes_images:
        raise UserError(
            f"recipe '{recipe.name}' mirrors or squashes the images, and known cameras are of the photos as they are. "
            "Choose another --recipe, such as scene, or leave the cameras out."
        )


class DatasetRow(NamedTuple):
    """One row of a published table, in the names of `Recipe`."""

    sets_per_scene: int
    distinct_seeds: int
    epochs: int
    lr: float
    final_lr: float


# What depends on the dataset: view sets per scene, distinct seeds, epochs, rate, final rate. The paper's rows are its
# supplement's table of training settings (the main text says 5 epochs for all). The released rows are what the runners
# compute, which differs in places from what they announce (docs/method.md, "Released recipes").
PAPER_DATASETS: Mapping[str, DatasetRow] = {
    "eth3d": DatasetRow(10, 10, 3, 1e-4, 1e-7),
    "7scenes": DatasetRow(20, 20, 3, 5e-5, 1e-8),
    "scannetpp": DatasetRow(10, 10, 3, 1e-5, 1e-8),
    "hiroom": DatasetRow(5, 5, 5, 1e-4, 1e-7),
}
RELEASED_DA3_DATASETS: Mapping[str, DatasetRow] = {
    "eth3d": DatasetRow(5, 5, 3, 1e-4, 1e-7),
    "7scenes": DatasetRow(10, 10, 3, 5e-5, 1e-8),
    "scannetpp": DatasetRow(10, 10, 3, 1e-5, 1e-8),
    "hiroom": DatasetRow(5, 5, 5, 1e-4, 1e-7),
}
RELEASED_VGGT_DATASETS: Mapping[str, DatasetRow] = {
    "eth3d": DatasetRow(10, 5, 3, 1e-5, 1e-8),
    "7scenes": DatasetRow(10, 10, 3, 1e-5, 1e-8),
    "scannetpp": DatasetRow(10, 10, 3, 3e-5, 1e-8),
    "hiroom": DatasetRow(5, 5, 3, 1e-4, 1e-8),
}

PAPER = Recipe(
    name="paper",
    loss=LossConfig(
        intra_tokens="camera+patches",
        cross_tokens="patches",
        weight_huber=1.0,
        weight_cosine=1.0,
        huber_delta=1.0,  # open; the released value
        angle_weights=(1.0, 1.0, 1.0),
        angle_penalty="l1",
        angle_huber_delta=1.0,
        weight_pk=1.0,
        weight_pq=1.0,
        weight_kq=1.0,
        kq_order="kq",
        pairing="all",
        distance_mode="kl",
        distance_beta=0.5,
        outer="none",
        outer_beta=0.5,
        temperature=10.0,  # open; released: 10 for DA3, 1 for VGGT (`AdaptationDefaults.temperature`)
        num_reference=256,
        num_query=256,
        queries="pooled",
        separate_draws=False,
        num_anchors=4,
        selection="mixed",
        reference_view=0,  # open; as released
    ),
    views=8,
    keep=None,  # (0, 2, 4, 6) of 8; as "every second one" it also applies to scenes of fewer views
    **PAPER_DATASETS["eth3d"]._asdict(),  # `paper` puts in the row of its dataset
    first_seed=40,  # open; as released
    steps=None,
    batch=4,
    drop_last=False,
    redraw=False,
    repeat_views=False,
    neighbours=False,
    hold=0.0,
    features=1.0,
    cameras=0.0,
    augmentation="none",
    squash=None,
    warmup=0.15,
    weight_decay=1e-5,
    clip=1.0,  # open; as released
    rank=32,
    alpha=32,
    dropout=0.0,
    precision="fp16",
)
"""The paper's settings, on ETH3D with DA3; `open` marks what the paper leaves open."""

_RELEASED = PAPER.changed(
    loss={
        "weight_cosine": 2.0, "angle_weights": (2.0, 2.0, 2.0), "weight_kq": 0.0, "kq_order": "qk",
        "pairing": "paired", "outer": "smooth_l1", "queries": "per_view", "separate_draws": True,
    },
    drop_last=True, repeat_views=True, augmentation="released", dropout=0.1,
)  # fmt: skip
RELEASED_DA3 = _RELEASED.changed(name="released-da3", loss={"intra_tokens": "patches"}, squash=518)
"""What the authors' DA3 runner computes: patch tokens only."""
RELEASED_VGGT = _RELEASED.changed(
    name="released-vggt",
    loss={"intra_tokens": "all", "cross_tokens": "all", "angle_penalty": "huber", "temperature": 1.0},
    batch=2, redraw=True,
)  # fmt: skip
"""What the authors' VGGT runner computes: every token, Huber angles."""


def scene(spec: ModelSpec) -> Recipe:
    """Return the recipe for one source: the paper's losses and `hold`, the model's rate, 100 steps of batch 1."""
    own = spec.adaptation
    found = PAPER.changed(
        name="scene", steps=100, batch=1, sets_per_scene=10, distinct_seeds=10, lr=own.scene_lr,
        final_lr=own.scene_lr / 1000, rank=own.rank, neighbours=own.neighbours, hold=1.0,
        loss={"temperature": own.temperature},
    )  # fmt: skip
    return replace(found, precision=None)


def evidence(spec: ModelSpec) -> Recipe:
    """Return the recipe that learns cameras which matches between the photos prove, instead of features."""
    return replace(scene(spec), name="evidence", cameras=1.0, features=0.0)


OWN: Mapping[str, Callable[[ModelSpec], Recipe]] = {"scene": scene, "evidence": evidence}
"""Our recipes for the photos of one place, which have no settings per dataset."""


PUBLISHED: Mapping[str, tuple[Recipe, Mapping[str, DatasetRow], str | None]] = {
    PAPER.name: (PAPER, PAPER_DATASETS, None),
    RELEASED_DA3.name: (RELEASED_DA3, RELEASED_DA3_DATASETS, "da3"),
    RELEASED_VGGT.name: (RELEASED_VGGT, RELEASED_VGGT_DATASETS, "vggt"),
}
"""Recipes with settings per dataset, and the model family that they are for; None: any."""


def named(name: str, spec: ModelSpec, dataset: str | None = None) -> Recipe:
    """Return a recipe by name, for a model and, where the settings depend on it, a dataset.

    `paper` takes the model's temperature, and the rank of one without published settings.

    UserError for an unknown recipe or dataset, a dataset recipe without a dataset, or `scene` with one.
    """
    own = spec.adaptation
    if name in OWN:
        if dataset is not None:
            raise UserError(
                f"recipe '{name}' has no settings per dataset, so --dataset {dataset} would change nothing. Leave it "
                "out, or choose --recipe paper, released-da3 or released-vggt."
            )
        return OWN[name](spec)
    if name not in PUBLISHED:
        *others, last = get_args(RecipeName)
        raise UserError(f"unknown recipe '{name}'. Known are {', '.join(others)} and {last}.")
    recipe, rows, family = PUBLISHED[name]
    if family is not None and own.published not in (None, family):
        logger.warning(
            "recipe '%s' holds the settings of another model family than that of %s; its own are 'released-%s'",
            name, spec.name, own.published,
        )  # fmt: skip
    # Generated rooms are no published dataset; 150 steps of batch 4 over 10 to 100 rooms was measured to suffice.
    rows = {**rows, "procedural": DatasetRow(4, 4, 3, own.scene_lr, 1e-6)}
    if dataset not in rows:
        *known, _ = rows
        raise UserError(
            f"recipe '{name}' has settings per dataset: choose --dataset from {', '.join(known)}, or --recipe scene."
        )
    recipe = recipe.changed(**rows[dataset]._asdict())
    if family is not None:
        return recipe
    return recipe.changed(
        rank=None if own.published else own.rank, neighbours=own.neighbours, loss={"temperature": own.temperature}
    )
