import logging
import math
import os
import socket
import subprocess
import sys
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from bench_tools import DATASET, ROOMS, task
from freegeo import pools
from freegeo.benchmark import cluster
from freegeo.benchmark.cluster import predict_on_cluster
from freegeo.benchmark.tasks import stored_tasks
from freegeo.errors import FreeGeoError, UserError
from processes import kill_one, needs_proc


class RayError(Exception):
    """What ray raises when a worker is gone."""


class RayTaskError(RayError):
    """What ray raises for an error of the work itself."""

    def __init__(self, cause):
        super().__init__("a traceback of many lines")
        self.cause = cause


class InlineRay:
    """What is used of ray, carried out in this process; the first `deaths` workers die.

    It listens at a port, as ray on this machine and the head of a cluster do. It ends `ends` times, each time when a
    result is asked for, and is back after `misses` vain connections.
    """

    exceptions = SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError)

    def __init__(self, deaths=0, ends=0, misses=0):
        self.options, self.deaths, self.shut = [], deaths, False
        self.ends, self.misses, self.started = ends, misses, 0

    def is_initialized(self):
        return False

    def init(self, **options):
        if self.started:
            self.misses -= 1
            if self.misses >= 0:
                raise ConnectionError("nobody is there")
        self.port = socket.create_server(("127.0.0.1", 0))

    def shutdown(self):
        self.shut = True
        self.port.close()

    def nodes(self):
        host, port = self.port.getsockname()
        return [{"NodeID": "this", "NodeManagerAddress": host, "NodeManagerPort": port}]

    def get_runtime_context(self):
        return SimpleNamespace(get_node_id=lambda: "this", gcs_address="{}:{}".format(*self.port.getsockname()))

    def cancel(self, reference, force):
        pass

    def remote(self, **options):
        self.options.append(options)
        return lambda work: SimpleNamespace(remote=lambda *arguments: self._started(work, arguments))

    def _started(self, work, arguments):
        self.started += 1
        return _Reference(work, arguments)

    def wait(self, references, num_returns, timeout):
        if self.ends:
            self.ends -= 1
            self.port.close()
            return [], references
        return references[:1], references[1:]

    def get(self, reference):
        if self.deaths:
            self.deaths -= 1
            raise RayError
        try:
            return reference.work(*reference.arguments)
        except Exception as error:
            raise RayTaskError(error) from None


class _Reference:
    def __init__(self, work, arguments):
        self.work, self.arguments = work, arguments


@pytest.fixture
def use_ray(monkeypatch):
    """Puts an `InlineRay` in the place of ray."""

    def use(**options):
        ray = InlineRay(**options)
        monkeypatch.setitem(sys.modules, "ray", ray)
        return ray

    return use


def test_the_cluster_gets_one_job_per_task_and_failures_come_back(predictor, use_ray):
    ray = use_ray()
    tasks = [task(), task("adapted"), task(scene=ROOMS[1]), task(scene="7")]
    done = []
    (problem,) = predict_on_cluster(predictor, tasks, on_task=done.append)
    assert problem.scene == "7"
    assert set(done) == set(tasks)
    assert {one for one, _ in stored_tasks(predictor.setup.out)} == set(tasks[:3])
    # A worker goes on with the next task, also on a GPU, where that is not ray's default.
    assert ray.options == [{"num_cpus": 1, "max_retries": 0, "max_calls": 0}]
    assert ray.shut


def test_a_worker_that_dies_is_replaced(predictor, use_ray, caplog):
    use_ray(deaths=2)
    assert predict_on_cluster(predictor, [task("adapted")]) == []
    assert [one for one, _ in stored_tasks(predictor.setup.out)] == [task("adapted")]
    assert len([record for record in caplog.records if "its worker died" in record.getMessage()]) == 2


def test_work_whose_worker_dies_every_time_is_a_problem(predictor, use_ray):
    use_ray(deaths=5)
    (problem,) = predict_on_cluster(predictor, [task(), task(scene=ROOMS[1])])
    assert "its worker died 3 times, the last time of RayError" in str(problem)
    assert len(stored_tasks(predictor.setup.out)) == 1


def test_a_cluster_that_comes_back_is_given_what_has_not_ended(predictor, use_ray, monkeypatch, caplog):
    monkeypatch.setattr(pools, "LOOK_S", 0.0)
    ray = use_ray(ends=1, misses=2)
    tasks = [task(), task(scene=ROOMS[1])]
    assert predict_on_cluster(predictor, tasks) == []
    assert ray.started == 4
    assert {one for one, _ in stored_tasks(predictor.setup.out)} == set(tasks)
    assert len([message for message in caplog.messages if "the ray cluster is gone" in message]) == 1


@pytest.mark.parametrize(("ends", "misses", "words"), [(1, math.inf, "nobody is there"), (9, 0, "is gone")])
def test_a_cluster_that_stays_away_is_named(predictor, use_ray, monkeypatch, ends, misses, words):
    monkeypatch.setattr(pools, "LOOK_S", 0.0)
    monkeypatch.setattr(pools, "RETURN_S", 0.1)
    use_ray(ends=ends, misses=misses)
    with pytest.raises(FreeGeoError, match=rf"{words}.*[Tt]he same command continues"):
        predict_on_cluster(predictor, [task()])


def test_a_machine_that_does_not_see_the_data_is_named(predictor, use_ray, monkeypatch):
    use_ray()
    monkeypatch.setattr(cluster, "gethostname", lambda: "node-7")
    (problem,) = predict_on_cluster(predictor, [task(scene="7")])
    assert str(problem).endswith("(on node-7)")


def test_what_the_work_warns_of_and_fails_with_is_told_here(predictor, use_ray, monkeypatch, caplog):
    use_ray()

    def warn(job):
        logging.getLogger("freegeo.benchmark").warning("doubtful")
        return []

    monkeypatch.setattr(cluster, "_worker", lambda key: SimpleNamespace(adapt=warn, predict=lambda task: None))
    (problem,) = predict_on_cluster(predictor, [task("adapted")])
    assert "doubtful" in caplog.messages
    assert "all machines must see" in str(problem)

    def fail(key):
        raise UserError("one sentence")

    monkeypatch.setattr(cluster, "_worker", fail)
    with pytest.raises(UserError, match=r"^one sentence$"):
        predict_on_cluster(predictor, [task()])
    monkeypatch.setattr(cluster, "_worker", lambda key: 1 / 0)
    with pytest.raises(FreeGeoError, match="a worker of ray failed: ZeroDivisionError: division by zero"):
        predict_on_cluster(predictor, [task()])


def test_machines_with_another_version_are_refused(predictor, use_ray, monkeypatch):
    use_ray()
    carry_out = pools._carry_out
    monkeypatch.setattr(pools, "_carry_out", lambda version, *others: carry_out("0.0.1", *others))
    with pytest.raises(UserError, match=r"this one 0\.0\.1"):
        predict_on_cluster(predictor, [task()])


def test_a_cluster_that_refuses_a_connection_may_ask_for_a_token(predictor, monkeypatch):
    def refuse(**options):
        raise ConnectionError("Failed to connect")

    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(is_initialized=lambda: False, init=refuse))
    with socket.create_server(("127.0.0.1", 0)) as there:
        monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{there.getsockname()[1]}")
        with pytest.raises(UserError, match="RAY_AUTH_MODE=token"):
            predict_on_cluster(predictor, [task()])


def test_without_ray_the_extra_is_named(predictor, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match="cluster"):
        predict_on_cluster(predictor, [task()])


@pytest.mark.slow
@needs_proc
@pytest.mark.skipif(find_spec("ray") is None, reason="needs the extra cluster")
def test_killed_workers_are_replaced_and_predictions_are_those_of_a_plain_run(tmp_path):
    program = [sys.executable, "-P", "-m", "freegeo.cli.app", "bench", "predict", "main", "--data", tmp_path / "data"]
    options = ["--datasets", DATASET, "--scenes", "2", "--views", "4", "--seeds", "43,44", "--steps", "3"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry)}
    plain, out = tmp_path / "plain", tmp_path / "out"
    subprocess.run([*program, *options, "-o", plain], env=environment, check=True, capture_output=True)
    command = [*program, *options, "-o", out, "--cluster"]
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
        kill_one(process.pid, "ray::_carry_out", lambda: any(out.glob("adapters/*/*/configuration.json")))
        kill_one(process.pid, "ray::_carry_out", lambda: any(out.rglob("prediction.npz")))
        _, messages = process.communicate(timeout=600)
    assert process.returncode == 0, messages
    assert messages.count("its worker died") == 2
    arrays = sorted(path.relative_to(plain) for path in plain.rglob("prediction.npz"))
    assert len(arrays) == 8
    assert arrays == sorted(path.relative_to(out) for path in out.rglob("prediction.npz"))
    for name in arrays:
        with np.load(plain / name) as one, np.load(out / name) as other:
            assert one.files == other.files
            assert all(np.array_equal(one[key], other[key]) for key in one.files)
    weights = [path.relative_to(plain) for path in plain.rglob("*.safetensors")]
    assert weights
    for name in weights:
        tensors, others = load_file(plain / name), load_file(out / name)
        assert all(torch.equal(tensor, others[key]) for key, tensor in tensors.items())
