"""Whole commands on tiny inputs, each run in a forked process, for the tests that crash, starve and disturb them.

A command's inputs and output lie in one folder (`Place.work`) that is laid out anew for every case, so that paths are
the same in all of them and everything that was changed anywhere in it is seen.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from itertools import zip_longest
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np
from PIL import Image

from bench_tools import DATASET, small_room
from evidence_tools import turned
from freegeo.cli.app import TERMINATED, main
from freegeo.files import LEDGER_FILE, as_json
from freegeo.host import end_with_parent
from freegeo.models.da3_config import EMBEDDED_WEIGHTS
from freegeo.run_folder import difference

QUICK = ("--steps", "2", "--sets", "2", "--guard", "off")
FROZEN = ("--no-adapt", "--refine", "off", "--formats", "ply")
CHUNKS = ("--chunk", "4", "--overlap", "3", "--order", "given", "--formats", "ply")
FORMATS = ("ply", "glb", "colmap", "nerfstudio", "tum", "depth")
BENCH = ("--data", "data", "-o", "out", "--datasets", DATASET, "--scenes", "1", "--device", "cpu")
HANGS_S = 180.0
"""Seconds after which a command, which takes a few, is taken for one that never ends."""
PRELOADED = (
    "torch", "cv2", "pycolmap", "trimesh", "scipy.spatial", "scipy.ndimage", "scipy.sparse.linalg", "matplotlib.pyplot",
    "peft", "safetensors.torch", "cyclopts", "freegeo.sequence_job", "freegeo.refined", "freegeo.pools",
    "freegeo.cli.run", "freegeo.cli.adapt", "freegeo.cli.reconstruct", "freegeo.cli.export", "freegeo.cli.batch",
    "freegeo.cli.refine", "freegeo.cli.bench", "freegeo.benchmark.predict", "freegeo.benchmark.score",
    "freegeo.data.procedural.splits", "freegeo.export.formats", "freegeo.export.glb", "freegeo.evidence.matches",
    "freegeo.evidence.refinement", "freegeo.evidence.guard", "freegeo.fusion.mesh", "freegeo.report.result",
    "freegeo.report.overview",
)  # fmt: skip
"""What children need; loaded once, before they are forked."""


@dataclass(frozen=True)
class Command:
    """A command line, which runs in the folder of its inputs, and what makes these inputs."""

    arguments: tuple[str, ...]
    prepare: Callable[[Path], None]


def photos(folder: Path, count: int = 4, place: int = 0) -> None:
    """Write photos of a generated room, 64 x 48."""
    folder.mkdir(parents=True)
    for photo in small_room(20_000_003 + place, "test-id", count).photos:
        Image.fromarray(photo.read()).save(folder / photo.name)


def _photos(work: Path) -> None:
    photos(work / "photos")


def _many_photos(work: Path) -> None:
    photos(work / "photos", 7)


def _two_scenes(work: Path) -> None:
    photos(work / "scenes" / "a")
    photos(work / "scenes" / "b", place=1)


def _result(work: Path) -> None:
    _photos(work)
    _must(["reconstruct", "photos", "-o", "result", *_tiny(), "--formats", "npz"])


def _refinable(work: Path) -> None:
    """A result with true depth and cameras that are turned by 2 degrees."""
    from freegeo.data.photos import load_photos
    from freegeo.data.procedural import photograph_room
    from freegeo.export.photos import photo_records
    from freegeo.export.reconstruction import Reconstruction
    from freegeo.files import write_json

    scene = photograph_room(30_300_000, "val-tex", frames=6)
    (work / "photos").mkdir()
    for photo in scene.photos:
        Image.fromarray(photo.read()).save(work / "photos" / photo.name)
    given = load_photos(work / "photos")
    height, width = given[0].size_hw
    found = Reconstruction(
        depth_z=scene.depth_z.numpy(), conf=np.ones((6, height, width), np.float32),
        images=np.stack([photo.read() for photo in given]), names=tuple(photo.name for photo in given),
        photo_hw=np.array([photo.size_hw for photo in given]), scale_xy=np.ones((6, 2)), offset_xy=np.zeros((6, 2)),
        T_cam_world=turned(scene.T_cam_world.double(), 2).float().numpy(), K=scene.K.numpy(),
    )  # fmt: skip
    found.save(work / "result")
    records = {"format": 1, "images": list(found.names), "photo_files": photo_records(given), "warnings": []}
    write_json(work / "result" / "reconstruction.json", records)


def _predicted(work: Path) -> None:
    _must(list(COMMANDS["bench-predict"].arguments))


def _nothing(work: Path) -> None:
    pass


def _tiny() -> tuple[str, ...]:
    return ("--model", "freegeo-tiny", "--checkpoint", str(EMBEDDED_WEIGHTS), "--device", "cpu", "--process-res", "48")


COMMANDS = {
    "run": Command(("run", "photos", "-o", "out", *_tiny(), *QUICK), _photos),
    "adapt": Command(("adapt", "photos", "-o", "out", *_tiny(), *QUICK), _photos),
    "reconstruct": Command(("reconstruct", "photos", "-o", "out", *_tiny(), *CHUNKS), _many_photos),
    "export": Command(("export", "result", "-o", "out", "--format", *FORMATS), _result),
    "export-inside": Command(("export", "result", "--format", *FORMATS), _result),
    "batch": Command(("batch", "scenes/a", "scenes/b", "-o", "out", *_tiny(), *FROZEN), _two_scenes),
    "refine": Command(("refine", "result", "-o", "out", "--formats", "ply"), _refinable),
    "bench-predict": Command(
        ("bench", "predict", "main", *BENCH, "--seeds", "43", "--views", "4", "--steps", "2", "--sets", "2",
         "--checkpoint", str(EMBEDDED_WEIGHTS), "--process-res", "48"), _nothing,
    ),
    "bench-evaluate": Command(("bench", "evaluate", *BENCH), _predicted),
}  # fmt: skip


def _must(arguments: list[str]) -> None:
    if main(arguments) != 0:
        raise RuntimeError(f"{arguments}: the inputs of a command cannot be made")


class Forked:
    """Stands for `subprocess.Popen` in `freegeo batch`: a worker that is forked, which takes no time to start.

    It stays in the process group of its parent, so that one signal stops both, as when a machine stops.
    """

    pipes: ClassVar[list[BinaryIO]] = []
    """The ends that this process holds of the pipes by which workers notice that it is gone."""

    def __init__(self, command: Sequence[str], *, stdout: Any, env: Mapping[str, str], **options: object):
        self.returncode: int | None = None
        theirs, ours = os.pipe()
        self.stdin = os.fdopen(ours, "wb")
        self.pipes.append(self.stdin)
        sys.stdout.flush()
        self.pid = os.fork()
        if self.pid == 0:
            try:
                os.dup2(theirs, 0)
                # A worker that held one, its own or another's, would never see it close.
                for pipe in self.pipes:
                    pipe.close()
                os.environ.update(env)
                _speak_to(stdout.fileno())
                end_with_parent()
                _end(list(command[command.index("freegeo.cli.app") + 1 :]))
            finally:
                os._exit(71)
        os.close(theirs)

    def poll(self) -> int | None:
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self.returncode = os.waitstatus_to_exitcode(status) if pid else None
        return self.returncode

    def wait(self, timeout: float = math.inf) -> int:
        deadline = time.monotonic() + timeout
        while (code := self.poll()) is None:
            if time.monotonic() > deadline:
                raise subprocess.TimeoutExpired("worker", timeout)
            time.sleep(0.01)
        return code

    def terminate(self) -> None:
        os.kill(self.pid, signal.SIGTERM)

    def kill(self) -> None:
        os.kill(self.pid, signal.SIGKILL)


def _speak_to(descriptor: int) -> None:
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    sys.stdout = os.fdopen(os.dup(1), "w", buffering=1)
    sys.stderr = os.fdopen(os.dup(2), "w", buffering=1)


def _end(arguments: list[str]) -> None:
    """Carry out a command line as the program does, and end this process."""
    import traceback

    code = 70
    try:
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
        code = main(arguments)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _quicken() -> None:
    """Leave out what only takes time here, and save the state of an adaptation after each step."""
    from freegeo import pools
    from freegeo.adaptation import adapt
    from freegeo.data.procedural import splits

    adapt.SAVE_EVERY_S = -1.0
    kept = ("PIPE", "STDOUT", "TimeoutExpired")
    pools.subprocess = type("subprocess", (), {"Popen": Forked, **{name: getattr(subprocess, name) for name in kept}})
    pools.POLL_S = 0.01
    splits.photograph_room = small_room
    os.fsync = lambda descriptor: None


@dataclass
class Ended:
    """What came of a process."""

    code: int
    """Its exit code; of one that a signal stopped, the signal's number, negative."""
    said: str
    seconds: float


@dataclass
class Place:
    """Where the cases of one command lie; see `laid_out`."""

    root: Path
    name: str
    files: dict[str, str] = field(default_factory=dict)
    """The work folder after an uninterrupted run, as `tree` returns it."""
    seconds: float = 0.0
    """How long that took."""

    @property
    def command(self) -> Command:
        return COMMANDS[self.name]

    @property
    def work(self) -> Path:
        """The folder that the command runs in."""
        return self.root / "work"

    @property
    def whole(self) -> Path:
        """The work folder after an uninterrupted run."""
        return self.root / "whole"

    def lay_out(self, content: Path | None = None) -> None:
        """Give the work folder the content that it has before the command, or another one."""
        shutil.rmtree(self.work, ignore_errors=True)
        shutil.copytree(content or self.root / "inputs", self.work, symlinks=True)

    def start(self, first: Callable[[], None] = lambda: None, *, said: str = "said") -> int:
        """Start the command in a forked process group, after a function there; returns its process.

        Its messages go to a file of the name `said` beside the work folder.
        """
        return _forked(self.work, self.root / said, partial(_end, list(self.command.arguments)), first)

    def run(self, first: Callable[[], None] = lambda: None, *, said: str = "said") -> Ended:
        """Carry out the command; see `start`."""
        return self.ended(self.start(first, said=said), said=said)

    def ended(self, process: int, *, said: str = "said") -> Ended:
        """Wait for a process of `start`; one that takes `HANGS_S` seconds is ended, with its workers."""
        started = time.monotonic()
        try:
            while not (done := os.waitpid(process, os.WNOHANG))[0]:
                if time.monotonic() - started > HANGS_S:
                    os.killpg(process, signal.SIGKILL)
                time.sleep(0.01)
        except KeyboardInterrupt:
            os.killpg(process, signal.SIGKILL)
            os.waitpid(process, 0)
            raise
        status, text = done[1], (self.root / said).read_text(errors="replace")
        return Ended(os.waitstatus_to_exitcode(status), text, time.monotonic() - started)

    def difference(self) -> str:
        """Say what in the work folder is not as after an uninterrupted run; empty when nothing is."""
        now = tree(self.work)
        odd = [f"{name} missing" for name in self.files if name not in now]
        odd += [f"{name} left over" for name in now if name not in self.files]
        odd += [self._differs(name) for name in now if name in self.files and now[name] != self.files[name]]
        return ", ".join(sorted(odd)[:4])

    def _differs(self, name: str) -> str:
        if name.endswith(".html"):
            return f"{name} differs ({_other_lines(self.whole / name, self.work / name)})"
        if not name.endswith(".json"):
            return f"{name} differs"
        before, now = (_without_times(json.loads((folder / name).read_text())) for folder in (self.whole, self.work))
        return f"{name} differs ({difference(as_json(before), as_json(now))})"


def laid_out(root: Path, name: str) -> Place:
    """Make the inputs of a command below an empty folder, and run it once without disturbance."""
    for module in PRELOADED:
        import_module(module)
    # A room takes seconds only where it is the first one of its kind.
    small_room(20_000_003, "test-id", 4)
    place = Place(root, name)
    place.work.mkdir(parents=True)

    def prepare() -> None:
        (place.work / "temporary").mkdir()
        COMMANDS[name].prepare(place.work)
        os._exit(0)

    made = place.ended(_forked(place.work, root / "said", prepare))
    if made.code != 0:
        raise RuntimeError(f"the inputs of {name} cannot be made:\n{made.said}")
    place.work.rename(root / "inputs")
    place.lay_out()
    whole = place.run()
    if whole.code != 0:
        raise RuntimeError(f"{name} fails without disturbance:\n{whole.said}")
    place.files, place.seconds = tree(place.work), whole.seconds
    shutil.copytree(place.work, place.whole, symlinks=True)
    return place


def _forked(work: Path, said: Path, then: Callable[[], None], first: Callable[[], None] = lambda: None) -> int:
    sys.stdout.flush()
    process = os.fork()
    if process:
        return process
    try:
        os.setpgid(0, 0)
        # What a shell starts in the background would ignore it.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        os.chdir(work)
        with said.open("wb") as file:
            _speak_to(file.fileno())
        tempfile.tempdir = str(work / "temporary")
        os.environ.update(TMPDIR=tempfile.tempdir, XDG_CACHE_HOME=str(work / "cache"))
        _quicken()
        first()
        then()
    except BaseException:
        import traceback

        traceback.print_exc()
        sys.stderr.flush()
    os._exit(71)


# -- what is in a folder

VOLATILE = {"finished", "asked", "peak_gb"}
"""Names of JSON values that depend on time, or on what the process did before, and have to be there nevertheless."""
_SECONDS = "seconds"
"""Name of JSON values that say how long stages took; one that a kill cut short may lack its time."""
_TIMES = re.compile(
    r"\d\d\d\d-\d\d-\d\d[T ][\d:+.]+|\b\d+(\.\d+)? (s|min)\b|<tr><th>[^<]*</th><td>\d+\.\d</td></tr>"
    r"|<tr><th>[^<]*seconds</th><td>[^<]*</td></tr>|^  <td>\d+</td>$",
    re.M,
)
"""Times in reports, and whole seconds in the table of a batch."""


def tree(folder: Path) -> dict[str, str]:
    """Return all files and folders below a folder, with digests of what does not depend on time."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            found[name] = f"link to {path.readlink()}"
        elif path.is_dir():
            found[name + "/"] = ""
        else:
            found[name] = hashlib.sha256(_content(path)).hexdigest()[:16]
    return found


def _content(path: Path) -> bytes:
    data = path.read_bytes()
    if path.name == LEDGER_FILE:
        # What was removed since may be named or not.
        names = {line for line in data.decode().splitlines() if (path.parent / line).exists()}
        return "\n".join(sorted(names)).encode()
    if path.suffix == ".json":
        try:
            return json.dumps(_without_times(json.loads(data)), sort_keys=True).encode()
        except ValueError:
            return data
    if path.suffix == ".html":
        return _TIMES.sub("", data.decode()).encode()
    return b"" if path.suffix == ".log" else data


def _other_lines(before: Path, now: Path) -> str:
    """Return the first lines in which pages differ but for times."""
    lines = [_content(page).decode().splitlines() for page in (before, now)]
    for number, (one, other) in enumerate(zip_longest(*lines, fillvalue="nothing"), 1):
        if one != other:
            start = next((k for k, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), 0)
            near = slice(max(0, start - 60), start + 60)
            return f"line {number}: {one[near]!r} / {other[near]!r}"
    return "nothing"


def _without_times(value: Any) -> Any:
    if isinstance(value, dict):
        kept = {key: _without_times(part) for key, part in value.items() if key != _SECONDS}
        # What held nothing but times may be missing with them.
        return {key: part is not None if key in VOLATILE else part for key, part in kept.items() if part != {}}
    return [_without_times(part) for part in value] if isinstance(value, list) else value
