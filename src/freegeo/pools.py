"""Work that is spread over processes of this machine or over a ray cluster (extra `cluster`).

A pool carries out items of work and tells which have ended. Where a worker died (killed, out of memory, its machine is
gone) instead of ending, `outcomes` starts the item again: the work has to continue by itself where it was.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, Self, TypeVar

from freegeo import __version__
from freegeo.errors import FreeGeoError, UserError
from freegeo.host import GRACE_S, bound_to_this_process

logger = logging.getLogger(__name__)

Item = TypeVar("Item")
RETRIES = 2
"""How often an item is started again after its worker died."""
POLL_S = 0.1
"""Seconds between two looks at what has ended."""
REACH_S = 10.0
"""Seconds in which a ray cluster has to answer."""
LOOK_S = 1.0
"""Seconds between two looks at whether the ray cluster is there."""
SILENT_S = 30.0
"""Seconds without the head of a ray cluster after which it is gone; after 60, ray itself ends the process."""
RETURN_S = 120.0
"""Seconds in which a ray cluster that is gone has to be back."""


@dataclass(frozen=True)
class Died:
    """The outcome of an item whose worker died."""

    reason: str


class Pool(Protocol):
    """Carries out items."""

    def start(self, item: Any, *, again: bool) -> None:
        """Carry out an item as soon as there is room; `again`: after its worker died."""

    def ended(self) -> Sequence[tuple[Any, Any]]:
        """Wait a moment, and return the items that have ended since, each with its outcome or `Died`."""
        ...


def outcomes(
    pool: Pool, items: Sequence[Item], *, on_wait: Callable[[], None] = lambda: None
) -> Iterator[tuple[Item, Any]]:
    """Carry out items and yield each with its outcome, as they end; `on_wait` is called about every `POLL_S` seconds.

    An item whose worker dies is started again, `RETRIES` times; after that its outcome is `Died`.
    """
    # By identity: items need not be hashable.
    deaths = {id(item): 0 for item in items}
    for item in items:
        pool.start(item, again=False)
    left = len(items)
    while left:
        for item, outcome in pool.ended():
            if isinstance(outcome, Died) and deaths[id(item)] < RETRIES:
                deaths[id(item)] += 1
                logger.warning(
                    "%s: its worker died (%s). It is started again and continues where it was (%d of %d times).",
                    item, outcome.reason, deaths[id(item)], RETRIES,
                )  # fmt: skip
                pool.start(item, again=True)
            else:
                left -= 1
                yield item, outcome
        on_wait()


class ProcessPool:
    """Commands in processes of this machine; the outcome of an item is the exit code of its command.

    Used as a context, it stops the processes that are left at the end: they are asked to end, and killed after
    `GRACE_S` seconds. Those of freegeo commands end by themselves when this process is killed
    (`freegeo.host.end_with_parent`).

    Args:
        command: the command line of an item; its second argument says whether its process died before.
        log: the file that the output of an item's process is appended to.
        environments: what each of the processes that run at once has besides this process's environment variables.
    """

    def __init__(
        self,
        command: Callable[[Any, bool], Sequence[str]],
        log: Callable[[Any], Path],
        environments: Sequence[Mapping[str, str]],
    ):
        self._command, self._log = command, log
        self._free = deque(environments)
        self._waiting: deque[tuple[Any, bool]] = deque()
        self._running: list[tuple[subprocess.Popen, Any, Mapping[str, str]]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        """Stop what is still running."""
        processes = [process for process, _, _ in self._running]
        for process in processes:
            process.terminate()
        deadline = time.monotonic() + GRACE_S
        for process in processes:
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            _close(process)

    def start(self, item: Any, *, again: bool) -> None:
        """Carry out an item as soon as there is room."""
        # First in the line after a death, so that what is half done is finished first.
        (self._waiting.appendleft if again else self._waiting.append)((item, again))

    def ended(self) -> list[tuple[Any, int | Died]]:
        """Start what there is room for, wait a moment, and return what has ended."""
        while self._waiting and self._free:
            self._launch(*self._waiting.popleft())
        time.sleep(POLL_S)
        over = [one for one in self._running if one[0].poll() is not None]
        self._running = [one for one in self._running if one not in over]
        for process, _, _ in over:
            _close(process)
        self._free.extend(environment for _, _, environment in over)
        return [(item, _exit(process.returncode)) for process, item, _ in over]

    def _launch(self, item: Any, again: bool) -> None:
        environment, bound = self._free.popleft(), bound_to_this_process()
        with self._log(item).open("ab") as log:
            process = subprocess.Popen(
                self._command(item, again), stdin=bound["stdin"], stdout=log, stderr=subprocess.STDOUT,
                env={**bound["env"], **environment},
                # Ctrl-C reaches this process alone, which stops the others.
                process_group=0,
            )  # fmt: skip
        self._running.append((process, item, environment))


def _close(process: subprocess.Popen) -> None:
    """Close the pipe by which an ended process would have noticed the end of this one."""
    if process.stdin is not None:
        process.stdin.close()


def _exit(code: int) -> int | Died:
    """Tell an exit code of a command from the end of a process that something stopped."""
    if code < 0:
        with contextlib.suppress(ValueError):
            return Died(signal.Signals(-code).name)
        return Died(f"signal {-code}")
    return Died(f"exit code {code}") if code > 127 else code


class RayPool:
    """Work on the cluster that ray is connected to (`RAY_ADDRESS`), or on the processors of this machine.

    All machines must see the folders that the work reads and writes. Used as a context, it stops the work that is left
    at the end. When the cluster, or ray on this machine, ends and is back within `RETURN_S` seconds, the pool connects
    anew and starts what has not ended again, `RETRIES` times.

    Args:
        work: a function of a module, or a partial of one; takes an item, and whether its worker died before.
        gpu: a worker needs a GPU; else a processor. None: a GPU where the cluster has any.
        fresh: every item gets a new process; else a worker goes on with the next item, and keeps what it has loaded.

    Raises:
        UserError: ray is not installed, or does not find its cluster.
    """

    def __init__(self, work: Callable[[Any, bool], Any], *, gpu: bool | None, fresh: bool = False):
        self._ray, self._is_own = _connected()
        self._ends = _Ends(self._ray)
        self._returns = 0
        if gpu is None:
            gpu = self._ray.cluster_resources().get("GPU", 0) >= 1
        resources = {"num_gpus": 1} if gpu else {"num_cpus": 1}
        # Deaths are counted by `outcomes`. 0 calls stand for any number, which is not ray's default with GPUs.
        self._remote = self._ray.remote(max_retries=0, max_calls=int(fresh), **resources)(_carry_out)
        self._work = work
        self._running: dict[Any, Any] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        """Stop what is still running."""
        for reference in self._running:
            self._ray.cancel(reference, force=True)
        if self._is_own:
            self._ray.shutdown()

    def start(self, item: Any, *, again: bool) -> None:
        """Give an item to ray, which carries it out as soon as a worker is free."""
        self._running[self._remote.remote(__version__, self._work, item, again)] = item

    def ended(self) -> list[tuple[Any, Any]]:
        """Wait a moment, and return what has ended; FreeGeoError for an error of the work itself, or a lost cluster."""
        # A signal that comes while ray itself waits would end this process with ray's exit code.
        time.sleep(POLL_S)
        if self._ends.are_gone():
            self._return()
        done, _ = self._ray.wait(list(self._running), num_returns=len(self._running), timeout=0)
        return [(self._running.pop(reference), self._outcome(reference)) for reference in done]

    def _return(self) -> None:
        """Connect anew, and start what was running again."""
        self._returns += 1
        if self._returns > RETRIES or not self._is_own:
            raise FreeGeoError("the ray cluster is gone. The same command continues when it is there again.")
        logger.warning(
            "the ray cluster is gone, or ray on this machine. What was running is started again and continues where it "
            "was, if the cluster is back within %.0f s (%d of %d times).",
            RETURN_S, self._returns, RETRIES,
        )  # fmt: skip
        items = list(self._running.values())
        self._running.clear()
        self._ray.shutdown()
        deadline = time.monotonic() + RETURN_S
        while True:
            try:
                self._ray, self._is_own = _connected()
                break
            except UserError as error:
                if time.monotonic() > deadline:
                    raise FreeGeoError(f"{error} Start the cluster; then the same command continues.") from None
            time.sleep(LOOK_S)
        self._ends = _Ends(self._ray)
        for item in items:
            self.start(item, again=True)

    def _outcome(self, reference: Any) -> Any:
        errors = self._ray.exceptions
        try:
            outcome, warnings = self._ray.get(reference)
        except errors.RayTaskError as error:
            if isinstance(error.cause, FreeGeoError):
                raise error.cause from None
            raise FreeGeoError(
                f"a worker of ray failed: {type(error.cause).__name__}: {error.cause}. Do all machines have the same "
                "freegeo?"
            ) from error
        except errors.RayError as error:
            return Died(type(error).__name__)
        for warning in warnings:
            logger.warning("%s", warning)
        return outcome


class _Ends:
    """What a connection to a ray cluster rests on: ray on this machine, and the head of the cluster.

    ray tells of neither: without the first it waits for ever, without the second it ends this process after a minute.
    A client (`ray://`) sees neither, so that they are not watched.
    """

    def __init__(self, ray: Any):
        self._here = self._head = None
        self._looked = self._answered = time.monotonic()
        if os.environ.get("RAY_ADDRESS", "").startswith("ray://"):
            return
        about = ray.get_runtime_context()
        node = next(node for node in ray.nodes() if node["NodeID"] == about.get_node_id())
        self._here, self._head = f"{node['NodeManagerAddress']}:{node['NodeManagerPort']}", about.gcs_address

    def are_gone(self) -> bool:
        """Look once in `LOOK_S` seconds whether one of the ends is gone."""
        now = time.monotonic()
        if self._here is None or self._head is None or now - self._looked < LOOK_S:
            return False
        self._looked = now
        try:
            _require_reachable(self._here)
        except ConnectionRefusedError:
            return True
        except OSError:
            # A busy machine may be late.
            return False
        with contextlib.suppress(OSError):
            _require_reachable(self._head)
            self._answered = now
        return now - self._answered > SILENT_S


def _carry_out(version: str, work: Callable[[Any, bool], Any], item: Any, again: bool) -> tuple[Any, list[str]]:
    """Do the work for an item, in a worker of ray; returns its outcome and the warnings of the package."""
    if version != __version__:
        raise UserError(f"a machine of the ray cluster has freegeo {__version__}, this one {version}. Install one.")
    warnings = _Warnings(logging.WARNING)
    package = logging.getLogger("freegeo")
    package.addHandler(warnings)
    try:
        return work(item, again), warnings.sentences
    finally:
        package.removeHandler(warnings)


class _Warnings(logging.Handler):
    """Keeps warnings for the process that shows them."""

    def __init__(self, level: int):
        super().__init__(level)
        self.sentences: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.sentences.append(record.getMessage())


def _connected() -> tuple[Any, bool]:
    """Return ray, connected, and whether the connection was made here."""
    try:
        ray: Any = import_module("ray")
    except ImportError:
        raise UserError("--cluster needs ray: pip install 'freegeo[cluster]'.") from None
    if ray.is_initialized():
        return ray, False
    before, address, token = signal.getsignal(signal.SIGTERM), os.environ.get("RAY_ADDRESS", ""), ""
    try:
        _require_reachable(address)
        if address:
            token = " Set RAY_AUTH_MODE=token if the cluster asks for a token."
        ray.init(log_to_driver=False, logging_level=logging.WARNING)
    except (OSError, RuntimeError, ValueError) as error:
        where = f" with RAY_ADDRESS={address}" if address else ""
        raise UserError(f"ray cannot be used{where}: {' '.join(str(error).split())}.{token}") from None
    if threading.current_thread() is threading.main_thread():
        # It puts a handler of its own there, after which SIGTERM would not end this process as it should.
        signal.signal(signal.SIGTERM, before)
    return ray, True


def _require_reachable(address: str) -> None:
    """Raise OSError when nobody listens at `host:port`, for which ray itself would wait for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), timeout=REACH_S).close()
