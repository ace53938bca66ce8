"""A hook of mkdocs: pages link to files of the repository as on a forge, and the site has pages that show these files.

`docs/reliability.md` links to `../src/freegeo/files.py`. The site gets a page with that file, and the link leads there.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
PAGES = {"CHANGELOG.md": "changelog.md", "README.md": "index.md"}
"""Pages of the repository that have a page of their own on the site."""
WIDE = ("index.md", "api.md")
"""Pages without a sidebar for navigation, which would hold nothing but their name."""
LINK = re.compile(r"(?<=\]\()([^()\s#:]+)((?:#[^()\s]*)?)(?=\))")
FENCED = re.compile(r"(^```.*?^```)", re.MULTILINE | re.DOTALL)
LIST = re.compile(r"^((?![-*|>#\s]|\d+\. )\S.*\n)(?=[-*] |1\. )", re.MULTILINE)
"""A line of text before a list: on a forge no blank line is needed between them."""
LANGUAGES = {".py": "python", ".toml": "toml", ".md": "markdown", ".json": "json", ".sh": "bash", "": "text"}
"""Endings of the files that are shown; others are only named."""


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the changelog, and a page for each file or folder of the repository that a page links to."""
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    texts = {"CHANGELOG.md": changelog}
    texts |= {f"docs/{file.src_uri}": file.content_string for file in files.documentation_pages()}
    files.append(File.generated(config, "changelog.md", content=changelog))
    linked = {target for origin, text in texts.items() for target in targets(origin, text)}
    for target in sorted(linked - set(PAGES)):
        path = ROOT / target
        if not target.startswith(("docs/", "..")) and path.exists():
            file = File.generated(config, site_path(target), content=shown(path), inclusion=InclusionLevel.NOT_IN_NAV)
            files.append(file)
    return files


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Let the links of a page lead to pages of the site."""
    here = page.file.src_uri
    if here in WIDE:
        page.meta["hide"] = ["navigation"]
    if here.startswith("source/"):
        return markdown
    origin = "CHANGELOG.md" if here == PAGES["CHANGELOG.md"] else f"docs/{here}"

    def replace(link: re.Match) -> str:
        target = resolved(origin, link[1])
        if target.startswith("docs/") and origin.startswith("docs/"):
            return link[0]
        return posixpath.relpath(site_path(target), posixpath.dirname(here) or ".") + link[2]

    parts = FENCED.split(markdown)
    return "".join(part if part.startswith("```") else LIST.sub(r"\1\n", LINK.sub(replace, part)) for part in parts)


def targets(origin: str, text: str) -> Iterator[str]:
    """Return what the links of a page lead to, as paths in the repository."""
    for part in FENCED.split(text):
        if not part.startswith("```"):
            yield from (resolved(origin, link) for link, _ in LINK.findall(part))


def resolved(origin: str, link: str) -> str:
    """Return where a relative link of a file leads, as a path in the repository."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(origin), link))


def site_path(target: str) -> str:
    """Return the source path of the page that stands for a file of the repository."""
    return target.removeprefix("docs/") if target.startswith("docs/") else PAGES.get(target, f"source/{target}.md")


def shown(path: Path) -> str:
    """Return a page that shows a file, or all files of a folder; the search leaves it out."""
    name = path.relative_to(ROOT).as_posix()
    files = sorted(child for child in path.rglob("*") if child.is_file()) if path.is_dir() else [path]
    files = [file for file in files if not re.search(r"__pycache__|egg-info", file.as_posix())]
    parts = [f"---\nsearch: {{exclude: true}}\nhide: [navigation, toc]\n---\n\n# `{name}`\n"]
    for file in files:
        if path.is_dir():
            parts.append(f"## `{file.relative_to(path).as_posix()}`\n")
        language = LANGUAGES.get(file.suffix)
        parts.append(
            f"`````{language}\n{file.read_text(encoding='utf-8')}\n`````\n"
            if language
            else "Not shown here; the file is in the repository.\n"
        )
    return "\n".join(parts)
