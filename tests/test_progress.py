"""Progress: a bar where it can be drawn, lines elsewhere, and time left that does not count what was done before."""

import io
import logging
import sys
from threading import Thread
from types import SimpleNamespace

import pytest
import rich.console
import torch

from freegeo import progress
from freegeo.adaptation.state import Progress


def test_progress_without_a_terminal_is_a_line_per_tenth(capsys):
    with progress.progress_bar("steps", 40) as update:
        update(0, "getting ready")
        for k in range(40):
            update(k + 1, f"loss {k}")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 11
    assert lines[0] == "steps: 0/40, getting ready", "nothing is known of the time that is left"
    assert lines[-1].startswith("steps: 40/40, 0 s left")


def test_progress_of_a_resumed_run_does_not_take_the_earlier_part_for_speed(capsys, monkeypatch):
    clock = iter([0.0, 0.0, 10.0, 10.0])
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    with progress.progress_bar("steps", 100) as update:
        update(60)
        update(70)
    assert capsys.readouterr().err.splitlines() == ["steps: 60/100", "steps: 70/100, 30 s left"]


class Shown:
    """A stand-in for stderr that claims to be a terminal."""

    def __init__(self):
        self.text = ""

    def write(self, text: str) -> int:
        self.text += text
        return len(text)

    def flush(self) -> None:
        """Nothing waits."""

    def isatty(self) -> bool:
        return True


def test_progress_in_a_terminal_is_a_bar_that_keeps_its_text(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Shown())
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    with progress.progress_bar("steps", 4) as update:
        update(1, "loss 0.5")
        update(4)
    last = sys.stderr.text.rpartition("steps")[2]
    assert "4/4" in last
    assert "loss 0.5" in last


@pytest.mark.parametrize(("widgets", "expected"), [(True, True), (False, False)])
def test_a_notebook_has_a_bar_where_widgets_are_installed(monkeypatch, widgets, expected):
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace())
    monkeypatch.setattr(progress, "find_spec", lambda name: object() if widgets else None)
    monkeypatch.setattr(rich.console, "_is_jupyter", lambda: True)
    assert progress.in_notebook() is expected


def test_steps_are_followed_from_the_first_to_the_last(capsys):
    followed = []
    with progress.step_bar(followed.append) as on_step:
        for step in range(20):
            on_step(Progress(step=step, steps=20, epoch=0, terms={"total": torch.tensor(step / 10)}))
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "adapting: 1/20, loss 0"
    # Steps 18 and 19, those since the line before.
    assert "adapting: 20/20" in lines[-1] and lines[-1].endswith("loss 1.85")
    assert [state.step for state in followed] == list(range(20))


def curve_in_a_log(capsys, losses) -> list[str]:
    """The lines of a run with these losses."""
    with progress.step_bar() as on_step:
        for step, loss in enumerate(losses):
            on_step(Progress(step=step, steps=len(losses), epoch=0, terms={"total": torch.tensor(loss)}))
    return capsys.readouterr().err.splitlines()


@pytest.mark.parametrize("steps", [1, 3, 10, 35, 100, 1000])
def test_every_line_of_a_log_says_the_loss(capsys, steps):
    lines = curve_in_a_log(capsys, [0.5] * steps)
    assert min(steps, 10) <= len(lines) <= 11
    assert all(line.endswith(", loss 0.5") for line in lines)


def test_the_loss_that_is_shown_is_that_of_all_steps_since_the_line_before(capsys):
    # View sets of unequal losses in turn: single steps would show 1 or 3.
    lines = curve_in_a_log(capsys, [1.0, 3.0] * 50)
    assert [line.rpartition("loss ")[2] for line in lines[2:]] == ["2"] * 9


def test_losses_that_are_huge_or_not_finite_are_shown_as_they_are(capsys):
    lines = curve_in_a_log(capsys, [0.5, 1.6e15, float("nan")])
    assert [line.rpartition("loss ")[2] for line in lines] == ["0.5", "1.6e+15", "nan"]


def test_a_run_that_fails_leaves_no_bar_behind(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Shown())
    monkeypatch.setenv("TERM", "xterm")
    hidden, visible = "\x1b[?25l", "\x1b[?25h"
    with pytest.raises(RuntimeError), progress.step_bar() as on_step:
        on_step(Progress(step=0, steps=3, epoch=0, terms={"total": torch.tensor(1.0)}))
        assert sys.stderr.text.count(hidden) > sys.stderr.text.count(visible)
        raise RuntimeError
    assert sys.stderr.text.count(hidden) == sys.stderr.text.count(visible)


@pytest.mark.parametrize("deaf", ["freegeo", "freegeo.runs", ""])
def test_warnings_are_collected_whatever_the_levels_and_shown_as_before(monkeypatch, deaf):
    shown, package, speaker = io.StringIO(), logging.getLogger("freegeo"), logging.getLogger("freegeo.runs")
    monkeypatch.setattr(package, "handlers", [logging.StreamHandler(shown)])
    monkeypatch.setattr(package, "propagate", True)
    quiet, before = logging.getLogger(deaf), {}
    for logger in (package, speaker, quiet):
        before[logger] = logger.level
        logger.setLevel(logging.NOTSET)
    quiet.setLevel(logging.ERROR)
    try:
        with progress.remembered() as warned:
            speaker.warning("doubtful")
            speaker.error("broken")
            other = Thread(target=lambda: speaker.warning("of another thread"))
            other.start()
            other.join()
            with progress.remembered():
                pass
            speaker.warning("again")
        speaker.warning("afterwards")
        assert warned == ["doubtful", "broken", "again"]
        assert shown.getvalue() == "broken\n" and quiet.level == logging.ERROR
        assert not package.handlers[0].filters
    finally:
        for logger, level in before.items():
            logger.setLevel(level)
