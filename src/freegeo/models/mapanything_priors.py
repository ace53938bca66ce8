"""What MapAnything is told of its views (docs/models/mapanything.md, "Conditioning"): rays, depth and poses, encoded.

Letters: B scenes, S views, V views of all scenes, P patches, D width, C channels of an input.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from freegeo.errors import UserError
from freegeo.geometry.camera import pixel_grid
from freegeo.geometry.rotation import matrix_to_quat_xyzw, quat_xyzw_to_matrix, rotate
from freegeo.geometry.se3 import inverse
from freegeo.types import Priors

EPS = 1e-6
TINY = 1e-8

Hints = Mapping[str, tuple[Tensor, Tensor]]
"""Name of an encoder -> what it reads of every view (B, S, ...), and which views (B, S) have it."""


class ResidualConv(nn.Module):
    """Two 3 x 3 convolutions beside a 1 x 1 one."""

    def __init__(self, channels_in: int, channels: int):
        super().__init__()
        self.conv1 = nn.Conv2d(channels_in, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)
        self.shortcut = nn.Conv2d(channels_in, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return gelu(conv2(gelu(conv1(x))) + shortcut(x))."""
        return F.gelu(self.conv2(F.gelu(self.conv1(x))) + self.shortcut(x))


class DenseEncoder(nn.Module):
    """Encodes a map, patch by patch."""

    def __init__(self, channels_in: int, channels: Sequence[int], width: int, patch_size: int):
        super().__init__()
        first, second, third = channels
        self.patch_size = patch_size
        self.conv_in = nn.Conv2d(channels_in * patch_size**2, first, 3, padding=1)
        self.encoder = nn.Sequential(
            ResidualConv(first, second), ResidualConv(second, third), nn.Conv2d(third, width, 1)
        )
        self.norm_layer = nn.LayerNorm(width, eps=EPS)

    def forward(self, maps_VCHW: Tensor) -> Tensor:
        """Return tokens (V, P, D)."""
        x = self.encoder(self.conv_in(F.pixel_unshuffle(maps_VCHW, self.patch_size)))
        return self.norm_layer(x.flatten(2).transpose(1, 2))


class GlobalEncoder(nn.Module):
    """Encodes a vector, the same for all patches of a view."""

    def __init__(self, channels_in: int, channels: Sequence[int], width: int):
        super().__init__()
        first, second, third = channels
        # Nested as the official names have it.
        x = nn.Sequential(nn.Linear(channels_in, first), nn.GELU())
        x = nn.Sequential(x, nn.Linear(first, second), nn.GELU())
        x = nn.Sequential(x, nn.Linear(second, third), nn.GELU())
        self.encoder = nn.Sequential(x, nn.Linear(third, width))
        self.norm_layer = nn.LayerNorm(width, eps=EPS)

    def forward(self, vectors_VC: Tensor) -> Tensor:
        """Return tokens (V, 1, D)."""
        return self.norm_layer(self.encoder(vectors_VC))[:, None]


def hints_of(priors: Priors, image_hw: tuple[int, int], model: str) -> Hints:
    """Return what the encoders read of priors, on the CPU.

    Raises:
        UserError: a view's depth is known and its intrinsics are not, without which there are no rays to measure along.
    """
    hints: dict[str, tuple[Tensor, Tensor]] = {}
    if priors.K is None and priors.T_cam_world is None and priors.depth_z is None:
        return hints
    has_K = priors.views_with("K")
    metric = torch.full_like(has_K, priors.metric)
    rays = None
    if priors.K is not None:
        rays = rays_of(priors.K.double(), image_hw)
        hints |= ray_hints(rays, has_K)
    if priors.depth_z is not None:
        has_depth = (priors.depth_z > 0).flatten(2).any(-1)
        if (has_depth & ~has_K).any():
            raise UserError(
                f"{model} takes the depth of a view together with its intrinsics, and some depth here is without. Give "
                "the intrinsics too, or leave that depth out."
            )
        if rays is not None:
            hints |= depth_hints(along_rays(priors.depth_z.double(), rays), has_depth, metric)
    if priors.T_cam_world is not None:
        T_world_cam = inverse(priors.T_cam_world.double())
        quat = matrix_to_quat_xyzw(T_world_cam[..., :3, :3])
        hints |= pose_hints(quat, T_world_cam[..., :3, 3], priors.views_with("pose"), metric)
    return hints


def rays_of(K: Tensor, image_hw: tuple[int, int]) -> Tensor:
    """Unit directions (..., H, W, 3) of the pixels, in the camera's frame, of K (..., 3, 3); skew is ignored."""
    u, v, one = pixel_grid(image_hw, like=K).unbind(-1)
    focal_x, focal_y, centre_x, centre_y = (
        K[..., row, column, None, None] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2))
    )
    x, y = (u - centre_x) / focal_x, (v - centre_y) / focal_y
    return F.normalize(torch.stack([x, y, one.expand_as(x)], dim=-1), dim=-1)


def along_rays(depth_z: Tensor, rays: Tensor) -> Tensor:
    """Distances (..., H, W) along unit rays (..., H, W, 3) of depths along the optical axis."""
    return (depth_z / rays[..., 2]).abs()


def ray_hints(rays_BSHW3: Tensor, known_BS: Tensor) -> Hints:
    """Return the hints of unit directions."""
    return {"ray_dirs_encoder": (rays_BSHW3.movedim(-1, 2), known_BS)}


def depth_factor(distance: Tensor) -> Tensor:
    """Mean (...) of the known distances (..., H, W), which are above 0; at least 1e-8."""
    known = distance > 0
    return (distance.sum((-2, -1)) / (known.sum((-2, -1)) + TINY)).clamp(min=TINY)


def depth_hints(distance_BSHW: Tensor, known_BS: Tensor, metric_BS: Tensor) -> Hints:
    """Return the hints of distances along rays, each view's in its own unit; metric views say which one."""
    factor = depth_factor(distance_BSHW)
    return {
        "depth_encoder": ((distance_BSHW / factor[..., None, None]).log1p()[:, :, None], known_BS),
        "depth_scale_encoder": ((factor + TINY).log()[..., None], known_BS & metric_BS),
    }


def relative_poses(quat_xyzw_BS4: Tensor, trans_BS3: Tensor) -> tuple[Tensor, Tensor]:
    """Poses relative to view 0, from poses camera to world; the quaternion's sign is that of the product."""
    first = quat_xyzw_BS4[:, :1]
    inverted = torch.cat([-first[..., :3], first[..., 3:]], dim=-1) / first.square().sum(-1, keepdim=True)
    moved = rotate(quat_xyzw_to_matrix(inverted), (trans_BS3 - trans_BS3[:, :1])[:, :, None])[:, :, 0]
    return _product(inverted, quat_xyzw_BS4), moved


def _product(a_xyzw: Tensor, b_xyzw: Tensor) -> Tensor:
    """Hamilton product of quaternions (..., 4)."""
    (a, a_w), (b, b_w) = ((q[..., :3], q[..., 3:]) for q in (a_xyzw, b_xyzw))
    vector = a_w * b + b_w * a + torch.linalg.cross(a, b)
    return torch.cat([vector, a_w * b_w - (a * b).sum(-1, keepdim=True)], dim=-1)


def translation_factor(trans_BS3: Tensor) -> Tensor:
    """Mean length (B,) of the translations of a scene that are not 0; at least 1e-8."""
    length = torch.linalg.vector_norm(trans_BS3, dim=-1)
    return (length.sum(-1) / ((length > 0).sum(-1) + TINY)).clamp(min=TINY)


def pose_hints(quat_xyzw_BS4: Tensor, trans_BS3: Tensor, known_BS: Tensor, metric_BS: Tensor) -> Hints:
    """Return the hints of poses camera to world, view 0 among them; lengths in their mean, which metric views say."""
    quat, trans = relative_poses(quat_xyzw_BS4, trans_BS3)
    trans = torch.where(known_BS[..., None], trans, 0.0)
    factor = translation_factor(trans)[:, None, None]
    return {
        "cam_rot_encoder": (quat, known_BS),
        "cam_trans_encoder": (trans / factor, known_BS),
        "cam_trans_scale_encoder": ((factor + TINY).log().expand(*trans.shape[:2], 1), known_BS & metric_BS),
    }
