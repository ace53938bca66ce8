"""The published MapAnything checkpoints (docs/models/mapanything.md, "Checkpoints"): one architecture, two licences.

The architecture itself is in mapanything.py. Importing this file does not import torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from freegeo.models.spec import AdaptationDefaults, KeyRules, ModelEntry, ModelSpec

if TYPE_CHECKING:
    from freegeo.models.mapanything import MapAnything

NON_COMMERCIAL = "CC BY-NC 4.0 (non-commercial)"
APACHE = "Apache-2.0"


@dataclass(frozen=True, kw_only=True)
class MapAnythingConfig:
    """Every number of one variant."""

    width: int
    """Channels of a token, D."""
    heads: int
    """Attention heads of every block."""
    encoder_depth: int
    depth: int
    """Number of blocks across views, global ones and those of single views together."""
    out_layers: tuple[int, int, int]
    """Blocks across views whose outputs the heads read, ascending; pose and scale heads read the last one."""
    dense_encoder: tuple[int, int, int] = (588, 768, 1024)
    """Channels inside the encoders of ray and depth maps."""
    global_encoder: tuple[int, int, int] = (128, 256, 512)
    """Channels inside the encoders of single vectors."""
    head_features: int = 256
    """Channels inside the dense head, F."""
    head_channels: tuple[int, int, int, int] = (96, 192, 384, 768)
    """Channels of the dense head's four maps before they are brought to F."""
    pose_hidden: int = 784
    scale_hidden: int = 196
    patch_size: int = 14
    """Side of a patch in pixels."""
    position_grid: int = 37
    """Side of the learned grid of positions, in patches."""

    def __post_init__(self):
        if list(self.out_layers) != sorted(set(self.out_layers)) or self.out_layers[-1] != self.depth - 1:
            raise ValueError(f"out_layers must ascend to the last block {self.depth - 1}, got {self.out_layers}")
        if self.depth % 2:
            raise ValueError(f"global blocks and those of single views alternate, so depth is even, not {self.depth}")


MAP_ANYTHING = MapAnythingConfig(width=1536, heads=24, encoder_depth=24, depth=16, out_layers=(7, 11, 15))

KEYS = KeyRules(
    # Upstream's module tree names parts of the dense head two or three times. The official file holds each tensor once,
    # under the names of our modules; a state dict that others saved may hold all of them.
    skipped=("dpt_feature_head.", "dpt_regressor_head.", "dense_head.0.scratch.layer"),
    foreign={
        "info_sharing.proj_embed.weight": "this is the first version of MapAnything, of 2025, which freegeo does not "
        "have. Use the files of facebook/map-anything or facebook/map-anything-apache."
    },
)


def build(config: MapAnythingConfig, spec: ModelSpec) -> MapAnything:
    """Build a variant without weights."""
    from freegeo.models.mapanything import MapAnything

    return MapAnything(config, spec)


def spec_of(name: str, config: MapAnythingConfig, licence: str, side: int) -> ModelSpec:
    """Return how a variant is described that reads images of a longest side."""
    return ModelSpec(
        name=name,
        patch_size=config.patch_size,
        default_side=side,
        sides=(side // 2, side * 2),
        loss_layers=config.out_layers,
        reference="first",
        special_tokens=1,
        weights_licence=licence,
        # Neither is measured: no weights were at hand (docs/models/mapanything.md, "Adaptation").
        adaptation=AdaptationDefaults(temperature=1.0, scene_lr=3e-5),
        metric=True,
        takes="parts",
    )


def _entry(name: str, licence: str, revision: str | None) -> ModelEntry:
    return ModelEntry(
        name=name,
        about="any number of views, lengths in metres, takes any part of the cameras, 16 blocks of width 1536",
        licence=licence,
        parameters=1_228_492_758,
        build=partial(build, MAP_ANYTHING, spec_of(name, MAP_ANYTHING, licence, side=518)),
        keys=KEYS,
        hub_id=f"facebook/{name}",
        revision=revision,
    )


ENTRIES = (
    _entry("map-anything", NON_COMMERCIAL, revision=None),
    _entry("map-anything-apache", APACHE, revision="00f9c245bbcb60522d1ed7f9e9d88462c6e3f38a"),
)
