"""The viewer draws in a browser what its controls say; Chromium renders in software, so pictures take a moment."""

import io
import socket
import time

import numpy as np
import pytest
from PIL import Image

from example_results import write_example

pytest.importorskip("viser")
from freegeo.report.viewer import open_viewer

PATIENCE_S = 60


@pytest.fixture(scope="module")
def viewer(tmp_path_factory):
    folder = write_example(tmp_path_factory.mktemp("viewer") / "out")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    shown = open_viewer([folder], port=port)
    yield shown, f"http://127.0.0.1:{port}"
    shown.close()


def picture(page) -> np.ndarray:
    """The left two thirds of the page, where no controls are."""
    image = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    return np.asarray(image)[180:, : image.width * 2 // 3].astype(int)


def settled(page) -> np.ndarray:
    """The picture once it stands still."""
    before, end = picture(page), time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        page.wait_for_timeout(500)
        now = picture(page)
        if np.array_equal(now, before) and drawn(now) > 0:
            return now
        before = now
    pytest.fail("the viewer did not come to rest")


def drawn(image: np.ndarray) -> int:
    return int((image.min(axis=-1) < 235).sum())


def test_the_viewer_follows_its_controls(open_page, viewer):
    shown, address = viewer
    page = open_page(address, width=900, height=600)
    page.get_by_text("Hide least confident").wait_for(timeout=1000 * PATIENCE_S)
    page.wait_for_timeout(3000)
    start = settled(page)
    assert drawn(start) > 2000

    shown.hidden.value = 80
    fewer = settled(page)
    assert drawn(fewer) < 0.7 * drawn(start)
    shown.hidden.value = 0
    shown.mode.value = "confidence"
    coloured = settled(page)
    assert (coloured != start).any(axis=-1).sum() > 1000
    shown.mode.value = "photo"
    shown.size.value = 5
    assert drawn(settled(page)) > 1.05 * drawn(start)
    shown.size.value = 1.5

    page.get_by_role("button", name="Swap before / after").click()
    page.wait_for_timeout(500)
    assert shown.shown.value == "frozen"
    assert (settled(page) != start).any(axis=-1).sum() > 1000
    shown.shown.value = "adapted"
    shown.with_cameras.value = False
    without = settled(page)
    assert drawn(without) < drawn(start)

    shown.follow.value = shown.follow.options[2]
    inside = settled(page)
    assert drawn(inside) > 1.5 * drawn(without), "from a camera's place, what it saw fills the picture"
    with page.expect_download(timeout=1000 * PATIENCE_S) as download:
        page.get_by_role("button", name="Save screenshot").click()
    with Image.open(download.value.path()) as saved:
        assert saved.size == (1920, 1080)
        assert np.asarray(saved.convert("RGB")).std() > 20
