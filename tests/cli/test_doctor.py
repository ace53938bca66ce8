"""`freegeo doctor`: what it finds, what it calls broken, and what it advises."""

import json
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
from huggingface_hub import constants

from freegeo.cli import doctor
from freegeo.models import catalog, hub

BROKEN = {
    "viser": "raise ImportError('libX.so.1 is missing')",
    "rerun": "import os; os._exit(7)",
    "OpenEXR": "import time; time.sleep(60)",
}


@pytest.fixture
def few(monkeypatch, tmp_path):
    """Load nothing by default, and look into an empty cache."""
    for name in ("CORE", "QUICK", "SLOW"):
        monkeypatch.setattr(doctor, name, ())
    monkeypatch.setattr(doctor, "_nvidia_gpus", list)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    return tmp_path


@pytest.fixture
def fakes(few, monkeypatch):
    """Packages that do not load, in front of the real ones."""
    folder = few / "packages"
    for name, code in BROKEN.items():
        (folder / name).mkdir(parents=True)
        (folder / name / "__init__.py").write_text(code)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", str(folder))


def test_json_is_what_is_printed(few, freegeo):
    outcome = freegeo("doctor", "--json")
    assert outcome.code == 0, outcome.err
    found = json.loads(outcome.out)
    assert found["torch_build"] and found["cores"] >= 1 and found["memory_free"] > 0
    assert set(found["disk_free"]) == {str(Path.cwd()), str(few / "hub")}
    said = freegeo("doctor").out
    for words in (found["torch"], found["python"], *found["next"], *(extra["install"] for extra in found["extras"])):
        assert words in said
    assert "No published model is on this machine: `freegeo models download da3-base`" in said


def test_extras_that_do_not_load_are_broken_and_slow_ones_were_not_tried(fakes, monkeypatch, freegeo):
    monkeypatch.setattr(doctor, "QUICK", ("viser", "OpenEXR"))
    monkeypatch.setattr(doctor, "SLOW", ("rerun",))
    monkeypatch.setattr(doctor, "PATIENCE_S", 1.0)
    outcome = freegeo("doctor", "--json")
    states = {extra["name"]: extra["state"] for extra in json.loads(outcome.out)["extras"]}
    assert outcome.code == 1
    assert (states["view"], states["rerun"], states["exr"]) == ("broken", "broken", "not tried")
    assert (
        "Extra view: viser does not work (ImportError: libX.so.1 is missing). Reinstall it: pip install" in outcome.err
    )
    assert "Extra rerun: rerun does not work (it ends the process that loads it (code 7))" in outcome.err
    assert "exr" not in outcome.err


def test_missing_extras_are_named_with_their_command(few, monkeypatch, freegeo):
    monkeypatch.setattr(doctor, "_is_there", lambda module: module == "torch")
    outcome = freegeo("doctor")
    assert outcome.code == 0
    for name in doctor.EXTRAS:
        (line,) = [line for line in outcome.out.splitlines() if line.startswith(f"{name} ")]
        assert "missing" in line and f"pip install 'freegeo[{name}]'" in line
    assert "Without pycolmap, cameras are not refined after adapting" in outcome.out


@pytest.mark.parametrize("cuda", [None, "12.8"])
def test_a_gpu_that_torch_cannot_use(few, monkeypatch, freegeo, cuda):
    import torch

    monkeypatch.setattr(doctor, "_nvidia_gpus", lambda: ["NVIDIA RTX 4090"])
    monkeypatch.setattr(torch.version, "cuda", cuda)
    outcome = freegeo("doctor")
    assert outcome.code == (0 if cuda is None else 1)
    words = "is a build for the CPU only" if cuda is None else "is built for CUDA 12.8 and cannot use the GPU"
    assert words in outcome.out and "NVIDIA RTX 4090" in outcome.out
    assert "No GPU" not in outcome.out


@pytest.mark.parametrize("is_there", [True, False])
def test_without_torch_the_rest_is_still_said(few, monkeypatch, freegeo, is_there):
    def load(name):
        raise OSError("libtorch.so: no such file")

    monkeypatch.setattr(doctor, "import_module", load)
    monkeypatch.setattr(doctor, "_is_there", lambda module: is_there)
    outcome = freegeo("doctor")
    assert outcome.code == 1
    assert (
        "torch cannot be loaded (OSError: libtorch.so" if is_there else "torch is missing: pip"
    ) in outcome.sentence()
    assert "pip install 'freegeo[view]'" in outcome.out


def test_a_hub_library_that_does_not_load_is_broken(few, monkeypatch, freegeo):
    def fail():
        raise ImportError("cannot import name 'x'")

    monkeypatch.setattr(hub, "cache_folder", fail)
    outcome = freegeo("doctor")
    assert outcome.code == 1
    assert "huggingface_hub, which freegeo needs, cannot be loaded (ImportError: cannot import" in outcome.sentence()
    assert "pip install 'freegeo[view]'" in outcome.out


def test_old_and_missing_packages_are_broken(few, monkeypatch, freegeo):
    versions = {"numpy": "1.26.4", "peft": None, "pycolmap": "3.1"}
    real = doctor._version
    monkeypatch.setattr(doctor, "_version", lambda package: versions.get(package, real(package)))
    outcome = freegeo("doctor")
    assert outcome.code == 1
    assert "numpy 1.26.4 is installed, and numpy>=2 is needed: pip install 'numpy>=2'." in outcome.out
    assert "peft is missing: pip install 'peft>=" in outcome.out
    assert "Extra colmap: pycolmap does not work (pycolmap 3.1 is installed, and pycolmap>=4 is needed" in outcome.out


def test_models_of_the_cache_are_listed_whole_or_not(few, freegeo):
    item = catalog.entry("da3-base")
    folder = few / "hub" / f"models--{item.hub_id.replace('/', '--')}"
    (folder / "blobs").mkdir(parents=True)
    (folder / "blobs" / "abc.incomplete").write_bytes(b"x" * 1000)
    outcome = freegeo("doctor", "--json")
    found = json.loads(outcome.out)
    assert [(one["name"], one["bytes"], one["complete"]) for one in found["models"]] == [("da3-base", 1000, False)]
    assert "da3-base is not complete: `freegeo models download da3-base` completes it." in found["next"]
    assert outcome.code == 0


def test_settings_of_the_hub_are_shown_without_passwords(few, monkeypatch, freegeo):
    monkeypatch.setenv("HF_ENDPOINT", "https://me:secret@hub.example")
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    out = freegeo("doctor").out
    assert "HF_HUB_OFFLINE=1, HF_ENDPOINT=https://hub.example; not asked whether it can be reached" in out
    assert "secret" not in out
    assert "HF_HUB_OFFLINE is set, which forbids downloads" in out


def test_weights_that_are_missing_from_the_package_are_broken(few, monkeypatch, freegeo):
    entries = {name: catalog.entry(name) for name in ("da3-base", "freegeo-tiny")}
    entries["freegeo-tiny"] = replace(entries["freegeo-tiny"], packaged_weights=few / "gone.safetensors")
    monkeypatch.setattr(catalog, "_own_entries", lambda: entries)
    outcome = freegeo("doctor")
    assert outcome.code == 1
    assert f"{few / 'gone.safetensors'}: the weights of freegeo-tiny are missing" in outcome.sentence()


def test_every_extra_for_users_is_looked_at():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    for_users = set(extras["all"][0].removeprefix("freegeo[").removesuffix("]").split(",")) | {"rerun"}
    assert set(doctor.EXTRAS) == for_users
    assert {*doctor.QUICK, *doctor.SLOW} == {module for module, _ in doctor.EXTRAS.values()}


@pytest.mark.slow
def test_it_takes_seconds_and_no_network():
    code = "import sys, time; from freegeo.cli.app import main; main(['doctor']); print(time.process_time())"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(said.stdout.splitlines()[-1]) < 4
