"""Files of the model hub: kept in its cache, checked before they are used, and a reason when one cannot be fetched."""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import re
import ssl
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from freegeo.errors import UserError
from freegeo.models.catalog import EMBEDDED_MODEL
from freegeo.models.spec import ModelEntry

if TYPE_CHECKING:
    from huggingface_hub import HfFileMetadata

logger = logging.getLogger(__name__)

REACHABLE_WITHIN_S = 5.0
_PROXIES = ("HTTPS_PROXY", "HTTP_PROXY", "ALL_PROXY")
_PASSWORD = re.compile(r"(^|//)[^/]*@")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_INSTEAD = f"pass --checkpoint FILE, or use the embedded model: --model {EMBEDDED_MODEL}."


@dataclass(frozen=True, kw_only=True)
class HubFile:
    """A file of a repository of the hub, described as far as explaining a failed download takes."""

    repository: str
    """Its id, such as `depth-anything/DA3-BASE`."""
    name: str
    page: str
    """Address of the repository's page, where its licence is accepted."""
    folder: str
    """Where it is downloaded to."""
    elsewhere: str
    """How another folder is chosen, without its name: `set HF_HOME to`."""
    gated: bool = False
    """The hub hands it out only to accounts that accepted its licence."""


def fetch(item: ModelEntry, *, check_hash: bool = False) -> Path:
    """Return the path of a model's checkpoint in the cache of the hub; it is downloaded where it is missing or damaged.

    A file is used after its SHA-256 was compared with the one of the catalog, or where that names none, with the one
    of the first download. It is compared again when the file is newer than the note of that, and with `check_hash`;
    otherwise its length is. UserError with the reason when the file cannot be downloaded or is not the right one.
    """
    import huggingface_hub

    assert item.hub_id is not None
    kept = _kept(item)
    revision, expected = item.revision, item.sha256
    if first := kept or _gone(item):
        # What was downloaded first counts, not what the hub calls its newest today.
        revision, expected = revision or _revision(first, item), expected or _known_digest(first)
    if kept is not None:
        if is_verified(kept, expected, check_hash=check_hash):
            return kept
        logger.info("%s: truncated or damaged; it is downloaded again.", kept)
    try:
        url = huggingface_hub.hf_hub_url(item.hub_id, item.hub_file, revision=revision)
        announced = digest_of(published(url).etag)
        if expected is not None and announced not in (None, expected):
            raise _another_file(item, announced, expected)
        if kept is not None and not kept.is_symlink():
            kept.unlink()  # a cache without links would keep it in the place of the new file
        path = Path(
            huggingface_hub.hf_hub_download(
                item.hub_id, item.hub_file, revision=revision, force_download=kept is not None
            )
        )
    except UserError:
        raise
    # The client raises errors of several libraries, by its version and the proxy; none of them is ours.
    except Exception as error:
        logger.debug("download of %s failed: %r", item.hub_id, error)
        reason, remedy = why(error, _described(item))
        missing = "is not on this machine" if kept is None else f"is damaged ({kept})"
        size = f"{item.download_bytes / 1e9:.1f} GB"
        raise UserError(
            f"the checkpoint of {item.name} ({item.hub_id}, {size}) {missing} and could not be downloaded: {reason}. "
            f"{remedy} and run `freegeo models download {item.name}`, {_INSTEAD}"
        ) from None
    if is_verified(path, expected or announced, check_hash=True):
        return path
    found = sha256_of(path)
    path.resolve().unlink()
    path.unlink(missing_ok=True)
    if announced is None and expected is not None:
        raise _another_file(item, found, expected)
    raise UserError(
        f"{path}: the download differs from what {endpoint()} announced; something on the way damages it. Run "
        f"`freegeo models download {item.name}` on another network, {_INSTEAD}"
    )


def local_file(item: ModelEntry) -> tuple[str, str] | None:
    """Return the revision and the SHA-256 of a model's file in the cache of the hub; None without one."""
    kept = _kept(item)
    return None if kept is None else (_revision(kept, item), sha256_of(kept))


def cache_folder() -> Path:
    """Return the folder of the hub's cache."""
    from huggingface_hub import constants

    return Path(constants.HF_HUB_CACHE)


def cached_file(item: ModelEntry) -> tuple[Path, int, bool] | None:
    """Return path and size of a model's file in the cache, and whether it is complete; None when nothing is there.

    Of a download that was interrupted, what has arrived so far.
    """
    kept = _kept(item)
    if kept is not None and kept.is_file():
        return kept, kept.stat().st_size, _has_its_length(kept)
    begun = [part for part in _folder(item).glob("blobs/*.incomplete") if part.stat().st_size]
    newest = max(begun, key=lambda part: part.stat().st_mtime_ns, default=None)
    return None if newest is None else (newest, newest.stat().st_size, False)


def is_verified(path: Path, expected: str | None, *, check_hash: bool) -> bool:
    """Whether a checkpoint is as long as it says and has the SHA-256 that is expected, or any where none is known.

    The SHA-256 is kept in a note beside the file; the file is read again when it is newer than the note.
    """
    note = _note(path)
    fresh = note.is_file() and note.stat().st_mtime_ns >= max(1, path.stat().st_mtime_ns)
    if fresh and not check_hash and noted_digest(path) == (expected or noted_digest(path)):
        return _has_its_length(path)
    if _has_its_length(path) and (digest := sha256_of(path)) == (expected or digest):
        _write_note(note, digest, path)
        return True
    if note.is_file():
        os.utime(note, (0, 0))  # it still says what the file should be, and never again that this file was compared
    return False


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's content, as `sha256sum` prints it."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _has_its_length(path: Path) -> bool:
    """Whether a checkpoint is as long as it says."""
    from freegeo.models.checkpoints import read_header

    if path.suffix == ".safetensors":
        try:
            read_header(path)
        except UserError:
            return False
        return True
    with path.open("rb") as file:
        start = file.read(4)
    return bool(start) and (start != b"PK\3\4" or zipfile.is_zipfile(path))


def _kept(item: ModelEntry) -> Path | None:
    """Return a model's file in the cache of the hub, of the revision that the catalog names."""
    import huggingface_hub

    assert item.hub_id is not None
    cached = huggingface_hub.try_to_load_from_cache(item.hub_id, item.hub_file, revision=item.revision)
    return Path(cached) if isinstance(cached, str) else None


def _gone(item: ModelEntry) -> Path | None:
    """Return where a model's file was that is no longer in the cache, by the newest note that is left."""
    notes = _folder(item).glob(f"snapshots/{item.revision or '*'}/{item.hub_file}.sha256")
    newest = max(notes, key=lambda note: note.stat().st_mtime_ns, default=None)
    return None if newest is None else newest.with_suffix("")


def _folder(item: ModelEntry) -> Path:
    """Return the folder of a model's repository in the cache of the hub."""
    return Path(cache_folder(), f"models--{(item.hub_id or '').replace('/', '--')}")


def _revision(kept: Path, item: ModelEntry) -> str:
    """Return the commit of a file in the cache: the name of the folder that holds the repository's files."""
    return kept.parents[len(Path(item.hub_file).parts) - 1].name


def _known_digest(kept: Path) -> str | None:
    """Return the SHA-256 that a file of the cache had when it was downloaded, by the note or the cache's own name."""
    return noted_digest(kept) or digest_of(kept.resolve().name)


def _note(path: Path) -> Path:
    """Return where the SHA-256 of a file of the cache is kept, in the format of `sha256sum`."""
    return path.with_name(path.name + ".sha256")


def noted_digest(path: Path) -> str | None:
    """Return the SHA-256 that a downloaded file had when it was compared; None without such a note."""
    try:
        return digest_of(_note(path).read_text("utf-8").partition(" ")[0])
    except (OSError, UnicodeError):
        return None


def _write_note(note: Path, digest: str, path: Path) -> None:
    """Write the note whole; a cache that cannot be written to goes without, and its file is read at each use."""
    part = note.with_name(f"{note.name}.{os.getpid()}")
    try:
        part.write_text(f"{digest}  {path.name}\n", "utf-8")
        part.replace(note)
    except OSError as error:
        logger.debug("%s cannot be written: %s", note, error)


def _another_file(item: ModelEntry, found: str, expected: str) -> UserError:
    """Say that the hub's file is not the pinned one, or not the one that was downloaded first."""
    first = "freegeo names" if item.sha256 else "was downloaded first"
    remedy = "Get a newer freegeo" if item.sha256 else f"If you trust the new one, remove {_folder(item)}"
    return UserError(
        f"{endpoint()} has another file for {item.name} than the one that {first} (SHA-256 {found} instead of "
        f"{expected}); it was not used. {remedy} and run `freegeo models download {item.name}`, {_INSTEAD}"
    )


def digest_of(name: str | None) -> str | None:
    """Return a name or entity tag if it is a SHA-256: the hub's tag of a large file, and its name in the cache."""
    return name if name is not None and _SHA256.fullmatch(name) else None


def published(url: str) -> HfFileMetadata:
    """Request a file's headers once, without the hub library's retries, which take half a minute when offline."""
    import huggingface_hub

    hub_logger = logging.getLogger("huggingface_hub")
    level = hub_logger.level
    hub_logger.setLevel(logging.CRITICAL)
    try:
        return huggingface_hub.get_hf_file_metadata(url, timeout=REACHABLE_WITHIN_S)
    finally:
        hub_logger.setLevel(level)


def _described(item: ModelEntry) -> HubFile:
    from huggingface_hub import constants

    return HubFile(
        repository=item.hub_id or "", name=item.hub_file, page=f"https://huggingface.co/{item.hub_id}",
        folder=constants.HF_HUB_CACHE, elsewhere="set HF_HOME to", gated=item.gated,
    )  # fmt: skip


def why(error: BaseException, item: HubFile) -> tuple[str, str]:
    """Return why a download failed, and what to do about it, as the beginning of a sentence that goes on with "and"."""
    from huggingface_hub import errors

    text = (str(error).strip() or type(error).__name__).splitlines()[0][:200].rstrip(".")
    proxies = _settings(*_PROXIES)
    if isinstance(error, errors.LocalEntryNotFoundError) and error.__cause__ is not None:
        return why(error.__cause__, item)
    if isinstance(error, errors.OfflineModeIsEnabled):
        return "HF_HUB_OFFLINE is set, which forbids downloads", "Unset it"
    if isinstance(error, errors.HfHubHTTPError):
        return _refused(error, item)
    if isinstance(error, errors.FileMetadataError):
        return f"{endpoint()} does not answer as a model hub does", "Check HF_ENDPOINT and the proxy"
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
        return f"the disk of {item.folder} is full", f"Make room, or {item.elsewhere} another disk,"
    if isinstance(error, PermissionError):
        place = error.filename or item.folder
        return f"{place} cannot be written to", f"{item.elsewhere[0].upper()}{item.elsewhere[1:]} a folder that can be"
    if "HTTPError" in [kind.__name__ for kind in type(error).__mro__]:  # of httpx or httpx2, by the hub's version
        through = f" through {proxies}" if proxies else ""
        return f"{endpoint()} cannot be reached{through} ({text})", f"Go online{_licence_first(item)}"
    return text, "Remove the cause"


def _refused(error: Exception, item: HubFile) -> tuple[str, str]:
    """Explain an answer of the hub that is an error: a licence, a name, a log-in, or its own trouble."""
    from huggingface_hub.errors import GatedRepoError

    status = getattr(getattr(error, "response", None), "status_code", "an error")
    if isinstance(error, GatedRepoError) or (item.gated and status in (401, 403)):
        return "the hub gives it only to accounts that accepted its licence", _accept_licence(item)
    answer = f"{endpoint()} answered {status} for {item.repository}/{item.name}"
    if status in (401, 403):
        return answer, "Log in with `hf auth login`, or unset HF_TOKEN,"
    if status == 404:
        return answer, "Check HF_ENDPOINT, if it is set,"
    return answer, "Wait"


def _is_about_certificates(error: BaseException, text: str) -> bool:
    # Missing certificate files are reported without their name.
    no_file = isinstance(error, FileNotFoundError | IsADirectoryError) and error.filename is None
    return isinstance(error, ssl.SSLError) or "CERTIFICATE" in text or no_file


def _accept_licence(item: HubFile) -> str:
    return f"Accept it at {item.page}, log in with `hf auth login`"


def _licence_first(item: HubFile) -> str:
    return f", accept its licence at {item.page}, log in with `hf auth login`" * item.gated


def _settings(*names: str) -> str:
    """Return the environment variables among `names` that are set, in either case, without passwords."""
    found = [(name, value) for name, value in sorted(os.environ.items()) if name.upper() in names and value]
    return " and ".join(f"{name}={without_password(value)}" for name, value in found)


def without_password(address: str) -> str:
    """Return an address without the name and password in it."""
    return _PASSWORD.sub(r"\1", address)


def endpoint() -> str:
    """Return the address of the hub."""
    from huggingface_hub import constants

    return constants.ENDPOINT
