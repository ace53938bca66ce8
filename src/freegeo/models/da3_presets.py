"""The DA3 variants: the published ones (DA3 fact sheet, section 1) and the embedded model of the same class.

This file is data: importing it does not import torch.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from freegeo.models.catalog import EMBEDDED_MODEL, ModelEntry

if TYPE_CHECKING:
    from freegeo.models.checkpoints import KeyRules
    from freegeo.models.da3 import DA3

APACHE = "Apache-2.0"
NON_COMMERCIAL = "CC BY-NC 4.0 (non-commercial)"
EMBEDDED_WEIGHTS = Path(__file__).parent / "weights" / "freegeo-tiny.safetensors"

_TWELVE_BLOCKS: dict[str, Any] = {"depth": 12, "out_layers": (5, 7, 9, 11), "starts": 4}
_WIDE_HEAD: dict[str, Any] = {"head_features": 256, "head_channels": (256, 512, 1024, 1024)}

PUBLISHED: dict[str, dict[str, Any]] = {
    "da3-small": {
        **_TWELVE_BLOCKS, "width": 384, "heads": 6, "head_features": 64, "head_channels": (48, 96, 192, 384),
    },
    "da3-base": {
        **_TWELVE_BLOCKS, "width": 768, "heads": 12, "head_features": 128, "head_channels": (96, 192, 384, 768),
    },
    "da3-large": {
        **_WIDE_HEAD, "width": 1024, "depth": 24, "heads": 16, "out_layers": (11, 15, 19, 23), "starts": 8,
    },
    "da3-giant": {
        **_WIDE_HEAD, "width": 1536, "depth": 40, "heads": 24, "out_layers": (19, 27, 33, 39), "starts": 13,
        "ffn": "swiglu",
    },
}  # fmt: skip

EMBEDDED: dict[str, Any] = {
    "width": 128,
    "depth": 10,
    "heads": 4,
    "out_layers": (3, 5, 7, 9),
    "starts": 3,
    "head_features": 32,
    "head_channels": (16, 32, 48, 64),
    "patch_size": 8,
    "position_grid": 8,
    "camera_encoder_depth": 1,
    "camera_encoder_heads": 4,
}
EMBEDDED_SIDE = 64


def config(values: dict[str, Any]):
    """Build the configuration of a variant whose three starts are one number."""
    from freegeo.models.da3 import DA3Config

    starts = values["starts"]
    rest = {name: value for name, value in values.items() if name != "starts"}
    return DA3Config(alt_start=starts, qknorm_start=starts, rope_start=starts, **rest)


def build_published(name: str, licence: str) -> DA3:
    """Build a published variant without weights."""
    from freegeo.models.api import AdaptationDefaults, ModelSpec
    from freegeo.models.da3 import DA3

    values = PUBLISHED[name]
    spec = ModelSpec(
        name=name,
        patch_size=14,
        default_side=504,
        loss_layers=values["out_layers"],
        reference="saddle_balanced",
        special_tokens=1,
        weights_licence=licence,
        adaptation=AdaptationDefaults(temperature=10.0, scene_lr=3e-5, published="da3"),
    )
    return DA3(config(values), spec)


def build_embedded() -> DA3:
    """Build the embedded model without weights."""
    from freegeo.models.api import AdaptationDefaults, ModelSpec
    from freegeo.models.da3 import DA3

    spec = ModelSpec(
        name=EMBEDDED_MODEL,
        patch_size=EMBEDDED["patch_size"],
        default_side=EMBEDDED_SIDE,
        loss_layers=EMBEDDED["out_layers"],
        reference="first",
        special_tokens=1,
        weights_licence=APACHE,
        adaptation=AdaptationDefaults(temperature=2.5, scene_lr=1e-3, rank=16, neighbours=True),
    )
    return DA3(config(EMBEDDED), spec)


def keys() -> KeyRules:
    """Return the rules of official DA3 checkpoints: prefix, Gaussian head left out, one norm under four names."""
    from freegeo.models.checkpoints import KeyRules

    stem = "head.scratch.output_conv2_aux"
    aliases = {f"{stem}.{level}.2.{leaf}": f"{stem}.0.2.{leaf}" for level in (1, 2, 3) for leaf in ("weight", "bias")}
    return KeyRules(prefix="model.", skipped=("gs_head.",), aliases=aliases)


def _published(name: str, licence: str, parameters: int, hub_id: str, about: str) -> ModelEntry:
    return ModelEntry(
        name=name,
        about=about,
        licence=licence,
        parameters=parameters,
        build=partial(build_published, name, licence),
        keys=keys,
        hub_id=f"depth-anything/{hub_id}",
    )


def _later(name: str, parameters: int, hub_id: str, licence: str, what: str) -> ModelEntry:
    about = f"{what}; use da3-small, da3-base, da3-large or da3-giant."
    return ModelEntry(name=name, about=about, licence=licence, parameters=parameters, hub_id=f"depth-anything/{hub_id}")


ENTRIES = (
    _published("da3-small", APACHE, 34_299_463, "DA3-SMALL", "any number of views, 12 blocks of width 384"),
    _published("da3-base", APACHE, 135_366_599, "DA3-BASE", "any number of views, 12 blocks of width 768"),
    _published(
        "da3-large", NON_COMMERCIAL, 410_941_767, "DA3-LARGE-1.1", "any number of views, 24 blocks of width 1024"
    ),
    _published(
        "da3-giant", NON_COMMERCIAL, 1_355_674_125, "DA3-GIANT-1.1", "any number of views, 40 blocks of width 1536"
    ),
    _later("da3mono-large", 334_171_394, "DA3MONO-LARGE", APACHE, "one view at a time, no cameras"),
    _later("da3metric-large", 334_171_394, "DA3METRIC-LARGE", APACHE, "one view at a time, metric depth"),
    _later(
        "da3nested-giant-large", 1_689_845_519, "DA3NESTED-GIANT-LARGE-1.1", NON_COMMERCIAL, "giant with metric scale"
    ),
    ModelEntry(
        name=EMBEDDED_MODEL,
        about="embedded, trained on generated rooms only: for demonstrations and tests, not for real photos",
        licence=APACHE,
        parameters=0,
        build=build_embedded,
        keys=keys,
        packaged_weights=EMBEDDED_WEIGHTS,
    ),
)
