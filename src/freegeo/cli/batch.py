"""`freegeo batch`: many scenes, each as by `freegeo run`, in several processes or on a ray cluster."""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
import traceback
from collections.abc import Generator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import MISSING, asdict, dataclass, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from socket import gethostname
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from freegeo import __version__
from freegeo.adaptation.recipe import Guard
from freegeo.cli import console
from freegeo.cli.export import stored_summary
from freegeo.cli.files import FileOptions
from freegeo.cli.jobs import DEFAULT_FILES, planned
from freegeo.cli.options import (
    ModelOptions,
    OutputOptions,
    PhotoOptions,
    PlacingOptions,
    RecipeOptions,
    Refine,
    SequenceOptions,
)
from freegeo.cli.scenes import INDEX_NAME, LOG, RECORD_NAME, NamedScene, is_video_scene, look_at, named_scenes
from freegeo.errors import FreeGeoError, PartialResultError, UserError
from freegeo.files import RUN_FILE, make_way, read_json, write_json
from freegeo.models.spec import PoseFrom
from freegeo.run_folder import check_folder, run_folder, stored_state

if TYPE_CHECKING:
    from freegeo.pools import Died, ProcessPool, RayPool
    from freegeo.report.overview import SceneRow

DEFAULT_RECIPE, DEFAULT_MODEL, DEFAULT_PHOTOS = RecipeOptions(), ModelOptions(), PhotoOptions()
DEFAULT_PLACING, DEFAULT_SEQUENCE = PlacingOptions(), SequenceOptions()
SETTINGS = {"command": "batch"}
DONE, PARTIAL = 0, 3
"""Exit codes of `freegeo run` with which there is a result."""
UNFINISHED, FAILED, INCOMPLETE = "unfinished", "failed", "incomplete"
WIDTH = 140


@dataclass(frozen=True, kw_only=True)
class _Work:
    """A scene, and the command that computes it."""

    scene: NamedScene
    arguments: tuple[str, ...]
    overwrite: bool
    log: Path
    asked: str
    """Fingerprint of the command, of the files that it reads and of the weights."""
    state: Path
    """File with the state of its folder."""
    before: int | None
    """Time of that file before the batch; None: there was none."""

    def command(self, *, again: bool) -> list[str]:
        """Return the arguments of `freegeo`.

        After a death --overwrite is left out where the dead process had removed what was there, so that it continues.
        """
        state = stored_state(self.state.parent) if again and _written(self.state) != self.before else None
        begun = state is not None and not state.get("clearing")
        return [*self.arguments, *(["--overwrite"] if self.overwrite and not begun else [])]

    def __str__(self) -> str:
        return self.scene.name


def batch(
    *scenes: str,
    output: OutputOptions,
    list_file: Annotated[Path | None, Parameter(name="--list")] = None,
    model: ModelOptions = DEFAULT_MODEL,
    recipe: RecipeOptions = DEFAULT_RECIPE,
    photos: PhotoOptions = DEFAULT_PHOTOS,
    placing: PlacingOptions = DEFAULT_PLACING,
    sequence: SequenceOptions = DEFAULT_SEQUENCE,
    files: FileOptions = DEFAULT_FILES,
    adapt: bool = True,
    adapter: Path | None = None,
    guard: Guard = "select",
    refine: Refine = "auto",
    pose_from: PoseFrom = "camera",
    jobs: int | None = None,
    cluster: bool = False,
) -> None:
    """Reconstruct many scenes, each on its own as `freegeo run` does, into OUTPUT/<name of the scene>.

    The same command continues: finished scenes are skipped, failed ones tried again.

    Parameters
    ----------
    scenes
        Folders of photos, patterns of folders in quotes, videos, photo files (together one scene), or `demo`.
    list_file
        Text file with a scene per line, `path` or `name = path`, relative to the file; # begins a comment.
    adapt
        Adapt to every scene before reconstructing it; --no-adapt uses the frozen model.
    adapter
        Folder of a saved adapter: nothing is trained, every scene is reconstructed with it (`freegeo reconstruct`).
    guard
        select: matches between the photos decide whether and in which state the adapter is used; report: they are only
        asked; off.
    refine
        ba: bring the cameras to the matches by bundle adjustment, where matches that had no part in it then fit better
        (needs the extra: pip install 'freegeo[colmap]'); auto: ba where the extra is installed; off.
    pose_from
        camera: cameras of the model's camera head; rays: found from the rays that it predicts (any-view models of DA3).
    jobs
        Scenes that are computed at once on this machine; default: one per GPU, 1 without.
    cluster
        Spread the scenes over a ray cluster (RAY_ADDRESS), or ray on this machine (needs the extra: pip install
        'freegeo[cluster]'); every scene gets a GPU where the cluster has any, else a processor.
    """
    from freegeo.adaptation.adapter_files import find_adapter
    from freegeo.models.images import chosen_side
    from freegeo.runs import adapter_identity

    if jobs is not None and (jobs < 1 or cluster):
        raise UserError(
            f"--jobs must be at least 1, got {jobs}."
            if jobs < 1
            else "--jobs is for this machine; with --cluster ray decides by what is free. Leave out one of them."
        )
    if files.filters.masks is not None:
        raise UserError("--masks is for one scene: masks belong to photos by name. Use `freegeo run` for that scene.")
    if adapter is not None:
        if recipe != DEFAULT_RECIPE or not adapt or guard != "select":
            raise UserError("with --adapter nothing is trained. Leave out the options about adapting, or --adapter.")
        adapter = find_adapter(adapter).resolve()
        model = model.for_adapter(adapter)
    if model.checkpoint is not None:
        model = replace(model, checkpoint=model.checkpoint.resolve())
    if placing.scale is not None and Path(placing.scale).is_file():
        placing = replace(placing, scale=str(Path(placing.scale).resolve()))
    named = named_scenes(scenes, list_file)
    out = output.output.resolve()
    _check_output(out, named)
    empty = model.build_empty()
    chosen_side(empty.spec, photos.process_res)
    adapting = adapt and adapter is None
    planned(empty, recipe if adapting else None, refine=refine, pose_from=pose_from, placing=placing)
    found = _look_at_all(named, photos, files, adapting=adapting, has_cameras=empty.spec.cameras)
    model.warn_of_embedded([source for scene in named for source in scene.sources])
    common = [model.fingerprint, None if adapter is None else adapter_identity(adapter)]
    options = [*as_arguments(model), *as_arguments(placing), *as_arguments(sequence), *as_arguments(files)]
    options += [f"--refine={refine}", f"--pose-from={pose_from}"]
    if adapter is not None:
        options.append(f"--adapter={adapter}")
    else:
        options += [*as_arguments(recipe), f"--guard={guard}", *([] if adapt else ["--no-adapt"])]
    command = "run" if adapter is None else "reconstruct"
    works = [
        _work(scene, replace(output, output=out), command, options, photos, common, found[scene.name])
        for scene in named
    ]  # fmt: skip
    with run_folder(out, SETTINGS):
        table = _Table(out, works)
        table.carry_out(model.device, jobs=jobs, cluster=cluster)
    table.say()
    table.require_success()


def as_arguments(options: Any) -> list[str]:
    """Return the arguments that make a command parse these options: a dataclass of options, or several in one."""
    found: list[str] = []
    for option in fields(options):
        value, name = getattr(options, option.name), f"--{option.name.replace('_', '-')}"
        default = option.default if option.default_factory is MISSING else option.default_factory()
        if is_dataclass(value):
            found += as_arguments(value)
        elif value != default:
            if isinstance(value, bool):
                found.append(name if value else f"--no-{name[2:]}")
            else:
                found += [f"{name}={part}" for part in (value if isinstance(value, tuple) else (value,))]
    return found


def _check_output(out: Path, scenes: Sequence[NamedScene]) -> None:
    """Refuse places for results that cannot be used."""
    from freegeo.runs import check_place

    state = stored_state(out) if out.is_dir() else None
    if state is not None and state["settings"] != SETTINGS:
        raise UserError(f"{out}: holds the result of another command. Choose another folder (--output).")
    check_folder(out, SETTINGS, overwrite=False)
    for scene in scenes:
        check_place(out / scene.name, overwrite=False)


def _look_at_all(
    scenes: Sequence[NamedScene], photos: PhotoOptions, files: FileOptions, *, adapting: bool, has_cameras: bool
) -> dict[str, list[Path]]:
    """Return the files of every scene; UserError for anything that a scene would be refused for later."""
    from freegeo.data.photos import unique_names
    from freegeo.export.formats import check_formats

    if photos.max_views is not None and photos.max_views < 1:
        raise UserError(f"--max-views must be at least 1, got {photos.max_views}.")
    if photos.fps is not None and not any(map(is_video_scene, scenes)):
        raise UserError("--fps is for videos; no scene is one.")
    found = {scene.name: look_at(scene, photos, adapting=adapting) for scene in scenes}
    for scene in scenes if files.formats is not None else ():
        # The names of a video's frames are ours.
        names = [] if is_video_scene(scene) else unique_names(found[scene.name])
        check_formats(files.formats or (), names, has_cameras=has_cameras)
    return found


def _work(
    scene: NamedScene, output: OutputOptions, command: str, options: Sequence[str], photos: PhotoOptions,
    common: Sequence[Any], found: Sequence[Path],
) -> _Work:  # fmt: skip
    """Return what is to be done for a scene, whose files are `found`; `common`: what else its result rests on."""
    # Only a video can be read with --fps.
    own = photos if is_video_scene(scene) else replace(photos, fps=None)
    place = output.output / scene.name
    arguments = (command, *scene.sources, f"--output={place}", *options, *as_arguments(own))
    seen = [(str(file), stat.st_size, stat.st_mtime_ns) for file in found for stat in (file.stat(),)]
    text = json.dumps([__version__, arguments, common, seen])
    return _Work(
        scene=scene, arguments=arguments, overwrite=output.overwrite, log=place.with_name(f"{scene.name}{LOG}"),
        asked=hashlib.sha256(text.encode()).hexdigest()[:16], state=place / RUN_FILE,
        before=_written(place / RUN_FILE),
    )  # fmt: skip


def _written(path: Path) -> int | None:
    """Return when a file was last written, in ns; None when it is not there."""
    return path.stat().st_mtime_ns if path.is_file() else None


class _Table:
    """What became of the scenes of a batch, on the screen and in its folder."""

    def __init__(self, out: Path, works: Sequence[_Work]):
        from freegeo.report.overview import SceneRow

        self.out, self.works = out, works
        self.rows = stored_rows(out / RECORD_NAME)
        self.recorded = set(self.rows)
        """Scenes of an earlier call, which made their logs."""
        self.skipped = {work.scene.name for work in works if self._is_done(work)}
        self.waiting = [work for work in works if work.scene.name not in self.skipped]
        self.begun: set[str] = set()
        self.ended = 0
        for work in self.waiting:
            self.rows[work.scene.name] = SceneRow(name=work.scene.name, source=work.scene.sources, outcome=UNFINISHED)

    def carry_out(self, device: str | None, *, jobs: int | None, cluster: bool) -> None:
        """Compute the scenes that are not finished."""
        from freegeo.pools import outcomes

        if self.skipped:
            console.note(f"{len(self.skipped)} of {len(self.works)} scenes are finished already")
        if not self.waiting:
            return
        with self._pool(device, jobs=jobs, cluster=cluster) as pool:
            for work in self.waiting:
                make_way(work.log, is_own=work.scene.name in self.recorded)
            self.write()
            started = time.monotonic()
            for work, outcome in outcomes(pool, self.waiting, on_wait=self._say_begun):
                self._say_begun()
                self.ended += 1
                row = self.rows[work.scene.name] = self._row(work, outcome)
                self.write()
                left = len(self.waiting) - self.ended
                rest = f", about {_duration((time.monotonic() - started) / self.ended * left)} left" if left else ""
                done = self.ended + len(self.skipped)
                console.note(f"{row.name}: {_told(row)} ({done} of {len(self.works)} scenes done{rest})")

    def write(self) -> None:
        """Write what is known by now.

        The record comes last: a scene that it calls done is not looked at again, so the page has to know of it.
        """
        from freegeo.report.overview import write_overview

        rows = list(self.rows.values())
        write_overview(self.out, INDEX_NAME, rows)
        write_json(self.out / RECORD_NAME, {"format": 1, "scenes": [asdict(row) for row in rows]})

    def say(self) -> None:
        """Print a line per scene of this command."""
        shown = [self.rows[work.scene.name] for work in self.works]
        cells = [
            (row.name, *("" if value is None else f"{value:.0f}" for value in (row.views, row.seconds, row.warnings)),
             row.outcome, row.error or str(self.out / (row.report or "")))
            for row in shown
        ]  # fmt: skip
        header = ("scene", "views", "seconds", "warnings", "outcome", "report")
        console.say(console.table(header, cells, prose=WIDTH))
        console.say(f"\nAll with links: {self.out / INDEX_NAME}")

    def require_success(self) -> None:
        """End with exit code 1 when a scene failed, and with 3 when files or photos of one are missing."""
        shown = [self.rows[work.scene.name] for work in self.works]
        failed = [row.name for row in shown if row.outcome == FAILED]
        if failed:
            raise FreeGeoError(
                f"{len(failed)} of {len(shown)} scenes failed: {_some(failed)}. The same command tries them again."
            )
        incomplete = [row.name for row in shown if row.outcome == INCOMPLETE]
        if incomplete:
            raise PartialResultError(f"results of {_some(incomplete)} are not whole; the table says what is missing.")

    @contextmanager
    def _pool(self, device: str | None, *, jobs: int | None, cluster: bool) -> Generator[ProcessPool | RayPool]:
        from freegeo.pools import ProcessPool, RayPool

        if cluster:
            gpu = None if device is None else device.startswith("cuda")
            with RayPool(partial(_in_worker, self.out), gpu=gpu, fresh=True) as pool:
                yield pool
        else:
            with ProcessPool(_command_line, lambda work: work.log, environments(jobs, device)) as pool:
                yield pool

    def _is_done(self, work: _Work) -> bool:
        """Whether the scene was computed by this very command, from the same files, and is as it was then."""
        row = self.rows.get(work.scene.name)
        if row is None or row.outcome in (FAILED, UNFINISHED, INCOMPLETE) or row.asked is None or work.overwrite:
            return False
        return row.asked == self._stamp(work) and (self.out / (row.report or "")).is_file()

    def _stamp(self, work: _Work) -> str | None:
        """Return what was asked for and when it was finished; None while it is not."""
        state = stored_state(self.out / work.scene.name)
        return f"{work.asked} {state['finished']}" if state is not None and state["finished"] else None

    def _say_begun(self) -> None:
        """Say which scenes have begun since the last time: they have a log."""
        for work in self.waiting:
            if work.scene.name not in self.begun and work.log.exists():
                self.begun.add(work.scene.name)
                console.note(f"{work.scene.name}: started, its messages go to {work.log}")

    def _row(self, work: _Work, outcome: int | Died) -> SceneRow:
        """Return what became of a scene, as its folder and its log say."""
        from freegeo.job import SUMMARY_NAME
        from freegeo.pools import RETRIES, Died
        from freegeo.report.overview import SceneRow, outcome_of
        from freegeo.report.result import REPORT_NAME

        folder = self.out / work.scene.name
        about: dict[str, Any] = {
            "name": work.scene.name, "source": work.scene.sources, "log": work.log.name if work.log.exists() else None
        }  # fmt: skip
        if isinstance(outcome, Died):
            error = f"its process died {RETRIES + 1} times, the last time of {outcome.reason}. See {work.log}."
            return SceneRow(**about, outcome=FAILED, error=error)
        if outcome not in (DONE, PARTIAL):
            return SceneRow(**about, outcome=FAILED, error=_reason(work.log))
        if not (folder / SUMMARY_NAME).is_file():
            error = f"{folder}: this machine does not see what was written there; all machines must see the folder."
            return SceneRow(**about, outcome=FAILED, error=error)
        summary = stored_summary(folder)
        partial_result = outcome == PARTIAL
        return SceneRow(
            **about, outcome=INCOMPLETE if partial_result else outcome_of(summary), views=len(summary["images"]),
            seconds=round(sum(summary["seconds"].values()), 1), warnings=len(summary["warnings"]),
            report=f"{work.scene.name}/{REPORT_NAME}", error=_reason(work.log) if partial_result else None,
            asked=self._stamp(work),
        )  # fmt: skip


def stored_rows(path: Path) -> dict[str, SceneRow]:
    """Read what an earlier batch wrote about its scenes, by their names; DamagedError when it is not that."""
    from freegeo.report.overview import Batch, SceneRow

    if not path.is_file():
        return {}
    rows = read_json(path, Batch)["scenes"]
    names = {field.name for field in fields(SceneRow)}
    return {row["name"]: SceneRow(**{name: row[name] for name in names & row.keys()}) for row in rows}


def _command_line(work: _Work, again: bool) -> list[str]:
    # -P: modules that lie in the current folder are not taken for those of Python.
    return [sys.executable, "-P", "-m", "freegeo.cli.app", *work.command(again=again)]


def _in_worker(out: Path, work: _Work, again: bool) -> int:
    """Compute a scene in this process, a worker of ray; returns the exit code."""
    from freegeo.cli.app import FAILURE, main

    if not (out / RUN_FILE).is_file():
        raise UserError(f"{gethostname()}, a machine of the ray cluster, does not see {out}; all of them must see it.")
    with work.log.open("a", encoding="utf-8") as log, redirect_stdout(log), redirect_stderr(log):
        try:
            code = main(work.command(again=again))
        except Exception:
            traceback.print_exc()
            code = FAILURE
        if code not in (DONE, PARTIAL):
            # Another machine may see what this one does not.
            log.flush()
            print(f"freegeo: {_reason(work.log)} (on {gethostname()}, a machine of the ray cluster)")
        return code


def environments(jobs: int | None, device: str | None) -> list[dict[str, str]]:
    """Return the environment variables of each of the processes that run at once.

    They share the processors, and where there are several GPUs each gets one of them.
    """
    gpus = _gpus(device)
    count = jobs or max(1, len(gpus))
    found: list[dict[str, str]] = [{} for _ in range(count)]
    if count == 1:
        return found
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for number, environment in enumerate(found):
        if "OMP_NUM_THREADS" not in os.environ:
            environment["OMP_NUM_THREADS"] = str(max(1, cores // count))
        if gpus:
            environment["CUDA_VISIBLE_DEVICES"] = gpus[number % len(gpus)]
    return found


def _gpus(device: str | None) -> list[str]:
    """Return the CUDA devices that scenes can be spread over, as CUDA_VISIBLE_DEVICES names them."""
    import torch

    if device not in (None, "cuda") or not torch.cuda.is_available():
        return []
    names = [name.strip() for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    return names or [str(number) for number in range(torch.cuda.device_count())]


def _told(row: SceneRow) -> str:
    """Return what became of a scene, in one line."""
    if row.views is None or row.seconds is None:
        return f"{row.outcome}: {row.error}"
    return f"{row.outcome}, {row.views} views, {_duration(row.seconds)}"


def _reason(log: Path) -> str:
    """Return why a command failed: the last sentence of its log."""
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines() if log.is_file() else []
    said = [line.removeprefix("freegeo: ") for line in lines if line.startswith("freegeo: ")]
    return (said or lines or ["it left no message"])[-1]


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _some(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 3 else f"{', '.join(names[:3])} and {len(names) - 3} more"
