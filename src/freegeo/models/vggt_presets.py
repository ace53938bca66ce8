"""The published VGGT checkpoints (VGGT fact sheet, section 1), one architecture under two licences.

This file is data: importing it does not import torch.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from freegeo.models.catalog import ModelEntry

if TYPE_CHECKING:
    from freegeo.models.checkpoints import KeyRules
    from freegeo.models.vggt import VGGT

NON_COMMERCIAL = "CC BY-NC 4.0 (non-commercial)"
VGGT_LICENCE = "VGGT License (commercial use under an acceptable-use policy, no military use)"
CHECK = "the wording of the licence on the hub page is the one that counts, read it first"
PARAMETERS = 1_256_537_516

CONFIG: dict[str, Any] = {
    "width": 1024,
    "depth": 24,
    "heads": 16,
    "encoder_depth": 24,
    "encoder_heads": 16,
    "camera_depth": 4,
    "camera_heads": 16,
    "out_layers": (4, 11, 17, 23),
    "head_features": 256,
    "head_channels": (256, 512, 1024, 1024),
}


def build(name: str, licence: str) -> VGGT:
    """Build the model without weights."""
    from freegeo.models.api import AdaptationDefaults, ModelSpec
    from freegeo.models.vggt import VGGT, VGGTConfig

    config = VGGTConfig(**CONFIG)
    spec = ModelSpec(
        name=name,
        patch_size=config.patch_size,
        default_side=504,
        loss_layers=config.out_layers,
        reference="first",
        special_tokens=config.special,
        weights_licence=licence,
        adaptation=AdaptationDefaults(temperature=1.0, scene_lr=3e-5, published="vggt"),
    )
    return VGGT(config, spec)


def keys() -> KeyRules:
    """Return the rules of official VGGT checkpoints: our names, and a tracking head that is left out."""
    from freegeo.models.checkpoints import KeyRules

    return KeyRules(skipped=("track_head.",))


def _entry(name: str, licence: str, hub_id: str, hub_file: str, *, gated: bool) -> ModelEntry:
    return ModelEntry(
        name=name,
        about=f"any number of views, 24 + 24 blocks of width 1024; {CHECK}",
        licence=licence,
        parameters=PARAMETERS,
        build=partial(build, name, licence),
        keys=keys,
        hub_id=f"facebook/{hub_id}",
        hub_file=hub_file,
        gated=gated,
    )


ENTRIES = (
    _entry("vggt-1b", NON_COMMERCIAL, "VGGT-1B", "model.safetensors", gated=False),
    _entry("vggt-1b-commercial", VGGT_LICENCE, "VGGT-1B-Commercial", "vggt_1B_commercial.pt", gated=True),
)
