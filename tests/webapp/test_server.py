"""The web app's server and the parts of its page, without Gradio and without a browser."""

import json
import zipfile
from pathlib import Path

import pytest
from PIL import Image

from freegeo import report
from freegeo.errors import UserError
from freegeo.lock import LOCK_FILE
from freegeo.models import catalog
from freegeo.report.contents import FILES
from freegeo.report.result import SUMMARY_NAME
from freegeo.webapp import page, server
from freegeo.webapp.runs import PHOTOS, RESULT, Run
from freegeo.webapp.sessions import Session


def asked(path: str = "/", kind: str = "http", **headers: str) -> dict:
    return {"type": kind, "path": path, "headers": [(name.encode(), text.encode()) for name, text in headers.items()]}


@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_no_other_page_is_answered(kind):
    guard = server.Guard(None, "127.0.0.1")
    own = "http://localhost:7860"
    assert guard.may_answer(asked(kind=kind, host="localhost:7860"))
    assert guard.may_answer(asked(kind=kind, host="localhost:7860", origin=own))
    assert guard.may_answer(asked(kind=kind, host="192.168.1.7:7860", origin="http://192.168.1.7:7860"))
    for origin in ("https://evil.example", "null", "http://localhost:8000", "http://127.0.0.1:7860", ""):
        assert not guard.may_answer(asked(kind=kind, host="localhost:7860", origin=origin)), origin
    # A name of somebody else that is made to lead here: such a page reads without saying where it is from.
    assert not guard.may_answer(asked(kind=kind, host="evil.example:7860"))
    assert not guard.may_answer(asked(kind=kind))


@pytest.mark.parametrize("path", ["/gradio_api/file=/etc/passwd", "/gradio_api/file/x", "/gradio_api/proxy=http://a.b"])
def test_gradios_own_ways_to_files_are_closed(path):
    assert not server.Guard(None, "127.0.0.1").may_answer(asked(path, host="localhost"))


@pytest.fixture
def finished(tmp_path):
    """A run whose result has the files that the page looks at."""
    result = tmp_path / RESULT
    (result / "frozen").mkdir(parents=True)
    (tmp_path / PHOTOS).mkdir()
    for number in range(3):
        (tmp_path / PHOTOS / f"{number}.jpg").touch()
    for name in ("report.html", "prediction.npz", "frozen/prediction.npz", ".freegeo-run.json", LOCK_FILE):
        (result / name).write_text(name)
    verdict = {"outcome": "adapted", "reason": "The matches fit better."}
    recipe = {"name": "scene", "steps": 100, "lr": 3e-5, "hold": 1.0}
    warning = f"{tmp_path}/photos/a.jpg: almost black."
    summary = {
        "format": 1,
        "recipe": recipe,
        "verdict": verdict,
        "filters": {},
        "warnings": [warning],
        "images": ["1.jpg"],
    }
    (result / SUMMARY_NAME).write_text(json.dumps(summary))
    (result / "link").symlink_to("/etc/passwd")
    run = Run(folder=tmp_path, inputs=(), command=[])
    run.state = "done"
    return run


def test_the_zip_file_holds_the_result_and_nothing_else(finished):
    path = server.zipped(finished, finished.result)
    with zipfile.ZipFile(path) as archive:
        names = set(archive.namelist())
        assert archive.testzip() is None
    assert {"freegeo/report.html", "freegeo/prediction.npz", "freegeo/frozen/prediction.npz"} <= names
    assert not [name for name in names if LOCK_FILE in name or "link" in name]
    written = path.stat().st_mtime_ns
    assert server.zipped(finished, finished.result).stat().st_mtime_ns == written


def test_the_files_that_the_report_links_to_are_there_and_no_others(finished):
    result = finished.result
    for name in ("prediction.npz", "frozen/prediction.npz", "frozen/", "frozen"):
        assert server.part_of(result, name) == result / name
    for name in ("", ".", "..", "../photos", "frozen/../../photos", str(result), "/etc/passwd", "link", "link/x", "no",
                 ".freegeo-run.json", LOCK_FILE, "frozen/\0", "x" * 5000):  # fmt: skip
        assert server.part_of(result, name) is None, name
    (result / "elsewhere").symlink_to(finished.folder / PHOTOS)
    assert server.part_of(result, "elsewhere/0.jpg") is None
    path = server.zipped(finished, result / "frozen")
    assert path.name == "freegeo-frozen.zip"
    with zipfile.ZipFile(path) as archive:
        assert archive.namelist() == ["freegeo/frozen/prediction.npz"]


def test_every_file_of_a_result_is_explained_as_in_the_report(finished):
    listed = {file["name"]: file["about"] for file in page.files(finished)}
    for name in ("report.html", "prediction.npz", "reconstruction.json"):
        assert listed[name] == FILES[name]


def test_the_verdict_comes_first(finished):
    text = page.result(finished, kept=False)
    assert "<b>Adaptation: yes.</b> The matches fit better." in text
    parts = ("Did it help?", ">a.jpg: almost black.", "/part/scene", "/part/photos", ".zip")
    assert sorted(parts, key=text.index) == list(parts)
    assert f"result/{finished.token}/files/prediction.npz" in text
    assert "<dd>1 of 3</dd>" in text
    assert "30 min after this page is closed" in text
    assert f"stay in {finished.folder}" in page.result(finished, kept=True)


def test_a_part_of_the_report_is_the_whole_page_with_the_rest_hidden():
    template = (Path(report.__file__).parent / "templates" / "report.html.j2").read_text("utf-8")
    for part in server.PARTS:
        assert f'<section id="{part}"' in template
        shown = server.one_part("<head></head><body></body>", part)
        assert f"main > *:not(#{part})" in shown.partition("</head>")[0]


def test_what_is_wrong_with_uploads_is_said_at_once(tmp_path):
    Image.new("RGB", (64, 48), "teal").save(tmp_path / "good.png")
    (tmp_path / "<b>bad.jpg").write_bytes(b"no image")
    text = page.about_uploads(Session(uploads=[tmp_path / "good.png", tmp_path / "<b>bad.jpg"]))
    assert "<b>1 photo</b>, 64 × 48" in text
    assert "&lt;b&gt;bad.jpg: the file is not a readable image." in text
    assert "data:image/jpeg" in text
    assert page.about_uploads(Session()).strip() == ""


def test_all_models_can_be_chosen_with_licence_and_size():
    found = page.models()
    assert [item.name for item in found] == catalog.names()
    for item in found:
        assert item.licence in page.about_model(item)
    names = ("da3-base", "da3-large", "vggt-1b-commercial")
    shown = [page.short_licence(catalog.entry(name)) for name in names]
    assert shown == ["Apache-2.0", "CC BY-NC 4.0, non-commercial", "VGGT License"]
    assert ["fg-caution" in page.about_model(catalog.entry(name)) for name in names] == [False, True, True]
    assert page.download_of(catalog.entry("freegeo-tiny")) == "included"
    assert page.download_of(catalog.entry("da3-base")) == "0.5 GB"


def test_an_unknown_model_or_a_missing_extra_is_refused_before_anything_starts(monkeypatch):
    with pytest.raises(UserError, match="unknown model"), server.serving(host="127.0.0.1", port=7860, model="no"):
        pass
    monkeypatch.setattr(server, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"freegeo\[app\]"), server.serving(host="127.0.0.1", port=7860):
        pass


def test_a_page_whose_run_was_removed_says_so(tmp_path):
    assert "away for too long" in page.panel(None, Session(), gone=True)
    assert "away for too long" not in page.panel(None, Session())


def test_sentences_begin_with_a_capital_and_names_of_files_stay_as_they_are():
    assert [page.capital(text) for text in ("no photos", "a.jpg: damaged", "")] == ["No photos", "a.jpg: damaged", ""]


def test_numbers_are_whole_or_left_out():
    assert [page.whole_number(text, page.STEPS) for text in ("", " 7 ", "100")] == [None, 7, 100]
    for text in ("0", "-1", "1.5", "many", "--steps", "9" * 5000):
        with pytest.raises(UserError, match=r"Training steps \(--steps\) is a whole number from 1 on"):
            page.whole_number(text, page.STEPS)
