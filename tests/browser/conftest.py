"""A headless Chromium whose complaints fail the test; without one the tests are skipped and say why."""

import os
import shutil
from pathlib import Path

import pytest

CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser") or ""
ARGUMENTS = [
    "--no-sandbox", "--headless", "--disable-gpu", "--enable-unsafe-swiftshader", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--no-first-run", "--force-color-profile=srgb",
]  # fmt: skip


def pytest_collection_modifyitems(items):
    here = Path(__file__).parent
    for item in items:
        if here in item.path.parents:
            item.add_marker(pytest.mark.browser)


@pytest.fixture(scope="session")
def chromium():
    api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install 'freegeo[browser]'")
    if not CHROMIUM:
        pytest.skip("needs Chromium: apt-get install chromium, or name it in the variable CHROMIUM")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture
def open_page(chromium):
    """Give `open_page(address, ...)`; console errors and requests that leave the machine fail the test."""
    pages, complaints = [], []

    def note_request(request):
        if not request.url.startswith(("file:", "data:", "blob:", "http://127.0.0.1:")):
            complaints.append(f"asked for {request.url}")

    def note_message(message):
        if message.type == "error":
            complaints.append(message.text)

    def open_it(address, width=1280, height=900, dark=False, touch=False, script=""):
        context = chromium.new_context(
            viewport={"width": width, "height": height}, color_scheme="dark" if dark else "light", has_touch=touch
        )
        if script:
            context.add_init_script(script)
        page = context.new_page()
        pages.append(context)
        page.on("console", note_message)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", note_request)
        page.goto(address)
        return page

    yield open_it
    for context in pages:
        context.close()
    assert complaints == []
