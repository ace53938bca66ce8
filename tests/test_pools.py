"""Work that is spread over processes: its outcomes, deaths of workers, and the end."""

import os
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest

from freegeo.pools import RETRIES, Died, ProcessPool, outcomes
from processes import descendants, needs_proc


class Scripted:
    """A pool in which items end as a script says."""

    def __init__(self, script):
        self.script = {name: list(ends) for name, ends in script.items()}
        self.started = []
        self.running = []

    def start(self, item, *, again):
        self.started.append((item, again))
        self.running.append(item)

    def ended(self):
        running, self.running = self.running, []
        return [(item, self.script[item].pop(0)) for item in running]


def test_an_item_whose_worker_dies_is_started_again_and_others_go_on(caplog):
    killed = Died("SIGKILL")
    pool = Scripted({"a": [0], "b": [killed, killed, 5], "c": [killed] * (RETRIES + 1)})
    assert dict(outcomes(pool, ["a", "b", "c"])) == {"a": 0, "b": 5, "c": killed}
    assert pool.started.count(("b", True)) == pool.started.count(("c", True)) == RETRIES == 2
    assert [again for item, again in pool.started if item == "a"] == [False]
    assert sum("SIGKILL" in record.getMessage() for record in caplog.records) == 2 * RETRIES


def python(code):
    return [sys.executable, "-S", "-c", code]


def pool_of(folder: Path, code: str, environments=({},)) -> ProcessPool:
    """A pool whose items are names that the code reads as the first argument; the second is 1 after a death."""
    return ProcessPool(
        lambda item, again: [*python(code), item, str(int(again))], lambda item: folder / f"{item}.log", environments
    )


def test_processes_end_with_exit_codes_and_write_logs(tmp_path):
    code = "import sys; print('out', sys.argv[1]); print('err', file=sys.stderr); sys.exit(int(sys.argv[1]))"
    with pool_of(tmp_path, code, [{}, {}]) as pool:
        assert dict(outcomes(pool, ["0", "1", "3"])) == {"0": 0, "1": 1, "3": 3}
    assert set((tmp_path / "3.log").read_text().splitlines()) == {"out 3", "err"}


def test_a_killed_process_is_replaced_and_its_log_goes_on(tmp_path):
    code = "import os, sys; print(sys.argv[2], flush=True); sys.argv[2] == '1' or os.kill(os.getpid(), 9)"
    with pool_of(tmp_path, code) as pool:
        assert dict(outcomes(pool, ["a"])) == {"a": 0}
    assert (tmp_path / "a.log").read_text().split() == ["0", "1"]


def test_a_process_that_is_always_killed_is_given_up(tmp_path):
    with pool_of(tmp_path, "import os; os.kill(os.getpid(), 11)") as pool:
        assert dict(outcomes(pool, ["a"])) == {"a": Died("SIGSEGV")}


def test_as_many_run_at_once_as_there_are_environments_each_in_its_own(tmp_path):
    code = "import os, time; print(os.environ['GPU'], time.monotonic()); time.sleep(.2); print(time.monotonic())"
    with pool_of(tmp_path, code, [{"GPU": "0"}, {"GPU": "1"}]) as pool:
        list(outcomes(pool, list("abcde")))
    runs: dict[str, list[tuple[float, float]]] = {}
    for name in "abcde":
        gpu, start, end = (tmp_path / f"{name}.log").read_text().split()
        runs.setdefault(gpu, []).append((float(start), float(end)))
    assert set(runs) == {"0", "1"}
    for spans in map(sorted, runs.values()):
        assert all(end <= start for (_, end), (start, _) in pairwise(spans))


@needs_proc
def test_processes_of_a_pool_whose_own_process_is_killed_save_their_state_and_end(tmp_path):
    child = (
        "import os, signal, sys, time\n"
        "from freegeo.host import end_with_parent\n"
        "signal.signal(signal.SIGTERM, lambda *_: (print('saved', flush=True), sys.exit(143)))\n"
        "end_with_parent()\n"
        "print(os.getpid(), flush=True)\n"
        "time.sleep(60)"
    )
    parent = (
        "import sys\nfrom pathlib import Path\nfrom freegeo.pools import ProcessPool, outcomes\n"
        f"pool = ProcessPool(lambda item, again: [sys.executable, '-c', {child!r}], Path, [{{}}, {{}}])\n"
        "list(outcomes(pool, sys.argv[1:]))"
    )
    logs = [tmp_path / name for name in "ab"]

    def wait_for(words: int):
        deadline = time.monotonic() + 30
        while not all(log.is_file() and len(log.read_text().split()) == words for log in logs):
            assert time.monotonic() < deadline, [log.read_text() for log in logs if log.is_file()]
            time.sleep(0.02)
        return [log.read_text().split() for log in logs]

    with subprocess.Popen([sys.executable, "-c", parent, *map(str, logs)]) as process:
        pids = [int(pid) for (pid,) in wait_for(1)]
        time.sleep(0.3)
        assert all(Path(f"/proc/{pid}").exists() for pid in pids), "they go on while it lives"
        process.kill()
    assert [said for _, said in wait_for(2)] == ["saved"] * 2
    deadline = time.monotonic() + 10
    while any(state(pid) != "Z" for pid in pids):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def state(pid: int) -> str:
    """The letter that says what a process does, Z once it has ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return "Z"


@needs_proc
def test_leaving_a_pool_asks_its_processes_to_end(tmp_path):
    """Also Ctrl-C, which reaches the pool's process alone."""
    code = (
        "import signal, sys, time\n"
        "signal.signal(signal.SIGTERM, lambda *_: (print('saved', flush=True), sys.exit(143)))\n"
        "print('ready', flush=True)\n"
        "time.sleep(60)"
    )
    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt), pool_of(tmp_path, code, [{}, {}]) as pool:
        for item in "ab":
            pool.start(item, again=False)
        logs = [tmp_path / f"{item}.log" for item in "ab"]
        while not all(log.is_file() and "ready" in log.read_text() for log in logs):
            pool.ended()
        raise KeyboardInterrupt
    assert time.monotonic() - started < 30
    assert [log.read_text().split() for log in logs] == [["ready", "saved"]] * 2
    assert not [line for line in descendants(os.getpid()).values() if "signal.SIGTERM" in line]
