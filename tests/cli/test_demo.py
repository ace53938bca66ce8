"""The demo: a generated room, scored before and after, with an honest sentence about what came of it."""

import io
import json
from contextlib import redirect_stdout

import pytest

from cli.conftest import QUICK
from freegeo.cli import demo, sources
from freegeo.cli.app import main
from freegeo.files import RUN_FILE

pytestmark = pytest.mark.slow

SCORE = {"auc05": 0.1, "auc15": 0.2, "auc30": 0.5, "abs_rel": 0.2, "f1_rel5": 0.3}


@pytest.fixture(scope="module", autouse=True)
def short_path():
    """Photograph eight views instead of sixteen."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sources, "DEMO_FRAMES", 8)
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory, tiny, short_path):
    """Folder of a demo that ran to its end, and what it printed."""
    out, printed = tmp_path_factory.mktemp("demo") / "out", io.StringIO()
    with redirect_stdout(printed):
        assert main(["demo", "-o", str(out), "--checkpoint", tiny[3], *QUICK[:4]]) == 0
    return out, printed.getvalue()


def test_demo_scores_both_models_and_points_to_the_files(finished):
    out, printed = finished
    scores = json.loads((out / "scores.json").read_text())
    assert set(scores) == {"frozen", "adapted"}
    for model in scores.values():
        assert set(model) == {"4", "8"}
        for score in model.values():
            assert set(score) >= set(SCORE)
    rows = [line.split() for line in printed.splitlines()]
    for views in ("4", "8"):
        for name in ("frozen", "adapted"):
            (row,) = [row for row in rows if row[:2] == [views, name]]
            assert row[2] == f"{scores[name][views]['auc05']:.3f}"
        assert f"{views} views: adaptation" in printed
    assert len(list((out / "photos").glob("*.png"))) == 8
    assert str(out / "scene.glb") in printed
    assert (out / "frozen" / "prediction.npz").is_file()


def test_finished_demo_shows_its_table_again(freegeo, tiny, finished):
    out, _ = finished
    outcome = freegeo("demo", "-o", out, "--checkpoint", tiny[3], *QUICK[:4])
    assert outcome.code == 0
    assert "already finished" in outcome.out
    assert "8 views: adaptation" in outcome.out
    other = freegeo("demo", "-o", out, "--checkpoint", tiny[3], *QUICK[:4], "--room", 1)
    assert other.code == 2
    assert "room: 0 there, 1 now" in other.sentence()


@pytest.mark.slow
def test_demo_that_was_stopped_while_scoring_is_not_finished(freegeo, tiny, tmp_path, monkeypatch):
    arguments = ["demo", "-o", tmp_path, "--checkpoint", tiny[3], *QUICK[:4]]
    with monkeypatch.context() as patch:
        patch.setattr(demo, "score_windows", lambda job, scene: (_ for _ in ()).throw(KeyboardInterrupt))
        assert freegeo(*arguments).code == 130
    assert json.loads((tmp_path / RUN_FILE).read_text())["finished"] is None
    outcome = freegeo(*arguments)
    assert outcome.code == 0
    assert "already finished" not in outcome.out
    assert (tmp_path / "scores.json").is_file()


@pytest.mark.parametrize(("option", "value"), [("--domain", "castle"), ("--room", "10000000"), ("--room", "-1")])
def test_rooms_that_do_not_exist(freegeo, tmp_path, option, value):
    outcome = freegeo("demo", "-o", tmp_path / "out", f"{option}={value}")
    assert outcome.code == 2
    assert value.lstrip("-") in outcome.sentence()
    assert not (tmp_path / "out").exists()


def test_windows_are_neighbours_and_four_views_are_every_second():
    assert demo.windows(16, 8) == [list(range(start, start + 8)) for start in (0, 2, 4, 6, 8)]
    assert demo.windows(10, 4) == [[0, 2, 4, 6], [2, 4, 6, 8]]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"auc30": 0.6, "f1_rel5": 0.4, "abs_rel": 0.1}, "adaptation improved AUC@30, F1 and abs-rel."),
        ({"auc30": 0.6}, "adaptation improved AUC@30, but not F1 and abs-rel."),
        ({"abs_rel": 0.1, "f1_rel5": 0.1}, "adaptation improved abs-rel, but not AUC@30 and F1."),
        ({}, "adaptation did not help on this room."),
        ({"auc30": 0.4, "f1_rel5": 0.2, "abs_rel": 0.3}, "adaptation did not help on this room."),
    ],
)
def test_verdict_is_honest(change, sentence):
    assert demo.verdict(SCORE, {**SCORE, **change}) == sentence
