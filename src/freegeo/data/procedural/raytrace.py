"""Analytic ray tracing of generated rooms: images, exact z-depth and cameras.

The loop runs over the primitives; rooms, views and pixels are one flat dimension. Ray directions have unit z in the
camera frame, so the ray parameter *is* the z-depth. Source: docs/embedded-model.md, "How the rooms are made".

Pixels. Pixel u of a W pixels wide image covers [u, u + 1) of the image plane, whose middle W / 2 the optical axis
meets; its ray goes through u + 0.5. That makes shrinking by area averaging exact. Written for integer pixel centres,
the rule of `freegeo.geometry.camera`, the same camera has cx = W / 2 - 0.5 and cy = H / 2 - 0.5, and this K is what
is returned: `depth_z` unprojected with it and integer pixel centres gives the exact surface points. Networks of the DA3
and VGGT family decode cx = W / 2 instead: half a pixel, or about 0.4 degrees of viewing direction at 96 pixels and 0.15
at 256. For the same reason scaling the rows of K by w' / w and h' / h, as those models do when they shrink a photo, is
off by (1 - w' / w) / 2 pixels from the K rendered at the small size; `resized_intrinsics` is the exact rule.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from freegeo.data.procedural.rooms import RoomBatch
from freegeo.data.procedural.textures import TEXTURE_SIZE, TextureBank, texture_bank
from freegeo.errors import UserError

LAMP_GAIN = 0.95
LAMP_REACH_M = 5.0
"""Distance in metres at which the lamp's light has fallen to half."""
GRAIN_CELLS = 96
"""Image noise has this many cells across the width whatever the resolution, so shrinking a photo keeps it."""

_NEAREST = 1e-3
_TINY = 1e-8
RAYS_PER_CHUNK_CPU = 1 << 16  # the working set of a chunk stays in the processor's cache
RAYS_PER_CHUNK_CUDA = 1 << 24


class RenderedViews(NamedTuple):
    """What `render` returns."""

    images: Tensor
    """(B, S, 3, H, W) RGB in [0, 1]."""
    depth_z: Tensor
    """(B, S, H, W) metres along the optical axis, exact at the pixel centres, positive everywhere."""
    T_cam_world: Tensor
    """(B, S, 4, 4) OpenCV axes."""
    K: Tensor
    """(B, S, 3, 3) in pixels, for integer pixel centres."""


class _Rays(NamedTuple):
    """V views with N rays each, in the frames of their rooms."""

    origin: Tensor  # (V, 3)
    direction: tuple[Tensor, Tensor, Tensor]  # (V, N) each; unit z in the camera frame


def render(
    rooms: RoomBatch, height: int, width: int, *, supersample: int = 1, views: Tensor | list[int] | None = None
) -> RenderedViews:
    """Images and ground truth of the rooms' cameras, on the device the rooms are on.

    Args:
        rooms: from `sample_rooms`.
        height, width: image size in pixels; the horizontal field of view is the room's, pixels are square.
        supersample: rays per pixel and direction. Depth is always traced at the pixel centres.
        views: indices of the cameras to render, the same for all rooms; default all.

    Raises:
        UserError: sizes or `supersample` below 1.
    """
    if min(height, width, supersample) < 1:
        raise UserError(
            f"cannot render {width}x{height} pixels with {supersample}x supersampling; all must be 1 or more"
        )
    views = torch.as_tensor(range(rooms.frames) if views is None else views, device=rooms.device)
    count = len(rooms) * len(views)
    images = torch.empty(count, 3, height, width, device=rooms.device)
    depth_z = torch.empty(count, height, width, device=rooms.device)
    T_cam_room = rooms.T_cam_room[:, views].flatten(0, 1)
    scene = torch.arange(len(rooms), device=rooms.device).repeat_interleave(len(views))
    bank = texture_bank(rooms.domain.bank, str(rooms.device))
    budget = RAYS_PER_CHUNK_CUDA if rooms.device.type == "cuda" else RAYS_PER_CHUNK_CPU
    chunk = max(1, budget // (height * width * supersample**2))
    for part in (slice(start, start + chunk) for start in range(0, count, chunk)):
        size = (height * supersample, width * supersample)
        rays = _camera_rays(T_cam_room[part], rooms.fov_rad[scene[part]], size)
        depth, primitive = _trace(rays, rooms, scene[part])
        colour = _shade(rays, depth, primitive, rooms, scene[part], bank, size[1]).unflatten(-1, size)
        if supersample > 1:
            colour = torch.nn.functional.avg_pool2d(colour, supersample)
            rays = _camera_rays(T_cam_room[part], rooms.fov_rad[scene[part]], (height, width))
            depth, _ = _trace(rays, rooms, scene[part])
        images[part] = colour
        depth_z[part] = depth.unflatten(-1, (height, width))
    split = (len(rooms), len(views))
    images = _record(images.unflatten(0, split), rooms, views)
    K = intrinsics(rooms.fov_rad, height, width)[:, None].expand(*split, 3, 3).clone()
    return RenderedViews(images, depth_z.unflatten(0, split), rooms.T_cam_world[:, views], K)


def intrinsics(fov_rad: Tensor, height: int, width: int) -> Tensor:
    """K (..., 3, 3) of the rendered cameras from their horizontal field of view (...), for integer pixel centres."""
    K = torch.zeros(*fov_rad.shape, 3, 3, dtype=fov_rad.dtype, device=fov_rad.device)
    K[..., 0, 0] = K[..., 1, 1] = 0.5 * width / torch.tan(0.5 * fov_rad)
    K[..., 0, 2] = 0.5 * (width - 1)
    K[..., 1, 2] = 0.5 * (height - 1)
    K[..., 2, 2] = 1.0
    return K


def resized_intrinsics(K: Tensor, old_hw: tuple[int, int], new_hw: tuple[int, int]) -> Tensor:
    """K (..., 3, 3) after the image has been resized from `old_hw` to `new_hw`, for integer pixel centres in both.

    Pixel u covers [u, u + 1), so the principal point moves as (c + 0.5) * scale - 0.5.
    """
    scale = torch.tensor([new_hw[1] / old_hw[1], new_hw[0] / old_hw[0], 1.0], dtype=K.dtype, device=K.device)
    half = torch.zeros_like(K)
    half[..., :2, 2] = 0.5
    return scale[:, None] * (K + half) - half


def _camera_rays(T_cam_room: Tensor, fov_rad: Tensor, hw: tuple[int, int]) -> _Rays:
    """Rays through the pixel centres of V cameras (V, 4, 4) with fields of view (V,)."""
    height, width = hw
    rotation = T_cam_room[:, :3, :3]
    per_pixel = 2.0 * torch.tan(0.5 * fov_rad)[:, None] / width
    x = (torch.arange(width, device=fov_rad.device) + 0.5 - 0.5 * width) * per_pixel
    y = (torch.arange(height, device=fov_rad.device) + 0.5 - 0.5 * height) * per_pixel
    axes = []
    for axis in range(3):
        right, down, forward = (rotation[:, row, axis, None] for row in range(3))
        axes.append(((forward + right * x)[:, None, :] + (down * y)[:, :, None]).flatten(1))
    origin = -(rotation.mT @ T_cam_room[:, :3, 3:])[..., 0]
    return _Rays(origin, (axes[0], axes[1], axes[2]))


def _trace(rays: _Rays, rooms: RoomBatch, scene: Tensor) -> tuple[Tensor, Tensor]:
    """Nearest hit of each ray: parameter (V, N), which is the z-depth, and primitive index (V, N) int64."""
    dx, dy, dz = (torch.where(axis.abs() < _TINY, _TINY, axis) for axis in rays.direction)
    inverse_z = dz.reciprocal()
    ground_square = dx * dx + dy * dy
    length_square = ground_square + dz * dz
    center, yaw, size = rooms.center[scene], rooms.yaw[scene], rooms.size[scene]
    offset = rays.origin[:, None] - center  # (V, P, 3)
    depth = _leave_box(offset[:, 0], (dx, dy, dz), size[:, 0])
    primitive = torch.zeros_like(depth, dtype=torch.int64)
    for k in range(1, center.shape[1]):
        ox, oy, oz = (offset[:, k, axis, None] for axis in range(3))
        sx, sy, sz = (size[:, k, axis, None] for axis in range(3))
        if k < rooms.first_sphere:
            cosine, sine = yaw[:, k, :1], yaw[:, k, 1:]
            near_x, far_x = _slab(cosine * ox + sine * oy, (cosine * dx + sine * dy).reciprocal(), sx)
            near_y, far_y = _slab(cosine * oy - sine * ox, (cosine * dy - sine * dx).reciprocal(), sy)
            near_z, far_z = _slab(oz, inverse_z, sz)
            enter = torch.maximum(torch.maximum(near_x, near_y), near_z)
            leave = torch.minimum(torch.minimum(far_x, far_y), far_z)
        elif k < rooms.first_cylinder:
            along = dx * ox + dy * oy + dz * oz
            enter, leave = _quadric(length_square, along, ox * ox + oy * oy + oz * oz - sx * sx.abs())
        else:
            enter, leave = _quadric(ground_square, dx * ox + dy * oy, ox * ox + oy * oy - sx * sx.abs())
            near_z, far_z = _slab(oz, inverse_z, sz)
            enter, leave = torch.maximum(enter, near_z), torch.minimum(leave, far_z)
        # A missed quadric is NaN, and comparisons with NaN are false.
        hit = (enter < leave) & (enter > _NEAREST) & (enter < depth)
        depth = torch.where(hit, enter, depth)
        primitive.masked_fill_(hit, k)
    return depth, primitive


def _leave_box(origin: Tensor, direction: tuple[Tensor, Tensor, Tensor], half: Tensor) -> Tensor:
    """Where rays from `origin` (V, 3) inside an upright box of half sizes (V, 3) leave it."""
    exits = [_slab(origin[:, a, None], direction[a].reciprocal(), half[:, a, None])[1] for a in range(3)]
    return torch.minimum(torch.minimum(exits[0], exits[1]), exits[2])


def _slab(origin: Tensor, inverse: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """Ray parameters of entering and leaving |coordinate| <= half; a negative half size is never entered."""
    middle, extent = -origin * inverse, half * inverse.abs()
    return middle - extent, middle + extent


def _quadric(a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Roots of a t^2 + 2 b t + c = 0 in ascending order, NaN where there are none."""
    root = torch.sqrt(b * b - a * c)
    inverse = a.reciprocal()
    return (-b - root) * inverse, (root - b) * inverse


def _shade(
    rays: _Rays, depth: Tensor, primitive: Tensor, rooms: RoomBatch, scene: Tensor, bank: TextureBank, width: int
) -> Tensor:
    """Linear colour (V, 3, N) of the hits: textured albedo under ambient light and lamps, which cast no shadows."""
    row = scene[:, None] * rooms.center.shape[1] + primitive
    center, size, yaw = (getattr(rooms, name).flatten(0, 1).unbind(-1) for name in ("center", "size", "yaw"))
    point = [rays.origin[:, a, None] + depth * rays.direction[a] for a in range(3)]
    cosine, sine = yaw[0][row], yaw[1][row]
    local = _turned([point[a] - center[a][row] for a in range(3)], cosine, sine)
    scaled = [local[a] / size[a][row] for a in range(3)]
    axis, normal = _surface(scaled, primitive, rooms)

    footprint = depth * (2.0 * torch.tan(0.5 * rooms.fov_rad[scene])[:, None] / width)
    albedo = _albedo(local, scaled, axis, primitive, footprint, rooms, scene, bank)
    light = rooms.ambient[scene][:, None, None]
    for position, colour in zip(rooms.lamp_position.unbind(1), rooms.lamp_colour.unbind(1), strict=True):
        lamp = _turned([position[scene][:, a, None] - point[a] for a in range(3)], cosine, sine)
        distance_square = lamp[0] ** 2 + lamp[1] ** 2 + lamp[2] ** 2
        facing = lamp[0] * normal[0] + lamp[1] * normal[1] + lamp[2] * normal[2]
        strength = LAMP_GAIN * facing.clamp_min(0.0) * distance_square.clamp_min(1e-4).rsqrt()
        strength = strength / (1.0 + distance_square / LAMP_REACH_M**2)
        light = light + strength[:, None] * colour[scene][..., None]
    return (rooms.domain.exposure * albedo * light).clamp_(0.0, 1.0)


def _turned(vector: list[Tensor], cosine: Tensor, sine: Tensor) -> list[Tensor]:
    """Coordinates in the frame that is turned about the vertical."""
    x, y, z = vector
    return [cosine * x + sine * y, cosine * y - sine * x, z]


def _surface(scaled: list[Tensor], primitive: Tensor, rooms: RoomBatch) -> tuple[Tensor, list[Tensor]]:
    """Axis (V, N) along which the surface is textured and the unit normal in the primitive's frame.

    `scaled` is the hit in units of the primitive's half sizes, so faces, caps and shells are where it reaches 1.
    """
    x, y, z = scaled
    abs_x, abs_y, abs_z = x.abs(), y.abs(), z.abs()
    is_cylinder = primitive >= rooms.first_cylinder
    is_sphere = (primitive >= rooms.first_sphere) & ~is_cylinder
    is_z = abs_z > torch.where(is_cylinder, torch.hypot(x, y), torch.maximum(abs_x, abs_y))
    is_x = ~is_z & (abs_x > abs_y)
    axis = torch.where(is_z, 2, torch.where(is_x, 0, 1))
    is_flat = ~is_sphere & ~(is_cylinder & ~is_z)
    # The room is seen from inside: its normals point to the middle.
    sign = torch.where(primitive == 0, -1.0, 1.0)
    normal_x = torch.where(is_flat, sign * x.sign() * is_x, x)
    normal_y = torch.where(is_flat, sign * y.sign() * (axis == 1), y)
    normal_z = torch.where(is_flat, sign * z.sign() * is_z, torch.where(is_sphere, z, 0.0))
    return axis, [normal_x, normal_y, normal_z]


def _albedo(
    local: list[Tensor],
    scaled: list[Tensor],
    axis: Tensor,
    primitive: Tensor,
    footprint: Tensor,
    rooms: RoomBatch,
    scene: Tensor,
    bank: TextureBank,
) -> Tensor:
    """Colour (V, 3, N) of the surfaces: the first colour, mixed with the second and third by two textures."""
    x, y, z = local
    along = torch.where(axis == 0, x, torch.where(axis == 1, y, z))
    u, v = torch.where(axis == 0, y, x), torch.where(axis == 2, y, z)
    side = (torch.where(axis == 0, scaled[0], torch.where(axis == 1, scaled[1], scaled[2])) > 0).long()
    materials = rooms.texture.shape[1]
    material = torch.where(primitive == 0, 2 * axis + side, 5 + primitive) + scene[:, None] * materials
    # Faces of one object cut the texture at different places; the room's faces have materials of their own.
    shift = along.sign() * 0.31 + axis * 0.17
    mix = []
    for layer in range(2):
        inverse = (1.0 / rooms.period_m[..., layer]).flatten()[material]
        offset_u, offset_v = (rooms.offset[:, :, layer, c].flatten()[material] for c in range(2))
        index = rooms.texture[..., layer].flatten()[material]
        texels = footprint * inverse * TEXTURE_SIZE
        first, second = (u, v) if layer == 0 else (v, u)
        mix.append(bank.sample(index, first * inverse + offset_u + shift, second * inverse + offset_v, texels))
    colours = rooms.colour.flatten(0, 1)  # (B M, 3, 3)
    channels = []
    for channel in range(3):
        one, two, three = (colours[:, k, channel][material] for k in range(3))
        channels.append(torch.lerp(torch.lerp(one, two, mix[0]), three, 0.7 * mix[1]))
    return torch.stack(channels, dim=1)


def _record(images: Tensor, rooms: RoomBatch, views: Tensor) -> Tensor:
    """The camera's response (B, S, 3, H, W): colour cast, gamma and grain, where the domain has them."""
    domain = rooms.domain
    if domain.colour_cast > 0.0:
        images = images * rooms.cast[:, None, :, None, None]
    if domain.gamma != (1.0, 1.0):
        images = images ** rooms.gamma[:, None, None, None, None]
    if domain.grain > 0.0:
        images = (images + domain.grain * _grain(rooms, views, (images.shape[-2], images.shape[-1]))).clamp(0.0, 1.0)
    return images


def _grain(rooms: RoomBatch, views: Tensor, hw: tuple[int, int]) -> Tensor:
    """Noise (B, S, 3, H, W) of unit variance that depends on the room's seed and the view's index alone."""
    cells = (round(GRAIN_CELLS * hw[0] / hw[1]), GRAIN_CELLS)
    noise = np.stack(
        [
            np.stack([np.random.default_rng((seed, 5, view)).standard_normal((3, *cells)) for view in views.tolist()])
            for seed in rooms.seeds
        ]
    )
    cells_noise = torch.from_numpy(noise.astype(np.float32)).flatten(0, 1).to(rooms.device)
    grain = torch.nn.functional.interpolate(cells_noise, size=hw, mode="bilinear", align_corners=False)
    # Interpolation averages cells; each view is rescaled alone, so that it does not depend on its batch.
    return (grain / grain.std(dim=(1, 2, 3), keepdim=True)).unflatten(0, (len(rooms), len(views)))
