"""The published Pi3 and Pi3X checkpoints (docs/models/pi3.md, "Checkpoints").

The architectures themselves are in pi3.py and pi3x.py. Importing this file does not import torch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from freegeo.models.spec import NO_REFERENCE, AdaptationDefaults, KeyRules, ModelEntry, ModelSpec

if TYPE_CHECKING:
    from freegeo.models.pi3 import Pi3

DEFAULT_SIDE = 574
"""Longest side of a 4:3 photo; what is fixed is the number of pixels, whatever the shape."""
NON_COMMERCIAL = "CC BY-NC 4.0 (non-commercial)"


@dataclass(frozen=True, kw_only=True)
class Pi3XConfig:
    """What Pi3X has beside the parts of Pi3."""

    head_channels: tuple[int, int, int] = (256, 128, 64)
    """Channels of the three levels of a convolutional head."""
    head_units: int = 2
    """Residual units of a level."""
    head_hidden: int = 32
    """Channels before a head's last convolution."""
    scale_width: int = 512
    scale_depth: int = 5
    scale_heads: int = 8
    scale_out: int = 512
    pose_pairs: tuple[int, ...] = (0, 4, 8, 12, 16)
    """Pairs of blocks after which known poses are injected."""


@dataclass(frozen=True, kw_only=True)
class Pi3Config:
    """Every number of one variant."""

    width: int
    """Channels of a token, D."""
    pairs: int
    """Pairs of a block within each view and a block across views."""
    heads: int
    """Attention heads of such a block."""
    encoder_depth: int
    encoder_heads: int
    head_width: int
    """Channels inside the decoders of points, confidence and cameras."""
    head_depth: int
    head_heads: int
    dense_out: int
    """Channels that the decoders of points and confidence end with."""
    camera_out: int
    registers: int = 5
    """Tokens of a view beside its patches; none of them is a camera token."""
    encoder_registers: int = 4
    patch_size: int = 14
    """Side of a patch in pixels."""
    position_grid: int = 37
    """Side of the learned grid of positions, in patches."""
    pixels: int = 255_000
    """Most pixels of an image: those of the largest that the models were trained with."""
    x: Pi3XConfig | None = None
    """The further parts of Pi3X; None: Pi3."""

    @property
    def channels(self) -> int:
        """Feature channels per token that the heads read: the two blocks of the last pair side by side."""
        return 2 * self.width

    @property
    def last_pair(self) -> int:
        """Level that the heads read."""
        return self.pairs - 1

    @property
    def readout(self) -> int:
        """Level of the features that losses compare: the last pair as the point decoder sees it first."""
        return self.pairs


PI3 = Pi3Config(
    width=1024, pairs=18, heads=16, encoder_depth=24, encoder_heads=16, head_width=1024, head_depth=5, head_heads=16,
    dense_out=1024, camera_out=512,
)  # fmt: skip

KEYS = KeyRules(skipped=("image_mean", "image_std"))
"""Official checkpoints: our names, and two buffers with ImageNet's constants."""


def build(config: Pi3Config, spec: ModelSpec) -> Pi3:
    """Build a variant without weights."""
    if config.x is not None:
        from freegeo.models.pi3x import Pi3X

        return Pi3X(config, spec)
    from freegeo.models.pi3 import Pi3

    return Pi3(config, spec)


def _entry(name: str, about: str, config: Pi3Config, hub_id: str, parameters: int) -> ModelEntry:
    spec = ModelSpec(
        name=name,
        patch_size=config.patch_size,
        default_side=DEFAULT_SIDE,
        sides=(287, DEFAULT_SIDE),
        loss_layers=(config.readout,),
        reference=NO_REFERENCE,
        special_tokens=config.registers,
        weights_licence=NON_COMMERCIAL,
        # Unproven: no weights were at hand. Below the rate of VGGT, since the method as published harms these models.
        adaptation=AdaptationDefaults(
            temperature=0.7,
            scene_lr=1e-5,
            caution="An independent test found Pi3 worse after adapting it as published (AUC@3 by 7.1 %, F1 by "
            "9.3 %), and the settings used here instead are unproven; trust the verdict of --guard select.",
        ),
        metric=config.x is not None,
        takes="nothing" if config.x is None else "parts",
    )
    return ModelEntry(
        name=name,
        about=about,
        licence=NON_COMMERCIAL,
        parameters=parameters,
        build=partial(build, config, spec),
        keys=KEYS,
        hub_id=f"yyfz233/{hub_id}",
    )


ENTRIES = (
    _entry("pi3", "any number of views, all alike; 36 blocks of width 1024", PI3, "Pi3", 958_696_732),
    _entry(
        "pi3x", "as pi3, in metres, smoother; takes known cameras and depth, all or some",
        replace(PI3, x=Pi3XConfig()), "Pi3X",
        1_360_032_433,
    ),
)  # fmt: skip
