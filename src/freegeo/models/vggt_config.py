"""The published VGGT checkpoints (docs/models/vggt.md, "Checkpoints"): one architecture under two licences.

The architecture itself is in vggt.py. Importing this file does not import torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from freegeo.models.spec import AdaptationDefaults, KeyRules, ModelEntry, ModelSpec

if TYPE_CHECKING:
    from freegeo.models.vggt import VGGT

NON_COMMERCIAL = "CC BY-NC 4.0 (non-commercial)"
VGGT_LICENCE = "VGGT License (commercial use under an acceptable-use policy, no military use)"
CHECK = "the wording of the licence on the hub page is the one that counts, read it first"


@dataclass(frozen=True, kw_only=True)
class VGGTConfig:
    """Every number of one variant."""

    width: int
    """Channels of a token, D."""
    depth: int
    """Number of frame blocks, and of global blocks."""
    heads: int
    """Attention heads of a frame or global block."""
    encoder_depth: int
    encoder_heads: int
    camera_depth: int
    camera_heads: int
    out_layers: tuple[int, int, int, int]
    """Pairs of blocks whose outputs the heads read, ascending; the camera head reads the last one."""
    head_features: int
    """Channels inside the dense heads, F."""
    head_channels: tuple[int, int, int, int]
    """Channels of a dense head's four maps before they are brought to F."""
    registers: int = 4
    """Tokens of a view beside its camera token and its patches."""
    patch_size: int = 14
    """Side of a patch in pixels."""
    position_grid: int = 37
    """Side of the learned grid of positions, in patches."""

    def __post_init__(self):
        if list(self.out_layers) != sorted(set(self.out_layers)) or self.out_layers[-1] != self.depth - 1:
            raise ValueError(f"out_layers must ascend to the last layer {self.depth - 1}, got {self.out_layers}")

    @property
    def channels(self) -> int:
        """Feature channels per token, C: the frame block's output beside the global block's."""
        return 2 * self.width

    @property
    def special(self) -> int:
        """Tokens of a view that are no patches: the camera token and the registers."""
        return 1 + self.registers


VGGT_1B = VGGTConfig(
    width=1024, depth=24, heads=16, encoder_depth=24, encoder_heads=16, camera_depth=4, camera_heads=16,
    out_layers=(4, 11, 17, 23), head_features=256, head_channels=(256, 512, 1024, 1024),
)  # fmt: skip

KEYS = KeyRules(skipped=("track_head.",))
"""Official checkpoints: our names, and a tracking head that is left out."""


def build(config: VGGTConfig, spec: ModelSpec) -> VGGT:
    """Build a variant without weights."""
    from freegeo.models.vggt import VGGT

    return VGGT(config, spec)


def _entry(name: str, licence: str, hub_id: str, hub_file: str, *, gated: bool) -> ModelEntry:
    spec = ModelSpec(
        name=name,
        patch_size=VGGT_1B.patch_size,
        default_side=504,
        sides=(252, 1008),
        loss_layers=VGGT_1B.out_layers,
        reference="first",
        special_tokens=VGGT_1B.special,
        weights_licence=licence,
        adaptation=AdaptationDefaults(temperature=1.0, scene_lr=3e-5, published="vggt"),
    )
    return ModelEntry(
        name=name,
        about=f"any number of views, 24 + 24 blocks of width 1024; {CHECK}",
        licence=licence,
        parameters=1_256_537_516,
        build=partial(build, VGGT_1B, spec),
        keys=KEYS,
        hub_id=f"facebook/{hub_id}",
        hub_file=hub_file,
        gated=gated,
    )


ENTRIES = (
    _entry("vggt-1b", NON_COMMERCIAL, "VGGT-1B", "model.safetensors", gated=False),
    _entry("vggt-1b-commercial", VGGT_LICENCE, "VGGT-1B-Commercial", "vggt_1B_commercial.pt", gated=True),
)
