"""The guard in conftest.py: no test depends on a network."""

import socket

import pytest


@pytest.mark.parametrize("host", ["example.org", "192.0.2.1"])
def test_other_machines_cannot_be_asked(host):
    with pytest.raises(pytest.fail.Exception, match=f"asked the network for '{host}'"):
        socket.create_connection((host, 80))


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1"])
def test_this_machine_can(host):
    with socket.create_server(("127.0.0.1", 0)) as server:
        socket.create_connection((host, server.getsockname()[1])).close()
