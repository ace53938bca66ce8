import json
import shutil

import pytest

from bench_tools import DATASET, ROOMS
from fixture_tools import fixture_path
from freegeo.benchmark import predict as predicting
from freegeo.benchmark.check import check_data, check_dataset
from freegeo.cli.app import main
from freegeo.data.datasets import eth3d
from freegeo.files import keep_ledger, scratch_folder

BENCH = fixture_path("benchmark", "datasets")
ADAPTATION_OPTIONS = (
    ("--lr", "0.5", "recipe.lr"), ("--rank", "2", "recipe.rank"), ("--keep", "0,3", "recipe.keep"),
    ("--sets", "2", "recipe.sets_per_scene"), ("--teacher-views", "6", "recipe.views"), ("--hold", "1", "recipe.hold"),
    ("--loss", "weight_kq=0", "recipe.loss.weight_kq"), ("--adapt-seed", "1", "seed"),
)  # fmt: skip


@pytest.fixture
def freegeo(capsys):
    def run(*arguments):
        capsys.readouterr()
        code = main(["bench", *(str(argument) for argument in arguments)])
        streams = capsys.readouterr()
        return code, streams.out, streams.err

    return run


@pytest.fixture
def options(tmp_path, small_rooms, tiny_model):
    return [
        "--data", tmp_path / "data", "-o", tmp_path / "out", "--datasets", DATASET, "--scenes", "2", "--seeds", "43",
        "--views", "4", "--steps", "1", "--device", "cpu",
    ]  # fmt: skip


def test_experiments_are_listed(freegeo):
    code, out, _ = freegeo("list")
    assert code == 0
    assert "lora-rank" in out


def test_check_says_what_is_missing_and_how_to_get_it(freegeo, tmp_path, monkeypatch):
    code, out, err = freegeo("check", tmp_path)
    assert code == 1
    for dataset in ("eth3d", "7scenes", "scannetpp", "hiroom"):
        assert f"freegeo bench download {dataset} --data {tmp_path}" in out
    assert "eth3d" in err.splitlines()[-1]

    monkeypatch.setattr(eth3d, "SCENES", ("pipes",))
    shutil.copytree(BENCH / "eth3d" / "pipes", tmp_path / "eth3d" / "pipes")
    assert freegeo("check", tmp_path, "--datasets", "eth3d")[0] == 0
    (tmp_path / "eth3d" / "pipes" / "combined_mesh.ply").unlink()
    code, out, _ = freegeo("check", tmp_path, "--datasets", "eth3d")
    assert code == 1
    assert "pipes: " in out
    assert "combined_mesh.ply: no such file (ground truth)" in out


def test_check_names_the_scenes_that_are_not_there():
    (finding,) = check_data(BENCH, ["eth3d"])
    assert finding.wanted == 11
    assert 0 < finding.scenes < 11
    assert any(problem.startswith("courtyard: ") for problem in finding.problems)
    assert check_dataset(BENCH, DATASET).complete


@pytest.mark.slow
def test_a_run_prints_and_stores_its_tables_and_a_second_one_does_nothing_again(freegeo, options, tmp_path):
    code, out, err = freegeo("run", "main", *options)
    assert code in (0, 1), err  # an empty surface of random weights is reported
    assert "forward passes of 4 views" in out
    assert "4 tasks, 0 of them finished" in out
    assert "main: published (tab:benchmark_4v_8v)" in out
    for ending in ("txt", "md", "csv", "tex"):
        assert "4 views, adapted" in (tmp_path / "out" / "tables" / f"main.{ending}").read_text()
    results = (tmp_path / "out" / "results.csv").read_text()

    code, out, _ = freegeo("run", "main", *options)
    assert "4 tasks, 4 of them finished" in out
    assert (tmp_path / "out" / "results.csv").read_text() == results

    for option, value, setting in ADAPTATION_OPTIONS:
        code, _, err = freegeo("predict", "main", *options, option, value)
        assert code == 2
        assert f"adaptation.{setting}: " in err
    assert freegeo("evaluate", "features", *options[:4])[0] in (0, 1)


@pytest.mark.slow
def test_a_run_whose_folder_is_deleted_ends_at_once(freegeo, options, tmp_path, monkeypatch):
    plain, calls = predicting.write_stored, []

    def deleting(*arguments):
        calls.append(arguments)
        shutil.rmtree(tmp_path / "out")
        return plain(*arguments)

    monkeypatch.setattr(predicting, "write_stored", deleting)
    code, _, err = freegeo("run", "main", *options)
    assert code == 1
    assert "was removed or replaced while freegeo was writing there" in err.splitlines()[-1]
    assert len(calls) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_damaged_scene_is_named_and_the_others_are_scored(freegeo, options, tmp_path):
    room = tmp_path / "data" / DATASET / f"{ROOMS[1]}.npz"
    room.parent.mkdir(parents=True)
    room.write_bytes(b"PK")
    room.with_suffix(".ply").write_bytes(b"ply")
    code, _, err = freegeo("run", "long-sequence", *options)
    assert code == 1
    assert f"{DATASET} {ROOMS[1]}: predict" in err
    assert "damaged file" in err
    problems = json.loads((tmp_path / "out" / "problems.json").read_text())
    assert {problem["scene"] for problem in problems if problem["stage"] == "predict"} == {ROOMS[1]}
    assert ROOMS[0] in (tmp_path / "out" / "results.csv").read_text()


def test_a_run_without_any_readable_scene_says_so(freegeo, options, tmp_path):
    for room in ROOMS:
        path = tmp_path / "data" / DATASET / f"{room}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"PK")
        path.with_suffix(".ply").write_bytes(b"ply")
    code, _, err = freegeo("run", "long-sequence", *options)
    assert code == 1
    assert "of 2 scenes" in err.splitlines()[-1]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["run"], "at least one experiment"),
        (["run", "mane"], "no experiment 'mane'"),
        (["run", "main", "--datasets", "kitti"], "kitti"),
        (["run", "main", "--views", "four"], "--views"),
        (["evaluate", "-o", "nowhere"], "no predictions"),
        (["predict", "main", "--datasets", "hiroom", "--data", "nowhere"], "selected_scene_list_val"),
    ],
)
def test_mistakes_end_with_a_sentence_and_code_2(freegeo, tmp_path, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    code, _, err = freegeo(*arguments)
    assert code == 2
    assert said in err.strip().splitlines()[-1]


def test_the_estimate_alone_computes_nothing(freegeo, options, tmp_path):
    code, out, _ = freegeo("predict", "overhead", *options, "--estimate-only")
    assert code == 0
    assert "minutes for the predictions" in out
    assert "surfaces of" in out
    assert not (tmp_path / "out" / "predictions").exists()


def test_what_a_killed_process_left_half_written_goes(freegeo, tmp_path):
    keep_ledger(tmp_path / "out")
    left = scratch_folder(tmp_path / "out" / "tables", "main")
    code, _, err = freegeo("evaluate", "-o", tmp_path / "out", "--data", tmp_path)
    assert code == 2
    assert "holds no predictions" in err
    assert not left.exists()
