import sys
from types import SimpleNamespace

import pytest

from bench_tools import ROOMS, task
from freegeo.benchmark.cluster import predict_on_cluster
from freegeo.benchmark.tasks import stored_tasks
from freegeo.errors import UserError


class InlineRay:
    """What is used of ray, carried out in this process."""

    def __init__(self):
        self.resources = []

    def is_initialized(self):
        return True

    def remote(self, **resources):
        self.resources.append(resources)
        return lambda work: SimpleNamespace(remote=lambda *arguments: _Reference(work(*arguments)))

    def wait(self, references):
        return references[:1], references[1:]

    def get(self, reference):
        return reference.value


class _Reference:
    def __init__(self, value):
        self.value = value


def test_the_cluster_gets_one_job_per_task_and_failures_come_back(predictor, monkeypatch):
    ray = InlineRay()
    monkeypatch.setitem(sys.modules, "ray", ray)
    tasks = [task(), task("adapted"), task(scene=ROOMS[1]), task(scene="7")]
    done = []
    (problem,) = predict_on_cluster(predictor, tasks, on_task=done.append)
    assert problem.scene == "7"
    assert set(done) == set(tasks)
    assert {one for one, _ in stored_tasks(predictor.setup.out)} == set(tasks[:3])
    assert ray.resources == [{"num_cpus": 1}] * 2


def test_without_ray_the_extra_is_named(predictor, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match="cluster"):
        predict_on_cluster(predictor, [task()])
