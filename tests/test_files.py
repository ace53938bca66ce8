"""Files appear whole or not at all, under names and rights as promised."""

import errno
import fcntl
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from freegeo import files
from freegeo.errors import FreeGeoError, UserError
from freegeo.files import LEDGER_FILE, atomic_folder, atomic_path, inside, keep_ledger, ledger, remove_written
from freegeo.lock import LOCK_FILE, locked
from test_lock import child


def names_in(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def test_file_appears_only_when_it_is_complete(tmp_path):
    file = tmp_path / "new" / "a.txt"
    with atomic_path(file) as part:
        part.write_text("whole")
        assert part.suffix == ".txt"
        assert not file.exists()
    assert file.read_text() == "whole"
    assert names_in(tmp_path) == {"new/a.txt"}


def test_failure_inside_the_block_keeps_the_old_file_and_leaves_nothing(tmp_path):
    file = tmp_path / "a.txt"
    file.write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_path(file) as part:
        part.write_text("half")
        raise KeyboardInterrupt
    assert file.read_text() == "old"
    assert names_in(tmp_path) == {"a.txt"}


def test_every_writer_reads_back_and_replaces(tmp_path):
    for value in (1.0, 2.0):
        files.write_json(tmp_path / "a.json", {"ö": value})
        files.write_npz(tmp_path / "a.npz", {"x": np.full(3, value)})
        files.write_tensors(tmp_path / "a.safetensors", {"x": torch.full((2, 3), value).T}, {"key": "text"})
    assert files.read_json(tmp_path / "a.json") == {"ö": 2.0}
    assert (np.load(tmp_path / "a.npz")["x"] == 2).all()
    from safetensors import safe_open

    with safe_open(tmp_path / "a.safetensors", framework="pt") as file:
        assert file.metadata() == {"key": "text"}
        assert torch.equal(file.get_tensor("x"), torch.full((3, 2), 2.0))
    assert names_in(tmp_path) == {"a.json", "a.npz", "a.safetensors"}


def test_files_are_readable_by_others_as_the_umask_says(tmp_path):
    before = os.umask(0o022)
    try:
        files.write_tensors(tmp_path / "a.safetensors", {"x": torch.zeros(1)})
    finally:
        os.umask(before)
    assert (tmp_path / "a.safetensors").stat().st_mode & 0o777 == 0o644


def test_damaged_json_names_the_file(tmp_path):
    (tmp_path / "a.json").write_text('{"half": ')
    with pytest.raises(FreeGeoError, match=r"a\.json: damaged file"):
        files.read_json(tmp_path / "a.json")


def test_folder_that_cannot_be_written_to_is_one_sentence(tmp_path, monkeypatch):
    def refuse(*args, **options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(UserError, match="cannot be written to"), atomic_path(tmp_path / "x" / "a.txt") as part:
        part.write_text("never")


def test_a_full_disk_names_the_file_that_was_asked_for(tmp_path):
    path = tmp_path / "result.json"
    with pytest.raises(OSError, match="No space left") as caught, atomic_path(path) as part:
        part.write_text("half")
        raise OSError(28, "No space left on device")
    assert caught.value.filename == str(path)
    assert list(tmp_path.iterdir()) == []


# -- folders


def written_folder(folder: Path, *names: str) -> None:
    with atomic_folder(folder) as part:
        for name in names:
            (part / name).parent.mkdir(parents=True, exist_ok=True)
            (part / name).write_text(name)


def test_folder_appears_only_when_it_is_complete(tmp_path):
    with atomic_folder(tmp_path / "deep" / "model") as part:
        (part / "a.bin").write_text("a")
        assert not (tmp_path / "deep" / "model").exists()
    assert names_in(tmp_path) == {"deep/model/a.bin"}


@pytest.mark.parametrize("noted", [True, False])
def test_folder_replaces_what_was_written_before_and_spares_other_files(tmp_path, noted):
    if noted:
        keep_ledger(tmp_path)
    written_folder(tmp_path / "model", "a.bin", "old.bin", "deep/old.bin")
    (tmp_path / "model" / "mine.txt").write_text("mine")
    written_folder(tmp_path / "model", "a.bin", "new.bin")
    # Without a ledger nobody knows whose the other files are.
    left = set() if noted else {"model/old.bin", "model/deep/old.bin"}
    assert names_in(tmp_path) - {LEDGER_FILE} == {"model/a.bin", "model/new.bin", "model/mine.txt"} | left
    assert (tmp_path / "model" / "deep").exists() != noted


def test_what_somebody_else_put_there_is_not_replaced(tmp_path):
    keep_ledger(tmp_path)
    for path in (tmp_path / "a.bin", tmp_path / "model" / "a.bin"):
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    with pytest.raises(UserError, match="freegeo did not write it"):
        written_folder(tmp_path / "model", "a.bin", "b.bin")
    with pytest.raises(UserError, match="freegeo did not write it"), atomic_path(tmp_path / "a.bin") as part:
        part.write_text("new")
    assert names_in(tmp_path) == {LEDGER_FILE, "a.bin", "model/a.bin"}
    assert (tmp_path / "a.bin").read_text() == (tmp_path / "model" / "a.bin").read_text() == "mine"


def test_failure_while_a_folder_is_written_keeps_the_old_one(tmp_path):
    keep_ledger(tmp_path)
    written_folder(tmp_path / "model", "a.bin")
    with pytest.raises(RuntimeError), atomic_folder(tmp_path / "model") as part:
        (part / "a.bin").write_text("half")
        raise RuntimeError
    assert (tmp_path / "model" / "a.bin").read_text() == "a.bin"
    assert names_in(tmp_path) == {LEDGER_FILE, "model/a.bin"}


def test_a_stop_between_old_and_new_never_leaves_a_mixture(tmp_path, monkeypatch):
    keep_ledger(tmp_path)
    written_folder(tmp_path / "model", "a.bin", "b.bin")
    plain, moved = Path.replace, []

    def replace_one(path, target):
        moved.extend([target] if target.suffix == ".bin" else [])
        if len(moved) == 2:
            raise KeyboardInterrupt
        return plain(path, target)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt), atomic_folder(tmp_path / "model") as part:
        for name in ("a.bin", "b.bin"):
            (part / name).write_text("new")
        patch.setattr(Path, "replace", replace_one)
    assert names_in(tmp_path) == {LEDGER_FILE, "model/a.bin"}
    assert (tmp_path / "model" / "a.bin").read_text() == "new"


def test_a_scratch_folder_is_empty_and_what_a_killed_process_left_in_it_goes(tmp_path):
    out = tmp_path / "out"
    keep_ledger(out)
    folder = files.scratch_folder(out / "adapter", "samples")
    (folder / "0.bin").write_text("")
    assert list(files.scratch_folder(out / "adapter", "samples").iterdir()) == []
    (folder / "0.bin").write_text("")
    files.remove_parts(out)
    assert names_in(out) == {LEDGER_FILE}
    assert not (out / "adapter").exists()


def test_a_scratch_folder_is_made_in_a_folder_and_not_outside(tmp_path):
    out = tmp_path / "out"
    keep_ledger(out)
    (tmp_path / "outside").mkdir()
    (out / "link").symlink_to(tmp_path / "outside")
    (out / "file").write_text("")
    for place, sentence in (("link", "leads out of the output folder"), ("file", "cannot be written to")):
        with pytest.raises(UserError, match=sentence):
            files.scratch_folder(out / place, "samples")
    assert list((tmp_path / "outside").iterdir()) == []


# -- the ledger, and places outside the folder


def test_what_was_written_is_removed_and_no_other_file(tmp_path):
    keep_ledger(tmp_path)
    for name in ("a.json", "maps/a.json", "maps/b.json", "maps2/a.json"):
        files.write_json(tmp_path / name, 1)
    (tmp_path / "maps" / "mine.txt").write_text("")
    remove_written(tmp_path / "maps", keep=[tmp_path / "maps" / "b.json"])
    assert names_in(tmp_path) == {LEDGER_FILE, "a.json", "maps/b.json", "maps2/a.json", "maps/mine.txt"}
    remove_written(tmp_path / "maps2")
    assert not (tmp_path / "maps2").exists()
    (tmp_path / "a.json").unlink()
    remove_written(tmp_path / "a.json")
    (tmp_path / "a.json").write_text("mine now")
    remove_written(tmp_path / "a.json")
    assert (tmp_path / "a.json").read_text() == "mine now"


def test_names_with_odd_characters_come_back_from_the_ledger(tmp_path):
    keep_ledger(tmp_path)
    names = ["zoë 客厅.json", "a\u2028b.json", "a\x85b.json", os.fsdecode(b"caf\xe9.json")]
    for name in names:
        files.write_json(tmp_path / name, 1)
    assert set(names) <= set(ledger(tmp_path))
    for name in names:
        remove_written(tmp_path / name)
    assert names_in(tmp_path) == {LEDGER_FILE}


@pytest.mark.parametrize(
    "name",
    ["", ".", "..", "../a", "a/../../b", "/etc/a", "a\nb", "a\x00b", "a\rb", "a/../b", "\ud800.png", "d" * 256 + "/a"],
)
def test_names_that_lead_out_are_refused(tmp_path, name):
    with pytest.raises(UserError, match="cannot be the name of a file below"):
        inside(tmp_path, name)


def test_names_that_only_look_odd_are_not(tmp_path):
    for name in ("a/b.png", "..a", "a..b/c", "~", "-x"):
        assert inside(tmp_path, name).is_relative_to(tmp_path)


@pytest.mark.parametrize("own", [LEDGER_FILE, LOCK_FILE])
@pytest.mark.parametrize("exists", [True, False])
def test_own_files_that_are_links_are_not_written_through(tmp_path, own, exists):
    out, victim = tmp_path / "out", tmp_path / "victim"
    out.mkdir()
    (out / own).symlink_to(victim)
    if exists:
        victim.write_text("mine")

    def write():
        with locked(out):
            keep_ledger(out)
            files.write_json(out / "a.json", 1)

    with pytest.raises(UserError, match=f"{own}: is a symbolic link"):
        write()
    assert victim.exists() == exists
    assert not exists or victim.read_text() == "mine"


@pytest.mark.parametrize("way", ["link", "link above", "dots"])
def test_nothing_is_written_through_a_way_out_of_the_folder(tmp_path, way):
    out, outside = tmp_path / "out", tmp_path / "outside"
    outside.mkdir()
    keep_ledger(out)
    place = out / "maps"
    if way == "link":
        place.symlink_to(outside)
    elif way == "link above":
        (out / "deep").symlink_to(tmp_path)
        place = out / "deep" / "outside"
    else:
        place = out / "maps" / ".." / ".." / "outside"
    for write in (lambda: files.write_json(place / "a.json", 1), lambda: written_folder(place, "a.json")):
        if way == "dots":
            (out / "maps").mkdir(exist_ok=True)
        with pytest.raises(UserError, match="leads out of the output folder"):
            write()
    assert list(outside.iterdir()) == []


def test_a_folder_that_became_a_link_is_not_followed_when_files_are_removed(tmp_path):
    out, outside = tmp_path / "out", tmp_path / "outside"
    keep_ledger(out)
    files.write_json(out / "maps" / "a.json", 1)
    (out / "maps").rename(outside)
    (out / "maps").symlink_to(outside)
    remove_written(out / "maps")
    assert names_in(outside) == {"a.json"}


def test_an_empty_folder_behind_a_link_stays(tmp_path):
    out, outside = tmp_path / "out", tmp_path / "outside"
    (outside / "sub").mkdir(parents=True)
    keep_ledger(out)
    files.write_json(out / "a.json", 1)
    (out / "link").symlink_to(outside)
    with (out / LEDGER_FILE).open("a") as file:
        file.write("link/sub/x\nlink/sub\nlink\n")
    remove_written(out / "link")
    assert (outside / "sub").is_dir()
    assert not (out / "link").is_symlink()


def test_links_and_ways_inside_the_folder_are_allowed(tmp_path):
    out = tmp_path / "out"
    keep_ledger(out)
    (out / "real").mkdir()
    (out / "maps").symlink_to(out / "real")
    files.write_json(out / "maps" / "a.json", 1)
    files.write_json(out / "maps" / ".." / "b.json", 1)
    assert {"real/a.json", "b.json"} <= set(ledger(out))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.symlink_to(out)
    files.write_json(elsewhere / "c.json", 1)
    remove_written(out / "real")
    assert names_in(out) == {LEDGER_FILE, "b.json", "c.json"}


@pytest.mark.parametrize("length", [250, 255])
def test_names_as_long_as_a_file_may_have_can_be_written(tmp_path, length):
    for letter, suffix in (("x", ".json"), ("客", ".json"), ("x", "." + "y" * 100)):
        room = length - len(suffix)
        name = letter * (room // len(letter.encode())) + suffix
        files.write_json(tmp_path / name, 1)
        assert files.read_json(tmp_path / name) == 1


def test_a_process_that_is_killed_while_it_writes_tensors_leaves_nothing_that_is_not_listed(tmp_path, monkeypatch):
    """The library writes to a temporary name of its own first."""
    files.start_ledger(tmp_path)
    left = []

    def stopped(tensors, file, metadata):
        (Path(file).parent / ".tmpx").touch()
        left.extend(path.relative_to(tmp_path).parts[0] for path in tmp_path.rglob(".tmpx"))

    with monkeypatch.context() as patch:
        patch.setattr("safetensors.torch.save_file", stopped)
        with pytest.raises(FileNotFoundError):
            files.write_tensors(tmp_path / "a.safetensors", {"x": torch.zeros(1)})
    assert left
    assert set(left) <= set(files.ledger(tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == [files.LEDGER_FILE]


def test_half_written_files_in_a_shared_folder_go_when_nobody_else_writes_there(tmp_path):
    writer = child(f"""
from freegeo.files import atomic_path, shared_folder
folder = Path({str(tmp_path)!r})
with shared_folder(folder), atomic_path(folder / "1.npz") as part:
    part.write_text("half")
    print("READY", flush=True)
    time.sleep(60)
""")
    (tmp_path / "mine.part").write_text("")
    try:
        with files.shared_folder(tmp_path):
            files.write_json(tmp_path / "2.json", 1)
        assert len(names_in(tmp_path)) == 3
    finally:
        writer.kill()
        writer.wait()
    with files.shared_folder(tmp_path):
        assert names_in(tmp_path) == {"mine.part", "2.json"}


def test_a_shared_folder_that_cannot_be_locked_is_written_to(tmp_path, monkeypatch):
    def refuse(*arguments):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with files.shared_folder(tmp_path / "new"):
        files.write_json(tmp_path / "new" / "2.json", 1)
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"), files.shared_folder(tmp_path / "file"):
        files.write_json(tmp_path / "file" / "2.json", 1)


def test_way_is_made_for_a_file_that_freegeo_wrote_and_for_no_other(tmp_path):
    keep_ledger(tmp_path)
    outside = tmp_path / "outside"
    for name in ("new.log", "own.log"):
        files.make_way(tmp_path / name)
        assert not (tmp_path / name).exists()
    (tmp_path / "own.log").write_text("first")
    files.make_way(tmp_path / "own.log")
    assert not (tmp_path / "own.log").exists()
    (tmp_path / "mine.log").write_text("mine")
    (tmp_path / "link.log").symlink_to(outside)
    for name in ("mine.log", "link.log"):
        with pytest.raises(UserError, match="freegeo did not"):
            files.make_way(tmp_path / name)
    assert (tmp_path / "mine.log").read_text() == "mine" and not outside.exists()
    assert {"new.log", "own.log"} <= set(ledger(tmp_path))
