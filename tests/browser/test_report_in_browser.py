"""The report is opened from its file, moved and switched, and its pictures change as they should."""

import base64
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

import numpy as np
import pytest

from example_results import HOSTILE_NAME, finer_photos, write_example
from example_sequences import write_sequence
from freegeo import files
from freegeo.report.page import VIEWS_A_PAGE, write_report

PIXELS = """() => {
  const canvas = document.getElementById("canvas3d");
  const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  let text = "";
  for (let at = 0; at < data.length; at += 8192) text += String.fromCharCode(...data.subarray(at, at + 8192));
  return btoa(text);
}"""
RECORD_LINES = """
  window.corners = [];
  for (const name of ["moveTo", "lineTo"]) {
    const draw = CanvasRenderingContext2D.prototype[name];
    CanvasRenderingContext2D.prototype[name] = function (x, y) { window.corners.push([x, y]); draw.call(this, x, y); };
  }
"""
LUMINANCE = """(element) => {
  const parts = (text) => text.match(/[\\d.]+/g).map(Number);
  const light = ([r, g, b]) => [r, g, b].map((v) => v / 255)
    .map((v) => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);
  let behind = element;
  while (getComputedStyle(behind).backgroundColor === "rgba(0, 0, 0, 0)") behind = behind.parentElement;
  const a = light(parts(getComputedStyle(element).color)), b = light(parts(getComputedStyle(behind).backgroundColor));
  return (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
}"""


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    folder = write_example(tmp_path_factory.mktemp("report") / "out", names=(HOSTILE_NAME,))
    return write_report(folder).as_uri()


def canvas(page) -> np.ndarray:
    """The canvas (n, 4) once it has been drawn after the last change."""
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return np.frombuffer(base64.b64decode(page.evaluate(PIXELS)), dtype=np.uint8).reshape(-1, 4)


def changed(page, before: np.ndarray) -> np.ndarray:
    """The canvas once it differs; input travels through other processes and may arrive late."""
    for _ in range(100):
        now = canvas(page)
        if not np.array_equal(now, before):
            return now
        page.wait_for_timeout(100)
    pytest.fail("the picture did not change")


def drawn(pixels: np.ndarray) -> int:
    return int((pixels[:, 3] > 0).sum())


def slide(page, name: str, value: float) -> None:
    page.eval_on_selector(
        f"#{name}", "(s, value) => { s.value = value; s.dispatchEvent(new Event('input')); }", str(value)
    )


def test_the_3d_view_follows_its_controls(open_page, address):
    page = open_page(address, width=800, height=600)
    page.uncheck("#cameras3d")
    start = canvas(page)
    assert drawn(start) > 5000
    assert len(np.unique(start[start[:, 3] > 0], axis=0)) > 500

    slide(page, "size3d", 5)
    assert drawn(canvas(page)) > 1.2 * drawn(start)
    slide(page, "size3d", 0.5)
    small = canvas(page)
    assert drawn(small) < 0.8 * drawn(start)
    slide(page, "conf3d", 80)
    assert drawn(canvas(page)) < 0.6 * drawn(small)
    assert page.inner_text("#conf3dText") == "80 %"
    slide(page, "conf3d", 0)
    slide(page, "size3d", 2)
    assert np.array_equal(canvas(page), start), "controls back where they were give the same picture"

    page.get_by_text("frozen", exact=True).first.click()
    assert not np.array_equal(canvas(page), start)
    page.get_by_text("adapted", exact=True).first.click()
    assert np.array_equal(canvas(page), start)

    for mode in ("confidence", "error"):
        page.check(f"input[name=colour3d][value={mode}]", force=True)
        coloured = canvas(page)
        assert np.array_equal(coloured[:, 3], start[:, 3]), "the same points"
        assert not np.array_equal(coloured, start)
    page.check("input[name=colour3d][value=photo]", force=True)

    page.check("#removed3d")
    pixels = canvas(page).astype(int)
    red = (pixels[:, 0] > 2.5 * pixels[:, 1]) & (pixels[:, 0] > 2.5 * pixels[:, 2]) & (pixels[:, 3] > 0)
    assert red.sum() > 200
    page.uncheck("#removed3d")
    page.check("#cameras3d")
    assert drawn(canvas(page)) > drawn(start)


@pytest.mark.parametrize(("width", "height"), [(1400, 900), (390, 844)])
@pytest.mark.parametrize("views", ["address", "many"])
def test_the_first_view_holds_the_cloud_and_all_cameras(open_page, request, views, width, height):
    page = open_page(request.getfixturevalue(views), width=width, height=height, script=RECORD_LINES)
    canvas(page)
    corners = np.array(page.evaluate("corners"))
    size = np.array(
        page.evaluate("[document.getElementById('canvas3d').width, document.getElementById('canvas3d').height]")
    )
    cameras = page.evaluate("JSON.parse(document.getElementById('scene-data').textContent).stages[0].cameras.length")
    assert len(corners) % (16 * cameras) == 0 and len(corners) > 0
    assert (corners > 0).all() and (corners < size).all()
    alpha = canvas(page)[:, 3].reshape(size[1], size[0])
    edges = [alpha[:2], alpha[-2:], alpha[:, :2], alpha[:, -2:]]
    assert not any(edge.any() for edge in edges), "nothing is cut off"
    rows, columns = (np.flatnonzero(alpha.any(axis)) for axis in (1, 0))
    assert max(np.ptp(rows) / size[1], np.ptp(columns) / size[0]) > 0.8, "and the picture is filled"
    view, hint = (page.locator(name).bounding_box() for name in ("#canvas3d", ".hint"))
    assert hint["y"] >= view["y"] + view["height"], "the hint lies over nothing"


def test_the_first_view_follows_the_window_until_it_was_moved(open_page, address):
    page = open_page(address, width=1400, height=900)
    canvas(page)
    page.set_viewport_size({"width": 390, "height": 844})
    narrow = canvas(page)
    other = open_page(address, width=390, height=844)
    assert np.array_equal(narrow, canvas(other))


def test_mouse_wheel_and_keys_move_the_view(open_page, address):
    page = open_page(address, width=800, height=600)
    page.uncheck("#cameras3d")
    box = page.locator("#canvas3d").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    start = canvas(page)

    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 80, y + 10, steps=3)
    page.mouse.up()
    turned = changed(page, start)
    page.mouse.wheel(0, -400)
    closer = changed(page, turned)
    assert drawn(closer) > drawn(turned)
    page.keyboard.press("ArrowLeft")
    changed(page, closer)
    page.click("#reset3d")
    assert np.array_equal(changed(page, closer), start)

    page.select_option("#camera3d", "1")
    inside = canvas(page)
    assert drawn(inside) > 1.5 * drawn(start), "from a camera's place, what it saw fills the picture"


def test_the_wheel_scrolls_the_page_until_the_view_was_clicked(open_page, address):
    page = open_page(address, width=800, height=600)
    start = canvas(page)
    page.hover("#canvas3d")
    page.mouse.wheel(0, 40)
    page.wait_for_function("scrollY > 0")
    assert np.array_equal(canvas(page), start)


def test_two_fingers_zoom(open_page, address):
    page = open_page(address, width=390, height=844, touch=True)
    page.uncheck("#cameras3d")
    start = canvas(page)
    page.evaluate(
        """() => {
          const canvas = document.getElementById("canvas3d"), box = canvas.getBoundingClientRect();
          canvas.setPointerCapture = () => {};
          const send = (type, id, x) => canvas.dispatchEvent(new PointerEvent(type, {
            pointerId: id, clientX: box.x + x, clientY: box.y + 100, pointerType: "touch", buttons: 1, bubbles: true,
          }));
          send("pointerdown", 11, 150); send("pointerdown", 12, 200);
          send("pointermove", 11, 125); send("pointermove", 12, 225);
          send("pointerup", 11, 125); send("pointerup", 12, 225);
        }"""
    )
    assert drawn(canvas(page)) > 1.3 * drawn(start)


def test_maps_and_models_are_chosen(open_page, address):
    page = open_page(address)

    def captions():
        shown = page.locator(".view >> nth=0 >> figcaption")
        return [text for text in shown.all_inner_texts() if text]

    def shown():
        figures = page.locator(".view >> nth=0 >> figure")
        return [f.locator("figcaption").inner_text() for f in figures.all() if f.is_visible()]

    assert shown() == ["photo", "depth, frozen", "depth, adapted", "depth, ground truth", "change of depth"]
    page.check("input[name=show][value=frozen]", force=True)
    assert "depth, adapted" not in shown()
    page.check("input[name=show][value=all]", force=True)
    page.check("input[name=map][value=error]", force=True)
    assert shown() == ["photo", "depth error, frozen", "depth error, adapted"]
    page.check("input[name=map][value=all]", force=True)
    assert len(shown()) == len(captions()) == 9
    pictures = page.evaluate("[...document.images].map((i) => [i.complete, i.naturalWidth])")
    assert all(complete and width == 64 for complete, width in pictures)
    page.locator(".enlarge >> nth=1").click()
    assert page.locator("dialog img").count() == 2
    page.click("#large-close")
    assert not page.locator("dialog").is_visible()


def test_file_names_do_nothing(open_page, address):
    page = open_page(address)
    assert page.evaluate("window.broken") is None
    assert page.locator(".view h3 >> nth=0").inner_text() == f"1. {HOSTILE_NAME}"
    assert page.locator("#camera3d option").nth(1).inner_text() == f"1: {HOSTILE_NAME}"


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [360, 390, 1280])
def test_it_is_readable_everywhere(open_page, address, width, dark):
    page = open_page(address, width=width, height=844, dark=dark)
    assert page.evaluate("document.documentElement.scrollWidth") <= width, "no sideways scrolling"
    for detail in page.locator("summary").all():
        detail.click()
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    background = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (sum(int(v) for v in background[4:-1].split(",")) < 200) == dark
    for selector in (
        "h1",
        ".note",
        "dt",
        "dd",
        "figcaption",
        ".segments input:checked + span",
        "td",
        "summary",
        ".hint",
    ):
        assert page.locator(selector).first.evaluate(LUMINANCE) >= 4.5, selector
    drawing = page.locator(".figure").first
    assert drawing.evaluate(LUMINANCE) >= 4.5
    assert drawing.bounding_box()["height"] > 150


@pytest.fixture(scope="module")
def many(tmp_path_factory):
    """32 views, with and without adaptation, and photos that are finer than what the model read."""
    folder = write_example(tmp_path_factory.mktemp("many") / "out", views=32)
    scores = {"epipolar_px": 2.0, "reprojection_px": 3.0, "depth_agreement": 0.9, "matches": 1200}
    told = {
        "recipe": {"name": "scene", "lr": 1e-3, "hold": 1.0, "steps": 60},
        "verdict": {"outcome": "adapted", "reason": "Matches fit better.", "frozen": scores},
        "refinement": {"accepted": False, "reason": "Too few pairs.", "lacking": "matches", "probability": 0.5},
    }
    files.write_json(folder / "reconstruction.json", {**files.read_json(folder / "reconstruction.json"), **told})
    return write_report(folder, photos=finer_photos(folder)).as_uri()


def test_the_page_is_short(open_page, many):
    page = open_page(many, width=1400, height=900)
    assert page.locator(".view:visible").count() == VIEWS_A_PAGE
    assert page.evaluate("document.documentElement.scrollHeight - innerHeight") < 3 * 900
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390


def test_an_enlarged_photo_leads_to_the_others(open_page, many):
    page = open_page(many, width=1400, height=900)
    page.locator(".view:visible .enlarge").first.focus()
    page.keyboard.press("Enter")
    picture = page.locator("dialog img")
    assert picture.count() == 1
    assert picture.evaluate("image => image.naturalWidth") >= 512
    assert picture.bounding_box()["width"] >= 512
    back, ahead = page.locator("#large-back"), page.locator("#large-ahead")
    assert back.is_disabled() and page.inner_text("dialog output") == "1 of 32"
    alt = picture.get_attribute("alt")
    page.keyboard.press("ArrowLeft")
    assert picture.get_attribute("alt") == alt
    ahead.click()
    for _ in range(6):
        page.keyboard.press("ArrowRight")
    assert page.inner_text("dialog output") == "8 of 32"
    assert page.inner_text("#large-title") == page.locator(".view h3").nth(7).text_content()
    back.click()
    page.keyboard.press("Escape")
    assert not page.locator("dialog").is_visible()
    assert page.inner_text(".pager output") == "7 to 12 of 32", "the photo that was seen last is on the page"
    assert page.evaluate("document.activeElement.querySelector('img').alt") == "photo of photo 6.JPG"
    page.locator(".view:visible .depth .enlarge").first.click()
    page.keyboard.press("ArrowRight")
    assert page.locator("dialog figcaption").all_inner_texts() == ["photo", "depth, frozen"]
    while ahead.is_enabled():
        page.keyboard.press("ArrowRight")
    assert page.inner_text("dialog output") == "32 of 32"


def test_links_lead_to_files_that_are_there(open_page, many):
    page = open_page(many)
    links = page.locator("#files a")
    found = [Path(url2pathname(urlsplit(link.evaluate("a => a.href")).path)) for link in links.all()]
    assert {file.name for file in found} >= {"prediction.npz", "adapter", "reconstruction.json"}
    assert all(file.exists() for file in found)
    assert all(link.get_attribute("href").split("/")[0] not in ("", "..", "file:") for link in links.all())


@pytest.mark.parametrize("dark", [False, True])
def test_keys_reach_everything_and_it_shows(open_page, many, dark):
    page = open_page(many, width=1400, height=900, dark=dark)
    assert page.evaluate("[...document.images].every((image) => image.alt)")
    named = """(e) => e.getAttribute("aria-label") || e.innerText || e.closest("label")?.innerText
      || e.querySelector("img")?.alt"""
    for control in page.locator("button:visible, select, input, canvas").all():
        assert control.evaluate(named), control.evaluate("e => e.outerHTML.slice(0, 200)")
    for _ in range(60):
        page.keyboard.press("Tab")
        ring = page.evaluate(
            """() => {
              const here = document.activeElement;
              const style = getComputedStyle(here.matches(".segments input") ? here.nextElementSibling : here);
              return [here.tagName, style.outlineStyle, parseFloat(style.outlineWidth)];
            }"""
        )
        assert ring[0] == "BODY" or (ring[1] == "solid" and ring[2] >= 2), ring
    for selector in (".verdict.yes b", ".verdict.no b", "#files a", "#files span", ".hint", ".pager output"):
        assert page.locator(selector).first.evaluate(LUMINANCE) >= 4.5, selector


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    folders = write_sequence(tmp_path_factory.mktemp("walk") / "out", 200, cut=8, unused=3)
    return [write_report(folder) for folder in reversed(folders)][-1].as_uri()


def test_many_views_are_turned_over_like_pages(open_page, walk):
    page = open_page(walk)
    shown = page.locator(".view:visible h3")
    assert shown.count() == VIEWS_A_PAGE and shown.first.inner_text() == "frame 0. frame_00000.jpg"
    back, ahead = page.locator(".pager button").all()
    assert back.is_disabled()
    seen = shown.all_inner_texts()
    while ahead.is_enabled():
        ahead.click()
        seen += shown.all_inner_texts()
    assert len(set(seen)) == len(seen) == 48
    assert page.inner_text(".pager output") == "43 to 48 of 48"
    back.click()
    assert page.inner_text(".pager output") == "37 to 42 of 48"


def test_a_line_joins_the_cameras_of_a_long_sequence(open_page, walk):
    page = open_page(walk, width=800, height=600)
    assert page.locator("#camera3d option").count() == 101
    with_cameras = canvas(page)
    page.uncheck("#cameras3d")
    assert not np.array_equal(canvas(page), with_cameras)
    page.select_option("#camera3d", "50")
    assert drawn(canvas(page)) > 1.5 * drawn(with_cameras), "inside the corridor, walls fill the picture"


def test_the_other_piece_is_a_click_away(open_page, walk):
    page = open_page(walk)
    page.click("#pieces a")
    page.wait_for_url("**/pieces/2/report.html")
    assert page.inner_text("h1") == "out, piece 2"
    page.click("#pieces a")
    page.wait_for_url(walk)


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [360, 1280])
def test_a_sequence_is_readable_everywhere(open_page, walk, width, dark):
    page = open_page(walk, width=width, height=844, dark=dark)
    for detail in page.locator("summary").all():
        detail.click()
    assert page.evaluate("document.documentElement.scrollWidth") <= width, "no sideways scrolling"
    for selector in ("#pieces li", "#pieces a", "#seams td", "#seams .unused td", "#loops .unused td", ".pager output"):
        assert page.locator(selector).first.evaluate(LUMINANCE) >= 4.5, selector
    colours = page.locator("#sequence svg text").evaluate_all("texts => texts.map((t) => getComputedStyle(t).fill)")
    assert len(set(colours)) >= 6
