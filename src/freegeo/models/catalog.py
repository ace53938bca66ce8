"""Every model by name: how it is built, where its weights come from, and under which licence."""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from freegeo.errors import FreeGeoError, UserError
from freegeo.models.spec import LoadedFrom, ModelEntry

if TYPE_CHECKING:
    from freegeo.models.api import ReconstructionModel

logger = logging.getLogger(__name__)

FAMILIES = (
    "freegeo.models.da3_config",
    "freegeo.models.vggt_config",
)
"""Modules, free of torch, that list their models in `ENTRIES`; a new backbone of the package is named here."""
DEFAULT_MODEL = "da3-base"
EMBEDDED_MODEL = "freegeo-tiny"
PLUGIN_GROUP = "freegeo.models"
REACHABLE_WITHIN_S = 5.0


def names() -> list[str]:
    """Return all model names: our own, then those of installed plug-ins."""
    own = list(_own_entries())
    return own + sorted(set(_plugin_points()) - set(own))


def entry(name: str) -> ModelEntry:
    """Look a model up, ours before a plug-in's; UserError lists the names that exist."""
    own = _own_entries()
    if name in own:
        return own[name]
    points = _plugin_points()
    if name in points:
        item = points[name].load()
        if not isinstance(item, ModelEntry):
            raise FreeGeoError(f"the plug-in '{name}' ({points[name].value}) is no ModelEntry. Tell its author.")
        return item
    raise UserError(f"unknown model '{name}'. Known are {', '.join(names())}.")


def build_empty(name: str) -> ReconstructionModel:
    """Build a model on the meta device: shapes and counts, no memory."""
    from freegeo.models.checkpoints import build_on_meta

    return build_on_meta(_buildable(name))


def load_model(name: str = DEFAULT_MODEL, *, checkpoint: str | Path | None = None) -> ReconstructionModel:
    """Load a frozen model on the CPU, from a local file or folder, the package, or the model hub.

    The weights' licence is logged and stored in `model.loaded_from`. UserError when the name is unknown, the file
    does not fit, or the download is not possible.
    """
    from freegeo.models import checkpoints

    item = entry(name)
    build = _buildable(name)
    path = weights_file(name, checkpoint)
    model = checkpoints.build_on_meta(build)
    checkpoints.load_weights(model, path, item.keys, name)
    model.eval()
    model.loaded_from = LoadedFrom(
        model=name, file=path.name, fingerprint=checkpoints.fingerprint(path), licence=item.licence
    )
    logger.info("%s loaded from %s; licence of the weights: %s", name, path, item.licence)
    return model


def weights_file(name: str, checkpoint: str | Path | None = None) -> Path:
    """Return the file of a model's weights: the local one given, the package's, or the hub's, which is downloaded."""
    from freegeo.models import checkpoints

    item = entry(name)
    return checkpoints.find_file(Path(checkpoint)) if checkpoint else _packaged_or_downloaded(item)


def download(name: str) -> Path:
    """Fetch a model's checkpoint from the hub (resumable) and return its path."""
    item = entry(name)
    if item.packaged_weights is not None:
        return item.packaged_weights
    if item.hub_id is None:
        raise UserError(f"{name} has no download; give its weights with --checkpoint.")
    import huggingface_hub
    from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError

    cached = huggingface_hub.try_to_load_from_cache(item.hub_id, item.hub_file)
    if isinstance(cached, str):
        return Path(cached)
    try:
        _require_reachable(huggingface_hub.hf_hub_url(item.hub_id, item.hub_file))
        return Path(huggingface_hub.hf_hub_download(item.hub_id, item.hub_file))
    except (LocalEntryNotFoundError, HfHubHTTPError, OSError, _http_error()) as error:
        logger.debug("download of %s failed: %s", item.hub_id, error)
        raise UserError(
            f"the checkpoint of {name} ({item.hub_id}, {item.download_gb:.1f} GB) is not on this machine and could not "
            f"be downloaded. {_how_to_download(item)}, pass --checkpoint FILE, or use the embedded model: "
            f"--model {EMBEDDED_MODEL}."
        ) from None


def _require_reachable(url: str) -> None:
    """Request a file's headers once, without the hub library's retries, which take half a minute when offline."""
    import huggingface_hub

    hub_logger = logging.getLogger("huggingface_hub")
    level = hub_logger.level
    hub_logger.setLevel(logging.CRITICAL)
    try:
        huggingface_hub.get_hf_file_metadata(url, timeout=REACHABLE_WITHIN_S)
    finally:
        hub_logger.setLevel(level)


def _http_error() -> type[Exception]:
    """Return the base of the network errors of the hub library's client: httpx or httpx2, by its version."""
    import huggingface_hub

    client = type(huggingface_hub.get_session()).__module__.partition(".")[0]
    return importlib.import_module(client).HTTPError


def _how_to_download(item: ModelEntry) -> str:
    command = f"`freegeo models download {item.name}`"
    if not item.gated:
        return f"Go online and run {command}"
    return f"Accept its licence at https://huggingface.co/{item.hub_id}, log in with `hf auth login` and run {command}"


def _packaged_or_downloaded(item: ModelEntry) -> Path:
    if item.packaged_weights is None:
        return download(item.name)
    if not item.packaged_weights.is_file():
        raise FreeGeoError(f"{item.packaged_weights}: the weights of {item.name} are missing. Reinstall the package.")
    return item.packaged_weights


def _buildable(name: str) -> Callable[[], ReconstructionModel]:
    item = entry(name)
    if item.build is None:
        raise UserError(f"{name} is listed but not implemented yet: {item.about}")
    return item.build


def _own_entries() -> dict[str, ModelEntry]:
    return {item.name: item for module in FAMILIES for item in importlib.import_module(module).ENTRIES}


def _plugin_points() -> dict:
    from importlib.metadata import entry_points

    return {point.name: point for point in entry_points(group=PLUGIN_GROUP)}
