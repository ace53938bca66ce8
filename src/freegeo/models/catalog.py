"""Every model by name: how it is built, where its weights come from, and under which licence."""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from freegeo.errors import FreeGeoError, UserError
from freegeo.models.spec import LoadedFrom, ModelEntry, ModelSpec

if TYPE_CHECKING:
    from freegeo.models.api import ReconstructionModel

logger = logging.getLogger(__name__)

FAMILIES = (
    "freegeo.models.da3_config",
    "freegeo.models.vggt_config",
    "freegeo.models.pi3_config",
    "freegeo.models.mapanything_config",
)
"""Modules, free of torch, that list their models in `ENTRIES`; a new backbone of the package is named here."""
DEFAULT_MODEL = "da3-base"
EMBEDDED_MODEL = "freegeo-tiny"
EMBEDDED_CAUTION = (
    f"{EMBEDDED_MODEL} was trained on generated rooms at 96 x 72 pixels, for demonstrations and tests: on real photos "
    f"its cameras are mostly wrong (AUC@30 of 0 to .29); use {DEFAULT_MODEL} or another model of `freegeo models`."
)
"""What the embedded model is not for."""
_SHOWN = 200
"""Most characters of the error of a plug-in that a message shows."""
PLUGIN_GROUP = "freegeo.models"
T = TypeVar("T")


def names() -> list[str]:
    """Return the names of all models that can be used: our own, then those of installed plug-ins."""
    own = _own_entries()
    return [*own, *sorted(set(_plugin_points()) - set(own))]


def entry(name: str) -> ModelEntry:
    """Look a model up by its name or hub id, ours before a plug-in's; UserError lists the names that exist.

    Capitals make no difference, and the address of a page on the hub stands for its id.
    """
    wanted = name.strip().removeprefix("https://huggingface.co/").strip("/").lower()
    for item in _own_entries().values():
        if wanted in (item.name.lower(), (item.hub_id or "").lower()):
            return item
    points = {known.lower(): point for known, point in _plugin_points().items()}
    if wanted in points:
        point = points[wanted]
        try:
            item = point.load()
        except Exception as error:
            raise broken(point.name, error) from error
        if not isinstance(item, ModelEntry):
            raise FreeGeoError(f"the plug-in '{point.name}' ({point.value}) is no ModelEntry. Tell its author.")
        return item
    raise UserError(f"unknown model '{name}'. Known are {', '.join(names())}.")


def broken(name: str, error: Exception) -> Exception:
    """Return the error that says in one sentence that a plug-in does not work; an error of ours comes back as it is."""
    point = None if name in _own_entries() else _plugin_points().get(name)
    if point is None or isinstance(error, FreeGeoError):
        return error
    reason = " ".join(f"{type(error).__name__}: {error}".split())[:_SHOWN]
    return FreeGeoError(
        f"the plug-in '{name}' ({point.value}) does not work ({reason}). Reinstall it, or tell its author."
    )


def for_each(make: Callable[[str], T]) -> list[T]:
    """Return what a function makes of the name of every model; a plug-in that does not work is a warning."""
    found = []
    for name in names():
        try:
            found.append(make(name))
        except Exception as error:
            told = broken(name, error)
            if not isinstance(told, FreeGeoError):
                raise
            logger.warning("%s", told)
    return found


def caution_of(spec: ModelSpec) -> str | None:
    """Return a sentence on what a model is not for, or what its results lack; None for nothing of the kind."""
    return spec.caution or (EMBEDDED_CAUTION if spec.name == EMBEDDED_MODEL else None)


def build_empty(name: str) -> ReconstructionModel:
    """Build a model on the meta device: shapes and counts, no memory."""
    from freegeo.models.checkpoints import build_on_meta

    item = entry(name)
    try:
        return build_on_meta(item.build)
    except Exception as error:
        raise broken(item.name, error) from error


def load_model(name: str = DEFAULT_MODEL, *, checkpoint: str | Path | None = None) -> ReconstructionModel:
    """Load a frozen model on the CPU, from a local file or folder, the package, or the model hub.

    The weights' licence is logged and stored in `model.loaded_from`. UserError when the name is unknown, the file
    does not fit, or the download is not possible.
    """
    from freegeo.models import checkpoints

    item = entry(name)
    path = weights_file(name, checkpoint)
    model = build_empty(name)
    try:
        checkpoints.load_weights(model, path, item.keys, item.name)
    except UserError as error:
        if checkpoint or item.packaged_weights:
            raise
        remedy = f"`freegeo models download {item.name}` checks that file and replaces it if it is damaged."
        raise UserError(f"{error} {remedy}") from None
    model.eval()
    model.loaded_from = origin_of(name, checkpoint)
    logger.info("%s loaded from %s; licence of the weights: %s", item.name, path, item.licence)
    return model


def weights_file(name: str, checkpoint: str | Path | None = None) -> Path:
    """Return the file of a model's weights: the local one given, the package's, or the hub's, which is downloaded."""
    from freegeo.models import checkpoints

    item = entry(name)
    return checkpoints.find_file(Path(checkpoint)) if checkpoint else _packaged_or_downloaded(item)


def origin_of(name: str, checkpoint: str | Path | None = None) -> LoadedFrom:
    """Return where a model's weights come from; the file is looked up, or downloaded, as by `load_model`."""
    from freegeo.models import checkpoints, hub

    item, path = entry(name), weights_file(name, checkpoint)
    known, from_hub = None, checkpoint is None and item.packaged_weights is None
    if from_hub:
        # It was compared, with the catalog or the first download.
        known = hub.noted_digest(path)
    return LoadedFrom(
        model=item.name, file=path.name, fingerprint=checkpoints.fingerprint(path), licence=item.licence,
        sha256={path.name: known} if known else checkpoints.sha256_of_parts(path),
        hub_id=item.hub_id if from_hub else None, revision=hub.revision_of(path, item) if from_hub else None,
    )  # fmt: skip


def download(name: str, *, check_hash: bool = False) -> Path:
    """Fetch a model's checkpoint from the hub and return its path; a damaged one is fetched again.

    A download that was stopped continues where it was.

    `check_hash` reads the whole of a file that is there already; without it, its length is checked.
    """
    item = entry(name)
    if item.packaged_weights is not None:
        return item.packaged_weights
    if item.hub_id is None:
        raise UserError(f"{item.name} has no download; give its weights with --checkpoint.")
    from freegeo.models.hub import fetch

    return fetch(item, check_hash=check_hash)


def _packaged_or_downloaded(item: ModelEntry) -> Path:
    if item.packaged_weights is None:
        return download(item.name)
    if not item.packaged_weights.is_file():
        raise FreeGeoError(f"{item.packaged_weights}: the weights of {item.name} are missing. Reinstall the package.")
    return item.packaged_weights


def _own_entries() -> dict[str, ModelEntry]:
    return {item.name: item for module in FAMILIES for item in importlib.import_module(module).ENTRIES}


def _plugin_points() -> dict:
    from importlib.metadata import entry_points

    return {point.name: point for point in entry_points(group=PLUGIN_GROUP)}
