"""The extras: users get what freegeo can do, without the tools of its developers."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
TOOLS = {"pytest", "pytest-xdist", "hypothesis", "playwright", "ruff", "ty"}


def packages(extra: str) -> set[str]:
    """Return the names of the packages that an extra installs, also through other extras."""
    found = set()
    for requirement in EXTRAS[extra]:
        name, _, inner = re.fullmatch(r"([\w-]+)(\[([\w,]+)\])?.*", requirement).groups()
        found |= set().union(*(packages(part) for part in inner.split(","))) if name == "freegeo" else {name}
    return found


def test_users_get_everything_but_the_tools():
    assert packages("all") == {"viser", "pycolmap", "pillow-heif", "ray"}
    assert packages("all") & TOOLS == set()


def test_developers_get_everything():
    assert packages("dev") == packages("all") | TOOLS
    assert "-e '.[dev]'" in (ROOT / "Makefile").read_text()


@pytest.mark.parametrize("place", ["README.md", "docs", "src"])
def test_extras_that_are_named_exist(place):
    path = ROOT / place
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.suffix in (".md", ".py")]
    named = {name for file in files for name in re.findall(r"(?:freegeo|\.)\[(\w+)\]", file.read_text("utf-8"))}
    assert named <= EXTRAS.keys(), named
