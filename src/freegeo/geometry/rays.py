"""Cameras from a predicted ray map (DA3's ``use_ray_pose``; docs/models/da3.md, "Cameras from rays").

`intrinsics_from_rays` is for rays in the camera's own frame (docs/models/mapanything.md, "Intrinsics").

A ray map gives each cell a direction and an origin in the reference frame. Directions are a homography of the image
plane, ``direction ~ R_world_cam K^-1 (x, y, 1)``; it is estimated robustly and split into rotation and intrinsics.

The published rule splits it with a *lower* triangular factor, which is exact only for a centred principal point. It is
kept, because results must agree with it. What differs: the random draws are seeded, and the final fit uses all inliers
(through a 9x9 normal matrix, so no sub-sampling is needed).
"""

import torch
from torch import Tensor

from freegeo.errors import FreeGeoError
from freegeo.geometry.camera import K_from_focal
from freegeo.geometry.se3 import from_Rt

__all__ = ["cameras_from_rays", "intrinsics_from_rays"]

SMALLEST_Z = 1e-4  # directions flatter than this have no image-plane coordinates
CANDIDATE_SHARE = 0.3  # hypotheses are drawn from the most confident rays
HYPOTHESES = 100
POINTS_PER_HYPOTHESIS = 8
INLIER_ERROR = 0.2  # in image-plane units at depth 1
FIT_SAMPLES = 50  # rays of a row and of a column from which on only every n-th enters a fit of intrinsics


def cameras_from_rays(
    rays: Tensor, confidence: Tensor, image_hw: tuple[int, int], *, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Cameras of ray maps.

    Args:
        rays: (..., h, w, 6) direction xyz (any length) and origin xyz in the reference frame.
        confidence: (..., h, w) positive weights.
        image_hw: size the intrinsics refer to.
        generator: source of the hypotheses; the same draws serve all views.

    Returns:
        ``T_cam_world`` (..., 4, 4) and ``K`` (..., 3, 3) in pixels of ``image_hw``, dtype of ``rays``; nan for a view
        with fewer than eight usable rays, which are finite and do not run along the image plane.

    Raises:
        FreeGeoError: the maps have fewer than eight cells.
    """
    leading, (height, width), origin = rays.shape[:-3], rays.shape[-3:-1], rays
    # The normal matrix squares the condition number; float64, which Apple GPUs lack, keeps the precision of a float32
    # map.
    if rays.device.type == "mps":
        rays, confidence = rays.cpu(), confidence.cpu()
    flat = rays.reshape(-1, height * width, 6).double()
    weights = confidence.reshape(-1, height * width).double()
    grid = _normalised_grid(height, width, like=flat)
    picks = _draw_hypotheses(height * width, generator).to(rays.device)
    usable = (flat[..., 2].abs() > SMALLEST_Z) & flat.isfinite().all(-1) & weights.isfinite()
    weights = torch.where(usable, weights, 0.0)
    flat = torch.where(usable[..., None], flat, 0.0)
    targets = flat[..., :2] / torch.where(usable, flat[..., 2], 1.0)[..., None]
    homographies = [_robust_homography(grid, *view, picks) for view in zip(targets, weights, strict=True)]
    rotation, lower = _split(torch.stack(homographies))
    centres = (weights[..., None] * flat[..., 3:]).sum(1) / weights.sum(1)[:, None]
    T_cam_world = from_Rt(rotation.mT, -(rotation.mT @ centres[..., None]).squeeze(-1))
    half_height, half_width = image_hw[0] / 2, image_hw[1] / 2
    K = K_from_focal(
        half_width / lower[:, 0, 0],
        half_height / lower[:, 1, 1],
        (1 + lower[:, 2, 0]) * half_width,
        (1 + lower[:, 2, 1]) * half_height,
    )
    # The type first: a float64 tensor cannot go to an Apple GPU.
    found = (T_cam_world.reshape(*leading, 4, 4), K.reshape(*leading, 3, 3))
    T_cam_world, K = (values.to(origin.dtype).to(origin.device) for values in found)
    return T_cam_world, K


def intrinsics_from_rays(rays: Tensor) -> Tensor:
    """Intrinsics (..., 3, 3), in pixels of the map, of directions (..., H, W, 3) of any length in the camera's frame.

    Least squares in each axis of ``u = cx + fx x / z``, over every 50th part of a row and of a column, in float64 where
    the device has it. Directions flatter than 1e-4 are left out; nan where fewer than two differ.
    """
    height, width = rays.shape[-3:-1]
    step_y, step_x = max(1, height // FIT_SAMPLES), max(1, width // FIT_SAMPLES)
    sampled = rays[..., ::step_y, ::step_x, :].flatten(-3, -2)
    # Around the means float32, which Apple GPUs are limited to, keeps what it has of the rays.
    sampled = sampled if rays.device.type == "mps" else sampled.double()
    v, u = torch.meshgrid(
        torch.arange(0, height, step_y, dtype=sampled.dtype, device=rays.device),
        torch.arange(0, width, step_x, dtype=sampled.dtype, device=rays.device),
        indexing="ij",
    )
    usable = sampled[..., 2].abs() > SMALLEST_Z
    z = torch.where(usable, sampled[..., 2], 1.0)
    found = [
        _fit_line(torch.where(usable, sampled[..., axis] / z, 0.0), pixel.flatten(), usable.to(z))
        for axis, pixel in ((0, u), (1, v))
    ]
    (focal_x, centre_x), (focal_y, centre_y) = found
    return K_from_focal(focal_x, focal_y, centre_x, centre_y).to(rays.dtype)


def _fit_line(x: Tensor, y: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Slope and value at 0 (...) of the line nearest to y over x (..., n), by weights."""
    total = weight.sum(-1)
    mean_x, mean_y = (x * weight).sum(-1) / total, (y * weight).sum(-1) / total
    from_mean = (x - mean_x[..., None]) * weight
    slope = (from_mean * (y - mean_y[..., None])).sum(-1) / (from_mean * (x - mean_x[..., None])).sum(-1)
    return slope, mean_y - slope * mean_x


def _normalised_grid(height: int, width: int, *, like: Tensor) -> Tensor:
    """Homogeneous cell centres (h * w, 3) in [-1, 1]."""
    x = (2 * torch.arange(width, dtype=like.dtype, device=like.device) + 1) / width - 1
    y = (2 * torch.arange(height, dtype=like.dtype, device=like.device) + 1) / height - 1
    rows, columns = torch.meshgrid(y, x, indexing="ij")
    return torch.stack((columns, rows, torch.ones_like(rows)), dim=-1).reshape(-1, 3)


def _draw_hypotheses(cells: int, generator: torch.Generator) -> Tensor:
    """Ranks (HYPOTHESES, 8), without repetition inside a row, into the cells sorted by confidence."""
    candidates = min(cells, max(POINTS_PER_HYPOTHESIS, int(CANDIDATE_SHARE * cells)))
    if candidates < POINTS_PER_HYPOTHESIS:
        raise FreeGeoError(f"A ray map of {cells} cells is too small for a pose; at least 8 are needed.")
    keys = torch.rand(HYPOTHESES, candidates, generator=generator, device=generator.device)
    return keys.topk(POINTS_PER_HYPOTHESIS, dim=1).indices


def _robust_homography(grid: Tensor, target: Tensor, weight: Tensor, picks: Tensor) -> Tensor:
    """Homography (3, 3), positive determinant, from grid (n, 3) to target (n, 2) with weights (n,)."""
    usable = int((weight > 0).sum())
    if usable < POINTS_PER_HYPOTHESIS:
        return grid.new_full((3, 3), torch.nan)
    order = weight.argsort(descending=True, stable=True)
    chosen = order[picks]
    hypotheses = _fit_homography(grid[chosen], target[chosen], weight[chosen])
    best = _best_inliers(hypotheses.float(), grid.float(), target.float(), weight.float())
    kept = weight * best if int((best & (weight > 0)).sum()) >= POINTS_PER_HYPOTHESIS else weight
    fitted = _fit_homography(grid, target, kept)
    return torch.where(torch.linalg.det(fitted) < 0, -fitted, fitted)


def _best_inliers(hypotheses: Tensor, grid: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Inlier mask (n,) of the hypothesis (m, 3, 3) with the largest weight of inliers.

    float32 is ample for this ranking. Both sides are multiplied by the third coordinate, so nothing is divided by zero.
    """
    x, y, z = torch.einsum("mij,nj->imn", hypotheses, grid)
    u, v = target.unbind(-1)
    inliers = (x - u * z).square() + (y - v * z).square() < (INLIER_ERROR * z).square()
    return inliers[(inliers.to(weight) @ weight).argmax()]


def _fit_homography(grid: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Weighted direct linear fit (..., 3, 3) of grid (..., n, 3) to target (..., n, 2).

    The rows ``[-p, 0, u p]`` and ``[0, -p, v p]`` enter only through their 9x9 normal matrix, whose blocks are the
    moments ``sum w f p p^T`` with f = 1, u, v, u^2 + v^2. The solution is the eigenvector of the smallest eigenvalue.
    """
    u, v = target.unbind(-1)
    factors = torch.stack((torch.ones_like(u), u, v, u * u + v * v), dim=-1) * weight[..., None]
    moments = torch.einsum("...nf,...ni,...nj->...fij", factors, grid, grid)
    plain, by_u, by_v, by_square = moments.unbind(-3)
    zero = torch.zeros_like(plain)
    blocks = ((plain, zero, -by_u), (zero, plain, -by_v), (-by_u, -by_v, by_square))
    normal = torch.cat([torch.cat(row, dim=-1) for row in blocks], dim=-2)
    return torch.linalg.eigh(normal).eigenvectors[..., 0].unflatten(-1, (3, 3))


def _split(homography: Tensor) -> tuple[Tensor, Tensor]:
    """``homography = Q L`` up to scale: Q (..., 3, 3) a rotation, L lower triangular, positive diagonal, L22 = 1."""
    Q, upper = torch.linalg.qr(homography.flip(-1))
    Q, lower = Q.flip(-1), upper.flip(-2, -1)
    signs = torch.where(lower.diagonal(dim1=-2, dim2=-1) < 0, -1.0, 1.0).to(lower)
    Q, lower = Q * signs[..., None, :], lower * signs[..., :, None]
    return Q, lower / lower[..., 2:, 2:]
