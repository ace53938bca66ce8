"""What SOURCE may be: a folder of photos, a glob, photo files, a video, or `demo`."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from glob import has_magic
from pathlib import Path
from typing import TYPE_CHECKING

from freegeo.errors import UserError

if TYPE_CHECKING:
    from freegeo.cli.options import PhotoOptions
    from freegeo.data.scene import Scene
    from freegeo.types import PhotoLike

DEMO = "demo"
DEMO_DOMAIN = "big"
DEMO_FRAMES = 16


def load_source(sources: Sequence[str], photos: PhotoOptions, *, doubt: bool = True) -> list[PhotoLike]:
    """Return the photos of one scene: several files are one scene, in the order given.

    `doubt`: warn of photos that are almost black, white or of one colour.
    """
    from freegeo.data.photos import all_of, doubt_blank

    require_sources(sources)
    if list(sources) == [DEMO]:
        return list(demo_scene(0, DEMO_DOMAIN).photos)[: photos.max_views]
    if len(sources) > 1:
        _refuse_several_scenes(sources)
    source = sources[0] if len(sources) == 1 else list(sources)
    found = all_of(source, photos.max_views, fps=photos.fps, skip_bad=photos.skip_bad)
    if doubt:
        doubt_blank(found)
    return found


def _refuse_several_scenes(sources: Sequence[str]) -> None:
    """Raise UserError when photos of a scene are given together with folders, patterns or videos."""
    scenes = [source for source in sources if not _is_photo_file(source)]
    if not scenes:
        return
    if len(scenes) < len(sources):
        raise UserError(
            f"{scenes[0]} is given together with photo files. Give photo files, or one folder, pattern or video."
        )
    raise UserError(
        f"{len(scenes)} folders, patterns or videos are given, and each is a scene of its own. Give one of them, "
        f"or make one adapter for all with `freegeo adapt {shlex.join(scenes)} -o ADAPTER`."
    )


def _is_photo_file(source: str) -> bool:
    from freegeo.data.video import is_video

    path = Path(source).expanduser()
    return not path.is_dir() and not is_video(source) and (path.is_file() or not has_magic(source)) and source != DEMO


def require_sources(sources: Sequence[str]) -> None:
    """Raise UserError when a command line names no source, or one twice."""
    if not any(sources):
        raise UserError("no source given: name a folder of photos, a glob in quotes, photo files, a video, or `demo`.")
    if len(set(sources)) < len(sources):
        twice = next(source for source in sources if sources.count(source) > 1)
        raise UserError(f"{twice} is given twice. Name each source once.")


def demo_scene(room: int, domain: str) -> Scene:
    """Photograph a generated room of a test domain."""
    from freegeo.data.procedural import get_domain, photograph_room

    seed = next(iter(get_domain(domain).seeds(1, start=room)))
    return photograph_room(seed, domain, frames=DEMO_FRAMES)


def split_scenes(sources: Sequence[str]) -> list[list[str]]:
    """Tell scenes apart: photo files together are one scene, every folder, pattern or video is one of its own.

    A pattern that fits folders or videos, and nothing else, stands for these.
    """
    require_sources(sources)
    named = [name for source in sources for name in _scenes_of_pattern(source) or [source]]
    files = [source for source in named if _is_photo_file(source)]
    scenes = [[source] for source in named if source not in files]
    return [files, *scenes] if files else scenes


def _scenes_of_pattern(source: str) -> list[str]:
    """Return the folders and videos that a pattern fits; nothing when it fits anything else."""
    from freegeo.data.photos import matching
    from freegeo.data.video import is_video

    if not has_magic(source) or Path(source).expanduser().exists():
        return []
    matches = matching(source)
    return [str(match) for match in matches] if all(match.is_dir() or is_video(match) for match in matches) else []
