"""The units of a benchmark run: what a task is, where its files lie, and what happens when one fails.

```
OUT/predictions/<dataset>/<scene>/<rule>-<views>v-seed<seed>/<variant>/
        task.json        the task with its full configuration, written last: a task without it is not finished
        prediction.npz   depth_z, T_cam_world, K, frames       (or measured.json, see `freegeo.benchmark.predict`)
        scores.json      metrics of the second stage
```

A task depends on no other one, so a run may be stopped anywhere, continued, or spread over machines.
"""

from __future__ import annotations

import logging
import struct
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, Required, TypedDict, TypeVar, get_args

import torch

from freegeo.benchmark import sampling
from freegeo.errors import FreeGeoError, LostFolderError, UserError
from freegeo.files import as_json, read_json, remove_file, write_json
from freegeo.host import exhausted_memory
from freegeo.models.spec import AdaptationDefaults
from freegeo.run_folder import difference

logger = logging.getLogger(__name__)

FrameRule = Literal["da3", "vggt", "experiment", "neighbours"]
Item = TypeVar("Item")
FRAME_RULES: tuple[FrameRule, ...] = get_args(FrameRule)
PREDICTIONS, TASK_FILE, PREDICTION_FILE, MEASURED_FILE, SCORES_FILE = (
    "predictions", "task.json", "prediction.npz", "measured.json", "scores.json",
)  # fmt: skip
SAMPLE = 8
"""Views of the sample that "8->4", and 4 views of the rules `vggt`, `experiment` and `neighbours`, are taken from."""
DAMAGED = (
    FreeGeoError, OSError, ValueError, LookupError, EOFError, SyntaxError, ArithmeticError, struct.error, zlib.error,
    torch.linalg.LinAlgError, torch.OutOfMemoryError, MemoryError,
)  # fmt: skip
"""What reading damaged data, a full disk or a scene too large for the memory raises; the other scenes go on."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """One prediction: a scene, which of its frames, and which variant of the model."""

    dataset: str
    scene: str
    rule: FrameRule
    views: int
    seed: int
    """Of the frames."""
    variant: str

    def folder(self, out: Path) -> Path:
        """Folder of the task's files in the benchmark folder `out`."""
        sample = f"{self.rule}-{self.views}v-seed{self.seed}"
        return Path(out) / PREDICTIONS / self.dataset / self.scene.replace("/", "-") / sample / self.variant

    def __str__(self) -> str:
        """Dataset, scene, views, seed and variant as text."""
        return f"{self.dataset} {self.scene}, {self.views} views, seed {self.seed}, {self.variant}"


class _Adaptation(TypedDict):
    """Of how a task's model was adapted, what decides which results belong together."""

    per: str
    epoch: Any
    recipe: Any
    seed: Any
    scenes: Any


class _Configuration(TypedDict, total=False):
    """Of what a task was predicted with, what is read."""

    model: Required[str]
    adaptation: _Adaptation | None


class _Record(TypedDict, total=False):
    """Content of `TASK_FILE`."""

    task: Required[Task]
    configuration: Required[_Configuration]
    frames: Required[list[int]]
    seconds: float | None
    peak_gb: float | None
    adapter: str | None


_AGAIN = "Remove that folder and predict again."


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Why something of a scene could not be computed."""

    dataset: str
    scene: str
    stage: Literal["adapt", "predict", "evaluate"]
    what: str
    reason: str

    def __str__(self) -> str:
        """Scene, stage and reason as text."""
        return f"{self.dataset} {self.scene}: {self.stage} of {self.what}: {self.reason}"


def choose_frames(rule: FrameRule, num_frames: int, views: int, seed: int) -> list[int]:
    """Frames of a task, ascending, by the rule of one of the published runners.

    `da3`: the first entries of a seeded shuffle; sets of one seed are nested. `vggt`: the same, but fewer than 8 views
    are every second frame of the 8. `experiment`: the sample of the published "8->4" comparison, fewer than 8 views
    likewise. `neighbours` (ours): 8 consecutive frames from a seeded start; fewer than 8 views are every second of
    them, more than 8 a longer run of frames.

    Source: docs/benchmark.md, "Frame rules".
    """
    if rule == "da3":
        return sampling.standard_frames(num_frames, views, seed)
    if rule == "vggt":
        if views < SAMPLE:
            return sampling.every_second_frame(num_frames, SAMPLE, views, seed)
        return sampling.standard_frames(num_frames, views, seed)
    if rule not in FRAME_RULES:
        raise UserError(f"There is no frame rule {rule!r}; choose one of {', '.join(FRAME_RULES)}.")
    sample = max(views, SAMPLE)
    if rule == "experiment":
        frames = sampling.experiment_frames(num_frames, sample, seed)
    else:
        start = seed % max(1, num_frames - sample + 1)
        frames = list(range(start, min(num_frames, start + sample)))
    return frames if views >= len(frames) else frames[::2][:views]


def family_rule(own: AdaptationDefaults) -> FrameRule:
    """The rule a model is evaluated with unless another one is asked for."""
    if own.neighbours:
        return "neighbours"
    return "vggt" if own.published == "vggt" else "da3"


def is_finished(task: Task, out: Path, configuration: Mapping[str, Any], *, overwrite: bool = False) -> bool:
    """Whether the task's prediction exists and was made with this configuration.

    UserError names the setting when it was made with another one, unless `overwrite` allows to replace it.
    """
    path = task.folder(out) / TASK_FILE
    if not path.is_file():
        return False
    unequal = difference(_record(path)["configuration"], as_json(configuration))
    if unequal and not overwrite:
        raise UserError(
            f"{path.parent}: was predicted with other settings ({unequal}). Choose another output folder, "
            "or replace it with --overwrite."
        )
    return not unequal


def finish(task: Task, out: Path, configuration: Mapping[str, Any], **facts: Any) -> None:
    """Mark a task as done; older scores of it are dropped."""
    folder = task.folder(out)
    remove_file(folder / SCORES_FILE)
    write_json(folder / TASK_FILE, {"task": asdict(task), "configuration": as_json(configuration), **facts})


def stored_tasks(out: Path) -> list[tuple[Task, dict[str, Any]]]:
    """All finished tasks of a folder with the content of task.json, in the order of their folders.

    FreeGeoError for a file that describes no task, or that of another folder.
    """
    found = []
    for path in sorted((Path(out) / PREDICTIONS).glob(f"*/*/*/*/{TASK_FILE}")):
        record = _record(path)
        names = {field.name for field in fields(Task)}
        task = Task(**{name: record["task"][name] for name in names})
        # Files are written and removed where the task says.
        if record["task"].keys() != names or task.folder(out) != path.parent:
            raise FreeGeoError(f"{path}: does not describe the task of its folder. {_AGAIN}")
        found.append((task, record))
    return found


def _record(path: Path) -> dict[str, Any]:
    return read_json(path, _Record, advice=_AGAIN)


def run_each(
    items: Iterable[Item],
    work: Callable[[Item], Iterable[Problem] | None],
    explain: Callable[[Item, BaseException], Problem],
    on_done: Callable[[Item], None] = lambda item: None,
) -> list[Problem]:
    """Do the work for every item; an item that fails on its data becomes a problem and the others go on.

    LostFolderError: the output folder is gone, so that all others would fail too.
    """
    problems: list[Problem] = []
    for item in items:
        try:
            problems += work(item) or ()
        except LostFolderError:
            raise
        except Exception as error:
            if not isinstance(error, DAMAGED) and exhausted_memory(error) is None:
                raise
            logger.debug("failed on %s", item, exc_info=True)
            problems.append(explain(item, error))
        on_done(item)
    return problems


def reason_of(error: BaseException) -> str:
    """One line that says what went wrong."""
    if isinstance(error, FreeGeoError):
        return str(error)
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror}{f': {error.filename}' if error.filename else ''}"
    return " ".join(f"{type(error).__name__}: {error}".split())


def by_scene(tasks: Iterable[Task]) -> dict[tuple[str, str], list[Task]]:
    """Group tasks by dataset and scene, keeping their order."""
    groups: dict[tuple[str, str], list[Task]] = {}
    for task in tasks:
        groups.setdefault((task.dataset, task.scene), []).append(task)
    return groups


def unique(items: Sequence[Item]) -> list[Item]:
    """The items without repeats, in their first order."""
    return list(dict.fromkeys(items))
