"""The program `freegeo`: commands load on use, so that help needs no torch."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

import cyclopts
from cyclopts import App

from freegeo import __version__
from freegeo.errors import FreeGeoError, UserError

USER_MISTAKE, FAILURE, INTERRUPTED = 2, 1, 130

COMMANDS = {
    "demo": ("freegeo.cli.demo:demo", "Photograph a generated room, adapt to it, score before and after."),
    "run": ("freegeo.cli.run:run", "Photos in, adapted reconstruction out."),
    "adapt": ("freegeo.cli.adapt:adapt", "Adapt a model to one or several scenes and save the adapter."),
    "reconstruct": ("freegeo.cli.reconstruct:reconstruct", "Reconstruct with a frozen model or a saved adapter."),
    "models": ("freegeo.cli.models:app", "List, describe, download and check models."),
    "train-tiny": ("freegeo.cli.train_tiny:train_tiny", "Train the embedded model on generated rooms."),
}


def build(config: Path | None = None) -> App:
    """Build the command tree; `config` is a TOML file with one table per command."""
    app = App(
        name="freegeo",
        help="Adapt feed-forward 3D models to your scene at test time.",
        version=__version__,
        help_epilogue="Every command takes --config FILE.toml (one table per command) and -v for more messages.",
        config=None if config is None else cyclopts.config.Toml(config, must_exist=True),
        help_format="plaintext",
        result_action="return_value",
        suppress_keyboard_interrupt=False,
    )
    for name, (target, about) in COMMANDS.items():
        app.command(target, name=name, help=about)
    return app


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line; returns the exit code (0, 2 for the user's mistake, 1 for a failure)."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    from freegeo.cli import console

    try:
        arguments, config, verbose = split_global(arguments)
        console.configure_logging(verbose)
        app = build(config)
        app(arguments, exit_on_error=False, print_error=False)
    except cyclopts.CycloptsError as error:
        return console.fail(one_line(str(error)), USER_MISTAKE)
    except UserError as error:
        return console.fail(str(error), USER_MISTAKE)
    except FreeGeoError as error:
        return console.fail(str(error), FAILURE)
    except KeyboardInterrupt:
        return console.fail("interrupted; the same command continues an unfinished run.", INTERRUPTED)
    except OSError as error:
        return console.fail(f"{error.filename or 'output'}: {error.strerror or error}.", FAILURE)
    return 0


def split_global(arguments: list[str]) -> tuple[list[str], Path | None, bool]:
    """Take --config FILE and -v/--verbose off a command line; they may stand anywhere."""
    rest, config, verbose = [], None, False
    tokens = iter(arguments)
    for token in tokens:
        if token in ("-v", "--verbose"):
            verbose = True
        elif token == "--config" or token.startswith("--config="):
            value = token.partition("=")[2] or next(tokens, "")
            config = Path(value)
            if not config.is_file():
                raise UserError(f"--config {value or '(nothing)'}: no such file.")
        else:
            rest.append(token)
    return rest, config, verbose


def one_line(text: str) -> str:
    """Join a parser's message into one sentence."""
    return " ".join(text.split())


def entry() -> None:
    """Console script: exit with the command's code."""
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    # Worker threads of third-party libraries must not hold the process after everything is written.
    os._exit(code) if code == INTERRUPTED else sys.exit(code)


if __name__ == "__main__":
    entry()
