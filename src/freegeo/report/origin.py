"""A guard for the viewer's server: browsers get the scene only for the viewer's own page, not for any other web page.

Browsers let every page open a websocket to every server, localhost included, and say in the header `Origin` which page
it is. viser does not look at it, so its requests are checked here before it sees them. Programs other than browsers can
write any header: this is no password.
"""

from __future__ import annotations

import ipaddress
import logging
import socket
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from freegeo.errors import FreeGeoError, UserError

logger = logging.getLogger(__name__)

LOCAL_HOSTS = frozenset({"127.0.0.1", "localhost", "::1"})
REFUSAL = "This viewer answers its own page only. Open the address that freegeo printed, or the machine's IP address.\n"
_MOST_TOLD = 10
"""Most foreign pages that the log names."""
_SHOWN = 80


def is_own_page(origins: Sequence[str], hosts: Sequence[str], listening: str) -> bool:
    """Whether a request was made by a page that the asked server itself delivered.

    The page's address must be the one that the request went to, whatever port a tunnel gave it. A page of somebody
    else can have that too, when the name of its server is made to lead to this machine; so the name must be localhost,
    an IP address, or one of this machine.

    Args:
        origins: values of the header `Origin`.
        hosts: values of the header `Host`.
        listening: the name or address that the server listens on.
    """
    if len(origins) != 1 or len(hosts) != 1:
        return False
    try:
        page = urlsplit(origins[0])
    except ValueError:
        return False
    same = page.scheme in ("http", "https") and page.netloc.lower() == hosts[0].lower()
    return same and is_own_host(hosts[0], listening)


def is_own_host(host: str, listening: str) -> bool:
    """Whether the name in a header `Host` is localhost, an IP address, `listening`, or this machine's own name."""
    try:
        name = urlsplit(f"//{host}").hostname
    except ValueError:
        return False
    own = socket.gethostname().lower()
    return name in {"localhost", listening.lower(), own, f"{own.partition('.')[0]}.local"} or _is_address(name or "")


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def require_free_port(host: str, port: int) -> None:
    """Raise UserError when the port cannot be opened; servers of others would take another one."""
    if not 1 <= port <= 65535:
        raise UserError(f"--port must be from 1 to 65535, got {port}.")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except socket.gaierror:
        raise UserError(
            f"--host {host}: no such address of this machine. Leave it out to listen on localhost."
        ) from None
    except OSError as error:
        raise UserError(
            f"port {port} on {host} cannot be used ({error.strerror}). Choose another with --port."
        ) from None


@contextmanager
def own_pages_only(listening: str) -> Generator[None]:
    """Guard the websocket server that viser starts in this block; FreeGeoError when it starts none that can be."""
    from websockets.asyncio import server

    plain, guarded = server.serve, []
    told: set[str] = set()

    def serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            origins, hosts = request.headers.get_all("Origin"), request.headers.get_all("Host")
            asks_for_scene = bool(origins or request.headers.get_all("Upgrade"))
            if asks_for_scene and not is_own_page(origins, hosts, listening):
                _tell(told, origins)
                return connection.respond(403, REFUSAL)
            return None if process_request is None else process_request(connection, request)

        guarded.append(True)
        return plain(*arguments, process_request=check, **options)

    server.serve = serve  # ty: ignore[invalid-assignment]
    try:
        yield
    finally:
        server.serve = plain
    if not guarded:
        raise FreeGeoError("This version of viser cannot be guarded from other web pages. Install viser 1.1.")


def _tell(told: set[str], origins: Sequence[str]) -> None:
    """Log a refused page, each once."""
    page = repr(", ".join(origins)[:_SHOWN])
    if page not in told and len(told) < _MOST_TOLD:
        told.add(page)
        logger.warning(
            "the viewer refused a request of the page %s. If that is how you opened it, open it by the address that "
            "was printed, or by the machine's IP address.", page,
        )  # fmt: skip
