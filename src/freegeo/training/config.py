"""Every number of a training run, and its schedule over the views learned from or the time."""

from __future__ import annotations

from dataclasses import dataclass

from freegeo.errors import UserError

_SMALLEST = {
    "views": 1,
    "views_per_step": 2,
    "peak": 1e-6,
    "cooldown": 0.0,
    "rooms": 1,
    "first_room": 0,
    "minutes": 0.0,
}
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
    field_of_view: float = 3.0
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
    any_reference: float = 0.0
    """Share of the samples whose reference is any of its views instead of one end of the walk."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Train the embedded model on generated rooms; the defaults are the recipe of the shipped weights, for one GPU.

    With `minutes=0` and `render_share=0` a run on the CPU repeats itself to the bit, however often it is stopped.
    """

    minutes: float = 8.0
    """Time that the run's schedule fits in, all legs together: it goes with the time where that is further on than the
    views are. 0: no limit."""
    views: int = 9_000_000
    """Views the model learns from at most, counted with repetition; an H200 learned from 3.6 million in 8 minutes."""
    begin: tuple[int, int] = (0, 0)
    """Steps and views of the run that this one continues; (0, 0): a start from nothing."""
    peak: float = 1.0
    """Factor on all learning rates; a run that continues a cooled one needs about 0.2."""
    seed: int = 0
    side: int = 96
    """Longest image side in pixels."""
    views_per_step: int = 1_024
    """Views of all samples of a step; with fewer, the processor that launches a GPU's work is the limit."""
    rooms: int = 36_000
    """Rooms in the pool; they are rendered a shard at a time while training goes on."""
    rooms_per_shard: int = 96
    rooms_at_start: int = 1_152
    """Rooms to render before the first step."""
    render_share: float = 0.15
    """Share of the time in which new rooms are rendered. 0: a shard every 40 steps, which can be repeated exactly."""
    field_of_view_deg: tuple[float, float] = (54.0, 76.0)
    """Horizontal, one value per room."""
    first_room: int = 0
    """Rooms of the training domain to leave out, because an earlier run has learned from them."""
    frames: int = 16
    matrix_lr: float = 4e-3
    """Muon, for the matrices of the blocks and the camera decoder."""
    other_lr: float = 1e-3
    """AdamW, for the backbone's embeddings, norms and biases."""
    head_lr: float = 6e-4
    """AdamW, for the dense head and the last linear layers. Their inputs have a large mean, so that a step moves all
    outputs of a layer together: at 2e-3 rectifiers died within a few hundred steps, and the answers were constant."""
    warmup_views: int = 120_000
    cooldown: float = 0.8
    """Share of the schedule, its end, in which the learning rate falls to zero."""
    ema: float = 0.995
    """How much of the running average of the weights a step keeps."""
    clip: float = 1.0
    """Largest norm of all gradients together."""
    pairs_until: int = 600_000
    """Views before windows reach beyond 2 or 3 neighbouring frames."""
    short_until: int = 1_500_000
    """Views before windows reach 16 views and stride 3."""
    small_until: int = 3_600_000
    """Views before the images reach their full size; at three quarters of it a view costs 40 % less."""
    reach: int = 10
    """Largest distance between the first and the last view of a sample, in frames, where its views are spread."""
    any_reference: float = 0.6
    """Share of the samples whose reference is any of its views instead of one end of the walk."""
    cameras_given: float = 0.25
    """Share of the samples whose cameras are given to the model, which trains its camera encoder."""
    depth_views: int = 128
    """Views that the dense head learns from in one step, at most one of each sample."""
    ray_branch_every: int = 8
    """Steps between two updates of the ray branch, which learns on detached features."""
    evaluate_every: int = 0
    """Views between two scores on validation rooms, which are computed on one core meanwhile. 0: none."""
    broken_steps: int = 20
    """Steps with a number that is not finite that are left out before the run ends with an error. More than 0 also
    spares a GPU from waiting for the answer after every step."""
    weights: LossWeights = LossWeights()

    def __post_init__(self):
        for name, smallest in _SMALLEST.items():
            value, largest = getattr(self, name), _LARGEST.get(name)
            if value < smallest or (largest is not None and value > largest):
                limits = f"at least {smallest:g}" + (f" and at most {largest:g}" if largest is not None else "")
                raise UserError(f"cannot train with {name.replace('_', '-')} {value}. Give {limits}.")

    def position(self, seen: int, seconds: float) -> float:
        """Return the place in the schedule, in views: the views learned from, or further where the time runs out first.

        The run is complete at `views`. `seconds` is the time that the run has taken so far.
        """
        if not self.minutes:
            return seen
        return max(seen, self.begin[1] + (self.views - self.begin[1]) * seconds / (60 * self.minutes))

    def phase(self, position: float) -> Phase:
        """Return the phase at a position of the schedule: short windows and small images come first."""
        side = self.side * 3 // 4 if position < self.small_until else self.side
        if position < self.pairs_until:
            views, stride = (2, 3), 1
        elif position < self.short_until:
            views, stride = (2, 3, 4), 2
        else:
            views, stride = (2, 4, 4, 4, 6, 8, 8, 8, 12, 16), 3
        return Phase(views=views, max_stride=stride, reach=self.reach, side=side, any_reference=self.any_reference)

    def rate(self, position: float) -> float:
        """Return the factor on all learning rates: warm-up, plateau, quadratic cool-down to zero."""
        warm = min(1.0, (position - self.begin[1]) / self.warmup_views)
        start = self.cooldown_start
        left = 1.0 if position < start else max(0.0, (self.views - position) / (self.views - start))
        return self.peak * warm * left**2

    @property
    def cooldown_start(self) -> float:
        """Number of views after which the cool-down begins."""
        return self.begin[1] + (self.views - self.begin[1]) * (1 - self.cooldown)
