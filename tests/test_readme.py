"""The Python programs in the README and in docs/python.md run as they stand there."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from freegeo.adaptation import recipe
from freegeo.data.procedural import photograph_room

ROOT = Path(__file__).parents[1]
PROGRAM = re.compile(r"<!-- tested: tests/test_readme\.py -->\s*```python\n(.*?)```", re.DOTALL)


def programs(page: str) -> list[str]:
    return PROGRAM.findall((ROOT / page).read_text(encoding="utf-8"))


@pytest.fixture
def photo_folder(tmp_path, monkeypatch):
    """The working folder, with `photos/` in it; the recipe is short."""
    from PIL import Image

    (tmp_path / "photos").mkdir()
    for photo in photograph_room(20_000_001, "test-id", frames=4).photos:
        Image.fromarray(photo.read()).resize((64, 48)).save(tmp_path / "photos" / photo.name)
    plain = recipe.scene
    short = {"steps": 2, "sets_per_scene": 2, "distinct_seeds": 2}
    monkeypatch.setitem(recipe.OWN, "scene", lambda spec: replace(plain(spec), **short))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_program_of_the_readme_runs(photo_folder, capsys):
    (program,) = programs("README.md")
    names: dict = {}
    exec(compile(program, "README.md", "exec"), names)
    shown = capsys.readouterr()
    assert "Reconstruction(4 views, 96 x 72 pixels, cameras) Adapted(scene recipe, 2 steps, loss " in shown.out
    assert "(4, 72, 96) (4, 4, 4)" in shown.out
    assert "adapting: 2/2" in shown.err
    with np.load(photo_folder / "out" / "prediction.npz") as content:
        assert content["depth_z"].shape == (4, 72, 96)
    assert {path.name for path in (photo_folder / "out").iterdir() if not path.name.startswith(".")} == {
        "prediction.npz", "points.ply", "scene.glb",
    }  # fmt: skip
    # Photos of 64 x 48 pixels have too few matches to judge an adaptation by.
    assert names["result"].verdict["outcome"] == "unknown"
    assert np.array_equal(names["before"].depth_z, names["after"].depth_z)
    assert (photo_folder / "adapter" / "freegeo.json").is_file()


def test_program_has_ten_lines():
    lines = [line for line in programs("README.md")[0].splitlines() if line.strip()]
    assert len(lines) <= 10


@pytest.mark.slow
def test_programs_of_the_python_page_run(photo_folder, capsys):
    parts = programs("docs/python.md")
    assert len(parts) == (ROOT / "docs" / "python.md").read_text().count("```python")
    names: dict = {}
    for part in parts:
        exec(compile(part, "docs/python.md", "exec"), names)
    shown = capsys.readouterr().out
    for line in re.findall(r"# (\w+\(.*\))$", "\n".join(parts), re.MULTILINE):
        assert re.search(re.escape(line).replace(re.escape("..."), ".+"), shown), line
    assert "['image-000', 'image-001', 'image-002', 'image-003']" in shown
    assert np.array_equal(names["frozen"].depth_z, names["frozen_again"].depth_z)
    assert np.array_equal(names["adapted"].depth_z, names["once"].depth_z)
    assert not np.array_equal(names["adapted"].depth_z, names["between"].depth_z)
    assert len(names["result"].curve) == 20
    assert np.array_equal(names["opened"].depth_z, names["adapted"].depth_z)
    assert all(path.is_file() for path in names["exported"].files)
    assert names["exported"].failed == {}


def test_program_of_the_page_on_scale_runs(photo_folder, capsys):
    (program,) = programs("docs/scale.md")
    names: dict = {}
    exec(compile(program, "docs/scale.md", "exec"), names)
    assert re.search(r"Scale\(value=.+, source='a measured distance', spread=None\)", capsys.readouterr().out)
    assert np.ptp(names["shared"].K[:, 0, 0]) == 0


@pytest.mark.parametrize("link", sorted(set(re.findall(r"\]\(([^)#:]+)\)", (ROOT / "README.md").read_text()))))
def test_links_lead_somewhere(link):
    assert (ROOT / link).exists()
