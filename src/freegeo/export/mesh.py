"""``mesh.ply``: the surface of the fused depth maps coloured by the photos, in the reconstruction's world frame."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from freegeo import files
from freegeo.errors import FreeGeoError, UserError
from freegeo.export.base import Export, Format
from freegeo.export.ply import ply_bytes
from freegeo.export.reconstruction import Reconstruction

if TYPE_CHECKING:
    from trimesh import Trimesh

    from freegeo.fusion.mesh import Mesh

logger = logging.getLogger(__name__)

FILE_NAME = "mesh.ply"
VOXELS_PER_PIXEL = 1.5
"""Voxel edge in units of what a pixel covers at the median depth: smaller voxels would leave holes."""
MAX_VOXELS_ACROSS = 512
"""Largest number of voxels along the scene, which bounds memory and time."""
TRUNCATION_VOXELS = 4
_GREY = 128


def voxel_size(reconstruction: Reconstruction, keep: np.ndarray) -> float:
    """Voxel edge, in the reconstruction's units, for its resolution and extent.

    1.5 times the median over the kept pixels of depth / focal length, at least 1 / 512 of twice the depth that 98 % of
    the pixels stay below. FreeGeoError when no pixel is kept.
    """
    if not keep.any():
        raise FreeGeoError("No depth is left for a mesh. Lower the confidence limit or switch filters off.")
    from freegeo.fusion.quantile import median, quantile

    K = reconstruction.cameras()[1]
    focal = np.sqrt(K[:, 0, 0] * K[:, 1, 1])
    views = range(len(reconstruction))
    covered = median(lambda: (reconstruction.depth_z[view][keep[view]] / focal[view] for view in views))
    extent = 2 * quantile(lambda: (reconstruction.depth_z[view][keep[view]] for view in views), 0.98)
    return float(max(VOXELS_PER_PIXEL * covered, extent / MAX_VOXELS_ACROSS))


def fuse(reconstruction: Reconstruction, keep: np.ndarray, *, voxel: float) -> Mesh:
    """Surface of the kept pixels (S, H, W), fused view by view with a truncation of four voxels."""
    import torch

    from freegeo.fusion.tsdf import TsdfVolume

    T_cam_world, K = (torch.from_numpy(a).float() for a in reconstruction.cameras())
    volume = TsdfVolume(voxel=voxel, truncation=TRUNCATION_VOXELS * voxel)
    for view in range(len(reconstruction)):
        depth = torch.from_numpy(np.where(keep[view], reconstruction.depth_z[view], 0))
        volume.integrate(depth, K[view], T_cam_world[view])
    return volume.extract_mesh()


def vertex_colours(mesh: Mesh, reconstruction: Reconstruction, keep: np.ndarray, *, tolerance: float) -> np.ndarray:
    """Colours (V, 3) uint8: mean of the views whose kept depth is within `tolerance` of a vertex; grey without one."""
    import torch

    from freegeo.geometry.camera import project
    from freegeo.geometry.se3 import transform_points

    T_cam_world, K = (torch.from_numpy(a).float() for a in reconstruction.cameras())
    height, width = reconstruction.image_hw
    vertices = torch.from_numpy(mesh.vertices).float()
    total, count = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    for view in range(len(reconstruction)):
        in_camera = transform_points(T_cam_world[view], vertices)
        column, row = (project(in_camera, K[view]) + 0.5).floor().unbind(-1)
        inside = (in_camera[:, 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        rows = inside.nonzero()[:, 0].numpy()
        index = (row[inside].long() * width + column[inside].long()).numpy()
        difference = reconstruction.depth_z[view].reshape(-1)[index] - in_camera[:, 2].numpy()[rows]
        seen = keep[view].reshape(-1)[index] & (np.abs(difference) <= tolerance)
        total[rows[seen]] += reconstruction.images[view].reshape(-1, 3)[index[seen]]
        count[rows[seen]] += 1
    mean = total / np.maximum(count, 1)[:, None]
    return np.where(count[:, None] > 0, mean.round(), _GREY).astype(np.uint8)


def load_mesh(path: Path) -> Trimesh:
    """Read what `write_mesh` wrote, with its colours; FreeGeoError when the file is damaged."""
    from freegeo.fusion.mesh import load_geometry

    found = load_geometry(path, force="mesh")
    if not hasattr(found, "faces"):
        raise FreeGeoError(f"{path}: holds no triangles. Export it again.")
    return found


def write_mesh(reconstruction: Reconstruction, keep: np.ndarray, path: Path, *, voxel: float | None = None) -> Path:
    """Fuse the kept pixels and write the coloured mesh.

    Args:
        reconstruction: with cameras.
        keep: (S, H, W) bool.
        path: of the PLY file.
        voxel: voxel edge in the reconstruction's units; default `voxel_size`, which is logged.

    Raises:
        UserError: the voxel is not positive.
        FreeGeoError: the fusion gives no surface.
    """
    import trimesh

    if voxel is not None and not voxel > 0:
        raise UserError(f"The voxel size must be positive, got {voxel}.")
    voxel = voxel or voxel_size(reconstruction, keep)
    logger.info("mesh: voxels of %.4g, truncation %.4g", voxel, TRUNCATION_VOXELS * voxel)
    mesh = fuse(reconstruction, keep, voxel=voxel)
    if mesh.is_empty:
        raise FreeGeoError(f"{path}: no surface with voxels of {voxel:.4g}. Choose larger voxels or fewer filters.")
    colours = vertex_colours(mesh, reconstruction, keep, tolerance=TRUNCATION_VOXELS * voxel)
    with files.atomic_path(path) as part:
        surface = trimesh.Trimesh(mesh.vertices, mesh.triangles, vertex_colors=colours, process=False)
        part.write_bytes(ply_bytes(surface, reconstruction.lengths))
    return path


def _write(export: Export) -> list[Path]:
    export.require_pixels()
    return [write_mesh(export.reconstruction, export.keep, export.folder / FILE_NAME, voxel=export.voxel)]


FORMAT = Format(name="mesh", path=FILE_NAME, about="surface", write=_write)
