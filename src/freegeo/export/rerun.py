"""``scene.rrd``: points, cameras with their images, and depth maps, for the viewer rerun.

Entities below `world`, in the reconstruction's frame (OpenCV axes): `points` and `path` (the cameras' positions, in
order) always; `camera` with `image` and `depth` at the number of their view on the timeline `view`. Depth maps are like
those of the depth format: the user's masks apply, the filters of points do not.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from freegeo import files
from freegeo.errors import FreeGeoError, UserError
from freegeo.export.base import Export, Format
from freegeo.export.pixels import HALF
from freegeo.export.reconstruction import Reconstruction

if TYPE_CHECKING:
    from freegeo.fusion.points import PointCloud

FILE_NAME = "scene.rrd"
TIMELINE = "view"
JPEG_QUALITY = 90
DEPTH_STEPS = 65535
"""The largest depth of a view has this value; 0: no valid depth."""
EXTRA = "The rerun export needs an extra: pip install 'freegeo[rerun]'."


def write_rerun(reconstruction: Reconstruction, cloud: PointCloud, depth_keep: np.ndarray, path: Path) -> Path:
    """Write a recording, without a viewer or a connection.

    Args:
        reconstruction: with cameras.
        cloud: world points.
        depth_keep: (S, H, W) bool, pixels whose depth is written.
        path: of the file.

    Raises:
        FreeGeoError: rerun cannot be loaded.
    """
    try:
        import rerun as rr
    except ImportError as error:
        raise FreeGeoError(f"rerun cannot be loaded ({error}). Run: pip install 'freegeo[rerun]'.") from None
    T_cam_world, K = (a.astype(np.float64) for a in reconstruction.cameras())
    poses = np.linalg.inv(T_cam_world)
    # As images cover 0 to their width, pixel centres are at 0.5.
    K[:, :2, 2] += HALF
    height, width = reconstruction.image_hw
    typical = float(np.median(np.linalg.norm(cloud.points - poses[cloud.view, :3, 3], axis=1)))
    with files.atomic_path(path) as part:
        recording = rr.RecordingStream("freegeo")
        recording.save(part)
        recording.log("world", rr.ViewCoordinates.RDF, static=True)
        about = rr.AnyValues(lengths=reconstruction.lengths)
        recording.log("world/points", rr.Points3D(cloud.points, colors=cloud.colours), about, static=True)
        recording.log("world/path", rr.LineStrips3D([poses[:, :3, 3]]), static=True)
        for view, name in enumerate(reconstruction.names):
            recording.set_time(TIMELINE, sequence=view)
            lens = rr.Pinhole(
                image_from_camera=K[view], width=width, height=height, camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=0.2 * typical,
            )  # fmt: skip
            place = rr.Transform3D(translation=poses[view, :3, 3], mat3x3=poses[view, :3, :3])
            recording.log("world/camera", place, lens, rr.AnyValues(photo=name))
            image = rr.EncodedImage(contents=_jpeg(reconstruction.images[view]), media_type="image/jpeg")
            recording.log("world/camera/image", image)
            values, steps = _depth_values(reconstruction.depth_z[view], depth_keep[view])
            recording.log("world/camera/depth", rr.DepthImage(values, meter=steps))
        recording.disconnect()
    return path


def _jpeg(image: np.ndarray) -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    return stream.getvalue()


def _depth_values(depth_z: np.ndarray, keep: np.ndarray) -> tuple[np.ndarray, float]:
    """Return depth (H, W) as uint16, 0 where it is not known, and the values in a unit of length."""
    largest = float(depth_z[keep].max()) if keep.any() else 1.0
    values = np.where(keep, np.clip(np.rint(np.where(keep, depth_z, 0) * (DEPTH_STEPS / largest)), 1, DEPTH_STEPS), 0)
    return values.astype(np.uint16), DEPTH_STEPS / largest


def check(names: Sequence[str]) -> None:
    """Raise UserError where rerun is not installed, whatever the photos are."""
    if find_spec("rerun") is None:
        raise UserError(EXTRA)


def _write(export: Export) -> list[Path]:
    path = export.folder / FILE_NAME
    return [write_rerun(export.reconstruction, export.cloud, export.depth_pixels(), path)]


FORMAT = Format(name="rerun", path=FILE_NAME, about="recording for the viewer rerun", write=_write, check=check)
