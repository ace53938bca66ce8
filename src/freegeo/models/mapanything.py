"""MapAnything (docs/models/mapanything.md, "Stages" and what follows); its sizes are in mapanything_config.py.

A DINOv2 encoder reads each view alone; what is known of a view is added to its patches (mapanything_priors.py); 16
blocks attend in turn across all views (global) and within each view; a dense head reads rays, distances along them and
confidence, a pose head each view's pose, and a scale head one factor for the scene, which turns lengths into metres.
Modules carry the official key names.

Letters: B scenes, S views, V views of all scenes, P patches, N tokens of a view (P patches + 1 class token), D width,
H W pixels.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from freegeo.errors import UserError
from freegeo.geometry.rays import intrinsics_from_rays
from freegeo.geometry.rotation import quat_xyzw_to_matrix, rotate
from freegeo.geometry.se3 import from_Rt, inverse
from freegeo.models import mapanything_images
from freegeo.models.api import ReconstructionModel, Want, check_layers, check_want, level_tokens
from freegeo.models.dpt import Fusion, confidence, read_in_chunks, resize
from freegeo.models.images import encoded
from freegeo.models.mapanything_config import MapAnythingConfig
from freegeo.models.mapanything_priors import DenseEncoder, GlobalEncoder, Hints, hints_of
from freegeo.models.priors import usable
from freegeo.models.spec import MIXED, Mixed, ModelSpec
from freegeo.models.transformer import Block, PatchEmbed, block_linears, position_table, run_block
from freegeo.types import Features, ImageBatch, Prediction, Priors, ViewTokens

EPS = 1e-6
"""Epsilon of every LayerNorm of this model."""
TINY = 1e-8
FUSED, SCALE = "fused", "scale"
"""What the heads read besides the levels: the patches that the blocks across views begin with (B, S, P, D), and the
scene's token, repeated for every view (B, S, D)."""


class ImageEncoder(nn.Module):
    """DINOv2 without its last blocks and its norm; views do not see each other."""

    def __init__(self, config: MapAnythingConfig):
        super().__init__()
        width = config.width
        self.patch_embed = PatchEmbed(config.patch_size, width)
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, config.position_grid**2 + 1, width))
        self.blocks = nn.ModuleList(
            Block(width, config.heads, norm_eps=EPS, ffn="swiglu") for _ in range(config.encoder_depth)
        )
        self.position_grid = config.position_grid

    def forward(self, images_V3HW: Tensor, grid_hw: tuple[int, int]) -> Tensor:
        """Return tokens (V, N, D) of normalised images: the patches, then the class token."""
        x = torch.cat([self.cls_token.expand(len(images_V3HW), -1, -1), self.patch_embed(images_V3HW)], dim=1)
        x = x + self.position_embedding(grid_hw)
        for block in self.blocks:
            x = block(x)
        return torch.cat([x[:, 1:], x[:, :1]], dim=1)

    def position_embedding(self, grid_hw: tuple[int, int]) -> Tensor:
        """Return the embedding (1, 1 + P, D) of a patch grid, resized by a factor as in stock DINOv2."""
        rows, columns = ((n + 0.1) / self.position_grid for n in grid_hw)
        return position_table(self.pos_embed, grid_hw, scale_factor=(rows, columns))


class InfoSharing(nn.Module):
    """The blocks across views: even ones see all tokens of a scene, odd ones those of one view."""

    view_pos_table: Tensor

    def __init__(self, config: MapAnythingConfig):
        super().__init__()
        self.self_attention_blocks = nn.ModuleList(
            Block(config.width, config.heads, norm_eps=EPS, ffn="swiglu") for _ in range(config.depth)
        )
        self.norm = nn.LayerNorm(config.width, eps=EPS)
        # The sines and cosines of position 0, which upstream stores and does not train.
        self.register_buffer("view_pos_table", torch.tensor([[0.0, 1.0]]).repeat(1, config.width // 2))
        self.recompute = False
        """Keep only the inputs of the blocks for the backward pass."""

    def aggregate(
        self, x_BSND: Tensor, scale_token_D: Tensor, layers: Collection[int]
    ) -> tuple[dict[int, Tensor], Tensor]:
        """Return layer -> patches (B, S, P, D), and the scale token (B, D), after the norm.

        Nothing above the last layer is computed.
        """
        views = x_BSND.shape[:2]
        x_BSND = torch.cat([x_BSND[:, :1] + self.view_pos_table, x_BSND[:, 1:]], dim=1)
        scale_B1D = scale_token_D.expand(len(x_BSND), 1, -1)
        levels = {}
        for i in range(max(layers) + 1):
            block = self.self_attention_blocks[i]
            if i % 2 == 0:
                tokens = torch.cat([x_BSND.flatten(1, 2), scale_B1D], dim=1)
                tokens = run_block(block, tokens, None, recompute=self.recompute)
                x_BSND, scale_B1D = tokens[:, :-1].unflatten(1, (views[1], -1)), tokens[:, -1:]
            else:
                x_BSND = run_block(block, x_BSND.flatten(0, 1), None, recompute=self.recompute).unflatten(0, views)
            if i in layers:
                levels[i] = self.norm(x_BSND[:, :, :-1])
        return levels, self.norm(scale_B1D[:, 0])


class FeatureHead(nn.Module):
    """Turns four levels of patches into one map of F channels, eight times as large as the patch grid."""

    def __init__(self, config: MapAnythingConfig):
        super().__init__()
        features, (a, b, c, d) = config.head_features, config.head_channels
        sizes = [
            [nn.ConvTranspose2d(a, a, 4, stride=4)], [nn.ConvTranspose2d(b, b, 2, stride=2)], [],
            [nn.Conv2d(d, d, 3, stride=2, padding=1)],
        ]  # fmt: skip
        self.input_process = nn.ModuleList(
            nn.Sequential(
                nn.Sequential(nn.Conv2d(config.width, channels, 1), *size),
                nn.Conv2d(channels, features, 3, padding=1, bias=False),
            )
            for channels, size in zip((a, b, c, d), sizes, strict=True)
        )
        self.scratch = nn.ModuleDict(
            {f"refinenet{k}": Fusion(features, lateral=k < 4, rectified_skip=False) for k in (1, 2, 3, 4)}
        )

    def forward(self, levels_VPD: Sequence[Tensor], grid_hw: tuple[int, int]) -> Tensor:
        """Return the map (V, F, 8 h, 8 w); every step doubles the size, and the first one is cut to the patch grid."""
        maps = [
            process(tokens.transpose(1, 2).unflatten(2, grid_hw))
            for process, tokens in zip(self.input_process, levels_VPD, strict=True)
        ]
        rows, columns = grid_hw
        x = self.scratch["refinenet4"](maps[3], _doubled(maps[3]))[..., :rows, :columns]
        for k in (3, 2, 1):
            x = self.scratch[f"refinenet{k}"](x, _doubled(x), maps[k - 1])
        return x


def _doubled(x_VCHW: Tensor) -> tuple[int, int]:
    return 2 * x_VCHW.shape[-2], 2 * x_VCHW.shape[-1]


class Regressor(nn.Module):
    """Reads six numbers per pixel."""

    def __init__(self, features: int):
        super().__init__()
        half = features // 2
        self.conv1 = nn.Conv2d(features, half, 3, padding=1)
        self.conv2 = nn.Sequential(nn.Conv2d(half, half, 3, padding=1), nn.ReLU(), nn.Conv2d(half, 6, 1))

    def forward(self, x_VFhw: Tensor, image_hw: tuple[int, int]) -> Tensor:
        """Return (V, 6, H, W), no activation."""
        return self.conv2(resize(self.conv1(x_VFhw), image_hw))


class PoseUnit(nn.Module):
    """Three layers on every patch and a skip."""

    def __init__(self, channels: int):
        super().__init__()
        self.res_conv1, self.res_conv2, self.res_conv3 = (nn.Conv2d(channels, channels, 1) for _ in range(3))

    def forward(self, x: Tensor) -> Tensor:
        """Return x plus the three layers, each followed by a ReLU."""
        return x + self.res_conv3(self.res_conv2(self.res_conv1(x).relu()).relu()).relu()


class PoseHead(nn.Module):
    """Reads translation and quaternion (xyzw) of a view, camera to world, from the mean over its patches."""

    def __init__(self, config: MapAnythingConfig):
        super().__init__()
        channels = config.pose_hidden
        self.proj = nn.Conv2d(config.width, channels, 1)
        self.res_conv = nn.ModuleList(PoseUnit(channels) for _ in range(2))
        self.more_mlps = nn.Sequential(
            nn.Linear(channels, channels), nn.ReLU(), nn.Linear(channels, channels), nn.ReLU()
        )
        self.fc_t = nn.Linear(channels, 3)
        self.fc_rot = nn.Linear(channels, 4)

    def forward(self, patches_VPD: Tensor) -> Tensor:
        """Return (V, 7), no activation."""
        x = self.proj(patches_VPD.transpose(1, 2)[..., None])
        for unit in self.res_conv:
            x = unit(x)
        x = self.more_mlps(x.mean((-2, -1)))
        return torch.cat([self.fc_t(x), self.fc_rot(x)], dim=-1)


class ScaleHead(nn.Module):
    """Reads the logarithm of a factor from the scene's token."""

    def __init__(self, config: MapAnythingConfig):
        super().__init__()
        channels = config.scale_hidden
        self.proj = nn.Linear(config.width, channels)
        self.mlp = nn.Sequential(*(nn.Sequential(nn.Linear(channels, channels), nn.ReLU()) for _ in range(2)))
        self.output_proj = nn.Linear(channels, 1)

    def forward(self, token_VD: Tensor) -> Tensor:
        """Return (V,), no activation."""
        return self.output_proj(self.mlp(self.proj(token_VD)))[..., 0]


class MapAnything(ReconstructionModel):
    """MapAnything for any number of views, with lengths in metres; the first view is the reference."""

    feature_copies = 0

    def __init__(self, config: MapAnythingConfig, spec: ModelSpec):
        super().__init__()
        self.config, self.spec = config, spec
        self.feature_channels = width = config.width
        # Three maps of half of the channels at image size, and one of all at 8 per patch.
        self.peak_channels = config.head_features * (1.5 + (8 / config.patch_size) ** 2)
        self.encoder = nn.ModuleDict({"model": ImageEncoder(config)})
        self.ray_dirs_encoder, self.depth_encoder = (
            DenseEncoder(channels, config.dense_encoder, width, config.patch_size) for channels in (3, 1)
        )
        self.cam_rot_encoder, self.cam_trans_encoder, self.cam_trans_scale_encoder, self.depth_scale_encoder = (
            GlobalEncoder(channels, config.global_encoder, width) for channels in (4, 3, 1, 1)
        )
        self.fusion_norm_layer = nn.LayerNorm(width, eps=EPS)
        self.scale_token = nn.Parameter(torch.zeros(width))
        self.info_sharing = InfoSharing(config)
        self.dense_head = nn.ModuleList([FeatureHead(config), Regressor(config.head_features)])
        self.pose_head = PoseHead(config)
        self.scale_head = ScaleHead(config)

    @property
    def camera_token_name(self) -> None:
        """The reference view is marked by a constant."""
        return None

    def set_recompute(self, recompute: bool) -> None:
        """Turn per-block activation checkpointing on or off."""
        self.info_sharing.recompute = recompute

    def adapter_targets(self) -> list[str]:
        """Return all linears of the blocks across views."""
        return [
            name
            for i, block in enumerate(self.info_sharing.self_attention_blocks)
            for name in block_linears(f"info_sharing.self_attention_blocks.{i}", block)
        ]

    def preprocess(self, photos: Sequence, *, mixed: Mixed = MIXED, process_res: int | None = None) -> ImageBatch:
        """Cover one of ten sizes, and cut around the middle."""
        side, patch = process_res or self.spec.default_side, self.config.patch_size
        return mapanything_images.preprocess(photos, side=side, patch=patch, mixed=mixed)

    def embed(self, images: Tensor, *, layers: Collection[int] | None = None) -> ViewTokens:
        """Run the image encoder on images (B, S, 3, H, W) in [0, 1]; `layers` changes nothing.

        What is known of the views is added by `aggregate`.
        """
        return encoded(images, self.config.patch_size, cast(ImageEncoder, self.encoder["model"]))

    def aggregate(
        self,
        tokens: ViewTokens,
        *,
        layers: Collection[int] | None = None,
        reference: str = "first",
        priors: Priors | None = None,
    ) -> Features:
        """Add what is known to the patches, and run the blocks across views; UserError for any other reference.

        Of `priors` as much is used as `freegeo.models.priors.usable` says for these views.
        """
        if reference != "first":
            raise UserError(f"{self.spec.name} takes the first view as reference, not '{reference}'. Use 'first'.")
        priors = None if priors is None else usable(priors, self.spec)[0]
        return self.mix(tokens, layers, {} if priors is None else hints_of(priors, tokens.image_hw, self.spec.name))

    def mix(self, tokens: ViewTokens, layers: Collection[int] | None, hints: Hints) -> Features:
        """Run the blocks across views with hints; `layers` as in `aggregate`."""
        wanted = self.config.out_layers if layers is None else layers
        check_layers(wanted, self.config.depth, self.spec.name)
        fused = self.fuse(tokens.tokens[:, :, :-1], hints)
        x_BSND = torch.cat([fused, tokens.tokens[:, :, -1:]], dim=2)
        levels, scale_BD = self.info_sharing.aggregate(x_BSND, self.scale_token, wanted)
        none = fused[:, :, :0]
        is_whole = self.config.out_layers[-1] in levels
        return Features(
            levels={layer: (patches, none) for layer, patches in levels.items()},
            image_hw=tokens.image_hw,
            grid_hw=tokens.grid_hw,
            extra={FUSED: fused, SCALE: scale_BD[:, None].expand(-1, fused.shape[1], -1)} if is_whole else {},
        )

    def fuse(self, patches_BSPD: Tensor, hints: Hints) -> Tensor:
        """Add what is known of every view to its patches, and normalise them; in float32, also under autocast."""
        with torch.autocast(patches_BSPD.device.type, enabled=False):
            x_BSPD = patches_BSPD if patches_BSPD.dtype == torch.float64 else patches_BSPD.float()
            for name, (values, known_BS) in hints.items():
                values, known_BS = values.to(x_BSPD.dtype).to(x_BSPD.device), known_BS.to(x_BSPD.device)
                encoded = self.get_submodule(name)(values.flatten(0, 1)).unflatten(0, known_BS.shape)
                x_BSPD = x_BSPD + torch.where(known_BS[..., None, None], encoded, 0.0)
            return self.fusion_norm_layer(x_BSPD)

    def decode(self, features: Features, *, want: Collection[Want] = ("depth", "cameras")) -> Prediction:
        """Read out depth, cameras and (only if in `want`) world points, in float32 and in metres."""
        check_want(want, ("depth", "cameras", "points"), self.spec.name)
        levels, scale_BSD = self.dense_levels(features), features.extra[SCALE]
        with torch.autocast(scale_BSD.device.type, enabled=False):
            maps = read_in_chunks([*levels, scale_BSD], lambda chunk: self._read(chunk, features, want))
            factor_B = metres(self.scale_head(scale_BSD[:, 0].float()))
        return Prediction(**maps, scale=torch.stack([factor_B, torch.full_like(factor_B, torch.nan)], dim=-1))

    def _read(self, chunk: Sequence[Tensor], features: Features, want: Collection[Want]) -> dict[str, Tensor]:
        """Read some views: four levels (V, P, D) and the scene's token (V, D)."""
        *levels, scale_VD = chunk
        factor_V = metres(self.scale_head(scale_VD))
        rays, distance, conf, ambiguous = dense_maps(self.dense(levels, features.grid_hw))
        maps: dict[str, Tensor] = {}
        if "depth" in want:
            depth_z = factor_V[:, None, None] * distance * rays[..., 2]
            maps |= {"depth_z": depth_z, "conf": conf, "sky": ambiguous.to(conf.dtype)}
        if {"cameras", "points"} & set(want):
            T_world_cam = camera_to_world(self.pose_head(levels[-1]), factor_V)
            if "cameras" in want:
                maps |= {"T_cam_world": inverse(T_world_cam), "K": intrinsics_from_rays(rays)}
            if "points" in want:
                points = world_points(rays, distance, T_world_cam, factor_V)
                maps["points"] = torch.cat([points, conf[..., None]], dim=-1)
        return maps

    def dense_levels(self, features: Features) -> list[Tensor]:
        """Return the four levels of patches (B, S, P, D) that the dense head reads; UserError when one is missing."""
        levels = [patches for patches, _ in level_tokens(features, self.config.out_layers, self.spec.name)]
        return [features.extra[FUSED], *levels]

    def dense(self, levels_VPD: Sequence[Tensor], grid_hw: tuple[int, int]) -> Tensor:
        """Return the dense head's six numbers per pixel (V, 6, H, W), no activation."""
        feature_head, regressor = self.dense_head
        rows, columns = (n * self.config.patch_size for n in grid_hw)
        return regressor(feature_head(levels_VPD, grid_hw), (rows, columns))


def metres(raw: Tensor) -> Tensor:
    """Return the factor from the network's unit to metres, exp(raw), at least 1e-8."""
    return raw.exp().clamp(min=TINY)


def dense_maps(raw_V6HW: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return unit rays (V, H, W, 3), distances along them, confidence, and which pixels are ambiguous, (V, H, W)."""
    rays, distance, conf, clear = raw_V6HW.split([3, 1, 1, 1], dim=1)
    rays = F.normalize(rays, dim=1, eps=TINY).permute(0, 2, 3, 1)
    return rays, distance[:, 0].exp(), confidence(conf[:, 0]), clear[:, 0] <= 0


def camera_to_world(raw_V7: Tensor, factor_V: Tensor) -> Tensor:
    """Return poses (V, 4, 4), camera to world, of translations and quaternions, and the factor of lengths."""
    quat = F.normalize(raw_V7[:, 3:], dim=-1, eps=TINY)
    return from_Rt(quat_xyzw_to_matrix(quat), factor_V[:, None] * raw_V7[:, :3])


def world_points(rays: Tensor, distance: Tensor, T_world_cam: Tensor, factor_V: Tensor) -> Tensor:
    """Return the points (V, H, W, 3) at distances along rays, which a factor takes to the unit of the poses."""
    points = factor_V[:, None, None, None] * distance[..., None] * rays
    return rotate(T_world_cam[:, :3, :3], points) + T_world_cam[:, None, None, :3, 3]
