"""Notices when Python code asks the network for another machine; free of other imports, for use in any process."""

import ipaddress
import sys
from collections.abc import Callable
from pathlib import Path

EVENTS = ("socket.getaddrinfo", "socket.gethostbyname", "socket.connect", "socket.sendto")
asked: list[str] = []
"""What this process asked the network for: where a thread asks, the exception ends the thread and nothing else."""


def is_local(host: object) -> bool:
    """Whether a host is this machine: no name, localhost or a loopback or wildcard address."""
    if host in (None, "", b"", "localhost", b"localhost"):
        return True
    try:
        address = ipaddress.ip_address(host.decode() if isinstance(host, bytes) else host)
    except ValueError:
        return False
    return address.is_loopback or address.is_unspecified


def watch(refuse: Callable[[str], None]) -> None:
    """Call `refuse` with a sentence for each look-up of a name and each connection to another machine.

    A hook, not a patched socket module: it also sees what compiled code does through Python, and nothing can undo it.
    """

    def hook(event: str, arguments: tuple) -> None:
        if event in EVENTS:
            target = arguments[1] if event in ("socket.connect", "socket.sendto") else arguments
            # Sockets of the UNIX family have a path in place of an address.
            if isinstance(target, tuple) and not is_local(target[0]):
                asked.append(f"asked the network for {target[0]!r} ({event})")
                refuse(asked[-1])

    sys.addaudithook(hook)


def watch_processes(folder: Path) -> Path:
    """Make Python processes that have `folder` in PYTHONPATH note what they ask for in a file, which is returned."""
    log = folder / "asked.txt"
    log.touch()
    (folder / "sitecustomize.py").write_text(
        f"""
import sys
sys.path.append({str(Path(__file__).parent)!r})
import offline

def refuse(text):
    with open({str(log)!r}, "a") as file:
        file.write(text + "\\n")
    raise ConnectionRefusedError(text)

offline.watch(refuse)
"""
    )
    return log
