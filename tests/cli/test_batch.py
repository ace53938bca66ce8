"""`freegeo batch`: names and refusals, options that reach every scene, what is written, deaths of workers."""

import math
import os
import shutil
import socket
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import fields, is_dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from cli.conftest import QUICK
from freegeo import pools
from freegeo.cli import console
from freegeo.cli.app import build
from freegeo.cli.batch import (
    RECORD_NAME,
    SETTINGS,
    _in_worker,
    _Table,
    _Work,
    as_arguments,
    environments,
    stored_rows,
)
from freegeo.cli.files import FileOptions, FilterOptions
from freegeo.cli.options import ModelOptions, PhotoOptions, PlacingOptions, RecipeOptions
from freegeo.cli.scenes import NamedScene, named_scenes
from freegeo.errors import UserError
from freegeo.files import read_json, write_json
from freegeo.report.overview import SceneRow, write_overview
from freegeo.run_folder import run_folder
from processes import kill_one, needs_proc

FROZEN = ["--no-adapt", "--refine", "off"]

# -- options


GIVEN = (
    ModelOptions(
        model="da3-giant", checkpoint=Path("/a b/c=d.pt"), device="cpu", precision="fp32", seed=-3, reference="first"
    ),
    RecipeOptions(
        recipe="paper", dataset="eth3d", views=6, keep="0,2,4", steps=7, epochs=2, sets=3, lr=1e-4, rank=8, hold=0.5,
        loss=("weight_kq=0", "selection=topk,angle_weights=2,2,2"),
    ),
    PhotoOptions(max_views=9, fps=1.5, skip_bad=True, mixed="pad", process_res=756),
    PlacingOptions(one_camera=False, scale="a.jpg:812,410 b.jpg:655,398 = 1.25"),
    FileOptions(
        formats=("ply", "mesh"), depth_size="photo",
        filters=FilterOptions(drop_share=0.1, flying=False, multi_view=False, min_agreeing=2, masks=Path("masks")),
    ),
)  # fmt: skip


@pytest.mark.parametrize("options", GIVEN, ids=lambda options: type(options).__name__)
def test_options_are_passed_on_as_they_are(options):
    """Every option is changed here; a new one that cannot be passed on fails."""

    def unchanged(options):
        values = {option.name: getattr(options, option.name) for option in fields(options)}
        inner = [name for value in values.values() if is_dataclass(value) for name in unchanged(value)]
        return [name for name, value in values.items() if value == getattr(type(options)(), name)] + inner

    assert unchanged(options) == []
    command = ["run", "photos", "--output=out", *as_arguments(options)]
    _, bound, *_ = build().parse_args(command, exit_on_error=False, print_error=False)
    assert options in bound.arguments.values()
    assert as_arguments(type(options)()) == []


# -- scenes and their names


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """Folders `a/images`, `b/images`, `c` and two videos, in the current folder."""
    monkeypatch.chdir(tmp_path)
    for name in ("a/images", "b/images", "c", "videos"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("videos/walk.mp4", "videos/way.mov", "c/1.jpg", "c/2.jpg"):
        (tmp_path / name).touch()
    return tmp_path


def names(sources, list_file=None):
    return [(scene.name, *scene.sources) for scene in named_scenes(sources, list_file)]


def test_scenes_are_called_like_their_folders_or_files(folders):
    here = str(folders)
    assert names(["a/images", "c", "videos/walk.mp4", "demo"]) == [
        ("images", f"{here}/a/images"), ("c", f"{here}/c"), ("walk", f"{here}/videos/walk.mp4"), ("demo", "demo")
    ]  # fmt: skip
    assert names(["*/images", "c/1.jpg", "c/2.jpg"]) == [
        ("c", f"{here}/c/1.jpg", f"{here}/c/2.jpg"),
        ("a-images", f"{here}/a/images"),
        ("b-images", f"{here}/b/images"),
    ]
    assert [name for name, _ in names(["videos/*"])] == ["walk", "way"]
    assert names(["c/*.jpg"]) == [("c", f"{here}/c/*.jpg")]


def test_names_can_be_those_of_folders_everywhere(folders):
    odd = ["a:b*?", ".hidden ", "CON\n", "x" * 255, "batch.json", "scene.log", "..."]
    for name in odd:
        (folders / "odd" / name).mkdir(parents=True)
    found = [name for name, _ in names([f"odd/{name}" for name in odd])]
    assert found == ["a-b", "hidden", "CON", found[3], "batch.json-scene", "scene.log-scene", "odd"]
    assert found[3].startswith("xxx") and len(f"{found[3]}.log") <= 255
    assert len({name.casefold() for name in found}) == len(odd)


def test_a_list_names_scenes_relative_to_itself(folders, monkeypatch):
    (folders / "list.txt").write_text("\ufeff# ours\n\nhall = a/images\nyard\tc\n*/images\n", encoding="utf-8")
    monkeypatch.chdir("/")
    here = str(folders)
    with pytest.raises(UserError, match="a/images is given twice"):
        names([], folders / "list.txt")
    (folders / "list.txt").write_text(f"hall = a/images\nyard\tc\ndemo\n{folders}/v*/w*\n")
    assert names([f"{here}/b/images"], folders / "list.txt") == [
        ("images", f"{here}/b/images"), ("hall", f"{here}/a/images"), ("yard", f"{here}/c"), ("demo", "demo"),
        ("walk", f"{here}/videos/walk.mp4"), ("way", f"{here}/videos/way.mov"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "--list list.txt: No such file"),
        ("# nothing\n", "names no scene"),
        ("../x = c", "list.txt, line 1: '../x' cannot be the name of a folder here"),
        ("batch.json = c", "cannot be the name"),
        (" = c", "line 1: a name or a path is missing"),
        ("c =  ", "line 1: a name or a path is missing"),
        ("both = */images", "fits 2 scenes, which cannot all be 'both'"),
        ("X = c\nx = a/images", "would both be called 'x'"),
        (b"\xff\xfe", "no text in UTF-8"),
    ],
)
def test_lists_that_cannot_be_meant(folders, text, words):
    if isinstance(text, bytes):
        (folders / "list.txt").write_bytes(text)
    elif text is not None:
        (folders / "list.txt").write_text(text)
    with pytest.raises(UserError, match=words):
        names([], Path("list.txt"))


# -- what is refused before the first scene


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "no scene given"),
        (["nowhere"], "nowhere: no such folder"),
        (["{photos}", "walk.mp4"], "walk.mp4: no such video"),
        (["{photos}", "{empty}"], "empty"),
        (["{empty}/../a.mp4", "{photos}"], "a.mp4: no such video"),
        (["{photos}/0.png", "{photos}/1.png"], "needs at least 3 photos, got 2"),
        (["{photos}", "--max-views", "2"], "needs at least 3 photos, got 2"),
        (["{photos}", "--max-views", "0"], "--max-views must be at least 1"),
        (["{photos}", "--fps", "2"], "--fps is for videos; no scene is one"),
        (["{photos}", "--keep", "a"], "--keep 'a' is no list"),
        (["{photos}", "--masks", "{photos}"], "--masks is for one scene"),
        (["{photos}", "--jobs", "0"], "--jobs must be at least 1"),
        (["{photos}", "--jobs", "2", "--cluster"], "--jobs is for this machine"),
        (["{photos}", "--adapter", "{empty}"], "adapter"),
        (["{photos}", "--adapter", "{empty}", "--steps", "3"], "nothing is trained"),
        (["{photos}", "--formats", "kml"], "kml"),
        (["{photos}", "--rank", "0"], "rank"),
        (["{photos}", "--reference", "last"], "last"),
        (["{photos}", "{bad}"], "0.jpg"),
    ],
)
def test_mistakes_are_refused_before_the_first_scene(
    freegeo, photo_folder, tiny, tmp_path, monkeypatch, options, words
):
    monkeypatch.chdir(tmp_path)
    for name in ("empty", "bad"):
        (tmp_path / name).mkdir()
    (tmp_path / "bad" / "0.jpg").write_bytes(b"no photo")
    places = {"photos": photo_folder, "empty": tmp_path / "empty", "bad": tmp_path / "bad"}
    outcome = freegeo("batch", *(option.format(**places) for option in options), "-o", tmp_path / "out", *tiny)
    assert outcome.code == 2
    assert words in outcome.sentence()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("ray", "words"),
    [
        (None, "pip install 'freegeo[cluster]'"),
        (SimpleNamespace(is_initialized=lambda: False), "RAY_ADDRESS=127.0.0.1:"),
    ],
)
def test_a_cluster_that_is_not_there(freegeo, photo_folder, tiny, tmp_path, monkeypatch, ray, words):
    with socket.socket() as taken:
        # Nobody listens there.
        taken.bind(("127.0.0.1", 0))
        monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{taken.getsockname()[1]}")
        monkeypatch.setitem(sys.modules, "ray", ray)
        outcome = freegeo("batch", photo_folder, "-o", tmp_path / "out", *tiny, "--cluster")
    assert outcome.code == 2
    assert words in outcome.sentence()
    assert not (tmp_path / "out").exists()


def test_no_scene_counts_as_done_before_the_page_shows_it(tmp_path, monkeypatch):
    """Else a batch that is killed between the two has a page for good on which a finished scene is unfinished."""
    table = _Table(tmp_path, [])
    table.rows["a"] = SceneRow(name="a", outcome="frozen")
    record, seen = tmp_path / RECORD_NAME, []
    monkeypatch.setattr("freegeo.report.overview.write_overview", lambda *_: seen.append(record.exists()))
    table.write()
    assert (seen, record.exists()) == ([False], True)


@pytest.mark.parametrize("recorded", [True, False])
def test_logs_that_no_ledger_lists_are_replaced_where_the_record_names_the_scene(tmp_path, monkeypatch, recorded):
    """Earlier versions did not enter logs in the ledger."""
    monkeypatch.setattr("freegeo.pools.outcomes", lambda *_, **__: iter(()))
    monkeypatch.setattr(_Table, "_pool", lambda *_, **__: nullcontext())
    log, scene = tmp_path / "room.log", NamedScene(name="room", sources=("room",))
    work = _Work(
        scene=scene, arguments=(), overwrite=False, log=log, asked="", state=tmp_path / "room" / "state", before=None
    )
    with run_folder(tmp_path, SETTINGS):
        if recorded:
            write_json(tmp_path / RECORD_NAME, {"scenes": [{"name": "room", "outcome": "unfinished"}]})
        log.write_text("before")
        with nullcontext() if recorded else pytest.raises(UserError, match="did not write"):
            _Table(tmp_path, [work]).carry_out(None, jobs=1, cluster=False)
    assert log.exists() is not recorded


@pytest.mark.parametrize(("seconds", "shown"), [(math.inf, "inf"), (math.nan, "nan"), (12.4, "12")])
def test_a_record_with_seconds_that_are_no_number_makes_a_page(tmp_path, seconds, shown):
    write_json(tmp_path / RECORD_NAME, {"scenes": [{"name": "a", "outcome": "frozen", "seconds": seconds}]})
    write_overview(tmp_path, "index.html", list(stored_rows(tmp_path / RECORD_NAME).values()))
    assert f"<td>{shown}</td>" in (tmp_path / "index.html").read_text()


def test_places_that_are_taken_are_refused(freegeo, photo_folder, tiny, tmp_path):
    out = tmp_path / "out"
    (out / photo_folder.name).mkdir(parents=True)
    (out / photo_folder.name / "mine.txt").touch()
    assert "did not write" in freegeo("batch", photo_folder, "-o", out, *tiny).sentence()
    (out / photo_folder.name / "mine.txt").rename(tmp_path / "out" / "index.html")
    outcome = freegeo("batch", photo_folder, "-o", out, *tiny)
    assert outcome.code == 2 and "did not write" in outcome.sentence()
    assert (out / "index.html").read_text() == ""
    (out / "index.html").rename(out / f"{photo_folder.name}.log")
    outcome = freegeo("batch", photo_folder, "-o", out, *tiny)
    assert outcome.code == 2 and "did not write" in outcome.sentence()
    assert (out / f"{photo_folder.name}.log").read_text() == ""
    with run_folder(tmp_path / "one", {"command": "run"}) as folder:
        folder.finish()
    assert "another command" in freegeo("batch", photo_folder, "-o", tmp_path / "one", *tiny).sentence()


# -- what is written


class HerePool:
    """Works in this process, as a worker of ray does; the first start of a scene in `dies` is its worker's death.

    It dies before it has looked at the folder of the scene, or, by `dies_when`, when it has begun a new run there
    (``begun``) or while it removes what was made with other options (``clearing``).
    """

    dies_when = ""

    def __init__(self, out, dies=()):
        self.work, self.dies, self.running, self.commands = partial(_in_worker, out), set(dies), [], []

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass

    def start(self, item, *, again):
        self.commands.append(item.command(again=again))
        self.running.append((item, again))

    def ended(self):
        if not self.running:
            return []
        item, again = self.running.pop(0)
        if str(item) in self.dies and not again:
            if self.dies_when and item.state.is_file():
                left = {"settings": {"made": "otherwise"}, "clearing": True} if self.dies_when == "clearing" else {}
                write_json(item.state, {**read_json(item.state), "finished": None, **left})
            return [(item, pools.Died("SIGKILL"))]
        code = self.work(item, again)
        # Messages went to the log, which is closed; another process would have handlers of its own.
        console.configure_logging(verbose=False)
        return [(item, code)]


@pytest.fixture
def here(monkeypatch, tmp_path):
    """The pools of the commands that follow, the newest last."""
    made = []

    def make(*arguments, **options):
        made.append(HerePool(tmp_path / "out", dies=["room-0"]))
        return made[-1]

    monkeypatch.setattr(pools, "ProcessPool", make)
    return made


@pytest.fixture
def rooms(photo_folder, tmp_path):
    """Two scenes that can be computed, and one with a photo whose pixels are damaged."""
    for name in ("room-0", "room-1", "broken"):
        shutil.copytree(photo_folder, tmp_path / "rooms" / name)
    photo = tmp_path / "rooms" / "broken" / "2.png"
    photo.write_bytes(photo.read_bytes()[:2000])
    return tmp_path / "rooms"


@pytest.mark.slow
def test_scenes_fail_on_their_own_and_the_same_command_continues(freegeo, here, rooms, photo_folder, tiny, tmp_path):
    out = tmp_path / "out"
    command = ["batch", f"{rooms}/*", "-o", out, *tiny, *FROZEN]
    outcome = freegeo(*command)
    assert outcome.code == 1
    assert "1 of 3 scenes failed: broken." in outcome.sentence()
    assert "room-0: its worker died (SIGKILL). It is started again" in outcome.err
    assert "room-1: started" in outcome.err and "room-1: frozen, 4 views" in outcome.err
    assert "(3 of 3 scenes done)" in outcome.err
    stored = {row["name"]: row for row in read_json(out / "batch.json")["scenes"]}
    assert [row["outcome"] for row in stored.values()] == ["failed", "frozen", "frozen"]
    assert "2.png" in stored["broken"]["error"] and stored["broken"]["report"] is None
    for name in ("room-0", "room-1"):
        assert (out / stored[name]["report"]).is_file() and (out / stored[name]["log"]).is_file()
        assert (stored[name]["views"], stored[name]["warnings"]) == (4, 1)
        assert f'<a href="{name}/report.html">{name}</a>' in (out / "index.html").read_text()
        assert name in outcome.out
    assert stored["broken"]["error"] in (out / "index.html").read_text().replace("&#39;", "'")

    before = (out / "room-0" / "report.html").stat().st_mtime_ns
    shutil.copy(photo_folder / "2.png", rooms / "broken" / "2.png")
    again = freegeo(*command)
    assert again.code == 0, again.err
    assert "2 of 3 scenes are finished already" in again.err
    assert [arguments[1] for arguments in here[-1].commands] == [str(rooms / "broken")]
    assert (out / "room-0" / "report.html").stat().st_mtime_ns == before

    made = len(here)
    assert freegeo(*command).code == 0
    assert len(here) == made
    # Other photos in a finished scene are no reason to skip it: its own command refuses them.
    shutil.copy(rooms / "room-1" / "0.png", rooms / "room-1" / "3.png")
    changed = freegeo(*command)
    assert changed.code == 1
    assert "photos with other contents" in read_json(out / "batch.json")["scenes"][-1]["error"]


def test_a_retry_overwrites_what_is_old_and_not_what_it_continues(freegeo, here, rooms, tiny, tmp_path, monkeypatch):
    command = ["batch", rooms / "room-0", "-o", tmp_path / "out", *tiny, *FROZEN, "--overwrite"]
    for when, overwrites in (("", True), ("begun", False), ("clearing", True)):
        monkeypatch.setattr(HerePool, "dies_when", when)
        assert freegeo(*command).code == 0
        assert ["--overwrite" in arguments for arguments in here[-1].commands] == [True, overwrites]


def test_a_machine_that_does_not_see_the_photos_is_named(freegeo, here, rooms, tiny, tmp_path, monkeypatch):
    monkeypatch.setattr("freegeo.cli.batch.gethostname", lambda: "node-7")
    photos, start = rooms / "room-1", HerePool.start
    monkeypatch.setattr(HerePool, "start", lambda *given, again: (shutil.rmtree(photos), start(*given, again=again)))
    assert freegeo("batch", photos, "-o", tmp_path / "out", *tiny, *FROZEN).code == 1
    (row,) = read_json(tmp_path / "out" / "batch.json")["scenes"]
    assert "room-1" in row["error"]
    assert row["error"].endswith("(on node-7, a machine of the ray cluster)")


@pytest.mark.slow
def test_a_saved_adapter_reconstructs_every_scene(freegeo, here, rooms, tiny, tmp_path):
    assert (
        freegeo(
            "adapt",
            rooms / "room-0",
            "-o",
            tmp_path / "adapter",
            *tiny,
            "--steps",
            "1",
            "--sets",
            "1",
            "--guard",
            "off",
        ).code
        == 0
    )
    out = tmp_path / "out"
    outcome = freegeo(
        "batch", rooms / "room-1", "-o", out, "--adapter", tmp_path / "adapter", "--checkpoint", tiny[-1],
        "--refine", "off",
    )  # fmt: skip
    assert outcome.code == 0, outcome.err
    alone = ["--adapter", tmp_path / "adapter", "--checkpoint", tiny[-1]]
    assert freegeo("reconstruct", rooms / "room-1", "-o", tmp_path / "alone", *alone).code == 0
    require_equal(out / "room-1", tmp_path / "alone")
    assert read_json(out / "batch.json")["scenes"][0]["outcome"] == "adapted"


# -- several processes


def test_processes_share_processors_and_get_a_gpu_each(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: range(8), raising=False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert environments(None, None) == [{}]
    assert environments(3, None) == [{"OMP_NUM_THREADS": "2"}] * 3
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    each = [{"OMP_NUM_THREADS": "4", "CUDA_VISIBLE_DEVICES": gpu} for gpu in "01"]
    assert environments(None, None) == environments(2, "cuda") == each
    assert [one["CUDA_VISIBLE_DEVICES"] for one in environments(3, None)] == ["0", "1", "0"]
    assert all("CUDA_VISIBLE_DEVICES" not in one for device in ("cpu", "cuda:1") for one in environments(2, device))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5, 7")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert environments(None, None) == [{"CUDA_VISIBLE_DEVICES": "5"}, {"CUDA_VISIBLE_DEVICES": "7"}]


def require_equal(folder: Path, other: Path) -> None:
    """Require the same adapters and the same predictions, to the bit."""
    weights = [path.relative_to(folder) for path in folder.rglob("*.safetensors")]
    assert weights == [path.relative_to(other) for path in other.rglob("*.safetensors")]
    for name in weights:
        tensors, others = load_file(folder / name), load_file(other / name)
        assert tensors.keys() == others.keys()
        assert all(torch.equal(tensor, others[key]) for key, tensor in tensors.items())
    for name in ("prediction.npz", "frozen/prediction.npz"):
        if (folder / name).exists() or (other / name).exists():
            with np.load(folder / name) as arrays, np.load(other / name) as others:
                assert arrays.files == others.files
                assert all(np.array_equal(arrays[key], others[key]) for key in arrays.files)


needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="needs the extra cluster")


@pytest.mark.slow
@needs_proc
@pytest.mark.parametrize(
    ("how", "worker"),
    [
        (["--jobs", "2"], "freegeo.cli.app run"),
        pytest.param(["--cluster"], "ray::_carry_out", marks=needs_ray),
    ],
)
def test_a_killed_worker_is_replaced_and_results_are_those_of_plain_runs(freegeo, rooms, tiny, tmp_path, how, worker):
    require_recovery(freegeo, rooms, tiny, tmp_path, how, worker, "its worker died")


@pytest.mark.slow
@needs_proc
@needs_ray
def test_a_killed_ray_is_started_again_and_results_are_those_of_plain_runs(freegeo, rooms, tiny, tmp_path):
    require_recovery(freegeo, rooms, tiny, tmp_path, ["--cluster"], "raylet/raylet", "the ray cluster is gone")


def require_recovery(freegeo, rooms, tiny, tmp_path, how, killed, words):
    """Require the results of plain runs of a batch of which a process is killed, which it says in these words once."""
    options = [*tiny, *QUICK, "--refine", "off"]
    out = tmp_path / "out"
    program = [sys.executable, "-P", "-m", "freegeo.cli.app"]
    scenes = [str(rooms / "room-0"), str(rooms / "room-1")]
    command = [*program, "batch", *scenes, "-o", str(out), *options, *how]
    path = os.pathsep.join(entry for entry in sys.path if entry)
    environment = {**os.environ, "PYTHONPATH": path}
    log = out / "room-0.log"
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
        kill_one(process.pid, killed, lambda: log.is_file() and "adaptation" in log.read_text())
        _, messages = process.communicate(timeout=600)
    assert process.returncode == 0, messages
    assert messages.count(words) == 1
    for name in ("room-0", "room-1"):
        assert freegeo("run", rooms / name, "-o", tmp_path / name, *options).code == 0
        require_equal(out / name, tmp_path / name)
