"""What known cameras are worth to a model on generated rooms: the same photos without cameras and with the true ones.

What is scored, and why: docs/embedded-model.md, "Known cameras".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from freegeo.files import write_json
from freegeo.geometry import se3
from freegeo.geometry.camera import K_from_fov
from freegeo.metrics.bootstrap import paired_interval
from freegeo.metrics.cloud import f1_rel5
from freegeo.metrics.depth import score_depth
from freegeo.models.api import ReconstructionModel
from freegeo.training.pool import Rooms, image_size
from freegeo.training.report_card import ALL_VIEWS, ASPECT, KEPT, ROOMS_PER_BATCH, evaluation_rooms, given, score_room
from freegeo.types import Prediction, Priors

VIEWS = {"4": KEPT, "8": tuple(range(ALL_VIEWS))}
WITHOUT, WITH = "without", "given"
METRICS = ("auc30", "auc05", "rotation_deg", "translation_deg", "fov_deg", "abs_rel", "abs_rel_posed", "f1", "f1_posed")
WHOLE_GAIN = "f1_posed - f1"
"""F1 with cameras given and returned, minus F1 of the photos alone."""
CAMERA_DOMAINS = ("test-id", "big", "sparse")


def camera_card(
    model: ReconstructionModel,
    path: Path,
    *,
    side: int,
    domains: Mapping[str, int],
    on_domain: Callable[[str], None] = lambda domain: None,
) -> dict[str, Any]:
    """Score a model with and without the true cameras on the same rooms, write the card as JSON and return it.

    Per domain and number of views: means of every metric, and paired intervals of given minus without.

    Args:
        model: in evaluation mode, on the CPU; one that takes known cameras.
        path: the JSON file.
        side: longest side of the images in pixels.
        domains: name -> number of rooms.
        on_domain: called before each domain.
    """
    card: dict[str, Any] = {"side": side, "kept": list(KEPT), "domains": {}}
    for domain, rooms in domains.items():
        on_domain(domain)
        scores = score_with_cameras(model, domain, rooms, side=side)
        card["domains"][domain] = {"rooms": rooms, "views": {views: _summary(one) for views, one in scores.items()}}
    write_json(path, card)
    return card


def _summary(scores: Mapping[str, Mapping[str, np.ndarray]]) -> dict[str, Any]:
    without, known = scores[WITHOUT], scores[WITH]
    gaps = {name: known[name] - without[name] for name in METRICS} | {WHOLE_GAIN: known["f1_posed"] - without["f1"]}
    return {
        "mean": {mode: {name: float(values.mean()) for name, values in one.items()} for mode, one in scores.items()},
        "gap": {name: paired_interval(gap)._asdict() for name, gap in gaps.items()},
    }


def score_with_cameras(
    model: ReconstructionModel, domain: str, rooms: int, *, side: int
) -> dict[str, dict[str, dict[str, np.ndarray]]]:
    """Return number of views -> mode -> metric -> (rooms,) on the first rooms of a domain."""
    rows: dict[str, dict[str, list[dict[str, float]]]] = {views: {WITHOUT: [], WITH: []} for views in VIEWS}
    size = image_size(side, ASPECT, model.spec.patch_size)
    for first in range(0, rooms, ROOMS_PER_BATCH):
        batch = evaluation_rooms(domain, first, min(ROOMS_PER_BATCH, rooms - first), size)
        for name, views in VIEWS.items():
            for mode, prediction in predict_both(model, batch, views).items():
                rows[name][mode] += [score_posed(prediction, batch, room, views) for room in range(len(batch.images))]
    return {
        views: {mode: {name: np.array([row[name] for row in one]) for name in METRICS} for mode, one in modes.items()}
        for views, modes in rows.items()
    }


@torch.no_grad()
def predict_both(model: ReconstructionModel, batch: Rooms, views: tuple[int, ...]) -> dict[str, Prediction]:
    """Predict some views of rooms without cameras and with the true ones."""
    chosen = list(views)
    tokens = model.embed(batch.images[:, chosen].float() / 255)
    K = K_from_fov(*batch.fov_vh[:, chosen].unbind(-1), tokens.image_hw)
    cameras = Priors(T_cam_world=batch.T_cam_world[:, chosen], K=K, metric=True)
    return {
        WITHOUT: model.decode(model.aggregate(tokens)),
        WITH: model.decode(model.aggregate(tokens, priors=cameras)),
    }


def score_posed(prediction: Prediction, truth: Rooms, room: int, views: tuple[int, ...]) -> dict[str, float]:
    """Return the metrics of the report card for one room, and those of its depth with the true cameras.

    For `abs_rel_posed` and `f1_posed` the depth is multiplied by the factor that brings the distances of the predicted
    cameras to the true ones, and nothing else is fitted; `f1_posed` has the true cameras in place of the predicted.
    """
    chosen = list(views)
    depth_true, T_true = truth.depth_z[room].float(), truth.T_cam_world[room]
    K_true = K_from_fov(*truth.fov_vh[room].unbind(-1), (depth_true.shape[-2], depth_true.shape[-1]))
    factor = distance_ratio(T_true[chosen], given(prediction.T_cam_world)[room])
    depth_z = given(prediction.depth_z)[room] * factor
    cloud = f1_rel5(
        depth_z, K_true[chosen], T_true[chosen], depth_true, K_true, T_true, views=views, posed=True
    )  # fmt: skip
    return score_room(prediction, truth, room, views, True) | {
        "abs_rel_posed": float(score_depth(depth_z, depth_true[chosen], align="none").abs_rel),
        "f1_posed": cloud.fscore,
    }


def distance_ratio(T_true: Tensor, T_pred: Tensor) -> Tensor:
    """Return the median over pairs of cameras (S, 4, 4) of their true distance over the predicted one."""
    first, second = torch.triu_indices(len(T_true), len(T_true), 1)
    true, pred = (
        torch.linalg.vector_norm(centres[first] - centres[second], dim=-1)
        for centres in (se3.camera_centres(T_true), se3.camera_centres(T_pred))
    )
    return (true / pred).median()


def camera_tables(card: Mapping[str, Any]) -> str:
    """Return a card as two Markdown tables: quality without and with cameras, and the intervals of the difference."""
    digits = {name: 2 if name.endswith("_deg") else 3 for name in METRICS}
    lines = ["| domain (rooms) | views | cameras | " + " | ".join(METRICS) + " |", "|---" * (len(METRICS) + 3) + "|"]
    for domain, entry in card["domains"].items():
        for views, summary in entry["views"].items():
            for mode, mean in summary["mean"].items():
                values = " | ".join(f"{mean[name]:.{digits[name]}f}" for name in METRICS)
                lines.append(f"| {domain} ({entry['rooms']}) | {views} | {mode} | {values} |")
    columns = ("auc30", "abs_rel", "abs_rel_posed", "f1", "f1_posed", WHOLE_GAIN)
    lines += ["", "| domain | views | " + " | ".join(columns) + " |", "|---" * (len(columns) + 2) + "|"]
    for domain, entry in card["domains"].items():
        for views, summary in entry["views"].items():
            gaps = [summary["gap"][name] for name in columns]
            cells = [f"{gap['mean']:+.3f} [{gap['low']:+.3f}, {gap['high']:+.3f}]" for gap in gaps]
            lines.append(f"| {domain} | {views} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"
