"""`freegeo app`: the web app, on this machine or through a tunnel."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from freegeo.cli import console
from freegeo.cli.view import say_address, wait


def webapp(
    *,
    host: str = "127.0.0.1",
    port: int = 7860,
    keep: Path | None = None,
    model: str | None = None,
    device: str | None = None,
    precision: Literal["fp32", "bf16", "fp16"] | None = None,
) -> None:
    """Reconstruct in the browser: drop photos or a video, look at the result, download it.

    Ends with Ctrl+C. Needs the extra: pip install 'freegeo[app]'.

    Parameters
    ----------
    host
        Address to listen on; everything but localhost is open to whoever reaches it.
    port
        Port to listen on.
    keep
        Folder in which photos and results stay; default: they are removed after the page was closed, and at the end.
    model
        Model that is chosen at first; default: da3-base.
    device
        cpu, cuda, cuda:N or mps, for every run; default: the best at hand.
    precision
        Arithmetic of the network, for every run; default: bf16 on CUDA, else fp32.
    """
    from freegeo.webapp.server import serving

    fixed = {"device": device, "precision": precision}
    options = [f"--{name}={value}" for name, value in fixed.items() if value is not None]
    console.note("starting the app ...")
    with serving(host=host, port=port, keep=keep, model=model, options=options):
        say_address(host, port, "app", sees="the page and can use it, with this machine's memory and disk")
        try:
            wait()
        except KeyboardInterrupt:
            console.note("app closed.")
