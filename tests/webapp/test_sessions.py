"""Sessions of the web app: uploads and runs of one page each, and folders that do not outlive them."""

import errno
import sys
import tempfile
import time
from pathlib import Path

import pytest

from freegeo.errors import UserError
from freegeo.webapp import sessions as module
from freegeo.webapp.runs import PHOTOS, RESULT, Choice
from freegeo.webapp.server import zipped
from freegeo.webapp.sessions import AWAY_S, IDLE_S, PREFIX, Sessions

TINY = Choice(model="freegeo-tiny")


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    """Temporary folders are made here, and runs only sleep."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    sleep = [sys.executable, "-c", "import time; time.sleep(60)"]
    monkeypatch.setattr(module, "command", lambda *arguments: sleep)
    return tmp_path / "temporary"


@pytest.fixture
def sessions():
    sessions = Sessions()
    yield sessions
    sessions.close()


def uploaded(sessions: Sessions, *names: str) -> list[Path]:
    """Put files where the server puts uploads: each in a folder named by its content."""
    paths = [sessions.uploads / f"{number}" / name for number, name in enumerate(names)]
    for path in paths:
        path.parent.mkdir(exist_ok=True)
        path.write_text(str(path))
    return paths


def test_a_run_has_its_own_photos_under_names_that_differ(sessions):
    page = sessions.session("a")
    page.uploads = uploaded(sessions, "10.jpg", "2.jpg", "2.JPG", ".hidden.jpg", "2.jpg")
    run = sessions.start(page, TINY)
    names = {path.name for path in (run.folder / PHOTOS).iterdir()}
    assert names == {"10.jpg", "2.jpg", "2-2.JPG", "2-3.jpg", "hidden.jpg"}


@pytest.mark.parametrize(
    ("names", "words"),
    [((), "no photos yet"), (("a.mp4", "b.jpg"), "one video alone"), (("a.mp4", "b.mov"), "one video alone")],
)
def test_what_makes_no_scene_is_refused(sessions, names, words):
    page = sessions.session("a")
    page.uploads = uploaded(sessions, *names)
    with pytest.raises(UserError, match=words):
        sessions.start(page, TINY)
    assert page.run is None


def test_a_page_has_one_run_at_a_time(sessions):
    page = sessions.session("a")
    page.uploads = uploaded(sessions, "a.jpg")
    sessions.start(page, TINY)
    with pytest.raises(UserError, match="under way"):
        sessions.start(page, TINY)


def test_the_same_inputs_continue_and_others_begin_anew(sessions):
    page = sessions.session("a")
    page.uploads = uploaded(sessions, "a.jpg", "b.jpg")
    first = sessions.start(page, TINY)
    sessions.queue.cancel(first)
    sessions.queue.wait_for(first, 20)
    again = sessions.start(page, TINY)
    assert again.folder == first.folder and again.token != first.token
    sessions.queue.cancel(again)
    sessions.queue.wait_for(again, 20)
    other = sessions.start(page, Choice(model="freegeo-tiny", adapt=False))
    assert other.folder != first.folder
    assert not first.folder.exists()


def test_a_zip_file_is_not_that_of_the_run_before(sessions):
    page = sessions.session("a")
    page.uploads = uploaded(sessions, "a.jpg")
    first = sessions.start(page, TINY)
    (first.folder / RESULT).mkdir()
    (first.folder / RESULT / "a.txt").touch()
    old = zipped(first, first.result)
    sessions.queue.cancel(first)
    sessions.queue.wait_for(first, 20)
    again = sessions.start(page, TINY)
    assert again.folder == first.folder and not old.exists()


def test_a_full_disk_is_told_and_leaves_nothing(sessions, monkeypatch):
    page = sessions.session("a")
    page.uploads = uploaded(sessions, "a.jpg")
    there = set(sessions.folder.iterdir())

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(module.os, "link", full)
    monkeypatch.setattr(module.shutil, "copyfile", full)
    with pytest.raises(UserError, match=r"cannot be stored .*No space left"):
        sessions.start(page, TINY)
    assert page.run is None and set(sessions.folder.iterdir()) == there


def test_results_open_by_their_token_alone_and_when_they_are_finished(sessions):
    page, other = sessions.session("a"), sessions.session("b")
    page.uploads = uploaded(sessions, "a.jpg")
    run = sessions.start(page, TINY)
    assert sessions.finished(run.token) is None
    run.state = "done"
    assert sessions.finished(run.token) is run
    assert sessions.finished("") is None
    sessions.find_again(other, "something else")
    assert other.run is None
    sessions.find_again(other, run.token)
    assert other.run is run and page.run is None


def test_a_closed_page_keeps_its_files_for_a_while_and_then_nothing(sessions):
    page = sessions.session("a")
    page.uploads = uploaded(sessions, "a.jpg")
    run = sessions.start(page, TINY)
    now = time.monotonic()
    sessions.leave("a")
    sessions.sweep(now + AWAY_S - 5)
    assert run.is_active and run.folder.is_dir()
    assert sessions.session("a") is page, "it came back"
    sessions.sweep(now + AWAY_S + 5)
    assert run.is_active
    sessions.leave("a")
    sessions.sweep(now + 2 * AWAY_S)
    assert run.state == "cancelled" and not run.folder.exists()
    assert sessions.session("a") is not page


def test_an_open_page_that_nobody_uses_is_forgotten_unless_it_computes(sessions):
    page, idle = sessions.session("a"), sessions.session("b")
    page.uploads = uploaded(sessions, "a.jpg")
    run = sessions.start(page, TINY)
    sessions.sweep(time.monotonic() + IDLE_S + 5)
    assert run.is_active and sessions.session("a") is page
    assert sessions.session("b") is not idle


def test_uploads_that_no_page_has_are_removed_after_a_while(sessions, monkeypatch):
    mine, nobodys = uploaded(sessions, "a.jpg", "b.jpg")
    sessions.session("a").uploads = [mine]
    sessions.sweep(time.monotonic())
    assert nobodys.is_file(), "its page may not have said yet that it has it"
    now = time.time()
    monkeypatch.setattr(module.time, "time", lambda: now + AWAY_S + 5)
    sessions.sweep(time.monotonic())
    assert mine.is_file() and not nobodys.exists()


def test_closing_removes_everything(place):
    sessions = Sessions()
    page = sessions.session("a")
    page.uploads = uploaded(sessions, "a.jpg")
    run = sessions.start(page, TINY)
    sessions.close()
    assert not run.is_active
    assert list(place.iterdir()) == []


def test_kept_results_stay(place, tmp_path):
    sessions = Sessions(keep=tmp_path / "kept")
    page = sessions.session("a")
    page.uploads = uploaded(sessions, "a.jpg")
    run = sessions.start(page, TINY)
    sessions.leave("a")
    sessions.sweep(time.monotonic() + AWAY_S + 5)
    sessions.close()
    assert [path.name for path in (run.folder / PHOTOS).iterdir()] == ["a.jpg"]
    assert run.folder.parent == tmp_path / "kept"
    assert list(place.iterdir()) == []


def test_what_a_killed_app_left_is_removed_and_what_another_uses_is_not(place, sessions):
    left = place / f"{PREFIX}left"
    (left / "uploads").mkdir(parents=True)
    (place / "another-program").mkdir()
    second = Sessions()
    try:
        assert not left.exists()
        assert sessions.folder.is_dir() and (place / "another-program").is_dir()
    finally:
        second.close()


def test_a_folder_to_keep_results_in_that_cannot_be_made_is_refused(tmp_path, place):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="Choose another folder"):
        Sessions(keep=tmp_path / "file" / "kept")
    assert list(place.iterdir()) == []
