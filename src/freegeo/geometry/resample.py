"""The exact image resizing the models were trained and scored with, without OpenCV.

DA3 and VGGT resize 8-bit photos with OpenCV (``INTER_AREA`` when shrinking, ``INTER_CUBIC`` when enlarging), and the
benchmark resizes depth maps with ``INTER_NEAREST``. Half a grey level or half a pixel of difference moves the networks'
output, so the rules are written out here and tested against OpenCV value by value.

Resizing is separable: every output row is a short weighted sum of neighbouring input rows. Neighbouring output rows
share most of their input, so they are computed in small groups, each one dense matrix product over the few input rows
the group touches. That keeps the work near one pass over the photo while using the fast matrix routines.

Pixel (row ``i``, column ``j``) covers the square ``[i, i + 1) x [j, j + 1)`` here, as in OpenCV. Resizing an image
multiplies the first two rows of ``K`` by the ratios (see :func:`freegeo.geometry.camera.resize_K`).
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from freegeo.errors import UserError

__all__ = ["resize_area", "resize_cubic", "resize_nearest"]

CUBIC_A = -0.75  # OpenCV's kernel parameter; Pillow and torch's antialiased bicubic use -0.5
NEGLIGIBLE_COVERAGE = 1e-3  # OpenCV leaves out border pixels covered by less than this
GROUP = 16  # output rows computed in one matrix product


@dataclass(frozen=True, kw_only=True)
class _Taps:
    """Weights of one axis: output ``i`` is ``sum_k weights[i, k] * input[index[i, k]]``."""

    index: Tensor  # (n_out, taps) int64, clamped to the input
    weights: Tensor  # (n_out, taps) float64; unused taps have weight 0


def resize_area(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Shrink an 8-bit image by exact area averaging, as OpenCV's ``INTER_AREA``.

    Each output pixel is the mean of the input it covers, partly covered pixels counting by their covered fraction.
    Source: the rule of DA3 (docs/models/da3.md, "Images") and VGGT (docs/models/vggt.md, "Images").

    Args:
        image: (H, W, C) uint8.
        size: (height, width) of the result, neither larger than the input.

    Returns:
        uint8 image (height, width, C).

    Raises:
        UserError: the image is not 8-bit and three-dimensional, or a side would grow.
    """
    height, width = _check_image(image, size)
    if size[0] > height or size[1] > width:
        raise UserError(
            f"Area averaging cannot enlarge {height}x{width} to {size[0]}x{size[1]}; use resize_cubic if a side grows."
        )
    if size == (height, width):
        return image.clone()
    if height % size[0] == 0 and width % size[1] == 0:
        return _resize_whole_blocks(image, size)
    return _to_8bit(_resize_separable(image, size, _area_taps, torch.float32))


def resize_cubic(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize an 8-bit image with the cubic kernel a = -0.75 and no antialiasing, as OpenCV's ``INTER_CUBIC``.

    The border is replicated, results are rounded once and clamped to 0..255. Meant for enlarging; a shrinking side is
    sampled at four pixels, as OpenCV does. This is OpenCV's result on x86, where its vendor library keeps full
    precision; builds without that library quantise the weights to 11 bits and differ by one level in 4 % of values.

    Args:
        image: (H, W, C) uint8.
        size: (height, width) of the result.

    Returns:
        uint8 image (height, width, C).

    Raises:
        UserError: the image is not 8-bit and three-dimensional, or the size is not positive.
    """
    height, width = _check_image(image, size)
    if size == (height, width):
        return image.clone()
    return _to_8bit(_resize_separable(image, size, _cubic_taps, torch.float32))


def resize_nearest(values: Tensor, size: tuple[int, int]) -> Tensor:
    """Nearest-neighbour resize of maps (..., H, W) of any dtype to (..., height, width).

    The source index is ``floor(i * source / target)``, clamped, which is OpenCV's ``INTER_NEAREST``: the first pixel
    maps to the first pixel and no half-pixel centre is involved (docs/benchmark.md, "Fusion and scoring").

    Raises:
        UserError: the size is not positive.
    """
    _check_size(size)
    rows = _nearest_index(values.shape[-2], size[0], values.device)
    columns = _nearest_index(values.shape[-1], size[1], values.device)
    return values.index_select(-2, rows).index_select(-1, columns)


def _check_size(size: tuple[int, int]) -> None:
    if min(size) < 1:
        raise UserError(f"Cannot resize to {size[0]}x{size[1]}; both sides must be at least 1 pixel.")


def _check_image(image: Tensor, size: tuple[int, int]) -> tuple[int, int]:
    _check_size(size)
    if image.dtype != torch.uint8 or image.ndim != 3:
        raise UserError(f"Resizing needs an 8-bit image with three dimensions, got {image.dtype} {tuple(image.shape)}.")
    return image.shape[0], image.shape[1]


def _resize_whole_blocks(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Area average when every output pixel covers whole input pixels, where exact ties are common.

    OpenCV rounds ties up for 2x2 blocks (its integer shortcut) and to even otherwise.
    """
    height, width = image.shape[:2]
    block_area = (height // size[0]) * (width // size[1])
    dtype = torch.float32 if block_area < 2**16 else torch.float64  # whole sums stay exact below 2**24
    total = _resize_separable(image, size, _block_taps, dtype)
    if (height, width) == (2 * size[0], 2 * size[1]):
        return (total * 0.25 + 0.5).floor().to(torch.uint8)
    reciprocal = torch.tensor(1.0 / block_area, dtype=torch.float32, device=image.device)
    return torch.round(total.to(torch.float32) * reciprocal).to(torch.uint8)


def _resize_separable(
    image: Tensor, size: tuple[int, int], make_taps: Callable[[int, int], _Taps], dtype: torch.dtype
) -> Tensor:
    """Weighted sums (height, width, C) along both axes of an image (H, W, C), in ``dtype``.

    Rows first, because whole rows are contiguous and most of the data disappears in that pass.
    """
    height, width, channels = image.shape
    shorter = _apply_taps(image.reshape(height, -1), make_taps(height, size[0]), dtype)
    columns_first = shorter.view(size[0], width, channels).permute(1, 2, 0).reshape(width, -1)
    total = _apply_taps(columns_first, make_taps(width, size[1]), dtype).view(size[1], channels, size[0])
    return total.permute(2, 0, 1).contiguous()


def _to_8bit(total: Tensor) -> Tensor:
    return total.round().clamp_(0, 255).to(torch.uint8)


def _apply_taps(values: Tensor, taps: _Taps, dtype: torch.dtype) -> Tensor:
    """Weighted sums along the first axis of (n_in, M): returns (n_out, M) in ``dtype``."""
    output = torch.empty(len(taps.index), values.shape[1], dtype=dtype, device=values.device)
    for start in range(0, len(taps.index), GROUP):
        index, weights = taps.index[start : start + GROUP], taps.weights[start : start + GROUP]
        low, high = int(index.min()), int(index.max()) + 1
        band = torch.zeros(len(index), high - low, dtype=torch.float64).scatter_add_(1, index - low, weights)
        band = band.to(device=values.device, dtype=dtype)
        torch.matmul(band, values[low:high].to(dtype), out=output[start : start + GROUP])
    return output


def _block_taps(n_in: int, n_out: int) -> _Taps:
    """Weight 1 for every input pixel of the output pixel's block."""
    index = torch.arange(n_in).view(n_out, n_in // n_out)
    return _Taps(index=index, weights=torch.ones(index.shape, dtype=torch.float64))


def _area_taps(n_in: int, n_out: int) -> _Taps:
    """Fraction of each output cell covered by each input pixel."""
    scale = n_in / n_out
    begin = torch.arange(n_out, dtype=torch.float64) * scale
    end = torch.minimum(begin + scale, torch.tensor(float(n_in), dtype=torch.float64))
    reach = int(scale) + 2
    index = begin.floor().long()[:, None] + torch.arange(reach)
    covered = (torch.minimum(end[:, None], index + 1.0) - torch.maximum(begin[:, None], index.double())).clamp(min=0)
    covered = torch.where((covered < NEGLIGIBLE_COVERAGE) | (index >= n_in), 0.0, covered)
    # OpenCV stores weights as float32, which decides the ties of simple ratios such as 4:3.
    weights = (covered / (end - begin)[:, None]).to(torch.float32).double()
    return _Taps(index=index.clamp(max=n_in - 1), weights=weights)


def _cubic_taps(n_in: int, n_out: int) -> _Taps:
    """Keys' cubic kernel at the four neighbours of each output centre."""
    centre = (torch.arange(n_out, dtype=torch.float64) + 0.5) * (n_in / n_out) - 0.5
    left = centre.floor()
    x = centre - left
    outer_left = ((CUBIC_A * (x + 1) - 5 * CUBIC_A) * (x + 1) + 8 * CUBIC_A) * (x + 1) - 4 * CUBIC_A
    inner_left = ((CUBIC_A + 2) * x - (CUBIC_A + 3)) * x * x + 1
    inner_right = ((CUBIC_A + 2) * (1 - x) - (CUBIC_A + 3)) * (1 - x) * (1 - x) + 1
    outer_right = 1 - outer_left - inner_left - inner_right
    weights = torch.stack((outer_left, inner_left, inner_right, outer_right), dim=1)
    index = left.long()[:, None] + torch.arange(-1, 3)
    return _Taps(index=index.clamp(0, n_in - 1), weights=weights)


def _nearest_index(n_in: int, n_out: int, device: torch.device) -> Tensor:
    # The ratio is formed as OpenCV forms it (1 / (out / in)): exact integer division differs at a few whole positions.
    ratio = 1.0 / (n_out / n_in)
    index = (torch.arange(n_out, dtype=torch.float64) * ratio).floor().long()
    return index.clamp(max=n_in - 1).to(device)
