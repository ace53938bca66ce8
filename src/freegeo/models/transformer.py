"""The one ViT block of every model here, with the two-axis RoPE.

Letters: B batch (views or scenes), L tokens in one attention, N tokens of one view, H heads, d head width, D width.

Sources: docs/models/da3.md, "Backbone"; docs/models/da3.md, "Rotary positions"; docs/models/vggt.md, "Blocks".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

HEAD_NORM_EPS = 1e-5
ENCODER_EPS = 1e-6
"""Of DINOv2's norms."""
ROPE_BASE = 100.0


@dataclass(frozen=True)
class Rope:
    """Rotation tables of one view's tokens, used for every view of the batch."""

    cos_Nd: Tensor
    sin_Nd: Tensor


def rope_table(positions_N2: Tensor, head_dim: int) -> Rope:
    """Build the tables for integer (row, column) positions; the first half of the head turns with the row.

    Frequencies are 100^(-2j/d) over each half of width d = head_dim / 2; a head width that 4 does not divide
    raises ValueError.
    """
    if head_dim % 4:
        raise ValueError(f"two-axis RoPE needs a head width divisible by 4, got {head_dim}")
    exponent = torch.arange(0, head_dim // 2, 2, device=positions_N2.device, dtype=torch.float32) / (head_dim // 2)
    angles_N2f = positions_N2[:, :, None].float() * ROPE_BASE**-exponent
    angles_Nd = angles_N2f.repeat(1, 1, 2).flatten(1)
    return Rope(angles_Nd.cos(), angles_Nd.sin())


@lru_cache(maxsize=32)
def grid_rope(
    grid_hw: tuple[int, int], special: int, head_dim: int, layout: Literal["grid", "flat"], device: torch.device
) -> Rope:
    """Return the tables of a view: special tokens at (0, 0), patches at (row + 1, column + 1).

    With `layout="flat"` every patch sits at (1, 1), which is how DA3 rotates across views.
    """
    # Cached tables must stay usable under autograd when the first call happened in inference mode.
    with torch.inference_mode(False):
        rows, columns = torch.meshgrid(*(torch.arange(1, n + 1, device=device) for n in grid_hw), indexing="ij")
        patches = torch.stack([rows, columns], dim=-1).flatten(0, 1)
        if layout == "flat":
            patches = torch.ones_like(patches)
        return rope_table(F.pad(patches, (0, 0, special, 0)), head_dim)


def rotate(x_BHLd: Tensor, rope: Rope) -> Tensor:
    """Turn queries or keys; L is a whole number of views of N tokens each."""
    x_BHSNd = x_BHLd.unflatten(2, (-1, rope.cos_Nd.shape[0]))
    first, second = x_BHSNd.unflatten(-1, (2, 2, -1)).unbind(-2)
    turned = torch.stack([-second, first], dim=-2).flatten(-3)
    return (x_BHSNd * rope.cos_Nd + turned * rope.sin_Nd).flatten(2, 3)


class Attention(nn.Module):
    """Multi-head self-attention; queries and keys are normalised first and rotated second."""

    def __init__(self, width: int, heads: int, *, qk_norm: bool):
        super().__init__()
        self.heads = heads
        head_dim = width // heads
        self.qkv = nn.Linear(width, 3 * width)
        self.q_norm = nn.LayerNorm(head_dim, eps=HEAD_NORM_EPS) if qk_norm else nn.Identity()
        self.k_norm = nn.LayerNorm(head_dim, eps=HEAD_NORM_EPS) if qk_norm else nn.Identity()
        self.proj = nn.Linear(width, width)

    def forward(self, x_BLD: Tensor, rope: Rope | None) -> Tensor:
        """Attend over the L tokens of each batch entry."""
        q, k, v = self.qkv(x_BLD).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4).unbind(0)
        q, k = self.q_norm(q), self.k_norm(k)
        if rope is not None:
            q, k = rotate(q, rope), rotate(k, rope)
        out_BHLd = F.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v)
        return self.proj(out_BHLd.transpose(1, 2).flatten(2))


class Mlp(nn.Module):
    """Two linears with the exact (erf) GELU between them."""

    def __init__(self, width: int, hidden: int, out: int | None = None):
        super().__init__()
        self.fc1 = nn.Linear(width, hidden)
        self.fc2 = nn.Linear(hidden, out or width)

    def forward(self, x: Tensor) -> Tensor:
        """Return fc2(gelu(fc1(x))), over the last axis."""
        return self.fc2(F.gelu(self.fc1(x)))


class SwiGlu(nn.Module):
    """Gated feed-forward: the first half of `w12` passes through SiLU and gates the second."""

    def __init__(self, width: int):
        super().__init__()
        hidden = (2 * 4 * width // 3 + 7) // 8 * 8
        self.w12 = nn.Linear(width, 2 * hidden)
        self.w3 = nn.Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        """Return w3(silu(first half of w12(x)) * second half), over the last axis."""
        gate, value = self.w12(x).chunk(2, dim=-1)
        return self.w3(F.silu(gate) * value)


class LayerScale(nn.Module):
    """A learned factor per channel, which scales what a block adds to the residual stream."""

    def __init__(self, width: int):
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        """Multiply the channels, the last axis, by their factors."""
        return x * self.gamma


class Block(nn.Module):
    """Pre-norm residual block, with LayerScale unless `scaled` is off."""

    def __init__(
        self,
        width: int,
        heads: int,
        *,
        qk_norm: bool = False,
        norm_eps: float,
        ffn: Literal["mlp", "swiglu"] = "mlp",
        scaled: bool = True,
    ):
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=norm_eps)
        self.attn = Attention(width, heads, qk_norm=qk_norm)
        self.ls1 = LayerScale(width) if scaled else nn.Identity()
        self.norm2 = nn.LayerNorm(width, eps=norm_eps)
        self.mlp = Mlp(width, 4 * width) if ffn == "mlp" else SwiGlu(width)
        self.ls2 = LayerScale(width) if scaled else nn.Identity()

    def forward(self, x_BLD: Tensor, rope: Rope | None = None) -> Tensor:
        """Run attention, then the feed-forward layer."""
        x_BLD = x_BLD + self.ls1(self.attn(self.norm1(x_BLD), rope))
        return x_BLD + self.ls2(self.mlp(self.norm2(x_BLD)))


def run_block(block: nn.Module, x_BLD: Tensor, rope: Rope | None, *, recompute: bool) -> Tensor:
    """Run a block, keeping only its input for the backward pass when `recompute` is on."""
    if recompute and torch.is_grad_enabled():
        return checkpoint(block, x_BLD, rope, use_reentrant=False)
    return block(x_BLD, rope)


class PatchEmbed(nn.Module):
    """Non-overlapping patches through one convolution, rows first."""

    def __init__(self, patch_size: int, width: int, *, channels: int = 3):
        super().__init__()
        self.proj = nn.Conv2d(channels, width, patch_size, patch_size)

    def forward(self, images_BCHW: Tensor) -> Tensor:
        """Return patch tokens (B, P, D)."""
        return self.proj(images_BCHW).flatten(2).transpose(1, 2)


class RegisterEncoder(nn.Module):
    """DINOv2 with register tokens, as VGGT and Pi3 have it; views do not see each other."""

    def __init__(
        self,
        width: int,
        *,
        depth: int,
        heads: int,
        registers: int,
        patch_size: int,
        position_grid: int,
        channels: int = 3,
    ):
        super().__init__()
        self.registers = registers
        self.patch_embed = PatchEmbed(patch_size, width, channels=channels)
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, position_grid**2 + 1, width))
        self.register_tokens = nn.Parameter(torch.zeros(1, registers, width))
        self.blocks = nn.ModuleList(Block(width, heads, norm_eps=ENCODER_EPS) for _ in range(depth))
        self.norm = nn.LayerNorm(width, eps=ENCODER_EPS)

    def forward(self, images_VCHW: Tensor, grid_hw: tuple[int, int]) -> Tensor:
        """Return patch tokens (V, P, D) of normalised images."""
        views = len(images_VCHW)
        x = torch.cat([self.cls_token.expand(views, -1, -1), self.patch_embed(images_VCHW)], dim=1)
        # Unlike stock DINOv2's, the table of positions is resized to the grid's size, with antialiasing.
        x = x + position_table(self.pos_embed, grid_hw, size=grid_hw, antialias=True)
        # Only the class token and the patches have positions, so the registers come in afterwards.
        x = torch.cat([x[:, :1], self.register_tokens.expand(views, -1, -1), x[:, 1:]], dim=1)
        for block in self.blocks:
            x = block(x)
        return self.norm(x)[:, 1 + self.registers :]


def position_table(
    pos_embed_1ND: Tensor,
    grid_hw: tuple[int, int],
    *,
    size: tuple[int, int] | None = None,
    scale_factor: tuple[float, float] | None = None,
    antialias: bool = False,
) -> Tensor:
    """Return the learned positions (1, 1 + h w, D) of a patch grid, class token first.

    The stored table is a square grid behind the class token's entry. It is used as it is for its own grid, and resized
    bicubically for any other; `size` or `scale_factor`, and `antialias`, are those of `interpolate`.
    """
    side = math.isqrt(pos_embed_1ND.shape[1] - 1)
    if grid_hw == (side, side):
        return pos_embed_1ND
    grid = pos_embed_1ND[:, 1:].unflatten(1, (side, side)).permute(0, 3, 1, 2).float()
    resized = F.interpolate(grid, size, scale_factor, mode="bicubic", align_corners=False, antialias=antialias)
    return torch.cat([pos_embed_1ND[:, :1], resized.flatten(2).transpose(1, 2)], dim=1)


def first_and_others(tokens_12X: Tensor, batch: int, views: int) -> Tensor:
    """Give the first view of every scene the first of two learned tokens, all others the second: (B, S, ...)."""
    per_view = torch.cat([tokens_12X[:, :1], *[tokens_12X[:, 1:]] * (views - 1)], dim=1)
    return per_view.expand(batch, *per_view.shape[1:])


def block_linears(prefix: str, block: nn.Module) -> list[str]:
    """Return the names of the four linears of a block that an adapter may sit on."""
    return [f"{prefix}.{name}" for name, module in block.named_modules() if isinstance(module, nn.Linear)]


def initialise(model: nn.Module, generator: torch.Generator) -> None:
    """Give a model built without a checkpoint its starting weights: truncated normals, zero biases, unit norms."""
    for name, parameter in model.named_parameters():
        if parameter.ndim < 2:
            continue
        std = 0.02 if parameter.ndim == 2 or "token" in name or "embed" in name else parameter[0].numel() ** -0.5
        with torch.no_grad():
            parameter.copy_(torch.nn.init.trunc_normal_(torch.empty_like(parameter), std=std, generator=generator))
    for module in model.modules():
        if isinstance(module, nn.Linear | nn.Conv2d | nn.ConvTranspose2d) and module.bias is not None:
            nn.init.zeros_(module.bias)
