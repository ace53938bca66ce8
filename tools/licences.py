"""The licences of everything in constraints.txt, by the metadata of what is installed: the tables of docs/licences.md.

`make licences` writes the tables, `make audit` (`--check`) only compares. Both fail with a sentence for each package
whose licence is neither allowed nor named here, and for each copyleft library in a package that is not named here.
"""

import re
import sys
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "licences.md"
MARK = "<!-- From here on written by `make licences`. -->\n"

# "BSD" stands for metadata that do not say how many clauses.
ALLOWED = {
    "0BSD", "Apache-2.0", "Apache-2.0 WITH LLVM-exception", "BSD", "BSD-2-Clause", "BSD-3-Clause", "BSL-1.0", "CC0-1.0",
    "CNRI-Python", "ISC", "MIT", "MIT-CMU", "PSF-2.0", "Zlib",
}  # fmt: skip
NAMED = {
    "certifi": "MPL-2.0: changed files of it must stay open; a list of certificates",
    "hypothesis": "MPL-2.0: changed files of it must stay open; for tests only",
    "openexr": "BSD-3-Clause, which only its text of the licence says and not its metadata",
    "orjson": "MPL-2.0 in part: changed files of it must stay open; JSON for the web app",
    "pathspec": "MPL-2.0: changed files of it must stay open; for the documentation site only",
    "tqdm": "MPL-2.0 in part: changed files of it must stay open; progress bars of the hub's client",
}
"""Packages with another licence than the allowed ones, and what it asks for."""
SPELLINGS = {
    "Apache-2.0": ("Apache", "Apache 2.0", "Apache 2.0 License", "Apache Software License"),
    "BSD": ("BSD License",),
    "BSD-3-Clause": ("BSD 3-clause", "3-Clause BSD License"),
    "ISC": ("ISC License", "ISC License (ISCL)"),
    "MIT": ("MIT License",),
    "MPL-2.0": ("Mozilla Public License 2.0 (MPL 2.0)",),
    "PSF-2.0": ("Python Software Foundation License",),
}
"""SPDX name -> what older metadata call it."""

COPYLEFT = {
    "x264": "GPL-2.0-or-later",
    "x265": "GPL-2.0-or-later",
    "avcodec": "LGPL-2.1-or-later; GPL where built with x264 or x265",
    "mp3lame": "LGPL-2.0-or-later",
    "gnutls": "LGPL-2.1-or-later",
    "gmp": "LGPL-3.0-or-later or GPL-2.0-or-later",
    "nettle": "LGPL-3.0-or-later or GPL-2.0-or-later",
    "unistring": "LGPL-3.0-or-later or GPL-2.0-or-later",
    "asound": "LGPL-2.1-or-later",
    "heif": "LGPL-3.0-or-later",
    "de265": "LGPL-3.0-or-later",
    "quadmath": "LGPL-2.1-or-later",
    "gfortran": "GPL-3.0-or-later with the GCC runtime exception",
    "gomp": "GPL-3.0-or-later with the GCC runtime exception",
    "readline": "GPL-3.0-or-later",
    "fftw3": "GPL-2.0-or-later",
    "cholmod": "LGPL-2.1-or-later, parts GPL-2.0-or-later",
    "Qt5Core": "LGPL-3.0",
    "Qt6Core": "LGPL-3.0",
}
"""Copyleft libraries, by the name of their file after `lib`, and their licences."""
BUNDLED = {
    "av": ("x264", "x265", "avcodec", "mp3lame", "gnutls", "gmp", "nettle", "unistring", "asound"),
    "pillow-heif": ("x265", "heif", "de265"),
    "opencv-python-headless": ("avcodec", "gfortran", "quadmath"),
    "numpy": ("gfortran", "quadmath"),
    "scipy": ("gfortran", "quadmath"),
    "pycolmap": ("gfortran", "quadmath", "gomp"),
    "torch": ("gomp",),
}
"""Packages whose wheels bring copyleft libraries along, which is known and explained on the page."""
ELSEWHERE = {"audioop-lts": "PSF-2.0"}
"""Licences of packages that are pinned for other versions of Python than the oldest one."""


def licence(package: metadata.PackageMetadata) -> str:
    """Return the SPDX expression of a package, or what its metadata say, in one line."""
    if expression := package.get("License-Expression"):
        return expression
    classifiers = [line for line in package.get_all("Classifier", []) if line.startswith("License ::")]
    stated = [package.get("License") or "", *(line.rpartition(" :: ")[2] for line in classifiers)]
    for words in stated:
        for name, spellings in SPELLINGS.items():
            if words in (name, *spellings):
                return name
    lines = [line.strip() for words in stated for line in words.splitlines() if line.strip()]
    return lines[0][:60] if lines else "unknown"


def is_allowed(expression: str) -> bool:
    """Whether one of the alternatives of each part of an SPDX expression is allowed."""
    parts = expression.replace("(", "").replace(")", "").split(" AND ")
    return all(any(name in ALLOWED for name in part.split(" OR ")) for part in parts)


def copyleft_libraries(files: Iterable[str]) -> set[str]:
    """Return the known copyleft libraries among the files of a package."""
    names = [Path(name).name for name in files if re.search(r"\.(so|dylib|dll)\b", name)]
    return {lib for lib in COPYLEFT if any(re.match(rf"(lib)?{lib}(?![A-Za-z])", name) for name in names)}


def faults(name: str, expression: str, libraries: Iterable[str]) -> list[str]:
    """Say what is neither allowed nor named of a package."""
    found = []
    if not is_allowed(expression) and name.lower() not in NAMED:
        found.append(f"{name}: its licence '{expression}' is neither allowed nor named in tools/licences.py.")
    unknown = sorted(set(libraries) - set(BUNDLED.get(name.lower().replace("_", "-"), ())))
    return found + [f"{name}: holds {lib} ({COPYLEFT[lib]}), which tools/licences.py does not name." for lib in unknown]


def tables(licences: dict[str, tuple[str, str]]) -> str:
    """Return the generated part of the page.

    Args:
        licences: name of a package -> its version and licence.
    """
    libraries = [f"| {name} | {lib} | {COPYLEFT[lib]} |" for name in sorted(BUNDLED) for lib in BUNDLED[name]]
    named = [f"| {name} | {why} |" for name, why in NAMED.items()]
    rows = [f"| {name} | {version} | {text} |" for name, (version, text) in licences.items()]
    return "\n".join((
        "\n## Copyleft libraries inside packages\n", "| package | library | licence |", "|---|---|---|", *libraries,
        "\n## Packages with other licences than those of the list\n", "| package | licence |", "|---|---|", *named,
        "\n## All packages\n", "| package | version | licence |", "|---|---|---|", *rows, "",
    ))  # fmt: skip


def main(arguments: list[str]) -> int:
    """Write or compare the page; return the exit code."""
    licences, wrong = {}, []
    for line in (ROOT / "constraints.txt").read_text("utf-8").splitlines():
        pin = Requirement(line)
        name, version = pin.name, str(pin.specifier).removeprefix("==")
        if pin.marker is not None and not pin.marker.evaluate():
            licences[name] = version, ELSEWHERE.get(name, "unknown")
            wrong += faults(name, licences[name][1], ())
            continue
        try:
            package = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            wrong.append(f"{name}: is not installed, so that its licence is not known. Run `make .venv/ready`.")
            continue
        licences[name] = version, licence(package.metadata)
        wrong += faults(name, licences[name][1], copyleft_libraries(map(str, package.files or ())))
    prose, mark, written = PAGE.read_text("utf-8").partition(MARK)
    if "--check" not in arguments:
        PAGE.write_text(prose + MARK + tables(licences), "utf-8")
    elif not mark or written != tables(licences):
        wrong.append("docs/licences.md is not what is installed. Run `make licences`.")
    for line in wrong:
        print(line, file=sys.stderr)
    return int(bool(wrong))


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
