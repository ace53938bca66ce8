"""Files appear whole or not at all, under names and rights as promised."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from freegeo import files
from freegeo.errors import FreeGeoError, UserError
from freegeo.files import atomic_path


def names_in(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def test_file_appears_only_when_it_is_complete(tmp_path):
    file = tmp_path / "new" / "a.txt"
    with atomic_path(file) as part:
        part.write_text("whole")
        assert part.suffix == ".txt"
        assert not file.exists()
    assert file.read_text() == "whole"
    assert names_in(tmp_path) == {"new/a.txt"}


def test_failure_inside_the_block_keeps_the_old_file_and_leaves_nothing(tmp_path):
    file = tmp_path / "a.txt"
    file.write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_path(file) as part:
        part.write_text("half")
        raise KeyboardInterrupt
    assert file.read_text() == "old"
    assert names_in(tmp_path) == {"a.txt"}


def test_every_writer_reads_back_and_replaces(tmp_path):
    for value in (1.0, 2.0):
        files.write_json(tmp_path / "a.json", {"ö": value})
        files.write_npz(tmp_path / "a.npz", {"x": np.full(3, value)})
        files.write_tensors(tmp_path / "a.safetensors", {"x": torch.full((2, 3), value).T}, {"key": "text"})
    assert files.read_json(tmp_path / "a.json") == {"ö": 2.0}
    assert (np.load(tmp_path / "a.npz")["x"] == 2).all()
    from safetensors import safe_open

    with safe_open(tmp_path / "a.safetensors", framework="pt") as file:
        assert file.metadata() == {"key": "text"}
        assert torch.equal(file.get_tensor("x"), torch.full((3, 2), 2.0))
    assert names_in(tmp_path) == {"a.json", "a.npz", "a.safetensors"}


def test_files_are_readable_by_others_as_the_umask_says(tmp_path):
    before = os.umask(0o022)
    try:
        files.write_tensors(tmp_path / "a.safetensors", {"x": torch.zeros(1)})
    finally:
        os.umask(before)
    assert (tmp_path / "a.safetensors").stat().st_mode & 0o777 == 0o644


def test_damaged_json_names_the_file(tmp_path):
    (tmp_path / "a.json").write_text('{"half": ')
    with pytest.raises(FreeGeoError, match=r"a\.json: damaged file"):
        files.read_json(tmp_path / "a.json")


def test_folder_that_cannot_be_written_to_is_one_sentence(tmp_path, monkeypatch):
    def refuse(*args, **options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(UserError, match="cannot be written to"), atomic_path(tmp_path / "x" / "a.txt") as part:
        part.write_text("never")


def test_a_full_disk_names_the_file_that_was_asked_for(tmp_path):
    path = tmp_path / "result.json"
    with pytest.raises(OSError, match="No space left") as caught, atomic_path(path) as part:
        part.write_text("half")
        raise OSError(28, "No space left on device")
    assert caught.value.filename == str(path)
    assert list(tmp_path.iterdir()) == []
