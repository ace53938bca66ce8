"""Marching cubes over sparse voxel blocks, vectorised, with vertices shared between cubes and blocks."""

from functools import cache

import numpy as np
import torch
from torch import Tensor

_CORNERS = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))
_CHUNK_BLOCKS = 256


def extract_surface(blocks: Tensor, tsdf: Tensor, weight: Tensor, *, voxel: float) -> tuple[Tensor, Tensor]:
    """Zero surface on the lattice of voxel centres.

    A cube counts when all eight corners have a positive weight; a corner is inside when its value is negative. The
    vertex on an edge lies at the fraction |f0| / (|f0| + |f1|). Normals point to the positive side.

    Args:
        blocks: (n, 3) int64 distinct block indices.
        tsdf: (n, b, b, b) float, axes x, y, z; voxel i of block a has its centre at (a b + i + 0.5) voxel.
        weight: (n, b, b, b).
        voxel: metres.

    Returns:
        Vertices (V, 3) float64 in metres and triangles (T, 3) int64.

    Source: docs/benchmark.md, "Fusion and scoring"; classic 256-case tables.
    """
    cells, codes, values = _crossed_cubes(blocks, tsdf, weight)
    case_start, case_edges = (table.to(tsdf.device) for table in _tables())
    # One row per triangle: its cube, and which three cube edges it joins.
    counts = case_start[codes + 1] - case_start[codes]
    cube = torch.repeat_interleave(torch.arange(len(codes), device=codes.device), counts)
    within = torch.arange(len(cube), device=codes.device) - torch.repeat_interleave(counts.cumsum(0) - counts, counts)
    edges = case_edges[case_start[codes[cube]] + within]  # (T, 3)

    starts, axes, low_corner, high_corner = (table.to(tsdf.device) for table in _edge_tables())
    lattice = cells[cube][:, None, :] + starts[edges]  # (T, 3, 3): lower end of each edge on the voxel lattice
    f0 = values[cube[:, None], low_corner[edges]].double().abs()
    f1 = values[cube[:, None], high_corner[edges]].double().abs()
    keys = _lattice_keys(lattice, axes[edges])
    unique_keys, triangles = torch.unique(keys, return_inverse=True)
    representative = torch.empty(len(unique_keys), dtype=torch.int64, device=keys.device)
    representative[triangles.flatten()] = torch.arange(keys.numel(), device=keys.device)

    step = torch.nn.functional.one_hot(axes[edges], 3) * (f0 / (f0 + f1))[..., None]
    positions = (lattice + step + 0.5).flatten(0, 1)[representative] * voxel
    return positions, triangles


def _crossed_cubes(blocks: Tensor, tsdf: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Lattice cells (m, 3), case codes (m,) and corner values (m, 8) of the fully seen cubes the surface crosses."""
    edge = tsdf.shape[-1]
    neighbours = _forward_neighbours(blocks)
    found = []
    for start in range(0, len(blocks), _CHUNK_BLOCKS):
        rows = slice(start, start + _CHUNK_BLOCKS)
        values = _with_halo(tsdf, neighbours[rows], fill=0.0)
        seen = _with_halo(weight > 0, neighbours[rows], fill=False)
        negative = values < 0
        code = torch.zeros(values.shape[0], edge, edge, edge, dtype=torch.uint8, device=tsdf.device)
        complete = torch.ones_like(code, dtype=torch.bool)
        for bit, corner in enumerate(_CORNERS):
            code |= _shifted(negative, corner).to(torch.uint8) << bit
            complete &= _shifted(seen, corner)
        crossed = torch.nonzero(complete & (code != 0) & (code != 255), as_tuple=True)
        block, x, y, z = crossed
        corners = [values[block, x + dx, y + dy, z + dz] for dx, dy, dz in _CORNERS]
        cell = blocks[rows][block] * edge + torch.stack([x, y, z], dim=-1)
        found.append((cell, code[crossed].long(), torch.stack(corners, dim=-1)))
    if not found:
        return blocks.new_zeros(0, 3), blocks.new_zeros(0), tsdf.new_zeros(0, 8)
    cells, codes, values = zip(*found, strict=True)
    return torch.cat(cells), torch.cat(codes), torch.cat(values)


def _forward_neighbours(blocks: Tensor) -> Tensor:
    """Row of the block at each of the eight offsets in {0, 1}^3 (n, 2, 2, 2), or -1."""
    low = blocks.amin(dim=0) if len(blocks) else blocks.new_zeros(3)
    size = (blocks - low).amax(dim=0) + 2 if len(blocks) else blocks.new_ones(3)

    def key(index: Tensor) -> Tensor:
        a, b, c = (index - low).unbind(-1)
        return (a * size[1] + b) * size[2] + c

    sorted_keys, order = key(blocks).sort()
    offsets = torch.cartesian_prod(*[torch.arange(2, device=blocks.device)] * 3)
    wanted = key(blocks[:, None] + offsets)
    place = torch.searchsorted(sorted_keys, wanted).clamp_max(max(0, len(blocks) - 1))
    return torch.where(sorted_keys[place] == wanted, order[place], -1).view(-1, 2, 2, 2)


def _with_halo(blocks: Tensor, neighbours: Tensor, *, fill: float | bool) -> Tensor:
    """Blocks (m, b+1, b+1, b+1) extended by the first layer of their forward neighbours; missing ones hold `fill`."""
    edge = blocks.shape[-1]
    result = blocks.new_full((len(neighbours), edge + 1, edge + 1, edge + 1), fill)
    inner, outer = slice(0, edge), slice(edge, edge + 1)
    whole, first = slice(None), slice(0, 1)
    for dx, dy, dz in np.ndindex(2, 2, 2):
        source = neighbours[:, dx, dy, dz]
        present = torch.nonzero(source >= 0)[:, 0]
        target = [outer if d else inner for d in (dx, dy, dz)]
        layer = [first if d else whole for d in (dx, dy, dz)]
        result[present, target[0], target[1], target[2]] = blocks[:, layer[0], layer[1], layer[2]][source[present]]
    return result


def _shifted(halo: Tensor, corner: tuple[int, int, int]) -> Tensor:
    dx, dy, dz = corner
    edge = halo.shape[-1] - 1
    return halo[:, dx : dx + edge, dy : dy + edge, dz : dz + edge]


def _lattice_keys(lattice: Tensor, axes: Tensor) -> Tensor:
    """A distinct int64 per lattice edge, from its lower end (..., 3) and its axis (...)."""
    if lattice.numel() == 0:
        return axes
    origin = lattice.flatten(0, -2).amin(dim=0)
    size = lattice.flatten(0, -2).amax(dim=0) - origin + 1
    x, y, z = (lattice - origin).unbind(-1)
    return ((x * size[1] + y) * size[2] + z) * 3 + axes


@cache
def _tables() -> tuple[Tensor, Tensor]:
    """Start of each case (257,) in the list of triangles (820, 3), given as edge numbers.

    The tables are read off PyMCubes, which holds the classic ones, by meshing all 256 sign patterns of one cube.
    """
    import mcubes

    middles = {tuple(middle): number for number, middle in enumerate(_edge_middles().tolist())}
    triangles: list[list[int]] = []
    starts = [0]
    for code in range(256):
        cube = np.ones((2, 2, 2))
        for bit, corner in enumerate(_CORNERS):
            if code >> bit & 1:
                cube[corner] = -1.0
        vertices, faces = mcubes.marching_cubes(cube, 0.0)
        numbers = [middles[tuple(vertex)] for vertex in vertices.tolist()]
        # Reversed: there the normals point to the negative side.
        triangles += [[numbers[index] for index in face[::-1]] for face in faces.tolist()]
        starts.append(len(triangles))
    return torch.tensor(starts), torch.tensor(triangles)


@cache
def _edge_tables() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Of the 12 cube edges: lower end (12, 3), axis (12,), corner number of the lower and of the upper end (12,)."""
    middles = _edge_middles()
    axes = (middles == 0.5).int().argmax(dim=-1).long()
    starts = middles.floor().long()
    ends = starts + torch.nn.functional.one_hot(axes, 3)
    low = torch.tensor([_CORNERS.index(tuple(corner)) for corner in starts.tolist()])
    high = torch.tensor([_CORNERS.index(tuple(corner)) for corner in ends.tolist()])
    return starts, axes, low, high


def _edge_middles() -> Tensor:
    """Middles of the 12 edges of the unit cube, (12, 3)."""
    halves = torch.cartesian_prod(*[torch.tensor([0.0, 0.5, 1.0])] * 3)
    return halves[(halves == 0.5).sum(dim=-1) == 1]
