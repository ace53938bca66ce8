"""`bench download`: sizes and terms first, a stopped download continues, archives are compared and unpacked safely."""

import errno
import io
import logging
import re
import shutil
import stat
import zipfile
from pathlib import Path

import huggingface_hub
import pytest
from huggingface_hub import constants, file_download

from fake_hub import CLOSED, COMMIT, ENVIRONMENT, running, use_endpoint
from fixture_tools import fixture_path
from freegeo.benchmark import download
from freegeo.cli.app import main
from freegeo.data.datasets import eth3d
from freegeo.host import gigabytes

DATASETS = fixture_path("benchmark", "datasets")


def zipped(entries: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def files_below(folder: Path) -> dict[str, bytes]:
    return {f.relative_to(folder.parent).as_posix(): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


PIPES = {f"eth3d/{name}": content for name, content in files_below(Path(DATASETS, "eth3d", "pipes")).items()}
ARCHIVE = zipped(PIPES)


@pytest.fixture(scope="module")
def running_hub():
    with running(ARCHIVE) as hub:
        yield hub


@pytest.fixture
def hub(monkeypatch, tmp_path, running_hub):
    for name in ENVIRONMENT:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "token"))
    monkeypatch.setattr(eth3d, "SCENES", ("pipes",))
    running_hub.reset(ARCHIVE)
    use_endpoint(monkeypatch, running_hub.url)
    huggingface_hub.close_session()
    yield running_hub
    huggingface_hub.close_session()


@pytest.fixture
def get(capsys, tmp_path, hub):
    """Run `bench download` for a folder of its own; returns the exit code, the output and the last line of errors."""

    def run(*names, yes=True):
        capsys.readouterr()
        code = main(["bench", "download", *names, "--data", str(tmp_path / "data"), *["--yes"] * yes])
        streams = capsys.readouterr()
        assert "Traceback" not in streams.err
        return code, streams.out, streams.err.strip().splitlines()[-1] if streams.err.strip() else ""

    return run


def test_a_dataset_is_shown_fetched_checked_and_unpacked(get, hub, tmp_path):
    code, out, _ = get("eth3d")
    assert code == 0
    size = gigabytes(len(ARCHIVE))
    assert f"eth3d: eth3d.zip, {size}" in out
    assert "terms: research only, under the terms of ETH3D: https://www.eth3d.net" in out
    assert "source: https://huggingface.co/datasets/depth-anything/DA3-BENCH" in out
    assert f"to download: {size}; free on the disk" in out
    assert out.index("terms:") < out.index("unpacked")
    assert "eth3d: 1 of 1 scenes complete" in out
    assert files_below(tmp_path / "data" / "eth3d") == PIPES
    assert hub.asked[-1].startswith("GET /datasets/depth-anything/DA3-BENCH/resolve/" + COMMIT + "/eth3d.zip")
    hub.asked.clear()
    code, out, _ = get("eth3d")
    assert (code, hub.asked) == (0, [])
    assert "eth3d: complete, nothing to do" in out
    (tmp_path / "data" / "eth3d").rename(tmp_path / "elsewhere")
    assert get("eth3d")[0] == 0
    assert hub.asked == []
    assert not list((tmp_path / "data").glob(".*.part"))


def test_without_a_terminal_nothing_starts_that_was_not_agreed_to(get, hub, tmp_path):
    code, out, said = get("eth3d", yes=False)
    assert code == 2
    assert "terms:" in out
    assert "there is no terminal to ask in. Read the terms above, and pass --yes to accept them." in said
    assert not any(line.startswith("GET") for line in hub.asked)
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(("answer", "code"), [("y\n", 0), ("Yes\n", 0), ("n\n", 2), ("\n", 2), ("", 2)])
def test_in_a_terminal_one_is_asked(get, monkeypatch, answer, code):
    stdin = io.StringIO(answer)
    stdin.isatty = lambda: True
    monkeypatch.setattr("sys.stdin", stdin)
    got, out, _ = get("eth3d", yes=False)
    assert got == code
    assert "Accept these terms and start? [y/N]" in out


@pytest.mark.parametrize("takes_ranges", [True, False])
def test_a_download_that_broke_off_continues_where_it_was(get, hub, monkeypatch, tmp_path, takes_ranges):
    monkeypatch.setattr(logging, "raiseExceptions", False)  # the client's logger writes to the stream of another test
    monkeypatch.setattr(file_download.time, "sleep", lambda seconds: None)
    monkeypatch.setattr(constants, "DOWNLOAD_CHUNK_SIZE", 1000)
    half = len(ARCHIVE) // 2000 * 1000
    hub.breaks_off_at = half
    code, _, said = get("eth3d")
    assert code == 2
    assert "eth3d.zip could not be downloaded: " in said
    assert "run the same command again, which continues" in said
    assert not (tmp_path / "data" / "eth3d.zip").exists()
    (part,) = (tmp_path / "data").glob("eth3d.zip.*.incomplete")
    assert part.read_bytes() == ARCHIVE[:half]
    hub.breaks_off_at, hub.takes_ranges = None, takes_ranges
    hub.starts.clear()
    code, out, _ = get("eth3d")
    assert code == 0
    assert "of them downloaded already" in out
    assert hub.starts == [half]
    assert files_below(tmp_path / "data" / "eth3d") == PIPES
    assert not part.exists()


def test_what_a_killed_command_left_is_removed_and_a_part_of_another_version_is_not_continued(get, hub, tmp_path):
    left = tmp_path / "data" / ".eth3d.00000000.part" / "eth3d" / "pipes"
    left.mkdir(parents=True)
    (left / "combined_mesh.ply").write_bytes(b"half of")
    other = tmp_path / "data" / "eth3d.zip.0123456789ab.incomplete"
    other.write_bytes(b"other")
    assert get("eth3d")[0] == 0
    assert files_below(tmp_path / "data" / "eth3d") == PIPES
    assert not list((tmp_path / "data").glob(".*.part"))
    assert hub.starts == [0]
    assert not other.exists()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"status": 403, "error": "GatedRepo"},
            "Accept it at https://huggingface.co/datasets/depth-anything/DA3-BENCH",
        ),
        ({"status": 401}, "answered 401 for depth-anything/DA3-BENCH/eth3d.zip. Log in with `hf auth login`"),
        ({"status": 404, "error": "EntryNotFound"}, "answered 404 for depth-anything/DA3-BENCH/eth3d.zip"),
        ({"status": 500}, "answered 500 for"),
    ],
)
def test_a_refusal_of_the_hub_is_one_sentence(get, hub, tmp_path, change, said):
    vars(hub).update(change)
    code, _, error = get("eth3d")
    assert code == 2
    assert said in error
    assert f"get it from {download.PAGE} in another way and put it into {tmp_path / 'data'}" in error


def test_without_a_network_the_reason_is_said_and_an_archive_brought_along_is_taken(get, hub, monkeypatch, tmp_path):
    use_endpoint(monkeypatch, CLOSED)
    code, _, said = get("eth3d")
    assert code == 2
    assert "Connection refused" in said
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "eth3d.zip").write_bytes(ARCHIVE)
    code, _, said = get("eth3d")
    assert code == 0
    assert files_below(tmp_path / "data" / "eth3d") == PIPES


def test_another_file_than_the_announced_or_first_one_is_not_unpacked(get, hub, tmp_path):
    archive = tmp_path / "data" / "eth3d.zip"
    hub.tag = "0" * 64
    code, _, said = get("eth3d")
    assert code == 1
    assert f"instead of {'0' * 64}), and was removed" in said
    assert not archive.exists()

    hub.tag = None
    assert get("eth3d")[0] == 0
    shutil.rmtree(tmp_path / "data" / "eth3d")
    archive.unlink()
    hub.content = zipped({**PIPES, "eth3d/more": b""})
    code, _, said = get("eth3d")
    assert code == 2
    assert "has another eth3d.zip than the one that was downloaded first" in said
    assert f"remove {archive}.sha256" in said
    assert not (tmp_path / "data" / "eth3d").exists()


@pytest.mark.parametrize("kind", ["truncated", "damaged inside"])
def test_a_damaged_archive_is_named(get, hub, monkeypatch, tmp_path, kind):
    use_endpoint(monkeypatch, CLOSED)
    (tmp_path / "data").mkdir()
    content = bytearray(ARCHIVE)
    if kind == "truncated":
        del content[len(content) // 2 :]
    else:
        middle = ARCHIVE.index(b"eth3d/pipes/combined_mesh.ply") + 300
        content[middle : middle + 20] = bytes(20)
    (tmp_path / "data" / "eth3d.zip").write_bytes(content)
    code, _, said = get("eth3d")
    assert code == 1
    assert f"{tmp_path / 'data' / 'eth3d.zip'}: damaged" in said
    assert "Remove it and run again; it is then downloaded." in said
    assert not (tmp_path / "data" / "eth3d").exists()
    assert not list((tmp_path / "data").glob(".*.part"))


def link(name: str, target: str) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        entry = zipfile.ZipInfo(name)
        entry.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(entry, target)
    return buffer.getvalue()


def twice(name: str) -> bytes:
    buffer = io.BytesIO()
    with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(name, "one")
        archive.writestr(name, "two")
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (zipped({"eth3d/../../out": b"x"}), "holds a file with the name 'eth3d/../../out'"),
        (zipped({"/eth3d/out": b"x"}), "holds a file with the name '/eth3d/out'"),
        (link("eth3d/out", "/etc/passwd"), "eth3d/out is a link"),
        (twice("eth3d/x"), "two files of one name"),
        (zipped({"other/x": b"x"}), "holds no folder eth3d"),
        (zipped({"eth3d/zeros": bytes(30_000_000)}), "it unpacks to 30.0 MB, where 20.0 MB would be very much"),
    ],
)
def test_a_hostile_archive_writes_nothing(get, hub, monkeypatch, tmp_path, content, reason):
    monkeypatch.setattr(download, "MOST_UNPACKED", 20e6 / 14.1e9)
    hub.content = content
    code, _, said = get("eth3d")
    assert code == 1
    assert reason in said
    assert {f.name for f in tmp_path.rglob("*") if f.is_file() and ".cache" not in f.parts} <= {
        "eth3d.zip", "eth3d.zip.sha256", ".eth3d.zip.lock"
    }  # fmt: skip


def test_files_elsewhere_in_an_archive_are_left_there_and_named(get, hub, tmp_path, capsys):
    hub.content = zipped({**PIPES, "__MACOSX/x": b"", "readme.txt": b""})
    assert main(["bench", "download", "eth3d", "--data", str(tmp_path / "data"), "--yes"]) == 0
    assert "2 files that are not in the folder eth3d were left in the archive" in capsys.readouterr().err
    assert not (tmp_path / "data" / "readme.txt").exists()


def test_a_disk_that_is_too_small_or_becomes_full(get, hub, monkeypatch, tmp_path):
    plain = download.free_bytes
    monkeypatch.setattr(download, "free_bytes", lambda folder: len(ARCHIVE))
    code, _, said = get("eth3d")
    assert code == 2
    assert "are free, and eth3d take at least" in said
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "eth3d.zip").write_bytes(ARCHIVE)
    code, _, said = get("eth3d")
    assert code == 2, said
    assert re.search(r"eth3d.zip unpacks to .* kB, and .* kB are free", said)
    monkeypatch.setattr(download, "free_bytes", plain)
    monkeypatch.setattr(Path, "mkdir", full_below("eth3d/pipes", Path.mkdir))
    code, _, said = get("eth3d")
    assert code == 2
    assert "the disk became full while eth3d.zip was unpacked; nothing of it was kept" in said
    assert not list((tmp_path / "data").glob(".*.part"))


def full_below(place: str, plain):
    def mkdir(path, *arguments, **options):
        if place in path.as_posix():
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        return plain(path, *arguments, **options)

    return mkdir


def test_a_folder_that_is_there_but_not_whole_is_left_alone(get, tmp_path):
    (tmp_path / "data" / "eth3d").mkdir(parents=True)
    code, _, said = get("eth3d")
    assert code == 2
    assert f"{tmp_path / 'data' / 'eth3d'} is there, but not complete (pipes: " in said
    assert "Move it away and run again" in said


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ([], "name at least one dataset"),
        (["eth"], "There is no dataset 'eth'; known are eth3d,"),
        (["procedural-light"], "needs no download"),
    ],
)
def test_names_that_cannot_be_fetched(get, hub, names, said):
    code, _, error = get(*names)
    assert code == 2
    assert said in error
    assert hub.asked == []
