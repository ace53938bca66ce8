"""The program `freegeo`: commands load on use, so that help needs no torch.

`--config FILE.toml` sets options that the command line leaves out. The file has one table per command, named like it,
with the long names of the options without their dashes, and the arguments by their name; a switch is true or false:

    [run]
    sources = ["photos"]
    output = "out"
    model = "da3-giant"
    formats = ["ply", "mesh"]
    steps = 50
    adapt = true
"""

from __future__ import annotations

import errno
import io
import os
import signal
import sys
import tomllib
from collections.abc import Sequence
from contextlib import nullcontext, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING

from freegeo import __version__
from freegeo.cli import console
from freegeo.errors import FreeGeoError, PartialResultError, UserError
from freegeo.host import end_with_parent, exhausted_memory

if TYPE_CHECKING:
    from cyclopts import App

ABOUT = "Adapt feed-forward 3D models to your scene at test time."
GLOBAL = "Every command takes --config FILE.toml (a table of options per command) and -v for more messages."
USER_MISTAKE, FAILURE, PARTIAL, INTERRUPTED = 2, 1, 3, 130
TERMINATED = 143
"""Exit code after SIGTERM."""

HELP = {"--help", "-h"}

COMMANDS = {
    "demo": ("freegeo.cli.demo:demo", "Photograph a generated room, adapt to it, score before and after."),
    "run": ("freegeo.cli.run:run", "Photos in, adapted reconstruction out."),
    "batch": ("freegeo.cli.batch:batch", "Many scenes, each as by run, in several processes or on a ray cluster."),
    "adapt": ("freegeo.cli.adapt:adapt", "Adapt a model to one or several scenes and save the adapter."),
    "reconstruct": ("freegeo.cli.reconstruct:reconstruct", "Reconstruct with a frozen model or a saved adapter."),
    "adapter": ("freegeo.cli.adapter:app", "Fold a saved adapter into the weights of its model."),
    "cameras": ("freegeo.cli.cameras:app", "Check known cameras against photos, and convert them."),
    "refine": ("freegeo.cli.refine:refine", "Bring a result's cameras to its photos by bundle adjustment."),
    "export": ("freegeo.cli.export:export", "Write a reconstruction in other tools' formats."),
    "app": ("freegeo.cli.webapp:webapp", "Photos in, adapted reconstruction out, in the browser."),
    "view": ("freegeo.cli.view:view", "Look at results in the browser, before and after adaptation."),
    "bench": ("freegeo.cli.bench:app", "Published evaluation: datasets, tables, comparison with the paper."),
    "models": ("freegeo.cli.models:app", "List, describe, download and check models."),
    "doctor": ("freegeo.cli.doctor:doctor", "Say what is installed, what is broken, and what to do next."),
    "train-tiny": ("freegeo.cli.train_tiny:train_tiny", "Train the embedded model on generated rooms."),
}


def overview() -> str:
    """Return the help of the program itself: a table of the commands."""
    width = max(len(name) for name in COMMANDS)
    rows = [f"  {name.ljust(width)}  {about}" for name, (_, about) in COMMANDS.items()]
    options = ["  --help, -h  Show this, or the help of a command.", "  --version   Show the version."]
    return "\n".join(["Usage: freegeo COMMAND ...", "", ABOUT, "", "Commands:", *rows, "", *options, "", GLOBAL])


def build(config: Path | None = None) -> App:
    """Build the command tree; `config` is a TOML file with one table per command."""
    import cyclopts

    from freegeo.cli.parsing import readers

    app = cyclopts.App(
        name="freegeo",
        help=ABOUT,
        version=__version__,
        help_epilogue=GLOBAL,
        config=readers(config),
        help_format="plaintext",
        result_action="return_value",
        suppress_keyboard_interrupt=False,
    )
    for name, (target, about) in COMMANDS.items():
        app.command(target, name=name, help=about)
    return app


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line and return the exit code.

    0: done; 2: the user's mistake; 1: a failure; 3: everything was written but for some files; 130: Ctrl-C; 143: asked
    to end by SIGTERM.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    console.prepare_streams()
    # The parser takes longer to load than these two take to answer.
    answers = {"": overview, "-h": overview, "--help": overview, "--version": lambda: __version__}
    if len(arguments) > 1 or "".join(arguments) not in answers:
        return run_command(arguments)
    try:
        console.say(answers["".join(arguments)]())
    except OSError as error:
        return _fail_to_write(error)
    return 0


def run_command(arguments: Sequence[str]) -> int:
    """Parse and run a command, and turn its errors into one sentence and an exit code."""
    import cyclopts

    console.remember_command(arguments)
    try:
        rest, config, verbose = split_global(arguments)
        console.configure_logging(verbose)
        # The parser prints help by itself; a reader that goes away (`| head`) does not matter there either.
        shown = io.StringIO() if HELP & set(rest) else None
        with nullcontext() if shown is None else redirect_stdout(shown):
            build(config)(rest, exit_on_error=False, print_error=False)
        if shown is not None:
            console.say(shown.getvalue().removesuffix("\n"))
    except cyclopts.CycloptsError as error:
        from freegeo.cli.parsing import explain

        return console.fail(explain(error), USER_MISTAKE)
    except UserError as error:
        return console.fail(str(error), USER_MISTAKE)
    except PartialResultError as error:
        return console.fail(str(error), PARTIAL)
    except FreeGeoError as error:
        return console.fail(str(error), FAILURE)
    except KeyboardInterrupt:
        return console.fail("interrupted; the same command continues an unfinished run.", INTERRUPTED)
    except SystemExit as error:
        if error.code != TERMINATED:
            raise
        return console.fail("asked to end (SIGTERM); the same command continues an unfinished run.", TERMINATED)
    except (MemoryError, RuntimeError) as error:
        sentence = out_of_memory(error)
        if sentence is None:
            raise
        return console.fail(sentence, FAILURE)
    except OSError as error:
        return _fail_to_write(error)
    except UnicodeEncodeError as error:
        # Names of files may hold any bytes; no file that we write can.
        name = error.object[error.object.rfind("\n", 0, error.start) + 1 :].partition("\n")[0].strip(' ",')
        return console.fail(f"{name}: the name of a file is not UTF-8 text. Rename that file.", USER_MISTAKE)
    return 0


def out_of_memory(error: BaseException) -> str | None:
    """Return what to do about an error of exhausted memory, of this machine or of a device; None for other errors."""
    of, again = exhausted_memory(error), "The same command continues an unfinished run."
    if of == "device":
        return (
            "the memory of the device does not suffice. Use fewer photos (--max-views, --views), smaller images "
            f"(--process-res), --precision bf16 or a smaller --model, or free the device of other work. {again}"
        )
    if of == "machine":
        return (
            "the memory of this machine does not suffice. Use fewer photos (--max-views), smaller images "
            f"(--process-res) or a smaller --model, or close other programs. {again}"
        )
    return None


def _fail_to_write(error: OSError) -> int:
    full = error.errno in (errno.ENOSPC, errno.EDQUOT) and error.filename != console.STANDARD_OUTPUT
    hint = " Make room and run the same command again; it continues." if full else ""
    if error.errno in (errno.EMFILE, errno.ENFILE):
        hint = " Raise the limit (ulimit -n), or close other programs, and run the same command again; it continues."
    return console.fail(f"{error.filename or 'input or output'}: {error.strerror or error}.{hint}", FAILURE)


def split_global(arguments: Sequence[str]) -> tuple[list[str], Path | None, bool]:
    """Take --config FILE and -v/--verbose off a command line; they may stand anywhere."""
    rest, config, verbose = [], None, False
    tokens = iter(map(expand_home, arguments))
    for token in tokens:
        if token in ("-v", "--verbose"):
            verbose = True
        elif token == "--config" or token.startswith("--config="):
            value = token.partition("=")[2] or next(tokens, "")
            if not value:
                raise UserError("--config needs the name of a TOML file.")
            config = checked_config(Path(value))
        else:
            rest.append(token)
    return rest, config, verbose


def expand_home(token: str) -> str:
    """Put the home folder for `~` in `--output=~/x`, where shells leave it as it is, and in quotes."""
    option, equals, value = token.partition("=")
    if equals and option.startswith("-"):
        return f"{option}={os.path.expanduser(value)}"  # noqa: PTH111
    return os.path.expanduser(token)  # noqa: PTH111


def checked_config(path: Path) -> Path:
    """Return the path of a config file; UserError unless it is TOML with tables named like commands.

    The parser refuses unknown options of the command that runs, but not tables that no command reads.
    """
    try:
        with path.open("rb") as file:
            content = tomllib.load(file)
    except OSError as error:
        raise UserError(f"--config {path}: {error.strerror}. Check the name.") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"--config {path}: not a TOML file ({error}).") from None
    for name, table in content.items():
        if name not in COMMANDS or not isinstance(table, dict):
            tables = ", ".join(f"[{command}]" for command in COMMANDS)
            raise UserError(f"--config {path}: '{name}' is no table of a command. Put options into one of {tables}.")
        for option in table:
            if option.startswith(("no-", "no_")):
                raise UserError(f"--config {path}: write {option[3:]} = false instead of {option} in [{name}].")
    return path


def entry() -> None:
    """Console script: exit with the command's code."""
    # A run that is asked to end saves its state, as after Ctrl-C.
    signal.signal(signal.SIGTERM, lambda *arguments: sys.exit(TERMINATED))
    end_with_parent()
    code = main()
    console.finish_streams()
    # Worker threads of third-party libraries must not hold the process after everything is written.
    os._exit(code) if code == INTERRUPTED else sys.exit(code)


if __name__ == "__main__":
    entry()
