"""What the photos of a scene teach in recipe `evidence`: cameras by bundle adjustment, from a part of their matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from freegeo.adaptation.losses import CameraTargets
from freegeo.errors import NoEvidenceError
from freegeo.evidence.matches import Matches
from freegeo.evidence.refinement import Refinement, refine
from freegeo.export.reconstruction import Reconstruction
from freegeo.geometry.se3 import transform_points
from freegeo.guarded import scene_matches
from freegeo.types import PhotoLike

JUDGING = 1 / 3
"""Share of the pairs of photos that teach nothing and judge the adapter."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Lesson:
    """What one scene teaches, and what is left to judge by."""

    targets: CameraTargets
    judging: Matches
    """Matches of the pairs that had no part in the targets."""


def lesson(
    name: str,
    photos: Sequence[PhotoLike],
    frozen: Reconstruction,
    store: Path | None = None,
    *,
    seed: int,
    device: str = "cpu",
) -> Lesson:
    """Refine the frozen prediction of a scene with a part of its pairs of photos.

    Args:
        name: of the scene, for messages.
        photos: those of the prediction.
        frozen: their prediction by the frozen model.
        store: file for the matches; None: they are not stored.
        seed: decides which pairs teach.
        device: where depth maps are compared.

    Raises:
        NoEvidenceError: the matches prove no cameras.
        UserError: the prediction has no cameras, or pycolmap is not installed.
    """
    matches = scene_matches(photos, frozen, store, device=device)
    teaching, judging = split_pairs(matches, seed)
    found = refine(frozen, teaching)
    if not found.accepted:
        raise NoEvidenceError(
            f"not adapted: the matches between the photos of {name} prove no cameras to learn from. {found.reason}"
        )
    return Lesson(targets=targets_of(found), judging=judging)


def split_pairs(matches: Matches, seed: int) -> tuple[Matches, Matches]:
    """Return the pairs that teach, and those that judge what was learned: no pair is in both."""
    order = np.random.default_rng(seed).permutation(len(matches.pairs))
    judges = round(JUDGING * len(order))
    return matches.only(np.sort(order[judges:])), matches.only(np.sort(order[:judges]))


def targets_of(refinement: Refinement) -> CameraTargets:
    """Return the cameras of an accepted refinement as targets; views that merely follow others are not known."""
    T, K, tracks = refinement.T_cam_world, refinement.K, refinement.tracks
    assert refinement.accepted
    assert T is not None
    assert K is not None
    assert tracks is not None
    cameras = torch.from_numpy(T)
    depth = transform_points(cameras[tracks.view], torch.from_numpy(tracks.xyz)[tracks.point])[:, 2]
    return CameraTargets(
        T_cam_world=cameras.float(),
        K=torch.from_numpy(K).float(),
        known=torch.from_numpy(refinement.refined),
        distance=float(depth.median()),
    )
