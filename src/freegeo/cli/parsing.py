"""What the parser of the command line leaves to us: arguments in config files, whole numbers, and plain messages."""

from __future__ import annotations

import inspect
import math
import os
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from cyclopts import (
    App,
    CoercionError,
    CycloptsError,
    MissingArgumentError,
    RepeatArgumentError,
    Token,
    ValidationError,
)
from cyclopts.argument import Argument, ArgumentCollection
from cyclopts.config import Dict
from cyclopts.exceptions import UnusedCliTokensError

from freegeo.errors import UserError

FORMS = {int: "N", float: "X", Path: "PATH", str: "TEXT"}
"""What stands for a value of an option, by its type."""
NUMBERS = {int: "a whole number", float: "a number", bool: "true or false"}
_SHOWN = 40
"""Most characters of a value that a message shows."""
_WHOLE = re.compile(r"[+-]?\d+")

Reader = Callable[[App, tuple[str, ...], ArgumentCollection], None]


def readers(config: Path | None) -> list[Reader]:
    """Return what the parser calls between reading a command line and converting its values."""
    if config is None:
        return [_require_numbers]
    content = _at_home(tomllib.loads(config.read_text(encoding="utf-8")))

    def read(app: App, commands: tuple[str, ...], arguments: ArgumentCollection) -> None:
        table = _table(content, commands)
        _take_positional(table, arguments, str(config))
        _join_lists(table, arguments)
        for command in reversed(commands):
            table = {command: table}
        Dict(table, source=str(config))(app, commands, arguments)

    return [read, _require_numbers]


def _at_home(value: Any) -> Any:
    """Return the content of a config file with the home folder for `~`."""
    if isinstance(value, dict):
        return {name: _at_home(part) for name, part in value.items()}
    if isinstance(value, list):
        return [_at_home(part) for part in value]
    return os.path.expanduser(value) if isinstance(value, str) else value  # noqa: PTH111 (most texts are no paths)


def _table(content: dict[str, Any], commands: tuple[str, ...]) -> dict[str, Any]:
    """Return the options of one command, without the tables of its sub-commands."""
    table: Any = content
    for command in commands:
        table = table.get(command, {}) if isinstance(table, dict) else {}
    return {name: value for name, value in table.items() if not isinstance(value, dict)}


def _take_positional(table: dict[str, Any], arguments: ArgumentCollection, source: str) -> None:
    """Give the arguments of a command that takes any number of them (`sources`) those of the file, if it has none."""
    for argument in arguments:
        if argument.field_info.kind is inspect.Parameter.VAR_POSITIONAL:
            name = argument.field_info.name
            values = table.pop(name, [])
            values = values if isinstance(values, list) else [values]
            if not argument.tokens:
                for index, value in enumerate(values):
                    argument.append(Token(value=str(value), source=source, index=index))


def _join_lists(table: dict[str, Any], arguments: ArgumentCollection) -> None:
    """Write lists as the command line has them, such as 0,2,4,6, for options that take one text."""
    single = [argument for argument in arguments if argument.hint in (str, str | None)]
    texts = {name.lstrip("-") for argument in single for name in argument.names}
    for name, value in table.items():
        if isinstance(value, list) and name.replace("_", "-") in texts:
            table[name] = ",".join(str(part) for part in value)


def _require_numbers(app: App, commands: tuple[str, ...], arguments: ArgumentCollection) -> None:
    """Refuse 1.5 where a whole number is wanted, which the parser would round, and numbers that nothing can be."""
    for argument in arguments:
        for token in argument.tokens:
            wrong = _CHECKS.get(_kind(argument), lambda text: None)(token.value)
            if wrong is not None:
                raise UserError(f"{_place(token, argument)}: '{_short(token.value)}' is {wrong}.")


def _wrong_whole(text: str) -> str | None:
    if not _WHOLE.fullmatch(text):
        return "not a whole number"
    fits = len(text) <= _DIGITS and -(2**63) <= int(text) < 2**64
    return None if fits else "too large a number"


def _wrong_float(text: str) -> str | None:
    try:
        return None if math.isfinite(float(text)) else "not a finite number"
    except ValueError:
        return "not a number"


_CHECKS: dict[Any, Callable[[str], str | None]] = {int: _wrong_whole, float: _wrong_float}
_DIGITS = 20
"""Most characters of a whole number of 64 bits."""


def _short(text: str) -> str:
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def explain(error: CycloptsError) -> str:
    """Return what is wrong with a command line, in one sentence that shows what would be right."""
    argument = error.argument
    if type(error) is MissingArgumentError and argument is not None:
        return _missing(error, argument)
    if isinstance(error, CoercionError) and error.token is not None and error.target_type in NUMBERS:
        return f"{_place(error.token, argument)}: '{error.token.value}' is not {NUMBERS[error.target_type]}."
    if isinstance(error, RepeatArgumentError):
        return f"{error.token.keyword} is given more than once. Give it once."
    if isinstance(error, ValidationError) and error.exception_message:
        return error.exception_message
    if isinstance(error, UnusedCliTokensError):
        command = " ".join(["freegeo", *(error.command_chain or ())])
        return f"'{' '.join(error.unused_tokens or ())}' is not expected here; `{command} --help` shows what is."
    # Names from a config file stand in brackets.
    return re.sub(r'"?\[([\w-]+)\]"?', r"\1", " ".join(str(error).split()))


def _missing(error: MissingArgumentError, argument: Argument) -> str:
    """Explain an option without its value, or an option or argument that is left out."""
    about = _help(error, argument)
    if error.keyword:
        return f"{error.keyword} needs a value: {error.keyword} {_form(argument)}{about}"
    command = " ".join(["freegeo", *(error.command_chain or ())])
    if argument.field_info.kind is inspect.Parameter.KEYWORD_ONLY:
        return f"`{command}` needs {argument.name} {_form(argument)}{about}"
    name = argument.name.lstrip("-").upper()
    return f"`{command}` needs {name}{about}"


def _form(argument: Argument) -> str:
    """Return what stands for an option's value: its choices, or a word for its type."""
    choices = argument.get_choices()
    return "|".join(choices) if choices else FORMS.get(_kind(argument), "VALUE")


def _help(error: CycloptsError, argument: Argument) -> str:
    """Return the end of a sentence, and an option's help as the next one."""
    if error.app is None:
        return "."
    known = error.app.assemble_argument_collection(parse_docstring=True).get(argument.name, None)
    text = None if known is None else known.parameter.help
    return f". {' '.join(text.split())}" if text else "."


def _kind(argument: Argument) -> Any:
    """Return the type of an option's value, without None and without the tuple around several."""
    kinds = [kind for kind in get_args(argument.hint) if kind not in (NoneType, Ellipsis)] or [argument.hint]
    return str if get_origin(argument.hint) is Literal else kinds[0]


def _place(token: Token, argument: Argument | None) -> str:
    """Name an option as it was given: on the command line, or in a file."""
    if token.source not in ("", "cli"):
        return f"{(token.keyword or '').strip('[]')} in {token.source}"
    return token.keyword or (argument.name.lstrip("-").upper() if argument is not None else "an argument")
