"""Photos without distortion: what models see of photos whose known camera has a lens.

The undistorted photo has the size of the original, a pinhole camera with the principal point in the middle, and shows
nothing that the original does not show: its focal length is the smallest with which no border is invisible. OpenCV
computes the rays; its pixel centres are at whole numbers, those of `KnownCamera.K` and of every place here at .5.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np

from freegeo.cameras.known import KnownCamera, KnownCameras, Lens
from freegeo.errors import UserError

if TYPE_CHECKING:
    from freegeo.types import PhotoLike

__all__ = ["LENSES", "UndistortedPhoto", "undistort", "undistorted"]

logger = logging.getLogger(__name__)

LENSES = {"SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4, "OPENCV_FISHEYE": 4, "FULL_OPENCV": 8}
"""COLMAP's camera models that can be undistorted, and how many numbers of distortion they have."""
FISHEYE = "OPENCV_FISHEYE"
WIDEST_DEG = 110.0
"""Field of view of an undistorted photo along either side; a pinhole image stretches what is farther out."""
WORTH_SAYING_DEG = 10.0
"""A warning names what is lost of the field of view from this on."""
SMALLEST_SLOPE = 0.1
"""How much of the way of a ray the lens must show, at least; at a fold it is nothing."""
_SCALES = (0.05, 8.0)
"""Focal lengths of the undistorted photo that are tried, in those of the original."""
LONGEST_SIDE = 32_766
"""What OpenCV can resample."""
_BORDER, _ALONG = 64, 16
"""Points on each side of the border, and on the way to each of them, at which the lens is looked at."""


@dataclass(frozen=True, eq=False)
class UndistortedPhoto:
    """A photo as a pinhole camera would have taken it; pixels are computed at each `read`, and nothing is kept."""

    photo: PhotoLike
    """The original."""
    original: KnownCamera
    """Its camera, with the lens."""
    K: np.ndarray
    """(3, 3) float64 of the undistorted photo, counted from the corner."""

    @property
    def name(self) -> str:
        """The original's name."""
        return self.photo.name

    @property
    def size_hw(self) -> tuple[int, int]:
        """Height and width, those of the original."""
        return self.photo.size_hw

    @property
    def blank(self) -> bool:
        """Whether the original is known to be almost black, white or of one colour."""
        return getattr(self.photo, "blank", False)

    @property
    def camera(self) -> KnownCamera:
        """The camera of the undistorted photo: a pinhole."""
        return replace(self.original, K=self.K, lens=None, size_hw=self.size_hw)

    def read(self) -> np.ndarray:
        """Decode the original and undistort it, (H, W, 3) uint8."""
        import cv2

        pixels = self.photo.read()
        return cv2.remap(pixels, *self._map, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)

    @property
    def _map(self) -> tuple[np.ndarray, np.ndarray]:
        """Column and row (H, W) float32 of the original at every pixel, centres at whole numbers."""
        import cv2

        old, new = self._camera.K.copy(), self.K.copy()
        old[:2, 2] -= 0.5
        new[:2, 2] -= 0.5
        height, width = self.size_hw
        make = cv2.fisheye.initUndistortRectifyMap if self._camera.fisheye else cv2.initUndistortRectifyMap
        return make(old, self._camera.coefficients, np.eye(3), new, (width, height), cv2.CV_32FC1)

    @cached_property
    def _camera(self) -> _LensCamera:
        return _LensCamera.of(self.original)

    def to_original(self, pixels: np.ndarray) -> np.ndarray:
        """Places (n, 2) in the original of places in the undistorted photo, both counted from the corner."""
        pixels = np.asarray(pixels, np.float64)
        return self._camera.pixels((pixels - self.K[:2, 2]) / self.K[[0, 1], [0, 1]])

    def from_original(self, pixels: np.ndarray) -> np.ndarray:
        """Places (n, 2) in the undistorted photo of places in the original, both counted from the corner.

        They may lie outside the undistorted photo, which shows less; nan where the lens has no ray.
        """
        rays = self._camera.rays(np.asarray(pixels, np.float64))
        return rays * self.K[[0, 1], [0, 1]] + self.K[:2, 2]


def undistort(photo: PhotoLike, camera: KnownCamera) -> UndistortedPhoto:
    """Return a photo without the distortion of its camera.

    Raises:
        UserError: the lens is none of `LENSES`, the intrinsics are not known, or no pinhole photo can be made of it.
    """
    if camera.lens is None or camera.K is None:
        raise UserError(f"{photo.name}: distortion and intrinsics are needed to undistort a photo.")
    require_lens(camera.lens)
    fx, fy, (height, width) = camera.K[0, 0], camera.K[1, 1], photo.size_hw
    try:
        if max(height, width) > LONGEST_SIDE:
            raise ValueError(f"sides of more than {LONGEST_SIDE} pixels cannot be resampled")
        scale = _scale(camera.lens, tuple(camera.K.ravel().tolist()), photo.size_hw)
    except ValueError as error:
        raise UserError(
            f"{photo.name}: the lens ({camera.lens.model}) cannot be undistorted: {error}. Undistort the photos "
            "elsewhere, and give the cameras of the undistorted ones."
        ) from None
    K = np.array([[scale * fx, 0, width / 2], [0, scale * fy, height / 2], [0, 0, 1]])
    return UndistortedPhoto(photo, camera, K)


@lru_cache(maxsize=64)
def _scale(lens: Lens, K: tuple[float, ...], size_hw: tuple[int, int]) -> float:
    """Focal length of the undistorted photo, in those of the original; photos of one camera share it."""
    camera = _LensCamera.of(KnownCamera(K=np.reshape(K, (3, 3)), lens=lens))
    return max(camera.smallest_scale(size_hw), camera.scale_of_widest(size_hw))


def undistorted(photos: Sequence[PhotoLike], known: KnownCameras) -> tuple[list[PhotoLike], KnownCameras]:
    """Return the photos, and their cameras, with every one undistorted that has distortion.

    Photos without distortion stay the objects that they are. What is lost of the field of view is said in the log.
    """
    new_photos, cameras, done = [], [], []
    for photo, camera in zip(photos, known.cameras, strict=True):
        if camera.lens is None:
            pass
        elif camera.lens.model != FISHEYE and not any(camera.lens.params):
            camera = replace(camera, lens=None)
        else:
            photo = undistort(photo, camera)
            camera = photo.camera
            done.append(photo)
        new_photos.append(photo)
        cameras.append(camera)
    if done:
        _say_fields(done, len(photos))
    return new_photos, replace(known, cameras=tuple(cameras))


def _say_fields(photos: list[UndistortedPhoto], count: int) -> None:
    """Log how much of the field of view is left, of the photo that loses most."""
    before, after, photo = max(
        ((before, after, photo) for photo in photos for before, after in [_fields(photo)]),
        key=lambda row: max(a - b for a, b in zip(row[0], row[1], strict=True)),
    )
    lost = max(a - b for a, b in zip(before, after, strict=True))
    logger.log(
        logging.WARNING if lost > WORTH_SAYING_DEG else logging.INFO,
        "%d of %d photos are undistorted; %s shows %.0f x %.0f of %.0f x %.0f degrees afterwards.",
        len(photos), count, photo.name, *after, *before,
    )  # fmt: skip


def _fields(photo: UndistortedPhoto) -> tuple[tuple[float, float], tuple[float, float]]:
    """Horizontal and vertical field of view, in degrees, of the original and of the undistorted photo."""
    height, width = photo.size_hw
    after = tuple(2 * np.degrees(np.arctan(side / 2 / photo.K[k, k])) for k, side in enumerate((width, height)))
    return photo._camera.field_deg((height, width)), after


@dataclass(frozen=True, eq=False)
class _LensCamera:
    """A lens as OpenCV takes it; pixels are counted from the corner."""

    K: np.ndarray
    coefficients: np.ndarray
    fisheye: bool

    @classmethod
    def of(cls, camera: KnownCamera) -> _LensCamera:
        lens = camera.lens
        assert lens is not None and camera.K is not None
        require_lens(lens)
        numbers = list(lens.params)
        if lens.model in ("SIMPLE_RADIAL", "RADIAL"):
            numbers += [0.0] * (4 - len(numbers))
        return cls(np.asarray(camera.K, np.float64), np.array(numbers), lens.model == FISHEYE)

    def pixels(self, rays: np.ndarray) -> np.ndarray:
        """Places (n, 2) at which rays (n, 2), with z = 1, appear."""
        import cv2

        points = np.concatenate((rays, np.ones((len(rays), 1))), axis=1)[:, None]
        none = np.zeros(3)
        project = cv2.fisheye.projectPoints if self.fisheye else cv2.projectPoints
        if self.fisheye:
            return project(points, none, none, self.K, self.coefficients)[0][:, 0]
        return project(points, none, none, self.K, self.coefficients)[0].reshape(-1, 2)

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Rays (n, 2), with z = 1, of places (n, 2); nan where there is none."""
        import cv2

        criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-14)
        module = cv2.fisheye if self.fisheye else cv2
        found = module.undistortPoints(pixels[:, None], self.K, self.coefficients, criteria=criteria)[:, 0]
        missed = np.linalg.norm(self.pixels(found) - pixels, axis=1) > 0.01
        found[missed] = np.nan
        return found

    def smallest_scale(self, size_hw: tuple[int, int]) -> float:
        """Smallest focal length, in those of the original, with which every border pixel is in the original."""
        scales = np.geomspace(*_SCALES, 24)[::-1]
        if not self._covered(scales[0], size_hw):
            raise ValueError("the original shows too little around the optical axis, or its numbers are no lens")
        high = scales[0]
        for scale in scales[1:]:
            if not self._covered(scale, size_hw):
                low = scale
                break
            high = scale
        else:
            return float(high)
        for _ in range(30):
            middle = (low * high) ** 0.5
            low, high = (low, middle) if self._covered(middle, size_hw) else (middle, high)
        return float(high)

    def scale_of_widest(self, size_hw: tuple[int, int]) -> float:
        """Focal length, in those of the original, with which the longer field of view is `WIDEST_DEG`."""
        sides = np.array(size_hw[::-1]) / 2 / self.K[[0, 1], [0, 1]]
        return float(sides.max() / np.tan(np.radians(WIDEST_DEG / 2)))

    def _covered(self, scale: float, size_hw: tuple[int, int]) -> bool:
        """Whether the border of the undistorted photo, and the way to it, lies in the original without a fold."""
        height, width = size_hw
        u, v = np.linspace(-width / 2, width / 2, _BORDER), np.linspace(-height / 2, height / 2, _BORDER)
        sides = [(u, np.full_like(u, end)) for end in (v[0], v[-1])] + [
            (np.full_like(v, end), v) for end in (u[0], u[-1])
        ]
        border = np.concatenate([np.stack(side, axis=1) for side in sides]) / (scale * self.K[[0, 1], [0, 1]])
        # The last step is short: a fold shows in the slope at the border first.
        steps = np.append(np.linspace(0, 1, _ALONG)[1:-1], (0.999, 1.0))
        places = self.pixels((steps[:, None, None] * border).reshape(-1, 2)).reshape(_ALONG, -1, 2)
        distance = np.linalg.norm((places - self.K[:2, 2]) / self.K[[0, 1], [0, 1]], axis=2)
        inside = (places >= 0).all() and (places <= np.array([width, height])).all()
        ways = np.diff(steps, prepend=0)[1:, None] * np.linalg.norm(border, axis=1)
        return bool(inside and (np.diff(distance, axis=0) > SMALLEST_SLOPE * ways).all())

    def field_deg(self, size_hw: tuple[int, int]) -> tuple[float, float]:
        """Horizontal and vertical field of view of the original through its principal point, below 180 degrees."""
        angles = np.radians(np.arange(0, 89.9, 0.1))
        field = []
        for axis, side in enumerate(size_hw[::-1]):
            total = 0.0
            for sign in (-1, 1):
                rays = np.zeros((len(angles), 2))
                rays[:, axis] = sign * np.tan(angles)
                place = sign * (self.pixels(rays)[:, axis] - self.K[axis, 2])
                room = self.K[axis, 2] if sign < 0 else side - self.K[axis, 2]
                seen = (place <= room) & (np.diff(place, prepend=-1.0) > 0)
                total += np.degrees(angles[seen.argmin() - 1 if not seen.all() else -1])
            field.append(float(total))
        return field[0], field[1]


def require_lens(lens: Lens) -> None:
    """Raise UserError for a lens that cannot be undistorted, or whose numbers are too many, too few or not finite."""
    if lens.model not in LENSES:
        raise UserError(
            f"cameras of the model {lens.model:.40} cannot be undistorted; known are {', '.join(LENSES)} and pinholes. "
            "Undistort the photos elsewhere, and give the cameras of the undistorted ones."
        )
    if len(lens.params) != LENSES[lens.model] or not np.isfinite(lens.params).all():
        raise UserError(f"a camera of the model {lens.model} has {LENSES[lens.model]} finite numbers of distortion.")
