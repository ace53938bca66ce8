"""The guide and its site name only what exists: commands and options, error messages, public names, pages, models."""

import ast
import importlib.util
import re
import shlex
from functools import cache
from pathlib import Path

import cyclopts
import pytest
import yaml

import freegeo
from freegeo.cli.app import build, split_global

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
BLOCK = re.compile(r"^```(?:bash|sh|)\n(.*?)^```", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`(freegeo [a-z-]+ [^`]+)`")
OPTION = re.compile(r"`(--[a-z-]+)[^`]*`")
QUOTED = re.compile(r"^\*\*`(.+?)`\*\*", re.MULTILINE)
DIRECTIVE = re.compile(r"^::: ([\w.]+)", re.MULTILINE)


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@cache
def program() -> cyclopts.App:
    return build()


def commands(page: Path) -> list[tuple[str, bool]]:
    """Return the command lines of freegeo on a page, and whether each is in a block of code and thus complete."""
    text = page.read_text(encoding="utf-8")
    blocks = "".join(BLOCK.findall(text)).replace("\\\n", " ")
    lines = [line.removeprefix("$ ") for line in blocks.splitlines()]
    inline = [" ".join(line.split()) for line in INLINE.findall(text)]
    return [(line, True) for line in lines if line.startswith("freegeo ")] + [
        (line, False) for line in inline if "..." not in line
    ]


def is_wrong(line: str, complete: bool = True) -> str | None:
    """Return why the command line of freegeo does not accept a line; nothing is run."""
    words = shlex.split(line, comments=True)[1:]
    try:
        rest, _, _ = split_global(words)
        program().parse_args(rest, exit_on_error=False, print_error=False)
    except cyclopts.MissingArgumentError as error:
        return f"{line}: {error}" if complete else None
    except cyclopts.CycloptsError as error:
        return f"{line}: {error}"
    return None


@cache
def messages() -> str:
    """Return every text in the package, one after the other; what is put into one is a tab, and between two a zero."""
    texts = []
    for path in sorted((ROOT / "src" / "freegeo").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts.append(node.value)
            elif isinstance(node, ast.JoinedStr):
                texts.append("".join(part.value if isinstance(part, ast.Constant) else "\t" for part in node.values))
    return "\0".join(texts)


def occurs(quoted: str) -> bool:
    """Say whether the package has a message with these words, in which `...` stands for what is put in."""
    return bool(re.search("[^\0]*".join(re.escape(part) for part in quoted.split("...")), messages()))


def nav_pages(part: object) -> list[str]:
    """Return the pages that a part of the navigation leads to."""
    if isinstance(part, str):
        return [part]
    return [page for child in (part.values() if isinstance(part, dict) else part) for page in nav_pages(child)]


def site() -> dict:
    """Return the settings of the site; its one Python object is left out."""
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    return yaml.safe_load(re.sub(r"!!python\S+", "", text))


def model_table():
    found = importlib.util.spec_from_file_location("model_table", ROOT / "tools" / "model_table.py")
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=name_of)
def test_commands_are_those_that_freegeo_has(page):
    assert not [wrong for line, complete in commands(page) if (wrong := is_wrong(line, complete))]


def test_wrong_commands_are_found():
    assert sum(len(commands(page)) for page in PAGES) > 60
    assert is_wrong("freegeo run photos/ -o out/") is None
    assert is_wrong("freegeo run photos/ -o out/ --step 5")
    assert is_wrong("freegeo rum photos/ -o out/")
    assert is_wrong("freegeo run photos/")


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) < 120


def test_errors_that_are_explained_exist():
    quoted = QUOTED.findall((DOCS / "troubleshooting.md").read_text(encoding="utf-8"))
    assert len(quoted) >= 20
    assert not [text for text in quoted if not occurs(text)]
    assert not occurs("no such ... message")


def test_every_public_name_is_in_the_reference_and_documented():
    listed = DIRECTIVE.findall((DOCS / "api.md").read_text(encoding="utf-8"))
    assert len(listed) == len(set(listed))
    public = {name: getattr(freegeo, name) for name in freegeo.__all__ if name != "__version__"}
    assert {f"{value.__module__}.{name}" for name, value in public.items()} <= set(listed)
    assert all(value.__doc__ for value in public.values())


def test_the_navigation_has_every_page():
    pages = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    listed = nav_pages(site()["nav"])
    assert len(listed) == len(set(listed))
    assert set(listed) == pages | {"changelog.md"}


def test_the_page_on_models_names_all_of_them_with_licence_and_size():
    made = model_table()
    rows = re.findall(r"^\| (`.*)$", (DOCS / "choosing-a-model.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert [tuple(row.split(" | ")[:3]) for row in rows] == [made.known_cells(item) for item in made.entries()]


@pytest.mark.slow
def test_the_table_of_models_is_that_of_the_planner():
    made = model_table()
    assert made.PLACE.search(made.PAGE.read_text(encoding="utf-8"))[2] == made.table()
