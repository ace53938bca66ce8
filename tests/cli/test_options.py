"""Options that several commands share reach what they name."""

import logging

import pytest

import freegeo as package
from cli.conftest import QUICK
from freegeo import pipeline
from freegeo.adaptation.recipe import PAPER, named, scene
from freegeo.cli import console
from freegeo.cli.options import ModelOptions
from freegeo.errors import UserError
from freegeo.files import read_json
from freegeo.models import catalog


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


# -- what the help says


@pytest.mark.parametrize("command", ["run", "adapt"])
def test_the_help_names_the_defaults_of_the_recipe(freegeo, command):
    text = " ".join(freegeo(command, "--help").out.replace("│", " ").split())
    base, tiny = (catalog.build_empty(name).spec for name in ("da3-base", "freegeo-tiny"))
    default, small = scene(base), scene(tiny)
    rate = f"{small.lr:.0e}".replace("e-0", "e-")
    for words in (
        f"Default: {default.steps} with recipe scene",
        f"Default: {default.sets_per_scene} with recipe scene",
        f"Default: {default.lr:.0e} with recipe scene (freegeo-tiny: {rate})".replace("e-0", "e-"),
        f"Default: {default.rank} (freegeo-tiny: {small.rank}).",
        f"Default: {default.hold:g} with scene and evidence, else {PAPER.hold:g}.",
        f"Default: {default.views}.",
        "default: da3-base.",
    ):
        assert words in text
    assert catalog.DEFAULT_MODEL == "da3-base"
    epochs = [named("paper", base, name).epochs for name in ("eth3d", "7scenes", "scannetpp", "hiroom")]
    assert f"Default: {min(epochs)} to {max(epochs)}, by dataset" in text


@pytest.mark.parametrize("command", ["run", "adapt", "reconstruct"])
def test_the_help_needs_no_dictionary(freegeo, command):
    text = freegeo(command, "--help").out
    for word in ("teacher", "student", "optimiser", "transformer"):
        assert word not in text.lower()


# -- which model


@pytest.mark.parametrize("given", ["freegeo-tiny", "FREEGEO-TINY"])
def test_the_model_has_one_name_in_results(given):
    assert ModelOptions(model=given).identity(None)["model"] == "freegeo-tiny"


def test_a_model_may_be_given_by_its_hub_id():
    assert ModelOptions(model="depth-anything/DA3-LARGE-1.1").name == "da3-large"
    assert ModelOptions().name == "da3-base"


@pytest.fixture(scope="module")
def run_of_tiny(tmp_path_factory, photo_folder):
    """The output folder of a short run with the embedded model."""
    from freegeo.cli.app import main

    folder = tmp_path_factory.mktemp("run") / "out"
    assert main(["run", str(photo_folder), "-o", str(folder), "--model", "freegeo-tiny", *QUICK]) == 0
    return folder


@pytest.mark.parametrize("below", ["", "adapter"])
def test_the_adapter_decides_the_model(freegeo, photo_folder, run_of_tiny, tmp_path, below):
    outcome = freegeo("reconstruct", photo_folder, "-o", tmp_path / "out", "--adapter", run_of_tiny / below)
    assert outcome.code == 0, outcome.err
    assert "model: freegeo-tiny, which the adapter was made for" in outcome.err
    summary = read_json(tmp_path / "out" / "reconstruction.json")
    assert summary["model"] == "freegeo-tiny"
    assert summary["adapter"] == str(run_of_tiny / "adapter")


def test_another_model_than_the_adapters_is_refused_before_anything_is_loaded(
    freegeo, photo_folder, run_of_tiny, tmp_path, monkeypatch
):
    monkeypatch.setattr(ModelOptions, "load", lambda self: pytest.fail("loaded"))
    for command in (["reconstruct", photo_folder], ["adapter", "merge"]):
        place = ["--adapter", run_of_tiny] if command[0] == "reconstruct" else [run_of_tiny]
        out = tmp_path / "out.safetensors"
        outcome = freegeo(*command, *place, "-o", out, "--model", "depth-anything/DA3-BASE")
        assert outcome.code == 2
        assert outcome.sentence().endswith("was made for freegeo-tiny, not for da3-base. Leave --model out.")


def test_an_adapter_of_somebody_else_needs_the_model(freegeo, photo_folder, run_of_tiny, tmp_path):
    for name in ("adapter_config.json", "adapter_model.safetensors"):
        (tmp_path / name).write_bytes((run_of_tiny / "adapter" / name).read_bytes())
    outcome = freegeo("reconstruct", photo_folder, "-o", tmp_path / "out", "--adapter", tmp_path)
    assert outcome.code == 2
    assert "does not say which model it was made for. Name that with --model." in outcome.sentence()


def test_an_adapter_of_a_model_that_is_not_installed_names_it(freegeo, photo_folder, run_of_tiny, tmp_path):
    for file in (run_of_tiny / "adapter").iterdir():
        if file.is_file():
            (tmp_path / file.name).write_bytes(file.read_bytes())
    metadata = tmp_path / "freegeo.json"
    metadata.write_text(metadata.read_text().replace('"freegeo-tiny"', '"somebody-elses"'))
    outcome = freegeo("reconstruct", photo_folder, "-o", tmp_path / "out", "--adapter", tmp_path)
    assert outcome.code == 2
    assert "unknown model 'somebody-elses'" in outcome.sentence()


def test_a_folder_without_an_adapter_is_said_before_the_photos_are_read(freegeo, tmp_path):
    outcome = freegeo("reconstruct", tmp_path / "no photos", "-o", tmp_path / "out", "--adapter", tmp_path)
    assert "not an adapter folder" in outcome.sentence()
    assert "or the output folder of `freegeo run`" in outcome.sentence()


# -- the embedded model on real photos

EMBEDDED = "freegeo-tiny was trained on generated rooms at 96 x 72 pixels"


def test_the_embedded_model_says_what_it_is_not_for(freegeo, photo_folder, tmp_path):
    outcome = freegeo("reconstruct", photo_folder, "-o", tmp_path / "out", "--model", "freegeo-tiny")
    assert outcome.err.count(f"warning: {EMBEDDED}") == 1
    (sentence,) = read_json(tmp_path / "out" / "reconstruction.json")["warnings"]
    assert sentence.startswith(EMBEDDED)
    assert "use da3-base or another model" in sentence
    assert EMBEDDED in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("model", "sources", "warns"),
    [
        ("freegeo-tiny", ["photos"], True), ("FreeGeo-Tiny", ["a.jpg", "b.jpg"], True),
        ("freegeo-tiny", ["demo", "photos"], True), ("freegeo-tiny", ["demo"], False), (None, ["photos"], False),
        ("da3-small", ["photos"], False),
    ],
)  # fmt: skip
def test_the_demo_and_other_models_are_no_reason_to_warn(capsys, model, sources, warns):
    console.configure_logging(False)
    ModelOptions(model=model).warn_of_embedded(sources)
    assert (EMBEDDED in capsys.readouterr().err) == bool(console.warned()) == warns


@pytest.mark.parametrize("command", ["run", "adapt"])
def test_every_command_that_takes_photos_warns(freegeo, photo_folder, tmp_path, monkeypatch, command):
    def stop(*arguments):
        raise UserError("stopped")

    monkeypatch.setattr("freegeo.pipeline.require_enough_photos", stop)
    outcome = freegeo(command, photo_folder, "-o", tmp_path / "out", "--model", "freegeo-tiny")
    assert EMBEDDED in outcome.err and "stopped" in outcome.sentence()


def test_python_warns_once(photo_folder, caplog, monkeypatch):
    # A command line of an earlier test may have left its own.
    monkeypatch.setattr(logging.getLogger("freegeo"), "handlers", [])
    monkeypatch.setattr(logging.getLogger("freegeo"), "propagate", True)
    monkeypatch.setattr(pipeline, "_warned_of", [])
    model = package.load_model("freegeo-tiny")
    for _ in range(2):
        package.reconstruct(model, sorted(photo_folder.iterdir())[:1])
    assert [record.getMessage()[: len(EMBEDDED)] for record in caplog.records if record.levelname == "WARNING"] == [
        EMBEDDED
    ]
