"""Rotation matrices for tests."""

import torch
from torch import Tensor


def rotation_of(axis_angle: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) about axes (..., 3) by their length in radians."""
    x, y, z = axis_angle.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).unflatten(-1, (3, 3))
    return torch.linalg.matrix_exp(cross)
