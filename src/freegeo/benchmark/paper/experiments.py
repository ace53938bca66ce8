"""Every table of the paper by name: which variants, views, seeds and frames it needs, as one literal table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from freegeo.benchmark.paper.variants import VARIANTS
from freegeo.benchmark.sampling import PAPER_BUDGETS, PAPER_SEEDS
from freegeo.benchmark.tasks import FrameRule, Task, unique
from freegeo.data.procedural.splits import FRAMES, PREFIX
from freegeo.errors import UserError

ROOMS = tuple(f"{PREFIX}{name}" for name in ("test-id", "light", "lowtex", "tex", "big", "sparse"))
"""The splits of the generated rooms that are reported."""
Layout = Literal["means", "changes", "costs", "gain"]


@dataclass(frozen=True, kw_only=True)
class Line:
    """One row of a table."""

    label: str
    variant: str
    views: int
    paper: Mapping[str, Any] = field(default_factory=dict)
    """Fields that identify the row of the published table to compare with; empty: there is none."""
    compare_with: str | None = None
    """Label of the row of this table that the difference is tested against."""


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """One table."""

    name: str
    title: str
    lines: tuple[Line, ...]
    metrics: tuple[str, ...]
    room_metrics: tuple[str, ...]
    """Metrics shown for generated rooms, where a small model is scored."""
    paper: str | None = None
    """Key of the published table."""
    layout: Layout = "means"
    """`means` over scenes and seeds; `changes`: relative ones in percent of the second line of each pair; `costs`;
    `gain`: frozen, adapted, and the gain as a share of the 8->4 gap, in one row per metric."""
    rule: FrameRule | None = None
    """Frame rule that belongs to the table; None: the run's."""
    seeds: tuple[int, ...] = PAPER_SEEDS
    paper_seeds: int = 3
    """Over how many seeds the paper's numbers are means; 1 where what it prints allows no more (docs/benchmark.md)."""
    every_second: bool = False
    """Whether fewer than 8 views have to be every second one of the 8; `vggt` then stands in for `da3`."""
    published_dataset: str | None = None
    """The only published dataset the paper reports it on; None: all four."""
    rooms: tuple[str, ...] = ROOMS

    def frame_rule(self, rule: FrameRule) -> FrameRule:
        """The rule of the table in a run of this rule; `neighbours` nests 4 in 8 views, so it serves every table."""
        if self.rule is not None and rule != "neighbours":
            return self.rule
        return "vggt" if self.every_second and rule == "da3" else rule

    def frame_seeds(self, rule: FrameRule) -> tuple[int, ...]:
        """The seeds of the table in a run of this rule; under a common rule all tables must share their samples."""
        return PAPER_SEEDS if rule == "neighbours" else self.seeds

    def lines_for(self, dataset: str) -> list[Line]:
        """The lines that can be computed on a dataset: generated rooms have 16 frames."""
        return [line for line in self.lines if not dataset.startswith(PREFIX) or line.views <= FRAMES]

    def tasks(
        self,
        scenes: Mapping[str, Sequence[str]],
        *,
        rule: FrameRule = "da3",
        seeds: Sequence[int] | None = None,
        views: Sequence[int] | None = None,
    ) -> list[Task]:
        """All tasks of the table on these scenes (dataset -> names); `seeds` and `views` narrow or replace its own."""
        return [
            Task(
                dataset=dataset, scene=scene, rule=self.frame_rule(rule), views=line.views, seed=seed,
                variant=line.variant,
            )
            for dataset, names in scenes.items()
            for line in self.lines_for(dataset)
            if views is None or line.views in views
            for scene in names
            for seed in (self.frame_seeds(rule) if seeds is None else seeds)
        ]  # fmt: skip


def _before_and_after(budgets: Iterable[int]) -> tuple[Line, ...]:
    return tuple(
        line
        for views in budgets
        for line in (
            Line(
                label=f"{views} views, frozen", variant="frozen", views=views, paper={"views": views, "adapted": False}
            ),
            Line(
                label=f"{views} views, adapted", variant="adapted", views=views,
                paper={"views": views, "adapted": True}, compare_with=f"{views} views, frozen",
            ),
        )
    )  # fmt: skip


def _against(base: str, base_label: str, others: Mapping[str, Mapping[str, Any]], views: int) -> tuple[Line, ...]:
    first = Line(label=base_label, variant=base, views=views)
    return first, *(
        Line(label=VARIANTS[name].label, variant=name, views=views, paper=paper, compare_with=base_label)
        for name, paper in others.items()
    )


_ALL_FOUR = ("auc03", "auc30", "fscore", "overall")
_ROOM_FOUR = ("auc03", "auc30", "fscore", "overall")
_ABLATION_ROOMS = (f"{PREFIX}light",)
EXPERIMENTS: dict[str, Experiment] = {
    experiment.name: experiment
    for experiment in (
        Experiment(
            name="long-sequence",
            title="Features of 8 views decoded for 4 of them, against 4 views alone",
            paper="long_sequence",
            paper_seeds=1,
            lines=(
                Line(label="8", variant="frozen", views=8, paper={"views": "8"}),
                Line(label="8->4", variant="8to4", views=4, paper={"views": "8->4"}, compare_with="4"),
                Line(label="4", variant="frozen", views=4, paper={"views": "4"}),
            ),
            metrics=("auc03", "fscore"),
            room_metrics=("auc03", "auc30", "fscore", "f1_rel5"),
            rule="experiment",
            seeds=(42,),
        ),
        Experiment(
            name="main",
            title="Frozen and adapted model with 4 and 8 views",
            paper="main_4v_8v",
            lines=_before_and_after((4, 8)),
            metrics=("auc03", "fscore"),
            room_metrics=("auc03", "auc30", "fscore", "f1_rel5"),
        ),
        Experiment(
            name="cross-views",
            title="Relative change of the adapted over the frozen model in percent",
            paper="cross_view_count",
            lines=_before_and_after(PAPER_BUDGETS),
            metrics=_ALL_FOUR,
            room_metrics=_ROOM_FOUR,
            layout="changes",
        ),
        Experiment(
            name="loss-ablation",
            title="Which terms of the loss matter, 4 views",
            paper="loss_ablation",
            paper_seeds=1,
            lines=(
                Line(label="frozen", variant="frozen", views=4),
                Line(
                    label="w/o consistency loss", variant="no-intra", views=4,
                    paper={"configuration": "w/o Consistency Loss"}, compare_with="full loss",
                ),
                Line(
                    label="w/o relational loss", variant="no-cross", views=4,
                    paper={"configuration": "w/o Relational Loss"}, compare_with="full loss",
                ),
                Line(
                    label="full loss", variant="adapted", views=4, paper={"configuration": "Full Loss (Free Geo)"},
                    compare_with="frozen",
                ),
            ),
            metrics=_ALL_FOUR,
            room_metrics=_ROOM_FOUR,
            published_dataset="eth3d",
            rooms=_ABLATION_ROOMS,
        ),
        Experiment(
            name="features",
            title="Distance of the last layer's features to those of the frozen model that sees 8 views",
            paper="feature_comparison",
            lines=(
                Line(label="frozen", variant="features-frozen", views=4, paper={"adapted": False}),
                Line(
                    label="adapted", variant="features-adapted", views=4, paper={"adapted": True},
                    compare_with="frozen",
                ),
            ),
            metrics=("mse", "cosine"),
            room_metrics=("mse", "cosine"),
            rule="vggt",
            published_dataset="eth3d",
        ),
        Experiment(
            name="anchors",
            title="How anchors are selected, 4 views",
            paper="selection_strategy",
            paper_seeds=1,
            lines=_against(
                "frozen",
                "frozen",
                {
                    "anchors-top": {"strategy": "Top selection"},
                    "anchors-random": {"strategy": "Random selection"},
                    "anchors-mixed": {"strategy": "Mixed selection (Free Geo)"},
                },
                views=4,
            ),
            metrics=_ALL_FOUR,
            room_metrics=_ROOM_FOUR,
            published_dataset="eth3d",
            rooms=_ABLATION_ROOMS,
        ),
        Experiment(
            name="lora-rank",
            title="Rank of the adapter, 16 views",
            paper="lora_rank",
            paper_seeds=1,
            lines=(
                Line(label="frozen", variant="frozen", views=16, paper={"variant": "Baseline"}),
                *_against(
                    "frozen", "frozen", {f"rank-{r}": {"variant": f"LoRA r={r}"} for r in (8, 16, 32, 64)}, views=16
                )[1:],
            ),
            metrics=("trainable", *_ALL_FOUR),
            room_metrics=("trainable", *_ROOM_FOUR),
            published_dataset="eth3d",
            rooms=_ABLATION_ROOMS,
        ),
        Experiment(
            name="pose-detail",
            title="Poses with 4 to 100 views",
            paper="pose_detailed",
            lines=_before_and_after(PAPER_BUDGETS),
            metrics=("auc03", "auc30"),
            room_metrics=("auc03", "auc05", "auc15", "auc30"),
        ),
        Experiment(
            name="recon-detail",
            title="Reconstruction with 4 to 100 views",
            paper="recon_detailed",
            lines=_before_and_after(PAPER_BUDGETS),
            metrics=("fscore", "overall"),
            room_metrics=("fscore", "overall", "f1_rel5", "abs_rel"),
        ),
        Experiment(
            name="gain",
            title="What adaptation gains, and how much of what the held-out views are worth",
            lines=(
                *_before_and_after((4,)),
                Line(label="8->4", variant="8to4", views=4, compare_with="4 views, frozen"),
                *_before_and_after((8, 16)),
            ),
            metrics=_ALL_FOUR,
            room_metrics=("auc05", "auc15", "auc30", "fscore", "f1_rel5", "abs_rel"),
            layout="gain",
            every_second=True,
        ),
        Experiment(
            name="overhead",
            title="What adaptation and inference cost",
            lines=_before_and_after((4, 8, 16)),
            metrics=("seconds", "peak_gb", "adapt_seconds", "adapt_steps", "adapt_peak_gb", "trainable"),
            room_metrics=("seconds", "peak_gb", "adapt_seconds", "adapt_steps", "adapt_peak_gb", "trainable"),
            layout="costs",
        ),
    )
}  # fmt: skip


def experiment(name: str) -> Experiment:
    """An experiment by name; UserError lists the names."""
    if name not in EXPERIMENTS:
        raise UserError(f"There is no experiment {name!r}; known are {', '.join(EXPERIMENTS)}, or all.")
    return EXPERIMENTS[name]


def chosen(names: Sequence[str]) -> list[Experiment]:
    """Experiments by name; `all` stands for every one."""
    return list(EXPERIMENTS.values()) if "all" in names else [experiment(name) for name in unique(list(names))]


def datasets_of(entry: Experiment, asked: Sequence[str]) -> list[str]:
    """The datasets of `asked` that an experiment is run on.

    Ablations run on the dataset of the paper and, of the generated rooms, on one split; if `asked` has none of these,
    on all of `asked`.
    """
    own = [
        name
        for name in asked
        if (
            name in entry.rooms if name in ROOMS else entry.published_dataset in (None, name) or name.startswith(PREFIX)
        )
    ]
    return own or list(asked)
