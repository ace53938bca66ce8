"""The documentation names only what exists: pages, headings, links, files, functions, experiments."""

import ast
import json
import re
from pathlib import Path

import pytest

from freegeo.benchmark.paper.experiments import EXPERIMENTS

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "freegeo"
TEXT = {".py", ".md", ".toml", ".js", ".css", ".j2"}
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
THIS = Path(__file__)
"""The one file that spells out what must not be cited."""
CODE = [
    path
    for part in ("src", "tests", "benchmarks", "examples")
    for path in sorted((ROOT / part).rglob("*.py"))
    if path != THIS
]
MAPS = [ROOT / "docs" / "paper.md", ROOT / "docs" / "method.md"]

FENCED = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
HEADING = re.compile(r"^#+ +(.+?) *$", re.MULTILINE)
CITATION = re.compile(r'\bdocs/([\w/.-]+\.md)((?:,? (?:and )?"[^"]+")*)')
LINK = re.compile(r"\]\(([^()\s]+)\)")
CODE_NAME = re.compile(r"`([\w/.-]+\.py)(?::([\w.]+))?`")
COMMAND = re.compile(r"`freegeo bench run ([a-z-]+)")
OUTSIDE = re.compile(
    r"fact[ _-]?sheet|\bspecs/|\bspecs? of\b|\b(?:specs?|sheet|specification|protocol)\b[^.]{0,60}\bsections? \d"
    r"|(?<!paper, )\bsections? \d",
    re.IGNORECASE,
)
"""Sources that a reader of the repository does not have: notes, and numbered sections of them."""


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def prose(path: Path) -> str:
    """Return a page without its blocks of code, or a program with every wrapped sentence on one line."""
    text = path.read_text(encoding="utf-8")
    return FENCED.sub("", text) if path.suffix == ".md" else re.sub(r"\s*\n[ \t]*(?:#:? ?)?", " ", text)


def headings(page: Path) -> list[str]:
    return HEADING.findall(prose(page))


def anchors(page: Path) -> set[str]:
    """Return the anchors that a page's headings get on the forge where the repository is read."""
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings(page)}


def wrong_citations(text: str) -> list[str]:
    """Return the citations of pages, or of headings of pages, that do not exist."""
    wrong = []
    for page, cited in CITATION.findall(text):
        path = ROOT / "docs" / page
        if not path.is_file():
            wrong.append(page)
        else:
            wrong += [f'{page}, "{name}"' for name in re.findall(r'"([^"]+)"', cited) if name not in headings(path)]
    return wrong


def wrong_links(page: Path) -> list[str]:
    """Return the relative links of a page that lead to no file or no heading."""
    wrong = []
    for link in LINK.findall(prose(page)):
        target, _, anchor = link.partition("#")
        path = page.parent / target if target else page
        if "://" in link or link.startswith("mailto:"):
            continue
        if not path.exists() or (anchor and anchor not in anchors(path)):
            wrong.append(link)
    return wrong


def defined(path: Path) -> set[str]:
    """Return what a module defines, members of its classes as `Class.member`."""
    names = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        names |= set(own := names_of(node))
        if isinstance(node, ast.ClassDef):
            names |= {f"{own[0]}.{member}" for child in node.body for member in names_of(child)}
    return names


def names_of(node: ast.stmt) -> list[str]:
    """Return the names that a statement binds."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return [node.name]
    targets = [node.target] if isinstance(node, ast.AnnAssign) else node.targets if isinstance(node, ast.Assign) else []
    return [target.id for target in targets if isinstance(target, ast.Name)]


@pytest.mark.parametrize("path", CODE, ids=name_of)
def test_citations_name_pages_and_headings_that_exist(path):
    assert not wrong_citations(prose(path))


def test_citations_are_found():
    cited = [citation for path in CODE for citation in CITATION.findall(prose(path))]
    assert len(cited) >= 10
    assert sum(1 for _, names in cited if names) >= 5


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page):
    assert not wrong_links(page)


def test_links_are_found():
    assert sum(len(LINK.findall(prose(page))) for page in PAGES) >= 30


@pytest.mark.parametrize("part", ["src", "tests", "benchmarks", "examples", "docs"])
def test_sources_are_within_reach_of_the_reader(part):
    files = [path for path in sorted((ROOT / part).rglob("*")) if path.suffix in TEXT and path != THIS]
    assert files
    wrong = {name_of(path): found.group() for path in files if (found := OUTSIDE.search(prose(path)))}
    assert not wrong, "\n".join(f"{path}: {text}" for path, text in wrong.items())


@pytest.mark.parametrize("page", MAPS, ids=name_of)
def test_code_named_on_the_maps_exists(page):
    wrong = []
    for file, name in CODE_NAME.findall(page.read_text(encoding="utf-8")):
        path = PACKAGE / file
        if not path.is_file() or (name and name not in defined(path)):
            wrong.append(f"{file}:{name}")
    assert not wrong, "\n".join(wrong)


def test_every_published_table_has_its_command():
    text = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    assert len(CODE_NAME.findall(text)) >= 40
    tables = json.loads((PACKAGE / "benchmark" / "paper" / "paper_tables.json").read_text(encoding="utf-8"))
    rows = {key: line for line in text.splitlines() for key in tables if f"`{key}`" in line}
    assert rows.keys() == tables.keys()
    commands = {key: COMMAND.findall(line) for key, line in rows.items()}
    assert {key: EXPERIMENTS[names[0]].paper for key, names in commands.items()} == {key: key for key in tables}
    assert set(COMMAND.findall(text)) <= set(EXPERIMENTS)


def test_the_checks_find_what_is_wrong(tmp_path):
    cited = 'docs/method.md, "Anchors", and docs/method.md, "Token draws" and "Anchor"; docs/none.md'
    assert wrong_citations(cited) == ['method.md, "Anchor"', "none.md"]
    page = tmp_path / "page.md"
    page.write_text(
        "# One thing: `a`\n[a](#one-thing-a) [b](#two) [c](none.md) [d](https://x.org)\n```\n[e](no)\n```\n"
    )
    assert wrong_links(page) == ["#two", "none.md"]
    program = tmp_path / "program.py"
    program.write_text(
        'A: int = 1\nclass B:\n    c = 2\n    def d(self):\n        """docs/method.md,\n        "E"."""\n'
    )
    assert defined(program) == {"A", "B", "B.c", "B.d"}
    assert wrong_citations(prose(program)) == ['method.md, "E"']
    for text in ("the fact-sheets", "Source: benchmark protocol, section 4", "see section 7.2", "specs/a.md"):
        assert OUTSIDE.search(text)
    for text in ("the model's spec is read", "Umeyama 1991, equation 34", "the paper, section 3", "a special section"):
        assert not OUTSIDE.search(text)
