"""The command that makes the tables of the embedded model again: it continues, and never mixes two weight files."""

import dataclasses
import importlib.util
import sys
from pathlib import Path

import cyclopts
import pytest

from freegeo.cli.app import build, split_global
from freegeo.models.da3_config import EMBEDDED_WEIGHTS

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def tables():
    spec = importlib.util.spec_from_file_location("tables_benchmark", ROOT / "benchmarks" / "tables.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.fixture
def study(tables, tmp_path):
    """A study of three commands that each add a line to a file, whose table is that file."""
    program = tmp_path / "program.sh"
    program.write_text(
        'if [ "$1" = show ]; then cat "$2/lines"; exit; fi\n'
        '[ -e "$2/../../broken-$1" ] && exit 5\n'
        '[ -e "$2/../../swap-$1" ] && echo other > "$2/../../weights"\n'
        'echo "line $1" >> "$2/lines"\n'
    )
    (tmp_path / "weights").write_text("first")
    steps = tuple(("sh", str(program), str(number), "{out}") for number in (1, 2, 3))
    part = tables.Part(
        folder="lines", pages=("guard.md",), minutes=1, steps=steps, table=("sh", str(program), "show", "{out}")
    )

    def call(*arguments: str, parts=None) -> int:
        return tables.main(["-o", str(tmp_path / "out"), *arguments], parts or {"lines": part}, tmp_path / "weights")

    return call, part, tmp_path


def lines(folder: Path) -> list[str]:
    return (folder / "out" / "lines.md").read_text().splitlines()


def test_every_command_runs_once_and_the_table_says_what_it_rests_on(study):
    call, _, folder = study
    assert call() == 0
    assert lines(folder)[0].startswith("<!-- lines: 3 of 3 commands, weights ")
    assert lines(folder)[2:] == ["line 1", "line 2", "line 3"]
    assert call() == 0
    assert lines(folder)[2:] == ["line 1", "line 2", "line 3"]


def test_a_stopped_study_has_a_table_and_goes_on_where_it_was(study):
    call, _, folder = study
    (folder / "broken-2").touch()
    assert call() == 1
    assert lines(folder)[0].startswith("<!-- lines: 1 of 3 commands")
    (folder / "broken-2").unlink()
    assert call() == 0
    assert lines(folder)[2:] == ["line 1", "line 2", "line 3"]


def test_no_command_begins_when_the_time_is_up(study, capsys):
    call, _, folder = study
    assert call("--minutes", "0") == 0
    assert "lines, 1 of 3: no time left" in capsys.readouterr().out
    assert not (folder / "out").exists()


def test_results_of_other_weights_are_refused_and_left_alone(study, capsys):
    call, _, folder = study
    assert call() == 0
    before = lines(folder)
    (folder / "weights").write_text("second")
    assert call() == 2
    assert "made with other weights" in capsys.readouterr().err
    assert lines(folder) == before


def test_a_folder_of_unknown_weights_is_refused(study, capsys):
    call, _, folder = study
    (folder / "out" / "lines").mkdir(parents=True)
    (folder / "out" / "lines" / "lines").write_text("of yesterday\n")
    assert call() == 2
    assert "nothing says which weights" in capsys.readouterr().err


def test_results_of_a_command_that_has_changed_since_are_refused(study, capsys):
    call, part, _ = study
    assert call() == 0
    shorter = dataclasses.replace(part, steps=part.steps[1:])
    assert call(parts={"lines": shorter}) == 2
    assert "made by a command that is none of its part any more" in capsys.readouterr().err
    longer = dataclasses.replace(part, steps=(*part.steps, part.steps[0]))
    assert call(parts={"lines": longer}) == 0


def test_a_command_during_which_the_weights_changed_counts_for_nothing(study, capsys):
    call, _, folder = study
    (folder / "swap-2").touch()
    assert call() == 2
    assert "changed meanwhile" in capsys.readouterr().err
    assert lines(folder)[2:] == ["line 1"]
    assert call() == 2
    assert "made with other weights" in capsys.readouterr().err


def test_parts_of_one_folder_share_its_table(study):
    call, part, folder = study
    halves = {
        "first": dataclasses.replace(part, steps=part.steps[:1]),
        "rest": dataclasses.replace(part, steps=part.steps[1:]),
    }
    assert call("first", parts=halves) == 0
    assert lines(folder)[0].startswith("<!-- lines: 1 of 3 commands")
    assert call("rest", parts=halves) == 0
    assert lines(folder)[2:] == ["line 1", "line 2", "line 3"]


def test_every_part_names_commands_and_pages_that_exist(tables, capsys):
    assert tables.WEIGHTS == EMBEDDED_WEIGHTS
    assert tables.main(["--list"]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in listed] == [*tables.PARTS, "all"]
    for name, part in tables.PARTS.items():
        for page in part.pages:
            assert (ROOT / "docs" / page.split("#")[0]).exists(), f"{name}: {page}"
        for step in (*part.steps, part.table):
            if step[0] == "freegeo":
                words = [word.replace("{out}", "out").replace("{data}", "data") for word in step[1:]]
                rest, _, _ = split_global(words)
                try:
                    build().parse_args(rest, exit_on_error=False, print_error=False)
                except cyclopts.CycloptsError as error:
                    pytest.fail(f"{name}: {error}")
            else:
                assert (ROOT / "benchmarks" / step[0]).is_file(), f"{name}: {step[0]}"
