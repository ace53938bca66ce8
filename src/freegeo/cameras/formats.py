"""The formats of camera files, and which of them a file is."""

from __future__ import annotations

from pathlib import Path

from freegeo.cameras import colmap, nerfstudio, plain, trajectories
from freegeo.cameras.base import Format, read_json_object, read_text
from freegeo.errors import UserError

__all__ = ["FORMATS", "choose_format"]

FORMATS: dict[str, Format] = {
    format.name: format
    for format in (
        plain.FORMAT, colmap.FORMAT, nerfstudio.FORMAT, trajectories.TUM, trajectories.KITTI, trajectories.POSES,
    )
}  # fmt: skip
"""By name, in the order in which a file is tried."""


def choose_format(path: Path, name: str | None = None) -> tuple[Format, Path]:
    """Return the format of a file or folder, and the file or folder that its reader takes.

    Args:
        path: what the user named.
        name: of a format; None: the one whose content it has.

    Raises:
        UserError: nothing is there, no format fits, or the folder fits several.
    """
    if name is not None and name not in FORMATS:
        raise UserError(f"{name}: no format of cameras. Choose one of {', '.join(FORMATS)}.")
    if not path.exists():
        raise UserError(f"{path}: no such file or folder of cameras.")
    if name is not None:
        return FORMATS[name], FORMATS[name].find(path) or path
    found = [(format, place) for format in FORMATS.values() if (place := format.find(path)) is not None]
    if len(found) == 1:
        return found[0]
    if found:
        kinds = ", ".join(f"{place} ({format.name})" for format, place in found)
        raise UserError(f"{path}: holds cameras of several kinds, {kinds}. Name one of them.")
    if path.is_file():
        # A broken file says more about itself than that it is of no format.
        read_json_object(path) if path.suffix.lower() == ".json" else read_text(path)
    kinds = "; ".join(f"{format.name}: {format.about}" for format in FORMATS.values())
    raise UserError(f"{path}: holds no cameras of a known format ({kinds}).")
