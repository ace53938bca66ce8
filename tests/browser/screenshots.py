"""Remakes the documentation's screenshots from what `freegeo demo` made: `python tests/browser/screenshots.py OUT`."""

import io
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

from conftest import ARGUMENTS, CHROMIUM
from freegeo.data.photos import load_photos
from freegeo.report.page import write_report
from freegeo.report.viewer import open_viewer

FIGURES = Path(__file__).parents[2] / "docs" / "figures"
PORT = 8437
VIEWER_START_MS, SETTLE_MS = 15_000, 1_500


def save(page: Page, name: str) -> None:
    """Store what the page shows with a palette of 256 colours, which is a third of the size."""
    path = FIGURES / name
    Image.open(io.BytesIO(page.screenshot())).convert("RGB").quantize(256, kmeans=3).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def main(folder: Path) -> None:
    address = write_report(folder, photos=load_photos(folder / "photos")).resolve().as_uri()
    viewer = open_viewer([folder], port=PORT)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        for name, width, height, scheme in (
            ("report.png", 1280, 1500, "light"),
            ("report-phone.png", 390, 844, "dark"),
        ):
            page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme)
            page.goto(address)
            page.wait_for_timeout(SETTLE_MS)
            save(page, name)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto(f"http://127.0.0.1:{PORT}")
        page.wait_for_timeout(VIEWER_START_MS)
        notice = page.locator(".mantine-Notification-closeButton")
        if notice.count():
            notice.first.click()
        page.wait_for_timeout(SETTLE_MS)
        save(page, "viewer.png")
        browser.close()
    viewer.close()


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python tests/browser/screenshots.py OUT")
    main(Path(sys.argv[1]))
