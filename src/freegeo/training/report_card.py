"""The report card of a checkpoint on generated rooms: 4 views, 8 views, and 8 views decoded for 4 ("8->4").

What is scored, and why: docs/embedded-model.md, "Quality on rooms never seen in training".
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from freegeo.data.procedural import get_domain
from freegeo.files import write_json
from freegeo.geometry import se3
from freegeo.geometry.camera import K_from_fov
from freegeo.metrics.bootstrap import Interval, paired_interval
from freegeo.metrics.cloud import f1_rel5
from freegeo.metrics.depth import score_depth
from freegeo.metrics.pose import pair_errors, pose_auc
from freegeo.models.api import ReconstructionModel
from freegeo.training.pool import Rooms, image_size, render_rooms
from freegeo.types import Prediction

ALL_VIEWS = 8
KEPT = (0, 2, 4, 6)
MODES = ("4", "8->4", "8")
ROOMS_PER_BATCH = 8
ASPECT = (3, 4)
GAP_METRICS = ("auc30", "auc15", "auc05", "f1", "abs_rel", "rotation_deg", "translation_deg")
PREMISE_METRICS = ("auc30", "auc15", "f1")
"""Metrics whose interval of 8->4 minus 4 has to lie above zero."""
REPORTED_DOMAINS = ("test-id", "light", "lowtex", "tex", "big", "sparse", "lens")
"""Domains of the shipped model's card; the first is the distribution that it was trained on."""


@dataclass(frozen=True, kw_only=True)
class Gate:
    """A limit that the checkpoint has to reach with 4 views in distribution."""

    metric: str
    limit: float
    at_least: bool

    def reached(self, value: float) -> bool:
        """Whether a value is within the limit."""
        return value >= self.limit if self.at_least else value <= self.limit


GATES = (
    Gate(metric="auc30", limit=0.80, at_least=True),
    Gate(metric="auc05", limit=0.30, at_least=True),
    Gate(metric="fov_deg", limit=1.5, at_least=False),
    Gate(metric="abs_rel", limit=0.06, at_least=False),
)


@dataclass(frozen=True, kw_only=True)
class RoomScores:
    """Metrics of some rooms of one domain, room by room, in each mode."""

    rooms: int
    per_room: dict[str, dict[str, np.ndarray]]
    """mode -> metric -> (rooms,)."""

    def mean(self, mode: str) -> dict[str, float]:
        """Return the mean of every metric over rooms."""
        return {name: float(np.nanmean(values)) for name, values in self.per_room[mode].items()}

    def gap(self, metric: str) -> Interval:
        """Return the paired interval of "8->4" minus "4", the gain from the held-out views."""
        return paired_interval(self.per_room["8->4"][metric] - self.per_room["4"][metric])


def score_rooms(
    model: ReconstructionModel, domain: str, rooms: int, *, side: int, with_f1: bool = False, start: int = 0
) -> RoomScores:
    """Score a model on the first rooms of a domain, rendered at the model's size (4:3, eight neighbouring frames)."""
    scores: dict[str, list[dict[str, float]]] = {mode: [] for mode in MODES}
    size = image_size(side, ASPECT, model.spec.patch_size)
    for first in range(start, start + rooms, ROOMS_PER_BATCH):
        batch = evaluation_rooms(domain, first, min(ROOMS_PER_BATCH, start + rooms - first), size)
        for mode, views, prediction in predictions(model, batch):
            scores[mode] += [score_room(prediction, batch, room, views, with_f1) for room in range(len(batch.images))]
    per_room = {mode: {k: np.array([row[k] for row in rows]) for k in rows[0]} for mode, rows in scores.items()}
    return RoomScores(rooms=rooms, per_room=per_room)


@lru_cache(maxsize=8)
def evaluation_rooms(domain: str, first: int, count: int, size: tuple[int, int]) -> Rooms:
    """Render some rooms of a domain; cached, as a training run scores the same ones repeatedly."""
    return render_rooms(get_domain(domain).seeds(count, start=first), domain, ALL_VIEWS, size)


@torch.no_grad()
def predictions(model: ReconstructionModel, batch: Rooms) -> Iterator[tuple[str, Sequence[int], Prediction]]:
    """Predict each mode for a batch of rooms; the images are embedded once."""
    tokens = model.embed(batch.images.float() / 255)
    all_features = model.aggregate(tokens)
    every = list(range(ALL_VIEWS))
    yield "4", KEPT, model.decode(model.aggregate(tokens.select(KEPT)))
    yield "8->4", KEPT, model.decode(all_features.select(KEPT))
    yield "8", every, model.decode(all_features)


def given(part: Tensor | None) -> Tensor:
    """Return a part of a prediction that must not be None."""
    assert part is not None
    return part


def score_room(
    prediction: Prediction, truth: Rooms, room: int, views: Sequence[int], with_f1: bool
) -> dict[str, float]:
    """Return all metrics of one room."""
    views = list(views)
    depth_z, K, T_cam_world = (given(part)[room] for part in (prediction.depth_z, prediction.K, prediction.T_cam_world))
    errors = pair_errors(T_cam_world, truth.T_cam_world[room, views])
    depth_true = truth.depth_z[room].float()
    height, width = depth_true.shape[-2:]
    fov = 2 * torch.atan(width / 2 / K[:, 0, 0])
    scores = pose_auc(errors.worst_deg) | {
        "rotation_deg": float(errors.rotation_deg.median()),
        "translation_deg": float(errors.translation_deg.median()),
        "fov_deg": float((fov - truth.fov_vh[room, views, 1]).abs().mean().rad2deg()),
        "abs_rel": float(score_depth(depth_z, depth_true[views]).abs_rel),
    }
    if with_f1:
        K_true = K_from_fov(*truth.fov_vh[room].unbind(-1), (height, width))
        T_true = truth.T_cam_world[room]
        cloud = f1_rel5(depth_z, K, T_cam_world, depth_true, K_true, T_true, views=tuple(views))
        scores["f1"] = cloud.fscore
    return {name: float(value) for name, value in scores.items()}


def zero_motion_rotation_deg(truth: Rooms) -> float:
    """Return the rotation error of a model that predicts no motion, the baseline for a trained one."""
    still = torch.eye(4).expand_as(truth.T_cam_world)
    return float(pair_errors(se3.inverse(still), truth.T_cam_world).rotation_deg.median())


def report_card(
    model: ReconstructionModel,
    path: Path,
    *,
    side: int,
    domains: Mapping[str, int],
    on_domain: Callable[[str], None] = lambda domain: None,
) -> dict[str, Any]:
    """Score a checkpoint on generated rooms, write the card as JSON and return it.

    Per domain: means of every metric in each mode, intervals of 8->4 minus 4, and whether the premise holds, which
    means that every one of `PREMISE_METRICS` has an interval above zero. `gates` judges the first domain at 4 views.

    Args:
        model: in evaluation mode, on the CPU.
        path: the JSON file.
        side: longest side of the images in pixels.
        domains: name -> number of rooms; the first one should be the distribution of the training.
        on_domain: called before each domain.
    """
    card: dict[str, Any] = {"side": side, "kept": list(KEPT), "domains": {}}
    for domain, rooms in domains.items():
        on_domain(domain)
        scores = score_rooms(model, domain, rooms, side=side, with_f1=True)
        gaps = {metric: scores.gap(metric) for metric in GAP_METRICS}
        card["domains"][domain] = {
            "rooms": rooms,
            "mean": {mode: scores.mean(mode) for mode in MODES},
            "gap": {metric: gap._asdict() for metric, gap in gaps.items()},
            "premise": all(gaps[metric].low > 0 for metric in PREMISE_METRICS),
        }
    first = next(iter(card["domains"].values()))["mean"]["4"]
    card["gates"] = {
        gate.metric: {"value": first[gate.metric], "limit": gate.limit, "reached": gate.reached(first[gate.metric])}
        for gate in GATES
    }
    write_json(path, card)
    return card


def gate_lines(card: Mapping[str, Any]) -> list[str]:
    """Return one line per gate: the value in the first domain with 4 views, the limit, and whether it is reached."""
    bounds = {gate.metric: ">=" if gate.at_least else "<=" for gate in GATES}
    return [
        f"{metric} {gate['value']:.4f}, asked for {bounds[metric]} {gate['limit']:g}: "
        f"{'reached' if gate['reached'] else 'not reached'}"
        for metric, gate in card["gates"].items()
    ]


def card_tables(card: Mapping[str, Any]) -> str:
    """Return a report card as two Markdown tables: quality, and the gain from the held-out views."""
    columns = ("auc30", "auc15", "auc05", "auc03", "rotation_deg", "translation_deg", "fov_deg", "abs_rel", "f1")
    digits = {name: 2 if name.endswith("_deg") else 3 for name in columns}
    lines = ["| domain (rooms) | mode | " + " | ".join(columns) + " |", "|---" * (len(columns) + 2) + "|"]
    for domain, entry in card["domains"].items():
        for mode in MODES:
            values = " | ".join(f"{entry['mean'][mode][name]:.{digits[name]}f}" for name in columns)
            lines.append(f"| {domain} ({entry['rooms']}) | {mode} | {values} |")
    lines += ["", "| domain | " + " | ".join(GAP_METRICS) + " | premise |", "|---" * (len(GAP_METRICS) + 2) + "|"]
    for domain, entry in card["domains"].items():
        cells = [f"{gap['mean']:+.3f} [{gap['low']:+.3f}, {gap['high']:+.3f}]" for gap in entry["gap"].values()]
        lines.append(f"| {domain} | " + " | ".join(cells) + f" | {'yes' if entry['premise'] else 'no'} |")
    return "\n".join(lines) + "\n"
