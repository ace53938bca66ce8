"""Scenes: views that stay together."""

from dataclasses import FrozenInstanceError

import numpy as np
import pytest
import torch

from freegeo.data.photos import MemoryPhoto
from freegeo.data.scene import Scene
from freegeo.errors import UserError


def scene(views: int = 5, **changes) -> Scene:
    photos = tuple(MemoryPhoto(f"{i}.png", np.full((2, 3, 3), i, np.uint8)) for i in range(views))
    numbers = torch.arange(views, dtype=torch.float32)[:, None, None]
    given = {
        "name": "numbered",
        "photos": photos,
        "T_cam_world": numbers * torch.ones(4, 4),
        "K": numbers * torch.ones(3, 3),
        "depth_z": numbers * torch.ones(2, 3),
    }
    return Scene(**{**given, **changes})


def test_selection_keeps_views_and_their_truth_together():
    chosen = scene().select([4, 0, 2])
    assert [int(photo.read()[0, 0, 0]) for photo in chosen.photos] == [4, 0, 2]
    for tensor in (chosen.T_cam_world, chosen.K, chosen.depth_z):
        assert tensor[:, 0, 0].tolist() == [4.0, 0.0, 2.0]
    assert chosen.name == "numbered" and len(chosen) == 3 and len(scene()) == 5


def test_unknown_truth_stays_unknown():
    chosen = scene(T_cam_world=None, K=None, depth_z=None).select(range(2))
    assert chosen.T_cam_world is None and chosen.K is None and chosen.depth_z is None and chosen.truth is None


def test_truth_of_another_number_of_views_is_refused():
    with pytest.raises(UserError, match="numbered: 5 photos, but K is of 4 views"):
        scene(K=torch.eye(3).expand(4, 3, 3))


def test_a_scene_does_not_change():
    with pytest.raises(FrozenInstanceError):
        scene().name = "other"
