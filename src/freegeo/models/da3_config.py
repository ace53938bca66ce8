"""The DA3 variants: the published ones (docs/models/da3.md, "Variants"), and the embedded model as one more.

The architecture itself is in da3.py and da3_metric.py. Importing this file does not import torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from freegeo.models.catalog import EMBEDDED_MODEL
from freegeo.models.spec import AdaptationDefaults, KeyRules, ModelEntry, ModelSpec

if TYPE_CHECKING:
    from freegeo.models.da3 import DA3
    from freegeo.models.da3_metric import DA3Nested, DA3SingleView

APACHE = "Apache-2.0"
NON_COMMERCIAL = "CC BY-NC 4.0 (non-commercial)"
EMBEDDED_WEIGHTS = Path(__file__).parent / "weights" / "freegeo-tiny.safetensors"


@dataclass(frozen=True, kw_only=True)
class DA3Config:
    """Every number of one variant."""

    width: int
    """Channels of a token in the backbone, D."""
    depth: int
    """Number of blocks."""
    heads: int
    """Attention heads of a block."""
    ffn: Literal["mlp", "swiglu"] = "mlp"
    """Feed-forward layer of a block."""
    alt_start: int
    """First block that comes after the views were given their camera token; odd blocks from here on are global.
    `depth` for a model of single views, which has no such blocks."""
    qknorm_start: int
    """First block that normalises queries and keys."""
    rope_start: int
    """First block that rotates queries and keys by their position."""
    out_layers: tuple[int, int, int, int]
    """Blocks whose outputs the heads read, ascending; the camera decoder reads the last one."""
    head_features: int
    """Channels inside the dense head, F."""
    head_channels: tuple[int, int, int, int]
    """Channels of the dense head's four maps before they are brought to F."""
    cat_token: bool = True
    """Whether a feature holds the last per-view block's output beside the current one, or only the latter."""
    patch_size: int = 14
    """Side of a patch in pixels."""
    position_grid: int = 37
    """Side of the learned grid of positions, in patches."""
    camera_encoder_depth: int = 4
    camera_encoder_heads: int = 16

    def __post_init__(self):
        if self.alt_start < 2:
            raise ValueError(f"alt_start must be at least 2, got {self.alt_start}")
        if list(self.out_layers) != sorted(set(self.out_layers)):
            raise ValueError(f"out_layers must ascend, got {self.out_layers}")

    @property
    def cross_view(self) -> bool:
        """Whether views see each other."""
        return self.alt_start < self.depth

    @property
    def channels(self) -> int:
        """Feature channels per token, C."""
        return self.width * (2 if self.cat_token else 1)


SMALL = DA3Config(
    width=384, depth=12, heads=6, alt_start=4, qknorm_start=4, rope_start=4, out_layers=(5, 7, 9, 11),
    head_features=64, head_channels=(48, 96, 192, 384),
)  # fmt: skip
BASE = DA3Config(
    width=768, depth=12, heads=12, alt_start=4, qknorm_start=4, rope_start=4, out_layers=(5, 7, 9, 11),
    head_features=128, head_channels=(96, 192, 384, 768),
)  # fmt: skip
LARGE = DA3Config(
    width=1024, depth=24, heads=16, alt_start=8, qknorm_start=8, rope_start=8, out_layers=(11, 15, 19, 23),
    head_features=256, head_channels=(256, 512, 1024, 1024),
)  # fmt: skip
GIANT = DA3Config(
    width=1536, depth=40, heads=24, ffn="swiglu", alt_start=13, qknorm_start=13, rope_start=13,
    out_layers=(19, 27, 33, 39), head_features=256, head_channels=(256, 512, 1024, 1024),
)  # fmt: skip
SINGLE_VIEW = DA3Config(
    width=1024, depth=24, heads=16, alt_start=24, qknorm_start=24, rope_start=24, out_layers=(4, 11, 17, 23),
    head_features=256, head_channels=(256, 512, 1024, 1024), cat_token=False,
)  # fmt: skip
EMBEDDED = DA3Config(
    width=192, depth=12, heads=6, alt_start=4, qknorm_start=4, rope_start=4, out_layers=(5, 7, 9, 11),
    head_features=32, head_channels=(24, 48, 72, 96), patch_size=8, position_grid=12,
    camera_encoder_depth=1, camera_encoder_heads=6,
)  # fmt: skip

_NORM = "head.scratch.output_conv2_aux"
KEYS = KeyRules(
    prefix="model.",
    skipped=("gs_head.",),
    aliases={f"{_NORM}.{level}.2.{leaf}": f"{_NORM}.0.2.{leaf}" for level in (1, 2, 3) for leaf in ("weight", "bias")},
)
"""Official checkpoints: a prefix, a Gaussian head that is left out, and one norm that is shared by four layers."""


SINGLE_VIEW_KEYS = KeyRules(prefix="model.")
NESTED_KEYS = KeyRules(
    prefix="model.",
    skipped=tuple(f"da3.{name}" for name in KEYS.skipped),
    aliases={f"da3.{alias}": f"da3.{stored}" for alias, stored in KEYS.aliases.items()},
)


def build(config: DA3Config, spec: ModelSpec) -> DA3:
    """Build an any-view variant without weights."""
    from freegeo.models.da3 import DA3

    return DA3(config, spec)


def build_single_view(config: DA3Config, spec: ModelSpec) -> DA3SingleView:
    """Build a variant of single views without weights."""
    from freegeo.models.da3_metric import DA3SingleView

    return DA3SingleView(config, spec)


def build_nested(anyview: DA3Config, metric: DA3Config, spec: ModelSpec) -> DA3Nested:
    """Build a nested variant without weights."""
    from freegeo.models.da3_metric import DA3Nested

    return DA3Nested(anyview, metric, spec)


def _spec(
    name: str,
    config: DA3Config,
    licence: str,
    *,
    cameras: bool = True,
    metric: bool = False,
    caution: str | None = None,
) -> ModelSpec:
    return ModelSpec(
        name=name,
        patch_size=config.patch_size,
        default_side=504,
        sides=(252, 1008),
        loss_layers=config.out_layers,
        reference="saddle_balanced",
        special_tokens=1,
        weights_licence=licence,
        adaptation=AdaptationDefaults(temperature=10.0, scene_lr=3e-5, published="da3"),
        cameras=cameras,
        metric=metric,
        ray_cameras=cameras,
        caution=caution,
        takes="cameras" if cameras else "nothing",
    )


def _published(name: str, config: DA3Config, licence: str, parameters: int, hub_id: str) -> ModelEntry:
    return ModelEntry(
        name=name,
        about=f"any number of views, {config.depth} blocks of width {config.width}",
        licence=licence,
        parameters=parameters,
        build=partial(build, config, _spec(name, config, licence)),
        keys=KEYS,
        hub_id=f"depth-anything/{hub_id}",
    )


def _single_view(name: str, hub_id: str, about: str, caution: str | None = None) -> ModelEntry:
    return ModelEntry(
        name=name,
        about=about,
        licence=APACHE,
        parameters=334_171_394,
        build=partial(build_single_view, SINGLE_VIEW, _spec(name, SINGLE_VIEW, APACHE, cameras=False, caution=caution)),
        keys=SINGLE_VIEW_KEYS,
        hub_id=f"depth-anything/{hub_id}",
    )


def _nested(name: str, parameters: int, hub_id: str) -> ModelEntry:
    spec = _spec(name, GIANT, NON_COMMERCIAL, metric=True)
    return ModelEntry(
        name=name,
        about="da3-giant with lengths in metres, and sky",
        licence=NON_COMMERCIAL,
        parameters=parameters,
        build=partial(build_nested, GIANT, SINGLE_VIEW, spec),
        keys=NESTED_KEYS,
        hub_id=f"depth-anything/{hub_id}",
    )


def embedded_spec() -> ModelSpec:
    """Return how the embedded model is described; its images are as large as its grid of positions."""
    return ModelSpec(
        name=EMBEDDED_MODEL,
        patch_size=EMBEDDED.patch_size,
        default_side=EMBEDDED.patch_size * EMBEDDED.position_grid,
        # AUC@30 of 8 views, 12 rooms of `test-id`: .46 at 48 pixels, .62 at 64, .76 at 96, .70 at 128, .57 at 160
        sides=(64, 128),
        loss_layers=EMBEDDED.out_layers,
        reference="first",
        special_tokens=1,
        weights_licence=APACHE,
        adaptation=AdaptationDefaults(temperature=2.5, scene_lr=1e-3, rank=16, neighbours=True),
        ray_cameras=True,
        takes="cameras",
        # It was trained on up to 16 views; what it makes of more consecutive ones: docs/sequences.md, "Measured".
        chunk=16,
    )


def _embedded() -> ModelEntry:
    return ModelEntry(
        name=EMBEDDED_MODEL,
        about="embedded, trained on generated rooms only: for demonstrations and tests, not for real photos",
        licence=APACHE,
        parameters=0,
        build=partial(build, EMBEDDED, embedded_spec()),
        keys=KEYS,
        packaged_weights=EMBEDDED_WEIGHTS,
    )


ENTRIES = (
    _published("da3-small", SMALL, APACHE, 34_299_463, "DA3-SMALL"),
    _published("da3-base", BASE, APACHE, 135_366_599, "DA3-BASE"),
    _published("da3-large", LARGE, NON_COMMERCIAL, 410_941_767, "DA3-LARGE-1.1"),
    _published("da3-giant", GIANT, NON_COMMERCIAL, 1_355_674_125, "DA3-GIANT-1.1"),
    _nested("da3nested-giant-large", 1_689_845_519, "DA3NESTED-GIANT-LARGE-1.1"),
    _single_view("da3mono-large", "DA3MONO-LARGE", "depth and sky of single photos, no cameras; cannot be adapted"),
    _single_view(
        "da3metric-large",
        "DA3METRIC-LARGE",
        "depth and sky of single photos, in metres times 300 / focal length; cannot be adapted",
        caution="da3metric-large does not know the focal length, so its depth is not in metres yet: multiply it by the "
        "focal length in pixels of the model's image / 300, or use da3nested-giant-large, which does that by itself.",
    ),
    _embedded(),
)
