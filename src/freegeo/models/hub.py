"""Files of the model hub: kept in its cache, checked before they are used, and a reason when one cannot be fetched.

`huggingface_hub` looks after the cache, the log-in, proxies and the network; its own download of a file begins anew
after each stop, so the content is fetched by `download_file`, into the place where the cache expects it.
"""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import re
import shutil
import ssl
import threading
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from freegeo.errors import UserError
from freegeo.host import gigabytes
from freegeo.models.catalog import EMBEDDED_MODEL
from freegeo.models.spec import ModelEntry

if TYPE_CHECKING:
    from huggingface_hub import HfFileMetadata

logger = logging.getLogger(__name__)

REACHABLE_WITHIN_S = 5.0
_PROXIES = ("HTTPS_PROXY", "HTTP_PROXY", "ALL_PROXY")
_PASSWORD = re.compile(r"(^|//)[^/]*@")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_FILE_NAME = re.compile(r"\w[\w.+=-]*")
_quiet = threading.Lock()
"""Held while the hub library's logger is silent, so that no thread takes that for its usual level."""
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
    kept, path, digest = _kept(item), None, None
    revision, expected = item.revision, item.sha256
    if first := kept or _gone(item):
        # What was downloaded first counts, not what the hub calls its newest today.
        revision, expected = revision or revision_of(first, item), expected or _known_digest(first)
    if kept is not None:
        if is_verified(kept, expected, check_hash=check_hash):
            return kept
        logger.info("%s: truncated or damaged; it is downloaded again.", kept)
    try:
        announced = published(huggingface_hub.hf_hub_url(item.hub_id, item.hub_file, revision=revision))
        digest = digest_of(announced.etag)
        if expected is not None and digest not in (None, expected):
            raise _another_file(item, digest, expected)
        place = _place(item, announced)
        found = download_file(
            huggingface_hub.hf_hub_url(item.hub_id, item.hub_file, revision=announced.commit_hash), place,
            part=part_file(_folder(item) / "blobs", Path(item.hub_file).name, announced.etag), size=announced.size,
            digest=expected or digest, lock=_lock(item, announced),
        )  # fmt: skip
        if found == (expected or digest or found):
            if kept is not None and kept.resolve() != place.resolve():
                kept.unlink()  # it would keep the place of the new file
            # The content is there, so this only adds what the cache notes of a file: its revision, and a link.
            path = Path(huggingface_hub.hf_hub_download(item.hub_id, item.hub_file, revision=revision))
            if not path.samefile(place):
                raise RuntimeError("another version was published meanwhile")
    except UserError:
        raise
    # The client raises errors of several libraries, by its version and the proxy; none of them is ours.
    except Exception as error:
        logger.debug("download of %s failed: %r", item.hub_id, error)
        reason, remedy = why(error, _described(item))
        missing = "is not on this machine" if kept is None else f"is damaged ({kept})"
        size = gigabytes(item.download_bytes)
        raise UserError(
            f"the checkpoint of {item.name} ({item.hub_id}, {size}) {missing} and could not be downloaded: {reason}. "
            f"{remedy} and run `freegeo models download {item.name}`, {_INSTEAD}"
        ) from None
    if path is not None:
        if note_digest(path, found):
            return path
        path.resolve().unlink()
        path.unlink(missing_ok=True)
    elif digest is None and expected is not None:
        raise _another_file(item, found, expected)
    raise UserError(
        f"{item.hub_file} of {item.name}: the download differs from what {endpoint()} announced; something on the way "
        "damages it, and it was not kept. Run "
        f"`freegeo models download {item.name}` on another network, {_INSTEAD}"
    )


def download_file(url: str, target: Path, *, part: Path, size: int | None, digest: str | None, lock: Path) -> str:
    """Fetch a file of the hub, or what is missing of it, compare it, and put it in its place; returns its SHA-256.

    What a stop left in `part` is continued. Only with `size` and `digest`, though: without them nothing tells that the
    whole is right, and it begins anew. A continued file with another SHA-256 is fetched once more from its beginning.
    When several processes want the file, one fetches it, and the others wait for it.

    Args:
        url: address at the hub, of one commit.
        target: where the file appears if it has the SHA-256 `digest`, or any where that is None. Otherwise nothing
            changes there, and the part is removed.
        part: by `part_file`. The parts of other versions beside it are removed.
        size: bytes that the hub announced.
        digest: SHA-256 that the file must have.
        lock: file that is locked meanwhile, and stays.

    Raises:
        Exception: whatever the client of the hub raises; the part stays. OSError when the disk is too small.
    """
    from huggingface_hub.utils import WeakFileLock

    for folder in (lock.parent, part.parent, target.parent):
        folder.mkdir(parents=True, exist_ok=True)
    with WeakFileLock(lock):
        if target.is_file() and target.stat().st_size == size:
            found = sha256_of(target)
            if found == (digest or found):
                return found  # another process fetched it meanwhile
        _remove_useless(part, size if digest else None)
        is_continued = part.exists()
        found = _complete(url, part, size)
        if is_continued and found != digest:
            part.unlink()
            found = _complete(url, part, size)
        if found == (digest or found):
            part.replace(target)
        else:
            part.unlink()
        return found


def part_file(folder: Path, name: str, etag: str | None) -> Path:
    """Return where a version of a file of the hub grows while it is downloaded."""
    # The end of the name is the one of the hub's cache, whose tools find and remove such files.
    return folder / f"{name}.{hashlib.sha256((etag or '').encode()).hexdigest()[:12]}.incomplete"


def _remove_useless(part: Path, size: int | None) -> None:
    """Remove a part that cannot become a file of `size` bytes that is known, and those of other versions."""
    if part.exists() and (size is None or part.stat().st_size > size):
        part.unlink()
    name = part.name.rsplit(".", 2)[0]
    other = re.compile(re.escape(name) + r"\.[0-9a-f]{12}\.incomplete")
    for path in part.parent.iterdir():
        if path != part and other.fullmatch(path.name):
            path.unlink()


def _complete(url: str, part: Path, size: int | None) -> str:
    """Append what is missing of a file, and return the SHA-256 of the whole."""
    from huggingface_hub.file_download import http_get
    from huggingface_hub.utils import build_hf_headers

    with part.open("ab") as file:
        there = file.tell()
        if size is not None and size - there > shutil.disk_usage(part.parent).free:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(part))
        http_get(
            # A range of a compressed answer would not be one of the file.
            url, file, resume_size=there, headers={**build_hf_headers(), "Accept-Encoding": "identity"},
            expected_size=size, displayed_filename=part.name.rsplit(".", 2)[0],
        )  # fmt: skip
    return sha256_of(part)


def local_file(item: ModelEntry) -> tuple[str, str] | None:
    """Return the revision and the SHA-256 of a model's file in the cache of the hub; None without one."""
    kept = _kept(item)
    return None if kept is None else (revision_of(kept, item), sha256_of(kept))


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
        _write_note(path, digest)
        return True
    if note.is_file():
        os.utime(note, (0, 0))  # it still says what the file should be, and never again that this file was compared
    return False


def note_digest(path: Path, digest: str) -> bool:
    """Note the SHA-256 of a file that was just compared; False, and no note, if the file is shorter than it says."""
    if not _has_its_length(path):
        return False
    _write_note(path, digest)
    return True


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


def _place(item: ModelEntry, announced: HfFileMetadata) -> Path:
    """Return where the cache keeps the content of a file: by its entity tag, or without links at its own name."""
    from huggingface_hub import constants, errors
    from huggingface_hub.file_download import are_symlinks_supported

    etag, commit = announced.etag or "", announced.commit_hash or ""
    if not (_FILE_NAME.fullmatch(etag) and _FILE_NAME.fullmatch(commit)):
        raise errors.FileMetadataError(f"no commit, or no entity tag: {commit!r}, {etag!r}")
    if are_symlinks_supported(constants.HF_HUB_CACHE):
        return _folder(item) / "blobs" / etag
    return _folder(item) / "snapshots" / commit / item.hub_file


def _lock(item: ModelEntry, announced: HfFileMetadata) -> Path:
    """Return the lock that `huggingface_hub` itself takes while it downloads that file."""
    folder = _folder(item)
    return folder.parent / ".locks" / folder.name / f"{announced.etag}.lock"


def revision_of(kept: Path, item: ModelEntry) -> str:
    """Return the commit of a file in the cache: the name of the folder that holds the repository's files."""
    return kept.parents[len(Path(item.hub_file).parts) - 1].name


def _known_digest(kept: Path) -> str | None:
    """Return the SHA-256 that a file of the cache had when it was downloaded, by the note or the cache's own name."""
    # Not the end of the chain of links: where repositories share files, that is named by another hash.
    return noted_digest(kept) or (digest_of(kept.readlink().name) if kept.is_symlink() else None)


def _note(path: Path) -> Path:
    """Return where the SHA-256 of a file of the cache is kept, in the format of `sha256sum`."""
    return path.with_name(path.name + ".sha256")


def noted_digest(path: Path) -> str | None:
    """Return the SHA-256 that a downloaded file had when it was compared; None without such a note."""
    try:
        return digest_of(_note(path).read_text("utf-8").partition(" ")[0])
    except (OSError, UnicodeError):
        return None


def _write_note(path: Path, digest: str) -> None:
    """Write the note whole; a cache that cannot be written to goes without, and its file is read at each use."""
    note = _note(path)
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
    with _quiet:
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
        return f"the disk of {item.folder} has too little room", f"Make room, or {item.elsewhere} another disk,"
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
