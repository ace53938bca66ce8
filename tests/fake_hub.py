"""A model hub on this machine that hands out one file: how it answers, where it breaks off, what it was asked for."""

import hashlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from huggingface_hub import constants

COMMIT = "0123456789" * 4
CLOSED = "http://127.0.0.1:9"
"""Where nothing answers."""
ENVIRONMENT = (
    *("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "NO_PROXY", "HF_TOKEN", "SSL_CERT_FILE", "SSL_CERT_DIR"),
    *("http_proxy", "https_proxy", "all_proxy", "no_proxy"),
)
"""Settings of the person at the machine that change how a hub is reached."""


class Hub:
    """The file, and the ways in which the hub can behave; `reset` makes it well-behaved."""

    def __init__(self, content: bytes):
        self.reset(content)
        ours = self

        class Handler(BaseHTTPRequestHandler):
            def answer(self, *, with_content: bool) -> None:
                if "/resolve/" not in self.path:  # the library's own questions, about other things than files
                    self.send_error(404)
                    return
                start = int((self.headers.get("Range") or "bytes=0-")[6:].partition("-")[0])
                ours.asked.append(f"{self.command} {self.path}")
                if with_content:
                    ours.starts.append(start)
                    ours.tokens.append(self.headers.get("Authorization"))
                start = start if ours.takes_ranges else 0
                self.send_response(206 if start and ours.status == 200 else ours.status)
                if ours.is_hub:
                    self.send_header("X-Repo-Commit", COMMIT)
                    self.send_header("ETag", f'"{ours.tag or hashlib.sha256(ours.content).hexdigest()}"')
                if ours.error:
                    self.send_header("X-Error-Code", ours.error)
                self.send_header("Content-Length", str(len(ours.content) - start))
                if start:
                    self.send_header("Content-Range", f"bytes {start}-{len(ours.content) - 1}/{len(ours.content)}")
                self.end_headers()
                if with_content:
                    self.wfile.write(ours.content[start : ours.breaks_off_at])
                    if ours.breaks_off_at is not None:
                        ours.has_broken_off.set()
                        ours.may_hang_up.wait(60)

            def do_HEAD(self):
                self.answer(with_content=False)

            def do_GET(self):
                self.answer(with_content=True)

            def log_message(self, *arguments):
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"

    def reset(self, content: bytes) -> None:
        self.content, self.status, self.error, self.tag, self.is_hub = content, 200, "", None, True
        self.takes_ranges = True
        self.breaks_off_at: int | None = None
        """Byte of the file after which nothing more comes."""
        self.has_broken_off, self.may_hang_up = threading.Event(), threading.Event()
        self.may_hang_up.set()
        self.asked: list[str] = []
        self.starts: list[int] = []
        """First byte that each GET asked for."""
        self.tokens: list[str | None] = []


@contextmanager
def running(content: bytes) -> Iterator[Hub]:
    """A hub that answers until the block ends."""
    hub = Hub(content)
    thread = threading.Thread(target=hub.server.serve_forever, args=(0.01,))
    thread.start()
    yield hub
    hub.server.shutdown()
    thread.join()
    hub.server.server_close()


def use_endpoint(monkeypatch: pytest.MonkeyPatch, url: str) -> None:
    """Let the hub library of this process ask the hub at an address."""
    monkeypatch.setattr(constants, "ENDPOINT", url)
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", url + "/{repo_id}/resolve/{revision}/{filename}")
