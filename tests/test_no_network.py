"""No test depends on a network, and no command asks it for anything unless a download was asked for."""

import json
import os
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from PIL import Image

import offline
from freegeo.data.procedural import render, sample_rooms

TESTS = Path(__file__).parent


@pytest.fixture
def asked(no_network):
    """What this test asked the network for, which is forgotten at its end."""
    yield offline.asked
    offline.asked.clear()


@pytest.mark.parametrize("host", ["example.org", "192.0.2.1"])
def test_other_machines_cannot_be_asked(host, asked):
    with pytest.raises(pytest.fail.Exception, match=f"asked the network for '{host}'"):
        socket.create_connection((host, 80))


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_thread_that_asks_is_noticed(asked):
    thread = threading.Thread(target=socket.getaddrinfo, args=("example.org", 80))
    thread.start()
    thread.join()
    assert asked == ["asked the network for 'example.org' (socket.getaddrinfo)"]


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1"])
def test_this_machine_can(host):
    with socket.create_server(("127.0.0.1", 0)) as server:
        socket.create_connection((host, server.getsockname()[1])).close()


# -- commands, in a process of their own, which with all that it starts is watched from its first line on

START = """
import json, sys
from freegeo.cli import sources, view
from freegeo.cli.app import main


def opened():
    raise KeyboardInterrupt


view.wait, sources.DEMO_FRAMES = opened, 8
for command in json.loads(sys.argv[1]):
    code = main(command)
    print("code", code, *command)
"""
TINY = ["--model", "freegeo-tiny"]
QUICK = [*TINY, "--steps", "2", "--sets", "2"]
LIGHT = [
    ["reconstruct", "rooms/room-0", "-o", "frozen", *TINY],
    ["export", "frozen", "-o", "files", "--format", "glb"],
    ["view", "frozen", "--port", "0"],
    ["app", "--port", "0"],
]
HEAVY = [
    ["models"],
    ["models", "describe", "da3-base"],
    ["run", "rooms/room-0", "-o", "adapted", *QUICK],
    ["view", "adapted", "--port", "0"],
    ["demo", "-o", "demo", *QUICK],
    ["batch", "rooms/*", "-o", "scenes", "--no-adapt", *TINY],
]


def watched(folder: Path, *arguments: str) -> tuple[str, str]:
    """Run Python in a folder and return what it printed, and what it and its processes asked the network for."""
    log = offline.watch_processes(folder)
    # A home and a cache without anything in them, and nothing that forbids a download.
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("HF_", "RAY_"))}
    paths = [str(folder), str(TESTS.parent / "src")]
    environment |= {"HF_HOME": str(folder / "hub"), "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True, timeout=240
    )
    return done.stdout + done.stderr, log.read_text()


def make_photos(folder: Path) -> None:
    """Make two folders with the same four photos of a room, 64 x 48."""
    views = render(sample_rooms([20_000_003], domain="test-id", frames=4), 48, 64)
    for name in ("room-0", "room-1"):
        (folder / name).mkdir(parents=True)
        for k, image in enumerate(views.images[0]):
            pixels = (image.permute(1, 2, 0) * 255).round().byte().numpy()
            Image.fromarray(pixels).save(folder / name / f"{k}.png")


@pytest.mark.slow
@pytest.mark.parametrize("commands", [LIGHT, HEAVY], ids=["light", "heavy"])
def test_commands_ask_the_network_for_nothing(tmp_path, commands):
    make_photos(tmp_path / "rooms")
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = str(server.getsockname()[1])
    commands = [[port if part == "0" else part for part in command] for command in commands]
    said, asked = watched(tmp_path, "-c", START, json.dumps(commands))
    codes = [line.split()[1:3] for line in said.splitlines() if line.startswith("code ")]
    assert codes == [["0", command[0]] for command in commands], said
    assert asked == ""


def test_a_download_that_is_asked_for_is_noticed(tmp_path):
    code = "from freegeo.cli.app import main; main(['models', 'download', 'da3-base'])"
    said, asked = watched(tmp_path, "-c", code)
    assert "asked the network for" in asked
    assert "could not be downloaded" in said
