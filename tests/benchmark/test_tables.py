import csv
import io
from dataclasses import replace

import pytest

from freegeo.benchmark.paper.experiments import EXPERIMENTS, PAPER_BUDGETS
from freegeo.benchmark.paper.tables import (
    as_csv,
    as_latex,
    as_markdown,
    as_text,
    change_of_means,
    experiment_tables,
    mean_of_changes,
    verdict,
)
from freegeo.benchmark.results import Row
from freegeo.metrics.bootstrap import Interval

SCENES = [f"scene {k}" for k in range(6)]


def rows(variant, views, values, *, dataset="eth3d", rule="da3"):
    """One row per scene, metric and seed; a scene's number is added so that pairs matter."""
    return [
        Row(
            model="da3-giant", dataset=dataset, scene=scene, rule=rule, views=views, frames=views, seed=seed,
            variant=variant, metric=metric, value=value + 0.01 * k,
        )
        for k, scene in enumerate(SCENES)
        for seed in (43, 44)
        for metric, value in values.items()
    ]  # fmt: skip


@pytest.fixture
def main_tables():
    found = rows("frozen", 4, {"auc03": 0.30, "fscore": 0.20}) + rows("adapted", 4, {"auc03": 0.32, "fscore": 0.19})
    return experiment_tables(EXPERIMENTS["main"], found, family="da3")


def test_ours_stands_beside_the_published_number(main_tables):
    ours, published, differences = main_tables
    assert ours.header == ("", "eth3d AUC@3", "eth3d F1")
    # 0.30 + mean of 0 .. 0.05; the paper's DA3 row at 4 views is 0.286
    assert ours.rows[0] == ("4 views, frozen", "0.325 (paper 0.286, +0.039)", "0.225 (paper 0.207, +0.018)")
    assert len(ours.rows) == 2, "lines without results are left out"
    assert len(published.rows) == 8
    assert published.rows[3][1] == "0.305"
    assert "6 scenes, seeds 43, 44" in ours.notes[0]
    assert [row[4] for row in differences.rows] == ["better", "worse"]
    assert differences.rows[0][2:4] == ("+0.020", "[+0.020, +0.020]")
    assert differences.rows[0][5:] == ("6", "12")


def test_other_models_get_no_difference_to_the_paper():
    tables = experiment_tables(EXPERIMENTS["main"], rows("frozen", 4, {"auc03": 0.3}), family=None)
    assert tables[0].rows == (("4 views, frozen", "0.325", ""),)


def test_missing_entries_are_said():
    found = rows("frozen", 4, {"auc03": 0.3, "fscore": 0.2})[:-1]
    assert "eth3d F1, 4 views, frozen: 11 of 12" in experiment_tables(EXPERIMENTS["main"], found)[0].notes[-1]


def test_rows_of_another_frame_rule_are_left_aside():
    found = rows("frozen", 4, {"auc03": 0.3}, rule="vggt")
    assert not any(table.title.startswith("main: Frozen") for table in experiment_tables(EXPERIMENTS["main"], found))
    assert experiment_tables(EXPERIMENTS["main"], found, rule="vggt")[0].rows


def test_the_two_means_differ_and_are_named():
    pairs = [(0.1, 0.2), (0.9, 0.9)]
    assert mean_of_changes(pairs) == pytest.approx(50)
    assert change_of_means(pairs) == pytest.approx(10)
    assert mean_of_changes([(0.0, 1.0)]) is None
    assert change_of_means([]) is None
    found = [
        row
        for dataset, old, new in (("eth3d", 0.1, 0.2), ("hiroom", 0.9, 0.9))
        for variant, value in (("frozen", old), ("adapted", new))
        for row in rows(variant, 4, {"auc03": value}, dataset=dataset)
    ]
    table = experiment_tables(EXPERIMENTS["cross-views"], found)[0]
    assert [row[0] for row in table.rows] == ["4 views, mean of changes", "4 views, change of means"]
    assert table.rows[0][1] != table.rows[1][1]


@pytest.mark.parametrize(
    ("metric", "interval", "scenes", "said"),
    [
        ("auc30", Interval(0.1, 0.05, 0.2), 9, "better"),
        ("overall", Interval(0.1, 0.05, 0.2), 9, "worse"),
        ("overall", Interval(-0.1, -0.2, -0.05), 9, "better"),
        ("auc30", Interval(-0.1, -0.2, -0.05), 9, "worse"),
        ("auc30", Interval(0.1, -0.05, 0.2), 9, "open"),
        ("auc30", Interval(0.1, 0.05, 0.2), 2, "too few scenes"),
    ],
)
def test_verdicts_know_which_way_is_better(metric, interval, scenes, said):
    assert verdict(metric, interval, scenes) == said


def test_the_gain_table_says_what_of_the_gap_was_reached():
    found = [
        row
        for variant, auc, chamfer in (("frozen", 0.3, 0.5), ("8to4", 0.4, 0.5), ("adapted", 0.32, 0.4))
        for row in rows(variant, 4, {"auc30": auc, "overall": chamfer}, rule="vggt")
    ]
    found += rows("frozen", 8, {"auc30": 0.5}, rule="vggt") + rows("adapted", 8, {"auc30": 0.48}, rule="vggt")
    lost = found.index(next(row for row in found if row.variant == "adapted" and row.scene == "scene 3"))
    found[lost] = replace(found[lost], value=found[lost].value - 0.14)
    (table,) = experiment_tables(EXPERIMENTS["gain"], found, rule="da3")
    cells = {row[:2]: dict(zip(table.header[2:6], row[2:6], strict=True)) | {"rest": row[6:]} for row in table.rows}
    assert set(cells) == {("eth3d: 4 views", "AUC@30"), ("eth3d: 4 views", "CD"), ("eth3d: 8 views", "AUC@30")}
    four = cells["eth3d: 4 views", "AUC@30"]
    # 0.02 in every scene and seed, but for one seed of scene 3, which loses 0.12
    assert (four["frozen"], four["adapted"], four["gain"]) == ("0.325", "0.333", "+0.008")
    verdict_cell, gap, _, share, worst, scenes = four["rest"]
    assert (verdict_cell, gap, share, worst, scenes) == ("open", "+0.100", "8%", "scene 3 -0.050", "6")
    # A smaller distance is better; without a gap there is no share.
    assert cells["eth3d: 4 views", "CD"]["rest"][0] == "better"
    assert cells["eth3d: 4 views", "CD"]["rest"][3] == ""
    assert cells["eth3d: 8 views", "AUC@30"]["rest"][:4] == ("worse", "", "", "")


def test_all_formats_carry_every_cell(main_tables):
    table = main_tables[0]
    text, markdown, latex = as_text(table), as_markdown(table), as_latex(table)
    assert list(csv.reader(io.StringIO(as_csv(table)))) == [list(table.header), *map(list, table.rows)]
    for row in table.rows:
        for cell in row:
            assert cell in text
            assert cell in markdown
            assert cell in latex
    widths = {len(line) for line in markdown.splitlines() if line.startswith("|")}
    assert all(line.count("|") == 4 for line in markdown.splitlines() if line.startswith("|")), widths
    assert latex.count(r"\\") == len(table.rows) + 1


def test_latex_escapes_what_it_must():
    found = rows("frozen", 4, {"auc03": 0.3}) + rows("adapted", 4, {"auc03": 0.4})
    latex = as_latex(experiment_tables(EXPERIMENTS["cross-views"], found)[0])
    body = [line for line in latex.splitlines() if not line.startswith("%")]
    assert r"\%" in "".join(body)
    assert not any("%" in line.replace(r"\%", "") for line in body)


def test_the_paper_reports_six_view_counts():
    assert [line.views for line in EXPERIMENTS["recon-detail"].lines[::2]] == list(PAPER_BUDGETS)
