"""Depth Anything 3 of single views, and the nested model that gets its metres from one (docs/models/da3.md).

A single-view model knows depth and sky of each photo, and no cameras. The nested model is an any-view model beside a
metric single-view one: the latter's depth decides one scale for all lengths of the former.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence

import torch
from torch import Tensor

from freegeo.errors import UserError
from freegeo.models.api import ReconstructionModel, Want, check_layers, check_want, level_tokens
from freegeo.models.da3 import DA3, DA3Images
from freegeo.models.da3_config import DA3Config
from freegeo.models.dpt import DenseHead, read_in_chunks
from freegeo.models.reference import require_rule
from freegeo.models.spec import MIXED, Mixed, ModelSpec
from freegeo.types import Features, ImageBatch, Prediction, Priors, ViewTokens

logger = logging.getLogger(__name__)

SKY = 0.3
"""A pixel with at least this much sky is sky."""
FEWEST_PIXELS = 10
"""Sky is filled, and a scale found, from more pixels than these."""
FAR = 0.99
"""Quantile of the depth of everything else that sky gets."""
FARTHEST_M = 200.0
"""Largest depth of sky in metres."""
METRIC_FOCAL = 300.0
"""Focal length in pixels at which the metric model's depth is in metres."""
SMALLEST_METRIC, SMALLEST_DEPTH = 1e-2, 1e-3
"""Depths up to these, of the metric and of the any-view model, take no part in the scale."""
METRIC_DEPTH, METRIC_SKY = "metric.depth", "metric.sky"


class DA3SingleView(DA3Images):
    """Depth and sky of each photo by itself; no cameras, no confidence, nothing to adapt."""

    def __init__(self, config: DA3Config, spec: ModelSpec):
        super().__init__(config, spec)
        self.head = DenseHead(
            channels_in=config.channels,
            features=config.head_features,
            out_channels=config.head_channels,
            outputs=1,
            patch_size=config.patch_size,
            single_view=True,
        )

    @property
    def cross_view(self) -> None:
        """No part of it sees several views."""
        return

    @property
    def camera_token_name(self) -> None:
        """It has no camera token."""
        return

    def adapter_targets(self) -> list[str]:
        """Return nothing: an adapter acts on cross-view layers."""
        return []

    def aggregate(
        self,
        tokens: ViewTokens,
        *,
        layers: Collection[int] | None = None,
        reference: str = "first",
        priors: Priors | None = None,
    ) -> Features:
        """Hand on what `embed` kept of each view; there is no reference view. UserError for priors."""
        wanted = self.config.out_layers if layers is None else layers
        check_layers(wanted, self.config.depth, self.spec.name)
        require_rule(reference)
        if priors is not None:
            raise UserError(f"{self.spec.name} looks at each photo by itself and takes no known cameras.")
        levels = self._vit.aggregate(tokens, wanted, None, None)
        return Features(levels=levels, image_hw=tokens.image_hw, grid_hw=tokens.grid_hw)

    def decode(self, features: Features, *, want: Collection[Want] = ("depth",)) -> Prediction:
        """Read out depth and sky in float32; the depth of sky is filled with that of the farthest other pixels."""
        check_want(want, ("depth",), self.spec.name)
        maps = self.read_maps(features)
        return Prediction(depth_z=fill_sky(maps["depth_z"], maps["sky"]), sky=maps["sky"])

    def read_maps(self, features: Features) -> dict[str, Tensor]:
        """Return depth as the head gives it, also of sky, and sky, each (B, S, H, W)."""
        with torch.autocast(next(iter(features.levels.values()))[0].device.type, enabled=False):
            levels = [patch for patch, _ in level_tokens(features, self.config.out_layers, self.spec.name)]
            return read_in_chunks(levels, lambda chunk: self._read_chunk(chunk, features.grid_hw))

    def _read_chunk(self, levels: list[Tensor], grid_hw: tuple[int, int]) -> dict[str, Tensor]:
        depth, sky = self.head.dense(self.head.pyramid(levels, grid_hw), grid_hw).unbind(1)
        return {"depth_z": depth.exp(), "sky": sky.relu()}


class DA3Nested(ReconstructionModel):
    """An any-view model whose lengths a metric single-view model brings to metres.

    `embed` also runs the whole metric model, which sees one image at a time; its maps travel in `extra`.
    """

    def __init__(self, anyview: DA3Config, metric: DA3Config, spec: ModelSpec):
        super().__init__()
        self.spec = spec
        self.da3 = DA3(anyview, spec)
        self.da3_metric = DA3SingleView(metric, spec)

    @property
    def cross_view(self) -> ReconstructionModel:
        """The any-view part; it is described, and was loaded, as the whole."""
        self.da3.loaded_from = self.loaded_from
        return self.da3

    @property
    def camera_token_name(self) -> str:
        """Name of the two learned tokens of the any-view part."""
        return f"da3.{self.da3.camera_token_name}"

    def adapter_targets(self) -> list[str]:
        """Return those of the any-view part."""
        return [f"da3.{name}" for name in self.da3.adapter_targets()]

    def set_recompute(self, recompute: bool) -> None:
        """Turn per-block activation checkpointing of the any-view part on or off."""
        self.da3.set_recompute(recompute)

    def preprocess(self, photos: Sequence, *, mixed: Mixed = MIXED, process_res: int | None = None) -> ImageBatch:
        """Resize as the any-view part does."""
        return self.da3.preprocess(photos, mixed=mixed, process_res=process_res)

    def embed(self, images: Tensor, *, layers: Collection[int] | None = None) -> ViewTokens:
        """Embed for the any-view part, and predict metric depth and sky; the latter only if `layers` is None."""
        tokens = self.da3.embed(images, layers=layers)
        if layers is not None:
            return tokens
        maps = self.da3_metric.read_maps(self.da3_metric.aggregate(self.da3_metric.embed(images)))
        metric = {METRIC_DEPTH: maps["depth_z"], METRIC_SKY: maps["sky"]}
        return ViewTokens(
            tokens=tokens.tokens, extra={**tokens.extra, **metric}, image_hw=tokens.image_hw, grid_hw=tokens.grid_hw
        )

    def aggregate(
        self,
        tokens: ViewTokens,
        *,
        layers: Collection[int] | None = None,
        reference: str = "first",
        priors: Priors | None = None,
    ) -> Features:
        """Run the any-view part's cross-view blocks, and hand on the metric maps."""
        found = self.da3.aggregate(tokens, layers=layers, reference=reference, priors=priors)
        metric = {name: tokens.extra[name] for name in (METRIC_DEPTH, METRIC_SKY) if name in tokens.extra}
        return Features(levels=found.levels, image_hw=found.image_hw, grid_hw=found.grid_hw, extra=metric)

    def decode(self, features: Features, *, want: Collection[Want] = ("depth", "cameras")) -> Prediction:
        """Read out the any-view part in metres, with sky; a scale that cannot be found is a warning.

        Metres need depth and cameras: without one of both in `want`, lengths are up to scale.
        """
        found = self.da3.decode(features, want=want)
        if found.depth_z is None or found.K is None:
            return found
        if METRIC_DEPTH not in features.extra:
            raise UserError(f"{self.spec.name} lacks the metric depth. Embed the images without `layers`.")
        metric, sky = features.extra[METRIC_DEPTH].float(), features.extra[METRIC_SKY].float()
        return to_metres(found, fill_sky(metric, sky), sky)


def fill_sky(depth: Tensor, sky: Tensor) -> Tensor:
    """Give the sky of maps (B, S, H, W) the depth of the farthest other pixels, over all of them together."""
    away = sky >= SKY
    if away.sum() <= FEWEST_PIXELS or (~away).sum() <= FEWEST_PIXELS:
        return depth
    return torch.where(away, quantile(depth[~away], FAR), depth)


def to_metres(found: Prediction, metric: Tensor, sky: Tensor) -> Prediction:
    """Bring a prediction (B, S, ...) to the metres of a metric model, with one factor for all of it.

    Args:
        found: depth, confidence, cameras.
        metric: (B, S, H, W) depth of the metric model, as it gives it.
        sky: (B, S, H, W).

    Returns:
        The prediction with lengths multiplied, sky filled and given the least confidence, and the factor in `scale`.
        As it was, with `sky`, and a warning, when too few pixels have depth in both.
    """
    depth, conf, K, T = found.depth_z, found.conf, found.K, found.T_cam_world
    assert depth is not None and conf is not None and K is not None and T is not None
    metric = metric * ((K[..., 0, 0] + K[..., 1, 1]) / 2 / METRIC_FOCAL)[..., None, None]
    solid = sky < SKY
    sure = solid & (metric > SMALLEST_METRIC) & (depth > SMALLEST_DEPTH)
    if solid.any():
        sure &= conf >= quantile(conf[solid], 0.5)
    if sure.sum() <= FEWEST_PIXELS:
        logger.warning(
            "Lengths are up to scale, not metres: the metric model finds no depth to compare, such as in photos of sky."
        )
        return Prediction(depth_z=depth, conf=conf, K=K, T_cam_world=T, rays=found.rays, sky=sky)
    factor = _factor(metric, depth, sure)
    single = torch.stack([_factor(*one) for one in zip(*(x.flatten(0, 1) for x in (metric, depth, sure)), strict=True)])
    single = single[single > 0]
    spread = single.std() / factor if len(single) > 1 else factor.new_tensor(torch.nan)
    depth = depth * factor
    far = quantile(depth[solid], FAR).clamp(max=FARTHEST_M)
    moved = torch.cat([T[..., :3, :3], T[..., :3, 3:] * factor], dim=-1)
    rays = found.rays
    if rays is not None:
        rays = torch.cat([rays[..., :3], rays[..., 3:6] * factor, rays[..., 6:]], dim=-1)
    return Prediction(
        depth_z=torch.where(solid, depth, far),
        conf=torch.where(solid, conf, 1.0),
        T_cam_world=torch.cat([moved, T[..., 3:, :]], dim=-2),
        K=K,
        sky=sky,
        rays=rays,
        scale=torch.stack((factor, spread)).expand(len(depth), 2),
    )


def _factor(metric: Tensor, depth: Tensor, sure: Tensor) -> Tensor:
    """Least squares fit of metric = factor * depth over the sure pixels; 0 where there are none."""
    return (metric * depth)[sure].sum() / depth[sure].square().sum().clamp_min(1e-12)


def quantile(values: Tensor, share: float) -> Tensor:
    """Quantile with linear interpolation, of any number of values (`torch.quantile` refuses more than 16 million)."""
    ordered = values.flatten().sort().values
    place = share * (len(ordered) - 1)
    return ordered[int(place)].lerp(ordered[min(int(place) + 1, len(ordered) - 1)], place - int(place))
