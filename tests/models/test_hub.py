"""Downloads: what is in the cache is checked, a damaged file is fetched again, and a failure names its true reason."""

import dataclasses
import errno
import hashlib
import logging
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections import namedtuple
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import huggingface_hub
import pytest
import torch
from huggingface_hub import constants, file_download
from safetensors.torch import save

from fake_hub import CLOSED, COMMIT, ENVIRONMENT, Hub, running, use_endpoint
from freegeo.cli import models
from freegeo.errors import UserError
from freegeo.models import catalog, hub

CONTENT = save({"model.x": torch.arange(5000.0)})
OTHER = save({"model.x": torch.arange(5000.0) + 1})
Disk = namedtuple("Disk", ["total", "used", "free"])


@pytest.fixture(scope="module")
def running_hub():
    with running(CONTENT) as hub:
        yield hub


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path) -> Path:
    """An empty cache, an environment without proxies, and a client that is made anew in it."""
    for name in ENVIRONMENT:
        monkeypatch.delenv(name, raising=False)
    folder = tmp_path / "cache"
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(folder))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "token"))
    use_endpoint(monkeypatch, CLOSED)
    huggingface_hub.close_session()
    yield folder
    huggingface_hub.close_session()


@pytest.fixture
def online(monkeypatch, running_hub) -> Hub:
    """The hub in its usual state."""
    running_hub.reset(CONTENT)
    use_endpoint(monkeypatch, running_hub.url)
    return running_hub


def reason(name: str = "da3-base") -> str:
    """Fail to download a model and return why."""
    with pytest.raises(UserError) as error:
        catalog.download(name)
    text = str(error.value)
    assert "\n" not in text and len(text) < 700
    assert "could not be downloaded: " in text
    assert f"run `freegeo models download {name}`" in text
    assert "pass --checkpoint FILE" in text
    return text


# -- the cache


def test_a_file_is_downloaded_once_and_then_needs_no_network(online, caplog):
    path = catalog.download("da3-base")
    assert path.read_bytes() == CONTENT
    asked = len(online.asked)
    assert online.asked[0] == "HEAD /depth-anything/DA3-BASE/resolve/main/model.safetensors"
    assert f"GET /depth-anything/DA3-BASE/resolve/{COMMIT}/model.safetensors" in online.asked
    assert catalog.download("da3-base") == catalog.download("da3-base", check_hash=True) == path
    assert len(online.asked) == asked
    assert caplog.text == ""


def damaged(path: Path, kind: str) -> None:
    """Damage a file of the cache where it is, also where it is a link."""
    content = {
        "truncated": CONTENT[:9000],
        "without its last byte": CONTENT[:-1],
        "empty": b"",
        "longer": CONTENT + b"x",
        "another content": CONTENT[:-4] + b"\0\0\0\0",
    }[kind]
    path.resolve().write_bytes(content)


@pytest.mark.parametrize("kind", ["truncated", "without its last byte", "empty", "longer"])
def test_a_damaged_file_is_downloaded_again(online, caplog, kind):
    path = catalog.download("da3-base")
    damaged(path, kind)
    caplog.set_level(logging.INFO, "freegeo")
    assert catalog.download("da3-base") == path
    assert path.read_bytes() == CONTENT
    assert f"{path}: truncated or damaged; it is downloaded again." in caplog.text


def test_a_file_of_the_right_length_with_another_content_is_found_by_its_hash(online):
    path = catalog.download("da3-base")
    damaged(path, "another content")
    assert catalog.download("da3-base", check_hash=True) == path
    assert path.read_bytes() == CONTENT


def test_a_cache_without_links_is_checked_too(online, cache):
    place = cache / "models--depth-anything--DA3-BASE"
    (place / "snapshots" / COMMIT).mkdir(parents=True)
    (place / "refs").mkdir()
    (place / "refs" / "main").write_text(COMMIT)
    path = place / "snapshots" / COMMIT / "model.safetensors"
    path.write_bytes(CONTENT[:9000])
    assert catalog.download("da3-base") == path
    assert path.read_bytes() == CONTENT


def test_a_damaged_file_without_a_network_is_named(online, monkeypatch):
    path = catalog.download("da3-base")
    damaged(path, "truncated")
    use_endpoint(monkeypatch, CLOSED)
    text = reason()
    assert f"is damaged ({path})" in text
    assert "Connection refused" in text
    assert path.exists()


@pytest.mark.parametrize("whole", [True, False])
def test_a_zip_of_weights_is_checked_by_its_end(online, monkeypatch, tmp_path, whole):
    torch.save({"x": torch.zeros(9000)}, tmp_path / "m.pt")
    online.content = (tmp_path / "m.pt").read_bytes()
    path = catalog.download("vggt-1b-commercial")
    asked = len(online.asked)
    if not whole:
        path.resolve().write_bytes(online.content[:-100])
    assert catalog.download("vggt-1b-commercial").read_bytes() == online.content
    assert (len(online.asked) == asked) == whole


def test_a_download_that_is_damaged_on_the_way_is_refused(online):
    online.tag = "0" * 64
    with pytest.raises(UserError, match=r"the download differs from what http://127.*announced"):
        catalog.download("da3-base")


def test_weights_that_do_not_load_name_the_repair(online):
    with pytest.raises(UserError, match=r"does not fit da3-base.*`freegeo models download da3-base` checks that file"):
        catalog.load_model("da3-base")


# -- a download that was stopped

HALF = 10_000


@pytest.fixture
def broken_off(online, monkeypatch, cache) -> Path:
    """The part that a download left which broke off in the middle; the hub is well again."""
    monkeypatch.setattr(logging, "raiseExceptions", False)  # the client's logger writes to the stream of another test
    monkeypatch.setattr(file_download.time, "sleep", lambda seconds: None)
    monkeypatch.setattr(constants, "DOWNLOAD_CHUNK_SIZE", 1000)
    online.breaks_off_at = HALF
    reason()
    (part,) = cache.rglob("*.incomplete")
    assert part.read_bytes() == CONTENT[:HALF]
    online.reset(CONTENT)
    return part


def layout(cache: Path) -> dict[str, str]:
    """What the hub's cache holds: files with their sizes, links with their targets, locks; without notes."""
    return {
        path.relative_to(cache).as_posix(): str(path.readlink() if path.is_symlink() else path.stat().st_size)
        for path in cache.rglob("*")
        if (path.is_file() or path.is_symlink()) and path.suffix != ".sha256"
    }


@pytest.mark.parametrize("takes_ranges", [True, False])
def test_a_download_that_broke_off_continues_where_it_was(online, broken_off, takes_ranges):
    online.takes_ranges = takes_ranges
    assert catalog.download("da3-base").read_bytes() == CONTENT
    assert online.starts == [HALF]
    assert not broken_off.exists()


def test_the_cache_is_as_the_hub_library_leaves_it(online, broken_off, cache, tmp_path):
    path = catalog.download("da3-base")
    theirs = tmp_path / "theirs"
    huggingface_hub.hf_hub_download("depth-anything/DA3-BASE", "model.safetensors", cache_dir=theirs)
    assert layout(cache) == layout(theirs)
    assert huggingface_hub.try_to_load_from_cache("depth-anything/DA3-BASE", "model.safetensors") == str(path)
    online.starts.clear()
    assert huggingface_hub.hf_hub_download("depth-anything/DA3-BASE", "model.safetensors") == str(path)
    assert online.starts == []


def test_a_part_of_another_version_is_removed_and_other_files_stay(online, broken_off):
    online.content = OTHER
    others = [broken_off.with_name(f"{name}.incomplete") for name in ("x.0123456789ab", digest(CONTENT))]
    for other in others:
        other.write_bytes(b"x")
    assert catalog.download("da3-base").read_bytes() == OTHER
    assert online.starts == [0]
    assert not broken_off.exists()
    assert all(other.exists() for other in others)


@pytest.mark.parametrize(
    ("part", "starts"),
    [(b"x" * HALF, [HALF, 0]), (CONTENT[:-1] + b"x", [0]), (CONTENT + b"x", [0]), (CONTENT, []), (b"", [0])],
)
def test_a_part_is_used_as_far_as_it_is_right(online, broken_off, part, starts):
    broken_off.write_bytes(part)
    assert catalog.download("da3-base").read_bytes() == CONTENT
    assert online.starts == starts


def test_nothing_is_continued_that_could_not_be_compared_afterwards(online, cache):
    online.tag = "some-tag"
    part = hub.part_file(cache / "models--depth-anything--DA3-BASE" / "blobs", "model.safetensors", "some-tag")
    part.parent.mkdir(parents=True)
    part.write_bytes(b"x" * HALF)
    assert catalog.download("da3-base").read_bytes() == CONTENT
    assert online.starts == [0]


def test_several_that_want_a_file_at_once_fetch_it_once(online, monkeypatch):
    plain, all_want = hub.download_file, threading.Barrier(3, timeout=20)

    def together(*arguments, **options):
        all_want.wait()
        return plain(*arguments, **options)

    monkeypatch.setattr(hub, "download_file", together)
    with ThreadPoolExecutor(3) as pool:
        paths = set(pool.map(catalog.download, ["da3-base"] * 3))
    assert [path.read_bytes() for path in paths] == [CONTENT]
    assert online.starts == [0]


def test_a_cache_without_links_gets_the_file_itself(online, monkeypatch, cache):
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_SYMLINKS", True)
    for _ in range(2):
        path = catalog.download("da3-base")
        assert path.read_bytes() == CONTENT
        assert not path.is_symlink()
        assert files(cache) == ["model.safetensors"]
        damaged(path, "truncated")
    assert online.starts == [0, 0]


def test_the_token_is_sent(online, monkeypatch):
    monkeypatch.setenv("HF_TOKEN", "hf_secret")
    catalog.download("da3-base")
    assert online.tokens == ["Bearer hf_secret"]


@pytest.mark.parametrize("tag", ["../../../outside", ".."])
def test_a_tag_that_is_no_file_name_writes_nothing(online, cache, tag):
    online.tag = tag
    assert "does not answer as a model hub does" in reason()
    assert files(cache.parent) == []


@pytest.mark.slow
def test_a_command_that_was_killed_continues_with_one_request(tmp_path):
    content = save({"model.x": torch.arange(6_500_000.0)})  # parts are written by 10 MiB
    environment = {name: value for name, value in os.environ.items() if name not in ENVIRONMENT}
    command = [sys.executable, "-m", "freegeo.cli.app", "models", "download", "da3-base"]
    with running(content) as hub:
        environment |= {"HF_ENDPOINT": hub.url, "HF_HOME": str(tmp_path)}
        hub.breaks_off_at = len(content) - 1000
        hub.may_hang_up.clear()
        killed = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        assert hub.has_broken_off.wait(60)
        (part,) = tmp_path.rglob("*.incomplete")
        wait_until(lambda: part.stat().st_size == 20 << 20)
        killed.kill()
        killed.wait()
        hub.may_hang_up.set()
        hub.reset(content)
        again = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        assert hub.starts == [20 << 20]
        path = Path(again.stdout.strip().splitlines()[-1])
        assert path.read_bytes() == content
        assert not part.exists()


def wait_until(holds) -> None:
    end = time.monotonic() + 30
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.02)


# -- the right file: pinned, or the one of the first download


def digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def pin(monkeypatch, **fields) -> None:
    """Pin da3-base in the catalog."""
    pinned = dataclasses.replace(catalog.entry("da3-base"), **fields)
    monkeypatch.setattr(catalog, "entry", lambda name: pinned)


def files(cache: Path) -> list[str]:
    """Return the names of the files that hold weights, whole or in part."""
    return [path.name for path in cache.rglob("*") if path.is_file() and path.stat().st_size > 1000]


def test_a_pinned_revision_is_the_one_that_is_asked_for(online, monkeypatch):
    pin(monkeypatch, revision=COMMIT, sha256=digest(CONTENT))
    path = catalog.download("da3-base")
    assert {line.split("/resolve/")[1] for line in online.asked} == {f"{COMMIT}/model.safetensors"}
    online.asked.clear()
    assert catalog.download("da3-base", check_hash=True) == path
    assert online.asked == []


@pytest.mark.parametrize("announced", [True, False])
def test_a_file_that_is_not_the_pinned_one_is_refused_and_not_kept(online, monkeypatch, cache, announced):
    pin(monkeypatch, revision=COMMIT, sha256=digest(CONTENT))
    online.content, online.tag = OTHER, None if announced else "some-tag"
    for _ in range(2):
        with pytest.raises(UserError) as error:
            catalog.download("da3-base")
        assert "has another file for da3-base than the one that freegeo names" in str(error.value)
        assert f"(SHA-256 {digest(OTHER)} instead of {digest(CONTENT)}); it was not used." in str(error.value)
        assert "\n" not in str(error.value)
        assert files(cache) == []
    assert any(line.startswith("GET") for line in online.asked) != announced


def test_a_file_that_another_program_put_into_the_cache_is_checked_before_its_first_use(online, monkeypatch, cache):
    path = Path(huggingface_hub.hf_hub_download("depth-anything/DA3-BASE", "model.safetensors"))
    path.resolve().write_bytes(OTHER)
    assert catalog.download("da3-base").read_bytes() == CONTENT
    pin(monkeypatch, sha256=digest(OTHER))
    with pytest.raises(UserError, match="another file for da3-base than the one that freegeo names"):
        catalog.download("da3-base")


def test_a_download_that_was_refused_is_not_taken_by_the_next_command(online, cache):
    online.tag = "0" * 64
    for _ in range(2):
        with pytest.raises(UserError, match="the download differs from what"):
            catalog.download("da3-base")
        assert files(cache) == []


@pytest.mark.parametrize("tag", [None, "some-tag"])
@pytest.mark.parametrize("lost", ["damaged", "removed"])
def test_the_file_of_the_first_download_counts_from_then_on(online, cache, tag, lost):
    online.tag = tag
    path = catalog.download("da3-base")
    if lost == "damaged":
        damaged(path, "truncated")
    else:
        path.resolve().unlink()
    online.content = OTHER
    online.asked.clear()
    for _ in range(2):
        with pytest.raises(UserError) as error:
            catalog.download("da3-base")
        assert "another file for da3-base than the one that was downloaded first" in str(error.value)
        assert f"(SHA-256 {digest(OTHER)} instead of {digest(CONTENT)}); it was not used." in str(error.value)
        folder = cache / "models--depth-anything--DA3-BASE"
        assert f"If you trust the new one, remove {folder} and run" in str(error.value)
    assert all(f"/resolve/{COMMIT}/" in line for line in online.asked)
    shutil.rmtree(folder)
    assert catalog.download("da3-base").read_bytes() == OTHER


def test_a_file_that_the_hub_library_shares_between_repositories_is_known_by_its_own_hash(online, cache):
    path = Path(huggingface_hub.hf_hub_download("depth-anything/DA3-BASE", "model.safetensors"))
    blob, shared = path.resolve(), cache / "blobs" / "ab" / ("ab" * 32)
    shared.parent.mkdir(parents=True)
    blob.rename(shared)
    blob.symlink_to(os.path.relpath(shared, blob.parent))
    online.asked.clear()
    assert catalog.download("da3-base") == path
    assert online.asked == []


def test_a_file_that_changed_since_it_was_checked_is_read_again(online, tmp_path):
    path = catalog.download("da3-base")
    damaged(path, "another content")
    later = path.with_name("model.safetensors.sha256").stat().st_mtime + 10
    os.utime(path, (later, later))
    assert catalog.download("da3-base").read_bytes() == CONTENT


def test_a_file_known_to_be_damaged_is_not_used_while_the_hub_is_away(online, monkeypatch):
    path = catalog.download("da3-base")
    damaged(path, "another content")
    os.utime(path, (1, 1))
    use_endpoint(monkeypatch, CLOSED)
    assert catalog.download("da3-base") == path  # its length is right, and it is no newer than the note
    for check in (True, False):
        with pytest.raises(UserError, match=r"is damaged .* could not be downloaded"):
            catalog.download("da3-base", check_hash=check)


def test_the_note_is_what_sha256sum_writes(online):
    path = catalog.download("da3-base")
    note = path.with_name("model.safetensors.sha256")
    assert note.read_text() == f"{digest(CONTENT)}  model.safetensors\n"
    assert hub.local_file(catalog.entry("da3-base")) == (COMMIT, digest(CONTENT))


def test_a_cache_that_takes_no_note_is_read_each_time(online, monkeypatch):
    path = Path(huggingface_hub.hf_hub_download("depth-anything/DA3-BASE", "model.safetensors"))

    def refuse(self, *arguments):
        raise PermissionError

    monkeypatch.setattr(Path, "write_text", refuse)
    assert catalog.download("da3-base") == path
    damaged(path, "another content")
    online.content = OTHER
    with pytest.raises(UserError, match="another file for da3-base"):
        catalog.download("da3-base")


def test_what_was_downloaded_is_named_by_commit_and_hash(online, tmp_path):
    path = catalog.download("da3-base")
    digest = hashlib.sha256(CONTENT).hexdigest()
    found = catalog.origin_of("da3-base").weights()
    assert (found["hub_id"], found["revision"], found["sha256"]) == (
        catalog.entry("da3-base").hub_id,
        COMMIT,
        {path.name: digest},
    )
    local = tmp_path / "mine.safetensors"
    local.write_bytes(OTHER)
    (tmp_path / "mine.safetensors.sha256").write_text(f"{digest}  mine.safetensors\n")
    found = catalog.origin_of("da3-base", local).weights()
    assert (found["hub_id"], found["revision"]) == (None, None)
    assert found["sha256"] == {local.name: hashlib.sha256(OTHER).hexdigest()}, (
        "a note beside a local file is not trusted"
    )


def test_describe_prints_what_to_pin(online, capsys):
    models.describe("da3-base")
    assert "pinned: nothing; " in capsys.readouterr().out
    assert online.asked == []
    catalog.download("da3-base")
    models.describe("da3-base")
    assert f"on this machine: revision {COMMIT}, SHA-256 {digest(CONTENT)}" in capsys.readouterr().out


def test_the_pins_of_the_catalog_are_whole_and_the_docs_list_them():
    page = (Path(__file__).parents[2] / "docs" / "reliability.md").read_text("utf-8")
    for name in catalog.names():
        item = catalog.entry(name)
        if item.hub_id is None:
            continue
        assert item.revision is None or re.fullmatch("[0-9a-f]{40}", item.revision)
        assert item.sha256 is None or re.fullmatch("[0-9a-f]{64}", item.sha256)
        words = [word for word, value in (("revision", item.revision), ("SHA-256", item.sha256)) if value]
        assert f"| {name} | {' and '.join(words) or 'nothing'} |" in page


# -- reasons


@pytest.mark.parametrize(
    ("variables", "words"),
    [
        ({"ALL_PROXY": "socks5://127.0.0.1:1080"}, ("ALL_PROXY=socks5://127.0.0.1:1080", "pip install socksio")),
        ({"ALL_PROXY": "socks://127.0.0.1:7890/"}, ("ALL_PROXY=socks://127.0.0.1:7890/", "http://HOST:PORT")),
        ({"https_proxy": "http://proxy:port"}, ("https_proxy=http://proxy:port", "http://HOST:PORT")),
        ({"HTTP_PROXY": "ftp://127.0.0.1"}, ("HTTP_PROXY=ftp://127.0.0.1", "http://HOST:PORT")),
        ({"HTTP_PROXY": "http://127.0.0.1:9"}, ("through HTTP_PROXY=http://127.0.0.1:9", "Connection refused")),
        ({"SSL_CERT_FILE": "/nonexistent/ca.pem"}, ("certificates", "SSL_CERT_FILE=/nonexistent/ca.pem")),
        ({"SSL_CERT_FILE": __file__}, ("certificates", f"SSL_CERT_FILE={__file__}")),
        ({"HF_TOKEN": "hf_é"}, ("access token", "HF_TOKEN")),
    ],
)
def test_settings_that_are_wrong_are_named(monkeypatch, variables, words):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    text = reason()
    for part in words:
        assert part in text


def test_passwords_of_proxies_are_not_shown(monkeypatch):
    monkeypatch.setenv("HTTP_PROXY", "http://me:secret@127.0.0.1:9")
    text = reason()
    assert "HTTP_PROXY=http://127.0.0.1:9" in text
    assert "secret" not in text


def test_a_hub_that_is_not_there():
    assert f"{CLOSED} cannot be reached ([Errno {errno.ECONNREFUSED}] Connection refused). Go online" in reason()


def test_an_endpoint_without_its_protocol(monkeypatch):
    use_endpoint(monkeypatch, "127.0.0.1:9")
    assert "127.0.0.1:9 cannot be reached (Request URL is missing an 'http://'" in reason()


def test_offline_mode_is_named(monkeypatch):
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    assert "HF_HUB_OFFLINE is set, which forbids downloads. Unset it" in reason()


@pytest.mark.parametrize(
    ("status", "words"),
    [(404, "answered 404 for depth-anything/DA3-BASE/model.safetensors. Check HF_ENDPOINT"), (401, "answered 401"),
     (403, "answered 403 for"), (503, "answered 503 for")],
)  # fmt: skip
def test_answers_that_are_errors_are_given_by_number(online, status, words):
    online.status = status
    assert words in reason()


@pytest.mark.parametrize("status", [401, 403])
def test_a_licence_to_be_accepted_is_named(online, status):
    online.status = status
    text = reason("vggt-1b-commercial")
    assert "Accept it at https://huggingface.co/facebook/VGGT-1B-Commercial, log in with `hf auth login`" in text


def test_a_page_that_is_no_hub(online):
    online.is_hub = False
    assert "does not answer as a model hub does. Check HF_ENDPOINT and the proxy" in reason()


def test_a_disk_that_is_too_small_is_named_before_the_download(online, monkeypatch, cache):
    monkeypatch.setattr(hub.shutil, "disk_usage", lambda folder: Disk(len(CONTENT), 0, len(CONTENT) - 1))
    assert f"the disk of {cache} has too little room. Make room, or set HF_HOME to another disk" in reason()
    assert online.starts == []


def test_what_was_there_when_the_disk_became_full_is_kept(online, monkeypatch, cache):
    def full(url, file, **options):
        file.write(CONTENT[:5000])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(file_download, "http_get", full)
        assert f"the disk of {cache} has too little room. Make room, or set HF_HOME to another disk" in reason()
    assert catalog.download("da3-base").read_bytes() == CONTENT
    assert online.starts == [5000]


def test_a_cache_that_cannot_be_written_to(online, monkeypatch):
    def denied(*arguments, **options):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), "/cache/blobs")

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", denied)
    assert "/cache/blobs cannot be written to. Set HF_HOME" in reason()


def test_a_cache_in_the_place_of_a_file(online, cache):
    cache.parent.mkdir(exist_ok=True)
    cache.write_text("a file")
    assert "could not be downloaded: " in reason()


def test_any_other_reason_is_given_as_it_is(online, monkeypatch):
    def broken(*arguments, **options):
        raise RuntimeError("Data processing error: chunk 3\nmore")

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", broken)
    assert "could not be downloaded: Data processing error: chunk 3. " in reason()


def test_an_unreachable_hub_is_noticed_before_the_download_and_without_noise(monkeypatch, caplog):
    monkeypatch.setattr(huggingface_hub, "hf_hub_download", lambda *arguments, **options: pytest.fail("asked"))
    reason("da3-small")
    assert caplog.text == ""
    assert logging.getLogger("huggingface_hub").level != logging.CRITICAL
    assert hub.REACHABLE_WITHIN_S <= 10
