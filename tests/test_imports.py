"""What a fresh interpreter loads: help and `import freegeo` stay light."""

import json
import statistics
import subprocess
import sys

import pytest

HEAVY = (
    "torch",
    "scipy",
    "cv2",
    "trimesh",
    "peft",
    "transformers",
    "matplotlib",
    "mcubes",
    "huggingface_hub",
    "av",
    "viser",
    "gradio",
)
HELP_BUDGET_S = 0.6
"""Twice what help may take on an idle machine, since this one may be busy; the measured time is in benchmarks/."""

REPORT = "import json, sys, time; print(json.dumps([time.process_time(), [m for m in sys.modules if '.' not in m]]))"


def fresh(code: str) -> tuple[float, set[str]]:
    """Run code in a new interpreter; returns its CPU time and the top-level modules it has loaded."""
    output = subprocess.run(
        [sys.executable, "-c", f"{code}\n{REPORT}"], capture_output=True, text=True, check=True
    ).stdout
    seconds, modules = json.loads(output.splitlines()[-1])
    return seconds, set(modules)


def call(*arguments: str) -> str:
    return f"from freegeo.cli.app import main\nassert main({list(arguments)!r}) == 0"


@pytest.mark.parametrize(
    "code",
    [
        pytest.param("import freegeo; dir(freegeo); freegeo.__version__", id="import freegeo"),
        pytest.param("import freegeo.cli.app", id="import freegeo.cli.app"),
        pytest.param("import freegeo.run_folder, freegeo.errors", id="import run folders"),
        pytest.param(
            "import freegeo.models.spec, freegeo.models.catalog, freegeo.adaptation.recipe",
            id="import specs and recipes",
        ),
        pytest.param(
            "from freegeo.models import catalog\nfor name in catalog.names(): catalog.entry(name)", id="look models up"
        ),
        pytest.param(call("--help"), id="freegeo --help"),
        pytest.param(call("--version"), id="freegeo --version"),
        pytest.param(call("run", "--help"), id="freegeo run --help"),
        pytest.param(call("demo", "--help"), id="freegeo demo --help"),
        pytest.param(call("models", "--help"), id="freegeo models --help"),
        pytest.param(call("app", "--help"), id="freegeo app --help"),
    ],
)
def test_nothing_heavy_is_loaded(code):
    _, modules = fresh(code)
    assert modules.isdisjoint(HEAVY), sorted(modules & set(HEAVY))


def test_help_is_quick():
    assert statistics.median(fresh(call("--help"))[0] for _ in range(3)) <= HELP_BUDGET_S


def test_importing_models_and_the_pipeline_leaves_heavy_packages_alone():
    _, modules = fresh("import freegeo.pipeline, freegeo.models.da3, freegeo.models.vggt, freegeo.data.photos")
    assert modules.isdisjoint(set(HEAVY) - {"torch"}), sorted(modules & set(HEAVY))


def test_import_changes_nothing_outside():
    code = """
import logging, os, warnings
before = dict(os.environ), list(warnings.filters), list(logging.getLogger().handlers)
import freegeo.pipeline, freegeo.cli.app
assert (dict(os.environ), list(logging.getLogger().handlers)) == (before[0], before[2])
assert logging.getLogger("freegeo").handlers == []
"""
    fresh(code)


def test_public_names_load_on_use():
    _, modules = fresh("import freegeo; assert callable(freegeo.load_photos)")
    assert "torch" not in modules
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        import freegeo

        freegeo.nothing  # noqa: B018
