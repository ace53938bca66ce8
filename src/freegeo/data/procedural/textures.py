"""Banks of 40 tileable grey textures, stored with their smaller levels as one flat tensor for fast look-up.

Source: docs/embedded-model.md, "How the rooms are made" (noise, checkers, stripes, dots, cells; bricks and rings in the
bank of the domain `tex`). Every pattern carries some noise of its own, so that no two of its tiles look the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

TEXTURE_COUNT = 40
TEXTURE_SIZE = 256
LEVEL_SIZES = (256, 128, 64, 32, 16)

Array = np.ndarray


@dataclass(frozen=True)
class TextureBank:
    """Grey textures in [0, 1], all levels in one flat tensor.

    Texel (row, column) of texture k at level l is `texels[level_offsets[l] + (k * n + row) * n + column]` with
    n = `LEVEL_SIZES[l]`. Textures repeat in both directions.
    """

    texels: Tensor  # (sum over levels of 40 n^2,) float32
    level_offsets: Tensor  # (levels,) int64

    def to(self, device: torch.device | str) -> TextureBank:
        """The bank on `device`."""
        return TextureBank(self.texels.to(device), self.level_offsets.to(device))

    def sample(self, index: Tensor, u: Tensor, v: Tensor, texels_per_pixel: Tensor) -> Tensor:
        """Bilinear look-up on the level whose texels are about as large as the pixel.

        `index` (int64), `u`, `v` (in texture periods) and `texels_per_pixel` (size of the pixel's footprint in texels
        of the largest level) have one shape, the result has it too; values in [0, 1].
        """
        level = torch.log2(texels_per_pixel.clamp(1.0, 2.0 ** (len(LEVEL_SIZES) - 1))).round_().long()
        size = TEXTURE_SIZE >> level
        column, row = (u - u.floor()) * size - 0.5, (v - v.floor()) * size - 0.5
        left, top = column.floor(), row.floor()
        column_weight, row_weight = column - left, row - top
        # Sizes are powers of two, so the mask wraps -1 and n around.
        mask = size - 1
        x0, y0 = left.long(), top.long()
        x1, y1 = (x0 + 1) & mask, (y0 + 1) & mask
        x0, y0 = x0 & mask, y0 & mask
        base = self.level_offsets[level] + index * size * size
        upper, lower = base + y0 * size, base + y1 * size
        top_row = torch.lerp(self.texels[upper + x0], self.texels[upper + x1], column_weight)
        bottom_row = torch.lerp(self.texels[lower + x0], self.texels[lower + x1], column_weight)
        return torch.lerp(top_row, bottom_row, row_weight)


@lru_cache(maxsize=16)
def texture_bank(name: str, device: str = "cpu") -> TextureBank:
    """The bank of that name on `device`: `train` and the domains' own ones, see `BANKS`. Made once, then cached."""
    if device != "cpu":
        return texture_bank(name).to(device)
    seed, patterns = BANKS[name]
    rng = np.random.default_rng(seed)
    textures = np.stack([_equalised(patterns[k % len(patterns)](rng)) for k in range(TEXTURE_COUNT)])
    level = torch.from_numpy(textures.astype(np.float32))[:, None]
    levels = []
    for _ in LEVEL_SIZES:
        levels.append(level.flatten())
        level = torch.nn.functional.avg_pool2d(level, 2)
    offsets = np.cumsum([0, *(part.numel() for part in levels[:-1])])
    return TextureBank(torch.cat(levels), torch.from_numpy(offsets))


def _noise(rng: np.random.Generator, exponent: float = 1.2, lowest: float = 1.0) -> Array:
    """Periodic multi-octave noise: amplitude falls with frequency ** exponent, nothing below `lowest` cycles."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(TEXTURE_SIZE), np.fft.rfftfreq(TEXTURE_SIZE), indexing="ij"))
    cycles = frequency * TEXTURE_SIZE
    amplitude = np.where(
        (cycles >= lowest) & (cycles < TEXTURE_SIZE / 6), 1.0 / np.maximum(cycles, 1.0) ** exponent, 0.0
    )
    spectrum = amplitude * np.exp(2j * np.pi * rng.random(cycles.shape))
    noise = np.fft.irfft2(spectrum, s=(TEXTURE_SIZE, TEXTURE_SIZE))
    return noise / noise.std()


def _soft(values: Array, radius: float = 1.2) -> Array:
    """Periodic Gaussian blur, so that edges are two or three texels wide and do not alias."""
    fy, fx = np.fft.fftfreq(TEXTURE_SIZE)[:, None], np.fft.rfftfreq(TEXTURE_SIZE)
    kernel = np.exp(-2.0 * (np.pi * radius) ** 2 * (fx**2 + fy**2))
    return np.fft.irfft2(np.fft.rfft2(values) * kernel, s=values.shape)


def _equalised(texture: Array) -> Array:
    """Stretched to [0, 1] between the 1st and 99th percentile."""
    low, high = np.percentile(texture, (1, 99))
    return np.clip((texture - low) / (high - low), 0.0, 1.0)


def _grid() -> tuple[Array, Array]:
    """Row and column coordinates in periods, both (256, 256)."""
    axis = (np.arange(TEXTURE_SIZE) + 0.5) / TEXTURE_SIZE
    return np.meshgrid(axis, axis, indexing="ij")


def _warped_grid(rng: np.random.Generator, amount: float) -> tuple[Array, Array]:
    row, column = _grid()
    return row + amount * _noise(rng, 2.2), column + amount * _noise(rng, 2.2)


def _octaves(rng: np.random.Generator) -> Array:
    return _noise(rng, rng.uniform(0.8, 1.5), lowest=float(rng.integers(1, 5)))


def _checker(rng: np.random.Generator) -> Array:
    row, column = _warped_grid(rng, rng.choice([0.0, 0.006]))
    rows, columns = 2 * rng.integers(2, 5, size=2)
    cell_row, cell_column = (
        (np.floor(row * rows) % rows).astype(int),
        (np.floor(column * columns) % columns).astype(int),
    )
    tint = 0.45 * rng.random((rows, columns))
    return _soft((cell_row + cell_column) % 2 + tint[cell_row, cell_column]) + 0.12 * _noise(rng)


def _stripes(rng: np.random.Generator) -> Array:
    row, column = _warped_grid(rng, rng.choice([0.0, 0.01, 0.02]))
    across, along = rng.integers(3, 8), rng.integers(-2, 3)
    position = across * column + along * row
    width = rng.uniform(0.35, 0.65)
    tint = 0.5 * rng.random(64)
    # One period down, a slanted stripe continues as the stripe `along` places away: those have to share their tint.
    tints = math.gcd(int(across), int(along))
    stripe = (position % 1.0 < width) + tint[(np.floor(position) % tints).astype(int)]
    return _soft(stripe.astype(float)) + 0.18 * _noise(rng)


def _nearest_points(rng: np.random.Generator, count: int) -> tuple[Array, Array, Array]:
    """Periodic distances to the nearest and second nearest of `count` random points, and the nearest one's index."""
    row, column = _grid()
    points = rng.random((count, 2))
    offset_row = (row[None] - points[:, 0, None, None] + 0.5) % 1.0 - 0.5
    offset_column = (column[None] - points[:, 1, None, None] + 0.5) % 1.0 - 0.5
    distance = np.hypot(offset_row, offset_column)
    two = np.partition(distance, 1, axis=0)[:2]
    return two[0], two[1], distance.argmin(axis=0)


def _dots(rng: np.random.Generator) -> Array:
    count = int(rng.integers(12, 40))
    nearest, _, owner = _nearest_points(rng, count)
    radius = rng.uniform(0.3, 0.6, size=count) / np.sqrt(count)
    tint = rng.uniform(0.5, 1.0, size=count)
    return _soft((nearest < radius[owner]) * tint[owner]) + 0.12 * _noise(rng)


def _cells(rng: np.random.Generator) -> Array:
    count = int(rng.integers(14, 45))
    nearest, second, owner = _nearest_points(rng, count)
    joint = (second - nearest) < 0.08 / np.sqrt(count)
    return _soft(np.where(joint, 0.0, 0.25 + rng.random(count)[owner])) + 0.08 * _noise(rng)


def _bricks(rng: np.random.Generator) -> Array:
    row, column = _warped_grid(rng, 0.002)
    rows, columns = 2 * int(rng.integers(4, 8)), int(rng.integers(3, 6))
    course = np.floor(row * rows)
    along = column * columns + 0.5 * (course % 2)
    brick = rng.random((rows, columns))[(course % rows).astype(int), (np.floor(along) % columns).astype(int)]
    mortar = ((row * rows) % 1.0 < 0.14) | (along % 1.0 < 0.14 * columns / rows * 1.5)
    return _soft(np.where(mortar, 0.0, 0.4 + 0.6 * brick)) + 0.1 * _noise(rng)


def _rings(rng: np.random.Generator) -> Array:
    count = int(rng.integers(4, 10))
    nearest, _, owner = _nearest_points(rng, count)
    frequency = rng.uniform(6.0, 14.0, size=count)
    phase = rng.random(count)
    return np.sin(2.0 * np.pi * (nearest * frequency[owner] + phase[owner])) + 0.25 * _noise(rng)


_FIVE: tuple[Callable[[np.random.Generator], Array], ...] = (_octaves, _checker, _stripes, _dots, _cells)
BANKS: dict[str, tuple[int, tuple[Callable[[np.random.Generator], Array], ...]]] = {
    "train": (101, _FIVE),
    "light": (102, _FIVE),
    "lowtex": (103, _FIVE),
    "tex": (104, (_bricks, _rings)),
    "big": (105, _FIVE),
    "sparse": (106, _FIVE),
}
"""Seed and patterns of every bank; pattern `k % len(patterns)` makes texture k."""
