"""The learning curve of a run as a figure, from its log."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

from freegeo.errors import UserError
from freegeo.files import atomic_path, json_of, read_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class _Line(TypedDict):
    kind: str
    views: float


class _Step(_Line):
    translation: float
    points: float
    matching: float
    depth: float
    field_of_view: float
    rotation: float
    zero_motion: float


class _Scores(TypedDict):
    auc30: float
    auc15: float
    auc05: float
    rotation_deg: float
    translation_deg: float
    fov_deg: float


_Modes = TypedDict("_Modes", {"4": _Scores, "8->4": _Scores})


class _Evaluation(_Line, _Modes):
    pass


_KINDS = {"step": _Step, "evaluation": _Evaluation}


def read_log(path: Path) -> list[dict[str, Any]]:
    """Return a log's lines, those that a resumed run repeated only once.

    UserError when there is no log, DamagedError when it is damaged.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such training log. Give the log.jsonl of a training run.")
    kept: list[dict[str, Any]] = []
    for text in read_text(path).splitlines():
        line = json_of(text, path, _Line)
        json_of(text, path, _KINDS.get(line["kind"], _Line))
        kept = [other for other in kept if other["kind"] != line["kind"] or other["views"] < line["views"]]
        kept.append(line)
    return kept


def plot_learning_curve(log: Path, figure: Path) -> Path:
    """Draw losses and rotation loss over the views learned from, and scores on validation rooms where there are any."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    lines = read_log(log)
    steps = [line for line in lines if line["kind"] == "step"]
    scores = [line for line in lines if line["kind"] == "evaluation"]
    rows = 2 if scores else 1
    canvas, axes = pyplot.subplots(
        rows, 2, figsize=(11, 0.5 + 3.5 * rows), sharex=True, squeeze=False, constrained_layout=True
    )
    seen = [line["views"] / 1e6 for line in steps]
    for name in ("translation", "points", "matching", "depth", "field_of_view"):
        axes[0, 0].plot(seen, [line[name] for line in steps], label=name.replace("_", " "))
    axes[0, 0].set(title="Weighted losses (running means)", yscale="log")
    axes[0, 0].legend(fontsize=8)
    axes[0, 1].plot(seen, [line["rotation"] / (line["zero_motion"] or float("nan")) for line in steps], color="black")
    axes[0, 1].axhline(1, linestyle=":", color="grey")
    axes[0, 1].set(title="Rotation loss / that of cameras that stand still", ylim=(0, 1.1))
    if scores:
        plot_scores(scores, *axes[1])
    for axis in axes[-1]:
        axis.set(xlabel="million views", xlim=(0, None))
    with atomic_path(figure) as part:
        canvas.savefig(part, dpi=110)
    pyplot.close(canvas)
    return figure


def plot_scores(scores: list[dict[str, Any]], quality: Axes, errors: Axes) -> None:
    """Draw pose scores and median errors on validation rooms, for 4 views and for the same ones seen with 4 others."""
    seen = [line["views"] / 1e6 for line in scores]
    for mode, style in (("4", "-"), ("8->4", "--")):
        for name, colour in (("auc30", "tab:blue"), ("auc15", "tab:orange"), ("auc05", "tab:green")):
            values = [line[mode][name] for line in scores]
            quality.plot(seen, values, style, color=colour, marker=".", label=f"{name}, {mode}")
        for name, colour in (("rotation_deg", "tab:red"), ("translation_deg", "tab:purple"), ("fov_deg", "tab:brown")):
            values = [line[mode][name] for line in scores]
            label = f"{name.removesuffix('_deg').replace('_', ' ')}, {mode}"
            errors.plot(seen, values, style, color=colour, marker=".", label=label)
    quality.set(title="Pose AUC on validation rooms")
    errors.set(title="Median errors on validation rooms, degrees", ylim=(0, None))
    for axis in (quality, errors):
        axis.legend(fontsize=8)
