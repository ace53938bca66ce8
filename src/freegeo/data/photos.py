"""A user's photos: files, a video, or images in memory; in natural order, upright, as 8-bit RGB."""

from __future__ import annotations

import glob
import logging
import os
import re
import shlex
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from freegeo.data.image_files import (
    IMAGE_SUFFIXES,
    KINDS,
    UnreadableImageError,
    deep_values,
    holds_several,
    is_blank,
    is_cut_off,
    is_image,
    opened,
    orientation,
    pillow_limit_off,
    rgb_on_white,
    rgb_pixels,
    scaled,
    size_hw,
    white_value,
)
from freegeo.data.video import is_video, load_video
from freegeo.errors import UserError
from freegeo.files import RUN_FILE

if TYPE_CHECKING:
    from PIL.Image import Image as PillowImage

    from freegeo.types import PhotoLike

    PhotoSource = str | Path | np.ndarray | PillowImage | Iterable[str | Path | np.ndarray | PillowImage | PhotoLike]
    """What `load_photos` takes."""

logger = logging.getLogger(__name__)

MAX_VIEWS = 32
"""Default limit of the photos that are used of a source."""
MASK_FOLDER = "masks"
"""Folder of masks beside photos."""
_SYSTEM_FILES = frozenset({"thumbs.db", "desktop.ini"})
_NAMED = 5
"""Most files that a warning names."""
_READERS = 4
"""Threads that decode photos when they are looked at."""


@dataclass(frozen=True)
class Photo:
    """One photo on disk; pixels are decoded at each `read`."""

    name: str
    path: Path
    size_hw: tuple[int, int]
    """Height and width after EXIF rotation."""
    white: float | None = None
    """Value that is white, of a file with more than 8 bits a channel; None: judged by the file's values."""
    blank: bool = False
    """Whether it is almost black, white or of one colour, as far as that is known."""

    def read(self) -> np.ndarray:
        """Decode to upright RGB (H, W, 3) uint8; transparent pixels become white."""
        with opened(self.path) as image:
            pixels = rgb_pixels(image, self.path, self.white)
        if pixels.shape[:2] != self.size_hw:
            raise UnreadableImageError(
                self.path,
                f"the image is damaged (its header says {self.size_hw[1]} x {self.size_hw[0]} pixels, "
                f"it has {pixels.shape[1]} x {pixels.shape[0]})",
            )
        return pixels


@dataclass(frozen=True, eq=False)
class MemoryPhoto:
    """One photo in memory."""

    name: str
    pixels: np.ndarray
    """(H, W, 3) uint8 RGB, upright."""

    @property
    def size_hw(self) -> tuple[int, int]:
        """Height and width."""
        return self.pixels.shape[0], self.pixels.shape[1]

    @property
    def blank(self) -> bool:
        """Whether it is almost black, white or of one colour."""
        return is_blank(self.pixels)

    def read(self) -> np.ndarray:
        """Return the pixels (H, W, 3) uint8."""
        return self.pixels


def load_photos(
    source: PhotoSource, max_views: int = MAX_VIEWS, *, fps: float | None = None, skip_bad: bool = False
) -> list[PhotoLike]:
    """Find the photos of a source and keep at most `max_views` of them, evenly spaced.

    Each photo is decoded once here, so that all damaged ones are found before anything slow. Photos that are almost
    black, white or of one colour, and files that had to be interpreted, are named in a warning.

    Args:
        source: a folder, a pattern such as `photos/*.jpg` (both in natural name order), a video, a photo, or a list of
            photo files, PIL images and arrays (H, W, 3) uint8. `~` stands for the home folder. Images in memory are
            named after their place in the list: `image-000`, `image-001`, ... A list that this function returned is
            used whole, whatever `max_views` is.
        max_views: most photos to keep; frames of a video are chosen by sharpness and parallax instead of evenly.
        fps: videos only: take a frame this often per second.
        skip_bad: leave out photos that cannot be used, with a warning, instead of refusing all.

    Raises:
        UserError: a file is missing, or photos are unreadable, no photos, or too large, or an image in memory is not
            of the kind above; the message names all of them.
    """
    found = found_photos(source, max_views, fps=fps, skip_bad=skip_bad)
    if not _is_loaded(source):
        doubt_blank(found)
    return found


def found_photos(
    source: PhotoSource, max_views: int, *, fps: float | None = None, skip_bad: bool = False
) -> list[PhotoLike]:
    """Do as `load_photos`, and leave it to the caller to say which photos are blank (`doubt_blank`)."""
    if max_views < 1:
        raise UserError(f"--max-views must be at least 1, got {max_views}.")
    if isinstance(source, str | Path) and (path := _as_video(source)) is not None:
        return list(load_video(path, fps=fps, max_views=max_views))
    if fps is not None:
        raise UserError("--fps is for videos; the source is none.")
    if _is_loaded(source):
        return _named_once(source)
    found = find_photos(source)
    if len(found) > max_views:
        logger.info("%d photos found, %d kept, evenly spaced (--max-views)", len(found), max_views)
        found = [found[i] for i in evenly_spaced(len(found), max_views)]
    files = [item for item in found if isinstance(item, Path)]
    names = dict(zip(files, unique_names(files), strict=True))
    looks = _looked_at(files, len(found), skip_bad=skip_bad)
    photos: list[PhotoLike] = []
    for item in found:
        if not isinstance(item, Path):
            photos.append(item)
        elif item in looks:
            look = looks[item]
            photos.append(Photo(names[item], item, look.size_hw, look.white, look.blank))
    return _named_once(photos)


def all_of(
    source: PhotoSource, max_views: int | None, *, fps: float | None = None, skip_bad: bool = False
) -> list[PhotoLike]:
    """Do as `found_photos`; None keeps all photos, and `MAX_VIEWS` frames of a video without `fps`."""
    if max_views is None:
        a_choice = isinstance(source, str | Path) and is_video(source) and fps is None
        max_views = MAX_VIEWS if a_choice else sys.maxsize
    return found_photos(source, max_views, fps=fps, skip_bad=skip_bad)


def blank_photos(photos: Sequence[PhotoLike]) -> list[str]:
    """Return the names of the photos that are known to be almost black, white or of one colour."""
    return [photo.name for photo in photos if getattr(photo, "blank", False)]


def doubt_blank(photos: Sequence[PhotoLike]) -> None:
    """Warn of photos that are almost black, white or of one colour."""
    if blank := blank_photos(photos):
        logger.warning(
            "%d of %d photos are almost black, white or of one colour: %s. Look whether they are meant to be.",
            len(blank), len(photos), some_of(blank),
        )  # fmt: skip


def open_photos(files: Sequence[Path]) -> list[Photo]:
    """Return photo files as photos, in their order; only the headers are read.

    UserError when one is missing or no image.
    """
    return [Photo(name, path, _header(path)) for name, path in zip(unique_names(files), files, strict=True)]


def _header(path: Path) -> tuple[int, int]:
    with opened(path) as image:
        return size_hw(image, orientation(image))


def _is_loaded(source: PhotoSource) -> TypeGuard[Sequence[PhotoLike]]:
    """Whether a source is what `load_photos` returned."""
    return isinstance(source, list | tuple) and bool(source) and all(map(_is_photo, source))


def _is_photo(item: Any) -> TypeGuard[PhotoLike]:
    return all(hasattr(item, name) for name in ("name", "size_hw", "read"))


def _named_once(photos: Sequence[PhotoLike]) -> list[PhotoLike]:
    """Return the photos; UserError when two have the same name, or one has a name that leads out of a folder."""
    names = [photo.name for photo in photos]
    twice = next((name for i, name in enumerate(names) if name in names[:i]), None)
    if twice is not None:
        raise UserError(f"two photos have the name {twice}. Name each photo once.")
    outside = next((name for name in names if PurePath(name).is_absolute() or ".." in PurePath(name).parts), None)
    if outside is not None:
        raise UserError(f"a photo has the name {outside}. Names become files below a folder: leave out '/' and '..'.")
    return list(photos)


def evenly_spaced(count: int, keep: int) -> list[int]:
    """Return `keep` distinct indices of `range(count)`, first and last included (the first alone for keep = 1)."""
    return [round(i) for i in np.linspace(0, count - 1, min(count, keep))]


def some_of(names: Sequence[str]) -> str:
    """Return names as text, the first few of many."""
    more = len(names) - _NAMED
    return ", ".join(names) if more <= 0 else f"{', '.join(names[:_NAMED])} and {more} more"


def find_photos(source: PhotoSource) -> Sequence[Path | PhotoLike]:
    """List the photos of a source; a list keeps its order, a folder or pattern is sorted naturally."""
    if isinstance(source, str | Path):
        return _found_files(source)
    if _is_pillow(source) or (isinstance(source, np.ndarray) and source.ndim < 4):
        source = [source]
    if not isinstance(source, Iterable):
        raise UserError(
            f"photos are a folder, a pattern, a video, or a list of files or images, not {_kind(source)}. "
            "See freegeo.load_photos."
        )
    listed = [_listed(item, position) for position, item in enumerate(source)]
    return listed or _no_photos("the list of photos", [])


def _found_files(source: str | Path) -> list[Path]:
    if not str(source):
        raise UserError("the name of the photos is empty. Give a folder of photos, a glob or a photo.")
    path = Path(source).expanduser()
    if path.is_dir():
        photos, folders = _photos_among(str(path), _by_name(path.iterdir())), _sub_folders(path)
        if full := _with_photos(folder for folder in folders if folder != path / MASK_FOLDER) if photos else []:
            logger.warning(
                "%s: sub-folders are not searched, and %d hold images: %s. If these are photos of this scene, give all "
                "photos as a list of files or with a pattern such as %s.",
                path, len(full), some_of(full), shlex.quote(f"{path}/**/*.jpg"),
            )  # fmt: skip
        return photos or _no_photos(str(path), folders)
    if path.is_file():
        return [path]
    if glob.has_magic(str(source)):
        matches = matching(source)
        folders = [match for match in matches if match.is_dir()]
        return _photos_among(str(source), matches) or _no_photos(str(source), folders)
    raise UserError(f"{source}: no such folder, file or pattern. Give a folder of photos, a glob or a photo.")


def matching(pattern: str | Path) -> list[Path]:
    """Return what a pattern fits, in natural order; folders that exist are names, whatever brackets they have."""
    path = Path(pattern).expanduser()
    folder = next(parent for parent in path.parents if parent.is_dir())
    found = glob.glob(str(path.relative_to(folder)), root_dir=folder, recursive=True)  # noqa: PTH207 (skips hidden files)
    return _by_name(folder / name for name in found)


def _by_name(paths: Iterable[Path]) -> list[Path]:
    return sorted(paths, key=natural_key)


def _photos_among(where: str, paths: Sequence[Path]) -> list[Path]:
    """Return the photos among files of a folder or pattern; others are left out with a warning, unless all are."""
    # A link whose file is missing is a photo that cannot be read, which the user should know.
    files = [path for path in paths if path.is_file() or path.is_symlink()]
    files = [path for path in files if not path.is_dir() and not _is_hidden(path)]
    photos = [
        path for path in files if path.suffix.lower() in IMAGE_SUFFIXES or (not is_video(path) and is_image(path))
    ]
    taken = set(photos)
    strangers = [path.name for path in files if path not in taken]
    videos = [path for path in files if is_video(path)]
    if not photos and videos:
        raise UserError(
            f"{where}: no photos, but {len(videos)} video{'s' if len(videos) > 1 else ''}. Give one video by its name, "
            f"such as {shlex.quote(str(videos[0]))}."
        )
    if photos and strangers:
        logger.warning(
            "%s: %d of %d files are no photos and are left out: %s.",
            where, len(strangers), len(files), some_of(strangers),
        )  # fmt: skip
    return photos


def _is_hidden(path: Path) -> bool:
    return path.name.startswith(".") or path.name.lower() in _SYSTEM_FILES


def _no_photos(where: str, folders: Sequence[Path]) -> list[Path]:
    """Say what there is instead of photos."""
    full = _with_photos(folders)
    if not full:
        raise UserError(f"{where}: no photos found. Supported are {KINDS}.")
    raise UserError(
        f"{where}: no photos found there, but in {len(full)} folders: {some_of(full)}. Give one of them; `freegeo "
        "adapt` takes several, each as a scene."
    )


def _with_photos(folders: Iterable[Path]) -> list[str]:
    """Return the folders that hold images by their names, each with the number of these."""
    return [f"{folder} ({count})" for folder, count in folders_with_images(folders).items()]


def folders_with_images(folders: Iterable[Path]) -> dict[Path, int]:
    """Return those of some folders that are there and hold files named like images, each with the number of these."""
    counts = {folder: sum(map(_named_image, folder.iterdir())) for folder in folders if folder.is_dir()}
    return {folder: count for folder, count in counts.items() if count}


def _named_image(path: Path) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES and path.is_file() and not _is_hidden(path)


def _sub_folders(folder: Path) -> list[Path]:
    """Return the folders one and two levels below a folder, without results of freegeo."""
    below = [path for path in folder.glob("*") if path.is_dir() and not (path / RUN_FILE).exists()]
    below += [path for parent in below for path in parent.glob("*") if path.is_dir()]
    return _by_name(path for path in below if not _is_hidden(path))


def _as_video(source: str | Path) -> Path | None:
    """Return the video that a source is, also as the one that a pattern fits; None for any other source."""
    path = Path(source).expanduser()
    if not is_video(path) or path.is_dir():
        return None
    if path.exists() or not glob.has_magic(str(source)):
        return path
    matches = [match for match in matching(source) if match.is_file()]
    return matches[0] if len(matches) == 1 else None


def _listed(item: Any, position: int) -> Path | PhotoLike:
    """Return an element of a list of photos as a file or a photo in memory."""
    name = f"image-{position:03d}"
    if isinstance(item, str | Path):
        path = Path(item).expanduser()
        if path.is_dir():
            raise UserError(f"{path}: a folder among several sources. Give one folder alone, or a list of photo files.")
        return path
    if isinstance(item, np.ndarray):
        if item.dtype != np.uint8 or item.ndim != 3 or item.shape[2] != 3 or not item.size:
            raise UserError(
                f"{name} is an array of {item.dtype} and shape {item.shape}; "
                "give arrays of uint8 and shape (height, width, 3), RGB from 0 to 255."
            )
        return MemoryPhoto(name, item.copy())
    if _is_pillow(item):
        return MemoryPhoto(name, rgb_pixels(item, name))
    if _is_photo(item):
        return item
    raise UserError(
        f"element {position} of the photos is {_kind(item)}; give file names, PIL images or uint8 arrays (H, W, 3)."
    )


def _is_pillow(item: Any) -> TypeGuard[PillowImage]:
    from PIL import Image

    return isinstance(item, Image.Image)


def _kind(value: object) -> str:
    return "None" if value is None else f"of the type {type(value).__name__}"


def natural_key(path: Path) -> list[tuple[int, int | str]]:
    """Sort key that puts frame2 before frame10."""
    return [(0, int(part)) if part.isdecimal() else (1, part.lower()) for part in re.split(r"(\d+)", str(path)) if part]


def unique_names(paths: Sequence[Path]) -> list[str]:
    """Return file names, with as many parent folders as needed to make them unique; never absolute, never with `..`.

    UserError when a file is listed twice.
    """
    # Made absolute without following links, whose targets would give names that the user does not know.
    absolute = [Path(os.path.abspath(path)) for path in paths]  # noqa: PTH100
    for depth in range(1, max((len(path.parts) for path in absolute), default=1) + 1):
        names = ["/".join(path.relative_to(path.anchor).parts[-depth:]) for path in absolute]
        if len(set(names)) == len(names):
            return names
    twice = next(str(paths[i]) for i, path in enumerate(absolute) if path in absolute[:i])
    raise UserError(f"{twice} is listed twice. Name each photo once.")


# -- looking at the pixels


@dataclass(frozen=True)
class _Look:
    """What was seen when a photo was decoded for the first time."""

    size_hw: tuple[int, int]
    blank: bool
    several: bool
    """Whether the file holds further pictures."""
    exif_damaged: bool = False
    cut_off: bool = False
    """Whether it ends in plain grey, as a JPEG does whose data are lost."""
    white: float | None = None
    """Value that is white, of a file with more than 8 bits a channel."""
    largest: int | None = None
    """Largest value of a file with 16-bit integers."""


def _looked_at(files: Sequence[Path], count: int, *, skip_bad: bool) -> dict[Path, _Look]:
    """Decode files; UserError names all that cannot be used, of `count` photos, unless they are left out."""
    with pillow_limit_off(), ThreadPoolExecutor(_READERS) as pool:
        results = dict(zip(files, pool.map(_look, files), strict=True))
    looks = {file: result for file, result in results.items() if isinstance(result, _Look)}
    bad = [result for result in results.values() if isinstance(result, UnreadableImageError)]
    if bad and (not skip_bad or len(bad) == count):
        raise _refusal(bad, count)
    if bad:
        logger.warning("%d of %d photos cannot be used and are left out: %s.", len(bad), count, _reasons(bad))
    if several := [file.name for file, look in looks.items() if look.several]:
        logger.warning(
            "only the first picture is used of files that hold several: %s. Save an animation as a video to use all.",
            some_of(several),
        )
    if damaged := [file.name for file, look in looks.items() if look.exif_damaged]:
        logger.warning(
            "damaged EXIF data do not say how these photos are turned: %s. Look whether they are upright.",
            some_of(damaged),
        )
    if cut_off := [file.name for file, look in looks.items() if look.cut_off]:
        logger.warning(
            "these photos end in plain grey, as a JPEG does that was cut off: %s. Look whether they are whole.",
            some_of(cut_off),
        )
    return _with_common_white(looks)


def _look(file: Path) -> _Look | UnreadableImageError:
    if is_video(file):
        return UnreadableImageError(file, "a video among photos, which has to be given alone")
    try:
        with opened(file) as image:
            several = holds_several(image)
            values = deep_values(image, file)
            if values is None:
                turn = orientation(image)
                seen_hw = size_hw(image, turn)
                # At an eighth of its size a JPEG is decoded in a third of the time, and the same damage is found.
                image.draft(None, (max(1, image.width // 8), max(1, image.height // 8)))
                pixels = rgb_pixels(image, file)
                cut_off = is_cut_off(image, pixels, turn or 1)
                return _Look(seen_hw, is_blank(pixels), several, exif_damaged=turn is None, cut_off=cut_off)
        white = white_value(values, file)
    except UnreadableImageError as bad:
        return bad
    height, width = values.shape[:2]
    largest = int(values[..., :3].max()) if values.dtype == np.uint16 else None
    return _Look((height, width), is_blank(rgb_on_white(scaled(values, white))), several, white=white, largest=largest)


def _with_common_white(looks: dict[Path, _Look]) -> dict[Path, _Look]:
    """Choose white for 16-bit files of one kind together, so that a dark photo stays darker than the others."""
    result = dict(looks)
    for depths in ((8,), (10, 12), (14, 16)):
        group = {f: look for f, look in looks.items() if look.largest is not None and look.white == 2 ** depths[-1] - 1}
        if not group:
            continue
        bits = next(bits for bits in depths if max(look.largest or 0 for look in group.values()) < 2**bits)
        result |= {file: replace(look, white=2.0**bits - 1) for file, look in group.items()}
        if bits < 16:
            logger.warning(
                "photos that store %d bits in 16-bit files are brightened accordingly: %s.",
                bits, some_of([file.name for file in group]),
            )  # fmt: skip
    return result


def _refusal(bad: Sequence[UnreadableImageError], count: int) -> UserError:
    if count == 1:
        return bad[0]
    if len(bad) == 1:
        return UserError(f"{bad[0].path}: {bad[0].reason}. Replace it, or leave it out with --skip-bad.")
    hint = "Replace them" if len(bad) == count else "Replace them, or leave them out with --skip-bad"
    return UserError(f"{len(bad)} of {count} photos cannot be used: {_reasons(bad)}. {hint}.")


def _reasons(bad: Sequence[UnreadableImageError]) -> str:
    """Name all bad photos, those with the same reason together."""
    reasons = list(dict.fromkeys(image.reason for image in bad))
    return "; ".join(f"{', '.join(str(i.path) for i in bad if i.reason == reason)}: {reason}" for reason in reasons)
