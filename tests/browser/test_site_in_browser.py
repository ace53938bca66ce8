"""The documentation site, opened from the file system: complete, within the window's width, and searchable."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
GUIDE = ("index", "get-started", "choosing-a-model", "troubleshooting")
PAGES = (*GUIDE, "api", "models/da3", "source/src/freegeo/files.py")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("material", reason="needs mkdocs-material: pip install 'freegeo[docs]'")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(folder)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": "src"})
    assert built.returncode == 0, built.stderr
    return folder


@pytest.mark.parametrize(("width", "dark"), [(1400, False), (390, True)])
def test_pages_fit_the_window_and_show_their_pictures(open_page, site, width, dark):
    for name in PAGES:
        page = open_page((site / f"{name}.html").as_uri(), width=width, dark=dark)
        assert page.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth"), name
        assert page.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 0)"), name


def test_search_finds_pages_and_leaves_out_source_files(open_page, site):
    page = open_page((site / "models" / "vggt.html").as_uri())
    page.locator(".md-search__input").click()
    page.keyboard.type("bundle adjustment")
    results = page.locator(".md-search-result__link")
    results.first.wait_for()
    links = [link.get_attribute("href") for link in results.all()]
    assert any("refinement.html" in link for link in links)
    assert not any("/source/" in link for link in links)


def test_a_link_to_a_source_file_shows_it(open_page, site):
    page = open_page((site / "reliability.html").as_uri())
    page.get_by_role("link", name="lock.py").first.click()
    assert page.locator("h1").inner_text().startswith("src/freegeo/lock.py")
    assert "class Lock" in page.locator(".md-content").inner_text()
