"""Tasks of a run spread over a ray cluster (extra `cluster`): first the adapters, then the predictions.

All machines must see the folders of data and results. Every worker keeps its model between tasks. A task whose worker
dies is started again; an adaptation continues at its last checkpoint.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from socket import gethostname
from typing import Any

from freegeo.benchmark.adapters import AdapterJob
from freegeo.benchmark.predict import Predictor, Setup, adaptation_problem, problem_of
from freegeo.benchmark.tasks import TASK_FILE, Problem, Task, run_each
from freegeo.errors import FreeGeoError
from freegeo.pools import RETRIES, Died, RayPool, outcomes


def predict_on_cluster(
    predictor: Predictor, tasks: Sequence[Task], *, on_task: Callable[[Task], None] = lambda task: None
) -> list[Problem]:
    """As `predict_all`, on the cluster ray is connected to (`RAY_ADDRESS`), or on this machine's processors.

    UserError when ray is not installed, or a stored task was made with other settings.
    """
    waiting = predictor.unfinished(tasks)
    problems: list[Problem] = []
    work = partial(_carry_out, _local(predictor.setup))
    with RayPool(work, gpu=predictor.chosen.device.type == "cuda") as pool:
        for job, outcome in outcomes(pool, predictor.adapter_jobs(waiting)):
            problems += [adaptation_problem(job, _death(outcome))] if isinstance(outcome, Died) else outcome
        for task, outcome in outcomes(pool, waiting):
            if isinstance(outcome, Died):
                outcome = [problem_of("predict")(task, _death(outcome))]
            elif not outcome and not (task.folder(predictor.setup.out) / TASK_FILE).is_file():
                outcome = [problem_of("predict")(task, _unseen(predictor.setup.out))]
            problems += outcome
            on_task(task)
    return problems


def _death(outcome: Died) -> FreeGeoError:
    return FreeGeoError(f"its worker died {RETRIES + 1} times, the last time of {outcome.reason}")


def _unseen(out: Path) -> FreeGeoError:
    return FreeGeoError(f"a worker wrote it where this machine does not see it; all machines must see {out}")


def _carry_out(setup: Setup, item: AdapterJob | Task, again: bool) -> list[Problem]:
    """Train an adapter or make a prediction, in a worker; what a dead worker left is continued or made anew."""
    predictor = _worker(_Key(setup))
    if isinstance(item, AdapterJob):
        problems = run_each([item], predictor.adapt, adaptation_problem)
    else:
        problems = run_each([item], predictor.predict, problem_of("predict"))
    # Another machine may see what this one does not.
    return [replace(problem, reason=f"{problem.reason} (on {gethostname()})") for problem in problems]


def _local(setup: Setup) -> Setup:
    """The setup with absolute folders: workers run elsewhere."""
    checkpoint = None if setup.checkpoint is None else setup.checkpoint.resolve()
    return replace(setup, data=setup.data.resolve(), out=setup.out.resolve(), checkpoint=checkpoint)


class _Key:
    """A setup that hashes and compares by its content, as the cache of `_worker` needs it."""

    def __init__(self, setup: Setup):
        self.setup = setup

    def __hash__(self) -> int:
        return hash(repr(self.setup))

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, _Key) and repr(self.setup) == repr(other.setup)


@lru_cache(maxsize=1)
def _worker(key: _Key) -> Predictor:
    return Predictor(key.setup)
