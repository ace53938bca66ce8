import pytest

from freegeo.adaptation.recipe import named
from freegeo.benchmark.paper.experiments import EXPERIMENTS, ROOMS, chosen, datasets_of
from freegeo.benchmark.paper.published import Cell, Printed, paper_table
from freegeo.benchmark.paper.tables import NAMES, published
from freegeo.benchmark.paper.variants import VARIANTS, Variant, variant
from freegeo.errors import UserError
from tiny_models import tiny_da3

NAMES_OF_THE_ISSUE = {
    "long-sequence", "main", "cross-views", "loss-ablation", "features", "anchors", "lora-rank", "pose-detail",
    "recon-detail", "overhead", "gain",
}  # fmt: skip


def test_every_table_of_the_paper_has_a_name():
    assert set(EXPERIMENTS) == NAMES_OF_THE_ISSUE
    assert {entry.name for entry in chosen(["all"])} == NAMES_OF_THE_ISSUE
    with pytest.raises(UserError, match="lora-rank"):
        chosen(["lora"])


@pytest.mark.parametrize("entry", EXPERIMENTS.values(), ids=lambda entry: entry.name)
def test_an_experiment_is_complete(entry):
    labels = [line.label for line in entry.lines]
    assert len(set(labels)) == len(labels)
    for line in entry.lines:
        assert line.variant in VARIANTS
        assert line.compare_with is None or line.compare_with in labels
    assert set(entry.metrics) | set(entry.room_metrics) <= set(NAMES)
    assert entry.paper is None or paper_table(entry.paper).rows


@pytest.mark.parametrize(
    ("name", "label", "dataset", "metric", "family", "printed"),
    [
        ("long-sequence", "8->4", "scannetpp", "auc03", "da3", 0.747),
        ("main", "4 views, adapted", "hiroom", "fscore", "vggt", 0.307),
        ("main", "8 views, frozen", "eth3d", "auc03", "da3", 0.408),
        ("pose-detail", "32 views, frozen", "eth3d", "auc30", "vggt", 0.805),
        ("recon-detail", "4 views, adapted", "eth3d", "overall", "da3", 2.754),
        ("loss-ablation", "full loss", "eth3d", "auc03", "da3", 0.3788),
        ("loss-ablation", "w/o relational loss", "eth3d", "overall", "da3", 3.9567),
        ("anchors", "top selection", "eth3d", "fscore", "da3", 0.2474),
        ("lora-rank", "LoRA r=32", "eth3d", "trainable", "da3", 21.237e6),
        ("features", "adapted", "eth3d", "mse", "vggt", 0.8384),
    ],
)
def test_published_numbers_are_found(name, label, dataset, metric, family, printed):
    entry = EXPERIMENTS[name]
    (line,) = [line for line in entry.lines if line.label == label]
    found = published(entry, line, dataset, metric, family)
    assert found is not None
    assert found.value == pytest.approx(printed)
    assert published(entry, line, "procedural-light", metric, family) is None
    assert published(entry, line, dataset, metric, None) is None


def test_the_gain_compares_the_same_frames():
    entry = EXPERIMENTS["gain"]
    assert {task.rule for task in entry.tasks({"eth3d": ["a"]}, rule="da3")} == {"vggt"}
    for name in ("gain", "long-sequence", "features", "main"):
        tasks = EXPERIMENTS[name].tasks({"procedural-big": ["1"]}, rule="neighbours")
        assert {task.rule for task in tasks} == {"neighbours"}
        assert {task.seed for task in tasks} == {43, 44, 45}, "tables of one rule share their samples"


def test_every_published_line_with_a_place_has_numbers():
    for entry in EXPERIMENTS.values():
        for line in entry.lines:
            if line.paper and entry.layout == "means":
                dataset = entry.published_dataset or "eth3d"
                assert published(entry, line, dataset, entry.metrics[-1], "da3") is not None, (entry.name, line)


def test_the_cross_view_table_is_in_percent():
    table = paper_table("cross_view_count")
    assert table.printed({"views": 16}, Cell(None, "overall", "da3")) == Printed(-7.67, 0.005)


def test_tasks_cover_lines_scenes_and_seeds_once():
    tasks = EXPERIMENTS["main"].tasks({"eth3d": ["pipes", "office"]}, rule="vggt")
    assert len(set(tasks)) == len(tasks) == 4 * 2 * 3
    assert {task.rule for task in tasks} == {"vggt"}
    assert {task.seed for task in tasks} == {43, 44, 45}
    rooms = EXPERIMENTS["pose-detail"].tasks({"procedural-big": ["1"]}, seeds=[43])
    assert sorted({task.views for task in rooms}) == [4, 8, 16]
    assert {task.rule for task in EXPERIMENTS["long-sequence"].tasks({"eth3d": ["a"]}, rule="da3")} == {"experiment"}
    assert {task.views for task in EXPERIMENTS["main"].tasks({"eth3d": ["a"]}, views=[8])} == {8}


def test_ablations_run_where_the_paper_ran_them():
    asked = ["eth3d", "hiroom", *ROOMS]
    assert datasets_of(EXPERIMENTS["anchors"], asked) == ["eth3d", "procedural-light"]
    assert datasets_of(EXPERIMENTS["main"], asked) == asked
    assert datasets_of(EXPERIMENTS["anchors"], ["procedural-big"]) == ["procedural-big"]
    assert datasets_of(EXPERIMENTS["anchors"], ["procedural-val-light"]) == ["procedural-val-light"]


def test_ablations_change_what_their_names_say():
    base = named("paper", tiny_da3().spec, "procedural")
    without = variant("no-cross").recipe(base).loss
    assert not without.uses_angles
    assert not without.uses_distances
    assert without.weight_huber == base.loss.weight_huber > 0
    only_cross = variant("no-intra").recipe(base).loss
    assert only_cross.weight_huber == only_cross.weight_cosine == 0
    assert only_cross.uses_angles
    assert variant("anchors-random").recipe(base).loss.selection == "random"
    rank = variant("rank-64").recipe(base)
    assert rank.rank == rank.alpha == 64
    assert variant("adapted").recipe(base) == base
    new = Variant(name="new", label="new", changes={"hold": 1.0, "steps": 5, "loss": {"weight_huber": 2.0}}).recipe(
        base
    )
    assert (new.hold, new.steps, new.epochs, new.loss.weight_huber) == (1.0, 5, None, 2.0)
    assert new.loss.weight_cosine == base.loss.weight_cosine
    with pytest.raises(UserError, match="frozen"):
        variant("thawed")
