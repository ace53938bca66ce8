"""The training objective: dense depth, relative cameras, per-token rays and points, cross-view matching.

Source: docs/embedded-model.md, "Training objective".
Letters: B samples, S views, P patches, Q cells (2 x 2 a patch), C channels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import cast, overload

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from freegeo.geometry import se3
from freegeo.geometry.rotation import matrix_to_quat_xyzw, quat_xyzw_to_matrix
from freegeo.models.da3 import DA3, Backbone
from freegeo.models.dpt import confidence, depth_maps
from freegeo.models.transformer import first_and_others
from freegeo.training.batches import Batch, to_device
from freegeo.training.config import TrainConfig
from freegeo.types import Features

CELLS = 2
DEPTH_CELLS = 4
"""Cells along a patch's side whose depth a linear map predicts, in every view."""
MATCH_WIDTH = 64
MATCH_LEVELS = (0, 2)
"""Output levels of the matching term; the first one is included because the later ones build on it."""
MATCH_TEMPERATURE = 0.07
RAYS_PER_PATCH_SIDE = 8
POSITION_LEVELS = (1, 2, 3)
"""Output levels of `position_term`, which needs information that attention has to carry between views."""
SMALLEST_BASELINE = 0.1
"""In mean depths: errors of relative translations are divided by their length, but by no less than this."""
VISIBLE_WITHIN = 0.06
"""Relative depth difference up to which a point counts as seen by the other view."""
CONFIDENCE_TARGET = 0.3
"""The optimal confidence for a log-depth error e is this number over e."""
GIVEN_UNITS = (1.0, 6.0)
"""Smallest and largest mean depth of a sample in the unit of the cameras that the model is given."""


class ReadOuts(nn.Module):
    """Training-only linear maps of patch features: rays and points per cell, descriptors per patch."""

    def __init__(self, channels: int):
        super().__init__()
        self.geometry = nn.Linear(channels, CELLS**2 * 9)
        self.log_depth = nn.Linear(channels, DEPTH_CELLS**2)
        self.reference_position = nn.ModuleList(nn.Linear(channels, 2) for _ in POSITION_LEVELS)
        self.descriptors = nn.ModuleList(nn.Linear(channels, MATCH_WIDTH) for _ in MATCH_LEVELS)


@dataclass(frozen=True, kw_only=True)
class CellTargets:
    """Ground truth at the middle of square cells: rays (direction with unit z, origin), points, all in the world."""

    direction: Tensor
    """(B, S, h, w, 3)."""
    point: Tensor
    """(B, S, h, w, 3)."""


def focal_lengths(fov_vh: Tensor, height: int, width: int) -> Tensor:
    """Return focal lengths in pixels (..., 2), vertical first."""
    vertical, horizontal = torch.tan(fov_vh / 2).unbind(-1)
    return torch.stack([height / 2 / vertical, width / 2 / horizontal], dim=-1)


def cell_targets(batch: Batch, cell: int) -> CellTargets:
    """Sample rays and points in the middle of cells of `cell` pixels."""
    height, width = batch.depth_z.shape[-2:]
    middle = cell // 2
    v, u = (torch.arange(middle, n, cell, device=batch.depth_z.device) + 0.5 for n in (height, width))
    focal = focal_lengths(batch.fov_vh, height, width)
    x = (u - width / 2) / focal[..., 1, None]
    y = (v - height / 2) / focal[..., 0, None]
    rays = torch.stack(
        [
            x[..., None, :].expand(*x.shape[:2], len(v), len(u)),
            y[..., None].expand(*y.shape[:2], len(v), len(u)),
            x.new_ones(*x.shape[:2], len(v), len(u)),
        ],
        dim=-1,
    )
    R, t = batch.T_world_cam[..., :3, :3], batch.T_world_cam[..., :3, 3]
    direction = torch.einsum("bsij,bshwj->bshwi", R, rays)
    depth_z = batch.depth_z[..., middle::cell, middle::cell]
    return CellTargets(direction=direction, point=t[:, :, None, None] + depth_z[..., None] * direction)


def objective(
    model: DA3, read_outs: ReadOuts, batch: Batch, config: TrainConfig, step: int, generator: torch.Generator
) -> dict[str, Tensor]:
    """Return all weighted terms of one step, scalars; their sum is the loss."""
    weights = config.weights
    device_type = batch.images.device.type
    first_tokens = camera_tokens(model, batch, generator)
    with torch.autocast(device_type, torch.bfloat16, enabled=device_type == "cuda"):
        features = encode(model, batch.images, first_tokens)
    features = as_float32(features)
    terms = camera_terms(model, features, batch, config)
    geometry = geometry_terms(read_outs, features, batch)
    terms["rays"] = weights.rays * geometry[0]
    terms["points"] = weights.points * geometry[1]
    terms["cell_depth"] = weights.cell_depth * cell_depth_term(read_outs, features, batch)
    terms["matching"] = weights.matching * matching_term(read_outs, features, batch)
    terms["position"] = weights.position * position_term(read_outs, features, batch)
    samples, views = batch.images.shape[:2]
    chosen = Choice(
        samples=to_device(torch.randperm(samples, generator=generator)[: config.depth_views], batch.images.device),
        view=int(torch.randint(views, (), generator=generator)),
    )
    depth_z, conf = read_depth(model, chosen.of(features))
    terms |= depth_terms(depth_z, conf, chosen.of(batch.depth_z), config)
    if step % config.ray_branch_every == 0:
        terms["ray_branch"] = weights.ray_branch * ray_branch_term(model, chosen.of(features), batch, chosen)
    return terms


def encode(model: DA3, images: Tensor, first_tokens_BSD: Tensor | None) -> Features:
    """Run the backbone on images (B, S, 3, H, W), whose views start with the given tokens or the learned ones."""
    tokens = model.embed(images)
    backbone = cast(Backbone, model.backbone["pretrained"])
    levels = backbone.aggregate(tokens, model.config.out_layers, None, first_tokens_BSD)
    return Features(levels=levels, image_hw=tokens.image_hw, grid_hw=tokens.grid_hw)


def camera_tokens(model: DA3, batch: Batch, generator: torch.Generator) -> Tensor:
    """Return the first tokens (B, S, D): encoded cameras where a sample's cameras are given, else the learned ones.

    The cameras come in a random unit, because nobody knows that of a user's: with two views it does not fall out.
    """
    low, high = (math.log(unit) for unit in GIVEN_UNITS)
    unit = torch.empty(len(batch.images), 1, 1).uniform_(low, high, generator=generator).exp()
    T_world_cam = batch.T_world_cam.clone()
    T_world_cam[..., :3, 3] *= to_device(unit, T_world_cam.device)
    T_world_cam = se3.inverse(se3.normalise_poses(se3.inverse(T_world_cam)))
    quat = matrix_to_quat_xyzw(T_world_cam[..., :3, :3])
    encoded = model.cam_enc(torch.cat([T_world_cam[..., :3, 3], quat, batch.fov_vh], dim=-1))
    backbone = cast(Backbone, model.backbone["pretrained"])
    learned = first_and_others(backbone.camera_token, *batch.images.shape[:2])
    return torch.where(batch.cameras_given[:, None, None], encoded, learned)


@dataclass(frozen=True, kw_only=True)
class Choice:
    """One view of some samples: what the dense head learns from in one step."""

    samples: Tensor
    view: int

    @overload
    def of(self, whole: Features) -> Features: ...
    @overload
    def of(self, whole: Tensor) -> Tensor: ...
    def of(self, whole: Features | Tensor) -> Features | Tensor:
        """Return the chosen part of features or of a tensor (B, S, ...), with one view each."""
        if isinstance(whole, Tensor):
            return whole[self.samples, self.view : self.view + 1]
        levels = {i: (self.of(patches), self.of(special)) for i, (patches, special) in whole.levels.items()}
        return replace(whole, levels=levels)


def as_float32(features: Features) -> Features:
    """Return features whose losses are computed in full precision."""
    levels = {i: (patches.float(), special.float()) for i, (patches, special) in features.levels.items()}
    return replace(features, levels=levels)


def camera_terms(model: DA3, features: Features, batch: Batch, config: TrainConfig) -> dict[str, Tensor]:
    """Compare camera encodings: relative motion of all ordered pairs, motion from view 0, field of view."""
    encoding = model.cam_dec(features.levels[model.config.out_layers[-1]][1][..., 0, :])
    t, quat, fov = encoding.split([3, 4, 2], dim=-1)
    R = quat_xyzw_to_matrix(quat)
    R_true, t_true = batch.T_world_cam[..., :3, :3], batch.T_world_cam[..., :3, 3]
    R_pairs, t_pairs = relative_motion(R, t)
    R_pairs_true, t_pairs_true = relative_motion(R_true, t_true)
    views = R.shape[1]
    # The motion of a view relative to itself has no error, so it is left out of the mean.
    others = views / (views - 1)
    baseline = t_pairs_true.norm(dim=-1, keepdim=True).clamp_min(SMALLEST_BASELINE)
    absolute = (R - R_true).abs().mean() + (t - t_true).abs().mean()
    weights = config.weights
    return {
        "rotation": weights.rotation * others * (R_pairs - R_pairs_true).abs().mean(),
        "translation": weights.translation * others * ((t_pairs - t_pairs_true) / baseline).abs().mean(),
        "absolute": weights.absolute * absolute,
        "field_of_view": weights.field_of_view * (fov - batch.fov_vh).abs().mean(),
    }


def zero_motion_rotation(batch: Batch) -> Tensor:
    """Return the rotation term, before its weight, of a model that predicts no motion."""
    R, t = batch.T_world_cam[..., :3, :3], batch.T_world_cam[..., :3, 3]
    views = R.shape[1]
    still = torch.eye(3, device=R.device)
    return views / (views - 1) * (relative_motion(R, t)[0] - still).abs().mean()


def relative_motion(R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Return R_i^T R_j (B, S, S, 3, 3) and R_i^T (t_j - t_i) (B, S, S, 3) of camera-to-world poses."""
    inverse = R.mT[:, :, None]
    return inverse @ R[:, None], (inverse @ (t[:, None] - t[:, :, None])[..., None])[..., 0]


def geometry_terms(read_outs: ReadOuts, features: Features, batch: Batch) -> tuple[Tensor, Tensor]:
    """Compare rays and points that a linear map predicts from the last features."""
    patch = batch.images.shape[-1] // features.grid_hw[1]
    targets = cell_targets(batch, patch // CELLS)
    tokens = features.levels[max(features.levels)][0]
    values = spread(read_outs.geometry(tokens), features.grid_hw, CELLS)
    direction, origin, point = values.split(3, dim=-1)
    origin_true = batch.T_world_cam[:, :, None, None, :3, 3]
    rays = (direction - targets.direction).abs().mean() + (origin - origin_true).abs().mean()
    return rays / 2, (point - targets.point).abs().mean()


def spread(values: Tensor, grid_hw: tuple[int, int], cells: int) -> Tensor:
    """Arrange the values of each patch's cells (B, S, P, cells^2 c) as an image (B, S, rows, columns, c)."""
    h, w = grid_hw
    by_patch = values.view(*values.shape[:2], h, w, cells, cells, -1)
    return by_patch.permute(0, 1, 2, 4, 3, 5, 6).flatten(4, 5).flatten(2, 3)


def cell_depth_term(read_outs: ReadOuts, features: Features, batch: Batch) -> Tensor:
    """Compare the log depth that a linear map predicts from the last features, in every view."""
    tokens = features.levels[max(features.levels)][0]
    log_depth = spread(read_outs.log_depth(tokens), features.grid_hw, DEPTH_CELLS)[..., 0]
    cell = batch.depth_z.shape[-1] // log_depth.shape[-1]
    middle = cell // 2
    return (log_depth - batch.depth_z[..., middle::cell, middle::cell].log()).abs().mean()


def pyramid(model: DA3, features: Features) -> list[Tensor]:
    """Return the dense head's maps of all views at once; `decode` reads a few at a time, which keeps a GPU waiting."""
    levels = [features.levels[i][0].flatten(0, 1) for i in model.config.out_layers]
    return model.head.pyramid(levels, features.grid_hw)


def read_depth(model: DA3, features: Features) -> tuple[Tensor, Tensor]:
    """Return depth and confidence (B, 1, H, W) of features of one view each."""
    maps = depth_maps(model.head.dense(pyramid(model, features), features.grid_hw))
    return maps["depth_z"][:, None], maps["conf"][:, None]


def depth_terms(depth_z: Tensor, conf: Tensor, depth_true: Tensor, config: TrainConfig) -> dict[str, Tensor]:
    """Compare log depth and its gradients; confidence learns the depth error, which is detached."""
    difference = depth_z.log() - depth_true.log()
    error = difference.abs()
    gradient = difference.diff(dim=-1).abs().mean() + difference.diff(dim=-2).abs().mean()
    return {
        "depth": config.weights.depth * error.mean(),
        "gradient": config.weights.gradient * gradient,
        "confidence": 0.1 * confidence_loss(conf, error),
    }


def confidence_loss(conf: Tensor, error: Tensor) -> Tensor:
    """Return the mean loss of a confidence that learns an error, which gets no gradient from it."""
    return (conf * error.detach() - CONFIDENCE_TARGET * conf.log()).mean()


def ray_branch_term(model: DA3, features: Features, batch: Batch, chosen: Choice) -> Tensor:
    """Train the ray branch of the dense head on detached features."""
    detached = replace(features, levels={i: (p.detach(), s.detach()) for i, (p, s) in features.levels.items()})
    maps = model.head.rays(pyramid(model, detached), features.grid_hw).permute(0, 2, 3, 1)[:, None]
    rays, raw_confidence = maps[..., :6], maps[..., 6]
    patch = batch.images.shape[-1] // features.grid_hw[1]
    direction = chosen.of(cell_targets(batch, patch // RAYS_PER_PATCH_SIDE).direction)
    origin = chosen.of(batch.T_world_cam)[..., None, None, :3, 3].expand_as(direction)
    error = (rays - torch.cat([direction, origin], dim=-1)).abs().mean(-1)
    return error.mean() + 0.1 * confidence_loss(confidence(raw_confidence), error)


def matching_term(read_outs: ReadOuts, features: Features, batch: Batch) -> Tensor:
    """Match each patch with its partner in another view (InfoNCE); hidden and outside points are left out."""
    views, device = batch.images.shape[1], batch.images.device
    # View 0 with all others, then the other neighbours.
    later = torch.arange(1, views, device=device)
    first, second = torch.cat([torch.zeros_like(later), later[:-1]]), torch.cat([later, later[1:]])
    target, visible = partners(batch, features.grid_hw, first, second)
    levels = sorted(features.levels)
    losses = []
    for index, read_out in zip(MATCH_LEVELS, read_outs.descriptors, strict=True):
        descriptor = F.normalize(read_out(features.levels[levels[index]][0]), dim=-1)
        logits = descriptor.index_select(1, first) @ descriptor.index_select(1, second).mT / MATCH_TEMPERATURE
        losses.append(F.cross_entropy(logits.flatten(0, 2), target.flatten(), reduction="none"))
    return (torch.stack(losses).mean(0) * visible.flatten()).sum() / visible.sum().clamp_min(1)


def position_term(read_outs: ReadOuts, features: Features, batch: Batch) -> Tensor:
    """Predict for each patch of the other views where the first view sees its point, in image widths and heights."""
    second = torch.arange(1, batch.images.shape[1], device=batch.images.device)
    seen = sightings(batch, features.grid_hw, second, torch.zeros_like(second))
    height, width = batch.depth_z.shape[-2:]
    row, column = seen.row_column.unbind(-1)
    target, visible = torch.stack([row / height, column / width], dim=-1) - 0.5, seen.visible[..., None]
    levels = sorted(features.levels)
    errors = [
        (read_out(features.levels[levels[index]][0][:, 1:]) - target).abs()
        for index, read_out in zip(POSITION_LEVELS, read_outs.reference_position, strict=True)
    ]
    return (torch.stack(errors).mean(0) * visible).sum() / visible.sum().clamp_min(1)


@dataclass(frozen=True, kw_only=True)
class Sightings:
    """Where the points of some views' patches appear in other views."""

    row_column: Tensor
    """(B, pairs, P, 2) pixels, the upper left corner is zero."""
    visible: Tensor
    """(B, pairs, P) bool: inside the image and not hidden."""


def partners(batch: Batch, grid_hw: tuple[int, int], first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Return for each patch of views `first` its patch in views `second` (B, pairs, P) and whether it is seen there."""
    seen = sightings(batch, grid_hw, first, second)
    patch = batch.depth_z.shape[-2] // grid_hw[0]
    row, column = (seen.row_column / patch).floor().long().unbind(-1)
    row, column = row.clamp(0, grid_hw[0] - 1), column.clamp(0, grid_hw[1] - 1)
    return row * grid_hw[1] + column, seen.visible


def sightings(batch: Batch, grid_hw: tuple[int, int], first: Tensor, second: Tensor) -> Sightings:
    """Project the middle of each patch of views `first` into views `second`."""
    height, width = batch.depth_z.shape[-2:]
    patch = height // grid_hw[0]
    points = cell_targets(batch, patch).point.flatten(2, 3)[:, first]
    T = batch.T_world_cam[:, second]
    camera = (points - T[..., None, :3, 3]) @ T[..., :3, :3]
    z = camera[..., 2].clamp_min(1e-3)
    focal = focal_lengths(batch.fov_vh[:, second], height, width)
    column = camera[..., 0] / z * focal[..., 1:] + width / 2
    row = camera[..., 1] / z * focal[..., :1] + height / 2
    inside = (camera[..., 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    pixel = row.clamp(0, height - 1).long() * width + column.clamp(0, width - 1).long()
    depth_there = batch.depth_z[:, second].flatten(-2).gather(-1, pixel)
    visible = inside & ((z - depth_there).abs() < VISIBLE_WITHIN * depth_there)
    return Sightings(row_column=torch.stack([row, column], dim=-1), visible=visible)
