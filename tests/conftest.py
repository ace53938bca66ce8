"""Settings of all tests."""

import logging
import signal

import pytest
import torch
from hypothesis import settings

import offline

# The same examples in every run: a suite that fails once in a while says nothing about a change.
settings.register_profile("repeatable", derandomize=True)
settings.load_profile("repeatable")

# A shell that starts the suite in the background lets it ignore Ctrl-C, which some tests press.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


offline.watch(lambda text: pytest.fail(f"a test {text}"))


@pytest.fixture(autouse=True)
def no_network():
    """Fail a test that asked the network, also where the exception was lost."""
    offline.asked.clear()
    yield
    assert not offline.asked


@pytest.fixture(autouse=True)
def fresh_log():
    """Start with the package's logger as it is in a new process: the commands set its level and handlers."""
    logger = logging.getLogger("freegeo")
    logger.setLevel(logging.NOTSET)
    logger.handlers.clear()
    logger.propagate = True


@pytest.fixture
def one_thread():
    """Compute with one thread, and give the threads back."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def short_flights(monkeypatch):
    """Make fly-throughs of a few pictures, which are what takes time when all formats are written."""
    monkeypatch.setattr("freegeo.export.flight.LEAST_FRAMES", 6)
    monkeypatch.setattr("freegeo.export.flight.FRAMES_PER_VIEW", 2)
