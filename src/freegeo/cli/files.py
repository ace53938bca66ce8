"""Options about the files that a command writes and the points that go into them."""

from __future__ import annotations

import hashlib
import logging
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from freegeo.errors import PartialResultError
from freegeo.export.base import DEFAULT_FORMATS, FLAT_FORMATS, DepthSize
from freegeo.export.formats import ALL, FORMATS, check_formats, chosen_formats
from freegeo.fusion.settings import FilterSettings
from freegeo.run_folder import stored_state

if TYPE_CHECKING:
    import numpy as np

    from freegeo.cli.options import OutputOptions
    from freegeo.types import PhotoLike

logger = logging.getLogger(__name__)

Size = tuple[int, int]

DEFAULTS = FilterSettings()


def _digest(masks: Sequence[np.ndarray]) -> str:
    """Return a fingerprint of masks; not zero is wanted."""
    digest = hashlib.sha256()
    for mask in masks:
        digest.update(repr(mask.shape).encode() + (mask != 0).tobytes())
    return digest.hexdigest()[:16]


def _check_formats(hint: object, names: Sequence[str] | None) -> None:
    if names is not None:
        chosen_formats(names)


FORMAT_NAMES = Parameter(
    consume_multiple=True,
    negative="",
    validator=_check_formats,
    help=f"Any of {', '.join(FORMATS)}, with spaces or commas between them; or {ALL}.",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class FilterOptions:
    """Which points are kept."""

    drop_share: float = DEFAULTS.drop_share
    """Least confident share of the pixels to drop, from 0 to below 1."""
    flying: bool = DEFAULTS.flying
    """Drop pixels that hang between surfaces."""
    multi_view: bool = DEFAULTS.multi_view
    """Drop pixels that more views contradict than confirm."""
    min_agreeing: int = DEFAULTS.min_agreeing
    """Other views that must agree with a pixel; more than 0 makes sparse, sure clouds."""
    masks: Path | None = None
    """Folder with an image per photo (IMG_1.png or IMG_1_mask.png for IMG_1.jpg); white is kept, black left out."""

    def settings(self) -> FilterSettings:
        """Return the filter settings."""
        return FilterSettings(
            drop_share=self.drop_share, flying=self.flying, multi_view=self.multi_view, min_agreeing=self.min_agreeing
        )

    def load_masks(
        self, names: Sequence[str], sizes_hw: Sequence[Size], *, model_hw: Size | None = None
    ) -> list[np.ndarray] | None:
        """Read the masks of photos, by name, at the photos' sizes (or at `model_hw`, the model's)."""
        if self.masks is None:
            return None
        from freegeo.data.masks import load_masks

        return load_masks(self.masks, names, sizes_hw, model_hw=model_hw)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class FileOptions:
    """Which files are written besides the predictions."""

    formats: Annotated[tuple[str, ...] | None, FORMAT_NAMES] = None
    """Default: ply glb, or depth for a model without cameras."""
    depth_size: DepthSize | None = None
    """Size of depth files: model, that of the model's images, or photo, interpolated from it along the photos' edges.
    Default: as in the folder of an earlier run, else model."""
    filters: FilterOptions = FilterOptions()

    def filter_settings(self, masks: Sequence[np.ndarray] | None) -> dict[str, object]:
        """Return what the choice of points depends on, for comparison with an existing folder."""
        values = asdict(self.filters)
        del values["masks"]
        return {**values, "masks": None if masks is None else _digest(masks)}

    def size_of_depth(self, output: OutputOptions) -> DepthSize:
        """Return the size asked for, or else that of the depth files in the folder, unless it is overwritten."""
        before = None if output.overwrite else stored_state(output.output)
        return self.depth_size or (before or {"settings": {}})["settings"].get("depth_size", "model")

    def all_formats(self, output: OutputOptions, photos: Sequence[PhotoLike], *, has_cameras: bool) -> list[str]:
        """Return the formats asked for, and those that the folder has already, unless it is overwritten.

        UserError for a format that can never be written for these photos, or by a model without cameras.
        """
        formats = self.formats or (DEFAULT_FORMATS if has_cameras else FLAT_FORMATS)
        asked = check_formats(formats, [photo.name for photo in photos], has_cameras=has_cameras)
        before = None if output.overwrite else stored_state(output.output)
        there = [] if before is None else before["settings"].get("formats", [])
        return chosen_formats([*there, *asked])

    def checked_masks(self, photos: Sequence[PhotoLike]) -> list[np.ndarray] | None:
        """Read the masks of photos, and refuse what cannot be used before anything is computed.

        Warns of masks beside the photos that are not asked for.
        """
        if self.filters.masks is None:
            for folder in unused_masks(photos):
                logger.warning(
                    "%s holds images that are not used; if these are the masks of the photos, add `--masks %s`.",
                    folder, shlex.quote(str(folder)),
                )  # fmt: skip
        return self.filters.load_masks([photo.name for photo in photos], [photo.size_hw for photo in photos])


def unused_masks(photos: Sequence[PhotoLike]) -> list[Path]:
    """Return the folders `masks` beside photos that hold images."""
    from freegeo.data.photos import MASK_FOLDER, folders_with_images
    from freegeo.export.photos import own_file

    files = [file for photo in photos if (file := own_file(photo)) is not None]
    return list(folders_with_images(dict.fromkeys(file.parent / MASK_FOLDER for file in files)))


def require_complete(folder: Path, failed: Mapping[str, str], sequence: Mapping[str, Any] | None = None) -> None:
    """Raise PartialResultError when formats could not be written, or photos are not all in one piece."""
    if failed:
        raise PartialResultError(
            f"{folder}: {', '.join(failed)} not written, everything else is there. The warnings say why."
        )
    if sequence is not None:
        pieces, missing = sequence["pieces"], sequence["frames"] - sum(part["frames"] for part in sequence["pieces"])
        if len(pieces) > 1 or missing:
            raise PartialResultError(
                f"{folder}: {pieces[0]['frames']} of {sequence['frames']} photos are in the result. The warnings say "
                "where the others are, and why."
            )
