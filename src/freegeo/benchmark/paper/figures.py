"""Figures of a benchmark folder, as PNG and PDF, drawn from stored predictions and the tidy table.

Scores against the number of views; depth error maps; clouds with the points beyond the threshold in red, for before and
after adaptation and for "8->4" against 4 views.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from freegeo.benchmark.paper.tables import NAMES, short_name
from freegeo.benchmark.results import Row, choose, mean, read_results
from freegeo.benchmark.scene_score import GROUND_TRUTH, fuse_scene, load_reference
from freegeo.benchmark.stored import read_stored
from freegeo.benchmark.tasks import DAMAGED, Task, reason_of, stored_tasks
from freegeo.data.datasets.registry import load_scene, true_depth
from freegeo.data.scene import Scene
from freegeo.files import atomic_path
from freegeo.fusion.mesh import sample_surface
from freegeo.metrics.cloud import nearest_distances
from freegeo.metrics.depth import score_depth

if TYPE_CHECKING:
    from matplotlib.figure import Figure

logger = logging.getLogger(__name__)

FOLDER = "figures"
CURVE_METRICS = ("auc30", "fscore")
LINES = {"frozen": ("frozen", "#555555", "o"), "adapted": ("adapted", "#1f77b4", "s")}
PAIRS = {"before-after": (("frozen", "adapted"), ("frozen", "adapted")), "8to4": (("frozen", "8to4"), ("4", "8->4"))}
"""Figure -> variants that stand side by side, and their titles."""
INSIDE, OUTSIDE, TRUTH = "#7f7f7f", "#d62728", "#d9e6f2"
WORST_ERROR = 0.5
CLOUD_POINTS = 20_000
SHOWN_VIEWS = 4


@dataclass(frozen=True, kw_only=True)
class DepthPanel:
    """One prediction of a scene beside the truth."""

    title: str
    images: Sequence[np.ndarray]
    """Photos of the views, each (H, W, 3) uint8."""
    depth_z: np.ndarray
    """(S, h, w) metres, scaled to the truth."""
    relative_error: np.ndarray
    """(S, h, w) |d - d_gt| / d_gt; NaN where there is no truth."""


@dataclass(frozen=True, kw_only=True)
class CloudPanel:
    """One fused surface beside the truth."""

    title: str
    points: np.ndarray
    """(n, 3) metres."""
    distance: np.ndarray
    """(n,) metres to the nearest point of the truth."""


def draw_all(data: Path, out: Path) -> list[Path]:
    """Draw the curves of every dataset, and maps and clouds of its first scene that has them; returns the files.

    A scene whose data is damaged is left out with a warning.
    """
    rows = read_results(out)
    files = []
    for dataset in dict.fromkeys(row.dataset for row in rows):
        figure = curve_figure(choose(rows, dataset=dataset), short_name(dataset))
        if figure is not None:
            files += save_figure(figure, Path(out) / FOLDER / f"views-{dataset}")
    for name, (one, other) in _comparisons(out).items():
        try:
            files += _draw_pair(data, out, name, one, other)
        except DAMAGED as error:
            logger.warning("no figure %s: %s", name, reason_of(error))
    return files


def curve_figure(rows: Sequence[Row], title: str) -> Figure | None:
    """AUC@30 and F1 against the number of views, frozen and adapted; None without two numbers of views."""
    plt = _pyplot()
    views = sorted({row.views for row in rows if row.metric in CURVE_METRICS and row.variant in LINES})
    if len(views) < 2:
        return None
    figure, axes = plt.subplots(1, len(CURVE_METRICS), figsize=(7.2, 2.9), layout="constrained")
    for axis, metric in zip(axes, CURVE_METRICS, strict=True):
        for variant, (label, colour, marker) in LINES.items():
            # Only entries of the main frame rule: the others are samples of another kind.
            points = {v: mean(_of_main_rule(choose(rows, variant=variant, metric=metric, views=v))) for v in views}
            known = {v: value for v, value in points.items() if value is not None}
            if known:
                axis.plot(list(known), list(known.values()), color=colour, marker=marker, label=label)
        axis.set(xlabel="views", ylabel=NAMES[metric], xscale="log", xticks=views, ylim=(0, None))
        axis.set_xticklabels([str(v) for v in views])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    axes[0].legend(frameon=False)
    figure.suptitle(f"{title}: scores against the number of views", fontsize=11)
    return figure


def depth_figure(panels: Sequence[DepthPanel], title: str) -> Figure:
    """Photos above; for every prediction its depth and its relative error, one colour scale for all."""
    plt = _pyplot()
    views = min(SHOWN_VIEWS, min(len(panel.images) for panel in panels))
    count = 1 + 2 * len(panels)
    height = panels[0].depth_z.shape[1] / panels[0].depth_z.shape[2]
    size = (2.1 * views + 0.9, 2.1 * count * height + 0.6)
    figure, grid = plt.subplots(count, views, figsize=size, layout="constrained", squeeze=False)
    near, far = np.nanpercentile(np.stack([panel.depth_z[:views] for panel in panels]), [2, 98])
    depth_map = error_map = None
    for view in range(views):
        grid[0, view].imshow(panels[0].images[view])
        for number, panel in enumerate(panels):
            top, below = grid[1 + 2 * number, view], grid[2 + 2 * number, view]
            depth_map = top.imshow(panel.depth_z[view], cmap="viridis", vmin=near, vmax=far)
            error_map = below.imshow(panel.relative_error[view], cmap="magma", vmin=0, vmax=WORST_ERROR)
            if view == 0:
                average = float(np.nanmean(panel.relative_error[:views]))
                top.set_ylabel(f"{panel.title}\ndepth", fontsize=9)
                below.set_ylabel(f"{panel.title}\nerror {average:.3f}", fontsize=9)
    grid[0, 0].set_ylabel("photo", fontsize=9)
    for axis in grid.flat:
        axis.set(xticks=[], yticks=[])
    assert depth_map is not None and error_map is not None
    everywhere = grid.ravel().tolist()
    figure.colorbar(depth_map, ax=everywhere, label="depth (m)", shrink=0.5)
    figure.colorbar(error_map, ax=everywhere, label="relative error", shrink=0.5, extend="max")
    figure.suptitle(title, fontsize=11)
    return figure


def cloud_figure(panels: Sequence[CloudPanel], truth: np.ndarray, threshold: float, title: str) -> Figure:
    """Surfaces seen along the thinnest direction of the truth (m, 3): grey inside, red beyond the threshold."""
    plt = _pyplot()
    centre, axes = _widest_plane(truth)
    figure, grid = plt.subplots(
        1, len(panels), figsize=(3.9 * len(panels), 4.2), layout="constrained", squeeze=False, sharex=True, sharey=True
    )
    ground = (truth - centre) @ axes
    shown = [(panel.points - centre) @ axes for panel in panels]
    low, high = _window(ground, shown)
    for axis, panel, flat in zip(grid[0], panels, shown, strict=True):
        axis.scatter(*_thinned(ground).T, s=1, color=TRUTH, rasterized=True)
        outside = panel.distance >= threshold
        for mask, colour in ((~outside, INSIDE), (outside, OUTSIDE)):
            axis.scatter(*_thinned(flat[mask], outside.size).T, s=1, color=colour, rasterized=True)
        share = f"{outside.mean():.0%} beyond {threshold:g} m" if outside.size else "no surface"
        axis.set_title(f"{panel.title}: {share}", fontsize=10)
        axis.set(aspect="equal", xlabel="m", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    handles = [
        plt.Line2D([], [], linestyle="", marker="o", color=colour, label=label)
        for colour, label in ((TRUTH, "ground truth"), (INSIDE, "within"), (OUTSIDE, "beyond the threshold"))
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    figure.suptitle(title, fontsize=11)
    return figure


def save_figure(figure: Figure, stem: Path) -> list[Path]:
    """Write a figure as `<stem>.png` and `<stem>.pdf` and close it."""
    paths = [stem.with_name(f"{stem.name}.{ending}") for ending in ("png", "pdf")]
    for path in paths:
        with atomic_path(path) as part:
            figure.savefig(part, dpi=150)
    _pyplot().close(figure)
    return paths


def depth_panel(title: str, scene: Scene, task: Task, out: Path) -> DepthPanel | None:
    """A stored prediction scaled by the median ratio; None when the depth of the scene's frames is not known."""
    stored = read_stored(task, out)
    chosen = scene.select(stored.frames)
    depth_z = stored.prediction.depth_z
    assert depth_z is not None
    truth = true_depth(chosen, (depth_z.shape[-2], depth_z.shape[-1]))
    if truth is None or not truth.any():
        return None
    scaled = depth_z * float(score_depth(depth_z, truth).scale)
    error = torch.where(truth > 0, (scaled - truth).abs() / truth, torch.nan)
    return DepthPanel(
        title=title, images=[photo.read() for photo in chosen.photos], depth_z=scaled.numpy(),
        relative_error=error.numpy(),
    )  # fmt: skip


def cloud_panel(title: str, scene: Scene, task: Task, out: Path, truth: np.ndarray) -> CloudPanel:
    """The fused surface of a stored prediction with its distances to the truth; without points when it is empty."""
    stored = read_stored(task, out)
    mesh = fuse_scene(scene.select(stored.frames), stored.prediction)
    points = np.empty((0, 3)) if mesh.is_empty else sample_surface(mesh, CLOUD_POINTS, seed=0)
    distance = nearest_distances(points, truth) if len(points) else np.empty(0)
    return CloudPanel(title=title, points=points, distance=distance)


def _comparisons(out: Path) -> Mapping[str, tuple[Task, Task]]:
    """The first pair of tasks of each kind in every dataset."""
    tasks = {task for task, _ in stored_tasks(out)}
    found: dict[str, tuple[Task, Task]] = {}
    for task in sorted(tasks, key=str):
        for kind, ((one, other), _) in PAIRS.items():
            partner = replace(task, variant=other)
            if task.variant == one and task.views == SHOWN_VIEWS and partner in tasks:
                found.setdefault(f"{kind}-{task.dataset}", (task, partner))
    return found


def _draw_pair(data: Path, out: Path, name: str, one: Task, other: Task) -> list[Path]:
    titles = next(labels for kind, (_, labels) in PAIRS.items() if name.startswith(kind))
    scene = load_scene(data, one.dataset, one.scene)
    reference = load_reference(scene, cache=Path(out) / GROUND_TRUTH)
    pairs = list(zip(titles, (one, other), strict=True))
    heading = f"{short_name(one.dataset)} {one.scene}, {one.views} views"
    clouds = [cloud_panel(title, scene, task, out, reference.cloud.points) for title, task in pairs]
    threshold = reference.constants.threshold
    files = save_figure(
        cloud_figure(clouds, reference.cloud.points, threshold, f"{heading}: fused surface"),
        Path(out) / FOLDER / f"cloud-{name}",
    )
    panels = [panel for title, task in pairs if (panel := depth_panel(title, scene, task, out)) is not None]
    if panels:
        files += save_figure(depth_figure(panels, f"{heading}: depth"), Path(out) / FOLDER / f"depth-{name}")
    return files


def _of_main_rule(rows: Sequence[Row]) -> list[Row]:
    rules = [row.rule for row in rows]
    main = next((rule for rule in ("da3", "vggt", "neighbours", "experiment") if rule in rules), None)
    return [row for row in rows if row.rule == main]


def _widest_plane(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre (3,) and the two directions (3, 2) in which points (n, 3) spread most."""
    centre = points.mean(axis=0)
    _, _, directions = np.linalg.svd(points - centre, full_matrices=False)
    return centre, directions[:2].T


def _window(truth: np.ndarray, shown: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Corners of what is drawn: the truth (m, 2) and most of the surfaces, at most a truth's width beyond it."""
    size = np.ptp(truth, axis=0).max()
    low, high = truth.min(axis=0), truth.max(axis=0)
    surfaces = np.concatenate(list(shown))
    if len(surfaces):
        near, far = np.percentile(surfaces, [2, 98], axis=0)
        low, high = np.minimum(low, np.maximum(near, low - size)), np.maximum(high, np.minimum(far, high + size))
    return low - 0.1 * size, high + 0.1 * size


def _thinned(points: np.ndarray, total: int | None = None) -> np.ndarray:
    """At most the shown number of points, thinned evenly; `total` keeps the share of a part."""
    step = max(1, (total or len(points)) // CLOUD_POINTS)
    return points[::step]


def _pyplot():
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    return plt
