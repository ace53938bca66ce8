"""Many scenes: what a command line and a list file name, a name for each, and a look at each before any is computed."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from freegeo.cli.sources import DEMO, split_scenes
from freegeo.errors import UserError
from freegeo.files import fitted

if TYPE_CHECKING:
    from freegeo.cli.options import PhotoOptions

LOG = ".log"
INDEX_NAME, RECORD_NAME = "index.html", "batch.json"
_OWN = {INDEX_NAME, RECORD_NAME}
_ODD = re.compile(r"[^\w.,+@() -]")
"""What no name of a scene has: some file systems refuse it, or it means something in a path."""


@dataclass(frozen=True, kw_only=True)
class NamedScene:
    """A scene, and the name of its folder and its log."""

    name: str
    sources: tuple[str, ...]
    """As `freegeo run` takes them, with absolute paths."""

    def __str__(self) -> str:
        """Return the name."""
        return self.name


@dataclass(frozen=True, kw_only=True)
class _Listed:
    """A source as somebody wrote it down."""

    source: str
    name: str | None = None
    place: str = ""
    """Where it was written down, with a colon; empty for the command line."""


def named_scenes(sources: Sequence[str], list_file: Path | None) -> list[NamedScene]:
    """Return the scenes of a command line and of a list file, each with a name of its own.

    A scene without a name is called like its folder or file; where several would be called the same, the folders above
    are put before. UserError for a scene that is named twice, and for two scenes that cannot be told apart.
    """
    scenes: list[tuple[str | None, list[str]]] = []
    if any(sources):
        scenes = [(None, [_absolute(part, Path.cwd()) for part in scene]) for scene in split_scenes(sources)]
    for listed in [] if list_file is None else _read_list(list_file):
        scenes += _scenes_of(listed)
    if not scenes:
        raise UserError("no scene given: name folders of photos, patterns in quotes, videos, or a list (--list FILE).")
    counts = Counter(tuple(parts) for _, parts in scenes)
    if twice := next((parts for parts, count in counts.items() if count > 1), None):
        raise UserError(f"{twice[0]} is given twice. Name each scene once.")
    given = [name for name, _ in scenes if name is not None]
    derived = iter(_derived([parts for name, parts in scenes if name is None], given))
    named = [NamedScene(name=name or next(derived), sources=tuple(parts)) for name, parts in scenes]
    places: dict[str, NamedScene] = {}
    for scene in named:
        # File systems of other machines may not tell capital letters from small ones.
        other = places.setdefault(scene.name.casefold(), scene)
        if other is not scene:
            raise UserError(
                f"{other.sources[0]} and {scene.sources[0]} would both be called '{scene.name}'. Name them in a list "
                "file (--list), as in: name = path"
            )
    return named


def _read_list(path: Path) -> list[_Listed]:
    """Read a list of scenes: a line each, `path` or `name = path` (or a tab between them); `#` begins a comment."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise UserError(f"--list {path}: {error.strerror}. Check the name.") from None
    except UnicodeDecodeError:
        raise UserError(f"--list {path}: is no text in UTF-8. Write a scene per line.") from None
    found = []
    for number, line in enumerate(lines, start=1):
        place = f"{path}, line {number}: "
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        name, between, source = line.partition("\t" if "\t" in line.strip() else " = ")
        if not between:
            name, source = "", line
        elif not (name := name.strip()) or not source.strip():
            raise UserError(f"{place}a name or a path is missing. Write: name = path")
        elif name != _clean(name):
            raise UserError(f"{place}'{name}' cannot be the name of a folder here. Choose another, such as scene-1.")
        found.append(_Listed(source=_absolute(source.strip(), path.absolute().parent), name=name or None, place=place))
    if not found:
        raise UserError(f"--list {path}: names no scene. Write a scene per line.")
    return found


def _scenes_of(listed: _Listed) -> list[tuple[str | None, list[str]]]:
    """Return the scenes that a line of a list names: several where it is a pattern of folders."""
    scenes = split_scenes([listed.source])
    if listed.name is not None and len(scenes) > 1:
        raise UserError(f"{listed.place}the pattern fits {len(scenes)} scenes, which cannot all be '{listed.name}'.")
    return [(listed.name, scene) for scene in scenes]


def _absolute(source: str, base: Path) -> str:
    return source if source == DEMO else str(base / Path(source).expanduser())


def _derived(scenes: Sequence[Sequence[str]], given: Sequence[str]) -> list[str]:
    """Return names made of the last parts of the scenes' paths: as few as tell them apart, and from names given."""
    parts = [_name_parts(scene) for scene in scenes]
    used = [1] * len(parts)
    while True:
        names = [_clean("-".join(part[-count:])) for part, count in zip(parts, used, strict=True)]
        counts = Counter(name.casefold() for name in [*names, *given])
        more = [
            k for k, name in enumerate(names) if counts[name.casefold()] > 1 and used[k] < len(parts[k])
        ]  # fmt: skip
        if not more:
            return names
        for k in more:
            used[k] += 1


def _name_parts(sources: Sequence[str]) -> list[str]:
    """Return what of a scene's path can be a name, from the top: photo files are called like their folder."""
    path = Path(sources[0])
    if len(sources) > 1:
        path = path.parent
    elif not path.is_dir():
        path = path.with_suffix("")
    parts = [text for part in path.parts if (text := _ODD.sub("-", part).strip(" .-_"))]
    return parts or ["scene"]


def _clean(name: str) -> str:
    """Return a name as it can be that of a folder, with a log beside it, on every file system."""
    name = fitted(_ODD.sub("-", name).strip(" .") + LOG).removesuffix(LOG) or "scene"
    return f"{name}-scene" if name.casefold() in _OWN or name.casefold().endswith(LOG) else name


def look_at(scene: NamedScene, photos: PhotoOptions, *, adapting: bool) -> list[Path]:
    """Return the files of a scene, of which only the beginnings are read; none for the demo.

    UserError when there are none, or too few to adapt to, or one is no photo.
    """
    from freegeo.data.photos import find_photos, open_photos
    from freegeo.pipeline import require_enough_photos

    if scene.sources == (DEMO,):
        return []
    if is_video_scene(scene):
        return [Path(scene.sources[0])]
    found = find_photos(scene.sources[0] if len(scene.sources) == 1 else list(scene.sources))
    files = [file for file in found if isinstance(file, Path)]
    if not photos.skip_bad:
        opened = open_photos(files)
        if adapting:
            try:
                require_enough_photos(opened[: photos.max_views])
            except UserError as error:
                raise UserError(f"{scene.sources[0]}: {error}") from None
    return files


def is_video_scene(scene: NamedScene) -> bool:
    """Whether a scene is a video; UserError when it has a video's name and is not there."""
    from freegeo.data.video import is_video

    path = Path(scene.sources[0])
    if len(scene.sources) > 1 or path.is_dir() or not is_video(path):
        return False
    if not path.is_file():
        raise UserError(f"{path}: no such video. Check the name.")
    return True
