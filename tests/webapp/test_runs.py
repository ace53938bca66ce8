"""Runs of the web app: what is asked of the command line, what is read of its progress, and how runs wait and end."""

import io
import sys
import time
from pathlib import Path

import pytest
from tqdm import tqdm

from freegeo.cli.app import build
from freegeo.webapp import runs
from freegeo.webapp.runs import Choice, Progress, Queue, Run, command

SLEEP = "import time; print('frozen prediction ...', file=__import__('sys').stderr, flush=True); time.sleep(60)"
STUBBORN = f"import signal; signal.signal(signal.SIGTERM, lambda *a: None); {SLEEP}; time.sleep(60)"


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def program(code: str) -> Run:
    return Run(folder=Path.cwd(), inputs=(), command=[sys.executable, "-c", code])


def saying(*lines: str, code: int = 0) -> Run:
    return program(f"import sys; sys.stderr.write({chr(10).join(lines)!r}); sys.exit({code})")


@pytest.fixture
def queue(here):
    queue = Queue()
    yield queue
    queue.close(0)


def until(state: str, run: Run) -> None:
    deadline = time.monotonic() + 20
    while run.state != state and time.monotonic() < deadline:
        time.sleep(0.01)
    assert run.state == state


def test_what_is_chosen_is_what_the_command_line_reads(tmp_path):
    choice = Choice(
        model="--model", steps=7, guard="report", refine="off", max_views=9, formats=("ply", "depth"), skip_bad=True
    )
    line = command(tmp_path / "photos", tmp_path / "result", choice, ["--device=cpu"])
    _, bound, _ = build().parse_args(line[line.index("run") :], exit_on_error=False, print_error=False)
    read = bound.arguments
    assert bound.args == (str(tmp_path / "photos"),)
    assert read["output"].output == tmp_path / "result"
    assert (read["model"].model, read["model"].device) == ("--model", "cpu")
    assert (read["recipe"].recipe, read["recipe"].steps, read["guard"]) == ("scene", 7, "report")
    assert (read["refine"], read["photos"].max_views, read["photos"].skip_bad) == ("off", 9, True)
    assert read["files"].formats == ("ply,depth",)


def test_without_adapting_nothing_of_a_recipe_is_asked():
    arguments = Choice(model="freegeo-tiny", adapt=False, steps=7).arguments()
    assert "--no-adapt" in arguments
    assert not [part for part in arguments if part.startswith(("--steps", "--recipe", "--guard"))]


def test_progress_is_read_off_the_lines_of_the_command():
    run = saying()
    for line in ("frozen prediction ...", "adaptation ...", "adapting: 30/120, 12 s left, loss 0.25"):
        run.follow(line)
    assert run.stages == ["starting", "frozen prediction"]
    assert run.progress == Progress(stage="adaptation", share=0.25, seconds_left=12, text="30 of 120, loss 0.25")
    run.follow("warning: three photos are almost black.")
    assert run.progress.stage == "adaptation"
    run.follow("points and files ...")
    assert run.progress == Progress(stage="points and files")


def test_the_bar_of_a_download_is_progress_too():
    shown = io.StringIO()
    bar = tqdm(total=500_000_000, unit="B", unit_scale=True, desc="model.safetensors", file=shown, mininterval=0)
    time.sleep(0.01)
    bar.update(100_000_000)
    run = saying()
    run.follow(shown.getvalue().split("\r")[-1].strip())
    assert run.progress.stage == "download of model.safetensors"
    assert run.progress.share == 0.2
    assert run.progress.seconds_left is not None
    assert run.progress.text == "100M of 500M"


def test_a_failed_run_says_the_sentence_of_the_command_with_the_names_that_the_visitor_knows(queue, tmp_path):
    run = saying(f"freegeo: {tmp_path}/photos/a.jpg: the image is damaged.", code=2)
    queue.add(run)
    until("failed", run)
    assert run.sentence == "a.jpg: the image is damaged."


@pytest.mark.parametrize("code", [0, 3])
def test_a_result_is_there_also_when_something_is_missing_in_it(queue, code):
    run = saying("freegeo: out: depth not written." if code else "", code=code)
    queue.add(run)
    until("done", run)
    assert (run.sentence is not None) == bool(code)


def test_a_run_that_breaks_is_told_in_a_sentence_and_logged(queue, caplog):
    broken, killed = program("raise ValueError('inside')"), program("import os; os.kill(os.getpid(), 9)")
    for run in (broken, killed):
        queue.add(run)
        until("failed", run)
    assert "Traceback" not in broken.sentence and "ended unexpectedly" in broken.sentence
    assert "ValueError: inside" in caplog.text
    assert "memory" in killed.sentence


def test_one_run_computes_and_the_others_wait_for_their_turn(queue):
    first, second, third = program(SLEEP), program(SLEEP), saying()
    for run in (first, second, third):
        queue.add(run)
    until("running", first)
    assert [queue.before(run) for run in (second, third)] == [1, 2]
    queue.cancel(second)
    assert second.state == "cancelled"
    assert queue.before(third) == 1
    queue.cancel(first)
    until("cancelled", first)
    until("done", third)


@pytest.mark.parametrize("code", [SLEEP, STUBBORN])
def test_a_cancelled_run_leaves_no_process(queue, code):
    run = program(code)
    queue.add(run)
    deadline = time.monotonic() + 20
    while not run.stages and time.monotonic() < deadline:
        time.sleep(0.01)
    process = run.process
    queue.cancel(run, grace=0.2)
    until("cancelled", run)
    assert process.poll() is not None


def test_temporary_files_of_a_run_do_not_outlive_it(queue, here):
    run = program("import tempfile, sys; sys.exit('freegeo: ' + tempfile.mkstemp()[1])")
    queue.add(run)
    until("failed", run)
    assert f"{here}/scratch/" in run.sentence
    assert list(here.iterdir()) == []


def test_closing_ends_all_runs():
    queue, running, waiting = Queue(), program(SLEEP), program(SLEEP)
    for run in (running, waiting):
        queue.add(run)
    until("running", running)
    queue.close(0)
    assert (running.state, waiting.state) == ("cancelled", "cancelled")
    assert not queue._worker.is_alive()


def test_a_program_that_is_not_there_is_a_failure(queue):
    run = Run(folder=Path.cwd(), inputs=(), command=["/no/such/program"])
    queue.add(run)
    until("failed", run)
    assert "could not be started" in run.sentence


def test_time_left_is_read_as_a_clock():
    assert [runs._seconds(text) for text in ("00:38", "1:02:03", "?")] == [38, 3723, None]
