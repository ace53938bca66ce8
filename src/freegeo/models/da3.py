"""Depth Anything 3, any-view models (docs/models/da3.md, "Stages" and what follows); variants are in da3_config.py.

Those of single views, and the nested one, are in da3_metric.py.

Per-view blocks, then alternating per-view and global blocks; a dual dense head for depth and rays; a camera decoder,
and a camera encoder for known poses. Modules carry the official key names without the prefix `model.`.

Letters: B scenes, S views, N tokens of a view (1 special + P patches), D width, C feature channels (2D with the
per-view half), H W pixels.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import cast

import torch
from torch import Tensor, nn

from freegeo.errors import UserError
from freegeo.geometry.camera import decode_camera_to_world, encode_camera_to_world
from freegeo.geometry.rays import cameras_from_rays
from freegeo.geometry.se3 import normalise_poses
from freegeo.models import da3_images, reference
from freegeo.models.api import ReconstructionModel, Want, check_layers, check_want, level_tokens
from freegeo.models.da3_config import DA3Config
from freegeo.models.dpt import DenseHead, confidence, depth_maps, read_in_chunks
from freegeo.models.images import normalise, patch_grid
from freegeo.models.priors import require_usable
from freegeo.models.spec import MIXED, Mixed, ModelSpec
from freegeo.models.transformer import (
    Block,
    Mlp,
    PatchEmbed,
    block_linears,
    first_and_others,
    grid_rope,
    position_table,
    run_block,
)
from freegeo.types import Features, ImageBatch, Prediction, Priors, ViewTokens

SELECTION = "selection"
RAY_SEED = 0
"""Seed of the hypotheses in the search for cameras of rays."""


class Backbone(nn.Module):
    """The vision transformer: `embed` runs blocks 0 to alt_start - 1, `aggregate` the rest."""

    def __init__(self, config: DA3Config):
        super().__init__()
        self.config = config
        width, tokens = config.width, config.position_grid**2 + 1
        self.patch_embed = PatchEmbed(config.patch_size, width)
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        if config.cross_view:
            self.camera_token = nn.Parameter(torch.zeros(1, 2, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, tokens, width))
        self.blocks = nn.ModuleList(
            Block(width, config.heads, qk_norm=i >= config.qknorm_start, norm_eps=1e-6, ffn=config.ffn)
            for i in range(config.depth)
        )
        self.norm = nn.LayerNorm(width, eps=1e-5)
        self.recompute = False

    def is_global(self, index: int) -> bool:
        """Whether a block attends across views."""
        return index >= self.config.alt_start and index % 2 == 1

    def embed(self, images_VXHW: Tensor, keep: Collection[int]) -> tuple[Tensor, dict[str, Tensor]]:
        """Return tokens (V, N, D) before block alt_start and, by name, the earlier outputs that are needed."""
        grid_hw = patch_grid(images_VXHW, self.config.patch_size)
        patches = self.patch_embed(images_VXHW)
        x = torch.cat([self.cls_token.expand(len(patches), -1, -1), patches], dim=1)
        x = x + self.position_embedding(grid_hw).to(x.dtype)
        extra = {}
        for i in range(self.config.alt_start):
            x = self._run(i, x, grid_hw)
            if i in keep:
                extra[f"layer.{i}"] = x
            if self.config.cross_view and i == self.config.alt_start - 2:
                extra[SELECTION] = x[:, 0]
        return x, extra

    def aggregate(
        self,
        tokens: ViewTokens,
        layers: Collection[int],
        order: Tensor | None,
        camera_tokens_BSD: Tensor | None,
    ) -> dict[int, tuple[Tensor, Tensor]]:
        """Return layer -> (patches (B, S, P, C), special (B, S, 1, C)) in input order.

        `order` (B, S) lists the views with the reference first; None keeps the input order.
        """
        levels = {i: self._early_level(tokens, i) for i in layers if i < self.config.alt_start}
        if not self.config.cross_view:
            return levels
        x_BSND = tokens.tokens if order is None else reference.take_views(tokens.tokens, order)
        x_BSND = torch.cat([self._first_tokens(x_BSND, camera_tokens_BSD), x_BSND[:, :, 1:]], dim=2)
        local_BSND = x_BSND
        for i in range(self.config.alt_start, max(layers, default=-1) + 1):
            joined = x_BSND.flatten(1, 2) if self.is_global(i) else x_BSND.flatten(0, 1)
            x_BSND = self._run(i, joined, tokens.grid_hw).view_as(x_BSND)
            local_BSND = local_BSND if self.is_global(i) else x_BSND
            if i in layers:
                levels[i] = self._level(local_BSND, x_BSND, order)
        return levels

    def _run(self, index: int, x_BLD: Tensor, grid_hw: tuple[int, int]) -> Tensor:
        rope = None
        if index >= self.config.rope_start:
            layout = "flat" if self.is_global(index) else "grid"
            rope = grid_rope(grid_hw, 1, self.config.width // self.config.heads, layout, x_BLD.device)
        return run_block(self.blocks[index], x_BLD, rope, recompute=self.recompute)

    def _first_tokens(self, x_BSND: Tensor, camera_tokens_BSD: Tensor | None) -> Tensor:
        if camera_tokens_BSD is not None:
            return camera_tokens_BSD[:, :, None]
        return first_and_others(self.camera_token, *x_BSND.shape[:2])[:, :, None].to(x_BSND.dtype)

    def _early_level(self, tokens: ViewTokens, layer: int) -> tuple[Tensor, Tensor]:
        if f"layer.{layer}" not in tokens.extra:
            raise UserError(f"layer {layer} was not kept by `embed`. Name it in its `layers`.")
        return self._level(tokens.extra[f"layer.{layer}"], tokens.extra[f"layer.{layer}"], None)

    def _level(self, local_BSND: Tensor, x_BSND: Tensor, order: Tensor | None) -> tuple[Tensor, Tensor]:
        y = torch.cat([local_BSND, x_BSND], dim=-1) if self.config.cat_token else x_BSND
        if order is not None:
            y = reference.take_views(y, order.argsort(dim=1))
        patches = y[:, :, 1:]
        current = self.norm(patches[..., -self.config.width :])
        if self.config.cat_token:
            current = torch.cat([patches[..., : self.config.width], current], dim=-1)
        return current, y[:, :, :1]

    def position_embedding(self, grid_hw: tuple[int, int]) -> Tensor:
        """Return the embedding (1, N, D) of a patch grid."""
        # The 0.1 is part of the sampling scale that official checkpoints were trained with.
        rows, columns = ((n + 0.1) / self.config.position_grid for n in grid_hw)
        return position_table(self.pos_embed, grid_hw, scale_factor=(rows, columns))


class CameraDecoder(nn.Module):
    """Camera token -> translation, quaternion (xyzw), field of view (vertical, horizontal), camera to world."""

    def __init__(self, channels: int):
        super().__init__()
        self.backbone = nn.Sequential(
            nn.Linear(channels, channels), nn.ReLU(), nn.Linear(channels, channels), nn.ReLU()
        )
        self.fc_t = nn.Linear(channels, 3)
        self.fc_qvec = nn.Linear(channels, 4)
        self.fc_fov = nn.Sequential(nn.Linear(channels, 2), nn.ReLU())

    def forward(self, token: Tensor) -> Tensor:
        """Return the pose encoding (..., 9)."""
        z = self.backbone(token)
        return torch.cat([self.fc_t(z), self.fc_qvec(z), self.fc_fov(z)], dim=-1)


class CameraEncoder(nn.Module):
    """Known cameras -> the token each view starts the cross-view part with."""

    def __init__(self, width: int, depth: int, heads: int):
        super().__init__()
        self.pose_branch = Mlp(9, width // 2, width)
        self.token_norm = nn.LayerNorm(width, eps=1e-5)
        self.trunk = nn.Sequential(*(Block(width, heads, norm_eps=1e-5) for _ in range(depth)))
        self.trunk_norm = nn.LayerNorm(width, eps=1e-5)

    def forward(self, encoding_BS9: Tensor) -> Tensor:
        """Return tokens (B, S, D)."""
        return self.trunk_norm(self.trunk(self.token_norm(self.pose_branch(encoding_BS9))))


class DA3Images(ReconstructionModel):
    """What any-view and single-view models have in common: images, and the per-view blocks on them."""

    def __init__(self, config: DA3Config, spec: ModelSpec):
        super().__init__()
        self.config, self.spec = config, spec
        self.backbone = nn.ModuleDict({"pretrained": Backbone(config)})

    @property
    def _vit(self) -> Backbone:
        return cast(Backbone, self.backbone["pretrained"])

    def preprocess(self, photos: Sequence, *, mixed: Mixed = MIXED, process_res: int | None = None) -> ImageBatch:
        """Resize to the longest side, by default 504, then to the nearest multiples of the patch."""
        side, patch = process_res or self.spec.default_side, self.config.patch_size
        return da3_images.preprocess(photos, side=side, patch=patch, mixed=mixed)

    def embed(self, images: Tensor, *, layers: Collection[int] | None = None) -> ViewTokens:
        """Run the per-view blocks on images (B, S, 3, H, W) in [0, 1]."""
        wanted = self.config.out_layers if layers is None else layers
        batch = images.shape[:2]
        check_layers(wanted, self.config.depth, self.spec.name)
        tokens, extra = self._vit.embed(normalise(images).flatten(0, 1), wanted)
        return ViewTokens(
            tokens=tokens.unflatten(0, batch),
            extra={name: value.unflatten(0, batch) for name, value in extra.items()},
            image_hw=(images.shape[-2], images.shape[-1]),
            grid_hw=patch_grid(images, self.config.patch_size),
        )


class DA3(DA3Images):
    """Depth Anything 3 for any number of views."""

    published_adapter_root = "backbone.pretrained"

    def __init__(self, config: DA3Config, spec: ModelSpec):
        super().__init__(config, spec)
        self.head = DenseHead(
            channels_in=config.channels,
            features=config.head_features,
            out_channels=config.head_channels,
            outputs=2,
            patch_size=config.patch_size,
            ray_branch=True,
        )
        self.cam_enc = CameraEncoder(config.width, config.camera_encoder_depth, config.camera_encoder_heads)
        self.cam_dec = CameraDecoder(config.channels)

    @property
    def camera_token_name(self) -> str:
        """Name of the two learned tokens: reference view, other views."""
        return "backbone.pretrained.camera_token"

    def set_recompute(self, recompute: bool) -> None:
        """Turn per-block activation checkpointing on or off."""
        self._vit.recompute = recompute

    def adapter_targets(self) -> list[str]:
        """Return all linears of the blocks from alt_start on."""
        return [
            name
            for i, block in enumerate(self._vit.blocks)
            if i >= self.config.alt_start
            for name in block_linears(f"backbone.pretrained.blocks.{i}", block)
        ]

    def aggregate(
        self,
        tokens: ViewTokens,
        *,
        layers: Collection[int] | None = None,
        reference: str = "first",
        priors: Priors | None = None,
    ) -> Features:
        """Run the cross-view blocks; known cameras replace the learned tokens and make the first view the reference."""
        wanted = self.config.out_layers if layers is None else layers
        check_layers(wanted, self.config.depth, self.spec.name)
        if priors is None:
            return self.mix(tokens, wanted, self.view_order(tokens, reference), None)
        require_usable(priors, self.spec)
        assert priors.T_cam_world is not None
        assert priors.K is not None
        # Normalised in the precision they came in: a world far from its origin would lose digits in float32.
        poses, K = (x.to(tokens.tokens.device, torch.float32) for x in (normalise_poses(priors.T_cam_world), priors.K))
        return self.mix(tokens, wanted, None, self.encode_cameras(poses, K, tokens.image_hw))

    def mix(
        self, tokens: ViewTokens, layers: Collection[int], order: Tensor | None, camera_tokens: Tensor | None
    ) -> Features:
        """Run the cross-view blocks on views in an order (B, S); with camera tokens (B, S, D), or the learned ones."""
        levels = self._vit.aggregate(tokens, layers, order, camera_tokens)
        return Features(levels=levels, image_hw=tokens.image_hw, grid_hw=tokens.grid_hw)

    def view_order(self, tokens: ViewTokens, rule: str) -> Tensor | None:
        """Return the reference-first order (B, S), or None where the input order stays (fewer than 3 views)."""
        return reference.view_order(tokens.extra[SELECTION], rule)

    def encode_cameras(self, T_cam_world: Tensor, K: Tensor, image_hw: tuple[int, int]) -> Tensor:
        """Return camera tokens (B, S, D) of poses that are already normalised (`se3.normalise_poses`), and intrinsics.

        The principal points are not used.
        """
        with torch.autocast(K.device.type, enabled=False):
            return self.cam_enc(encode_camera_to_world(T_cam_world, K, image_hw))

    def decode(self, features: Features, *, want: Collection[Want] = ("depth", "cameras")) -> Prediction:
        """Read out depth, confidence, cameras and (only if in `want`) rays or the cameras of rays, in float32."""
        check_want(want, ("depth", "cameras", "ray_cameras", "rays"), self.spec.name)
        if {"cameras", "ray_cameras"} <= set(want):
            raise UserError("cameras come from the camera head or from the rays. Ask for one of both.")
        maps: dict[str, Tensor] = {}
        with torch.autocast(next(iter(features.levels.values()))[0].device.type, enabled=False):
            if {"depth", "rays", "ray_cameras"} & set(want):
                maps |= self._dense(features, want)
            if "cameras" in want:
                maps |= self._cameras(features)
            if "ray_cameras" in want:
                rays = maps["rays"] if "rays" in want else maps.pop("rays")
                # The same draws in every call, so that equal features give equal cameras.
                drawn = torch.Generator().manual_seed(RAY_SEED)
                found = cameras_from_rays(rays[..., :6], rays[..., 6], features.image_hw, generator=drawn)
                maps |= dict(zip(("T_cam_world", "K"), found, strict=True))
        return Prediction(**maps)

    def _cameras(self, features: Features) -> dict[str, Tensor]:
        [(_, special)] = level_tokens(features, self.config.out_layers[-1:], self.spec.name)
        token = special[..., 0, :].float()
        T_cam_world, K = decode_camera_to_world(self.cam_dec(token), features.image_hw)
        return {"T_cam_world": T_cam_world, "K": K}

    def _dense(self, features: Features, want: Collection[Want]) -> dict[str, Tensor]:
        levels = [patch for patch, _ in level_tokens(features, self.config.out_layers, self.spec.name)]
        return read_in_chunks(levels, lambda chunk: self._dense_chunk(chunk, features.grid_hw, want))

    def _dense_chunk(self, levels: list[Tensor], grid_hw: tuple[int, int], want: Collection[Want]) -> dict[str, Tensor]:
        pyramid = self.head.pyramid(levels, grid_hw)
        maps = {}
        if "depth" in want:
            maps |= depth_maps(self.head.dense(pyramid, grid_hw))
        if {"rays", "ray_cameras"} & set(want):
            directions_origins, conf = self.head.rays(pyramid, grid_hw).split([6, 1], dim=1)
            maps["rays"] = torch.cat([directions_origins, confidence(conf)], dim=1).permute(0, 2, 3, 1)
        return maps
