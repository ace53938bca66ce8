"""The extras: users get what freegeo can do, without the tools of its developers."""

import email
import importlib.util
import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
TOOLS = {"pytest", "pytest-xdist", "hypothesis", "playwright", "ruff", "ty"}
TOOLS |= {"nbclient", "ipykernel", "mkdocs-material", "mkdocstrings-python"}


def packages(extra: str) -> set[str]:
    """Return the names of the packages that an extra installs, also through other extras."""
    found = set()
    for requirement in EXTRAS[extra]:
        name, _, inner = re.fullmatch(r"([\w-]+)(\[([\w,]+)\])?.*", requirement).groups()
        found |= set().union(*(packages(part) for part in inner.split(","))) if name == "freegeo" else {name}
    return found


def test_users_get_everything_but_the_tools():
    assert packages("all") == {"viser", "pycolmap", "pillow-heif", "ray", "gradio", "OpenEXR"}
    assert packages("all") & TOOLS == set()


def test_developers_get_everything():
    assert packages("dev") == packages("all") | packages("rerun") | TOOLS


def pins(file: str) -> dict[str, str]:
    """Return the versions that a file pins, by the names of the packages."""
    found = re.findall(r"^([\w.-]+)==([\w.]+)", (ROOT / file).read_text("utf-8"), re.MULTILINE)
    assert found
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in found}


def test_all_that_is_pinned_has_hashes_but_torch():
    versions, locked = pins("constraints.txt"), pins("requirements.lock")
    assert versions.pop("torch")
    assert locked == versions, "run `make lock`"
    for entry in re.split(r"\n(?=\w)", (ROOT / "requirements.lock").read_text("utf-8").partition("make lock\n")[2]):
        assert re.search(r"--hash=sha256:[0-9a-f]{64}", entry), entry


def test_what_freegeo_asks_for_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = {re.match(r"[\w-]+", line)[0] for line in project["dependencies"]} | packages("dev")
    assert {name.replace("_", "-").lower() for name in asked} <= pins("constraints.txt").keys()


def test_what_the_pinned_packages_need_is_pinned_for_each_python():
    """As `pip check` finds there, of the packages that are installed here; the libraries of torch differ by build."""
    pins = [Requirement(line) for line in (ROOT / "constraints.txt").read_text("utf-8").splitlines()]
    names = {canonicalize_name(pin.name) for pin in pins if pin.name != "torch"}
    needs = {
        name: [Requirement(need) for need in package.requires or ()]
        for package in metadata.distributions()
        if (name := canonicalize_name(package.metadata["Name"])) in names
    }
    assert needs
    for python in ("3.11", "3.12", "3.13", "3.14"):
        environment = {"python_version": python, "python_full_version": f"{python}.0"}
        there = {canonicalize_name(pin.name) for pin in pins if applies(pin, environment)}
        for name, asked in needs.items():
            missing = {canonicalize_name(need.name) for need in asked if applies(need, environment)} - there
            assert not missing, (python, name)


def applies(requirement: Requirement, environment: dict[str, str]) -> bool:
    """Whether a package is needed in an environment, without extras."""
    return requirement.marker is None or requirement.marker.evaluate({**environment, "extra": ""})


def test_no_file_names_a_package_index():
    for file in ("constraints.txt", "requirements.lock", "Makefile"):
        assert not re.search(r"https?://|file:|index-url|find-links", (ROOT / file).read_text("utf-8")), file


# -- licences


@pytest.fixture(scope="module")
def licences():
    """The script that writes the tables of docs/licences.md."""
    spec = importlib.util.spec_from_file_location("licences", ROOT / "tools" / "licences.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("expression", "allowed"),
    [
        ("MIT", True), ("Apache-2.0 OR GPL-3.0-only", True), ("MIT AND (BSD-3-Clause OR GPL-2.0-only)", True),
        ("MIT AND GPL-3.0-only", False), ("GPL-3.0-or-later", False),
        ("MPL-2.0", False), ("unknown", False), ("", False),
    ],
)  # fmt: skip
def test_licences_that_are_not_on_the_list_are_named(licences, expression, allowed):
    assert licences.is_allowed(expression) == allowed
    assert (licences.faults("x", expression, ()) == []) == allowed
    assert licences.faults("tqdm", expression, ()) == []  # it is named


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        (["License-Expression: MIT", "License: GPL"], "MIT"),
        (["License: Apache 2.0"], "Apache-2.0"),
        (["License: Copyright of somebody", "Classifier: License :: OSI Approved :: BSD License"], "BSD"),
        (["Classifier: License :: OSI Approved :: GNU General Public License v3 (GPLv3)"],
         "GNU General Public License v3 (GPLv3)"),
        (["Classifier: Topic :: Multimedia"], "unknown"),
    ],
)  # fmt: skip
def test_licences_are_read_from_new_and_old_metadata(licences, lines, expected):
    assert licences.licence(email.message_from_string("\n".join(lines))) == expected


def test_copyleft_libraries_are_told_by_their_files(licences):
    files = [
        "av.libs/libx264-d6533a8d.so.165", "av/.dylibs/libx265.216.dylib", "x/avcodec-62.dll", "x/libheifer.so",
        "x/x264.py", "heif.so.txt/readme", "libgmp.so",
    ]  # fmt: skip
    assert licences.copyleft_libraries(files) == {"x264", "x265", "avcodec", "gmp"}
    assert licences.faults("av", "MIT", ["x264"]) == []
    assert licences.faults("pillow_heif", "MIT", ["x265"]) == []
    (fault,) = licences.faults("numpy", "MIT", ["x264"])
    assert fault.startswith("numpy: holds x264 (GPL-2.0-or-later)")


@pytest.mark.parametrize("place", ["README.md", "docs", "src"])
def test_extras_that_are_named_exist(place):
    path = ROOT / place
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.suffix in (".md", ".py")]
    named = {name for file in files for name in re.findall(r"(?:freegeo|\.)\[(\w+)\]", file.read_text("utf-8"))}
    assert named <= EXTRAS.keys(), named
