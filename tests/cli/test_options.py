"""Options that several commands share reach what they name."""

import pytest

from cli.conftest import QUICK
from freegeo.adaptation.recipe import PAPER
from freegeo.files import read_json


def test_settings_of_the_loss_reach_the_recipe(freegeo, photo_folder, tiny, tmp_path):
    changes = ["--loss", "weight_kq=0", "--loss", "selection=topk,angle_weights=0, 0,0,num_query=9,separate_draws=TRUE"]
    outcome = freegeo("adapt", photo_folder, "-o", tmp_path / "out", *tiny, *QUICK, *changes)
    assert outcome.code == 0, outcome.err
    stored = read_json(tmp_path / "out" / "freegeo.json")
    loss = stored["recipe"]["loss"]
    changed = {"weight_kq": 0.0, "selection": "topk", "num_query": 9, "separate_draws": True}
    assert loss == loss | changed | {"angle_weights": [0.0, 0.0, 0.0], "weight_pk": PAPER.loss.weight_pk}
    assert {"kl_pk", "kl_pq"} <= stored["loss_curve"][0].keys()
    assert stored["loss_curve"][0].keys().isdisjoint({"kl_kq", "phi"})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("weight_kq", "--loss 'weight_kq' is no setting. Write it as weight_kq=0."),
        ("weight_kk=0", "There is no loss setting 'weight_kk'; known are intra_tokens, cross_tokens, "),
        ("weight_kq=none", "--loss weight_kq: 'none' is no value like 1.0."),
        ("num_query=2.5", "--loss num_query: '2.5' is no value like 256."),
        ("separate_draws=2", "--loss separate_draws: '2' is no value like False."),
        ("angle_weights=1,2", "angle_weights has 3 numbers"),
        ("selection=best", "selection is one of mixed, topk, random, not best."),
        ("weight_kq=-1", "weights must be 0 or more"),
    ],
)
def test_settings_of_the_loss_that_make_no_sense(freegeo, photo_folder, tiny, tmp_path, text, words):
    outcome = freegeo("adapt", photo_folder, "-o", tmp_path / "out", *tiny, *QUICK, "--loss", text)
    assert outcome.code == 2
    assert words in outcome.sentence()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["run", "adapt", "demo"])
def test_help_says_how_the_loss_is_changed(freegeo, command):
    outcome = freegeo(command, "--help")
    assert "--loss" in outcome.out and "weight_kq=0" in outcome.out
