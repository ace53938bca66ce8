"""The examples run as they stand, offline, on generated photos with the embedded model."""

import ast
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from PIL import Image

EXAMPLES = Path(__file__).parents[1] / "examples"
SCRIPTS = sorted(path.name for path in EXAMPLES.glob("*.py"))
NOTEBOOK = EXAMPLES / "quickstart.ipynb"
BUDGET_S = 120


def run(script: str, folder: Path, *arguments: str) -> str:
    """Run a script in a folder; returns what it printed."""
    command = [sys.executable, str(EXAMPLES / script), *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize("name", SCRIPTS)
def test_every_script_says_what_it_shows(name):
    text = (EXAMPLES / name).read_text(encoding="utf-8")
    assert 4 <= len(ast.get_docstring(ast.parse(text)).splitlines()) <= 7
    assert f"]({name})" in (EXAMPLES / "README.md").read_text(encoding="utf-8")


def test_the_notebook_holds_no_outputs():
    content = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    code = [cell for cell in content["cells"] if cell["cell_type"] == "code"]
    assert len(code) >= 8
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in code)


@pytest.mark.slow
def test_splats_get_a_folder_that_colmap_reads(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    said = run("photos_to_colmap_gsplat.py", tmp_path)
    folder = tmp_path / "out" / "gsplat"
    assert f"--data_dir {folder} --data_factor 1" in said
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    assert len(model.images) == 8
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        assert camera.model.name == "PINHOLE"
        assert Image.open(folder / "images" / image.name).size == (camera.width, camera.height)
    assert model.num_points3D() > 100


@pytest.mark.slow
def test_a_term_of_one_s_own_takes_part(tmp_path):
    said = run("own_loss_term.py", tmp_path, "--steps", "3")
    assert "step 0: total" in said and "step 2: total" in said
    about = json.loads((tmp_path / "out" / "own-loss" / "freegeo.json").read_text())
    assert about["own_loss"] == "edges_of_features"
    assert all(terms["own"] > 0 for terms in about["loss_curve"])


@pytest.mark.slow
def test_a_data_set_of_one_s_own_is_scored(tmp_path):
    said = run("own_dataset.py", tmp_path)
    assert "captures: 1 of 1 scenes complete" in said or "captures: 1 of ? scenes complete" in said
    assert "4 views, adapted" in said and "captures F1" in said


@pytest.mark.slow
def test_the_notebook_runs(tmp_path, monkeypatch):
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    started = time.monotonic()
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=BUDGET_S, kernel_name="python3", resources=resources).execute()
    assert time.monotonic() - started < BUDGET_S
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == 5, "photos, loss, depth twice, points"
    said = "".join(output.get("text", "") for output in outputs)
    assert "adapting" in said and "the matches between the photos" in said
    for name in ("prediction.npz", "points.ply", "scene.glb", "transforms.json", "adapter/freegeo.json"):
        assert (tmp_path / "out" / "quickstart" / name).is_file()
