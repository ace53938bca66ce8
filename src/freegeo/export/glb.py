"""``scene.glb``: coloured points and one small frustum per camera, below a node that turns them to glTF axes.

Vertices are in the reconstruction's world, as in all other files. The matrix of their parent, the node
`reconstruction`, turns it to glTF's world (y up): upright where up can be told (`freegeo.export.gravity`), otherwise
the axes are only renamed. The scene's extras say which it is.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from freegeo import files
from freegeo.export.base import Export, Format
from freegeo.export.gravity import Up, find_up, upright_rotation
from freegeo.export.ply import require_points

if TYPE_CHECKING:
    from freegeo.fusion.points import PointCloud

logger = logging.getLogger(__name__)

FILE_NAME = "scene.glb"
NODE = "reconstruction"
"""Name of the node whose matrix turns the reconstruction's world to that of the file."""
OPENCV_TO_GLTF = np.diag((1.0, -1.0, -1.0))
"""Rotation from OpenCV axes (y down, z forward) to glTF axes (y up, z backward): half a turn about x, and back."""
UP_UNKNOWN = "not known: the cameras disagree, so it is that of the reconstruction's world"
FRUSTUM_SHARE = 0.08
"""Depth of a frustum as a share of the median distance of the points from the cameras that saw them."""
BEAM_SHARE = 0.02
"""Width of a frustum's beams as a share of its depth."""
_FOR_UP = 3000
"""Points that are enough to find the floor."""
# Corners: the camera's centre, then the image's; edges by corner numbers.
_EDGES = ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1))
_BOX_FACES = (
    *((0, 2, 1), (0, 3, 2), (4, 5, 6), (4, 6, 7), (0, 1, 5), (0, 5, 4)),
    *((1, 2, 6), (1, 6, 5), (2, 3, 7), (2, 7, 6), (3, 0, 4), (3, 4, 7)),
)


def write_glb(
    cloud: PointCloud,
    T_cam_world: np.ndarray,
    K: np.ndarray,
    image_hw: tuple[int, int],
    path: Path,
    *,
    lengths: str,
    up: Up | None = None,
) -> Path:
    """Write points and camera frusta.

    The scene's objects are named `points` and `camera_000`, `camera_001`, ... in view order, all below the node
    `NODE`; its extras say the unit and what up rests on.

    Args:
        cloud: world points.
        T_cam_world: (S, 4, 4).
        K: (S, 3, 3) pixels of images of the size `image_hw`.
        image_hw: height and width.
        path: of the file.
        lengths: that of the reconstruction.
        up: becomes +y by the node's matrix; None: that only renames the axes of the world (`OPENCV_TO_GLTF`).

    Raises:
        FreeGeoError: there is no point.
    """
    import trimesh

    require_points(cloud, path)
    turn = np.eye(4)
    turn[:3, :3] = OPENCV_TO_GLTF if up is None else upright_rotation(up.direction, T_cam_world)
    scene = trimesh.Scene(metadata={"lengths": lengths, "up": UP_UNKNOWN if up is None else up.source})
    scene.graph.update(NODE, matrix=turn)
    points = trimesh.PointCloud(cloud.points, colors=cloud.colours)
    scene.add_geometry(points, geom_name="points", node_name="points", parent_node_name=NODE)
    size = FRUSTUM_SHARE * _typical_depth(cloud, T_cam_world)
    for view, colour in enumerate(order_colours(len(K))):
        corners = frustum_corners(T_cam_world[view], K[view], image_hw, size)
        vertices, faces = _beams(corners, BEAM_SHARE * size)
        colours = np.tile(colour, (len(vertices), 1))
        mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)
        name = f"camera_{view:03d}"
        scene.add_geometry(mesh, geom_name=name, node_name=name, parent_node_name=NODE)
    with files.atomic_path(path) as part:
        part.write_bytes(scene.export(file_type="glb"))
    return path


def frustum_corners(T_cam_world: np.ndarray, K: np.ndarray, image_hw: tuple[int, int], depth: float) -> np.ndarray:
    """World coordinates (5, 3) float64 of a camera's centre and its image's corners (clockwise from top left).

    The corners are those of the outermost pixels' areas, pushed out to z-depth `depth`.
    """
    height, width = image_hw
    left, top, right, bottom = -0.5, -0.5, width - 0.5, height - 0.5
    pixels = np.array([(left, top, 1), (right, top, 1), (right, bottom, 1), (left, bottom, 1)])
    corners = depth * pixels @ np.linalg.inv(K.astype(np.float64)).T
    R, t = T_cam_world[:3, :3].astype(np.float64), T_cam_world[:3, 3].astype(np.float64)
    return (np.concatenate((np.zeros((1, 3)), corners)) - t) @ R


def order_colours(count: int) -> np.ndarray:
    """Colours (count, 3) uint8 from blue (first view) over green and yellow to red (last view)."""
    import colorsys

    hues = np.linspace(2 / 3, 0.0, count) if count > 1 else np.array([2 / 3])
    colours = [colorsys.hsv_to_rgb(hue, 0.85, 0.95) for hue in hues]
    return (np.array(colours).reshape(-1, 3) * 255).round().astype(np.uint8)


def _typical_depth(cloud: PointCloud, T_cam_world: np.ndarray) -> float:
    chosen = _even_choice(cloud, 10_000)
    T = T_cam_world[chosen.view]
    return float(np.median(np.einsum("ni,ni->n", T[:, 2, :3], chosen.points) + T[:, 2, 3]))


def _even_choice(cloud: PointCloud, most: int) -> PointCloud:
    return cloud.select(np.linspace(0, len(cloud) - 1, min(len(cloud), most)).astype(np.int64))


def _beams(corners: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Square beams along the edges of a frustum: vertices (64, 3) and faces (96, 3)."""
    vertices, faces = [], []
    for start, end in _EDGES:
        along = corners[end] - corners[start]
        along /= np.linalg.norm(along)
        helper = np.eye(3)[np.abs(along).argmin()]
        side = np.cross(along, helper)
        side *= 0.5 * width / np.linalg.norm(side)
        up = np.cross(along, side)
        ring = np.stack((-side - up, side - up, side + up, -side + up))
        faces.append(np.array(_BOX_FACES) + 8 * len(faces))
        vertices.append(np.concatenate((corners[start] + ring, corners[end] + ring)))
    return np.concatenate(vertices), np.concatenate(faces)


def _write(export: Export) -> list[Path]:
    from freegeo.fusion.normals import point_normals

    r = export.reconstruction
    T_cam_world, K = r.cameras()
    some = _even_choice(export.cloud, _FOR_UP)
    up = find_up(T_cam_world, some.points, point_normals(some, r.depth_z, T_cam_world, K, r.inside()))
    logger.info("%s: up is %s", FILE_NAME, UP_UNKNOWN if up is None else up.source)
    path = export.folder / FILE_NAME
    return [write_glb(export.cloud, T_cam_world, K, r.image_hw, path, lengths=r.lengths, up=up)]


FORMAT = Format(name="glb", path=FILE_NAME, about="points and camera frusta, y up where it can be told", write=_write)
