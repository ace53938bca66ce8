"""A user's video as photos: frames that are sharp and far enough apart, as they are shown, decoded again when read.

Frames are turned, mirrored and given square pixels as the file says.

The file is decoded twice. The first pass looks at reduced frames and keeps one candidate per time slot, at most
`MAX_CANDIDATES` of them however long the video is. Frames are chosen among the candidates, and their pixels are decoded
when they are read, so memory does not grow with length or resolution.
"""

from __future__ import annotations

import logging
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from freegeo.data.image_files import MAX_PIXELS, is_blank
from freegeo.errors import FreeGeoError, UserError

logger = logging.getLogger(__name__)

VIDEO_SUFFIXES = frozenset({
    ".mp4", ".mov", ".m4v", ".3gp", ".3g2", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".vob", ".ts", ".mts", ".m2ts",
    ".wmv", ".asf", ".flv", ".ogv",
})  # fmt: skip
VIDEO_KINDS = "MP4, MOV, MKV, WebM, AVI, MPEG, TS, WMV, FLV and OGV"
_CONTAINERS = "mov,matroska,avi,mpeg,mpegvideo,mpegts,asf,flv,ogg"
"""What FFmpeg may find in a file: no playlists, nor anything else that makes it open other files or the network."""
MAX_CANDIDATES = 2048
SMALLEST_CHANGE = 0.05
"""Mean absolute difference, in standard deviations of the image, below which two frames count as one view."""
_SHARPNESS_WIDTH, _THUMBNAIL_HW = 320, (36, 48)
_FIRST_SLOT_S = 1 / 30
_FALLBACK_RATE = 30.0
_MISSING_SHARE = 0.1
"""Share of the length at whose end no frame may be, before a warning."""
_EXTREME_ASPECT = 4
"""Aspect of a pixel that no camera has."""


@dataclass(frozen=True, kw_only=True)
class VideoFrame:
    """One chosen frame; usable wherever a photo is."""

    name: str
    """Name of the video and number of the frame, with the suffix `.png`."""
    path: Path
    size_hw: tuple[int, int]
    """Height and width as it is shown."""
    time_s: float
    """Seconds since the first frame."""
    number: int
    """Position among the decodable frames of the file."""
    pts: int | None
    """Timestamp as stored; None where the file has none."""

    def read(self) -> np.ndarray:
        """Decode to upright RGB (H, W, 3) uint8. FreeGeoError when the file has changed since."""
        from av.error import FFmpegError

        for seek in (True, False) if self.pts is not None else (False,):
            try:
                with _opened(self.path) as container:
                    frame = self._find(container, seek)
                    if frame is not None:
                        return _shown(frame, _pixel_aspect(container))
            except UserError:
                raise
            except (FFmpegError, OSError, ValueError) as error:
                # Where a file cannot be sought in, it is decoded from the start.
                if not seek:
                    reason = getattr(error, "strerror", None) or error
                    raise FreeGeoError(f"{self.path}: frame {self.number} cannot be read ({reason}).") from None
        raise FreeGeoError(f"{self.path}: frame {self.number} is no longer there. Was the video replaced?")

    def _find(self, container: Any, seek: bool) -> Any:
        stream = container.streams.video[0]
        if seek:
            container.seek(self.pts, stream=stream)
        for number, frame in enumerate(_decoded(container)):
            if seek and frame.pts is not None and frame.pts >= self.pts:
                # Where a wrong index seeks past the frame, None makes the caller decode from the start.
                return frame if frame.pts == self.pts else None
            if not seek and number == self.number:
                return frame
        return None


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """The data of one frame that the choice of frames is based on."""

    number: int
    pts: int | None
    time_s: float
    size_hw: tuple[int, int]
    sharpness: float
    """Variance of the Laplacian of the frame at 320 pixels width; compared between neighbours only."""
    thumbnail: np.ndarray
    """(36, 48) float16 grey values with mean 0 and standard deviation 1, so that exposure does not count as motion."""
    blank: bool = False
    """Whether the frame is almost black, white or of one colour."""


def is_video(path: Path | str) -> bool:
    """Whether a path is named like a video."""
    return Path(path).suffix.lower() in VIDEO_SUFFIXES


def load_video(path: Path | str, *, fps: float | None = None, max_views: int) -> list[VideoFrame]:
    """Choose frames of a video, in order of time.

    Args:
        path: of a file that FFmpeg reads.
        fps: frames per second of the video's own clock: the sharpest frame of each interval, evenly thinned to
            `max_views`. None chooses by parallax: at steps of about the same image change the sharpest frame near each
            step, so a camera that rests gives one frame.
        max_views: most frames to return.

    Returns:
        At least one frame. Variable frame rates are followed by the timestamps. Of a damaged file, what can be decoded;
        a warning says how much is lost. Blank frames are chosen only when all are.

    Raises:
        UserError: no such file, not a video, a video without frames, or `fps` or `max_views` out of range.
    """
    path = Path(path)
    if max_views < 1:
        raise UserError(f"--max-views must be at least 1, got {max_views}.")
    if fps is not None and not 0 < fps < float("inf"):
        raise UserError(f"--fps must be a positive number, got {fps}.")
    if not path.is_file():
        raise UserError(f"{path}: no such video.")
    found = collect_candidates(path, slot_s=_FIRST_SLOT_S if fps is None else 1 / fps)
    if not found:
        raise UserError(f"{path}: the video has no frame that can be decoded. Record or convert it again.")
    usable = [candidate for candidate in found if not candidate.blank]
    if not usable:
        logger.warning("%s: almost black, white or of one colour in every frame. Look whether it is meant to be.", path)
    elif len(usable) < len(found):
        logger.info("%s: %d blank frames are left out", path.name, len(found) - len(usable))
    found = usable or found
    chosen = choose_by_time(found, max_views) if fps is not None else choose_by_parallax(found, max_views)
    logger.info("%s: %d of %d candidate frames chosen", path.name, len(chosen), len(found))
    digits = max(6, len(str(found[-1].number)))
    return [
        VideoFrame(
            name=f"{path.stem}_{c.number:0{digits}d}.png",
            path=path,
            size_hw=c.size_hw,
            time_s=c.time_s,
            number=c.number,
            pts=c.pts,
        )
        for c in chosen
    ]


def collect_candidates(path: Path, *, slot_s: float) -> list[Candidate]:
    """Return the sharpest frame of every time slot, in order of time.

    Slots start at `slot_s` seconds and are doubled whenever more than `MAX_CANDIDATES` are filled.
    """
    best: dict[int, Candidate] = {}
    with _opened(path) as container:
        for candidate in _looked_at(container, path):
            _keep_sharper(best, candidate, slot_s)
            if len(best) > MAX_CANDIDATES:
                slot_s *= 2
                merged: dict[int, Candidate] = {}
                for kept in best.values():
                    _keep_sharper(merged, kept, slot_s)
                best = merged
    return sorted(best.values(), key=lambda c: (c.time_s, c.number))


def _keep_sharper(best: dict[int, Candidate], candidate: Candidate, slot_s: float) -> None:
    # The small offset keeps the rounding of timestamps from moving a frame into the slot before its own.
    slot = int(candidate.time_s / slot_s + 1e-3)
    if slot not in best or candidate.sharpness > best[slot].sharpness:
        best[slot] = candidate


def choose_by_time(candidates: Sequence[Candidate], max_views: int) -> list[Candidate]:
    """Thin candidates evenly to at most `max_views`, first and last included (the first alone for one view)."""
    places = np.linspace(0, len(candidates) - 1, min(len(candidates), max_views))
    return [candidates[round(place)] for place in places]


def choose_by_parallax(candidates: Sequence[Candidate], max_views: int) -> list[Candidate]:
    """Choose candidates at even steps of image change, near each step the sharpest.

    The change is summed over frames that differ from the last one counted by more than `SMALLEST_CHANGE`, so noise of a
    resting camera adds nothing. For each step the sharpest frame up to half way to the neighbouring steps is taken.
    """
    moved, way = _way(np.stack([c.thumbnail for c in candidates]).astype(np.float32).reshape(len(candidates), -1))
    marks = np.linspace(0, way[-1], min(len(moved), max_views))
    steps = sorted({int(moved[np.abs(way - mark).argmin()]) for mark in marks})
    borders = [0, *((a + b + 1) // 2 for a, b in pairwise(steps)), len(candidates)]
    return [max(candidates[start:end], key=lambda c: c.sharpness) for start, end in pairwise(borders)]


def _way(thumbnails: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices (n,) of the frames that are counted, the first included, and the summed change (n,) up to each."""
    moved, way = [0], [0.0]
    for k in range(1, len(thumbnails)):
        change = float(np.abs(thumbnails[k] - thumbnails[moved[-1]]).mean())
        if change > SMALLEST_CHANGE:
            moved.append(k)
            way.append(way[-1] + change)
    return np.array(moved), np.array(way)


def _looked_at(container: Any, path: Path) -> Iterator[Candidate]:
    from av.error import FFmpegError

    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    rate = float(stream.average_rate or _FALLBACK_RATE)
    pixel_aspect = _pixel_aspect(container)
    start, last, damaged = None, 0.0, 0
    errors: list[Exception] = []
    for number, frame in enumerate(_decoded(container, errors)):
        time_s = frame.time if frame.time is not None else number / rate
        start = time_s if start is None else start
        last = max(last, time_s - start)
        try:
            grey = None if frame.is_corrupt else _grey(frame)
        except (FFmpegError, OSError, ValueError):
            grey = None
        if grey is None:
            damaged += 1
            continue
        yield Candidate(
            number=number,
            pts=frame.pts,
            time_s=max(0.0, time_s - start),
            size_hw=_shown_hw(frame, pixel_aspect),
            sharpness=sharpness(grey),
            thumbnail=_thumbnail(grey),
            blank=is_blank(grey),
        )
    if start is not None and (errors or damaged):
        logger.warning(
            "%s: %d damaged frames are left out; those after them may be smeared up to the next key frame. Copy or "
            "record the video again if you can.", path, len(errors) + damaged,
        )  # fmt: skip
    length = _length_s(container)
    if start is not None and length - last - 1 / rate > max(0.5, _MISSING_SHARE * length):
        logger.warning(
            "%s: the video should be %.1f s long, but its frames end at %.1f s. What there is is used; copy or record "
            "the video again if you can.", path, length, last,
        )  # fmt: skip


def _length_s(container: Any) -> float:
    """Length of the pictures in seconds by the file's header; 0 where it says nothing."""
    stream = container.streams.video[0]
    lengths = [float(stream.duration * stream.time_base)] if stream.duration else []
    lengths += [container.duration / 1e6] if container.duration else []
    return min(lengths, default=0.0)


def sharpness(grey: np.ndarray) -> float:
    """Variance of the Laplacian of an image (H, W); 0 for images without an interior."""
    if min(grey.shape) < 3:
        return 0.0
    values = grey.astype(np.float32)
    laplacian = values[:-2, 1:-1] + values[2:, 1:-1] + values[1:-1, :-2] + values[1:-1, 2:] - 4 * values[1:-1, 1:-1]
    return float(laplacian.var())


def _grey(frame: Any) -> np.ndarray:
    """Luminance (h, w) uint8 at no more than 320 pixels width."""
    width = min(frame.width, _SHARPNESS_WIDTH)
    height = max(1, round(frame.height * width / frame.width))
    return frame.reformat(width=width, height=height, format="gray").to_ndarray()


def _thumbnail(grey: np.ndarray) -> np.ndarray:
    from PIL import Image

    small = np.asarray(Image.fromarray(grey).resize(_THUMBNAIL_HW[::-1], Image.Resampling.BOX), dtype=np.float32)
    return ((small - small.mean()) / max(float(small.std()), 1.0)).astype(np.float16)


def _pixel_aspect(container: Any) -> float:
    """Width of a pixel over its height, as the video is shown."""
    return float(container.streams.video[0].sample_aspect_ratio or 1)


def _square_hw(frame: Any, pixel_aspect: float) -> tuple[int, int]:
    """Height and width of a stored frame with square pixels: the shorter side of a pixel grows."""
    wide = pixel_aspect >= 1
    height = frame.height if wide else round(frame.height / pixel_aspect)
    return height, round(frame.width * pixel_aspect) if wide else frame.width


def _shown_hw(frame: Any, pixel_aspect: float) -> tuple[int, int]:
    size_hw = _square_hw(frame, pixel_aspect)
    return size_hw[::-1] if _turn(frame)[0] % 2 else size_hw


def _shown(frame: Any, pixel_aspect: float) -> np.ndarray:
    """Return RGB (H, W, 3) uint8 as a player shows it: square pixels, upright, mirrored where the file says so."""
    height, width = _square_hw(frame, pixel_aspect)
    if (height, width) == (frame.height, frame.width):
        image = frame.to_ndarray(format="rgb24")
    else:
        image = frame.to_ndarray(format="rgb24", width=width, height=height, interpolation="BICUBIC")
    turns, mirrored = _turn(frame)
    image = np.rot90(image, turns)
    return np.ascontiguousarray(image[:, ::-1] if mirrored else image)


def _turn(frame: Any) -> tuple[int, bool]:
    """Counter-clockwise quarter turns of a stored frame, and whether it is mirrored left to right afterwards."""
    from av.sidedata.sidedata import Type

    stored = frame.side_data.get(Type.DISPLAYMATRIX)
    if stored is None:
        return 0, False
    # The matrix maps x and y of the stored frame, y down, to a x + c y and b x + d y.
    a, b, _, c, d = np.frombuffer(bytes(stored), np.int32)[:5].astype(float)
    mirrored = a * d - b * c < 0
    return round(np.arctan2(-b, -a if mirrored else a) / (np.pi / 2)) % 4, bool(mirrored)


def _decoded(container: Any, errors: list[Exception] | None = None) -> Iterator[Any]:
    """Frames of the first video stream without those that cannot be decoded, whose `errors` are collected.

    A file that breaks off ends the iteration.
    """
    from av.error import FFmpegError

    errors = [] if errors is None else errors
    packets = container.demux(container.streams.video[0])
    while True:
        try:
            packet = next(packets, None)
        except (FFmpegError, EOFError) as error:
            errors.append(error)
            return
        if packet is None:
            return
        try:
            frames = packet.decode()
        except (FFmpegError, EOFError) as error:
            errors.append(error)
            continue
        yield from frames


@contextmanager
def _opened(path: Path) -> Generator[Any]:
    import av
    from av.error import ArgumentError, FFmpegError

    options = {"format_whitelist": _CONTAINERS, "protocol_whitelist": "file"}
    try:
        # With the protocol in front no part of the name is taken for one.
        container = av.open(f"file:{path}", options=options)
    except (FFmpegError, OSError, ValueError) as error:
        known = isinstance(error, ArgumentError)
        reason = f"it is none of {VIDEO_KINDS}" if known else getattr(error, "strerror", None) or error
        raise UserError(f"{path}: not a readable video ({reason}). Convert it, or give a folder of photos.") from None
    with container:
        if not container.streams.video:
            raise UserError(f"{path}: holds no video stream. Give a video, or a folder of photos.")
        codec = container.streams.video[0].codec_context
        if codec is None:
            raise UserError(f"{path}: its codec is not known. Convert it, or give a folder of photos.")
        if codec.width * codec.height > MAX_PIXELS:
            raise UserError(
                f"{path}: frames of {codec.width} x {codec.height} pixels are more than the limit of "
                f"{MAX_PIXELS // 1_000_000} megapixels. Convert it."
            )
        # A frame may have another size than the file says at its beginning.
        codec.options = {"max_pixels": str(MAX_PIXELS)}
        aspect = _pixel_aspect(container)
        if not 1 / _EXTREME_ASPECT <= aspect <= _EXTREME_ASPECT:
            raise UserError(f"{path}: its pixels are {aspect:.3g} times as wide as high by its header. Convert it.")
        yield container
