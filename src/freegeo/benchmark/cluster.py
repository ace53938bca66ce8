"""Tasks of a run spread over a ray cluster (extra `cluster`): first the adapters, then the predictions.

All machines must see the folders of data and results. Every worker keeps its model between tasks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from importlib import import_module
from typing import Any

from freegeo.benchmark.adapters import AdapterJob
from freegeo.benchmark.predict import Predictor, Setup, adaptation_problem, problem_of
from freegeo.benchmark.tasks import Problem, Task, run_each
from freegeo.errors import UserError


def predict_on_cluster(
    predictor: Predictor, tasks: Sequence[Task], *, on_task: Callable[[Task], None] = lambda task: None
) -> list[Problem]:
    """As `predict_all`, on the cluster ray is connected to (`RAY_ADDRESS`), or on this machine's processors.

    UserError when ray is not installed, or a stored task was made with other settings.
    """
    try:
        ray: Any = import_module("ray")
    except ImportError:
        raise UserError("--cluster needs ray: pip install 'freegeo[cluster]'.") from None
    if not ray.is_initialized():
        ray.init(log_to_driver=False)
    resources = {"num_gpus": 1} if predictor.chosen.device.type == "cuda" else {"num_cpus": 1}
    waiting = predictor.unfinished(tasks)
    problems: list[Problem] = []
    for work, items in ((_adapt, predictor.adapter_jobs(waiting)), (_predict, waiting)):
        remote = ray.remote(**resources)(work)
        running = {remote.remote(_local(predictor.setup), item): item for item in items}
        while running:
            done, _ = ray.wait(list(running))
            for reference in done:
                item = running.pop(reference)
                problems += ray.get(reference)
                if isinstance(item, Task):
                    on_task(item)
    return problems


def _adapt(setup: Setup, job: AdapterJob) -> list[Problem]:
    return run_each([job], _worker(_Key(setup)).adapt, adaptation_problem)


def _predict(setup: Setup, task: Task) -> list[Problem]:
    return run_each([task], _worker(_Key(setup)).predict, problem_of("predict"))


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
