"""`freegeo view`: one or two results in the browser, on this machine or through a tunnel."""

from __future__ import annotations

import time
from pathlib import Path

from freegeo.cli import console
from freegeo.errors import UserError
from freegeo.report.origin import LOCAL_HOSTS


def view(*folders: Path, host: str = "127.0.0.1", port: int = 8080) -> None:
    """Look at a result in the browser: points, mesh, cameras, before and after adaptation.

    Ends with Ctrl+C. Needs the extra: pip install 'freegeo[view]'.

    Parameters
    ----------
    folders
        Output folder of a run, or two of the same photos to compare.
    host
        Address to listen on; everything but localhost is open to whoever reaches it.
    port
        Port to listen on.
    """
    from freegeo.report.viewer import open_viewer

    if not 1 <= len(folders) <= 2:
        raise UserError(f"name one output folder, or two to compare; got {len(folders)}.")
    viewer = open_viewer(folders, host=host, port=port)
    say_address(host, port, "viewer", sees="the photos and points")
    try:
        wait()
    except KeyboardInterrupt:
        console.note("viewer closed.")
    finally:
        viewer.close()


def say_address(host: str, port: int, server: str, *, sees: str) -> None:
    """Print where to open a server's page, how to reach it from another machine, and who else reaches it."""
    if host not in LOCAL_HOSTS:
        console.note(
            f"Warning: listening on {host}. Anybody who reaches this machine on port {port} sees {sees}; there is no "
            "password. Leave --host out and use a tunnel to keep it private."
        )
    shown = "localhost" if host in LOCAL_HOSTS or host in ("0.0.0.0", "::") else host
    console.say(f"Open http://{shown}:{port} in a browser. Ctrl+C ends the {server}.")
    if host in LOCAL_HOSTS:
        console.say(
            f"On a remote machine: run `ssh -L {port}:localhost:{port} THIS_MACHINE` on yours, and open the same "
            "address there."
        )


def wait() -> None:
    """Sleep until somebody interrupts."""
    while True:
        time.sleep(3600)
