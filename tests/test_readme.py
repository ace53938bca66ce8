"""The Python program in the README runs as it stands there."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from freegeo.adaptation import recipe
from freegeo.data.procedural import photograph_room

ROOT = Path(__file__).parents[1]
PROGRAM = re.compile(r"<!-- tested: tests/test_readme\.py -->\s*```python\n(.*?)```", re.DOTALL)


def program() -> str:
    (found,) = PROGRAM.findall((ROOT / "README.md").read_text(encoding="utf-8"))
    return found


def test_program_has_ten_lines():
    lines = [line for line in program().splitlines() if line.strip()]
    assert len(lines) <= 10


def test_program_runs(tmp_path, monkeypatch, capsys):
    from PIL import Image

    folder = tmp_path / "photos"
    folder.mkdir()
    for photo in photograph_room(20_000_001, "test-id", frames=4).photos:
        Image.fromarray(photo.read()).resize((64, 48)).save(folder / photo.name)
    plain = recipe.scene
    monkeypatch.setattr(recipe, "scene", lambda spec: replace(plain(spec), steps=2, sets_per_scene=2, distinct_seeds=2))
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(program(), "README.md", "exec"), names)
    assert "(4, 48, 64) (4, 4, 4)" in capsys.readouterr().out
    assert len(names["result"].curve) == 2
    with np.load(tmp_path / "prediction.npz") as content:
        assert content["depth_z"].shape == (4, 48, 64)
    assert not np.array_equal(names["before"].depth_z, names["after"].depth_z)


@pytest.mark.parametrize("link", sorted(set(re.findall(r"\]\(([^)#:]+)\)", (ROOT / "README.md").read_text()))))
def test_links_lead_somewhere(link):
    assert (ROOT / link).exists()
