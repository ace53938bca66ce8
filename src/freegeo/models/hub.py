"""Files of the model hub: kept in its cache, checked before they are used, and a reason when one cannot be fetched."""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import re
import ssl
import zipfile
from pathlib import Path

from freegeo.errors import UserError
from freegeo.models.catalog import EMBEDDED_MODEL
from freegeo.models.spec import ModelEntry

logger = logging.getLogger(__name__)

REACHABLE_WITHIN_S = 5.0
_PROXIES = ("HTTPS_PROXY", "HTTP_PROXY", "ALL_PROXY")
_PASSWORD = re.compile(r"(^|//)[^/]*@")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_INSTEAD = f"pass --checkpoint FILE, or use the embedded model: --model {EMBEDDED_MODEL}."


def fetch(item: ModelEntry, *, check_hash: bool = False) -> Path:
    """Return the path of a model's checkpoint in the cache of the hub; it is downloaded where it is missing or damaged.

    A file that is there already is checked for its length, with `check_hash` also against its SHA-256, where the cache
    knows that; a download always is. UserError with the reason when the file cannot be downloaded.
    """
    import huggingface_hub

    assert item.hub_id is not None
    cached = huggingface_hub.try_to_load_from_cache(item.hub_id, item.hub_file)
    kept = Path(cached) if isinstance(cached, str) else None
    if kept is not None:
        if is_intact(kept, _digest(kept.resolve().name) if check_hash else None):
            return kept
        logger.info("%s: truncated or damaged; it is downloaded again.", kept)
    try:
        digest = _digest(_published_etag(huggingface_hub.hf_hub_url(item.hub_id, item.hub_file)))
        if kept is not None and not kept.is_symlink():
            kept.unlink()  # a cache without links would keep it in the place of the new file
        path = Path(huggingface_hub.hf_hub_download(item.hub_id, item.hub_file, force_download=kept is not None))
    # The client raises errors of several libraries, by its version and the proxy; none of them is ours.
    except Exception as error:
        logger.debug("download of %s failed: %r", item.hub_id, error)
        reason, remedy = _why(error, item)
        missing = "is not on this machine" if kept is None else f"is damaged ({kept})"
        size = f"{item.download_bytes / 1e9:.1f} GB"
        raise UserError(
            f"the checkpoint of {item.name} ({item.hub_id}, {size}) {missing} and could not be downloaded: {reason}. "
            f"{remedy} and run `freegeo models download {item.name}`, {_INSTEAD}"
        ) from None
    if not is_intact(path, digest):
        raise UserError(
            f"{path}: the download differs from what {_endpoint()} announced; something on the way damages it. Run "
            f"`freegeo models download {item.name}` on another network, {_INSTEAD}"
        )
    return path


def is_intact(path: Path, digest: str | None = None) -> bool:
    """Whether a checkpoint is as long as it says, and has the given SHA-256."""
    from freegeo.models.checkpoints import read_header

    if path.suffix == ".safetensors":
        try:
            read_header(path)
        except UserError:
            return False
    else:
        with path.open("rb") as file:
            start = file.read(4)
        if not start or (start == b"PK\3\4" and not zipfile.is_zipfile(path)):
            return False
    if digest is None:
        return True
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() == digest


def _digest(name: str | None) -> str | None:
    """Return a name or entity tag if it is a SHA-256: the hub's tag of a large file, and its name in the cache."""
    return name if name is not None and _SHA256.fullmatch(name) else None


def _published_etag(url: str) -> str | None:
    """Request a file's headers once, without the hub library's retries, which take half a minute when offline."""
    import huggingface_hub

    hub_logger = logging.getLogger("huggingface_hub")
    level = hub_logger.level
    hub_logger.setLevel(logging.CRITICAL)
    try:
        return huggingface_hub.get_hf_file_metadata(url, timeout=REACHABLE_WITHIN_S).etag
    finally:
        hub_logger.setLevel(level)


def _why(error: BaseException, item: ModelEntry) -> tuple[str, str]:
    """Return why a download failed, and what to do about it."""
    from huggingface_hub import constants, errors

    text = (str(error).strip() or type(error).__name__).splitlines()[0][:200].rstrip(".")
    proxies = _settings(*_PROXIES)
    if isinstance(error, errors.LocalEntryNotFoundError) and error.__cause__ is not None:
        return _why(error.__cause__, item)
    if isinstance(error, errors.OfflineModeIsEnabled):
        return "HF_HUB_OFFLINE is set, which forbids downloads", "Unset it"
    if isinstance(error, errors.HfHubHTTPError):
        return _refused(error, item)
    if isinstance(error, errors.FileMetadataError):
        return f"{_endpoint()} does not answer as a model hub does", "Check HF_ENDPOINT and the proxy"
    if isinstance(error, UnicodeError) or "header value" in text:
        return "the access token holds letters that no token has", "Correct HF_TOKEN, or log in with `hf auth login`,"
    if isinstance(error, ImportError) and "SOCKS" in text:
        return f"{proxies} is a SOCKS proxy, which needs one more package", "Install it with `pip install socksio`"
    if _is_about_certificates(error, text):
        files = _settings("SSL_CERT_FILE", "SSL_CERT_DIR") or "SSL_CERT_FILE, which is not set"
        return f"certificates cannot be read or trusted ({text}; {files})", "Set SSL_CERT_FILE to your certificates"
    if proxies and (isinstance(error, ValueError) or type(error).__name__ == "InvalidURL"):
        return f"the proxy in {proxies} cannot be used ({text})", "Write it as http://HOST:PORT"
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"the disk of {constants.HF_HUB_CACHE} is full", "Make room, or set HF_HOME to another disk,"
    if isinstance(error, PermissionError):
        place = error.filename or constants.HF_HUB_CACHE
        return f"{place} cannot be written to", "Set HF_HOME to a folder that can be"
    if "HTTPError" in [kind.__name__ for kind in type(error).__mro__]:  # of httpx or httpx2, by the hub's version
        through = f" through {proxies}" if proxies else ""
        return f"{_endpoint()} cannot be reached{through} ({text})", f"Go online{_licence_first(item)}"
    return text, "Remove the cause"


def _refused(error: Exception, item: ModelEntry) -> tuple[str, str]:
    """Explain an answer of the hub that is an error: a licence, a name, a log-in, or its own trouble."""
    status = getattr(getattr(error, "response", None), "status_code", "an error")
    if item.gated and status in (401, 403):
        return "the hub gives it only to accounts that accepted its licence", _accept_licence(item)
    answer = f"{_endpoint()} answered {status} for {item.hub_id}/{item.hub_file}"
    if status in (401, 403):
        return answer, "Log in with `hf auth login`, or unset HF_TOKEN,"
    if status == 404:
        return answer, "Check HF_ENDPOINT, if it is set,"
    return answer, "Wait"


def _is_about_certificates(error: BaseException, text: str) -> bool:
    # Missing certificate files are reported without their name.
    no_file = isinstance(error, FileNotFoundError | IsADirectoryError) and error.filename is None
    return isinstance(error, ssl.SSLError) or "CERTIFICATE" in text or no_file


def _accept_licence(item: ModelEntry) -> str:
    return f"Accept it at https://huggingface.co/{item.hub_id}, log in with `hf auth login`"


def _licence_first(item: ModelEntry) -> str:
    return f", accept its licence at https://huggingface.co/{item.hub_id}, log in with `hf auth login`" * item.gated


def _settings(*names: str) -> str:
    """Return the environment variables among `names` that are set, in either case, without passwords."""
    found = [(name, value) for name, value in sorted(os.environ.items()) if name.upper() in names and value]
    return " and ".join(f"{name}={_without_password(value)}" for name, value in found)


def _without_password(address: str) -> str:
    return _PASSWORD.sub(r"\1", address)


def _endpoint() -> str:
    from huggingface_hub import constants

    return constants.ENDPOINT
