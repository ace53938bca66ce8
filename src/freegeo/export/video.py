"""``flythrough.mp4``: a flight along the cameras, past the coloured points; an earlier prediction is shown beside it.

H.264 where the installed `av` can encode it, otherwise VP9; both in MP4 with `yuv420p`, which browsers play.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np

from freegeo import files
from freegeo.errors import FreeGeoError
from freegeo.export.base import Before, Export, Format
from freegeo.export.reconstruction import Reconstruction

FILE_NAME = "flythrough.mp4"
FRAMES_PER_SECOND = 24
LONGEST_SIDE = 640
"""Longest side of one picture."""
LARGEST_SCALE = 4.0
"""Most pixels of a picture for one of the model's, in each direction."""
SUPERSAMPLING = 1.5
"""Pixels drawn for one of the picture, in each direction."""
ENCODERS = {
    # With its faster code for this CPU, x264 makes another file each time.
    "libx264": {"crf": "20", "preset": "fast", "x264-params": "cpu-independent=1"},
    "libvpx-vp9": {"crf": "32", "b": "0", "deadline": "realtime", "cpu-used": "6"},
}
"""Encoders with their options, the first that there is counts."""
_LINE, _LINE_COLOUR = 2, (235, 235, 235)


def write_video(pictures: Iterable[np.ndarray], path: Path) -> Path:
    """Encode pictures (H, W, 3) uint8, at least one, all of one size; FreeGeoError when `av` has no encoder for it."""
    import av

    encoder = next((name for name in ENCODERS if _encodes(name)), None)
    if encoder is None:
        raise FreeGeoError(f"{path}: the installed av encodes neither H.264 nor VP9. Install av from its own wheels.")
    rest = iter(pictures)
    first = next(rest)
    with files.atomic_path(path) as part, av.open(part, "w", format="mp4", options={"movflags": "faststart"}) as video:
        stream = video.add_stream(encoder, rate=FRAMES_PER_SECOND, options=ENCODERS[encoder])
        assert isinstance(stream, av.VideoStream)
        stream.height, stream.width = first.shape[:2]
        stream.pix_fmt = "yuv420p"
        # The number of threads changes the file.
        stream.codec_context.thread_count = 1
        for picture in chain([first], rest):
            video.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        video.mux(stream.encode())
    return path


def _encodes(name: str) -> bool:
    import av

    try:
        return av.Codec(name, "w").is_encoder
    except ValueError:  # an unknown codec
        return False


def flythrough(
    reconstruction: Reconstruction, keep: np.ndarray, *, before: Before | None = None, masks: np.ndarray | None = None
) -> Iterator[np.ndarray]:
    """Pictures (H, W, 3) uint8 of a flight along the cameras; those of an earlier prediction on the left, if any.

    Args:
        reconstruction: with cameras.
        keep: (S, H, W) bool, pixels that are points; at least one.
        before: an earlier prediction; left out when it is the same as the reconstruction.
        masks: (S, H, W) bool, the user's, where the points of the earlier prediction are chosen here.
    """
    from cv2 import INTER_AREA, resize

    from freegeo.export.flight import Painter, plan_flight

    flight = plan_flight(reconstruction, keep)
    (height, width), scale = picture_size(reconstruction.image_hw)
    drawn = round(SUPERSAMPLING * height), round(SUPERSAMPLING * width)
    sides = [(reconstruction, keep)]
    earlier = None if before is None else _earlier(before, reconstruction, masks)
    captions = None
    if before is not None and earlier is not None:
        sides = [earlier, *sides]
        captions = [_caption(label, height, width) for label in (before.label, before.result_label)]
    painters = [Painter(scene, points, flight.depth, drawn, SUPERSAMPLING * scale) for scene, points in sides]
    for T_cam_world, focal in zip(flight.T_cam_world, flight.focal, strict=True):
        pictures = [resize(one.draw(T_cam_world, focal), (width, height), interpolation=INTER_AREA) for one in painters]
        if captions is not None:
            pictures = [
                picture * (1 - opacity) + colour for picture, (colour, opacity) in zip(pictures, captions, strict=True)
            ]
            pictures[0][:, -_LINE:], pictures[1][:, :_LINE] = _LINE_COLOUR, _LINE_COLOUR
        yield np.concatenate(pictures, axis=1).round().astype(np.uint8)


def picture_size(image_hw: tuple[int, int]) -> tuple[tuple[int, int], float]:
    """Height and width of a picture for maps of a size, and its pixels for one of theirs in each direction.

    Height and width are even, for which a pixel may be cut.
    """
    scale = min(LARGEST_SCALE, LONGEST_SIDE / max(image_hw))
    height, width = (max(2, int(scale * side) // 2 * 2) for side in image_hw)
    return (height, width), scale


def _earlier(
    before: Before, reconstruction: Reconstruction, masks: np.ndarray | None
) -> tuple[Reconstruction, np.ndarray] | None:
    """Return an earlier prediction in the world of a reconstruction, and its points; None where they are the same."""
    from freegeo.export.alignment import align, moved_cameras
    from freegeo.export.formats import filter_reconstruction
    from freegeo.export.kept import load_kept

    found = Reconstruction.load(before.folder)
    if found.depth_z.shape != reconstruction.depth_z.shape:
        raise FreeGeoError(f"{before.folder}: has other views or another size than the result. Run again.")
    if all(np.array_equal(getattr(found, name), getattr(reconstruction, name)) for name in ("T_cam_world", "depth_z")):
        return None
    stored = load_kept(before.folder, found.depth_z.shape) if before.filters is None else None
    keep, _ = stored or filter_reconstruction(found, masks=masks, settings=before.filters)
    move = align(found, reconstruction)
    cameras = moved_cameras(found.cameras()[0], move)
    return replace(found, depth_z=found.depth_z * np.float32(move.s), T_cam_world=cameras), keep


def _caption(text: str, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Colours (H, W, 3), opacity applied, and opacity (H, W, 1) in [0, 1] of a label at the top left of a picture."""
    from PIL import Image, ImageDraw, ImageFont

    size = max(9, round(0.05 * height))
    layer = Image.new("RGBA", (width, height))
    draw = ImageDraw.Draw(layer)
    font = ImageFont.load_default(size)
    left, top, right, bottom = draw.textbbox((size, size), text, font=font, anchor="lt")
    edge = round(0.45 * size)
    draw.rounded_rectangle((left - edge, top - edge, right + edge, bottom + edge), edge, fill=(0, 0, 0, 170))
    draw.text((size, size), text, font=font, anchor="lt", fill=(255, 255, 255, 255))
    pixels = np.asarray(layer).astype(np.float32)
    opacity = pixels[..., 3:] / 255
    return pixels[..., :3] * opacity, opacity


def _write(export: Export) -> list[Path]:
    export.require_pixels()
    pictures = flythrough(export.reconstruction, export.keep, before=export.before, masks=export.masks)
    return [write_video(pictures, export.folder / FILE_NAME)]


FORMAT = Format(name="video", path=FILE_NAME, about="flight along the cameras", write=_write)
