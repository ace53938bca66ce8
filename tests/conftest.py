"""Settings of all tests."""

import ipaddress
import logging
import sys

import pytest
import torch
from hypothesis import settings

# The same examples in every run: a suite that fails once in a while says nothing about a change.
settings.register_profile("repeatable", derandomize=True)
settings.load_profile("repeatable")


def is_local(host: object) -> bool:
    """Whether a host is this machine: no name, localhost or a loopback or wildcard address."""
    if host in (None, "", b"", "localhost", b"localhost"):
        return True
    try:
        address = ipaddress.ip_address(host.decode() if isinstance(host, bytes) else host)
    except ValueError:
        return False
    return address.is_loopback or address.is_unspecified


def forbid_network(event: str, arguments: tuple) -> None:
    """Audit hook: looking a name up, or connecting to another machine, fails the test."""
    if event in ("socket.getaddrinfo", "socket.gethostbyname", "socket.connect", "socket.sendto"):
        target = arguments[1] if event in ("socket.connect", "socket.sendto") else arguments
        # Sockets of the UNIX family have a path in place of an address.
        if isinstance(target, tuple) and not is_local(target[0]):
            pytest.fail(f"a test asked the network for {target[0]!r} ({event})")


# A hook, not a patched socket module: it also sees what compiled code does through Python, and no test can undo it.
sys.addaudithook(forbid_network)


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
