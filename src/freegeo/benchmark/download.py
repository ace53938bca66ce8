"""The archives of the benchmark's datasets: fetched from the hub, compared with their hashes, unpacked.

```
DATA/<name>.zip            the archive
DATA/<name>.zip.sha256     what it was when it was compared
DATA/<name>.zip.<hash>.incomplete   what is there of it after a download that was stopped; the next one continues
DATA/<name>/               its content, which appears as a whole
```
"""

from __future__ import annotations

import errno
import logging
import shutil
import stat
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from freegeo.benchmark.check import check_dataset
from freegeo.data.datasets.base import Archive
from freegeo.data.datasets.registry import get_dataset
from freegeo.errors import DamagedError, FreeGeoError, UserError
from freegeo.files import inside, scratch_folder
from freegeo.host import gigabytes
from freegeo.models.hub import (
    HubFile,
    digest_of,
    download_file,
    endpoint,
    is_verified,
    note_digest,
    noted_digest,
    part_file,
    published,
    why,
)

if TYPE_CHECKING:
    from huggingface_hub import HfFileMetadata

logger = logging.getLogger(__name__)

REPOSITORY = "depth-anything/DA3-BENCH"
PAGE = f"https://huggingface.co/datasets/{REPOSITORY}"
MOST_UNPACKED = 10
"""No dataset is so many times as large as its archive is listed."""
MOST_FILES = 1_000_000
_BLOCK = 1 << 20
_DAMAGED = (
    zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError, LookupError,
)  # fmt: skip
"""What zipfile raises for a damaged archive, and for one that is encrypted or packed in a way it does not know."""


@dataclass(frozen=True, kw_only=True)
class Offer:
    """One dataset, and what fetching it takes."""

    name: str
    archive: Archive
    path: Path
    """Of the archive on this machine, whether it is there or not."""
    state: str
    """`complete`: unpacked already; `archive`: to be unpacked; `missing`: to be downloaded and unpacked."""
    size: int
    """Bytes of the archive."""
    kept: int = 0
    """Bytes of it that were downloaded already."""
    digest: str | None = None
    """SHA-256 that the archive must have; None: unknown, and the first one counts."""
    part: Path | None = None
    """Where the archive grows while it is downloaded; another version of it has another one."""
    url: str = ""

    @property
    def needed(self) -> int:
        """Bytes that the disk needs at least: the rest of the archive, and as much again for its content."""
        return 0 if self.state == "complete" else 2 * self.size - self.kept


def offer(data: Path, name: str) -> Offer:
    """Say what fetching a dataset takes; the hub is asked for the size of an archive that is not there.

    Raises:
        UserError: there is no such dataset on the hub, its folder holds something else than the whole dataset, or the
            hub does not answer.
    """
    dataset = get_dataset(name)
    if dataset.generated:
        raise UserError(f"{name} needs no download: its rooms are rendered when they are first used.")
    if dataset.archive is None:
        raise UserError(f"{name} is not on the hub: get it from its authors, and put it into {data / name}.")
    path = data / f"{name}.zip"
    if (data / name).exists():
        blocking = check_dataset(data, name).blocking
        if blocking:
            raise UserError(
                f"{data / name} is there, but not complete ({blocking[0]}). Move it away and run again; the whole "
                "dataset is then unpacked anew."
            )
        return Offer(name=name, archive=dataset.archive, path=path, state="complete", size=0)
    noted = noted_digest(path)
    if path.is_file():
        size = path.stat().st_size
        digest = noted or _digest_by_the_hub(path)
        return Offer(
            name=name, archive=dataset.archive, path=path, state="archive", size=size, kept=size, digest=digest
        )
    found = _announced(path)
    announced = digest_of(found.etag)
    if noted is not None and announced not in (None, noted):
        raise UserError(
            f"{endpoint()} has another {path.name} than the one that was downloaded first (SHA-256 {announced} instead "
            f"of {noted}); it was not downloaded. If you trust the new one, remove {path}.sha256 and run again."
        )
    part, digest = part_file(data, path.name, found.etag), noted or announced
    return Offer(
        name=name, archive=dataset.archive, path=path, state="missing", size=found.size or 0,
        kept=part.stat().st_size if digest and part.is_file() else 0, digest=digest, part=part,
        url=_address(path, found.commit_hash),
    )  # fmt: skip


def require_room(data: Path, offers: Sequence[Offer]) -> int:
    """Return the bytes that are free for `data`; UserError when they do not suffice for the archives and content."""
    free, needed = free_bytes(data), sum(one.needed for one in offers)
    if needed > free:
        raise UserError(
            f"{data}: {gigabytes(free)} are free, and {', '.join(o.name for o in offers if o.needed)} take at least "
            f"{gigabytes(needed)}, archives included. Make room, or point --data to another disk."
        )
    return free


def fetch(one: Offer) -> Path:
    """Download an archive, or what is missing of it, and compare its SHA-256; returns its path.

    Raises:
        UserError: the download failed, with the reason and what to do.
        FreeGeoError: the archive is damaged, or not the right one.
    """
    path = one.path
    if one.part is None:
        if is_verified(path, one.digest, check_hash=True):
            return path
        raise FreeGeoError(
            f"{path}: damaged, or not the right archive. Remove it and run again; it is then downloaded."
        )
    try:
        found = download_file(
            one.url, path, part=one.part, size=one.size or None, digest=one.digest,
            lock=path.with_name(f".{path.name}.lock"),
        )  # fmt: skip
    # The client raises errors of several libraries; none of them is ours.
    except Exception as error:
        logger.debug("download of %s failed: %r", path.name, error)
        raise _failed(error, path) from None
    if found == (one.digest or found) and note_digest(path, found):
        return path
    path.unlink(missing_ok=True)
    raise FreeGeoError(
        f"{path.name}: what was downloaded is not what {endpoint()} announced (SHA-256 {found} instead of "
        f"{one.digest or 'a zip file'}), and was removed. Run again, perhaps on another network."
    )


def unpack(one: Offer, data: Path, on_bytes: Callable[[int, int], None] = lambda done, total: None) -> Path:
    """Unpack an archive beside itself; the dataset's folder appears when everything is in it.

    Args:
        one: of which the archive is there.
        data: the folder that gets the dataset's folder.
        on_bytes: called with the bytes that are written and those of the whole.

    Raises:
        UserError: the disk is too small.
        FreeGeoError: the archive is damaged, or holds what no dataset does: files elsewhere, links, far too much.
    """
    scratch = scratch_folder(data, one.name)
    try:
        with zipfile.ZipFile(one.path) as archive:
            members = _members(archive, one, scratch)
            total, free = sum(member.file_size for member in members), free_bytes(data)
            if total > free:
                raise UserError(
                    f"{data}: {one.path.name} unpacks to {gigabytes(total)}, and {gigabytes(free)} are free. Make "
                    "room, or point --data to another disk and move the archive there."
                )
            done = 0
            for member in members:
                target = scratch / member.filename
                target.parent.mkdir(parents=True, exist_ok=True)
                # No more comes out than the size that was added up; at the end the checksum is compared.
                with archive.open(member) as source, target.open("xb") as file:
                    while block := source.read(_BLOCK):
                        file.write(block)
                        done += len(block)
                        on_bytes(done, total)
        (scratch / one.name).rename(data / one.name)
    except FreeGeoError:
        raise
    except _DAMAGED as error:
        raise DamagedError(one.path, error, "Remove it and run again; it is then downloaded.") from None
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise UserError(
            f"{data}: the disk became full while {one.path.name} was unpacked; nothing of it was kept. Make room and "
            "run again."
        ) from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return data / one.name


def free_bytes(folder: Path) -> int:
    """Return the bytes that are free on the disk of a folder, which need not exist yet."""
    return shutil.disk_usage(next(f for f in (folder, *folder.absolute().parents) if f.exists())).free


def _members(archive: zipfile.ZipFile, one: Offer, folder: Path) -> list[zipfile.ZipInfo]:
    """Return the files of an archive that belong to its dataset; FreeGeoError when one is no file of a dataset."""
    entries = archive.infolist()
    if len(entries) > MOST_FILES:
        raise _refused(one, f"it lists {len(entries):,} files")
    for entry in entries:
        try:
            inside(folder, entry.filename)
        except UserError:
            raise _refused(one, f"it holds a file with the name {entry.filename[:80]!r}") from None
        kind = stat.S_IFMT(entry.external_attr >> 16)
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise _refused(one, f"{entry.filename} is a link or a device")
    files = [entry for entry in entries if not entry.is_dir()]
    own = [entry for entry in files if entry.filename.startswith(f"{one.name}/")]
    others = [entry.filename for entry in files if not entry.filename.startswith(f"{one.name}/")]
    if len({entry.filename for entry in own}) < len(own):
        raise _refused(one, "it holds two files of one name")
    if not own:
        raise _refused(one, f"it holds no folder {one.name}")
    total, most = sum(entry.file_size for entry in own), MOST_UNPACKED * one.archive.gb * 1e9
    if total > most:
        raise _refused(one, f"it unpacks to {gigabytes(total)}, where {gigabytes(most)} would be very much")
    if others:
        logger.warning(
            "%s: %d files that are not in the folder %s were left in the archive, such as %s.",
            one.path, len(others), one.name, others[0],
        )  # fmt: skip
    return own


def _refused(one: Offer, reason: str) -> FreeGeoError:
    return FreeGeoError(f"{one.path}: was not unpacked, because {reason}. Remove it; it is not the published archive.")


def _announced(path: Path) -> HfFileMetadata:
    """Return what the hub says about an archive; UserError with the reason when it cannot be asked."""
    try:
        return published(_address(path))
    except Exception as error:
        logger.debug("asking for %s failed: %r", path.name, error)
        raise _failed(error, path) from None


def _address(path: Path, commit: str | None = None) -> str:
    import huggingface_hub

    return huggingface_hub.hf_hub_url(REPOSITORY, path.name, repo_type="dataset", revision=commit)


def _digest_by_the_hub(path: Path) -> str | None:
    """Return the SHA-256 that the hub has for an archive that somebody put there; a warning when it cannot be asked."""
    try:
        return digest_of(_announced(path).etag)
    except UserError as error:
        logger.warning("%s: taken as it is, since it could not be compared with the hub's: %s", path, error)
        return None


def _failed(error: Exception, path: Path) -> UserError:
    reason, remedy = why(
        error,
        HubFile(repository=REPOSITORY, name=path.name, page=PAGE, folder=str(path.parent), elsewhere="point --data to"),
    )
    return UserError(
        f"{path.name} could not be downloaded: {reason}. {remedy} and run the same command again, which continues; or "
        f"get it from {PAGE} in another way and put it into {path.parent}."
    )
