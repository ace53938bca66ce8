"""Every number of a training run, and its schedule over the number of views learned from."""

from __future__ import annotations

from dataclasses import dataclass

from freegeo.errors import UserError

_SMALLEST = {"views": 1, "peak": 1e-6, "cooldown": 0.0, "rooms": 1, "first_room": 0}
_LARGEST = {"peak": 1.0, "cooldown": 1.0}


@dataclass(frozen=True, kw_only=True)
class LossWeights:
    """Weights of the training objective (docs/embedded-model.md, "Training objective")."""

    depth: float = 2.0
    cell_depth: float = 2.0
    gradient: float = 0.5
    rotation: float = 4.0
    translation: float = 3.5
    absolute: float = 0.5
    field_of_view: float = 1.0
    rays: float = 2.0
    points: float = 2.0
    matching: float = 0.3
    position: float = 2.0
    ray_branch: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Phase:
    """The samples of one part of the curriculum."""

    views: tuple[int, ...]
    """Possible numbers of views in a sample."""
    max_stride: int
    """Largest distance between neighbouring views, in frames."""
    reach: int
    """Largest distance between the first and the last view, in frames; more views than that still follow each other."""
    side: int
    """Longest image side in pixels."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Train the embedded model on generated rooms."""

    views: int = 700_000
    """Views the model learns from, counted with repetition; the last `cooldown` of them lower the learning rate."""
    begin: tuple[int, int] = (0, 0)
    """Steps and views of the run that this one continues; (0, 0): a start from nothing."""
    peak: float = 1.0
    """Factor on all learning rates; a run that continues a cooled one needs about 0.2."""
    seed: int = 0
    side: int = 64
    """Longest image side in pixels."""
    views_per_step: int = 48
    rooms: int = 7_680
    """Rooms in the pool; they are rendered a shard at a time while training goes on."""
    first_room: int = 0
    """Rooms of the training domain to leave out, because an earlier run has learned from them."""
    frames: int = 16
    matrix_lr: float = 4e-3
    """Muon, for the matrices of the blocks and the camera decoder."""
    other_lr: float = 1e-3
    """AdamW, for the backbone's embeddings, norms and biases."""
    head_lr: float = 4e-4
    """AdamW, for the dense head and the last linear layers. Their inputs have a large mean, so that a step moves all
    outputs of a layer together: at 2e-3 rectifiers died within a few hundred steps, and the answers were constant."""
    warmup_views: int = 6_000
    cooldown: float = 0.85
    ema: float = 0.99
    clip: float = 1.0
    pairs_until: int = 25_000
    """Views before windows reach beyond 2 or 3 neighbouring frames."""
    short_until: int = 60_000
    """Views before windows reach 16 views and stride 3."""
    small_until: int = 270_000
    """Views before the images reach their full size; at three quarters of it a view costs 40 % less."""
    reach: int = 10
    """Largest distance between the first and the last view of a sample, in frames, where its views are spread."""
    depth_views: int = 8
    """Views that the dense head learns from in one step, at most one of each sample."""
    ray_branch_every: int = 8
    """Steps between two updates of the ray branch, which learns on detached features."""
    weights: LossWeights = LossWeights()

    def __post_init__(self):
        for name, smallest in _SMALLEST.items():
            value, largest = getattr(self, name), _LARGEST.get(name)
            if value < smallest or (largest is not None and value > largest):
                limits = f"at least {smallest:g}" + (f" and at most {largest:g}" if largest is not None else "")
                raise UserError(f"cannot train with {name.replace('_', '-')} {value}. Give {limits}.")

    def phase(self, seen: int) -> Phase:
        """Return the phase after `seen` views: short windows and small images come first."""
        side = self.side * 3 // 4 if seen < self.small_until else self.side
        if seen < self.pairs_until:
            return Phase(views=(2, 3), max_stride=1, reach=self.reach, side=side)
        if seen < self.short_until:
            return Phase(views=(2, 3, 4), max_stride=2, reach=self.reach, side=side)
        return Phase(views=(2, 4, 4, 4, 6, 8, 8, 8, 12, 16), max_stride=3, reach=self.reach, side=side)

    def rate(self, seen: int) -> float:
        """Return the factor on all learning rates: warm-up, plateau, quadratic cool-down to zero."""
        warm = min(1.0, (seen - self.begin[1]) / self.warmup_views)
        start = self.cooldown_start
        left = 1.0 if seen < start else max(0.0, (self.views - seen) / (self.views - start))
        return self.peak * warm * left**2

    @property
    def cooldown_start(self) -> float:
        """Number of views after which the cool-down begins."""
        return self.begin[1] + (self.views - self.begin[1]) * (1 - self.cooldown)
