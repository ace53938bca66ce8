"""`freegeo adapter merge`: weights that need no adapter give the same reconstruction."""

import shutil

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.torch import load_file

from cli.conftest import QUICK
from freegeo.models.checkpoints import fingerprint


@pytest.fixture(scope="module")
def adapter(tmp_path_factory, photo_folder, tiny):
    """An adapter of the embedded model after a few steps."""
    from freegeo.cli.app import main

    folder = tmp_path_factory.mktemp("adapter") / "adapter"
    assert main(["adapt", str(photo_folder), "-o", str(folder), *tiny, *QUICK]) == 0
    return folder


def depth(folder) -> np.ndarray:
    with np.load(folder / "prediction.npz") as content:
        return content["depth_z"]


def test_merged_weights_reconstruct_as_the_adapter_does(freegeo, photo_folder, tiny, weights, adapter, tmp_path):
    merged = tmp_path / "merged.safetensors"
    outcome = freegeo("adapter", "merge", adapter, "-o", merged, "--checkpoint", weights)
    assert outcome.code == 0, outcome.err
    assert f"--model freegeo-tiny --checkpoint {merged}" in outcome.out
    assert "licence of the weights: Apache-2.0" in outcome.out
    assert "fits freegeo-tiny" in freegeo("models", "check", "freegeo-tiny", merged).out

    for name, options in (
        ("frozen", tiny),
        ("adapted", [*tiny, "--adapter", adapter]),
        ("merged", ["--model", "freegeo-tiny", "--checkpoint", merged]),
    ):
        assert freegeo("reconstruct", photo_folder, "-o", tmp_path / name, *options).code == 0
    change = np.abs(depth(tmp_path / "adapted") - depth(tmp_path / "frozen")).max()
    assert change > 1e-3
    np.testing.assert_allclose(depth(tmp_path / "merged"), depth(tmp_path / "adapted"), rtol=1e-4, atol=1e-4)


def test_the_file_has_the_names_of_the_checkpoint_and_says_where_it_comes_from(freegeo, weights, adapter, tmp_path):
    merged = tmp_path / "merged.safetensors"
    arguments = ["adapter", "merge", adapter, "-o", merged, "--checkpoint", weights, "--strength", "0"]
    assert freegeo(*arguments).code == 0
    before, after = load_file(weights), load_file(merged)
    assert {name.removeprefix("model.") for name in before} == {name.removeprefix("model.") for name in after}
    assert all(name.startswith("model.") for name in after)
    with safe_open(merged, framework="np") as file:
        assert file.metadata() == {
            "format": "pt", "model": "freegeo-tiny", "licence": "Apache-2.0", "base": fingerprint(weights),
            "adapter": fingerprint(adapter / "adapter_model.safetensors"), "strength": "0",
        }  # fmt: skip
    again = freegeo(*arguments)
    assert again.code == 2
    assert "exists already. Add --overwrite" in again.sentence()
    assert freegeo(*arguments, "--overwrite").code == 0


def test_requests_that_cannot_be_carried_out(freegeo, weights, adapter, tmp_path):
    out = tmp_path / "merged.safetensors"
    assert "not an adapter folder" in freegeo("adapter", "merge", tmp_path, "-o", out).sentence()
    assert "written as .safetensors" in freegeo("adapter", "merge", adapter, "-o", tmp_path / "merged.pt").sentence()
    plain = tmp_path / "plain"
    shutil.copytree(adapter, plain)
    (plain / "freegeo.json").unlink()
    outcome = freegeo("adapter", "merge", plain, "-o", out, "--checkpoint", weights)
    assert outcome.code == 2
    assert "Name that with --model" in outcome.sentence()
    assert not out.exists()
