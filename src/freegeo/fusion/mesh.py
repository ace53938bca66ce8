"""Triangle meshes: area, PLY files, and seeded sampling of surface points."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from freegeo.errors import DamagedError, FreeGeoError, UserError

EMPTY_MESH_SEED = 42
KINDS = ("ply", "obj", "stl", "off")
"""Kinds of files that meshes are read from, by their endings. Others may hold pictures in any format."""


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """A triangle mesh in metres."""

    vertices: np.ndarray
    """(V, 3) float64."""
    triangles: np.ndarray
    """(T, 3) int64, counter-clockwise seen from the free side."""

    @property
    def is_empty(self) -> bool:
        """Whether there is no triangle."""
        return len(self.triangles) == 0

    @property
    def area(self) -> float:
        """Surface area in square metres."""
        return float(self.triangle_areas().sum())

    def triangle_areas(self) -> np.ndarray:
        """Area of each triangle (T,) in square metres."""
        a, b, c = (self.vertices[self.triangles[:, corner]] for corner in range(3))
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1)


def sample_surface(mesh: Mesh, count: int, *, seed: int) -> np.ndarray:
    """Points (count, 3) float64 drawn uniformly from the surface; equal seeds give equal points.

    Each point takes three numbers of a 32-bit Mersenne Twister: r1, r2 for the place within the triangle, and one that
    picks the triangle in proportion to its area.

    Raises:
        UserError: the mesh has no triangle, or no area.

    Source: docs/benchmark.md, "Fusion and scoring".
    """
    areas = mesh.triangle_areas()
    total = areas.sum()
    if not total > 0:
        raise UserError("A mesh without surface cannot be sampled.")
    words = np.random.RandomState(seed).randint(0, 1 << 32, size=(count, 3, 2), dtype=np.uint32).astype(np.float64)
    r1, r2, pick = ((words[..., 0] + words[..., 1] * 2.0**32) / 2.0**64).T
    cumulative = np.cumsum(areas / total)
    cumulative[-1] = 1.0
    chosen = mesh.triangles[np.searchsorted(cumulative, pick, side="left")]
    a, b, c = (mesh.vertices[chosen[:, corner]] for corner in range(3))
    root = np.sqrt(r1)[:, None]
    r2 = r2[:, None]
    return (1 - root) * a + root * (1 - r2) * b + root * r2 * c


def empty_mesh_substitute(count: int) -> np.ndarray:
    """Points (count, 3) uniform in [-1, 1]^3 that the published evaluation scores in place of an empty mesh."""
    return np.random.default_rng(EMPTY_MESH_SEED).uniform(-1.0, 1.0, size=(count, 3))


def read_mesh(path: Path) -> Mesh:
    """Read a triangle mesh (`KINDS`) as stored, without merging vertices.

    Raises:
        UserError: there is no such file, or it is of another kind. FreeGeoError: it holds no triangles.
    """
    import trimesh

    loaded = load_geometry(path, force="mesh")
    if not isinstance(loaded, trimesh.Trimesh) or len(loaded.faces) == 0:
        raise FreeGeoError(f"{path} holds no triangles.")
    return Mesh(vertices=np.asarray(loaded.vertices, np.float64), triangles=np.asarray(loaded.faces, np.int64))


def read_points(path: Path) -> np.ndarray:
    """Read the points (n, 3) float64 of a PLY cloud (or the vertices of a mesh).

    Raises:
        UserError: there is no such file, or it is of another kind. FreeGeoError: it holds no points.
    """
    import trimesh

    loaded = load_geometry(path)
    if not isinstance(loaded, trimesh.PointCloud | trimesh.Trimesh):
        raise FreeGeoError(f"{path} holds no points.")
    return np.asarray(loaded.vertices, np.float64)


def load_geometry(path: Path, **options: Any) -> Any:
    """Read one file with trimesh, by its ending, and none that it names: textures of any kind, other meshes, addresses.

    UserError when there is no such file, or it is of another kind than `KINDS`; DamagedError when it cannot be read.
    """
    import trimesh

    path = Path(path)
    if not path.is_file():
        raise UserError(f"There is no file {path}.")
    kind = path.suffix.lower().removeprefix(".")
    if kind not in KINDS:
        raise UserError(f"{path}: a mesh is read from {', '.join(KINDS)}. Convert it.")
    content = io.BytesIO(path.read_bytes())
    try:
        # Without the file's path trimesh cannot find what the file refers to.
        return trimesh.load(content, file_type=kind, process=False, skip_materials=True, **options)
    except MemoryError:
        raise
    except Exception as error:  # for damaged files trimesh raises all kinds, UnboundLocalError among them
        raise DamagedError(path, f"{type(error).__name__}: {error}", "Copy or export it again.") from None
