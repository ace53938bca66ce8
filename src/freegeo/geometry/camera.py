"""Pinhole cameras: intrinsics, fields of view, projection and the models' pose encodings.

The one pixel rule of this package: **the centre of the pixel in column ``u``, row ``v`` has the coordinates
``(u, v)``**, whole numbers starting at 0 (docs/models/vggt.md, "Unprojection"). ``K`` is in pixels of the image it
travels with. Where a model counts pixel centres differently (the ray head: ``u + 0.5``), the difference stays inside
that function.

Axes are OpenCV's: x right, y down, z forward. Fields of view are full angles in radians, vertical and horizontal named.
"""

import torch
from torch import Tensor

from freegeo.errors import UserError
from freegeo.geometry.rotation import matrix_to_quat_xyzw, quat_xyzw_to_matrix, rotate
from freegeo.geometry.se3 import from_Rt, inverse

__all__ = [
    "K_from_focal",
    "K_from_fov",
    "decode_camera_to_world",
    "decode_world_to_camera",
    "encode_camera_to_world",
    "fov_from_K",
    "photo_K",
    "pixel_grid",
    "project",
    "resize_K",
]

SMALLEST_TANGENT = 1e-6  # bounds the focal length of a zero field of view (DA3's rule)


def K_from_focal(focal_x: Tensor, focal_y: Tensor, centre_x: Tensor, centre_y: Tensor) -> Tensor:
    """Intrinsics (..., 3, 3) without skew from focal lengths and principal point (...), all in pixels."""
    focal_x, focal_y, centre_x, centre_y = torch.broadcast_tensors(focal_x, focal_y, centre_x, centre_y)
    zero, one = torch.zeros_like(focal_x), torch.ones_like(focal_x)
    entries = (focal_x, zero, centre_x, zero, focal_y, centre_y, zero, zero, one)
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


def K_from_fov(fov_vertical: Tensor, fov_horizontal: Tensor, image_hw: tuple[int, int]) -> Tensor:
    """Intrinsics (..., 3, 3) from full fields of view (...) in radians; the principal point is ``(W / 2, H / 2)``.

    ``f = (side / 2) / max(tan(fov / 2), 1e-6)``: a field of view of 0, or above pi, gives a huge but finite focal
    length (docs/models/da3.md, "Camera decoder"). VGGT's decoder has no bound; the two agree wherever its result is
    finite and positive (docs/models/vggt.md, "Pose encoding").
    """
    height, width = image_hw
    focal_y = (height / 2) / (fov_vertical / 2).tan().clamp(min=SMALLEST_TANGENT)
    focal_x = (width / 2) / (fov_horizontal / 2).tan().clamp(min=SMALLEST_TANGENT)
    return K_from_focal(focal_x, focal_y, focal_x.new_tensor(width / 2), focal_x.new_tensor(height / 2))


def fov_from_K(K: Tensor, image_hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """(vertical, horizontal) full fields of view (...) in radians of ``K`` (..., 3, 3).

    The principal point is ignored, as in both models' encoders.
    """
    height, width = image_hw
    return 2 * torch.atan((height / 2) / K[..., 1, 1]), 2 * torch.atan((width / 2) / K[..., 0, 0])


def resize_K(K: Tensor, from_hw: tuple[int, int], to_hw: tuple[int, int]) -> Tensor:
    """``K`` (..., 3, 3) of an image resized from ``from_hw`` to ``to_hw``.

    Row 0 is multiplied by the width ratio, row 1 by the height ratio, principal point included and without a half-pixel
    shift: the rule of both models (docs/models/da3.md, "Images") and of the benchmark
    (docs/benchmark.md, "Fusion and scoring").
    """
    ratios = K.new_tensor([to_hw[1] / from_hw[1], to_hw[0] / from_hw[0], 1.0])
    return K * ratios[:, None]


def photo_K(K: Tensor, scale_xy: Tensor, offset_xy: Tensor) -> Tensor:
    """``K`` (..., 3, 3) of photos from that of a model's images, where a photo's pixel u is at ``u * scale + offset``.

    ``scale_xy`` and ``offset_xy`` are (..., 2), x first. The offset is negative where a photo was cropped and positive
    where it was padded; `ImageBatch` carries both. The principal point moves as any other place of the image.
    """
    rows = torch.cat((K[..., :2, :2], K[..., :2, 2:] - offset_xy[..., None]), dim=-1) / scale_xy[..., None]
    return torch.cat((rows, K[..., 2:, :]), dim=-2)


def pixel_grid(image_hw: tuple[int, int], *, like: Tensor) -> Tensor:
    """Pixel coordinates (H, W, 3): ``(u, v, 1)`` at row ``v``, column ``u``; dtype and device of ``like``."""
    height, width = image_hw
    v, u = torch.meshgrid(
        torch.arange(height, dtype=like.dtype, device=like.device),
        torch.arange(width, dtype=like.dtype, device=like.device),
        indexing="ij",
    )
    return torch.stack((u, v, torch.ones_like(u)), dim=-1)


def project(points_cam: Tensor, K: Tensor) -> Tensor:
    """Pixel coordinates (..., *any, 2) of camera-frame points (..., *any, 3) under ``K`` (..., 3, 3).

    The leading dimensions of ``K`` are the first ones of the points. Points with z = 0 have no image and give
    non-finite numbers; points behind the camera give the coordinates of their mirror image, so check z > 0.
    """
    homogeneous = rotate(K, points_cam)
    return homogeneous[..., :2] / homogeneous[..., 2:]


def decode_camera_to_world(encoding: Tensor, image_hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """DA3's nine numbers (..., 9) as ``T_cam_world`` (..., 4, 4) and ``K`` (..., 3, 3) in pixels of ``image_hw``.

    The numbers are the *camera-to-world* pose: camera centre (3), quaternion xyzw of any length (4), vertical and
    horizontal field of view (docs/models/da3.md, "Camera decoder").
    """
    T_world_cam, K = _decode(encoding, image_hw)
    return inverse(T_world_cam), K


def encode_camera_to_world(T_cam_world: Tensor, K: Tensor, image_hw: tuple[int, int]) -> Tensor:
    """Cameras as DA3's nine camera-to-world numbers (..., 9) (docs/models/da3.md, "Known cameras")."""
    T_world_cam = inverse(T_cam_world)
    fov = torch.stack(fov_from_K(K, image_hw), dim=-1)
    return torch.cat((T_world_cam[..., :3, 3], matrix_to_quat_xyzw(T_world_cam[..., :3, :3]), fov), dim=-1)


def decode_world_to_camera(encoding: Tensor, image_hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """VGGT's nine numbers (..., 9) as ``T_cam_world`` (..., 4, 4) and ``K`` (..., 3, 3) in pixels of ``image_hw``.

    As :func:`decode_camera_to_world`, but the numbers are the *world-to-camera* pose
    (docs/models/vggt.md, "Pose encoding").
    """
    return _decode(encoding, image_hw)


def _decode(encoding: Tensor, image_hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
    if encoding.shape[-1] != 9:
        raise UserError(f"A pose encoding has 9 numbers, got shape {tuple(encoding.shape)}.")
    transform = from_Rt(quat_xyzw_to_matrix(encoding[..., 3:7]), encoding[..., :3])
    return transform, K_from_fov(encoding[..., 7], encoding[..., 8], image_hw)
