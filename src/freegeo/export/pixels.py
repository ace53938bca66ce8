"""From the model's pixels to those of the original photos, in the pixel coordinates of other tools.

freegeo gives the centre of the top left pixel the coordinates (0, 0). COLMAP and nerfstudio count from the image's
corner, so that the same centre is at (0.5, 0.5). Resizing keeps corners, not centres, in place: pixel u of the model's
image is at `(u + 0.5 - offset) / scale` in the photo, counted from the corner. Only these functions convert between
the two; with them every 3D point projects to the image content that it was lifted from.
"""

from __future__ import annotations

import numpy as np

from freegeo.errors import UserError
from freegeo.export.reconstruction import Reconstruction

HALF = 0.5


def corner_pixels(reconstruction: Reconstruction, view: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """Places (n, 2) in the photos, counted from the corner, of model pixels (n, 2) in the views `view` (n,)."""
    return (pixel + HALF - reconstruction.offset_xy[view]) / reconstruction.scale_xy[view]


def corner_K(reconstruction: Reconstruction) -> np.ndarray:
    """Intrinsics (S, 3, 3) float64 of the original photos, with pixel centres at 0.5."""
    import torch

    from freegeo.geometry.camera import photo_K

    values = (reconstruction.cameras()[1].astype(np.float64), reconstruction.scale_xy, reconstruction.offset_xy - HALF)
    return photo_K(*map(torch.from_numpy, values)).numpy()


def map_places(count: int, side: int, scale: float, offset: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the pixels of a photo are in a map of the model, along one axis.

    Args:
        count: pixels of the photo.
        side: pixels of the map.
        scale: from the photo to the map.
        offset: of the map.

    Returns:
        (count,) float64 places, where the centres of the map's pixels are at whole numbers; (count,) int64 the map's
        pixel that each falls into, the nearest one for those outside; (count,) bool whether it falls into one.
    """
    corner = (np.arange(count) + HALF) * scale + offset
    return corner - HALF, np.clip(np.floor(corner), 0, side - 1).astype(np.int64), (corner >= 0) & (corner < side)


def mask_for_photo(reconstruction: Reconstruction, view: int, mask: np.ndarray) -> np.ndarray:
    """Turn a mask (H, W) bool of a view's map into one (h, w) of its photo; false where the model did not see it."""
    (row, row_seen), (column, column_seen) = (
        map_places(
            int(reconstruction.photo_hw[view, axis]), mask.shape[axis], reconstruction.scale_xy[view, 1 - axis],
            reconstruction.offset_xy[view, 1 - axis],
        )[1:]
        for axis in (0, 1)
    )  # fmt: skip
    return mask[row[:, None], column] & row_seen[:, None] & column_seen


def masks_for_model(reconstruction: Reconstruction, masks: list[np.ndarray]) -> np.ndarray:
    """Turn a user's masks into one (S, H, W) bool for the model's maps, true where points are wanted.

    It is false in the padding around a photo.

    Args:
        reconstruction: what the masks belong to.
        masks: one array per view, of the photo's or of the model's height and width; anything but 0 is wanted.

    Raises:
        UserError: another number of masks than views, or a mask of another size.
    """
    if len(masks) != len(reconstruction):
        raise UserError(f"{len(masks)} masks for {len(reconstruction)} views. Give one mask per photo, in their order.")
    found = np.stack([_model_mask(reconstruction, view, np.asarray(mask)) for view, mask in enumerate(masks)])
    return found & reconstruction.inside()


def _model_mask(reconstruction: Reconstruction, view: int, mask: np.ndarray) -> np.ndarray:
    height, width = reconstruction.image_hw
    photo_hw = tuple(reconstruction.photo_hw[view].tolist())
    if mask.shape == (height, width):
        return mask != 0
    if mask.shape != photo_hw:
        size = " x ".join(str(side) for side in mask.shape)
        raise UserError(
            f"The mask of {reconstruction.names[view]} has the size {size}, but the photo is "
            f"{photo_hw[0]} x {photo_hw[1]} (height x width). Save masks at the size of the photos."
        )
    scale, offset = reconstruction.scale_xy[view], reconstruction.offset_xy[view]
    column, row = (
        np.clip(((np.arange(side) + HALF - offset[axis]) / scale[axis]).astype(np.int64), 0, photo_hw[1 - axis] - 1)
        for axis, side in enumerate((width, height))
    )
    return mask[row[:, None], column] != 0
