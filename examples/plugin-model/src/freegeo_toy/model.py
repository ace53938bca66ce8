"""A toy architecture in freegeo's three stages: convolutions per view, attention across views, linear read-outs.

Letters: B scenes, S views, P patches of a view, L = S P, D width, H W pixels.
"""

from collections.abc import Collection, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from freegeo.errors import UserError
from freegeo.geometry.camera import decode_world_to_camera
from freegeo.geometry.se3 import inverse
from freegeo.models.api import ReconstructionModel, Want, check_layers, check_want, level_tokens
from freegeo.models.da3_images import preprocess
from freegeo.models.images import normalise, patch_grid
from freegeo.models.spec import MIXED, AdaptationDefaults, Mixed, ModelSpec
from freegeo.types import Features, ImageBatch, Prediction, Priors, ViewTokens
from freegeo_toy import LICENCE

WIDTH, HEADS, DEPTH, PATCH, SIDE = 24, 2, 2, 8, 64


class Mixer(nn.Module):
    """Attention over all tokens of all views. An adapter can sit on a layer only if the layer is called."""

    def __init__(self):
        super().__init__()
        self.norm, self.norm_wide = nn.LayerNorm(WIDTH), nn.LayerNorm(WIDTH)
        self.query, self.key, self.value, self.output = (nn.Linear(WIDTH, WIDTH) for _ in range(4))
        self.widen, self.narrow = nn.Linear(WIDTH, 4 * WIDTH), nn.Linear(4 * WIDTH, WIDTH)

    def forward(self, x_BLD: Tensor) -> Tensor:
        """Mix the tokens of each batch entry."""
        y = self.norm(x_BLD)
        q, k, v = (f(y).unflatten(-1, (HEADS, -1)).transpose(1, 2) for f in (self.query, self.key, self.value))
        x_BLD = x_BLD + self.output(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))
        return x_BLD + self.narrow(F.gelu(self.widen(self.norm_wide(x_BLD))))


class Toy(ReconstructionModel):
    """Everything freegeo asks of a model."""

    spec = ModelSpec(
        name="toy",
        patch_size=PATCH,
        default_side=SIDE,
        loss_layers=(0, 1),
        reference="first",
        special_tokens=0,
        weights_licence=LICENCE,
        adaptation=AdaptationDefaults(temperature=1.0, scene_lr=1e-3, rank=4),
    )
    camera_token_name = None

    def __init__(self):
        super().__init__()
        self.patches = nn.Conv2d(3, WIDTH, PATCH, PATCH)
        self.neighbours = nn.Conv2d(WIDTH, WIDTH, 3, padding=1)
        self.mixers = nn.ModuleList(Mixer() for _ in range(DEPTH))
        self.read_depth = nn.Linear(WIDTH, 2 * PATCH**2)
        self.read_camera = nn.Linear(WIDTH, 9)

    def preprocess(self, photos: Sequence, *, mixed: Mixed = MIXED) -> ImageBatch:
        """Resize the longest side to 64 pixels, both sides to multiples of 8."""
        return preprocess(photos, side=SIDE, patch=PATCH, mixed=mixed)

    def embed(self, images: Tensor, *, layers: Collection[int] | None = None) -> ViewTokens:
        """See each view alone: images (B, S, 3, H, W) in [0, 1]."""
        grid_hw = patch_grid(images, PATCH)
        x_VDhw = self.patches(normalise(images).flatten(0, 1))
        x_VDhw = x_VDhw + self.neighbours(F.gelu(x_VDhw))
        tokens = x_VDhw.flatten(2).transpose(1, 2).unflatten(0, images.shape[:2])
        return ViewTokens(tokens=tokens, image_hw=(images.shape[-2], images.shape[-1]), grid_hw=grid_hw)

    def aggregate(
        self,
        tokens: ViewTokens,
        *,
        layers: Collection[int] | None = None,
        reference: str = "first",
        priors: Priors | None = None,
    ) -> Features:
        """Mix the views; level i holds the tokens after mixer i, with no special tokens among them."""
        wanted = range(DEPTH) if layers is None else layers
        check_layers(wanted, DEPTH, self.spec.name)
        if reference != "first" or priors is not None:
            raise UserError("toy takes the first view as reference and no known cameras. Leave both options out.")
        x_BSPD, levels = tokens.tokens, {}
        for i in range(max(wanted) + 1):
            x_BSPD = self.mixers[i](x_BSPD.flatten(1, 2)).view_as(x_BSPD)
            if i in wanted:
                levels[i] = (x_BSPD, x_BSPD[:, :, :0])
        return Features(levels=levels, image_hw=tokens.image_hw, grid_hw=tokens.grid_hw)

    def decode(self, features: Features, *, want: Collection[Want] = ("depth", "cameras")) -> Prediction:
        """Read depth off every patch, and the camera off the mean of a view's patches, relative to the first view."""
        check_want(want, ("depth", "cameras"), self.spec.name)
        [(x_BSPD, _)] = level_tokens(features, (DEPTH - 1,), self.spec.name)
        with torch.autocast(x_BSPD.device.type, enabled=False):
            x_BSPD, maps = x_BSPD.float(), {}
            if "depth" in want:
                raw = self.read_depth(x_BSPD).transpose(-1, -2).unflatten(-1, features.grid_hw)
                depth, conf = F.pixel_shuffle(raw, PATCH).exp().unbind(2)
                maps |= {"depth_z": depth, "conf": 1 + conf}
            if "cameras" in want:
                upright = x_BSPD.new_tensor([0, 0, 0, 0, 0, 0, 1, 1, 1])
                encoding = upright + 0.1 * self.read_camera(x_BSPD.mean(2)).tanh()
                T_cam_any, K = decode_world_to_camera(encoding, features.image_hw)
                maps |= {"T_cam_world": T_cam_any @ inverse(T_cam_any[:, :1]), "K": K}
        return Prediction(**maps)

    def adapter_targets(self) -> list[str]:
        """Name the linears of the mixers."""
        return [f"mixers.{name}" for name, part in self.mixers.named_modules() if isinstance(part, nn.Linear)]
