"""The web server: Gradio's page behind a guard, and the pages and files of results."""

from __future__ import annotations

import logging
import os
import threading
import time
import zipfile
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from freegeo.errors import FreeGeoError, UserError
from freegeo.lock import LOCK_FILE
from freegeo.models import catalog
from freegeo.report.origin import is_own_host, is_own_page, require_free_port
from freegeo.report.result import REPORT_NAME
from freegeo.webapp.runs import ZIP_NAME, ZIPS, Run
from freegeo.webapp.sessions import Sessions

if TYPE_CHECKING:
    from fastapi import FastAPI

logger = logging.getLogger(__name__)

MOST_UPLOADED = "8gb"
"""Largest file that can be uploaded."""
START_S = 30.0
PARTS = {"scene", "photos"}
"""Sections of the report that the page shows."""
CLOSED_PATHS = ("/gradio_api/file", "/gradio_api/proxy", "/gradio_api/stream", "/proxy", "/file")
"""Gradio's own ways to files and other servers, which the page needs none of."""
REFUSAL = "This app answers its own page only. Open the address that freegeo printed, or the machine's IP address.\n"
POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; frame-ancestors 'self'; base-uri 'self'; "
    "object-src 'none'"
)
HEADERS = {
    "Content-Security-Policy": POLICY, "X-Content-Type-Options": "nosniff", "Referrer-Policy": "same-origin",
}  # fmt: skip


class Guard:
    """Answers the app's own page, and no page of anybody else that a browser on this machine may have open."""

    def __init__(self, app: Any, listening: str):
        """Stand before an ASGI application that listens on a name or address."""
        self.app, self.listening = app, listening

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Answer a request, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        if not self.may_answer(scope):
            from starlette.responses import PlainTextResponse

            await PlainTextResponse(REFUSAL, status_code=403)(scope, receive, send)
            return

        async def send_with_headers(message: Any) -> None:
            if message["type"] == "http.response.start":
                there = {name.lower() for name, _ in message["headers"]}
                more = [(name.lower().encode(), value.encode()) for name, value in HEADERS.items()]
                message["headers"] = [*message["headers"], *(pair for pair in more if pair[0] not in there)]
            await send(message)

        await self.app(scope, receive, send_with_headers)

    def may_answer(self, scope: Any) -> bool:
        """Whether a request was made by the app's own page, or by nobody's, and asks for nothing that is closed."""
        headers = [(name.decode("latin-1"), value.decode("latin-1")) for name, value in scope["headers"]]
        hosts = [value for name, value in headers if name == "host"]
        origins = [value for name, value in headers if name == "origin"]
        if len(hosts) != 1 or not is_own_host(hosts[0], self.listening):
            return False
        if origins and not is_own_page(origins, hosts, self.listening):
            return False
        return not scope["path"].startswith(CLOSED_PATHS)


def application(sessions: Sessions, *, model: str, host: str, port: int) -> Guard:
    """Build the app: the page, and the addresses of results, which only the page that made one knows."""
    # Before Gradio is loaded, which reads them then.
    os.environ["GRADIO_ANALYTICS_ENABLED"] = "False"
    os.environ["GRADIO_TEMP_DIR"] = str(sessions.uploads)
    import gradio as gr
    from fastapi import FastAPI

    from freegeo.webapp import page

    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)
    _add_results(app, sessions)
    blocks = page.build(sessions, model=model)
    gr.mount_gradio_app(
        app, blocks, path="/", server_name=host, server_port=port, show_error=False, max_file_size=MOST_UPLOADED,
        ssr_mode=False, pwa=False, mcp_server=False, enable_monitoring=False, allowed_paths=[],
        favicon_path=str(page.HERE / "icon.svg"), **page.design(),
    )  # fmt: skip
    return Guard(app, host)


def _add_results(app: FastAPI, sessions: Sessions) -> None:
    from fastapi import HTTPException
    from fastapi.responses import FileResponse, HTMLResponse

    zipping = threading.Lock()

    def finished(token: str) -> Run:
        run = sessions.finished(token)
        if run is None:
            raise HTTPException(404, "there is no such result, or not any more.")
        return run

    @app.get("/result/{token}/part/{part}")
    def show_part(token: str, part: str) -> HTMLResponse:
        run = finished(token)
        if part not in PARTS:
            raise HTTPException(404, "there is no such part.")
        return HTMLResponse(one_part((run.result / REPORT_NAME).read_text("utf-8"), part))

    @app.get("/result/{token}/files/{name:path}")
    def fetch_file(token: str, name: str) -> FileResponse:
        run = finished(token)
        path = part_of(run.result, name)
        if path is None:
            raise HTTPException(404, "there is no such file.")
        if path.is_dir():
            with zipping:
                path = zipped(run, path)
        inline = name == REPORT_NAME
        return FileResponse(path, filename=path.name, content_disposition_type="inline" if inline else "attachment")

    @app.get(f"/result/{{token}}/{ZIP_NAME}")
    def fetch_all(token: str) -> FileResponse:
        run = finished(token)
        with zipping:
            path = zipped(run, run.result)
        return FileResponse(path, filename=ZIP_NAME)


def part_of(result: Path, name: str) -> Path | None:
    """Return a file or folder of a result by its path there, as the report links to it; None for hidden ones and links.

    None, too, for a path that leads out of the result, or that no file can have.
    """
    parts = Path(name).parts
    path = result / name
    try:
        within = (
            bool(parts)
            and not Path(name).is_absolute()
            and path.exists()
            and path.resolve() == result.resolve() / Path(name)
        )
    except (OSError, ValueError):
        return None
    return None if not within or any(part.startswith(".") for part in parts) else path


def one_part(report: str, part: str) -> str:
    """Return a report that shows one of its sections, and makes the frame that it is in as high as that."""
    from freegeo.webapp.page import render

    return report.replace("</head>", f"{render('part.html.j2', part=part)}</head>", 1)


def zipped(run: Run, folder: Path) -> Path:
    """Return the zip file of a result, or of a folder in it, which is made at the first call."""
    path = run.folder / ("-".join([ZIPS, *folder.relative_to(run.result).parts]) + ".zip")
    if not path.is_file():
        part = path.with_suffix(".part")
        with zipfile.ZipFile(part, "w") as archive:
            for file in sorted(folder.rglob("*")):
                if file.is_file() and not file.is_symlink() and file.name != LOCK_FILE:
                    archive.write(file, Path("freegeo", file.relative_to(run.result)))
        part.replace(path)
    return path


@contextmanager
def serving(
    *, host: str, port: int, keep: Path | None = None, model: str | None = None, options: Sequence[str] = ()
) -> Generator[Sessions]:
    """Serve the app while the block runs; then runs are ended and folders removed.

    Args:
        host: address to listen on. Other than localhost, everybody who reaches it can use the app.
        port: to listen on.
        keep: folder in which photos and results stay; None: they are removed.
        model: the one that is chosen at first; None: the default one.
        options: of `freegeo run`, for every run.

    Raises:
        UserError: Gradio is not installed, an unknown model, or a port or folder that cannot be used.
    """
    if find_spec("gradio") is None:
        raise UserError("the web app needs an extra: pip install 'freegeo[app]'")
    import uvicorn

    chosen = catalog.entry(model or catalog.DEFAULT_MODEL).name
    require_free_port(host, port)
    sessions = Sessions(keep=keep, options=options)
    try:
        app = application(sessions, model=chosen, host=host, port=port)
        config = uvicorn.Config(app, host=host, port=port, log_level="error", timeout_graceful_shutdown=1)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, name="freegeo-server", daemon=True)
        thread.start()
        deadline = time.monotonic() + START_S
        while not server.started and thread.is_alive() and time.monotonic() < deadline:
            time.sleep(0.05)
        if not server.started:
            raise FreeGeoError(f"the server did not start on {host}:{port}. Choose another --port.")
        try:
            yield sessions
        finally:
            server.should_exit = True
            thread.join(10)
    finally:
        sessions.close()
