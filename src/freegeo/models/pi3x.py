"""What Pi3X has beside Pi3 (docs/models/pi3.md, "Pi3X"): metres, smoother maps, and what is known of the views.

Letters as in pi3.py.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

from freegeo.models.api import level_tokens
from freegeo.models.dpt import uv_axes
from freegeo.models.pi3 import EPS, Pi3
from freegeo.models.pi3_config import Pi3Config, Pi3XConfig
from freegeo.models.pi3_priors import Given, PoseTables, given_of, pose_tables, turn
from freegeo.models.spec import ModelSpec
from freegeo.models.transformer import Attention, LayerScale, Mlp, PatchEmbed, Rope, grid_rope, rotate
from freegeo.types import Features, Priors, ViewTokens

GROUP_EPS = 1e-5
GROUP_WIDTH = 32
"""Channels of a group inside a residual unit."""
LARGEST_LOG_DEPTH = 15.0


class _ResidualUnit(nn.Module):
    def __init__(self, width: int):
        super().__init__()
        inner = 2 * width
        self.layers = nn.Sequential(
            nn.GroupNorm(1, width, eps=GROUP_EPS),
            nn.ReLU(),
            _convolution(width, inner),
            nn.GroupNorm(inner // GROUP_WIDTH, inner, eps=GROUP_EPS),
            nn.ReLU(),
            _convolution(inner, width),
        )

    def forward(self, x: Tensor) -> Tensor:
        return x + self.layers(x)


class ConvHead(nn.Module):
    """Three levels, each twice as fine as the one before, then one branch for each group of output channels."""

    def __init__(self, width: int, outputs: tuple[int, ...], patch_size: int, config: Pi3XConfig):
        super().__init__()
        self.patch_size = patch_size
        widths = (width, *config.head_channels)
        self.upsample_blocks = nn.ModuleList(
            nn.Sequential(
                nn.Sequential(nn.ConvTranspose2d(before + 2, after, 2, stride=2), _convolution(after, after)),
                *(_ResidualUnit(after) for _ in range(config.head_units)),
            )
            for before, after in itertools.pairwise(widths)
        )
        self.output_block = nn.ModuleList(
            nn.Sequential(
                _convolution(widths[-1] + 2, config.head_hidden), nn.ReLU(), nn.Conv2d(config.head_hidden, count, 1)
            )
            for count in outputs
        )

    def forward(self, tokens_VPD: Tensor, grid_hw: tuple[int, int]) -> Tensor:
        """Return maps (V, outputs, H, W), the branches one after the other."""
        height, width = (n * self.patch_size for n in grid_hw)
        x = tokens_VPD.transpose(1, 2).unflatten(2, grid_hw)
        for level in self.upsample_blocks:
            x = level(with_uv(x, width / height))
        x = F.interpolate(x, (height, width), mode="bilinear", align_corners=False)
        x = with_uv(x, width / height)
        return torch.cat([branch(x) for branch in self.output_block], dim=1)


def _convolution(before: int, after: int) -> nn.Conv2d:
    return nn.Conv2d(before, after, 3, padding=1, padding_mode="replicate")


def with_uv(x_VCHW: Tensor, aspect: float) -> Tensor:
    """Append the normalised coordinates u and v of a map's pixels as two channels; `aspect` is the image's."""
    views, _, rows, columns = x_VCHW.shape
    u, v = (axis.to(x_VCHW.dtype).to(x_VCHW.device) for axis in uv_axes((rows, columns), aspect))
    uv = torch.stack((u.expand(rows, -1), v[:, None].expand(-1, columns)))
    return torch.cat([x_VCHW, uv.expand(views, -1, -1, -1)], dim=1)


class _CrossAttention(nn.Module):
    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.q_proj, self.k_proj, self.v_proj, self.proj = (nn.Linear(width, width) for _ in range(4))

    def forward(self, query_B1D: Tensor, context_BLD: Tensor, rope: Rope) -> Tensor:
        projected = (self.q_proj(query_B1D), self.k_proj(context_BLD), self.v_proj(context_BLD))
        q, k, v = (x.unflatten(-1, (self.heads, -1)).transpose(1, 2) for x in projected)
        return self.proj(F.scaled_dot_product_attention(q, rotate(k, rope), v).transpose(1, 2).flatten(2))


class _ScaleBlock(nn.Module):
    def __init__(self, width: int, heads: int):
        super().__init__()
        self.norm2, self.norm_y, self.norm3 = (nn.LayerNorm(width, eps=EPS) for _ in range(3))
        self.cross_attn = _CrossAttention(width, heads)
        self.mlp = Mlp(width, 4 * width)

    def forward(self, query_B1D: Tensor, context_BLD: Tensor, rope: Rope) -> Tensor:
        query_B1D = query_B1D + self.cross_attn(self.norm2(query_B1D), self.norm_y(context_BLD), rope)
        return query_B1D + self.mlp(self.norm3(query_B1D))


class ScaleDecoder(nn.Module):
    """One learned query per scene attends to the features of all its views."""

    def __init__(self, channels: int, config: Pi3XConfig):
        super().__init__()
        self.projects_x, self.projects_y = (nn.Linear(channels, config.scale_width) for _ in range(2))
        self.blocks = nn.ModuleList(
            _ScaleBlock(config.scale_width, config.scale_heads) for _ in range(config.scale_depth)
        )
        self.linear_out = nn.Linear(config.scale_width, config.scale_out)

    def forward(self, query_B1C: Tensor, features_BLC: Tensor, rope: Rope) -> Tensor:
        """Return (B, out); `rope` turns the keys of one view, the query stays."""
        query, context = self.projects_x(query_B1C), self.projects_y(features_BLC)
        for block in self.blocks:
            query = block(query, context, rope)
        return self.linear_out(query)[:, 0]


class _PoseAttention(Attention):
    """Attention between the views whose pose is known, in which tokens are turned by pose and place."""

    def attend(self, x_LD: Tensor, tables: PoseTables) -> Tensor:
        q, k, v = self.qkv(x_LD).unflatten(-1, (3, self.heads, -1)).permute(1, 2, 0, 3).unbind(0)
        q, k = (turn(self.q_norm(q), tables, "query"), turn(self.k_norm(k), tables, "value"))
        out = F.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), turn(v, tables, "value"))
        out = turn(out, tables, "output")
        return self.proj(out.transpose(0, 1).flatten(1))


class PoseInjection(nn.Module):
    """What known poses add to the patches of their views; attention and feed-forward layer are side by side."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.norm1, self.norm2 = (nn.LayerNorm(width, eps=EPS) for _ in range(2))
        self.attn = _PoseAttention(width, heads, qk_norm=True)
        self.mlp = Mlp(width, 4 * width)
        self.ls1, self.ls2 = LayerScale(width), LayerScale(width)

    def forward(self, patches_SPD: Tensor, tables: PoseTables) -> Tensor:
        """Return the term (S, P, D) for the patches of the posed views of one scene."""
        x_LD = patches_SPD.flatten(0, 1)
        term = self.ls1(self.attn.attend(self.norm1(x_LD), tables)) + self.ls2(self.mlp(self.norm2(x_LD)))
        return term.view_as(patches_SPD)


class Pi3X(Pi3):
    """Pi3 in metres, which can be told poses, intrinsics and depth of all views or of some."""

    largest_log_depth = LARGEST_LOG_DEPTH

    def __init__(self, config: Pi3Config, spec: ModelSpec):
        super().__init__(config, spec)
        x = self._x
        # The finest level at image size, as it is, with u and v, and with its border; or a unit of it at 8 per patch,
        # twice as wide inside.
        widest = max(3, 8 * (8 / config.patch_size) ** 2)
        self.peak_channels = max(self.peak_channels or 0, widest * x.head_channels[-1])
        self.metric_token = nn.Parameter(torch.zeros(1, 1, config.channels))
        self.metric_decoder = ScaleDecoder(config.channels, x)
        self.metric_head = nn.Linear(x.scale_out, 1)
        self.depth_encoder = self._encoder(channels=2)
        self.depth_emb = nn.Parameter(torch.zeros(1, 1, config.width))
        self.ray_embed = PatchEmbed(config.patch_size, config.width, channels=2)
        self.pose_inject_blk = nn.ModuleList(PoseInjection(config.width, config.heads) for _ in x.pose_pairs)

    @property
    def _x(self) -> Pi3XConfig:
        assert self.config.x is not None
        return self.config.x

    def _dense_heads(self) -> tuple[nn.Module, nn.Module]:
        config = self.config
        points, conf = (ConvHead(config.dense_out, outputs, config.patch_size, self._x) for outputs in ((2, 1), (1,)))
        return points, conf

    def _levels_of(
        self, tokens: ViewTokens, priors: Priors | None, wanted: set[int]
    ) -> dict[int, tuple[Tensor, Tensor]]:
        """Return the levels of tokens with what is known of the views.

        Scale and frame of the priors have no part in the result: its lengths are metres by the model's own estimate.
        """
        if priors is None:
            return super()._levels_of(tokens, priors, wanted)
        return self.levels_with(tokens, given_of(priors, tokens.image_hw, tokens.tokens.device), wanted)

    def levels_with(self, tokens: ViewTokens, given: Given, wanted: set[int]) -> dict[int, tuple[Tensor, Tensor]]:
        """Return the levels of tokens with what is given, prepared as the network reads it."""
        patches, grid_hw = tokens.tokens, tokens.grid_hw
        if given.rays is not None:
            rays, has_rays = given.rays
            found = self.ray_embed(rays.flatten(0, 1)).view_as(patches)
            patches = patches + torch.where(has_rays[..., None, None], found, 0)
        if given.depth is not None:
            depth, has_depth = given.depth
            found = self.depth_encoder(depth.flatten(0, 1), grid_hw).view_as(patches) + self.depth_emb
            patches = patches + torch.where(has_depth[..., None, None], found, 0)
        return self._levels(patches, grid_hw, wanted, lambda pair, x: self._with_poses(pair, x, given, grid_hw))

    def _with_poses(self, pair: int, x_BSND: Tensor, given: Given, grid_hw: tuple[int, int]) -> Tensor:
        if pair not in self._x.pose_pairs or given.T_cam_world is None:
            return x_BSND
        block = self.pose_inject_blk[self._x.pose_pairs.index(pair)]
        head_dim, special = self.config.width // self.config.heads, self.config.registers
        scenes = []
        for x_SND, T_S44, views in zip(x_BSND, given.T_cam_world, given.posed, strict=True):
            if not views:
                scenes.append(x_SND)
                continue
            tables = pose_tables(T_S44[views], grid_hw, head_dim)
            patches = x_SND[views, special:]
            if self.recompute and torch.is_grad_enabled():
                term = checkpoint(block, patches, tables, use_reentrant=False)
            else:
                term = block(patches, tables)
            changed = x_SND.clone()
            changed[views, special:] += term.to(x_SND.dtype)
            scenes.append(changed)
        return torch.stack(scenes)

    def _metric(self, features: Features) -> Tensor:
        [(patches, special)] = level_tokens(features, (self.config.last_pair,), self.spec.name)
        tokens = torch.cat([special, patches], dim=2).flatten(1, 2).float()
        head_dim = self._x.scale_width // self._x.scale_heads
        rope = grid_rope(features.grid_hw, self.config.registers, head_dim, "grid", tokens.device)
        hidden = self.metric_decoder(self.metric_token.expand(len(tokens), -1, -1), tokens, rope)
        return self.metric_head(hidden)[:, 0].exp()
