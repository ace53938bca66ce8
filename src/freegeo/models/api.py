"""The contract of a reconstruction model: embed, aggregate, decode (docs/architecture.md).

`embed` sees one image at a time and is never adapted; `aggregate` mixes the views and is the only place where an
adapter acts; `decode` turns the features of any selection of views into depth and cameras.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from freegeo.errors import UserError
from freegeo.models.spec import MIXED, LoadedFrom, Mixed, ModelSpec
from freegeo.types import Features, ImageBatch, PhotoLike, Prediction, Priors, ViewTokens

Want = Literal["depth", "cameras", "ray_cameras", "rays", "points"]
"""What `decode` can predict; `ray_cameras` are cameras found from the rays instead of those of the camera head."""


class ReconstructionModel(nn.Module, ABC):
    """A feed-forward multi-view reconstruction model in three stages."""

    spec: ModelSpec
    loaded_from: LoadedFrom | None = None
    """Where the weights came from; None for a model that was built and not loaded."""
    published_adapter_root: str = ""
    """Module that adapter files of the method's authors name layers relative to; empty: the model itself."""

    adapted_at: int | None = None
    """Longest side of the images that the adapter in place was trained on; None: unknown, or no adapter."""

    feature_copies: int = 1
    """Copies of all features that `aggregate` makes, such as normalised ones; the memory planner counts them."""
    feature_channels: int | None = None
    """Channels of the features at `spec.loss_layers`; None: twice the width, where two blocks' outputs are joined."""

    read_channels: int | None = None
    """Channels of a token that `decode` reads, of all levels together; None: those of four levels, with their copies.
    The memory planner counts them, and the next."""
    peak_channels: float | None = None
    """Numbers for each pixel of a view that `decode` holds at its widest moment, besides what it reads and returns;
    None: those of a DPT head."""

    @abstractmethod
    def preprocess(
        self, photos: Sequence[PhotoLike], *, mixed: Mixed = MIXED, process_res: int | None = None
    ) -> ImageBatch:
        """Resize photos as the model was trained, to one size by the rule `mixed`; UserError for an unusable photo.

        `process_res` is the longest side that is asked for, None the model's default; it is given only where
        `spec.sides` is not None.
        """

    @abstractmethod
    def embed(self, images: Tensor, *, layers: Collection[int] | None = None) -> ViewTokens:
        """Run everything below the first cross-view layer on images (B, S, 3, H, W) in [0, 1].

        `layers` are those that `aggregate` will return; None means all that the decoder reads.
        """

    @abstractmethod
    def aggregate(
        self,
        tokens: ViewTokens,
        *,
        layers: Collection[int] | None = None,
        reference: str = "first",
        priors: Priors | None = None,
    ) -> Features:
        """Mix the views; `layers` limits the result to some of the decoder's layers, nothing above them is computed.

        `priors` are what is known of the views, in any world frame and unit: the model normalises them. UserError for
        priors that `spec.takes` excludes; a model that takes parts uses what `freegeo.models.priors.usable` leaves.
        """

    @abstractmethod
    def decode(self, features: Features, *, want: Collection[Want] = ("depth", "cameras")) -> Prediction:
        """Predict depth and cameras from the features of the given views; results have leading dimensions (B, S)."""

    @abstractmethod
    def adapter_targets(self) -> list[str]:
        """Return the exact names of the linear layers an adapter may sit on."""

    @property
    @abstractmethod
    def camera_token_name(self) -> str | None:
        """Name of the parameter that marks reference and other views; None when the model has none."""

    def set_recompute(self, recompute: bool) -> None:
        """Turn per-block activation checkpointing of `aggregate` on or off; a model without it keeps everything."""

    @property
    def cross_view(self) -> ReconstructionModel | None:
        """The part with the cross-view layers, which an adapter belongs to; None for a model of single views."""
        return self

    def adaptable(self) -> ReconstructionModel:
        """Return the part that an adapter belongs to; UserError for a model without cross-view layers."""
        part = self.cross_view
        if part is None:
            raise UserError(
                f"{self.spec.name} looks at each photo by itself: it has no cross-view layers, which adaptation works "
                "on. Reconstruct without adapting (--no-adapt, or `freegeo reconstruct`), or use another model."
            )
        return part


def check_layers(layers: Collection[int], depth: int, model: str) -> None:
    """Raise UserError when `layers` has one that a model of `depth` layers does not have."""
    unknown = sorted(set(layers) - set(range(depth)))
    if unknown or not layers:
        raise UserError(f"{model} has layers 0 to {depth - 1}; asked for {unknown or 'none'}. Choose among them.")


def check_want(want: Collection[str], offered: Collection[Want], model: str) -> None:
    """Raise UserError when `want` has something that a model does not predict."""
    unknown = sorted(set(want) - set(offered))
    if unknown:
        raise UserError(f"{model} does not predict {', '.join(unknown)}. Choose among {', '.join(sorted(offered))}.")


def level_tokens(features: Features, layers: Collection[int], model: str) -> list[tuple[Tensor, Tensor]]:
    """Return the features of the layers a head reads; UserError when one is not in `features`."""
    missing = [layer for layer in layers if layer not in features.levels]
    if missing:
        raise UserError(
            f"{model} decodes from layers {sorted(layers)}, and the features lack {missing}. "
            "Call aggregate without `layers`, or with all of them."
        )
    return [features.levels[layer] for layer in layers]


@torch.no_grad()
def embed_in_chunks(
    model: ReconstructionModel, images: Tensor, *, device: torch.device, layers: Sequence[int] | None = None
) -> ViewTokens:
    """Embed images (S, 3, H, W) a few at a time, so that memory does not grow with S except for the result.

    On the CPU one at a time: then a view's tokens do not depend, in the last bit, on the views beside it.
    """
    chunk = views_per_chunk(device)
    parts = [model.embed(part.to(device)[None], layers=layers) for part in images.split(chunk)]
    return ViewTokens.join_views(parts)


def views_per_chunk(device: torch.device) -> int:
    """Return how many views are embedded together."""
    return 1 if device.type == "cpu" else 8
