"""The variants of a model that the experiments compare: one literal table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from freegeo.adaptation.recipe import Recipe
from freegeo.errors import UserError


@dataclass(frozen=True, kw_only=True)
class Variant:
    """How a prediction of a task is made."""

    name: str
    label: str
    adapted: bool = False
    measures: Literal["prediction", "features"] = "prediction"
    """`features`: no prediction, but the distance of the last layer's features to those of the frozen model that sees
    8 views."""
    encode_all: bool = False
    """The encoder sees the whole sample of 8, the decoder gets the features of the kept views ("8->4")."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """What the variant changes in a recipe, as in `Recipe.changed`, settings of the loss under `loss`."""

    def recipe(self, base: Recipe) -> Recipe:
        """The recipe of this variant."""
        return base.changed(**self.changes)


_NO_CROSS = {"angle_weights": (0.0, 0.0, 0.0), "weight_pk": 0.0, "weight_pq": 0.0, "weight_kq": 0.0}
VARIANTS: dict[str, Variant] = {
    variant.name: variant
    for variant in (
        Variant(name="frozen", label="frozen"),
        Variant(name="8to4", label="8->4", encode_all=True),
        Variant(name="adapted", label="+ Free Geometry", adapted=True),
        Variant(name="features-frozen", label="frozen", measures="features"),
        Variant(name="features-adapted", label="+ Free Geometry", measures="features", adapted=True),
        Variant(
            name="no-intra", label="w/o consistency loss", adapted=True,
            changes={"loss": {"weight_huber": 0.0, "weight_cosine": 0.0}},
        ),
        Variant(name="no-cross", label="w/o relational loss", adapted=True, changes={"loss": _NO_CROSS}),
        Variant(name="anchors-top", label="top selection", adapted=True, changes={"loss": {"selection": "topk"}}),
        Variant(
            name="anchors-random", label="random selection", adapted=True, changes={"loss": {"selection": "random"}},
        ),
        Variant(
            name="anchors-mixed", label="mixed selection", adapted=True, changes={"loss": {"selection": "mixed"}},
        ),
        *(
            Variant(name=f"rank-{rank}", label=f"LoRA r={rank}", adapted=True, changes={"rank": rank})
            for rank in (8, 16, 32, 64)
        ),
    )
}  # fmt: skip


def variant(name: str) -> Variant:
    """A variant by name; UserError lists the names."""
    if name not in VARIANTS:
        raise UserError(f"There is no variant {name!r}; known are {', '.join(VARIANTS)}.")
    return VARIANTS[name]
