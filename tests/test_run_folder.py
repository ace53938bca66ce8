"""Output folders are locked, continued, refused and replaced as promised."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from freegeo import files
from freegeo.errors import FreeGeoError, UserError
from freegeo.files import LEDGER_FILE, LOCK_FILE, RUN_FILE, atomic_path, write_json
from freegeo.run_folder import Part, check_folder, difference, locked, run_folder

SETTINGS = {"model": "tiny", "recipe": {"steps": 2, "keep": (0, 2)}, "seed": 1}
HIDDEN = {RUN_FILE, LOCK_FILE, LEDGER_FILE}


def visible(folder: Path) -> set[str]:
    names = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    return names - HIDDEN


def result(folder: Path, settings=SETTINGS, text="first", **options) -> None:
    with run_folder(folder, settings, **options) as run:
        write_json(run / "result.json", text)
        write_json(run / "deep" / "part.json", text)
        run.finish()


def child(code: str) -> subprocess.Popen:
    """Start Python on a few lines; it says READY when they have got that far."""
    code = "import time\nfrom pathlib import Path\n" + code
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "READY\n"
    return process


# -- lock


def test_second_process_is_refused_and_the_lock_dies_with_its_holder(tmp_path):
    code = f"""
from freegeo.run_folder import locked
with locked(Path({str(tmp_path)!r})):
    print("READY", flush=True)
    time.sleep(60)
"""
    holder = child(code)
    try:
        with pytest.raises(UserError, match="another freegeo process"), locked(tmp_path):
            pass
    finally:
        holder.send_signal(signal.SIGKILL)
        holder.wait()
    with locked(tmp_path):
        assert (tmp_path / LOCK_FILE).exists()
    assert not (tmp_path / LOCK_FILE).exists()


def test_lock_is_released_after_an_error(tmp_path):
    with pytest.raises(RuntimeError), locked(tmp_path):
        raise RuntimeError
    with locked(tmp_path):
        pass


@pytest.mark.parametrize("place", ["file", "file/below"])
def test_lock_in_a_place_that_is_no_folder(tmp_path, place):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written to"), locked(tmp_path / place):
        pass


# -- run folders


@pytest.mark.parametrize("exists", [False, True])
def test_new_or_empty_folder_is_started_and_finished(tmp_path, exists):
    folder = tmp_path / "out"
    if exists:
        folder.mkdir()
    with run_folder(folder, SETTINGS) as run:
        assert not run.finished
        assert json.loads((folder / RUN_FILE).read_text())["settings"]["recipe"]["keep"] == [0, 2]
        write_json(run / "a.json", 1)
        run.finish()
    with run_folder(folder, SETTINGS) as run:
        assert run.finished
        assert run.finished_at is not None and run.finished_at.startswith("20")
    assert visible(folder) == {"a.json"}


def test_unfinished_run_goes_on_with_its_parts(tmp_path):
    with pytest.raises(KeyboardInterrupt), run_folder(tmp_path, SETTINGS) as run:
        write_json(run / "a.json", 1)
        raise KeyboardInterrupt
    with run_folder(tmp_path, SETTINGS) as run:
        assert not run.finished
        assert (run / "a.json").is_file()


@pytest.mark.parametrize("finish", [False, True])
def test_other_settings_are_refused_by_name_and_nothing_changes(tmp_path, finish):
    with run_folder(tmp_path, SETTINGS) as run:
        write_json(run / "a.json", 1)
        if finish:
            run.finish()
    other = {**SETTINGS, "seed": 2, "recipe": {"steps": 3, "keep": [0, 2]}, "new": None}
    with pytest.raises(UserError) as caught, run_folder(tmp_path, other):
        pass
    message = str(caught.value)
    assert ("finished result" if finish else "unfinished run") in message
    assert "seed: 1 there, 2 now" in message and "recipe.steps: 2 there, 3 now" in message
    assert "keep" not in message and "--overwrite" in message and "\n" not in message
    assert visible(tmp_path) == {"a.json"}
    check_folder(tmp_path, SETTINGS, overwrite=False)


def test_differences_are_named_with_their_place():
    before, now = {"recipe": {"lr": 1, "rank": 4}, "model": "a"}, {"recipe": {"lr": 2, "rank": 4}, "model": "a"}
    assert difference(before, now) == "recipe.lr: 1 there, 2 now"
    assert difference({"adaptation": None}, {"adaptation": {"per": "scene"}}) == "adaptation: none there, given now"
    assert difference(now, now) == ""


def test_many_differences_are_cut_short(tmp_path):
    result(tmp_path, {str(k): k for k in range(9)})
    with pytest.raises(UserError, match="; and 5 more"):
        check_folder(tmp_path, {str(k): -1 - k for k in range(9)}, overwrite=False)


def test_settings_that_appear_or_vanish_are_named_not_spelled_out(tmp_path):
    result(tmp_path, {"recipe": {"name": "scene", "steps": 2}, "adapter": None})
    with pytest.raises(UserError, match="adapter: none there, given now; recipe: 'scene' there, none now"):
        check_folder(tmp_path, {"recipe": None, "adapter": {"folder": "x"}}, overwrite=False)


def test_overwrite_removes_what_freegeo_wrote_and_nothing_else(tmp_path):
    result(tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "deep" / "mine.txt").write_text("mine too")
    (tmp_path / "mine").mkdir()
    with run_folder(tmp_path, {"other": 1}, overwrite=True) as run:
        assert visible(tmp_path) == {"notes.txt", "deep/mine.txt"}
        assert (tmp_path / "mine").is_dir()
        write_json(run / "second.json", 1)
        run.finish()
    assert visible(tmp_path) == {"notes.txt", "deep/mine.txt", "second.json"}


def test_overwrite_of_an_unfinished_run_keeps_the_users_files(tmp_path):
    with pytest.raises(KeyboardInterrupt), run_folder(tmp_path, SETTINGS) as run:
        write_json(run / "inner" / "a.json", 1)
        raise KeyboardInterrupt
    (tmp_path / "notes.txt").write_text("mine")
    with run_folder(tmp_path, {}, overwrite=True):
        assert visible(tmp_path) == {"notes.txt"}
        assert not (tmp_path / "inner").exists()


def test_overwrite_with_the_same_settings_starts_anew(tmp_path):
    result(tmp_path)
    with run_folder(tmp_path, SETTINGS, overwrite=True) as run:
        assert not run.finished
        assert visible(tmp_path) == set()


def test_files_added_to_a_finished_folder_by_freegeo_go_with_it(tmp_path):
    result(tmp_path)
    write_json(tmp_path / "later.json", "made from the old result")
    with run_folder(tmp_path, {}, overwrite=True):
        assert visible(tmp_path) == set()


def test_result_inside_another_result_is_a_result_of_its_own(tmp_path):
    result(tmp_path)
    result(tmp_path / "inner")
    with run_folder(tmp_path, {}, overwrite=True):
        assert visible(tmp_path) == {"inner/result.json", "inner/deep/part.json"} | {
            f"inner/{name}" for name in (RUN_FILE, LEDGER_FILE)
        }


PARTS = (
    Part("train", ("adapter/",)),
    Part("predict", ("prediction.npz",)),
    Part("filter", ("",), free=True),
    Part("formats", (), free=True),
)
STAGED = {
    "command": "run",
    "train": {"lr": 1},
    "predict": {"rule": "first"},
    "filter": {"share": 0.4},
    "formats": ["a"],
}
STAGED_FILES = {"adapter/weights", "prediction.npz", "adapter.txt", "points.ply", "frozen/points.ply"}


def staged(folder: Path, *, finish: bool = True) -> None:
    with run_folder(folder, STAGED, parts=PARTS) as run:
        for name in STAGED_FILES:
            write_json(run / name, name)
        run.note("train", 5)
        run.note("predict", 6)
        if finish:
            run.finish()


@pytest.mark.parametrize("finish", [False, True])
@pytest.mark.parametrize(
    ("part", "value", "kept"),
    [
        ("filter", {"share": 0.1}, {"adapter/weights", "prediction.npz"}),
        ("formats", ["a", "b"], STAGED_FILES),
    ],
)
def test_a_free_part_may_change_and_only_what_depends_on_it_goes(tmp_path, part, value, kept, finish):
    staged(tmp_path, finish=finish)
    (tmp_path / "notes.txt").write_text("mine")
    changed = {**STAGED, part: value}
    with run_folder(tmp_path, changed, parts=PARTS) as run:
        assert not run.finished
        assert visible(tmp_path) == kept | {"notes.txt"}
        assert run.notes == {"train": 5, "predict": 6}
        run.finish()
    with run_folder(tmp_path, changed, parts=PARTS) as run:
        assert run.finished
    # What was kept is still freegeo's own.
    with run_folder(tmp_path, {"command": "other"}, parts=PARTS, overwrite=True):
        assert visible(tmp_path) == {"notes.txt"}


def test_other_parts_need_overwrite_which_removes_what_depends_on_them(tmp_path):
    staged(tmp_path)
    changed = {**STAGED, "predict": {"rule": "middle"}, "filter": {"share": 0.1}}
    with pytest.raises(UserError, match='--reference: "first" there, "middle" now'):
        check_folder(tmp_path, changed, overwrite=False, parts=PARTS, labels={"rule": "--reference"})
    assert visible(tmp_path) == STAGED_FILES
    with run_folder(tmp_path, changed, parts=PARTS, overwrite=True) as run:
        assert visible(tmp_path) == {"adapter/weights"}
        assert run.notes == {"train": 5}


@pytest.mark.parametrize("change", [{}, {"command": "reconstruct"}, {"train": {"lr": 2}}, {"room": 3}])
def test_overwrite_starts_anew_when_the_first_part_or_nothing_differs(tmp_path, change):
    staged(tmp_path)
    with run_folder(tmp_path, {**STAGED, **change}, parts=PARTS, overwrite=True) as run:
        assert visible(tmp_path) == set()
        assert run.notes == {}


def test_labels_stand_for_names_of_settings():
    before, now = {"x": {"seed": 1, "contents": "abc"}, "y": {"contents": "a"}}, {"x": {"seed": 2}, "y": {}}
    labels = {"seed": "--seed", "contents": "other photos"}
    assert difference(before, now, labels) == "other photos; --seed: 1 there, 2 now"


def test_ledger_never_leads_out_of_the_folder(tmp_path):
    folder, outside = tmp_path / "out", tmp_path / "outside.txt"
    outside.write_text("mine")
    result(folder)
    with (folder / LEDGER_FILE).open("a") as file:
        file.write(f"../outside.txt\n{outside}\n")
    with run_folder(folder, {}, overwrite=True):
        assert outside.read_text() == "mine"


def test_removal_that_is_cut_short_does_not_pass_for_a_finished_result(tmp_path, monkeypatch):
    result(tmp_path)

    plain = Path.unlink

    def unlink_and_stop(path, **options):
        plain(path, **options)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", unlink_and_stop)
        with pytest.raises(KeyboardInterrupt), run_folder(tmp_path, {}, overwrite=True):
            pass
    with run_folder(tmp_path, SETTINGS) as run:
        assert not run.finished


def test_refused_block_leaves_no_trace(tmp_path):
    with pytest.raises(UserError, match="no"), run_folder(tmp_path / "out", SETTINGS):
        raise UserError("no")
    assert not (tmp_path / "out").exists()
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError), run_folder(tmp_path / "empty", SETTINGS):
        raise UserError("no")
    assert list((tmp_path / "empty").iterdir()) == []


def test_failure_keeps_what_was_written(tmp_path):
    with pytest.raises(FreeGeoError), run_folder(tmp_path, SETTINGS) as run:
        write_json(run / "a.json", 1)
        raise FreeGeoError("the loss is NaN")
    with run_folder(tmp_path, SETTINGS) as run:
        assert (run / "a.json").is_file()


@pytest.mark.parametrize("overwrite", [False, True])
def test_foreign_folder_is_never_touched(tmp_path, overwrite):
    (tmp_path / "holiday.txt").write_text("mine")
    with pytest.raises(UserError, match="did not write"), run_folder(tmp_path, SETTINGS, overwrite=overwrite):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ["holiday.txt"]


@pytest.mark.parametrize("place", ["file", "file/below"])
def test_file_in_the_way(tmp_path, place):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(UserError, match=r"is a file|cannot be written"), run_folder(tmp_path / place, SETTINGS):
        pass
    assert (tmp_path / "file").read_text() == "mine"


def test_folder_without_write_permission(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(UserError, match="cannot be written to"):
        check_folder(tmp_path / "out", SETTINGS, overwrite=False)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("overwrite", [False, True])
def test_newer_format_is_left_alone(tmp_path, overwrite):
    result(tmp_path)
    state = json.loads((tmp_path / RUN_FILE).read_text())
    (tmp_path / RUN_FILE).write_text(json.dumps({**state, "format": files.FORMAT + 1}))
    with pytest.raises(UserError, match="newer freegeo"), run_folder(tmp_path, SETTINGS, overwrite=overwrite):
        pass
    assert visible(tmp_path) == {"result.json", "deep/part.json"}


@pytest.mark.parametrize("text", ["[1]", "{}", "not json"])
def test_damaged_state_is_an_error_with_the_files_name(tmp_path, text):
    (tmp_path / RUN_FILE).write_text(text)
    with pytest.raises(FreeGeoError, match=RUN_FILE), run_folder(tmp_path, SETTINGS):
        pass


def test_killed_process_leaves_the_old_file_and_its_half_file_is_cleared_away(tmp_path):
    code = f"""
from freegeo.files import atomic_path, write_json
from freegeo.run_folder import run_folder
with run_folder(Path({str(tmp_path)!r}), {{"a": 1}}) as run:
    write_json(run / "deep" / "a.json", "old")
    with atomic_path(run / "deep" / "a.json") as part:
        part.write_text("half")
        print("READY", flush=True)
        time.sleep(60)
"""
    process = child(code)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert files.read_json(tmp_path / "deep" / "a.json") == "old"
    assert len(visible(tmp_path)) == 2
    with run_folder(tmp_path, {"a": 1}) as run:
        assert not run.finished
        assert visible(tmp_path) == {"deep/a.json"}


@pytest.mark.parametrize("overwrite", [False, True])
def test_killed_process_leaves_the_old_folder_and_its_half_folder_is_cleared_away(tmp_path, overwrite):
    code = f"""
from freegeo.files import atomic_folder, atomic_path
from freegeo.run_folder import run_folder
with run_folder(Path({str(tmp_path)!r}), {{"a": 1}}) as run:
    with atomic_folder(run / "colmap" / "0") as part:
        (part / "a.bin").write_text("old")
    with atomic_folder(run / "colmap" / "0") as part, atomic_path(run / "first" / "b.txt") as file:
        (part / "a.bin").write_text("half")
        file.write_text("half")
        print("READY", flush=True)
        time.sleep(60)
"""
    process = child(code)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert len(visible(tmp_path)) == 3
    (tmp_path / "colmap" / "mine.part").write_text("mine")
    with run_folder(tmp_path, {"a": 1}, overwrite=overwrite):
        assert visible(tmp_path) == {"colmap/mine.part"} | (set() if overwrite else {"colmap/0/a.bin"})
        assert overwrite or (tmp_path / "colmap" / "0" / "a.bin").read_text() == "old"
        assert not (tmp_path / "first").exists()


def test_a_block_that_is_refused_while_it_writes_leaves_no_trace(tmp_path):
    out = tmp_path / "out"
    with pytest.raises(UserError, match="no"), run_folder(out, SETTINGS), atomic_path(out / "a.txt"):
        raise UserError("no")
    assert not (tmp_path / "out").exists()
