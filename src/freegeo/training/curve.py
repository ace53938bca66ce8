"""The learning curve of a run as a figure, from its log."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from freegeo.errors import UserError
from freegeo.files import atomic_path


def read_log(path: Path) -> list[dict[str, Any]]:
    """Return a log's lines, those that a resumed run repeated only once. UserError when there is no log."""
    if not path.is_file():
        raise UserError(f"{path}: no such training log. Give the log.jsonl of a training run.")
    kept: list[dict[str, Any]] = []
    for line in map(json.loads, path.read_text(encoding="utf-8").splitlines()):
        while kept and kept[-1]["views"] >= line["views"] and kept[-1]["kind"] == line["kind"]:
            kept.pop()
        kept.append(line)
    return kept


def plot_learning_curve(log: Path, figure: Path) -> Path:
    """Draw losses, rotation error relative to zero motion, pose scores and errors over the views learned from."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    lines = read_log(log)
    steps = [line for line in lines if line["kind"] == "step"]
    scores = [line for line in lines if line["kind"] == "evaluation"]
    canvas, axes = pyplot.subplots(2, 2, figsize=(11, 7), sharex=True, constrained_layout=True)
    seen = [line["views"] / 1000 for line in steps]
    for name in ("translation", "points", "matching", "depth", "field_of_view"):
        # A run in which only a part of the model learns has fewer losses.
        if all(name in line for line in steps):
            axes[0, 0].plot(seen, [line[name] for line in steps], label=name.replace("_", " "))
    axes[0, 0].set(title="Weighted losses (running mean)", yscale="log")
    axes[0, 1].plot(seen, [line["rotation"] / line["zero_motion"] for line in steps], color="black")
    axes[0, 1].axhline(1, linestyle=":", color="grey")
    axes[0, 1].set(title="Relative rotation loss / loss of standing still", ylim=(0, 1.1))
    seen = [line["views"] / 1000 for line in scores]
    for mode, style in (("4", "-"), ("8->4", "--")):
        for name, colour in (("auc30", "tab:blue"), ("auc15", "tab:orange"), ("auc05", "tab:green")):
            values = [line[mode][name] for line in scores]
            axes[1, 0].plot(seen, values, style, color=colour, marker=".", label=f"{name}, {mode}")
        for name, colour in (("rotation_deg", "tab:red"), ("translation_deg", "tab:purple"), ("fov_deg", "tab:brown")):
            values = [line[mode][name] for line in scores]
            label = f"{name.removesuffix('_deg').replace('_', ' ')}, {mode}"
            axes[1, 1].plot(seen, values, style, color=colour, marker=".", label=label)
    axes[1, 0].set(title="Pose AUC on validation rooms", xlabel="thousand views")
    axes[1, 1].set(title="Median errors on validation rooms, degrees", xlabel="thousand views", ylim=(0, None))
    for axis in (axes[0, 0], axes[1, 0], axes[1, 1]):
        axis.legend(fontsize=8)
    with atomic_path(figure) as part:
        canvas.savefig(part, dpi=110)
    pyplot.close(canvas)
    return figure
