"""Every mistake is one clear sentence with exit code 2, every failure one with 1, and nothing is half-written."""

import json
import pickle
import shlex
from pathlib import Path

import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file

from cli.conftest import QUICK
from freegeo.adaptation import adapt as adapting
from freegeo.cli.options import ModelOptions
from png_header import png_header


def copies(folder: Path, source: Path, count: int) -> Path:
    folder.mkdir()
    for k in range(count):
        (folder / f"{k}.png").write_bytes((source / f"{k}.png").read_bytes())
    return folder


def bad_source(kind: str, folder: Path, source: Path) -> tuple[Path | str, str]:
    """Return a source that cannot be used and the words that say why."""
    if kind == "missing":
        return folder / "nowhere", "no such folder, file or pattern"
    if kind == "pattern":
        return f"{folder}/*.jpg", "no photos found"
    if kind == "empty":
        folder.mkdir()
        return folder, "no photos found"
    if kind in ("one photo", "two photos"):
        count = 1 if kind == "one photo" else 2
        return copies(folder, source, count), f"needs at least 3 photos, got {count}"
    copies(folder, source, 4)
    if kind == "not an image":
        (folder / "1.png").write_text("no image")
        return folder, "1.png: the file is not a readable image"
    if kind == "truncated":
        (folder / "2.png").write_bytes((folder / "2.png").read_bytes()[:2000])
        return folder, "2.png: the image is damaged or truncated"
    if kind == "too large":
        (folder / "3.png").write_bytes(png_header(20_000, 20_000))
        return folder, "more than the limit of 150 megapixels"
    assert kind == "several"
    (folder / "1.png").write_text("no image")
    (folder / "2.png").write_bytes((folder / "2.png").read_bytes()[:2000])
    return folder, "2 of 4 photos cannot be used: "


@pytest.mark.parametrize("command", ["run", "adapt"])
@pytest.mark.parametrize(
    "kind",
    ["missing", "pattern", "empty", "one photo", "two photos", "not an image", "truncated", "too large", "several"],
)
def test_sources_that_cannot_be_used(freegeo, photo_folder, tiny, tmp_path, command, kind):
    source, words = bad_source(kind, tmp_path / "photos", photo_folder)
    outcome = freegeo(command, source, "-o", tmp_path / "out", *tiny, *QUICK)
    assert outcome.code == 2, outcome.err
    assert words in outcome.sentence()
    assert not (tmp_path / "out").exists()


def test_bad_photos_and_other_files_are_left_out_and_said_in_the_result(freegeo, photo_folder, tiny, tmp_path):
    folder = copies(tmp_path / "photos", photo_folder, 4)
    (folder / "2.png").write_bytes((folder / "2.png").read_bytes()[:2000])
    (folder / "notes.txt").write_text("")
    outcome = freegeo("reconstruct", folder, "-o", tmp_path / "out", *tiny, "--skip-bad")
    assert outcome.code == 0, outcome.err
    summary = json.loads((tmp_path / "out" / "reconstruction.json").read_text())
    assert summary["images"] == ["0.png", "1.png", "3.png"]
    left_out, bad = summary["warnings"][:2]
    assert left_out == f"{folder}: 1 of 5 files are no photos and are left out: notes.txt."
    assert bad.startswith(f"1 of 4 photos cannot be used and are left out: {folder}/2.png: the image is damaged")
    assert f"warning: {left_out}" in outcome.err


def test_no_source_is_not_the_working_folder(freegeo, photo_folder, tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(photo_folder)
    for command in ("run", "adapt", "reconstruct"):
        outcome = freegeo(command, "-o", tmp_path / "out", *tiny)
        assert outcome.code == 2
        assert "no source given" in outcome.sentence()
    assert not (tmp_path / "out").exists()


def test_one_scene_per_run(freegeo, photo_folder, tiny, tmp_path):
    other = copies(tmp_path / "other", photo_folder, 3)
    for command in ("run", "reconstruct"):
        for sources in ((photo_folder, other), ("a.mp4", "b.ts"), (f"{photo_folder}/*.png", other)):
            outcome = freegeo(command, *sources, "-o", tmp_path / "out", *tiny)
            assert outcome.code == 2
            assert "2 folders, patterns or videos are given" in outcome.sentence()
            suggested = f"freegeo adapt {shlex.join(map(str, sources))} -o ADAPTER"
            assert suggested in outcome.sentence()
    mixed = freegeo("run", photo_folder / "0.png", other, "-o", tmp_path / "out", *tiny)
    assert mixed.code == 2
    assert f"{other} is given together with photo files" in mixed.sentence()
    twice = freegeo("adapt", photo_folder, photo_folder, "-o", tmp_path / "out", *tiny)
    assert twice.code == 2
    assert "given twice" in twice.sentence()


def test_masks_that_cannot_be_used_are_refused_before_anything_is_written(freegeo, photo_folder, tiny, tmp_path):
    (tmp_path / "masks").mkdir()
    for k, level in enumerate((0, 0, 0, 128)):
        Image.new("L", (64, 48), level).save(tmp_path / "masks" / f"{k}.png")
    for words in ("neither black nor white", "select nothing"):
        outcome = freegeo("run", photo_folder, "-o", tmp_path / "out", *tiny, *QUICK, "--masks", tmp_path / "masks")
        assert outcome.code == 2
        assert words in outcome.sentence()
        Image.new("L", (64, 48), 0).save(tmp_path / "masks" / "3.png")
    assert not (tmp_path / "out").exists()


# -- models and checkpoints


def test_unknown_model_lists_the_known_ones(freegeo, photo_folder, tmp_path):
    outcome = freegeo("run", photo_folder, "-o", tmp_path / "out", "--model", "da4-huge")
    assert outcome.code == 2
    assert "unknown model 'da4-huge'" in outcome.sentence()
    assert "da3-base" in outcome.sentence()


def bad_checkpoint(kind: str, folder: Path, weights: Path) -> tuple[Path, tuple[str, ...]]:
    tensors = load_file(weights)
    first, second = sorted(tensors)[:2]
    file = folder / "bad.safetensors"
    if kind == "missing":
        return folder / "nowhere.safetensors", ("no such checkpoint",)
    if kind == "other names":
        tensors["surprise.weight"] = tensors.pop(second)
        save_file(tensors, file)
        return file, ("does not fit freegeo-tiny", "1 missing", "1 unexpected (first: surprise.weight)")
    if kind == "other shape":
        tensors[first] = torch.zeros(3, 3, 3)
        save_file(tensors, file)
        return file, ("1 of another shape", "(3, 3, 3)")
    if kind == "pickle":
        file.write_bytes(pickle.dumps({"weight": [1.0]}))
        return file, ("not a safetensors file, a renamed pickle or damaged",)
    if kind == "code":
        trap = folder / "trap.pt"
        torch.save({"weight": Path("x")}, trap)
        return trap, ("never runs code",)
    if kind == "truncated":
        file.write_bytes(weights.read_bytes()[:-1000])
        return file, ("truncated",)
    assert kind == "not finite"
    tensors[first] = torch.full_like(tensors[first], torch.nan)
    save_file(tensors, file)
    return file, ("not finite",)


@pytest.mark.parametrize("kind", ["missing", "other names", "other shape", "pickle", "code", "truncated", "not finite"])
def test_checkpoints_that_cannot_be_used(freegeo, photo_folder, weights, tmp_path, kind):
    file, words = bad_checkpoint(kind, tmp_path, weights)
    outcome = freegeo("run", photo_folder, "-o", tmp_path / "out", "--model", "freegeo-tiny", "--checkpoint", file)
    assert outcome.code == 2, outcome.err
    for part in words:
        assert part in outcome.sentence()
    assert not (tmp_path / "out").exists()


def test_default_model_offline_names_the_ways_out(freegeo, photo_folder, tmp_path, monkeypatch):
    import huggingface_hub

    def unreachable(url, **options):
        raise OSError("no route")

    monkeypatch.setattr(huggingface_hub, "try_to_load_from_cache", lambda *names, revision: None)
    monkeypatch.setattr(huggingface_hub, "get_hf_file_metadata", unreachable)
    outcome = freegeo("run", photo_folder, "-o", tmp_path / "out")
    assert outcome.code == 2
    assert "freegeo models download da3-base" in outcome.sentence()
    assert "--model freegeo-tiny" in outcome.sentence()
    warning, _ = outcome.err.strip().splitlines()
    assert warning.startswith("warning: 4 of 4 photos"), "the photos are far smaller than what the model reads"
    assert not (tmp_path / "out").exists()


# -- output folders and options


@pytest.mark.parametrize("command", ["run", "adapt", "reconstruct"])
@pytest.mark.parametrize("place", ["file", "file/below", "full"])
def test_output_that_cannot_be_written_to(freegeo, photo_folder, tiny, tmp_path, monkeypatch, command, place):
    """It is refused before the weights are loaded."""
    monkeypatch.setattr(ModelOptions, "load", lambda options: pytest.fail("the weights were loaded"))
    (tmp_path / "file").write_text("mine")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    options = [] if command == "reconstruct" else QUICK
    outcome = freegeo(command, photo_folder, "-o", tmp_path / place, *tiny, *options)
    assert outcome.code == 2
    assert any(words in outcome.sentence() for words in ("is a file", "cannot be written to", "did not write"))
    assert {p.name for p in tmp_path.rglob("*")} == {"file", "full", "notes.txt"}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--stepz", "3"], "Did you mean --steps?"),
        (["--steps", "many"], "--steps: 'many' is not a whole number"),
        (["--steps", "0"], "at least 1"),
        (["--views", "2"], "--views must be at least 3"),
        (["--keep", "0,x"], "Write it as 0,2,4,6"),
        (["--keep", "2,0"], "ascending positions, such as 0,2,4,6"),
        (["--keep", "1,3"], "must begin with 0"),
        (["--rank", "0"], "--rank must be positive"),
        (["--lr", "nan"], "--lr: 'nan' is not a finite number"),
        (["--hold", "inf"], "--hold: 'inf' is not a finite number"),
        (["--seed", "-1"], "--seed must be from 0 to 2^64 - 1, got -1"),
        (["--seed", str(2**64)], "--seed: '18446744073709551616' is too large a number"),
        (["--seed", "9" * 5000], "99999...' is too large a number"),
        (["--dataset", "eth3d"], "'scene' has no settings per dataset"),
        (["--recipe", "evidence", "--dataset", "eth3d"], "'evidence' has no settings per dataset"),
        (["--sets", "0"], "--sets must be positive"),
        (["--precision", "fp99"], '"fp32", "bf16", "fp16"'),
        (["--device", "toaster"], "toaster"),
        (["--recipe", "paper"], "--dataset"),
        (["--formats", "ply", "obj"], "Unknown export format 'obj'. Choose from npz, ply, glb"),
        (["--max-views", "0"], "--max-views must be at least 1"),
        (["--max-views", "2"], "needs at least 3 photos"),
        (["--reference", "best"], "best"),
    ],
)
def test_options_out_of_range(freegeo, photo_folder, tiny, tmp_path, options, words):
    outcome = freegeo("run", photo_folder, "-o", tmp_path / "out", *tiny, *options)
    assert outcome.code == 2, outcome.err
    assert words in outcome.sentence()
    assert not (tmp_path / "out").exists()


def test_command_without_its_output(freegeo, photo_folder):
    outcome = freegeo("run", photo_folder)
    assert outcome.code == 2
    assert "--output" in outcome.sentence()
    assert "Did you mean" in freegeo("rum", photo_folder).sentence()


@pytest.mark.parametrize("kind", ["missing", "no adapter", "another model"])
def test_adapters_that_cannot_be_used(freegeo, photo_folder, tiny, tmp_path, kind):
    adapter = tmp_path / "adapter"
    if kind == "no adapter":
        adapter.mkdir()
    if kind == "another model":
        assert freegeo("adapt", photo_folder, "-o", adapter, *tiny, *QUICK).code == 0
        metadata = adapter / "freegeo.json"
        metadata.write_text(metadata.read_text().replace("freegeo-tiny", "da3-base"))
    outcome = freegeo("reconstruct", photo_folder, "-o", tmp_path / "out", *tiny, "--adapter", adapter)
    assert outcome.code == 2
    expected = "made for da3-base, not for freegeo-tiny" if kind == "another model" else "not an adapter folder"
    assert expected in outcome.sentence()
    assert not (tmp_path / "out").exists()


# -- failures


def test_loss_that_is_not_finite_names_its_term_and_leaves_the_frozen_result(
    freegeo, photo_folder, tiny, tmp_path, monkeypatch
):
    plain = adapting.adaptation_loss
    adapters = []

    def poisoned(*arguments, **options):
        loss, terms = plain(*arguments, **options)
        name = next(name for name in terms if name != "total")
        return loss * torch.nan, {**terms, name: terms[name] * torch.nan}

    class Optimiser(torch.optim.AdamW):
        def step(self, *arguments, **options):
            adapters.append("stepped")

    monkeypatch.setattr(adapting, "adaptation_loss", poisoned)
    monkeypatch.setattr(torch.optim, "AdamW", Optimiser)
    out = tmp_path / "out"
    outcome = freegeo("run", photo_folder, "-o", out, *tiny, *QUICK)
    assert outcome.code == 0
    assert adapters == []
    summary = json.loads((out / "reconstruction.json").read_text())
    (warning,) = [sentence for sentence in summary["warnings"] if "diverged" in sentence]
    assert warning.startswith("Adaptation diverged: loss term ") and "is not finite at step 0" in warning
    assert warning.endswith("The result is that of the frozen model.")
    for text in (outcome.err, outcome.out, (out / "report.html").read_text()):
        assert warning in text
    assert summary["adapter"] is None
    assert (out / "prediction.npz").read_bytes() == (out / "frozen" / "prediction.npz").read_bytes()
    # The same command does not train again, other formats neither.
    poisoned_calls = len(adapters)
    assert "already finished" in freegeo("run", photo_folder, "-o", out, *tiny, *QUICK).out
    assert freegeo("run", photo_folder, "-o", out, *tiny, *QUICK, "--formats", "depth").code == 0
    assert warning in (out / "report.html").read_text()
    assert len(adapters) == poisoned_calls


def test_adapting_alone_fails_when_the_adapter_is_of_no_use(freegeo, photo_folder, tiny, tmp_path):
    out = tmp_path / "adapter"
    outcome = freegeo("adapt", photo_folder, "-o", out, *tiny, *QUICK, "--lr", 100)
    assert outcome.code == 1
    assert "--lr (now 100)" in outcome.sentence()
    assert not list((tmp_path / "out").glob("**/*.part*"))


def test_full_disk_is_a_failure_and_the_run_can_go_on(freegeo, photo_folder, tiny, tmp_path, monkeypatch):
    import numpy as np

    def full(*arguments, **options):
        raise OSError(28, "No space left on device", "prediction.npz")

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez_compressed", full)
        outcome = freegeo("reconstruct", photo_folder, "-o", tmp_path / "out", *tiny)
    assert outcome.code == 1
    assert outcome.sentence() == (
        f"freegeo: {tmp_path / 'out' / 'prediction.npz'}: No space left on device. "
        "Make room and run the same command again; it continues."
    )
    assert not (tmp_path / "out" / "prediction.npz").exists()
    assert freegeo("reconstruct", photo_folder, "-o", tmp_path / "out", *tiny).code == 0
