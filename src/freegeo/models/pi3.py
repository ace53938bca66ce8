"""Pi3 (docs/models/pi3.md, "Stages" and what follows); its sizes are in pi3_config.py, what Pi3X adds in pi3x.py.

A DINOv2 encoder reads each view alone; pairs of blocks then attend within each view and across all views; three
decoders of further blocks, each view alone, read out local points, confidence and a camera. All views are treated
alike: there is no reference view and no camera token. Modules carry the official key names.

Letters: B scenes, S views, V views of all scenes, P patches, R registers, N = R + P tokens of a view, D width,
C feature channels (2D: the block within the view, the block across views), H W pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from freegeo.geometry.local_points import K_from_local_points
from freegeo.geometry.rotation import closest_rotation
from freegeo.geometry.se3 import from_Rt, inverse, transform_points
from freegeo.models import pi3_images
from freegeo.models.api import ReconstructionModel, Want, check_layers, check_want, level_tokens
from freegeo.models.dpt import confidence, read_in_chunks
from freegeo.models.images import encoded
from freegeo.models.pi3_config import Pi3Config
from freegeo.models.priors import require_usable
from freegeo.models.reference import require_no_choice
from freegeo.models.spec import MIXED, Mixed, ModelSpec
from freegeo.models.transformer import Block, RegisterEncoder, Rope, block_linears, grid_rope, run_block
from freegeo.types import Features, ImageBatch, Prediction, Priors, ViewTokens

EPS = 1e-6
"""Of the norms of all blocks; those of queries and keys have their own."""

FIT_ARRAYS = 16
"""Numbers for each pixel of a view while its intrinsics are found."""


class HeadDecoder(nn.Module):
    """Further blocks that read the features of a view, registers included, for one of the heads."""

    def __init__(self, config: Pi3Config, out: int):
        super().__init__()
        self.projects = nn.Linear(config.channels, config.head_width)
        self.blocks = nn.ModuleList(
            Block(config.head_width, config.head_heads, norm_eps=EPS, scaled=False) for _ in range(config.head_depth)
        )
        self.linear_out = nn.Linear(config.head_width, out)
        self.head_dim = config.head_width // config.head_heads

    def forward(self, tokens_VNC: Tensor, grid_hw: tuple[int, int]) -> Tensor:
        """Return (V, N, out)."""
        special = tokens_VNC.shape[1] - grid_hw[0] * grid_hw[1]
        rope = grid_rope(grid_hw, special, self.head_dim, "grid", tokens_VNC.device)
        x = self.projects(tokens_VNC)
        for block in self.blocks:
            x = block(x, rope)
        return self.linear_out(x)

    def first_norm(self, tokens: Tensor) -> Tensor:
        """Return what the first block's attention reads of features (..., C)."""
        first = self.blocks[0]
        assert isinstance(first, Block)
        return first.norm1(self.projects(tokens))


class LinearHead(nn.Module):
    """One linear layer that writes all pixels of a patch."""

    def __init__(self, width: int, outputs: int, patch_size: int):
        super().__init__()
        self.patch_size = patch_size
        self.proj = nn.Linear(width, outputs * patch_size**2)

    def forward(self, tokens_VPD: Tensor, grid_hw: tuple[int, int]) -> Tensor:
        """Return maps (V, outputs, H, W)."""
        return F.pixel_shuffle(self.proj(tokens_VPD).transpose(1, 2).unflatten(2, grid_hw), self.patch_size)


class _ResidualMlp(nn.Module):
    def __init__(self, width: int):
        super().__init__()
        self.res_conv1, self.res_conv2, self.res_conv3 = (nn.Linear(width, width) for _ in range(3))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.res_conv3(self.res_conv2(self.res_conv1(x).relu()).relu()).relu()


class CameraHead(nn.Module):
    """Reads twelve numbers off the mean of a view's patches: a translation, and nine near a rotation matrix."""

    def __init__(self, width: int):
        super().__init__()
        self.res_conv = nn.ModuleList(_ResidualMlp(width) for _ in range(2))
        self.more_mlps = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.fc_t = nn.Linear(width, 3)
        self.fc_rot = nn.Linear(width, 9)

    def forward(self, tokens_VPD: Tensor) -> tuple[Tensor, Tensor]:
        """Return translations (V, 3) and the nine numbers (V, 9), camera to world."""
        for part in self.res_conv:
            tokens_VPD = part(tokens_VPD)
        pooled = self.more_mlps(tokens_VPD.mean(1))
        return self.fc_t(pooled), self.fc_rot(pooled)


def camera_to_world(translation: Tensor, nine: Tensor) -> Tensor:
    """Return transforms (..., 4, 4) from translations (..., 3) and nine numbers (..., 9).

    The numbers are a matrix, row by row; each row gets length 1, then the closest rotation is taken.
    """
    rows = F.normalize(nine.unflatten(-1, (3, 3)), dim=-1, eps=1e-12)
    return from_Rt(closest_rotation(rows), translation)


def local_points(raw_V3HW: Tensor, largest: float | None = None) -> Tensor:
    """Return points (V, H, W, 3) of the camera's frame from a ray's two slopes and the logarithm of the depth.

    `largest` bounds that logarithm, in Pi3X.
    """
    slopes, log_depth = raw_V3HW.split([2, 1], dim=1)
    depth = (log_depth if largest is None else log_depth.clamp(max=largest)).exp()
    return torch.cat([slopes * depth, depth], dim=1).permute(0, 2, 3, 1)


class Pi3(ReconstructionModel):
    """Permutation-equivariant geometry for any number of views, up to scale."""

    feature_copies = 1
    largest_log_depth: float | None = None

    def __init__(self, config: Pi3Config, spec: ModelSpec):
        super().__init__()
        self.config, self.spec = config, spec
        self.feature_channels, self.read_channels = config.head_width, config.channels
        # A block of a decoder, the feed-forward layer of which is four times as wide, beside what it reads; or the fit
        # of the intrinsics.
        self.peak_channels = max((2 * config.channels + 12 * config.head_width) / config.patch_size**2, FIT_ARRAYS)
        self.encoder = self._encoder()
        self.register_token = nn.Parameter(torch.zeros(1, 1, config.registers, config.width))
        self.decoder = nn.ModuleList(
            Block(config.width, config.heads, qk_norm=True, norm_eps=EPS) for _ in range(2 * config.pairs)
        )
        self.point_decoder = HeadDecoder(config, config.dense_out)
        self.conf_decoder = HeadDecoder(config, config.dense_out)
        self.camera_decoder = HeadDecoder(config, config.camera_out)
        self.camera_head = CameraHead(config.camera_out)
        self.point_head, self.conf_head = self._dense_heads()
        self.recompute = False
        """Keep only the inputs of the blocks for the backward pass."""

    def _encoder(self, channels: int = 3) -> RegisterEncoder:
        config = self.config
        return RegisterEncoder(
            config.width, depth=config.encoder_depth, heads=config.encoder_heads, registers=config.encoder_registers,
            patch_size=config.patch_size, position_grid=config.position_grid, channels=channels,
        )  # fmt: skip

    def _dense_heads(self) -> tuple[nn.Module, nn.Module]:
        """Return the heads of points (three maps) and of confidence (one)."""
        config = self.config
        points, conf = (LinearHead(config.dense_out, outputs, config.patch_size) for outputs in (3, 1))
        return points, conf

    @property
    def camera_token_name(self) -> None:
        """There is no camera token."""
        return

    def set_recompute(self, recompute: bool) -> None:
        """Turn per-block activation checkpointing on or off."""
        self.recompute = recompute

    def adapter_targets(self) -> list[str]:
        """Return all linears of the blocks within and across views."""
        return [name for i, block in enumerate(self.decoder) for name in block_linears(f"decoder.{i}", block)]

    def preprocess(self, photos: Sequence, *, mixed: Mixed = MIXED, process_res: int | None = None) -> ImageBatch:
        """Resize to the number of pixels that the model was trained with, the aspect kept up to whole patches.

        Another side asks for the number of pixels that a 4:3 photo of that side has.
        """
        config, factor = self.config, (process_res or self.spec.default_side) / self.spec.default_side
        pixels = round(config.pixels * factor**2)
        return pi3_images.preprocess(photos, patch=config.patch_size, pixels=pixels, mixed=mixed)

    def embed(self, images: Tensor, *, layers: Collection[int] | None = None) -> ViewTokens:
        """Run the patch encoder on images (B, S, 3, H, W) in [0, 1]; `layers` changes nothing."""
        return encoded(images, self.config.patch_size, self.encoder)

    def aggregate(
        self,
        tokens: ViewTokens,
        *,
        layers: Collection[int] | None = None,
        reference: str = "first",
        priors: Priors | None = None,
    ) -> Features:
        """Run the pairs of blocks; every pair is a level, and after them comes the readout that losses compare.

        UserError for priors, and for a rule of the reference view: all views are alike.
        """
        wanted = {self.config.last_pair} if layers is None else set(layers)
        check_layers(wanted, self.config.pairs + 1, self.spec.name)
        require_no_choice(reference, self.spec.name)
        if priors is not None:
            require_usable(priors, self.spec)
        levels = self._levels_of(tokens, priors, wanted)
        return Features(levels=levels, image_hw=tokens.image_hw, grid_hw=tokens.grid_hw)

    def _levels_of(
        self, tokens: ViewTokens, priors: Priors | None, wanted: set[int]
    ) -> dict[int, tuple[Tensor, Tensor]]:
        """Return the levels of tokens, with priors that this model can be told."""
        return self._levels(tokens.tokens, tokens.grid_hw, wanted)

    def _levels(
        self,
        patches_BSPD: Tensor,
        grid_hw: tuple[int, int],
        wanted: set[int],
        after_pair: Callable[[int, Tensor], Tensor] | None = None,
    ) -> dict[int, tuple[Tensor, Tensor]]:
        """Return level -> (patches (B, S, P, C), special (B, S, R, C)); nothing above the highest level is computed.

        `after_pair` may change the tokens (B, S, N, D) after a pair of that number.
        """
        batch, views = patches_BSPD.shape[:2]
        x_BSND = torch.cat([self.register_token.expand(batch, views, -1, -1), patches_BSPD], dim=2)
        rope = self._rope(grid_hw, patches_BSPD.device)
        special, last = self.config.registers, self.config.last_pair
        levels = {}
        for pair in range(min(max(wanted), last) + 1):
            within = run_block(self.decoder[2 * pair], x_BSND.flatten(0, 1), rope, recompute=self.recompute)
            within_BSND = within.view_as(x_BSND)
            across = run_block(self.decoder[2 * pair + 1], within_BSND.flatten(1, 2), rope, recompute=self.recompute)
            x_BSND = across.view_as(x_BSND)
            if after_pair is not None:
                x_BSND = after_pair(pair, x_BSND)
            if pair in wanted or (pair == last and self.config.readout in wanted):
                both = torch.cat([within_BSND, x_BSND], dim=-1)
                levels[pair] = (both[:, :, special:], both[:, :, :special])
        if self.config.readout in wanted:
            with torch.autocast(patches_BSPD.device.type, enabled=False):
                readout = self.point_decoder.first_norm(levels[last][0])
            # Registers have no part in it, since none of them is a camera token.
            levels[self.config.readout] = (readout, readout[:, :, :0])
        return {level: value for level, value in levels.items() if level in wanted}

    def _rope(self, grid_hw: tuple[int, int], device: torch.device) -> Rope:
        """Return the one table that serves every view and block."""
        return grid_rope(grid_hw, self.config.registers, self.config.width // self.config.heads, "grid", device)

    def decode(self, features: Features, *, want: Collection[Want] = ("depth", "cameras")) -> Prediction:
        """Read out depth, cameras and (only if in `want`) world points, in float32, each view alone.

        The intrinsics come from the local points, so cameras cost as much as depth.
        """
        check_want(want, ("depth", "cameras", "points"), self.spec.name)
        [(patches, special)] = level_tokens(features, (self.config.last_pair,), self.spec.name)
        with torch.autocast(patches.device.type, enabled=False):
            found = read_in_chunks((special, patches), lambda chunk: self._read(chunk, features, want))
            return self._prediction(found, self._metric(features), want)

    def _read(self, chunk: Sequence[Tensor], features: Features, want: Collection[Want]) -> dict[str, Tensor]:
        """Return local points (V, H, W, 3) and their confidence, and cameras, of a few views."""
        tokens_VNC = torch.cat(list(chunk), dim=1)
        special, grid_hw = self.config.registers, features.grid_hw
        maps = [
            head(decoder(tokens_VNC, grid_hw)[:, special:], grid_hw)
            for decoder, head in ((self.point_decoder, self.point_head), (self.conf_decoder, self.conf_head))
        ]
        found = {"points": local_points(maps[0], self.largest_log_depth), "conf": confidence(maps[1][:, 0])}
        if "cameras" in want:
            found["K"] = K_from_local_points(found["points"], maps[1][:, 0].sigmoid())
        if {"cameras", "points"} & set(want):
            camera = self.camera_head(self.camera_decoder(tokens_VNC, grid_hw)[:, special:])
            found["T_world_cam"] = camera_to_world(*camera)
        return found

    def _metric(self, features: Features) -> Tensor | None:
        """Return the factor (B,) that makes lengths metres; None where they are up to scale."""
        return None

    def _prediction(self, found: dict[str, Tensor], metric_B: Tensor | None, want: Collection[Want]) -> Prediction:
        points, conf, T_world_cam = found["points"], found["conf"], found.get("T_world_cam")
        maps = {"K": found["K"]} if "cameras" in want else {}
        if metric_B is not None:
            points = points * metric_B[:, None, None, None, None]
            maps["scale"] = torch.stack((metric_B, torch.full_like(metric_B, torch.nan)), dim=-1)
            if T_world_cam is not None:
                T_world_cam = from_Rt(T_world_cam[..., :3, :3], T_world_cam[..., :3, 3] * metric_B[:, None, None])
        if "depth" in want:
            maps |= {"depth_z": points[..., 2], "conf": conf}
        if "cameras" in want:
            assert T_world_cam is not None
            maps["T_cam_world"] = inverse(T_world_cam)
        if "points" in want:
            assert T_world_cam is not None
            maps["points"] = torch.cat([transform_points(T_world_cam, points), conf[..., None]], dim=-1)
        return Prediction(**maps)
