"""The one dense head (DPT) of every model here.

Four feature levels become a pyramid, are fused from coarse to fine and read out at image resolution. Letters:
V views (batch and views flattened), P patches, C channels in, F head features, `grid` (h, w) in patches.

Sources: docs/models/da3.md, "Dense head", and docs/models/vggt.md, "Dense heads".
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import lru_cache

import torch
from torch import Tensor, nn
from torch.nn import functional as F

HIDDEN = 32
VIEWS_PER_CHUNK = 8
"""Views are independent in a dense head; more at once only cost memory."""
RAY_CHANNELS = 7


def uv_axes(map_hw: tuple[int, int], aspect: float) -> tuple[Tensor, Tensor]:
    """Return the normalised coordinates u (W,) and v (H,) of a map's pixels, float64; the half diagonal is 1."""
    diagonal = (aspect**2 + 1) ** 0.5
    ends = (half * (n - 1) / n for n, half in zip(map_hw[::-1], (aspect / diagonal, 1 / diagonal), strict=True))
    u, v = (torch.linspace(-end, end, n, dtype=torch.float64) for n, end in zip(map_hw[::-1], ends, strict=True))
    return u, v


@lru_cache(maxsize=64)
def uv_embedding(channels: int, map_hw: tuple[int, int], aspect: float, device: torch.device) -> Tensor:
    """Return sines and cosines of the normalised image coordinates, (channels, H, W), before the factor 0.1.

    `aspect` is the image's width over height; channels come as sin u, cos u, sin v, cos v, a quarter each.
    """
    with torch.inference_mode(False):
        axes = uv_axes(map_hw, aspect)
        quarter = channels // 4
        omega = 100.0 ** -(torch.arange(quarter, dtype=torch.float64) / quarter)
        u_cW, v_cH = (omega[:, None] * axis for axis in axes)
        u = torch.cat([u_cW.sin(), u_cW.cos()])[:, None, :].expand(-1, map_hw[0], -1)
        v = torch.cat([v_cH.sin(), v_cH.cos()])[:, :, None].expand(-1, -1, map_hw[1])
        return torch.cat([u, v]).to(device=device, dtype=torch.float32)


def add_uv(x_VCHW: Tensor, aspect: float) -> Tensor:
    """Add a tenth of the position embedding to a map."""
    return x_VCHW + 0.1 * uv_embedding(x_VCHW.shape[1], tuple(x_VCHW.shape[-2:]), aspect, x_VCHW.device)


def resize(x_VCHW: Tensor, size: Sequence[int]) -> Tensor:
    """Resize bilinearly with aligned corners."""
    if tuple(x_VCHW.shape[-2:]) == tuple(size):
        return x_VCHW
    return F.interpolate(x_VCHW, tuple(size), mode="bilinear", align_corners=True)


class ResidualUnit(nn.Module):
    """Two convolutions and a skip; VGGT's skip carries the rectified input, DA3's the plain one."""

    def __init__(self, features: int, *, rectified_skip: bool):
        super().__init__()
        self.conv1 = nn.Conv2d(features, features, 3, padding=1)
        self.conv2 = nn.Conv2d(features, features, 3, padding=1)
        self.rectified_skip = rectified_skip

    def forward(self, x: Tensor) -> Tensor:
        """Return skip + conv2(relu(conv1(relu(x))))."""
        rectified = F.relu(x)
        return (rectified if self.rectified_skip else x) + self.conv2(F.relu(self.conv1(rectified)))


class Fusion(nn.Module):
    """One step from a coarse map to the next finer size, with that level's map (the lateral one) added."""

    def __init__(self, features: int, *, lateral: bool, rectified_skip: bool):
        super().__init__()
        if lateral:
            self.resConfUnit1 = ResidualUnit(features, rectified_skip=rectified_skip)
        self.resConfUnit2 = ResidualUnit(features, rectified_skip=rectified_skip)
        self.out_conv = nn.Conv2d(features, features, 1)

    def forward(self, coarse: Tensor, size: Sequence[int], lateral: Tensor | None = None) -> Tensor:
        """Add the lateral map, refine, project, and resize to `size`."""
        if lateral is not None:
            coarse = coarse + self.resConfUnit1(lateral)
        # The 1x1 projection commutes with the resize (its weights sum to one), and is four times cheaper before it.
        return resize(self.out_conv(self.resConfUnit2(coarse)), size)


class Permute(nn.Module):
    """Move an axis, so that a norm over channels can stand in a Sequential under its official key."""

    def __init__(self, *order: int):
        super().__init__()
        self.order = order

    def forward(self, x: Tensor) -> Tensor:
        """Return a view of x with its axes in the order of the constructor."""
        return x.permute(self.order)


def read_out(features: int, outputs: int) -> nn.Sequential:
    """Return the last two convolutions of a branch."""
    return nn.Sequential(nn.Conv2d(features // 2, HIDDEN, 3, padding=1), nn.ReLU(), nn.Conv2d(HIDDEN, outputs, 1))


class Scratch(nn.Module):
    """The fusion chain and the read-outs, under their official names."""

    def __init__(
        self,
        features: int,
        out_channels: Sequence[int],
        outputs: int,
        *,
        rectified_skip: bool,
        ray_branch: bool,
        sky_branch: bool,
    ):
        super().__init__()
        for k, channels in enumerate(out_channels, start=1):
            self.add_module(f"layer{k}_rn", nn.Conv2d(channels, features, 3, padding=1, bias=False))
            for suffix in ("", "_aux") if ray_branch else ("",):
                fusion = Fusion(features, lateral=k < 4, rectified_skip=rectified_skip)
                self.add_module(f"refinenet{k}{suffix}", fusion)
        self.output_conv1 = nn.Conv2d(features, features // 2, 3, padding=1)
        self.output_conv2 = read_out(features, outputs)
        if sky_branch:
            self.sky_output_conv2 = read_out(features, 1)
        if ray_branch:
            self.output_conv1_aux = nn.ModuleList(self._ray_trunk(features) for _ in range(4))
            # One norm module is shared by all four read-outs; the checkpoint stores it once, under level 0.
            norm = nn.LayerNorm(HIDDEN, eps=1e-5)
            self.output_conv2_aux = nn.ModuleList(self._ray_read_out(features, norm) for _ in range(4))

    @staticmethod
    def _ray_trunk(features: int) -> nn.Sequential:
        widths = [features, features // 2] * 3
        return nn.Sequential(*(nn.Conv2d(a, b, 3, padding=1) for a, b in itertools.pairwise(widths)))

    @staticmethod
    def _ray_read_out(features: int, norm: nn.LayerNorm) -> nn.Sequential:
        first, relu, last = read_out(features, RAY_CHANNELS)
        return nn.Sequential(first, Permute(0, 2, 3, 1), norm, Permute(0, 3, 1, 2), relu, last)

    def fuse(self, pyramid: Sequence[Tensor], suffix: str = "") -> Tensor:
        """Run the chain from level 4 to level 1; the result is twice as large as level 1."""
        l1, l2, l3, l4 = pyramid
        fusion = [getattr(self, f"refinenet{k}{suffix}") for k in (1, 2, 3, 4)]
        x = fusion[3](l4, l3.shape[-2:])
        x = fusion[2](x, l2.shape[-2:], l3)
        x = fusion[1](x, l1.shape[-2:], l2)
        return fusion[0](x, [2 * n for n in l1.shape[-2:]], l1)


class DenseHead(nn.Module):
    """Dense read-out of four feature levels; views are independent of each other.

    The head of DA3's single-view models (`single_view`) has no norm and no position embedding, but a sky branch.
    """

    def __init__(
        self,
        *,
        channels_in: int,
        features: int,
        out_channels: Sequence[int],
        outputs: int,
        patch_size: int,
        rectified_skip: bool = False,
        ray_branch: bool = False,
        single_view: bool = False,
    ):
        super().__init__()
        self.patch_size, self.single_view = patch_size, single_view
        self.norm = nn.Identity() if single_view else nn.LayerNorm(channels_in, eps=1e-5)
        self.projects = nn.ModuleList(nn.Conv2d(channels_in, channels, 1) for channels in out_channels)
        oc0, oc1, _, oc3 = out_channels
        self.resize_layers = nn.ModuleList(
            [
                nn.ConvTranspose2d(oc0, oc0, 4, stride=4),
                nn.ConvTranspose2d(oc1, oc1, 2, stride=2),
                nn.Identity(),
                nn.Conv2d(oc3, oc3, 3, stride=2, padding=1),
            ]
        )
        self.scratch = Scratch(
            features, out_channels, outputs, rectified_skip=rectified_skip, ray_branch=ray_branch,
            sky_branch=single_view,
        )  # fmt: skip

    def pyramid(self, levels_VPC: Sequence[Tensor], grid_hw: tuple[int, int]) -> list[Tensor]:
        """Turn four token maps into four maps of F channels at 4, 2, 1 and 1/2 of the patch grid."""
        aspect = grid_hw[1] / grid_hw[0]
        maps = []
        for k, (tokens, project, scale) in enumerate(
            zip(levels_VPC, self.projects, self.resize_layers, strict=True), start=1
        ):
            x = project(self.norm(tokens).transpose(1, 2).unflatten(2, grid_hw))
            maps.append(getattr(self.scratch, f"layer{k}_rn")(scale(self._placed(x, aspect))))
        return maps

    def _placed(self, x_VCHW: Tensor, aspect: float) -> Tensor:
        return x_VCHW if self.single_view else add_uv(x_VCHW, aspect)

    def dense(self, pyramid: Sequence[Tensor], grid_hw: tuple[int, int]) -> Tensor:
        """Read the main branch at image resolution: (V, outputs, H, W), no activation; then sky, if there is any."""
        x = self.scratch.output_conv1(self.scratch.fuse(pyramid))
        x = resize(x, [n * self.patch_size for n in grid_hw])
        x = self._placed(x, grid_hw[1] / grid_hw[0])
        main = self.scratch.output_conv2(x)
        return torch.cat([main, self.scratch.sky_output_conv2(x)], dim=1) if self.single_view else main

    def rays(self, pyramid: Sequence[Tensor], grid_hw: tuple[int, int]) -> Tensor:
        """Read the ray branch at 8 samples a patch: (V, 7, 8h, 8w), no activation."""
        x = self.scratch.output_conv1_aux[3](self.scratch.fuse(pyramid, "_aux"))
        return self.scratch.output_conv2_aux[3](add_uv(x, grid_hw[1] / grid_hw[0]))


def read_in_chunks(
    levels_BSPC: Sequence[Tensor], read: Callable[[list[Tensor]], dict[str, Tensor]]
) -> dict[str, Tensor]:
    """Call `read` on the four levels, in float32, of a few views at a time; its maps get leading dimensions (B, S)."""
    batch = levels_BSPC[0].shape[:2]
    chunks = zip(*(level.flatten(0, 1).split(VIEWS_PER_CHUNK) for level in levels_BSPC), strict=True)
    maps = [read([level.float() for level in chunk]) for chunk in chunks]
    return {name: torch.cat([m[name] for m in maps]).unflatten(0, batch) for name in maps[0]}


def confidence(raw: Tensor) -> Tensor:
    """Return 1 + exp(raw), in (1, inf)."""
    return 1 + raw.exp()


def depth_maps(raw_V2HW: Tensor) -> dict[str, Tensor]:
    """Return depth exp(z) and its confidence, each (V, H, W), under their names in a prediction."""
    depth, conf = raw_V2HW.unbind(1)
    return {"depth_z": depth.exp(), "conf": confidence(conf)}
