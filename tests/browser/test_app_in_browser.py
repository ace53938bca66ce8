"""The web app as a visitor uses it: upload, progress, cancel, result, two pages at once, and pages of others."""

import http.client
import io
import os
import re
import signal
import socket
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from PIL import Image

import offline
from freegeo.data.procedural import render, sample_rooms
from processes import descendants

pytest.importorskip("gradio")
SOURCE = Path(__file__).parents[2] / "src"
RUN_MS = 90_000
BRIGHT = """() => {
  const canvas = document.getElementById("canvas3d");
  return canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data.filter((v, k) => k % 4 == 3 && v).length;
}"""  # noqa: E501


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """Eight photos of a room, 64 x 48."""
    folder = tmp_path_factory.mktemp("photos")
    views = render(sample_rooms([20_000_003], domain="test-id", frames=8), 48, 64)
    for k, image in enumerate(views.images[0]):
        pixels = (image.permute(1, 2, 0) * 255).round().byte().numpy()
        Image.fromarray(pixels).save(folder / f"{k}.png")
    return sorted(folder.iterdir())


class Server:
    """`freegeo app` in a process of its own, without weights and without a network."""

    def __init__(self, folder: Path):
        with socket.create_server(("127.0.0.1", 0)) as probe:
            self.port = probe.getsockname()[1]
        self.temporary = folder / "temporary"
        self.temporary.mkdir()
        self.asked = offline.watch_processes(folder)
        environment = {name: value for name, value in os.environ.items() if not name.startswith(("HF_", "GRADIO_"))}
        environment |= {
            "PYTHONPATH": os.pathsep.join((str(folder), str(SOURCE))), "OMP_NUM_THREADS": "1",
            "HF_HOME": str(folder / "hub"), "HF_HUB_OFFLINE": "1", "TMPDIR": str(self.temporary), "GRADIO_SHARE": "1",
        }  # fmt: skip
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", "freegeo.cli.app", "app", f"--port={self.port}", "--model=freegeo-tiny"],
            cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if "in a browser" in line:
                break
        self.address = f"http://127.0.0.1:{self.port}/"

    def get(self, path: str, **headers: str) -> tuple[int, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read()

    def runs(self) -> list[int]:
        return [pid for pid, line in descendants(self.process.pid).items() if "freegeo.cli.app run" in line]


@pytest.fixture(scope="module")
def app(tmp_path_factory):
    server = Server(tmp_path_factory.mktemp("app"))
    yield server
    below = descendants(server.process.pid)
    server.process.send_signal(signal.SIGINT)
    assert server.process.wait(30) == 0, server.process.stdout.read()
    assert not [pid for pid in below if Path(f"/proc/{pid}").exists()], "runs end with the app"
    assert list(server.temporary.iterdir()) == []
    assert server.asked.read_text() == ""


def prepare(page, files, *, adapt=True, steps: int | str = 2):
    """Drop files into the page and choose what is quick."""
    page.set_input_files("#photos input[type=file]", [str(file) for file in files])
    page.wait_for_selector(".fg-uploads")
    page.get_by_text("Advanced", exact=True).click()
    page.locator("#skip-bad").wait_for()  # the last of the controls that Gradio makes when they are first shown
    field = page.get_by_label("Training steps")
    field.clear()
    field.press_sequentially(str(steps))
    field.press("Tab")
    assert field.input_value() == str(steps)
    page.locator("#refine").get_by_label("off").check()
    if not adapt:
        page.locator("#adapt input").uncheck()


def outcome(page) -> str:
    page.wait_for_selector(".fg-result, .fg-failed", timeout=RUN_MS)
    return page.inner_text("#panel")


def test_photos_become_a_result(open_page, app, photos):
    page = open_page(app.address)
    page.click("#start")
    page.wait_for_selector("#trouble .fg-sentence")
    assert "No photos yet" in page.inner_text("#trouble")
    assert page.title() == "freegeo"
    assert page.locator("#cancel").is_disabled()

    prepare(page, photos)
    assert "8 photos, 64 × 48" in page.inner_text("#noticed")
    page.click("#start")
    page.wait_for_selector(".fg-running")
    assert page.locator("#trouble .fg-sentence").count() == 0
    text = outcome(page)
    assert text.startswith("Did it help?")
    assert re.search(r"Adaptation: (yes|no|unknown)\.", text)
    assert "freegeo-tiny was trained on generated rooms" in text

    scene = page.frame_locator("#scene3d")
    scene.locator("#canvas3d").wait_for()
    assert page.frames[1].evaluate(BRIGHT) > 5000
    assert not scene.locator("h1").is_visible()
    assert page.frame_locator("#maps").locator("figure.photo img").first.is_visible()
    with page.expect_download() as fetched:
        page.click("text=Download everything")
    with zipfile.ZipFile(io.BytesIO(Path(fetched.value.path()).read_bytes())) as archive:
        assert {"freegeo/points.ply", "freegeo/scene.glb", "freegeo/report.html"} <= set(archive.namelist())

    report = page.get_attribute("text=Open the whole report", "href")
    links = re.findall(r'<li><a href="([^"]+)">', app.get(f"/{report}")[1].decode())
    assert {"frozen/prediction.npz", "adapter/", "points.ply"} <= set(links)
    for link in links:
        assert app.get(f"/{report.removesuffix('report.html')}{link}")[0] == 200, link

    for width in (390, 320):
        page.set_viewport_size({"width": width, "height": 844})
        page.wait_for_timeout(300)
        assert page.evaluate("document.documentElement.scrollWidth") <= width, "no sideways scrolling"
    page.reload()
    assert outcome(page) == text, "a page that is reloaded finds its result again"


def test_a_cancelled_run_ends_and_the_next_one_computes(open_page, app, photos):
    page = open_page(app.address)
    prepare(page, photos, steps=5000)
    page.click("#start")
    page.wait_for_selector(".fg-now .fg-bar", timeout=RUN_MS)
    assert "of 5000" in page.inner_text(".fg-now")
    (run,) = app.runs()
    page.click("#cancel")
    page.wait_for_selector(".fg-cancelled", timeout=30_000)
    assert not Path(f"/proc/{run}").exists()
    page.locator("#adapt input").uncheck()
    page.click("#start")
    assert outcome(page).startswith("Done")
    assert app.runs() == []


def test_a_broken_photo_is_named(open_page, app, photos, tmp_path):
    broken = tmp_path / "broken.png"
    broken.write_bytes(photos[0].read_bytes()[:900])
    page = open_page(app.address)
    prepare(page, [*photos[:2], broken], adapt=False, steps="")
    page.wait_for_selector(".fg-problems")
    assert page.inner_text(".fg-problems").startswith("broken.png: ")
    page.click("#start")
    text = outcome(page)
    assert "broken.png: the image is damaged" in text
    assert str(app.temporary) not in text and "Traceback" not in text
    page.locator("#skip-bad input").check()
    page.click("#start")
    page.wait_for_selector(".fg-result", timeout=RUN_MS)
    assert "broken.png" in page.inner_text(".fg-doubts")


def test_weights_that_cannot_be_downloaded_are_a_sentence(open_page, app, photos):
    page = open_page(app.address)
    page.click("#model input")
    page.get_by_role("option", name=re.compile("^da3-base .* 0.5 GB")).click()
    page.wait_for_selector("text=0.5 GB are downloaded at the first use")
    prepare(page, photos[:2], adapt=False)
    page.click("#start")
    text = outcome(page)
    assert "The checkpoint of da3-base" in text and "HF_HUB_OFFLINE is set" in text


def test_two_pages_take_turns_and_see_nothing_of_each_other(open_page, app, photos):
    first, second = open_page(app.address), open_page(app.address)
    prepare(first, photos[:3], adapt=False)
    prepare(second, photos[3:5], adapt=False)
    first.click("#start")
    first.wait_for_selector(".fg-running")
    second.click("#start")
    second.wait_for_selector(".fg-waiting")
    assert "1 reconstruction comes before yours" in second.inner_text("#panel")
    assert outcome(first)
    assert "In the queue" not in outcome(second)
    assert first.frame_locator("#maps").locator(".view h3").all_inner_texts() == ["1. 0.png", "2. 1.png", "3. 2.png"]
    assert second.frame_locator("#maps").locator(".view h3").all_inner_texts() == ["1. 3.png", "2. 4.png"]
    results = [page.get_attribute("#maps", "src").rpartition("/part")[0] for page in (first, second)]
    assert len(set(results)) == 2
    for result in results:
        assert app.get(f"/{result}/files/report.html")[0] == 200
        for path in ("files/..%2F..%2F..%2Fphotos", "files/.freegeo-run.json", "files/%2Fetc%2Fpasswd", "part/no"):
            assert app.get(f"/{result}/{path}")[0] == 404, path
    assert app.get("/result/other/files/report.html")[0] == 404
    third = open_page(app.address)
    third.wait_for_selector(".fg-begin")
    assert third.locator(".fg-result, .fg-running").count() == 0


def test_only_the_apps_own_page_is_answered(app):
    own = f"127.0.0.1:{app.port}"
    assert app.get("/", Origin=f"http://{own}")[0] == 200
    for origin in ("https://evil.example", "null", "http://127.0.0.1:1"):
        status, answer = app.get("/", Origin=origin)
        assert status == 403 and b"own page only" in answer
    assert app.get("/", Host="evil.example")[0] == 403
    for path in ("/gradio_api/file=/etc/passwd", f"/gradio_api/file={SOURCE}/freegeo/__init__.py"):
        assert app.get(path)[0] == 403
    status, answer = app.get("/")
    assert status == 200 and b"fonts.googleapis" not in answer


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [390, 1400])
def test_it_is_readable_everywhere(open_page, app, width, dark):
    page = open_page(app.address, width=width, dark=dark)
    page.wait_for_selector("#start")
    page.get_by_text("Advanced", exact=True).click()
    page.wait_for_timeout(300)
    assert page.evaluate("document.documentElement.scrollWidth") <= width, "no sideways scrolling"
    background = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (sum(int(v) for v in re.findall(r"\d+", background)[:3]) < 200) == dark
