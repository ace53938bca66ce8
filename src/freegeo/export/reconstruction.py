"""One prediction of one scene as NumPy arrays, and its file ``prediction.npz``: what every export starts from.

The keys are field names and must not change, because scripts of users read them:

| key | shape | type | meaning |
|---|---|---|---|
| `depth_z` | (S, H, W) | float32 | coordinate along the optical axis; metres with a scale, else up to scale |
| `conf` | (S, H, W) | float32 | confidence, higher is better, not calibrated; 1 where the model gives none |
| `T_cam_world` | (S, 4, 4) | float32, known ones float64 | world to camera, OpenCV axes; absent without cameras |
| `K` | (S, 3, 3) | as above | pixels of the H x W map, centres at whole numbers; absent without cameras |
| `sky` | (S, H, W) | float32 | 0 and more; sky from .3 on; absent when the model does not give it |
| `images` | (S, H, W, 3) | uint8 | the images the model read |
| `names` | (S,) | str | names of the photos |
| `photo_hw` | (S, 2) | int64 | height and width of the photos after EXIF rotation |
| `scale_xy`, `offset_xy` | (S, 2) | float64 | model pixel = photo pixel * scale + offset, x first |
| `scale_value`, `scale_spread` | () | float64 | the fields of `Scale`; absent where lengths are up to scale |
| `scale_source` | () | str | its third field |
| `format` | () | int64 | version of this table |
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from freegeo import files
from freegeo.errors import FreeGeoError, UserError, in_short
from freegeo.export.base import DEFAULT_FORMATS, MAX_TRACKS, DepthSize, Export, Exported, Format
from freegeo.fusion.settings import MAX_POINTS, FilterSettings

if TYPE_CHECKING:
    from torch import Tensor

    from freegeo.types import ImageBatch, PhotoLike, Prediction

FILE_NAME = "prediction.npz"
VERSION = 1
METRIC_MODEL = "a metric model"
_OPTIONAL = ("T_cam_world", "K", "sky")
_CAMERAS = ("T_cam_world", "K")
_VIEWS = (-1, -1, -1)
_ROTATION_SLACK = 0.01
"""Largest entry of R R^T - 1 in a file; that of float32 rotations is a thousand times smaller."""
_K_SLACK = 1e-6
"""Of the entries of K that are 0 or 1: means of several cameras have them but for rounding."""
_SMALLEST_FOCAL, _LONGEST = 1e-3, 1_000_000
"""In pixels, below which a number in a file is no focal length, and beyond which none is a side of an image."""
_KINDS: dict[str, files.Kind] = {
    "depth_z": ("f", _VIEWS), "conf": ("f", _VIEWS), "images": ("u", (-1, -1, -1, 3)), "names": ("U", (-1,)),
    "photo_hw": ("iu", (-1, 2)), "scale_xy": ("f", (-1, 2)), "offset_xy": ("f", (-1, 2)),
    "T_cam_world": ("f", (-1, 4, 4)), "K": ("f", (-1, 3, 3)), "sky": ("f", _VIEWS), "scale_value": ("f", ()),
    "scale_source": ("U", ()), "scale_spread": ("f", ()), "format": ("iu", ()),
}  # fmt: skip
_DTYPES = {"images": np.uint8, "photo_hw": np.int64, "scale_xy": np.float64, "offset_xy": np.float64}


@dataclass(frozen=True, kw_only=True)
class Scale:
    """What a reconstruction's lengths being metres rests on; FreeGeoError for a value or spread that is no number."""

    value: float
    """Factor that turned the prediction's lengths into metres; it is applied already."""
    source: str
    """What it comes from, as it reads after "from", such as `METRIC_MODEL`."""
    spread: float | None = None
    """Relative spread (standard deviation) of the factors of single measurements, such as views; None: unknown."""

    def __post_init__(self) -> None:
        """Raise FreeGeoError for values that no measurement gives."""
        if not (math.isfinite(self.value) and self.value > 0):
            raise FreeGeoError(f"the scale of a reconstruction must be positive, got {self.value}.")
        if self.spread is not None and not (math.isfinite(self.spread) and self.spread >= 0):
            raise FreeGeoError(f"the spread of a reconstruction's scale must not be negative, got {self.spread}.")

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the entries of the file."""
        found = {f.name: getattr(self, f.name) for f in fields(self)}
        return {f"scale_{name}": np.asarray(value) for name, value in found.items() if value is not None}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> Scale | None:
        """Read what `arrays` returned; None where there is no scale."""
        if "scale_value" not in arrays:
            return None
        spread = arrays.get("scale_spread")
        source = str(arrays.get("scale_source", "an unknown source"))
        return cls(value=float(arrays["scale_value"]), source=source, spread=None if spread is None else float(spread))


@dataclass(frozen=True, kw_only=True)
class Reconstruction:
    """A prediction for S photos at the model's resolution H x W; the table above is the description of its fields."""

    depth_z: np.ndarray
    """(S, H, W) float32."""
    conf: np.ndarray
    """(S, H, W) float32."""
    images: np.ndarray
    """(S, H, W, 3) uint8 RGB."""
    names: tuple[str, ...]
    photo_hw: np.ndarray
    """(S, 2) int64."""
    scale_xy: np.ndarray
    """(S, 2) float64."""
    offset_xy: np.ndarray
    """(S, 2) float64."""
    T_cam_world: np.ndarray | None = None
    """(S, 4, 4) float32 as predicted, float64 where cameras were known."""
    K: np.ndarray | None = None
    """(S, 3, 3), as above."""
    sky: np.ndarray | None = None
    """(S, H, W) float32."""
    scale: Scale | None = None
    """What the lengths being metres rests on; None: they are up to scale."""

    def __post_init__(self) -> None:
        """Raise FreeGeoError when a shape does not fit the others, or two views have one name."""
        views, height, width = self.depth_z.shape
        expected = {
            "conf": (views, height, width),
            "images": (views, height, width, 3),
            "photo_hw": (views, 2),
            "scale_xy": (views, 2),
            "offset_xy": (views, 2),
            "T_cam_world": (views, 4, 4),
            "K": (views, 3, 3),
            "sky": (views, height, width),
        }
        for name, shape in expected.items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise FreeGeoError(f"{name} of a reconstruction has the shape {value.shape}, expected {shape}.")
        if len(self.names) != views:
            raise FreeGeoError(f"A reconstruction of {views} views has {len(self.names)} names.")
        if len(set(self.names)) != views:
            raise FreeGeoError("Two views of a reconstruction have the same name.")

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.names)

    def __repr__(self) -> str:
        """Return the size of the result, not its arrays."""
        cameras = "cameras" if self.has_cameras else "no cameras"
        unit = "" if self.scale is None else ", metres"
        return f"Reconstruction({len(self)} views, {self.image_hw[1]} x {self.image_hw[0]} pixels, {cameras}{unit})"

    @property
    def lengths(self) -> str:
        """Unit of all lengths, and what it rests on, as it reads after "lengths are"."""
        return "up to scale" if self.scale is None else f"metres (from {self.scale.source})"

    @property
    def image_hw(self) -> tuple[int, int]:
        """Height and width of the model's maps."""
        return self.depth_z.shape[1], self.depth_z.shape[2]

    @property
    def has_cameras(self) -> bool:
        """Whether the model predicted cameras."""
        return self.K is not None and self.T_cam_world is not None

    def cameras(self) -> tuple[np.ndarray, np.ndarray]:
        """Return `T_cam_world` (S, 4, 4) and `K` (S, 3, 3); UserError when the model predicts no cameras."""
        if self.T_cam_world is None or self.K is None:
            raise UserError(
                "This reconstruction has no cameras, so it has no 3D points. Use a model that predicts cameras."
            )
        return self.T_cam_world, self.K

    def valid_pixels(self) -> np.ndarray:
        """Mask (S, H, W) bool of usable depth: finite, positive, and not in padding."""
        valid = self.inside()
        for view, depth in enumerate(self.depth_z):
            valid[view] &= np.isfinite(depth) & (depth > 0)
        return valid

    def photo_K(self) -> np.ndarray:
        """Intrinsics (S, 3, 3) float64 of the original photos, pixel centres at whole numbers.

        By the rule of `freegeo.geometry.camera.photo_K`.
        """
        import torch

        from freegeo.geometry.camera import photo_K

        values = (self.cameras()[1].astype(np.float64), self.scale_xy, self.offset_xy)
        return photo_K(*map(torch.from_numpy, values)).numpy()

    def inside(self) -> np.ndarray:
        """Mask (S, H, W) bool of the pixels that show the photo; the others are padding."""
        import torch

        from freegeo.types import inside_photo

        mapping = (self.photo_hw, self.scale_xy, self.offset_xy)
        return inside_photo(*map(torch.from_numpy, mapping), self.image_hw).numpy()

    def scaled(self, factor: float, *, source: str, spread: float | None = None) -> Reconstruction:
        """Return the reconstruction in metres: depth and camera positions times a factor, together.

        Args:
            factor: metres in a unit of its present lengths.
            source: what that comes from, as it reads after "from".
            spread: relative error of the factor; None: not known.

        Raises:
            FreeGeoError: a factor that is not positive.
        """
        scale = Scale(value=factor, source=source, spread=spread)
        T = self.T_cam_world
        if T is not None:
            T = T.copy()
            T[:, :3, 3] *= factor
        return replace(self, depth_z=(self.depth_z * factor).astype(np.float32), T_cam_world=T, scale=scale)

    @classmethod
    def from_prediction(cls, prediction: Prediction, batch: ImageBatch) -> Reconstruction:
        """Convert a model's prediction for a batch of photos.

        Args:
            prediction: tensors (S, ...) or (1, S, ...), on any device.
            batch: what the model read, in the same order.

        Raises:
            FreeGeoError: without depth, or for several scenes at once.
        """
        if prediction.depth_z is None:
            raise FreeGeoError("A prediction without depth cannot be stored. Decode with want=('depth', 'cameras').")
        depth_z = _to_numpy(prediction.depth_z, trailing=3)
        assert depth_z is not None
        conf = _to_numpy(prediction.conf, trailing=3)
        images = (batch.images.detach().float().clamp(0, 1) * 255).round().byte().permute(0, 2, 3, 1)
        return cls(
            depth_z=depth_z,
            conf=np.ones_like(depth_z) if conf is None else conf,
            T_cam_world=_to_numpy(prediction.T_cam_world, trailing=3),
            K=_to_numpy(prediction.K, trailing=3),
            sky=_to_numpy(prediction.sky, trailing=3),
            scale=_scale(prediction.scale),
            images=np.ascontiguousarray(images.cpu().numpy()),
            names=tuple(batch.names),
            photo_hw=batch.photo_hw.cpu().numpy().astype(np.int64),
            scale_xy=batch.scale_xy.cpu().numpy().astype(np.float64),
            offset_xy=batch.offset_xy.cpu().numpy().astype(np.float64),
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the content of the file: every field that is not None, under its name, and the format."""
        present = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "scale"}
        arrays = {name: np.asarray(value) for name, value in present.items() if value is not None}
        scale = {} if self.scale is None else self.scale.arrays()
        return {**arrays, **scale, "format": np.array(VERSION, np.int64)}

    def save(self, path: Path | str) -> Path:
        """Write the file (`prediction.npz` of `path` when that is a folder) atomically; returns where it is.

        It is compressed; one whose depth is mapped from a file is written uncompressed, as that file is.
        """
        file = _file(path)
        if isinstance(self.depth_z, np.memmap):
            files.write_npz_rows(file, self.arrays().items())
        else:
            files.write_npz(file, self.arrays())
        return file

    def export(
        self,
        folder: Path | str,
        formats: Sequence[str] = DEFAULT_FORMATS,
        *,
        filters: FilterSettings | None = None,
        masks: list[np.ndarray] | None = None,
        photos: Sequence[PhotoLike] | None = None,
        max_points: int | None = MAX_POINTS,
        max_tracks: int | None = MAX_TRACKS,
        voxel: float | None = None,
        depth_size: DepthSize = "model",
        seed: int = 0,
    ) -> Exported:
        """Write files for other tools, and return which, and which formats could not be written.

        A format that has nothing to write is a warning, and the others are written nevertheless. Files of the same
        formats that an earlier export left in the folder are replaced or removed.

        Args:
            folder: where they are written.
            formats: names of `freegeo.export.formats.FORMATS`; `all` stands for all that can be written.
            filters: which points are kept; None: the defaults of `FilterSettings`.
            masks: one (H, W) array per photo at its size, not zero where points are wanted.
            photos: the photos of this reconstruction, of which `colmap` and `nerfstudio` write upright copies, and by
                which depth is interpolated to their size.
            max_points: of `points.ply` and `scene.glb`; None writes all.
            max_tracks: points of the COLMAP model; None writes all.
            voxel: voxel edge of the mesh in the reconstruction's units; None: from its resolution.
            depth_size: of depth files: the model's, or the photos' by interpolation, which needs the photos.
            seed: of the random choice of points.

        Raises:
            UserError: a format that is unknown or can never be written: a missing extra, no cameras, one photo; no
                photos for depth at their size.
            FreeGeoError: nothing at all is left to write.
        """
        from freegeo.export.formats import check_formats, export, filter_reconstruction
        from freegeo.export.pixels import masks_for_model

        names = check_formats(formats, self.names, has_cameras=self.has_cameras)
        wanted = None if masks is None else masks_for_model(self, masks)
        filtered = filter_reconstruction(self, masks=wanted, settings=filters) if self.has_cameras else None
        return export(
            self, Path(folder).expanduser(), names, filtered=filtered, masks=wanted, photos=photos,
            max_points=max_points, max_tracks=max_tracks, voxel=voxel, depth_size=depth_size, seed=seed,
        ).require_any()  # fmt: skip

    @classmethod
    def load(cls, path: Path | str) -> Reconstruction:
        """Read what `save` or `save_streamed` wrote, from the file or the folder it is in.

        Arrays that the file stores uncompressed are mapped: they take memory as they are read, and can be larger than
        it. Writing into them does not change the file.

        Raises:
            UserError: there is no such file, or a newer freegeo wrote it.
            FreeGeoError: the file is damaged or not a reconstruction.
        """
        file = _file(path)
        if not file.is_file():
            raise UserError(
                f"{path}: holds no reconstruction ({FILE_NAME} is missing). Run `freegeo reconstruct` first."
            )
        version = int(files.read_npz(file, {"format": _KINDS["format"]}, optional=("format",)).get("format", VERSION))
        if version > VERSION:
            raise UserError(f"{file}: written by a newer freegeo (format {version}). Update freegeo.")
        return cls._from_arrays(files.read_npz(file, _KINDS, optional=_KINDS), file)

    @classmethod
    def _from_arrays(cls, arrays: dict[str, np.ndarray], file: Path) -> Reconstruction:
        names = [f.name for f in fields(cls) if f.name != "scale"]
        missing = [name for name in names if name not in arrays and name not in _OPTIONAL]
        if missing:
            raise FreeGeoError(f"{file}: not a reconstruction, {', '.join(missing)} missing. Name another file.")
        kept = {name: np.float64 for name in _CAMERAS if name in arrays and arrays[name].dtype == np.float64}
        types = {**_DTYPES, **kept}
        values = {
            n: arrays[n].astype(types.get(n, np.float32), copy=False) for n in names if n in arrays and n != "names"
        }
        try:
            found = cls(**values, names=tuple(map(str, arrays["names"])), scale=Scale.from_arrays(arrays))
        except (FreeGeoError, ValueError) as error:
            raise FreeGeoError(f"{file}: not a reconstruction ({error}) Name another file.") from None
        with np.errstate(all="ignore"):
            checks = found._checks()
        for name, can_be in checks.items():
            views = can_be.reshape(len(found), -1).all(1)
            if not views.all():
                view = in_short(found.names[int(np.argmin(views))])
                raise FreeGeoError(f"{file}: damaged, {name} of {view} is not that of a photo. Run again.")
        return found

    def _checks(self) -> dict[str, np.ndarray]:
        """Return by field (S, ...) bool whether a photo and its camera can have such numbers."""
        seen = self.photo_hw[:, ::-1] * self.scale_xy
        checks = {
            "photo_hw": (self.photo_hw >= 1) & (self.photo_hw <= _LONGEST),
            "scale_xy": (seen > 1 / _LONGEST) & (seen < _LONGEST),
            "offset_xy": np.abs(self.offset_xy) < _LONGEST,
        }
        if self.T_cam_world is not None:
            R = self.T_cam_world[:, :3, :3].astype(np.float64)
            turned = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)) < _ROTATION_SLACK
            checks["T_cam_world"] = np.isfinite(self.T_cam_world) & turned.all((1, 2), keepdims=True)
        if self.K is not None:
            # Some models fit the focal length to their points, and of poor ones it may come out below 0.
            focal = np.abs(self.K[:, (0, 1), (0, 1)]).min(1) > _SMALLEST_FOCAL
            below = np.abs(self.K[:, (1, 2, 2, 2), (0, 0, 1, 2)] - (0, 0, 0, 1)).max(1) < _K_SLACK
            checks["K"] = np.isfinite(self.K) & (focal & below)[:, None, None]
        return checks


def save_streamed(
    path: Path | str,
    *,
    names: Sequence[str],
    photo_hw: np.ndarray,
    scale_xy: np.ndarray,
    offset_xy: np.ndarray,
    blocks: Callable[[str], Iterator[np.ndarray] | None],
    T_cam_world: np.ndarray | None = None,
    K: np.ndarray | None = None,
    scale: Scale | None = None,
) -> Path:
    """Write the file of a reconstruction that is larger than memory, uncompressed and atomically; returns where it is.

    Args:
        path: of the file, or of the folder for `prediction.npz`.
        names: of the S photos.
        photo_hw: as the field of `Reconstruction`, like the next ones.
        scale_xy: (S, 2).
        offset_xy: (S, 2).
        blocks: called once each with `depth_z`, `conf`, `images` and `sky`, one after the other; yields the rows of
            that field in arrays (n, H, W[, 3]), in the order of the views. None for `sky` when there is none.
        T_cam_world: (S, 4, 4).
        K: (S, 3, 3).
        scale: of the lengths.

    Raises:
        FreeGeoError: rows of another number or shape than the rest; no file is left then.
        UserError: the folder cannot be written to.
    """
    rows = iter(blocks("depth_z") or ())
    first = next(rows, np.zeros((0, 0, 0), np.float32))
    shape = (len(names), *first.shape[1:])
    # Zeros without memory stand for what is not there yet: the rest is checked against them, and put into order.
    zeros = np.broadcast_to(np.float32(0), shape)
    planned = Reconstruction(
        depth_z=zeros, conf=zeros, images=np.broadcast_to(np.uint8(0), (*shape, 3)), names=tuple(names),
        photo_hw=photo_hw, scale_xy=scale_xy, offset_xy=offset_xy, T_cam_world=T_cam_world, K=K, scale=scale,
    )  # fmt: skip

    def entries() -> Iterator[tuple[str, np.ndarray | files.Rows]]:
        for name, value in planned.arrays().items():
            if name in ("depth_z", "conf", "images"):
                parts = chain([first], rows) if name == "depth_z" else blocks(name) or ()
                yield name, files.Rows(shape=value.shape, dtype=value.dtype, parts=parts)
            else:
                yield name, value
        sky = blocks("sky")
        if sky is not None:
            yield "sky", files.Rows(shape=shape, dtype=zeros.dtype, parts=sky)

    file = _file(path)
    files.write_npz_rows(file, entries())
    return file


def open_reconstruction(path: Path | str) -> Reconstruction:
    """Read a stored reconstruction, from its file or the output folder of a run; errors as `Reconstruction.load`."""
    return Reconstruction.load(path)


def _file(path: Path | str) -> Path:
    path = Path(path).expanduser()
    return path if path.suffix == ".npz" else path / FILE_NAME


def _to_numpy(tensor: Tensor | None, *, trailing: int) -> np.ndarray | None:
    if tensor is None:
        return None
    if tensor.ndim == trailing + 1 and tensor.shape[0] == 1:
        tensor = tensor[0]
    if tensor.ndim != trailing:
        raise FreeGeoError(f"One reconstruction holds one scene, got a prediction of shape {tuple(tensor.shape)}.")
    return np.ascontiguousarray(tensor.detach().float().cpu().numpy())


def _scale(scale: Tensor | None) -> Scale | None:
    if scale is None:
        return None
    value, spread = scale.reshape(2).tolist()
    return Scale(value=value, source=METRIC_MODEL, spread=None if math.isnan(spread) else spread)


def _write(export: Export) -> list[Path]:
    return [export.reconstruction.save(export.folder)]


FORMAT = Format(name="npz", path=FILE_NAME, about="depth, confidence, cameras", write=_write, needs_cameras=False)
