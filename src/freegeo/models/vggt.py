"""VGGT (docs/models/vggt.md, "Stages" and what follows); its sizes are in vggt_config.py.

A DINOv2 encoder reads each view alone; 24 pairs of blocks then attend within each view (frame) and across all views
(global); a camera head refines nine numbers per view over four steps, and two dense heads read depth and world points.
Modules carry the official key names. The tracking head is not built.

Letters: B scenes, S views, V views of all scenes, P patches, N tokens of a view (1 camera + registers + P patches),
D width, C feature channels (2D: frame half, global half), H W pixels.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from freegeo.errors import UserError
from freegeo.geometry.camera import decode_world_to_camera
from freegeo.models import vggt_images
from freegeo.models.api import ReconstructionModel, Want, check_layers, check_want, level_tokens
from freegeo.models.dpt import DenseHead, confidence, depth_maps, read_in_chunks
from freegeo.models.images import encoded
from freegeo.models.priors import require_usable
from freegeo.models.spec import MIXED, Mixed, ModelSpec
from freegeo.models.transformer import (
    Block,
    Mlp,
    RegisterEncoder,
    block_linears,
    first_and_others,
    grid_rope,
    run_block,
)
from freegeo.models.vggt_config import VGGTConfig
from freegeo.types import Features, ImageBatch, Prediction, Priors, ViewTokens

BLOCK_EPS = 1e-5
MODULATED_EPS = 1e-6
CAMERA_STEPS = 4


class Aggregator(nn.Module):
    """The patch encoder and the blocks that alternate between one view and all views."""

    def __init__(self, config: VGGTConfig):
        super().__init__()
        self.config = config
        self.patch_embed = RegisterEncoder(
            config.width, depth=config.encoder_depth, heads=config.encoder_heads, registers=config.registers,
            patch_size=config.patch_size, position_grid=config.position_grid,
        )  # fmt: skip
        # From DINOv2's training and never read; it is here because checkpoints must match name by name.
        self.patch_embed.mask_token = nn.Parameter(torch.zeros(1, config.width))
        self.camera_token = nn.Parameter(torch.zeros(1, 2, 1, config.width))
        self.register_token = nn.Parameter(torch.zeros(1, 2, config.registers, config.width))
        self.frame_blocks, self.global_blocks = (
            nn.ModuleList(
                Block(config.width, config.heads, qk_norm=True, norm_eps=BLOCK_EPS) for _ in range(config.depth)
            )
            for _ in range(2)
        )
        self.recompute = False
        """Keep only the inputs of the frame and global blocks for the backward pass."""

    def aggregate(
        self, patches_BSPD: Tensor, grid_hw: tuple[int, int], layers: Collection[int]
    ) -> dict[int, tuple[Tensor, Tensor]]:
        """Return layer -> (patches (B, S, P, C), special (B, S, T, C)); nothing above the last layer is computed."""
        batch, views = patches_BSPD.shape[:2]
        learned = (first_and_others(t, batch, views) for t in (self.camera_token, self.register_token))
        x_BSND = torch.cat([*learned, patches_BSPD], dim=2)
        special, head_dim = self.config.special, self.config.width // self.config.heads
        # Global blocks rotate by the position within each view, too: one table serves every view and block.
        rope = grid_rope(grid_hw, special, head_dim, "grid", patches_BSPD.device)
        levels = {}
        for i in range(max(layers) + 1):
            frame = run_block(self.frame_blocks[i], x_BSND.flatten(0, 1), rope, recompute=self.recompute)
            frame_BSND = frame.view_as(x_BSND)
            mixed = run_block(self.global_blocks[i], frame_BSND.flatten(1, 2), rope, recompute=self.recompute)
            x_BSND = mixed.view_as(x_BSND)
            if i in layers:
                patches, tokens = (
                    torch.cat([frame_BSND[:, :, part], x_BSND[:, :, part]], dim=-1)
                    for part in (slice(special, None), slice(special))
                )
                levels[i] = (patches, tokens)
        return levels


class CameraHead(nn.Module):
    """Refines translation, quaternion (xyzw) and field of view (vertical, horizontal), world to camera."""

    def __init__(self, channels: int, depth: int, heads: int):
        super().__init__()
        self.empty_pose_tokens = nn.Parameter(torch.zeros(1, 1, 9))
        self.trunk = nn.Sequential(*(Block(channels, heads, norm_eps=BLOCK_EPS) for _ in range(depth)))
        self.token_norm = nn.LayerNorm(channels, eps=BLOCK_EPS)
        self.trunk_norm = nn.LayerNorm(channels, eps=BLOCK_EPS)
        self.embed_pose = nn.Linear(9, channels)
        self.poseLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(channels, 3 * channels))
        self.pose_branch = Mlp(channels, channels // 2, 9)

    def forward(self, token_BSC: Tensor, steps: int = CAMERA_STEPS) -> list[Tensor]:
        """Return the pose encoding (B, S, 9) after every step; views of a scene attend to each other.

        What is fed back is the sum of all corrections before the field of view is clipped at 0, and no gradient
        flows from one step into the one before.
        """
        token_BSC = self.token_norm(token_BSC)
        fed_back_BS9 = self.empty_pose_tokens.expand(*token_BSC.shape[:2], -1)
        total_BS9 = torch.zeros_like(fed_back_BS9)
        encodings = []
        for _ in range(steps):
            total_BS9 = total_BS9.detach() + self._correction(token_BSC, fed_back_BS9)
            fed_back_BS9 = total_BS9.detach()
            encodings.append(torch.cat([total_BS9[..., :7], total_BS9[..., 7:].relu()], dim=-1))
        return encodings

    def _correction(self, token_BSC: Tensor, pose_BS9: Tensor) -> Tensor:
        shift, scale, gate = self.poseLN_modulation(self.embed_pose(pose_BS9)).chunk(3, dim=-1)
        plain = F.layer_norm(token_BSC, token_BSC.shape[-1:], eps=MODULATED_EPS)
        y = token_BSC + gate * (plain * (1 + scale) + shift)
        return self.pose_branch(self.trunk_norm(self.trunk(y)))


class VGGT(ReconstructionModel):
    """Visual geometry grounded transformer for any number of views; the first view is the reference."""

    feature_copies = 0

    def __init__(self, config: VGGTConfig, spec: ModelSpec):
        super().__init__()
        self.config, self.spec = config, spec
        self.aggregator = Aggregator(config)
        self.camera_head = CameraHead(config.channels, config.camera_depth, config.camera_heads)
        self.depth_head = self._dense_head(outputs=2)
        self.point_head = self._dense_head(outputs=4)

    def _dense_head(self, outputs: int) -> DenseHead:
        return DenseHead(
            channels_in=self.config.channels,
            features=self.config.head_features,
            out_channels=self.config.head_channels,
            outputs=outputs,
            patch_size=self.config.patch_size,
            rectified_skip=True,
        )

    @property
    def camera_token_name(self) -> str:
        """Name of the two learned tokens: first view, other views."""
        return "aggregator.camera_token"

    def set_recompute(self, recompute: bool) -> None:
        """Turn per-block activation checkpointing on or off."""
        self.aggregator.recompute = recompute

    def adapter_targets(self) -> list[str]:
        """Return all linears of the frame and global blocks."""
        return [
            name
            for kind in ("frame_blocks", "global_blocks")
            for i, block in enumerate(getattr(self.aggregator, kind))
            for name in block_linears(f"aggregator.{kind}.{i}", block)
        ]

    def preprocess(self, photos: Sequence, *, mixed: Mixed = MIXED, process_res: int | None = None) -> ImageBatch:
        """Resize to the longest side, by default 504, the aspect kept up to whole patches, as in the benchmark."""
        side, patch = process_res or self.spec.default_side, self.config.patch_size
        return vggt_images.preprocess(photos, side=side, patch=patch, mixed=mixed)

    def embed(self, images: Tensor, *, layers: Collection[int] | None = None) -> ViewTokens:
        """Run the patch encoder on images (B, S, 3, H, W) in [0, 1].

        Every layer mixes views, so `layers` changes nothing. The special tokens depend on the order of the views and
        are added by `aggregate`.
        """
        return encoded(images, self.config.patch_size, self.aggregator.patch_embed)

    def aggregate(
        self,
        tokens: ViewTokens,
        *,
        layers: Collection[int] | None = None,
        reference: str = "first",
        priors: Priors | None = None,
    ) -> Features:
        """Run the frame and global blocks; UserError for priors and for any reference but the first view."""
        wanted = self.config.out_layers if layers is None else layers
        check_layers(wanted, self.config.depth, self.spec.name)
        if reference != "first":
            raise UserError(f"{self.spec.name} takes the first view as reference, not '{reference}'. Use 'first'.")
        if priors is not None:
            require_usable(priors, self.spec)
        levels = self.aggregator.aggregate(tokens.tokens, tokens.grid_hw, wanted)
        return Features(levels=levels, image_hw=tokens.image_hw, grid_hw=tokens.grid_hw)

    def decode(self, features: Features, *, want: Collection[Want] = ("depth", "cameras")) -> Prediction:
        """Read out depth, cameras and (only if in `want`) world points, in float32."""
        check_want(want, ("depth", "cameras", "points"), self.spec.name)
        levels = level_tokens(features, self.config.out_layers, self.spec.name)
        patches = [patch for patch, _ in levels]
        maps: dict[str, Tensor] = {}
        with torch.autocast(patches[0].device.type, enabled=False):
            if "cameras" in want:
                encoding = self.camera_head(levels[-1][1][..., 0, :].float())[-1]
                T_cam_world, K = decode_world_to_camera(encoding, features.image_hw)
                maps |= {"T_cam_world": T_cam_world, "K": K}
            if "depth" in want:
                maps |= read_in_chunks(patches, lambda chunk: depth_maps(self._dense(self.depth_head, chunk, features)))
            if "points" in want:
                maps |= read_in_chunks(patches, lambda chunk: point_map(self._dense(self.point_head, chunk, features)))
        return Prediction(**maps)

    @staticmethod
    def _dense(head: DenseHead, levels_VPC: list[Tensor], features: Features) -> Tensor:
        return head.dense(head.pyramid(levels_VPC, features.grid_hw), features.grid_hw)


def point_map(raw_V4HW: Tensor) -> dict[str, Tensor]:
    """Return world points sign(z) (exp|z| - 1) and their confidence, (V, H, W, 4), under their name in a prediction."""
    z, conf = raw_V4HW.split([3, 1], dim=1)
    points = z.sign() * z.abs().expm1()
    return {"points": torch.cat([points, confidence(conf)], dim=1).permute(0, 2, 3, 1)}
