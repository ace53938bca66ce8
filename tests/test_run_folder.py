"""Output folders are locked, continued, refused and replaced as promised."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from freegeo import files
from freegeo.errors import FreeGeoError, UserError
from freegeo.files import LEDGER_FILE, RUN_FILE, atomic_path, write_json
from freegeo.lock import LOCK_FILE, locked
from freegeo.run_folder import Part, check_folder, difference, run_folder, stored_state
from test_lock import child

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
    assert (stored_state(tmp_path) or {})["clearing"]
    with run_folder(tmp_path, SETTINGS) as run:
        assert not run.finished
    with run_folder(tmp_path, {}, overwrite=True):
        assert "clearing" not in (stored_state(tmp_path) or {})


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


def test_folders_without_files_are_no_files(tmp_path):
    """A process whose output folder is removed at a bad moment may leave such, and they are in nobody's way."""
    (tmp_path / "a" / "b").mkdir(parents=True)
    check_folder(tmp_path, SETTINGS, overwrite=False)
    (tmp_path / "a" / "b" / "link").symlink_to(tmp_path / "nothing")
    with pytest.raises(UserError, match="did not write"):
        check_folder(tmp_path, SETTINGS, overwrite=False)


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


# -- a folder that is changed behind its holder's back


def deleted(out: Path) -> None:
    shutil.rmtree(out)


def made_anew(out: Path) -> None:
    shutil.rmtree(out)
    out.mkdir()


def moved_away(out: Path) -> None:
    out.rename(out.with_name("moved"))


def replaced_by_a_link(out: Path) -> None:
    out.rename(out.with_name("moved"))
    (out.parent / "other").mkdir()
    out.symlink_to(out.parent / "other")


def made_anew_by_another_process(out: Path) -> None:
    shutil.rmtree(out)
    holder = child(f"""
import os
from freegeo.run_folder import run_folder
with run_folder(Path({str(out)!r}), {{"other": 1}}) as run:
    print("READY", flush=True)
    os.kill(os.getpid(), 9)
""")
    holder.wait()


TAKEN_AWAY = (deleted, made_anew, moved_away, replaced_by_a_link, made_anew_by_another_process)
DOES = {
    "file": lambda run: write_json(run / "b.json", 1),
    "folder": lambda run: files.atomic_folder(run / "model").__enter__(),
    "removal": lambda run: files.remove_file(run / "a.json"),
    "note": lambda run: run.note("x", 1),
    "finish": lambda run: run.finish(),
}


def tree(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("taken_away", TAKEN_AWAY)
@pytest.mark.parametrize("does", DOES)
def test_a_run_whose_folder_is_taken_away_stops_and_changes_nothing_there(tmp_path, taken_away, does):
    out = tmp_path / "out"
    gone = pytest.raises(FreeGeoError, match="was removed or replaced while freegeo was writing")
    with gone, run_folder(out, SETTINGS) as run:
        write_json(run / "a.json", 1)
        taken_away(out)
        there = tree(tmp_path)
        DOES[does](run)
    assert tree(tmp_path) == there
    assert out.exists() == (taken_away not in (deleted, moved_away))


def test_a_folder_that_vanishes_while_a_file_is_written(tmp_path):
    out = tmp_path / "out"
    gone = pytest.raises(FreeGeoError, match="was removed or replaced")
    with gone, run_folder(out, SETTINGS) as run, atomic_path(run / "a.txt") as part:
        part.write_text("half")
        shutil.rmtree(out)
    assert not out.exists()


def test_two_writers_are_impossible_after_a_re_creation(tmp_path):
    out = tmp_path / "out"
    with pytest.raises(FreeGeoError, match="was removed or replaced"), run_folder(out, SETTINGS) as run:
        shutil.rmtree(out)
        code = f"""
from freegeo.run_folder import run_folder
with run_folder(Path({str(out)!r}), {{"other": 1}}) as run:
    print("READY", flush=True)
    time.sleep(60)
"""
        second = child(code)
        try:
            before = tree(out)
            write_json(run / "a.json", 1)
        finally:
            after = tree(out)
            with pytest.raises(UserError, match="another freegeo process"), locked(out):
                pass
            second.kill()
            second.wait()
    assert after == before
    assert (out / LOCK_FILE).exists(), "the first must not remove the lock of the second"


@pytest.mark.parametrize("name", ["frozen/a.json", LEDGER_FILE, RUN_FILE])
def test_a_result_that_lost_a_file_is_not_finished_and_the_same_run_repairs_it(tmp_path, name):
    def run_it(lose: bool) -> None:
        with run_folder(tmp_path, SETTINGS) as run:
            for own in ("frozen/a.json", "b.json"):
                if not (run / own).is_file():
                    write_json(run / own, own)
            if lose:
                (tmp_path / name).unlink()
            run.finish()

    with pytest.raises(FreeGeoError, match=r"was removed while freegeo was writing there.*run the command again"):
        run_it(lose=True)
    if name != RUN_FILE:
        run_it(lose=False)
        assert visible(tmp_path) == {"frozen/a.json", "b.json"}


def test_what_the_run_removes_itself_is_not_missed(tmp_path):
    with run_folder(tmp_path, SETTINGS) as run:
        for name in ("a.json", "deep/b.json", "c.json", "model/d.json"):
            write_json(run / name, 1)
        files.remove_file(run / "a.json")
        files.remove_written(run / "deep")
        with files.atomic_folder(run / "model") as part:
            (part / "e.json").write_text("1")
        run.finish()
    assert visible(tmp_path) == {"c.json", "model/e.json"}


def test_files_that_a_run_would_take_for_its_own_are_in_the_way(tmp_path):
    """Without its ledger a run does not know what it wrote: it must not label an adapter of before as a new one."""
    staged(tmp_path)
    (tmp_path / LEDGER_FILE).unlink()
    other = {**STAGED, "train": {"lr": 2}}
    in_the_way = pytest.raises(UserError, match=r"adapter/weights: freegeo did not write it")
    with in_the_way, run_folder(tmp_path, other, parts=PARTS, overwrite=True):
        pass
    assert visible(tmp_path) == STAGED_FILES


def test_what_a_killed_run_kept_on_disk_is_not_in_the_way(tmp_path):
    staged(tmp_path, finish=False)
    (files.scratch_folder(tmp_path / "adapter", "samples") / "0.bin").write_text("")
    with run_folder(tmp_path, {**STAGED, "train": {"lr": 2}}, parts=PARTS, overwrite=True):
        assert visible(tmp_path) == set()
        assert not (tmp_path / "adapter").exists()


# -- killed at any moment

DRIVER = """
import json, os, shutil, sys
from pathlib import Path
from freegeo.files import atomic_folder, write_json
from freegeo.run_folder import Part, run_folder

PARTS = (Part("train", ("adapter/",)), Part("filter", ("",), free=True))
EVENTS = {"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.utime", "os.chmod"}
place, step = Path(sys.argv[1]), int(sys.argv[2])
os.fsync = lambda file: None  # only the order of operations matters here

def command(out, train, share, overwrite=False):
    with run_folder(out, {"train": train, "filter": share}, parts=PARTS, overwrite=overwrite) as run:
        if run.finished:
            return
        if not (run / "adapter/weights.json").is_file():
            write_json(run / "adapter/weights.json", train)
            run.note("train", train)
        with atomic_folder(run / "model") as part:
            (part / "a.bin").write_text(f"{train} {share}")
            (part / f"{share}.bin").write_text("x")
        write_json(run / "points.json", [train, share])
        run.finish()

def tree(out):
    names = {p.relative_to(out).as_posix(): p for p in out.rglob("*") if p.name != ".freegeo-files"}
    return {name: json.loads(p.read_text())["settings"] if p.name == ".freegeo-run.json" else p.read_text()
            for name, p in names.items() if p.is_file()}

def in_child(work, kill_at=None):
    child = os.fork()
    if child == 0:
        count = [0]
        def hook(event, arguments):
            if event in EVENTS and str(place) in str(arguments[0]):
                count[0] += 1
                if count[0] == kill_at:
                    os.kill(os.getpid(), 9)
        if kill_at:
            sys.addaudithook(hook)
        try:
            work()
        except BaseException as error:
            print("FAILED", repr(error), file=sys.stderr, flush=True)
            os._exit(1)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

stages = {
    "first": lambda out: command(out, 1, 1),
    "free part": lambda out: command(out, 1, 2),
    "overwrite": lambda out: command(out, 2, 2, overwrite=True),
}
told = {}
before = None
for number, (name, stage) in enumerate(stages.items()):
    whole = place / f"{number}-whole"
    if before:
        shutil.copytree(before, whole)
    in_child(lambda: stage(whole))
    points = int(sys.argv[3]) - step
    while True:
        points += step
        out = place / f"{number}-{points}"
        if before:
            shutil.copytree(before, out)
        if in_child(lambda: stage(out), kill_at=points) == 0:
            break
        code = in_child(lambda: stage(out))
        if code or tree(out) != tree(whole):
            print(json.dumps([name, points, code, sorted(tree(out))]))
            sys.exit("not as without the kill")
    told[name] = points // step
    before = whole
print(json.dumps(told))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize("step", [pytest.param(1, marks=pytest.mark.slow), 8])
def test_a_kill_at_any_operation_is_followed_by_the_same_result(tmp_path, step):
    """Each operation on a file of a run, of a change of a free part, and of `overwrite`; every `step`-th of them."""
    arguments = [sys.executable, "-c", DRIVER, str(tmp_path), str(step), str(min(step, 5))]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    kills = json.loads(done.stdout)
    assert min(kills.values()) * step >= 56, kills
