"""What SOURCE may be, and which sources are scenes of their own."""

import pytest

from freegeo.cli import sources
from freegeo.cli.options import PhotoOptions
from freegeo.errors import UserError


@pytest.mark.slow
def test_demo_is_a_source_of_photos(monkeypatch):
    monkeypatch.setattr(sources, "DEMO_FRAMES", 3)
    found = sources.load_source(["demo"], PhotoOptions(max_views=2))
    assert [photo.name for photo in found] == ["00.png", "01.png"]
    assert found[0].read().shape == (*found[0].size_hw, 3)


def test_files_are_one_scene_and_folders_are_several(tmp_path):
    files = [tmp_path / "a.png", tmp_path / "b.png"]
    for file in files:
        file.write_bytes(b"")
    names = [str(file) for file in files]
    assert sources.split_scenes(names) == [names]
    assert sources.split_scenes([str(tmp_path), "x/*.jpg"]) == [[str(tmp_path)], ["x/*.jpg"]]
    assert sources.split_scenes(["demo"]) == [["demo"]]
    assert sources.split_scenes([*names, str(tmp_path), "walk.mp4"]) == [names, [str(tmp_path)], ["walk.mp4"]]


def test_a_pattern_that_fits_folders_stands_for_these(tmp_path):
    for name in ("b", "a", "c[1]"):
        (tmp_path / name).mkdir()
    assert sources.split_scenes([f"{tmp_path}/*"]) == [[str(tmp_path / name)] for name in ("a", "b", "c[1]")]
    assert sources.split_scenes([str(tmp_path / "c[1]")]) == [[str(tmp_path / "c[1]")]]
    (tmp_path / "d.png").write_bytes(b"")
    assert sources.split_scenes([f"{tmp_path}/*"]) == [[f"{tmp_path}/*"]]


@pytest.mark.parametrize("given", [[], [""]])
def test_no_source(given):
    for ask in (sources.split_scenes, lambda names: sources.load_source(names, PhotoOptions())):
        with pytest.raises(UserError, match="no source given"):
            ask(given)
