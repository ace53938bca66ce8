"""A folder has one writer at a time, and the lock ends with it."""

import errno
import signal
import subprocess
import sys

import pytest

from freegeo import lock as locking
from freegeo.errors import UserError
from freegeo.lock import LOCK_FILE, kept_still, locked


def child(code: str) -> subprocess.Popen:
    """Start Python on a few lines; it says READY when they have got that far."""
    code = "import time\nfrom pathlib import Path\n" + code
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "READY\n"
    return process


def test_second_process_is_refused_and_the_lock_dies_with_its_holder(tmp_path):
    code = f"""
from freegeo.lock import locked
with locked(Path({str(tmp_path)!r})):
    print("READY", flush=True)
    time.sleep(60)
"""
    holder = child(code)
    try:
        with pytest.raises(UserError, match="another freegeo process"), locked(tmp_path):
            pass
    finally:
        holder.send_signal(signal.SIGKILL)
        holder.wait()
    with locked(tmp_path):
        assert (tmp_path / LOCK_FILE).exists()
    assert not (tmp_path / LOCK_FILE).exists()


def test_lock_is_released_after_an_error(tmp_path):
    with pytest.raises(RuntimeError), locked(tmp_path):
        raise RuntimeError
    with locked(tmp_path):
        pass


@pytest.mark.parametrize("place", ["file", "file/below"])
def test_lock_in_a_place_that_is_no_folder(tmp_path, place):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written to"), locked(tmp_path / place):
        pass


def test_a_file_system_without_locks_is_not_taken_for_another_process(tmp_path, monkeypatch):
    import fcntl

    def refuse(*arguments):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(UserError, match=r"cannot lock files \(No locks available\).*another disk"), locked(tmp_path):
        pass


def test_a_result_is_kept_still_where_its_folder_may_be_written_to(tmp_path, monkeypatch):
    with kept_still(tmp_path), pytest.raises(UserError, match="another freegeo process"), locked(tmp_path):
        pass
    assert not (tmp_path / LOCK_FILE).exists()
    monkeypatch.setattr(locking.os, "access", lambda path, mode: False)
    with kept_still(tmp_path), locked(tmp_path):
        assert (tmp_path / LOCK_FILE).exists()
