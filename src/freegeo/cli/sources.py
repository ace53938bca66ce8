"""What SOURCE may be: a folder of photos, a glob, photo files, a video, or `demo`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from freegeo.errors import UserError

if TYPE_CHECKING:
    from freegeo.cli.options import PhotoOptions
    from freegeo.data.scene import Scene
    from freegeo.types import PhotoLike

DEMO = "demo"
DEMO_DOMAIN = "light"
DEMO_FRAMES = 16


def load_source(sources: Sequence[str], photos: PhotoOptions) -> list[PhotoLike]:
    """Return the photos of one scene: several files are one scene, in the order given."""
    from freegeo.data.photos import load_photos

    require_sources(sources)
    if list(sources) == [DEMO]:
        return list(demo_scene(0, DEMO_DOMAIN).photos)[: photos.max_views]
    return load_photos(sources[0] if len(sources) == 1 else list(sources), photos.max_views, fps=photos.fps)


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
    """Tell scenes apart: photo files together are one scene, every folder, pattern or video is one of its own."""
    from freegeo.data.video import is_video

    require_sources(sources)
    if all(Path(source).expanduser().is_file() and not is_video(source) for source in sources):
        return [list(sources)]
    return [[source] for source in sources]
