"""Remakes the documentation's screenshots from what `freegeo demo` made: `python tests/browser/screenshots.py OUT`."""

import io
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from conftest import ARGUMENTS, CHROMIUM
from freegeo.cli.sources import DEMO_DOMAIN, demo_scene
from freegeo.data.photos import load_photos
from freegeo.models.catalog import EMBEDDED_MODEL
from freegeo.report.page import write_report
from freegeo.report.viewer import open_viewer
from freegeo.webapp.server import serving

FIGURES = Path(__file__).parents[2] / "docs" / "figures"
PORT, APP_PORT = 8437, 8438
APP_ROOM, APP_PHOTOS = 1, 12
"""Photos of which adaptation and refinement have different verdicts."""
VIEWER_START_MS, SETTLE_MS, RUN_MS = 15_000, 1_500, 300_000


def save(page: Page, name: str, height: int) -> None:
    """Store the page down to a height with a palette of 256 colours, which is a third of the size."""
    path = FIGURES / name
    assert page.viewport_size is not None
    shown = page.screenshot(
        full_page=True, clip={"x": 0, "y": 0, "width": page.viewport_size["width"], "height": height}
    )
    Image.open(io.BytesIO(shown)).convert("RGB").quantize(256, kmeans=3).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def main(folder: Path) -> None:
    address = write_report(folder, photos=load_photos(folder / "photos")).resolve().as_uri()
    viewer = open_viewer([folder], port=PORT)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        for name, width, window, height, scheme in (
            ("report.png", 1280, 900, 1850, "light"),
            ("report-phone.png", 390, 844, 1400, "dark"),
        ):
            page = browser.new_page(viewport={"width": width, "height": window}, color_scheme=scheme)
            page.goto(address)
            page.wait_for_timeout(SETTLE_MS)
            save(page, name, height)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto(f"http://127.0.0.1:{PORT}")
        page.wait_for_timeout(VIEWER_START_MS)
        notice = page.locator(".mantine-Notification-closeButton")
        if notice.count():
            notice.first.click()
        page.wait_for_timeout(SETTLE_MS)
        save(page, "viewer.png", 800)
        save_app(browser)
        browser.close()
    viewer.close()


def save_app(browser: Browser) -> None:
    """Let the web app reconstruct photos of a generated room with the embedded model, and store what it shows then."""
    page = browser.new_page(viewport={"width": 1280, "height": 1150})
    with TemporaryDirectory() as folder, serving(host="127.0.0.1", port=APP_PORT, model=EMBEDDED_MODEL):
        for number, photo in enumerate(demo_scene(APP_ROOM, DEMO_DOMAIN).photos[:APP_PHOTOS]):
            Image.fromarray(photo.read()).save(Path(folder, f"IMG_{2101 + number}.jpg"), quality=92)
        page.goto(f"http://127.0.0.1:{APP_PORT}")
        page.set_input_files("#photos input[type=file]", sorted(Path(folder).iterdir()))
        page.wait_for_selector(".fg-strip")
        page.click("#start")
        page.wait_for_selector(".fg-result", timeout=RUN_MS)
        page.frame_locator("#scene3d").locator("#canvas3d").wait_for()
        page.evaluate("scrollTo(0, 0)")
        page.wait_for_timeout(SETTLE_MS)
        save(page, "app.png", 1150)
        page.close()


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python tests/browser/screenshots.py OUT")
    main(Path(sys.argv[1]))
