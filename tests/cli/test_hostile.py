"""A result folder from somebody else: whatever it holds, nothing outside changes, and there is no traceback."""

import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from exact_rooms import room
from freegeo.export.formats import filter_reconstruction
from freegeo.export.kept import save_kept
from freegeo.files import LEDGER_FILE, RUN_FILE, write_json
from freegeo.lock import LOCK_FILE
from freegeo.run_folder import run_folder

OUTSIDE = "OUTSIDE"
"""Stands for the folder that must not change."""
NAMES = (
    f"{OUTSIDE}/photo.png", f"{OUTSIDE}/photo", "../outside/photo.png", "../../outside/photo.png",
    "x/../../../outside/photo.png", "..", ".", "", "/", "a\nb.png", "a\rb", "C:\\x.png", "..\\..\\outside\\photo.png",
    "a" * 300 + ".png", "d" * 300 + "/a.png", "/".join(["d" * 100] * 60) + "/x.png", "\ud800.png", "\udcff.png",
    "~/x.png", "$HOME/x.png", LEDGER_FILE, RUN_FILE, "a/../b.png", "a//b.png", "%2e%2e/x.png", "1.png",
)  # fmt: skip
LINKS = (
    "depth", "depth/depth.json", "points.ply", "images", "colmap", "colmap/sparse", "transforms.json", "prediction.npz",
    "kept.npz", "tracks.npz", "reconstruction.json", LEDGER_FILE, RUN_FILE, LOCK_FILE,
)  # fmt: skip
TARGETS = (OUTSIDE, f"{OUTSIDE}/photo.png", f"{OUTSIDE}/nothing", "/dev/null", "..")
LEDGERS = (
    "../../outside/photo.png", f"{OUTSIDE}/photo.png", "link/photo.png", "link/sub/x", "link", ".", "..", "/", "a\0b",
    "link/../../../outside/photo.png", "x" * 5000, ".x.12345678.part", "link/.x.12345678.part",
)  # fmt: skip
RECORDS = (
    {"file": f"{OUTSIDE}/photo.png", "sha256": "x"}, {"file": "/dev/zero", "sha256": "x"}, {"file": 3},
    {"file": OUTSIDE, "sha256": ""}, {"file": "a\0b", "sha256": ""}, {"file": "x" * 5000, "sha256": ""}, {}, [], "x", 7,
)  # fmt: skip
SUMMARIES = ([], "x", None, 3, {"images": 3}, {"photo_files": 3}, {"refinement": 3}, {"warnings": 3}, {"images": [[]]})
FORMATS = ("-f", "depth,ply,nerfstudio")


@pytest.fixture(scope="module")
def harmless(tmp_path_factory) -> Path:
    """A small finished result."""
    folder, scene = tmp_path_factory.mktemp("harmless") / "out", room(3, (12, 16))
    with run_folder(folder, {"command": "reconstruct"}) as run:
        scene.save(folder)
        save_kept(folder, filter_reconstruction(scene))
        write_json(folder / "reconstruction.json", {"images": list(scene.names), "photo_files": [None] * len(scene)})
        run.finish()
    return folder


@pytest.fixture
def unharmed(freegeo, harmless, tmp_path):
    """Give `unharmed(change, ...)`: change a copy of the result, run commands on it, and look at the world outside."""
    outside = tmp_path / "outside"
    (outside / "sub").mkdir(parents=True)
    (outside / "photo.png").write_bytes(b"mine")
    work = tmp_path / "work"

    def world() -> dict[str, bytes | None]:
        every = (path for path in tmp_path.rglob("*") if not path.is_relative_to(work))
        return {str(path): path.read_bytes() if path.is_file() else None for path in every}

    def try_it(change, *commands) -> list[int]:
        shutil.rmtree(work, ignore_errors=True)
        out = Path(shutil.copytree(harmless, work / "out"))
        change(out)
        before, codes = world(), []
        for command in commands:
            outcome = freegeo(command[0], out, *command[1:])
            assert outcome.code in (0, 1, 2, 3)
            if outcome.code:
                outcome.sentence()
            codes.append(outcome.code)
        assert world() == before
        return codes

    return try_it


def put(text, tmp_path: Path):
    return json.loads(json.dumps(text).replace(OUTSIDE, str(tmp_path / "outside")))


def with_arrays(name: str, **arrays):
    """A change that replaces arrays of an npz file, or makes one."""

    def change(out: Path) -> None:
        there = dict(np.load(out / name)) if (out / name).is_file() else {}
        np.savez(out / name, **{**there, **arrays})

    return change


def test_names_of_a_prediction(unharmed, tmp_path, harmless):
    own = np.load(harmless / "prediction.npz")["names"].tolist()
    for name in NAMES:
        change = with_arrays("prediction.npz", names=np.array([put(name, tmp_path), *own[1:]]))
        unharmed(change, ("export", *FORMATS), ("export", *FORMATS, "-o", tmp_path / "work" / "new"))


def test_two_views_of_one_name(unharmed, harmless):
    own = np.load(harmless / "prediction.npz")["names"].tolist()
    codes = unharmed(with_arrays("prediction.npz", names=np.array([own[1], *own[1:]])), ("export", *FORMATS))
    assert codes == [1]


@pytest.mark.slow
def test_links_in_the_folder(unharmed, tmp_path):
    def change(out: Path, link: str, target: str) -> None:
        (out / link).parent.mkdir(parents=True, exist_ok=True)
        (out / link).unlink(missing_ok=True)
        (out / link).symlink_to(target)

    for link in LINKS:
        for target in TARGETS:
            unharmed(partial(change, link=link, target=put(target, tmp_path)), ("export", *FORMATS))


def test_names_in_the_ledger(unharmed, tmp_path):
    outside = tmp_path / "outside"

    def change(out: Path, name: str) -> None:
        for link in ("link", ".x.12345678.part"):
            (out / link).symlink_to(outside)
        with (out / LEDGER_FILE).open("a") as file:
            file.write(f"{name}\n")

    def overwritten(out: Path, name: str) -> None:
        change(out, name)
        before = {path: path.stat().st_mtime_ns for path in outside.rglob("*")}
        with run_folder(out, {"other": 1}, overwrite=True):
            pass
        assert {path: path.stat().st_mtime_ns for path in outside.rglob("*")} == before

    for name in LEDGERS:
        unharmed(partial(change, name=put(name, tmp_path)), ("export", *FORMATS))
        unharmed(partial(overwritten, name=put(name, tmp_path)))


def write_summary(out: Path, content: object) -> None:
    (out / "reconstruction.json").write_text(json.dumps(content))


def test_records_of_photos_and_the_summary(unharmed, tmp_path, harmless):
    names = np.load(harmless / "prediction.npz")["names"].tolist()
    whole = [{"images": names, "photo_files": [put(record, tmp_path)] * len(names)} for record in RECORDS]
    for content in (*whole, *SUMMARIES):
        unharmed(partial(write_summary, content=content), ("export", *FORMATS))


@pytest.mark.parametrize("name", ["kept.npz", "tracks.npz"])
def test_arrays_of_another_result(unharmed, name, harmless):
    shape = np.load(harmless / "kept.npz")["keep"].shape
    tracks = {
        "xyz": np.zeros((2, 3)), "colours": np.zeros((2, 3), np.uint8), "point": np.array([0, 0, 1, 1]),
        "view": np.array([0, 1, 0, 1]), "pixel": np.zeros((4, 2)),
    }  # fmt: skip
    changes = {
        "kept.npz": [
            {"keep": np.ones((1, 2, 3), bool)}, {"keep": np.ones(shape)}, {"masks": np.ones((1, 2, 3), bool)},
            {"masks": np.ones(shape)}, {"keep": np.array([{}], object)}, {"removed": np.array(3)},
        ],
        "tracks.npz": [
            {"xyz": np.zeros(3)}, {"view": np.array([0, 9, 0, 1])}, {"view": np.array([0, -1, 0, 1])},
            {"point": np.array([0, 0, 9, 9])}, {"point": np.array([1, 1, 0, 0])}, {"pixel": np.full((4, 2), np.nan)},
            {"point": np.array(["a"] * 4)}, {"colours": np.zeros((3, 3), np.uint8)},
        ],
    }  # fmt: skip
    for change in changes[name]:
        arrays = {**tracks, **change} if name == "tracks.npz" else change
        assert unharmed(with_arrays(name, **arrays), ("export", "-f", "ply")) == [1], change
