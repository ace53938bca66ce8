"""Files that lie about their size, are of the wrong kind, or cannot be written: one sentence each."""

import errno
import os
import pickle
import subprocess
import sys
import zipfile
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from freegeo import files, host
from freegeo.cameras.plain import read as read_cameras
from freegeo.cli.app import checked_config, main, out_of_memory
from freegeo.cli.demo import read_scores
from freegeo.data.image_files import UnreadableImageError
from freegeo.errors import DamagedError, FreeGeoError, UserError
from freegeo.metrics.scene import PRINTED
from freegeo.models import catalog
from freegeo.training.curve import read_log

FULL = Path("/dev/full")


def npz(path, members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return path


def npy(array) -> bytes:
    out = BytesIO()
    np.lib.format.write_array(out, array)
    return out.getvalue()


def header(shape, dtype="<f4") -> bytes:
    out = BytesIO()
    np.lib.format.write_array_header_1_0(out, {"descr": dtype, "fortran_order": False, "shape": shape})
    return out.getvalue()


@pytest.mark.parametrize("shape", [(1 << 33,), (1 << 40, 1 << 40), (-1,)], ids=str)
def test_an_array_larger_than_its_file_is_not_allocated(tmp_path, shape):
    with pytest.raises(DamagedError, match="does not have the size that its header says"):
        files.read_npz(npz(tmp_path / "a.npz", {"x": header(shape)}))


def test_a_file_that_unpacks_to_more_than_the_free_memory_is_refused_by_its_headers(tmp_path, monkeypatch):
    path = npz(tmp_path / "a.npz", {"x": npy(np.zeros((1000, 1000), np.float32)), "y": npy(np.ones(3))})
    assert path.stat().st_size < 20_000
    monkeypatch.setattr(files, "host_available", lambda: 3_900_000)
    with pytest.raises(FreeGeoError, match=r"a\.npz: unpacks to 4\.0 MB, and 3\.9 MB of memory are free"):
        files.read_npz(path)
    assert files.read_npz(path, {"y": ("f", (-1,))})["y"].tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    ("array", "reason"),
    [
        (np.zeros((2, 3), np.int64), "x is int64 of"), (np.zeros(3, np.float32), r"x is float32 of the shape \(3,\)"),
        (np.zeros((2, 4), np.float32), r"x is float32 of the shape \(2, 4\)"), (np.array([["a"]]), "x is <U1 of"),
    ],
    ids=["integers", "one axis", "four columns", "text"],
)  # fmt: skip
def test_arrays_of_another_kind_are_refused(tmp_path, array, reason):
    with pytest.raises(DamagedError, match=reason):
        files.read_npz(npz(tmp_path / "a.npz", {"x": npy(array)}), {"x": ("f", (-1, 3))})


def test_json_is_checked_and_keeps_fields_that_nobody_named(tmp_path):
    path = tmp_path / "a.json"
    path.write_text('{"a": [1, 2], "more": {"b": null}}')
    assert files.read_json(path, dict[str, object]) == {"a": [1, 2], "more": {"b": None}}
    for text in ("[1", "1" * 5000, "[" * 100_000, '{"a": 1}', "\xff"):
        path.write_bytes(text.encode("latin-1"))
        with pytest.raises(DamagedError, match=r"a\.json: damaged file"):
            files.read_json(path, dict[str, list[int]])


@pytest.mark.parametrize("text", ["9" * 400, "[" * 100_000, '{"a": ' + "9" * 5_000 + "}"], ids=["400", "deep", "5000"])
def test_json_that_nothing_can_compute_with_is_damaged(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(DamagedError):
        files.read_json(tmp_path / "a.json")
    assert files.json_value("9" * 300) == int("9" * 300)


@pytest.mark.parametrize("text", ["a = " + "[" * 5_000, "a = " + "9" * 5_000], ids=["deep", "5000"])
def test_a_config_file_that_nothing_can_read_is_named(tmp_path, text):
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(UserError, match="not a TOML file"):
        checked_config(tmp_path / "a.toml")


SCORES = {name: {views: dict.fromkeys(PRINTED, 0.5) for views in ("4", "8")} for name in ("frozen", "adapted")}


@pytest.mark.parametrize(
    "content",
    [None, [], {"frozen": 1}, {**SCORES, "adapted": {}}, {**SCORES, "frozen": {"4": {"auc30": None}}}],
    ids=["gone", "list", "number", "missing", "null"],
)
def test_scores_of_a_demo_that_are_damaged_or_gone(tmp_path, content):
    path = tmp_path / "scores.json"
    files.write_json(path, SCORES)
    assert read_scores(path) == SCORES
    path.unlink() if content is None else files.write_json(path, content)
    with pytest.raises(DamagedError, match=r"Run again with --overwrite\."):
        read_scores(path)


@pytest.mark.parametrize(
    "line", ["{", "[]", '{"kind": "step", "views": 1}', '{"kind": "evaluation", "views": 1, "4": 2}']
)
def test_a_damaged_training_log_is_named(tmp_path, line):
    (tmp_path / "log.jsonl").write_text('{"kind": "other", "views": 1}\n' + line + "\n")
    with pytest.raises(DamagedError, match=r"log\.jsonl: damaged file"):
        read_log(tmp_path / "log.jsonl")


def test_tensors_on_a_full_disk_end_as_other_files_do(tmp_path, monkeypatch):
    import safetensors.torch

    def full(*arguments, **options):
        raise safetensors.SafetensorError("I/O error: No space left on device (os error 28)")

    monkeypatch.setattr(safetensors.torch, "save_file", full)
    with pytest.raises(OSError) as caught:
        files.write_tensors(tmp_path / "a.safetensors", {"x": torch.zeros(1)})
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(tmp_path / "a.safetensors"))
    assert list(tmp_path.iterdir()) == []


def test_damaged_tensors_are_refused_whatever_the_reader_raises(tmp_path):
    path = tmp_path / "a.safetensors"
    save_file({"x": torch.zeros(2)}, path)
    whole = path.read_bytes()
    for content in (whole[:-1], whole[:20], b"", whole.replace(b'"F32"', b'"F31"'), b"\xff" * 8 + whole[8:]):
        path.write_bytes(content)
        with pytest.raises(DamagedError, match=r"a\.safetensors: damaged file"):
            files.read_tensors(path)


@pytest.mark.parametrize("version", [1, 2])
def test_limits_of_control_groups_count(tmp_path, monkeypatch, version):
    """A group of 3 GB with 2 GB used, 1 GB of that for files that can be dropped, in one with more room."""
    root = tmp_path / "groups" / ("memory" if version == 1 else "")
    names = {
        1: ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
        2: ("memory.max", "memory.current", "inactive_file"),
    }[version]
    for group, limit in ((root / "job", 3_000), (root, 9_000)):
        group.mkdir(parents=True, exist_ok=True)
        (group / names[0]).write_text(f"{limit}\n")
        (group / names[1]).write_text("2000\n")
        (group / "memory.stat").write_text(f"cache 5\n{names[2]} 1000\n")
    (tmp_path / "self").mkdir()
    (tmp_path / "self" / "cgroup").write_text("4:memory:/job\n" if version == 1 else "0::/job\n")
    (tmp_path / "meminfo").write_text("MemAvailable: 1000 kB\n")
    monkeypatch.setattr(host, "PROC", tmp_path)
    monkeypatch.setattr(host, "CGROUPS", tmp_path / "groups")
    assert host.host_available() == 2_000
    (root / "job" / names[0]).write_text("max\n")
    assert host.host_available() == 8_000
    (root / names[0]).write_text("9223372036854771712\n")
    assert host.host_available() == 1_024_000


def broken_plugin(monkeypatch, load):
    point = SimpleNamespace(name="bad", value="bad:ENTRY", load=load)
    monkeypatch.setattr(catalog, "_plugin_points", lambda: {"bad": point})


def failing():
    raise ImportError("no module\nnamed x")


def test_a_plugin_that_does_not_load_hides_no_other_model(monkeypatch, capsys):
    broken_plugin(monkeypatch, failing)
    assert main(["models"]) == 0
    streams = capsys.readouterr()
    assert "freegeo-tiny" in streams.out and "da3-base" in streams.out
    assert "warning: the plug-in 'bad' (bad:ENTRY) does not work (ImportError: no module named x)" in streams.err
    assert main(["models", "describe", "bad"]) == 1
    assert "freegeo: the plug-in 'bad'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "what"),
    [
        (MemoryError(), "of this machine"), (torch.OutOfMemoryError("CUDA out of memory. Tried"), "of the device"),
        (RuntimeError("MPS backend out of memory (MPS allocated: 9 GB)"), "of the device"),
        (RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`"), "of the device"),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried"), "of this machine"),
    ],
    ids=["python", "device", "mps", "cublas", "torch"],
)  # fmt: skip
def test_exhausted_memory_says_what_to_change(monkeypatch, capsys, error, what):
    def fail(name):
        raise error

    monkeypatch.setattr(catalog, "entry", fail)
    assert main(["models", "describe", "freegeo-tiny"]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"freegeo: the memory {what}") and "--model" in said and "--max-views" in said


def test_other_errors_are_no_matter_of_memory():
    assert out_of_memory(RuntimeError("shape mismatch")) is None


@pytest.mark.skipif(not FULL.exists(), reason="needs /dev/full")
@pytest.mark.parametrize("arguments", [["--help"], ["run", "--help"]], ids=" ".join)
def test_output_that_nobody_reads_or_nothing_can_hold(arguments):
    command = [sys.executable, "-m", "freegeo.cli.app", *arguments]
    with FULL.open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, "freegeo: standard output: No space left on device.\n")
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_code_of_a_mistake_is_kept_where_nothing_can_be_printed():
    with FULL.open("w") as full:
        done = subprocess.run([sys.executable, "-m", "freegeo.cli.app", "run"], stderr=full, check=False)
    assert done.returncode == 2


@pytest.mark.parametrize("kind", [FreeGeoError, UserError])
def test_a_sentence_keeps_the_names_of_files_and_cuts_off_their_content(kind):
    path = "/".join(["x" * 255] * 8)
    assert str(kind(f"{path}: no such file.")) == f"{path}: no such file."
    assert str(kind(f"a.json: '{'1' * 5000}' is no number.")) == f"a.json: '{'1' * 79}... is no number."


@pytest.mark.parametrize(
    "error", [UserError("a"), DamagedError("a.json", "b", "c"), UnreadableImageError(Path("a.png"), "b")], ids=repr
)
def test_an_error_passes_from_a_worker_to_another_process(error):
    copy = pickle.loads(pickle.dumps(error))
    assert (type(copy), str(copy), vars(copy)) == (type(error), str(error), vars(error))


@pytest.mark.parametrize("value", [10**299, "1" * 5000, ["x"] * 5000], ids=["number", "text", "list"])
def test_a_camera_file_is_not_quoted_at_length(tmp_path, value):
    files.write_json(tmp_path / "cameras.json", {"frames": [{}], "metric": value})
    with pytest.raises(UserError, match="metric is ") as error:
        read_cameras(tmp_path / "cameras.json")
    assert len(str(error.value)) < 300 + len(str(tmp_path))
