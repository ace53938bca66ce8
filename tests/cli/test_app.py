"""The program itself: help, version, messages, config files, and the table of models."""

import io
import logging
import os
import sys
import tomllib
from pathlib import Path

import pytest

from freegeo import __version__
from freegeo.cli import app, console
from freegeo.cli.app import COMMANDS, main
from freegeo.cli.models import needs_of
from freegeo.models import catalog


def test_help_names_every_command_and_fits_a_terminal(freegeo):
    for arguments in ([], ["--help"], ["-h"]):
        outcome = freegeo(*arguments)
        assert outcome.code == 0
        assert outcome.err == ""
        for name, (_, about) in COMMANDS.items():
            assert f"  {name}" in outcome.out
            assert about in outcome.out
        assert max(map(len, outcome.out.splitlines())) <= 100


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_every_command_explains_itself(freegeo, command):
    outcome = freegeo(command, "--help")
    assert outcome.code == 0
    assert outcome.err == ""
    assert f"freegeo {command}" in outcome.out
    assert "--config" in outcome.out


def test_version(freegeo):
    assert freegeo("--version").out.strip() == __version__


def test_verbose_shows_what_the_library_notes_down():
    for verbose, level in ((False, logging.INFO), (True, logging.DEBUG)):
        console.configure_logging(verbose)
        assert logging.getLogger("freegeo").getEffectiveLevel() == level


def test_a_warning_is_shown_and_kept_once_until_the_next_command(capsys):
    for _ in range(2):
        console.configure_logging(False)
        assert console.warned() == []
        for _ in range(2):
            logging.getLogger("freegeo.data").warning("Half of %s is cut off.", "a.png")
        logging.getLogger("freegeo.data").info("a note")
        assert console.warned() == ["Half of a.png is cut off."]
    assert capsys.readouterr().err.splitlines()[0] == "warning: Half of a.png is cut off."


@pytest.mark.parametrize("flag", ["-v", "--verbose"])
def test_verbose_may_stand_anywhere(flag):
    for arguments in ([flag, "run", "x"], ["run", flag, "x"], ["run", "x", flag]):
        assert app.split_global(arguments) == (["run", "x"], None, True)


def test_command_line_is_quoted_as_it_could_be_typed():
    console.remember_command(["run", "my photos/*.jpg", "-o", "out"])
    assert console.command_line() == "freegeo run 'my photos/*.jpg' -o out"


@pytest.mark.parametrize(
    ("stop", "code", "words"), [(KeyboardInterrupt(), 130, "interrupted"), (SystemExit(143), 143, "asked to end")]
)
def test_interrupt_and_sigterm_have_codes_of_their_own_and_say_how_to_go_on(
    freegeo, monkeypatch, tmp_path, stop, code, words
):
    def interrupt(*arguments, **options):
        raise stop

    monkeypatch.setattr("freegeo.cli.reconstruct.load_source", interrupt)
    outcome = freegeo("reconstruct", "x", "-o", tmp_path / "out")
    assert outcome.code == code
    assert words in outcome.sentence()
    assert "the same command continues" in outcome.sentence()


# -- config files


@pytest.fixture
def caught(monkeypatch) -> list:
    """What `run` would have done."""
    calls = []
    monkeypatch.setattr("freegeo.cli.run.load_source", lambda sources, limit, **_: calls.append((sources, limit)))
    monkeypatch.setattr("freegeo.cli.options.ModelOptions.load", lambda self: type("Model", (), {"spec": None}))
    monkeypatch.setattr("freegeo.cli.options.RecipeOptions.build", lambda self, spec: self)
    monkeypatch.setattr("freegeo.cli.run.run_job", lambda *args, **options: calls.append((args, options)))
    return calls


def config(folder, text: str) -> str:
    file = folder / "freegeo.toml"
    file.write_text(text)
    return str(file)


def test_config_sets_options_and_the_command_line_wins(caught, tmp_path):
    file = config(tmp_path, '[run]\nmodel = "da3-large"\nsteps = 5\nmax-views = 7\nrank = 4\n[adapt]\nsteps = 9\n')
    assert main(["run", "x", "-o", "out", "--config", file, "--rank", "8"]) == 0
    (sources, limit), ((_, model, output), options) = caught
    assert (sources, limit.max_views) == (("x",), 7)
    assert model.model == "da3-large"
    assert str(output.output) == "out"
    assert (options["recipe"].steps, options["recipe"].rank) == (5, 8)


@pytest.mark.parametrize("spelling", ["--config FILE", "--config=FILE"])
def test_config_sets_switches(caught, tmp_path, spelling):
    file = config(tmp_path, '[run]\nadapt = false\noverwrite = true\noutput = "from-file"\n')
    assert main(["run", "x", *spelling.replace("FILE", file).split()]) == 0
    (_, _, output), options = caught[1]
    assert options["recipe"] is None
    assert output.overwrite
    assert str(output.output) == "from-file"


@pytest.mark.parametrize("given", [["--output=~/x"], ["--output", "~/x"], ["-o", "~/x"], ["-o=~/x"]])
def test_the_home_folder_may_be_short_in_every_option(caught, tmp_path, monkeypatch, given):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert main(["run", "~/photos", *given, "--checkpoint=~/w.pt", "--masks", "~/m"]) == 0
    (sources, _), ((_, model, output), options) = caught
    assert sources == (f"{tmp_path}/photos",)
    assert output.output == tmp_path / "x"
    assert model.checkpoint == tmp_path / "w.pt"
    assert options["files"].filters.masks == tmp_path / "m"


def test_the_home_folder_may_be_short_in_a_config(caught, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert main(["run", "x", "--config", config(tmp_path, '[run]\noutput = "~/x"\nsteps = 3\n')]) == 0
    (_, _, output), options = caught[1]
    assert output.output == tmp_path / "x"
    assert options["recipe"].steps == 3


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[run]\nstepz = 2\n", "stepz"),
        ('[run]\nsteps = "many"\n', "'many' is not a whole number"),
        ("[run]\nsteps = 1.5\n", "'1.5' is not a whole number"),
        ('[run]\nlr = "fast"\n', "'fast' is not a number"),
        ('[run]\noverwrite = "perhaps"\n', "'perhaps' is not true or false"),
        ("[run]\nsource = 'x'\n", "Unknown option: source from"),
        ("[rnu]\nsteps = 2\n", "'rnu' is no table of a command"),
        ("steps = 2\n", "'steps' is no table of a command"),
        ("[run]\nno-adapt = true\n", "write adapt = false instead of no-adapt in [run]"),
        ("[run\n", "not a TOML file"),
    ],
)
def test_mistakes_in_a_config_are_refused(freegeo, caught, tmp_path, text, words):
    outcome = freegeo("run", "x", "-o", tmp_path / "out", "--config", config(tmp_path, text))
    assert outcome.code == 2
    assert words in outcome.sentence()
    assert "freegeo.toml" in outcome.sentence()
    assert caught == []


def test_config_that_is_not_there(freegeo, tmp_path):
    assert "No such file" in freegeo("run", "x", "-o", "out", "--config", tmp_path / "no.toml").sentence()
    assert "needs the name" in freegeo("run", "x", "-o", "out", "--config").sentence()
    assert "Is a directory" in freegeo("run", "x", "-o", "out", "--config", tmp_path).sentence()


def test_example_in_the_documentation_is_a_config(caught, tmp_path):
    lines = [line.strip() for line in (app.__doc__ or "").splitlines() if line.startswith("    ")]
    text = "\n".join(lines)
    assert set(tomllib.loads(text)) == {"run"}
    assert main(["run", "--config", config(tmp_path, text)]) == 0
    (sources, _), ((_, model, output), options) = caught
    assert (sources, str(output.output), model.model, options["recipe"].steps) == (("photos",), "out", "da3-giant", 50)


@pytest.mark.parametrize("written", ['["a", "b"]', '"a"'])
def test_sources_in_a_config_stand_back_for_those_on_the_command_line(caught, tmp_path, written):
    file = config(tmp_path, f'[run]\noutput = "out"\nsources = {written}\n')
    assert main(["run", "--config", file]) == 0
    assert main(["run", "x", "y", "--config", file]) == 0
    assert [sources for sources, _ in caught[::2]] == [("a", "b") if "b" in written else ("a",), ("x", "y")]


def test_the_home_folder_is_found_in_lists_and_tables_below_tables(caught, freegeo, monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    file = config(tmp_path, '[run]\noutput = "~/out"\nsources = ["~/a"]\n[models.check]\ncheckpoint = "~/none.pt"\n')
    assert main(["run", "--config", file]) == 0
    assert (caught[0][0], str(caught[1][0][2].output)) == ((str(tmp_path / "a"),), str(tmp_path / "out"))
    assert f"{tmp_path / 'none.pt'}: no such" in freegeo("models", "check", "da3-base", "--config", file).sentence()


def test_lists_in_a_config_reach_options_that_take_several_values_or_a_list_in_one(caught, tmp_path):
    file = config(
        tmp_path,
        '[run]\nkeep = [0, 2, 4]\nloss = ["weight_kq=0", "num_query=9"]\nformats = ["ply", "mesh"]\nmasks = "m"\n',
    )
    assert main(["run", "x", "-o", "out", "--config", file]) == 0
    options = caught[1][1]
    assert (options["recipe"].keep, options["recipe"].loss) == ("0,2,4", ("weight_kq=0", "num_query=9"))
    assert list(options["files"].formats) == ["ply", "mesh"]
    assert str(options["files"].filters.masks) == "m"


def test_commands_below_commands_have_tables_too(freegeo, tmp_path):
    file = config(tmp_path, '[models.describe]\nmodel = "freegeo-tiny"\n[models.check]\nmodel = "da3-base"\n')
    assert freegeo("models", "describe", "--config", file).out.startswith("freegeo-tiny: ")
    assert "needs CHECKPOINT" in freegeo("models", "check", "--config", file).sentence()
    file = config(tmp_path, '[bench.run]\nexperiments = ["main", "nonsense"]\n')
    assert "nonsense" in freegeo("bench", "run", "--config", file).sentence()


def test_config_works_for_a_whole_run(freegeo, photo_folder, tiny, tmp_path):
    file = config(
        tmp_path, f'[reconstruct]\nmodel = "{tiny[1]}"\ncheckpoint = "{tiny[3]}"\noutput = "{tmp_path / "out"}"\n'
    )
    assert freegeo("reconstruct", photo_folder, "--config", file).code == 0
    assert (tmp_path / "out" / "prediction.npz").is_file()


# -- what the parser says


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("run x -o", "-o needs a value: -o PATH. Folder for the results."),
        ("run x -o o --steps", "--steps needs a value: --steps N. "),
        ("run x -o o --lr", "--lr needs a value: --lr X. "),
        ("run x -o o --keep", "--keep needs a value: --keep TEXT. "),
        ("run x -o o --recipe", "--recipe needs a value: --recipe scene|evidence|paper|released-da3|released-vggt. "),
        ("run x -o o --loss", "--loss needs a value: --loss TEXT. Settings of the loss, such as weight_kq=0"),
        ("run x", "`freegeo run` needs --output PATH. Folder for the results."),
        ("models describe", "`freegeo models describe` needs MODEL. "),
        ("adapter merge", "`freegeo adapter merge` needs ADAPTER. "),
        ("run x -o o --steps many", "--steps: 'many' is not a whole number."),
        ("run x -o o --rank 3.7", "--rank: '3.7' is not a whole number."),
        ("run x -o o --seed 1e3", "--seed: '1e3' is not a whole number."),
        ("run x -o o --lr fast", "--lr: 'fast' is not a number."),
        ("run x -o o --no-adapt=3", "--no-adapt: '3' is not true or false."),
        ("run x -o o --seed 1 --seed 2", "--seed is given more than once. Give it once."),
        ("export a b -f ply", "'b' is not expected here; `freegeo export --help` shows what is."),
        ("run x -o o --formats obj", "Unknown export format 'obj'. Choose from npz, ply, glb"),
        ("run x -o o --stepz 3", "Unknown option: --stepz. Did you mean --steps?"),
        ("runn x", 'Unknown command "runn". Did you mean "run"?'),
    ],
)
def test_mistakes_on_the_command_line_show_what_would_be_right(freegeo, line, sentence):
    outcome = freegeo(*line.split())
    assert outcome.code == 2
    assert outcome.sentence().startswith(f"freegeo: {sentence}")
    assert outcome.err.count("\n") == 1


# -- streams


@pytest.mark.parametrize("encoding", ["cp1252", "ascii", "cp932"])
def test_text_that_a_stream_cannot_encode_is_escaped(monkeypatch, encoding):
    streams = {name: io.TextIOWrapper(io.BytesIO(), encoding=encoding) for name in ("stdout", "stderr")}
    for name, stream in streams.items():
        monkeypatch.setattr(sys, name, stream)
    assert main(["models", "describe", "模型 é"]) == 2
    console.say("é 模型 \udcff")
    for stream in streams.values():
        written = stream.buffer.getvalue().decode(encoding)
        assert "模型" in written or "\\u6a21\\u578b" in written
    assert "\\udcff" in streams["stdout"].buffer.getvalue().decode(encoding)


@pytest.mark.parametrize("arguments", [[], ["--version"], ["models"], ["models", "describe", "nothing"]])
def test_closed_streams_are_no_mistake(monkeypatch, arguments):
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    assert main(arguments) == (2 if "nothing" in arguments else 0)
    console.finish_streams()


@pytest.mark.parametrize("arguments", [["--help"], ["models"]])
def test_a_reader_that_goes_away_ends_nothing(monkeypatch, capfd, arguments):
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        assert main(arguments) == 0
        console.say("nobody reads this")
        console.finish_streams()
    assert capfd.readouterr().err == ""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
@pytest.mark.parametrize("arguments", [["--help"], ["models"]])
def test_a_log_on_a_full_disk_is_one_sentence(monkeypatch, capfd, arguments):
    with Path("/dev/full").open("w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        assert main(arguments) == 1
        console.finish_streams()
    assert capfd.readouterr().err.count("\n") == 1


def test_names_of_files_that_are_no_text_are_refused(freegeo, monkeypatch, tmp_path):
    def write(*arguments, **options):
        (tmp_path / "x.json").write_text('{\n  "names": [\n    "\udcff1.png",\n    "2.png"]', encoding="utf-8")

    monkeypatch.setattr("freegeo.cli.reconstruct.load_source", write)
    outcome = freegeo("reconstruct", "x", "-o", tmp_path / "out")
    assert outcome.code == 2
    assert outcome.sentence() == "freegeo: \\udcff1.png: the name of a file is not UTF-8 text. Rename that file."


# -- models


def test_models_fit_a_terminal_and_name_every_licence(freegeo):
    outcome = freegeo("models")
    assert outcome.code == 0
    lines = outcome.out.splitlines()
    assert max(map(len, lines)) <= 100
    for name in catalog.names():
        about, numbers = [line for line in lines if line.split()[:1] == [name]]
        assert about.split(maxsplit=1)[1].split(" ")[0] == catalog.entry(name).about.split(" ")[0]
        assert catalog.entry(name).licence.split(" (")[0] in numbers


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("da3-giant", ("5,311,488", "10,619,904", "21,236,736", "42,470,400", "takes: photos, and the poses together")),
        ("freegeo-tiny", ("embedded",)),
        ("map-anything", ("12,582,912", "lengths: metres", "takes: photos, and poses or intrinsics or both", "15\n")),
    ],
)
def test_describe_counts_what_an_adapter_trains(freegeo, name, counts):
    outcome = freegeo("models", "describe", name)
    assert outcome.code == 0
    assert outcome.out.startswith(f"{name}: ")
    assert f"licence of the weights: {catalog.entry(name).licence}" in outcome.out
    for count in counts:
        assert count in outcome.out


def test_models_and_describe_show_one_size_one_download_and_the_planned_memory(freegeo, monkeypatch):
    monkeypatch.setattr(catalog, "names", lambda: ["da3-base", "vggt-1b", "freegeo-tiny"])
    said = freegeo("models").out
    lines = {line.split()[0]: line for line in said.splitlines() if line.strip()}  # of the last table with the name
    needs = {item.entry.name: item for item in catalog.for_each(needs_of)}
    assert list(needs) == catalog.names()
    assert "included" in lines["freegeo-tiny"]
    for name in ("da3-base", "vggt-1b"):
        found, out = needs[name], freegeo("models", "describe", name).out
        assert out.startswith(f"{name}: ")
        assert f"{found.parameters / 1e6:,.0f} M" in lines[name]
        assert f"parameters: {found.parameters:,}\n" in out
        assert found.download >= 4 * found.parameters
        assert list(found.reconstruct) == [8, 32, 100]
        assert 4 * found.parameters < found.reconstruct[8] < found.reconstruct[32] < found.reconstruct[100]
        for size in (found.download, *found.reconstruct.values()):
            assert f"{size / 1e9:.1f} GB" in lines[name] and f"{size / 1e9:.1f} GB" in out
        fast, small = found.adapt
        assert fast > small > 4 * found.parameters
        assert f"memory to adapt to 8 of them: {fast / 1e9:.1f} GB, or {small / 1e9:.1f} GB" in out


def test_describe_says_what_a_model_of_single_views_lacks(freegeo):
    out = freegeo("models", "describe", "da3metric-large").out
    assert "adapter: none, since it looks at each photo by itself" in out
    assert "memory to adapt" not in out
    assert "its depth is not in metres yet" in out
    assert "lengths: metres" in freegeo("models", "describe", "da3nested-giant-large").out


def test_check_tells_whether_a_file_fits(freegeo, weights):
    assert "fits freegeo-tiny" in freegeo("models", "check", "freegeo-tiny", weights).out
    outcome = freegeo("models", "check", "da3-small", weights)
    assert outcome.code == 2
    assert "does not fit da3-small" in outcome.sentence()
    assert freegeo("models", "describe", "nothing").code == 2


def test_embedded_model_needs_no_download(freegeo):
    outcome = freegeo("models", "download", "freegeo-tiny")
    assert outcome.code == 0
    assert "freegeo-tiny.safetensors" in outcome.out


def test_table_wraps_its_last_column():
    text = console.table(("a", "b"), [("x", "one two three four five")], prose=20)
    assert text.splitlines() == ["a  b", "-  -------------", "x  one two three", "   four five"]
    plain = console.table(("name", "n"), [("x", "1"), ("long", "22")])
    assert plain.splitlines() == ["name   n", "----  --", "x      1", "long  22"]
