"""Keypoints of one photo and their descriptors: the interface of an extractor, and root-SIFT."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

__all__ = ["Extractor", "Features", "RootSift"]


@dataclass(frozen=True, kw_only=True)
class Features:
    """The keypoints of one image; a place may occur several times, with different descriptors."""

    pixel: np.ndarray
    """(n, 2) float32 column and row, pixel centres at whole numbers."""
    descriptor: np.ndarray
    """(n, d) float32 of unit length: their inner product says how alike two places look."""


class Extractor(Protocol):
    """Finds keypoints; the same image gives the same result."""

    @property
    def name(self) -> str:
        """What it is and how it is set, for the fingerprint of stored matches."""
        ...

    def extract(self, image: np.ndarray, mask: np.ndarray | None = None) -> Features:
        """Return the features of an RGB image (H, W, 3) uint8; only where `mask` (H, W) bool is true, if given."""
        ...


@dataclass(frozen=True, kw_only=True)
class RootSift:
    """SIFT (Lowe 2004) with square-rooted descriptors (Arandjelovic and Zisserman 2012), by OpenCV."""

    most: int = 2000
    """Keypoints kept, those of highest contrast."""
    contrast: float = 0.005
    """Least contrast of a keypoint, OpenCV's `contrastThreshold`. Far below its usual 0.04: plain walls and small
    photos then have several times the matches, no less exact ones (docs/evidence.md, "Matches")."""

    @property
    def name(self) -> str:
        """Name and settings."""
        return f"root-sift most={self.most} contrast={self.contrast:g}"

    def extract(self, image: np.ndarray, mask: np.ndarray | None = None) -> Features:
        """Return the features of an RGB image (H, W, 3) uint8; only where `mask` (H, W) bool is true, if given."""
        import cv2

        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        # Without the precise upscaling every keypoint lies a quarter of a pixel too far right and down.
        sift = cv2.SIFT.create(
            nfeatures=0 if mask is not None else self.most,
            contrastThreshold=self.contrast,
            enable_precise_upscale=True,
        )
        keypoints, descriptors = sift.detectAndCompute(grey, None)
        if descriptors is None or not keypoints:
            return Features(pixel=np.zeros((0, 2), np.float32), descriptor=np.zeros((0, 128), np.float32))
        pixel = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float32)
        strength = np.array([keypoint.response for keypoint in keypoints])
        # The strongest first, the same order whatever the number of threads; OpenCV may return one more on ties.
        order = np.lexsort((pixel[:, 0], pixel[:, 1], -strength))
        if mask is not None:
            column, row = np.clip(np.rint(pixel), 0, np.array(grey.shape[::-1]) - 1).astype(np.int64).T
            order = order[mask[row, column][order]]
        chosen = order[: self.most]
        total = descriptors.sum(axis=1, keepdims=True)
        root = np.sqrt(descriptors / np.maximum(total, 1e-12))
        return Features(pixel=pixel[chosen], descriptor=root[chosen].astype(np.float32))
