"""`bench reproduce`: which differences to the paper are marked, which tables are left out, and all of it end to end."""

import math
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from safetensors.torch import save_file

from fixture_tools import fixture_path
from freegeo.benchmark.paper.experiments import EXPERIMENTS
from freegeo.benchmark.paper.published import Printed
from freegeo.benchmark.paper.reproduction import (
    PAPER_DATASETS,
    PAPER_TABLES,
    Reproduction,
    allowed_difference,
    compared_table,
    left_out,
    standard_error,
)
from freegeo.benchmark.results import Row
from freegeo.cli.app import main
from freegeo.data.datasets import eth3d, registry, scannetpp, sevenscenes
from freegeo.data.procedural.splits import surface_points, write_points
from freegeo.models import catalog
from freegeo.models.da3 import DA3
from freegeo.models.spec import ModelEntry
from freegeo.report.reproduction import render
from tiny_models import ANY_VIEW, tiny_da3

SCENES = {"eth3d": ("courtyard", "office")}


def rows(value, *, line="frozen", views=4, metric="auc03", seeds=(43, 44, 45), spread=0.0, scenes=SCENES):
    """Rows whose means over scenes are value - spread, value and value + spread for three seeds."""
    return [
        Row(
            model="da3-giant", dataset=dataset, scene=scene, rule="da3", views=views, frames=views, seed=seed,
            variant=line, metric=metric, value=value + spread * (k - (len(seeds) - 1) / 2) + 0.1 * (-1) ** j,
        )
        for dataset, names in scenes.items()
        for j, scene in enumerate(names)
        for k, seed in enumerate(seeds)
    ]  # fmt: skip


def cell(found, name="main", label="4 views, frozen", column=0, scenes=SCENES, **options):
    table = compared_table(EXPERIMENTS[name], found, scenes, rule="da3", family="da3", **options)
    return next(cells for row, cells in table.rows if row == label)[column], table


# -- the rule


def test_the_standard_error_is_that_of_a_difference_of_two_means_over_seeds():
    assert standard_error([0.1, 0.2, 0.3], 3) == pytest.approx(0.1 * math.sqrt(2 / 3))
    assert standard_error([0.1, 0.2, 0.3], 1) == pytest.approx(0.1 * math.sqrt(4 / 3))
    assert standard_error([0.1], 3) is None


def test_rounding_and_surface_sampling_are_allowed_for():
    assert allowed_difference("auc03", Printed(0.3, 0.0005), 0.01) == pytest.approx(0.0205)
    assert allowed_difference("fscore", Printed(0.3, 0.0005), 0.0) == pytest.approx(0.0015)
    assert allowed_difference("overall", Printed(2.0, 0.0005), 0.0) == pytest.approx(0.0045)
    assert allowed_difference("auc03", Printed(0.3, 0.0005), None) is None


@pytest.mark.parametrize(
    ("ours", "spread", "verdict", "direction"),
    [
        (0.286, 0.01, "within", ""),  # the paper prints 0.286
        (0.286 + 0.016, 0.01, "within", ""),
        (0.286 + 0.018, 0.01, "beyond", "better"),
        (0.286 - 0.018, 0.01, "beyond", "worse"),
        (0.2864, 0.0, "within", ""),
        (0.2866, 0.0, "beyond", "better"),
    ],
)
def test_a_difference_is_marked_beyond_twice_its_standard_error(ours, spread, verdict, direction):
    found, _ = cell(rows(ours, spread=spread))
    assert found.verdict == verdict
    if direction:
        assert found.direction == direction
        assert f"**beyond: {direction}**" in str(found)
    else:
        assert "beyond" not in str(found)


def test_less_is_better_for_a_distance():
    found, _ = cell(rows(2.0, metric="overall"), "recon-detail", column=1)
    assert (found.verdict, found.direction) == ("beyond", "better")
    assert str(found) == "2.0000 (paper 2.7420, -0.7420, **beyond: better**)"


@pytest.mark.parametrize(
    ("found", "options", "said"),
    [
        (rows(0.9, seeds=(43,)), {}, "One seed ran"),
        (rows(0.9)[:-1], {}, "Scenes or seeds are missing, so nothing is marked: eth3d 4 views, frozen"),
        (rows(0.9, scenes={"eth3d": ("office",)}), {}, "Scenes or seeds are missing"),
        (rows(0.9), {"judged": False}, ""),
    ],
)
def test_what_cannot_be_judged_is_not_marked_and_the_reason_is_given(found, options, said):
    one, table = cell(found, **options)
    assert one.verdict == "open"
    assert table.counts() == {"within": 0, "beyond": 0, "open": 1}
    assert any(said in note for note in table.notes)


def test_a_number_that_the_paper_does_not_have_stands_alone():
    one, table = cell(rows(0.3), "loss-ablation", "frozen")
    assert (one.verdict, str(one)) == (None, "0.300")
    assert any("one seed" in note for note in table.notes)


def test_relative_changes_stand_beside_the_papers_and_are_never_marked():
    label = "4 views, change of means"
    one, table = cell(rows(0.50) + rows(0.55, line="adapted", spread=0.02), "cross-views", label)
    assert (one.verdict, str(one)) == ("open", "+10.00 % (paper +2.74 %, +7.26 %)")
    assert any("Nothing is marked: the paper does not say how it averages" in note for note in table.notes)


# -- what is left out


def test_tables_that_cannot_run_say_why():
    gone = {"eth3d": "eth3d: no such folder"}
    assert left_out(EXPERIMENTS["main"], "vggt", gone, ["hiroom"]) is None
    assert left_out(EXPERIMENTS["features"], "vggt", {}, ["eth3d"]) is None
    assert left_out(EXPERIMENTS["cross-views"], "vggt", {}, ["hiroom"]) is None
    assert left_out(EXPERIMENTS["features"], "da3", gone, ["hiroom"]) == "needs eth3d: eth3d: no such folder"
    assert left_out(EXPERIMENTS["anchors"], "da3", {}, ["hiroom"]) == "needs eth3d: not among --datasets"
    assert left_out(EXPERIMENTS["lora-rank"], "vggt", {}, ["eth3d"]) == "the paper prints no numbers of VGGT for it"
    assert not any(left_out(EXPERIMENTS[name], "da3", {}, PAPER_DATASETS) for name in PAPER_TABLES)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--model", "freegeo-tiny"], "the paper reports no model like freegeo-tiny; choose da3-giant or vggt-1b"),
        (["--tables", "gain"], "--tables gain: the paper's tables are long-sequence, main"),
        (["--datasets", "procedural"], "--datasets procedural: the paper's are eth3d"),
        (["--given-cameras"], "no table of the paper was made with given cameras"),
        (
            ["--model", "da3-small"],
            "no dataset of the paper is complete in nowhere (eth3d: nowhere/eth3d: no such",
        ),
    ],
)
def test_mistakes_end_with_a_sentence_before_anything_is_loaded(tmp_path, monkeypatch, capsys, arguments, said):
    monkeypatch.chdir(tmp_path)
    assert main(["bench", "reproduce", "--data", "nowhere", *arguments]) == 2
    assert said in capsys.readouterr().err.strip().splitlines()[-1]
    assert not list(tmp_path.iterdir())


# -- the page


def test_the_page_escapes_names_and_says_the_same_in_both_formats():
    table = compared_table(EXPERIMENTS["main"], rows(0.5), SCENES, rule="da3", family="da3")
    page = Reproduction(
        facts=(("model", "<b>da3</b>"),), doubts=("Only <i>one</i> dataset.",), tables=(table,),
        not_run=(("anchors", "Anchors", "needs eth3d"),), problems=("eth3d office: predict: & failed",),
        datasets=("eth3d",), settings=(("epochs", ("3",)),),
    )  # fmt: skip
    assert page.answer == "0 of 1 numbers agree with the paper's within seed noise."
    html, text = render(page), page.as_markdown()
    assert "<b>da3</b>" not in html and "&lt;b&gt;da3" in html
    assert 'class="first beyond better"' in html
    assert "0.500 (paper 0.286, +0.214, **beyond: better**)" in text
    for said in ("Only", "needs eth3d", "& failed", page.rule):
        assert said in text
        assert said.replace("&", "&amp;").replace("'", "&#39;") in html
    assert "://" not in html


# -- end to end


@pytest.fixture
def miniature(monkeypatch, tmp_path, one_thread):
    """The four datasets in their published layout, a few frames each, and a tiny DA3 with weights in a file."""
    data = tmp_path / "data"
    shutil.copytree(fixture_path("benchmark", "datasets"), data)
    monkeypatch.setattr(eth3d, "SCENES", ("pipes",))
    monkeypatch.setattr(sevenscenes, "SCENES", ("stairs",))
    monkeypatch.setattr(scannetpp, "SCENES", ("09c1414f1b",))
    (data / "hiroom" / "selected_scene_list_val.txt").write_text("20241230/000001/cam_sampled_00\n")
    for name in PAPER_DATASETS:
        plain = registry.DATASETS[name].constants
        coarse = replace(
            plain, samples=5000, voxel=4 * plain.voxel, truncation=4 * plain.truncation, down_sample=4 * plain.voxel
        )
        monkeypatch.setitem(registry.DATASETS, name, replace(registry.DATASETS[name], constants=coarse))
    for name in registry.scene_names(data, "hiroom"):
        scene = registry.load_scene(data, "hiroom", name)
        depth = registry.true_depth(scene, scene.photos[0].size_hw)
        write_points(scene.truth.surface, surface_points(depth, scene.K, scene.T_cam_world))

    def build():
        spec = tiny_da3().spec
        return DA3(replace(ANY_VIEW), replace(spec, adaptation=replace(spec.adaptation, published="da3")))

    weights = tmp_path / "tiny.safetensors"
    save_file({name: value.clone() for name, value in tiny_da3().state_dict().items()}, weights)
    item = ModelEntry(
        name="tiny-da3", about="a test", licence="none", parameters=1, build=build, packaged_weights=weights
    )
    point = SimpleNamespace(name="tiny-da3", value="test", load=lambda: item)
    monkeypatch.setattr(catalog, "_plugin_points", lambda: {"tiny-da3": point})
    return ["bench", "reproduce", "--model", "tiny-da3", "--data", str(data), "-o", str(tmp_path / "out"),
            "--device", "cpu", "--steps", "2", "--seeds", "43,44"]  # fmt: skip


@pytest.mark.slow
def test_every_table_of_the_paper_is_run_compared_and_written_to_a_page(miniature, tmp_path, capsys):
    out = tmp_path / "out"
    code = main(miniature)
    said = capsys.readouterr()
    assert code in (0, 1), said.err  # surfaces of random weights may be empty, which is reported
    assert f"9 of 9 tables: {', '.join(PAPER_TABLES)}" in said.out
    assert "in all about" in said.out
    html, text = (out / "reproduction.html").read_text(), (out / "reproduction.md").read_text()
    for name in PAPER_TABLES:
        assert f'<section id="{name}">' in html
        assert f"### {name}: " in text
        assert (out / "tables" / f"{name}.csv").is_file()
    for dataset in PAPER_DATASETS:
        assert f">{dataset}</th>" in html
    assert "The paper&#39;s numbers are of da3-giant, these of tiny-da3" in html
    assert "steps = 2" in html
    assert "tiny.safetensors, fingerprint" in html
    assert "(paper 0.286, " in text and "beyond: worse" in text
    assert ("What failed" in html) == (code == 1)

    results = (out / "results.csv").read_text()
    assert main(miniature) == code
    again = capsys.readouterr().out
    assert "0 of them finished" not in again and "forward passes" not in again
    assert (out / "results.csv").read_text() == results

    shutil.rmtree(Path(miniature[miniature.index("--data") + 1], "eth3d"))
    assert main([*miniature, "--tables", "main,anchors"]) in (0, 1)
    html = (out / "reproduction.html").read_text()
    assert "needs eth3d: " in html and "Without eth3d: " in html
